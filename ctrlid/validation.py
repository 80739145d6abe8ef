"""compare(): how well a model or a loop reproduces a record, every curve labelled for what it is."""

from dataclasses import dataclass
from typing import Any

import control as ct
import numpy as np
from scipy import optimize

from .controllers import PID
from .data import Record
from .errors import CtrlidError
from .linearization import state_matrices
from .loop import Loop
from .physics import Array, timebase
from .predictor import predict, predict_ahead
from .residuals import Correlation, autocorrelation, cross_correlation, explained_share
from .replay import controller_output
from .simulation import Simulator
from .stepping import growth_rate

SYSTEMATIC = 0.05  # share of an error that follows the signals and is worth a word


@dataclass(frozen=True, eq=False)
class Curve:
    """One reproduction of the measured output.

    Attributes
    ----------
    label : str
        What it is: a prediction (uses measured outputs) or a simulation (does not).
    y : ndarray, shape (n,)
        Reproduced output; NaN where there is none.
    fit : float
        Fit in percent, ``100 (1 - |y - yhat| / |y - mean(y)|)``.
    rms : float
        Root mean square of the error [output unit].
    noise_share : float
        Share of the error's variance that does not follow the past of reference and input.
    """

    label: str
    y: Array
    fit: float
    rms: float
    noise_share: float


@dataclass(frozen=True, eq=False)
class Comparison:
    """What `compare` found.

    Attributes
    ----------
    what : str
        The model or loop that was compared.
    record : Record
        The data.
    curves : tuple of Curve
        Predictions and simulations.
    residuals : ndarray, shape (n,)
        One-step prediction errors; NaN where there are none.
    tests : tuple of Correlation
        Residuals with their own past, with past u and with past r.
    notes : tuple of str
        What could not be computed, and why.
    """

    what: str
    record: Record
    curves: tuple[Curve, ...]
    residuals: Array
    tests: tuple[Correlation, ...]
    notes: tuple[str, ...] = ()

    def __getitem__(self, label: str) -> Curve:
        for curve in self.curves:
            if label in curve.label:
                return curve
        raise CtrlidError(f"no curve is called {label!r}; there are "
                          f"{', '.join(c.label for c in self.curves)}")  # fmt: skip

    @property
    def fit(self) -> dict[str, float]:
        """Fit in percent by curve label."""
        return {curve.label: curve.fit for curve in self.curves}

    @property
    def verdict(self) -> str:
        """The comparison in a sentence."""
        last = self.curves[-1]
        share = 100 * last.noise_share
        text = f"The {last.label} reproduces {self.record.name or 'the record'} with a fit of {last.fit:.1f} %; "
        if 1 - last.noise_share < SYSTEMATIC:
            text += f"{share:.0f} % of what remains does not follow reference or input: noise explains it."
        else:
            text += (f"only {share:.0f} % of what remains is unrelated to reference and input, the "
                     "rest follows them: something is missing in the model.")  # fmt: skip
        failed = [t.name for t in self.tests if not t.passed]
        if failed:
            text += f" The one-step errors are NOT WHITE OR NOT INDEPENDENT ({'; '.join(failed)})."
        return text

    def __str__(self) -> str:
        unit = self.record.units.get("y", "")
        rows = [f"{self.what} against {self.record.name or 'record'} ({len(self.record)} samples, "
                f"{np.count_nonzero(self.record.valid)} valid)",
                f"  {'curve':<34}{'fit':>9}{'RMS error':>14}{'noise explains':>17}"]  # fmt: skip
        rows += [f"  {c.label:<34}{c.fit:>7.2f} %{c.rms:>11.3e} {unit:<2}{100 * c.noise_share:>14.1f} %"
                 for c in self.curves]  # fmt: skip
        for t in self.tests:
            worst = int(np.argmax(np.abs(t.values)))
            mark = "ok" if t.passed else "NO"
            rows.append(f"  {t.name:<34}{mark:>9}   largest {t.values[worst]:+.3f} at lag "
                        f"{t.lags[worst]}, 99 % band {t.band:.3f}, p = {t.p_value:.2g}")  # fmt: skip
        rows += [f"  note: {note}" for note in self.notes]
        return "\n".join([*rows, "  " + self.verdict])


def compare(record: Record, model_or_loop: Any, *, horizon: int | None = None) -> Comparison:
    """Compare a record with a model or a loop.

    A prediction uses the measured output up to some samples before; a simulation uses none of it.
    A loop with a controller is simulated closed loop; a stable plant without one is simulated
    from the measured input. An unstable plant is never simulated open loop: any difference
    would grow without bound and say nothing. What the controller's own law leaves of the measured
    u (injected pulses, dither) is injected in the simulation as well; initial states are
    estimated for each valid stretch.

    Parameters
    ----------
    record : Record
        The data.
    model_or_loop : Loop, IdentifiedModel or control.TransferFunction
        What to compare with them. A transfer function predicts as the ARX equation does, with the
        constant part fitted to this record.
    horizon : int, optional
        Samples to predict ahead; by default about one time constant of the slowest unstable, or
        else the slowest stable, pole.

    Returns
    -------
    Comparison
        Curves with fit and error, and tests of the one-step errors.

    Raises
    ------
    CtrlidError
        If record and model do not fit together.

    Examples
    --------
    >>> import ctrlid as cid
    >>> plant = cid.plants.servo(m=1.0, c=2.0, k=3.0)
    >>> loop = cid.Loop(plant, 5.0, dt=0.01)
    >>> r = cid.random_binary(1000, amplitude=0.1, hold=50, seed=1)
    >>> record = cid.simulate(loop, r, sensor_noise=1e-3, seed=2)
    >>> [curve.label for curve in cid.compare(record, loop).curves]
    ['one-step prediction', '33-step prediction', 'closed-loop simulation']
    """
    if not isinstance(record, Record):
        raise CtrlidError(f"compare needs a Record; given {type(record).__name__}")
    if horizon is not None and not 1 <= horizon < len(record):
        raise CtrlidError(
            f"horizon must be between 1 and {len(record) - 1} samples; given {horizon}"
        )
    if isinstance(model_or_loop, Loop):
        return _compare_loop(record, model_or_loop, horizon)
    if isinstance(model_or_loop, ct.TransferFunction):
        return _compare_model(record, model_or_loop, horizon)
    raise CtrlidError(
        "compare needs a Loop, or a transfer function such as the fits return; given "
        f"{type(model_or_loop).__name__}. Put a nonlinear plant into a Loop(plant, controller, "
        "dt=..., at=...)"
    )


def _compare_loop(record: Record, loop: Loop, horizon: int | None) -> Comparison:
    prediction = predict(loop, record)
    residuals = np.where(record.valid, prediction.innovations, np.nan)
    curves = [_curve("one-step prediction", record, prediction.y)]
    poles = np.linalg.eigvals(state_matrices(loop.equations(), loop.point)[0])
    steps = horizon or _time_constant(poles, loop.equations().dt, record)
    if steps > 1:
        index, values = predict_ahead(loop, record, prediction, steps)
        ahead = np.full(len(record), np.nan)
        ahead[index] = values
        curves.append(_curve(f"{steps}-step prediction", record, ahead))
    notes = []
    try:
        label, y = _simulated(record, loop, prediction.states)
        curves.append(_curve(label, record, y))
    except CtrlidError as reason:
        notes.append(f"no simulation: {reason}")
    return Comparison(repr(loop), record, tuple(curves), residuals, _tests(record, residuals),
                      tuple(notes))  # fmt: skip


def _time_constant(poles: Any, dt: float, record: Record) -> int:
    rates = (np.log(poles.astype(complex)) / dt if dt else poles).real
    fast = rates[rates > 1e-6] if np.any(rates > 1e-6) else -rates[rates < -1e-6]
    slowest = float(np.min(fast)) if fast.size else 10 / record.duration
    return int(np.clip(round(0.67 / (slowest * record.dt)), 1, max(len(record) // 10, 1)))


def _simulated(record: Record, loop: Loop, states: Array) -> tuple[str, Array]:
    """Simulate a record, stretch by stretch, each from its own best initial state."""
    r: Any = record.r
    if loop.controller is None:
        rate = growth_rate(loop)
        if rate > -1e-9:
            raise CtrlidError(
                "the plant is not stable and the controller is unknown; an open-loop simulation "
                "would drift without bound. Give the loop its controller"
            )
        label = "open-loop simulation"
    elif loop.analog and r is None:
        raise CtrlidError("an analog loop is simulated from its reference, but the record has none")
    else:
        label = "closed-loop simulation"
        if r is None:
            if (
                isinstance(loop.controller, PID)
                and np.isfinite([loop.controller.lower, loop.controller.upper]).any()
            ):
                raise CtrlidError("a PID with limits is simulated from its reference, but the "
                                  "record has none")  # fmt: skip
            r = np.full(len(record), loop.point.output)
    y = np.full(len(record), np.nan)
    simulator = Simulator(loop)
    for start, stop in record.segments():
        if stop - start < 3:
            continue
        part = record[start:stop]
        reference = r[start:stop] if r is not None else None
        if loop.controller is None:
            d = part.u - loop.point.input
        elif loop.analog:
            d = np.zeros(len(part))
        else:
            d = part.u - controller_output(loop, part.y, reference)
        y[start:stop] = _from_best_start(simulator, part, reference, d, states[start])
    return label, y


def _from_best_start(
    simulator: Simulator, part: Record, r: Any, d: Array, guess: Array
) -> Array:  # fmt: skip
    """Simulate from the initial plant state that fits the first samples best."""
    fitted = slice(0, min(len(part), 400))
    start = simulator.rest.copy()
    start[: len(guess)] = guess
    scale = np.maximum(np.abs(guess), 1e-3 * max(float(np.std(part.y)), 1e-12))
    spread = max(float(np.std(part.y)), 1e-300)

    def misfit(step: Array) -> Array:
        z = start.copy()
        z[: len(guess)] += scale * step
        try:
            y = simulator.run(z, None if r is None else r[fitted], d[fitted])[0]
        except CtrlidError:
            return np.full(fitted.stop, 1e3)
        return np.asarray((y - part.y[fitted]) / spread, dtype=float)

    best = optimize.least_squares(misfit, np.zeros(len(guess)), x_scale="jac", diff_step=1e-5,
                                  max_nfev=20)  # fmt: skip
    start[: len(guess)] += scale * best.x
    return simulator.run(start, r, d)[0]


def _compare_model(record: Record, model: Any, horizon: int | None) -> Comparison:
    if model.ninputs != 1 or model.noutputs != 1:
        raise CtrlidError("compare needs a model with one input and one output")
    dt = timebase(model)
    if dt and abs(dt - record.dt) > 1e-9 * dt:
        raise CtrlidError(f"the model is sampled at {dt:g} s, the record at {record.dt:g} s; fit or "
                          "sample the model at the record's period")  # fmt: skip
    what = f"{model.name}: poles " + ", ".join(f"{p:.4g}" for p in model.poles())
    if not dt:
        model = ct.sample_system(ct.ss(model), record.dt, record.hold)
        model = ct.tf(model)
    num, den = (np.asarray(p[0][0], float) for p in (model.num, model.den))
    num = np.concatenate([np.zeros(len(den) - len(num)), num]) / den[0]
    den = den / den[0]
    order = len(den) - 1
    valid = np.asarray(record.valid)
    usable = np.zeros(len(record), dtype=bool)
    if len(record) <= order + 2:
        raise CtrlidError(f"a model of order {order} needs more than {order + 2} samples; given "
                          f"{len(record)}")  # fmt: skip
    usable[order:] = np.lib.stride_tricks.sliding_window_view(valid, order + 1).all(axis=1)
    y0, u0 = float(np.mean(record.y[valid])), float(np.mean(record.u[valid]))
    y, u = record.y - y0, record.u - u0
    moved = np.convolve(u, num)[: len(u)]
    error = np.convolve(y, den)[: len(y)] - moved
    constant = float(np.mean(error[usable]))
    residuals = np.where(usable, error - constant, np.nan)
    curves = [_curve("one-step prediction", record, record.y - residuals)]
    steps = horizon or _time_constant(np.roots(den), record.dt, record)
    if steps > 1:
        curves.append(_curve(f"{steps}-step prediction", record,
                             y0 + _arx_ahead(y, moved + constant, den, steps, usable)))  # fmt: skip
    notes = ["an unstable model is not simulated open loop; put it into a Loop with the controller"]
    if np.all(np.abs(np.roots(den)) < 1 - 1e-9):
        notes = []
        from scipy.signal import lfilter

        free = lfilter([1.0], den, moved + constant)
        curves.append(_curve("open-loop simulation", record, y0 + np.asarray(free)))
    return Comparison(what, record, tuple(curves), residuals, _tests(record, residuals),
                      tuple(notes))  # fmt: skip


def _arx_ahead(y: Array, driven: Array, den: Array, steps: int, usable: Any) -> Array:
    """Iterate the ARX equation `steps` times, each time with the predictions made before."""
    order, n = len(den) - 1, len(y)
    # past[i] holds, for each origin k, the (predicted or measured) output at k + j - i.
    past = [np.concatenate([np.zeros(i), y[: n - i]]) for i in range(order)]
    for j in range(1, steps + 1):
        drive = np.concatenate([driven[j:], np.full(j, np.nan)])
        new = drive - sum((a * p for a, p in zip(den[1:], past, strict=True)), np.zeros(n))
        past = [new, *past[:-1]]
    ahead = np.full(n, np.nan)
    ahead[steps:] = past[0][: n - steps] if past else driven[steps:]
    window = steps + order
    if n > window:
        whole = np.lib.stride_tricks.sliding_window_view(usable, steps).all(axis=1)
        ok = np.zeros(n, dtype=bool)
        ok[steps - 1 :] = whole
        ahead[~ok] = np.nan
    ahead[:window] = np.nan
    return ahead


def _curve(label: str, record: Record, y: Array) -> Curve:
    known = np.asarray(record.valid) & np.isfinite(y)
    if not known.any():
        return Curve(label, y, float("nan"), float("nan"), float("nan"))
    error = np.where(known, record.y - y, 0.0)
    measured = record.y[known]
    size = float(np.linalg.norm(measured - measured.mean()))
    fit = 100 * (1 - float(np.linalg.norm(error[known])) / size) if size else float("nan")
    signals = [np.asarray(s) for s in (record.r, record.u) if s is not None]
    if "simulation" in label and record.r is not None:
        signals = signals[:1]  # u carries the noise itself round the loop
    share = 1 - explained_share(error, signals, known)
    return Curve(label, np.where(known, y, np.nan), fit,
                 float(np.sqrt(np.mean(error[known] ** 2))), share)  # fmt: skip


def _tests(record: Record, residuals: Array) -> tuple[Correlation, ...]:
    known = np.isfinite(residuals)
    e = np.where(known, residuals, 0.0)
    lags = int(min(25, max(known.sum() // 10, 1)))
    tests = [autocorrelation(e, known, lags),
             cross_correlation(e, np.asarray(record.u), known, "u", lags, 1)]  # fmt: skip
    if record.r is not None:
        tests.append(cross_correlation(e, np.asarray(record.r), known, "r", lags, 0))
    return tuple(tests)
