"""The demonstration of identification: from physics to a redesign on a simulated ball."""

import math
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import control as ct
import numpy as np

from ..._base.errors import CtrlidError, CtrlidWarning
from ...data.record import Record
from ...data.references import random_binary
from ...design.lead import design_lead
from ...design.margins import loop_margins
from ...design.redesigning import Redesign, redesign
from ...estimation.constraints import ReciprocalPoles
from ...estimation.identified_model import Estimate, IdentifiedModel
from ...estimation.linear.arx import fit_arx
from ...estimation.linear.iv import fit_iv
from ...loop.loop import Loop
from ...loop.simulation import simulate
from ...physics.conversions import sample_held
from ...physics.linearization import OperatingPoint, linearize, operating_point
from ...physics.plants import maglev
from ...validation.comparing import compare
from ...validation.comparison import Comparison, write_fit
from .. import pictures as _pictures
from .. import plot
from ..html_page import Section
from ..tables import Table

TITLES = (
    "The physics",
    "A controller",
    "The experiment",
    "Plain least squares",
    "What is known beforehand",
    "What the noise does not reach",
    "What the noise explains",
    "A new controller from the model",
)
# Mass [kg], constant of the magnet [N m^2/V^2] and gravity [m/s^2] of the paper's apparatus.
BALL, MAGNET, GRAVITY = 0.0213, 3.34e-6, 9.81
# Gap at rest [m].
GAP = 0.03
# The paper settled on this sampling period [s].
PERIOD = 0.005
# Demands on the controller of the experiment: crossover [rad/s] and phase margin [deg].
CROSSOVER, PHASE_MARGIN = 130.0, 60.0
# The jumps of the reference [m] are so small that the magnet's square law does not matter.
AMPLITUDE = 5e-6
# The reference is tossed every so many samples, since a closed loop passes on slow motion only.
HOLD = 25
# Two curves lie close together if their fits differ by less than so many percent.
CLOSE = 5.0
# More samples would cost seconds and say the same.
COMPARED = 15_000
# Demands on the redesign: crossover [rad/s] and phase margin [deg].
WANTED = (120.0, 50.0)
# A relative error above this is more than rounding and chance.
WORTH_A_WORD = 0.02

Models = dict[str, IdentifiedModel]


@dataclass(frozen=True, eq=False)
class _Bench:
    """The apparatus: physics, operating point, linear models, and the loop of the experiment."""

    plant: Any
    op: OperatingPoint
    P: Any
    sampled: Any
    loop: Loop

    @property
    def pole(self) -> float:
        """The unstable pole by physics, sqrt(2 g / x0) [rad/s]."""
        return math.sqrt(2 * GRAVITY / GAP)

    @property
    def coefficients(self) -> dict[str, float]:
        """The coefficients a1, a2, b1, b2 of the sampled physics."""
        a, b = self.sampled.den[0][0], self.sampled.num[0][0]
        return dict(zip(("a1", "a2", "b1", "b2"), (a[1], a[2], b[-2], b[-1]), strict=True))


def tell_identification(
    *, samples: int = 45_000, noise: float = 0.1, seed: int = 1
) -> Iterator[Section]:
    """Tell the main job, section by section as it is computed.

    Parameters
    ----------
    samples : int, optional
        Length of the experiment.
    noise : float, optional
        Standard deviation of the sensor noise as a share of the jump of the reference.
    seed : int, optional
        Seed of reference and noise.

    Yields
    ------
    Section
        One for each of `TITLES`.

    Raises
    ------
    CtrlidError
        If the experiment cannot be made, for instance because the noise throws the ball.

    Examples
    --------
    >>> next(tell_identification()).title
    'The physics'
    """
    bench = _make_bench()
    yield _tell_physics(bench)
    yield _tell_controller(bench)
    record, perfect = _simulate_records(bench, samples, noise, seed)
    yield _tell_experiment(record, noise)
    models = {"plain": fit_arx(record, na=2, nb=2)}
    yield _tell_plain_fit(bench, models, fit_arx(perfect, na=2, nb=2), noise)
    models["constrained"] = fit_arx(record, na=2, nb=2, constraints=[ReciprocalPoles()])
    yield _tell_constrained_fit(bench, models)
    with warnings.catch_warnings(record=True) as doubts:
        warnings.simplefilter("always", CtrlidWarning)
        models["instruments"] = fit_iv(record, na=2, nb=2, constraints=[ReciprocalPoles()])
    yield _tell_instruments(bench, models, [str(doubt.message) for doubt in doubts])
    yield _tell_comparisons(bench, record, models)
    yield _tell_redesigns(bench, models)


def _make_bench() -> _Bench:
    plant = maglev(m=BALL, K=MAGNET, g=GRAVITY)
    op = operating_point(plant, output=GAP)
    P = linearize(plant, op)
    sampled = sample_held(P, PERIOD)
    C = design_lead(sampled, crossover=CROSSOVER, phase_margin=PHASE_MARGIN)
    return _Bench(plant, op, P, sampled, Loop(plant, C, dt=PERIOD, at=op))


def _tell_physics(bench: _Bench) -> Section:
    alpha, beta = -bench.P.den[0][0][-1], -bench.P.num[0][0][-1]
    volts, pole = bench.op.input, bench.pole
    text = f"""
        A steel ball of {1e3 * BALL:g} g hangs below a magnet: m x'' = m g - K V^2/x^2, with the gap
        x and the voltage V. At a gap of {1e3 * GAP:g} mm a voltage of {volts:.3f} V holds it.

        For small deviations this is X(s) = -beta/(s^2 - alpha) V(s), with poles at +/-sqrt(alpha).
        Without control any deviation doubles every {1e3 * math.log(2) / pole:.0f} ms, so the ball
        can be identified in closed loop only."""
    rows = (
        ("alpha = 2g/x0 [1/s^2]", f"{2 * GRAVITY / GAP:.3f}", f"{alpha:.3f}"),
        ("beta = 2g/V0 [m/(s^2 V)]", f"{2 * GRAVITY / volts:.5f}", f"{beta:.5f}"),
        ("unstable pole [rad/s]", f"{pole:.4f}", f"{max(bench.P.poles().real):.4f}"),
    )
    return Section(TITLES[0], _join_lines(text), Table(("", "by hand", "linearize()"), rows), {})


def _tell_controller(bench: _Bench) -> Section:
    C = bench.loop.controller
    gain, zero, pole = C.num[0][0][0], C.zeros()[0].real, C.poles()[0].real
    poles = " and ".join(f"{p:.3f}" for p in sorted(bench.sampled.poles().real, reverse=True))
    lead = f"{gain:.0f} (z {_write_signed(-zero)})/(z {_write_signed(-pole)})"
    text = f"""
        The controller is digital: every {1e3 * PERIOD:g} ms it reads the gap, computes the voltage
        and holds it. With this sampling the poles of the plant are z = {poles}; one of them is
        outside the unit circle.

        design_lead() finds the lead with a crossover of {CROSSOVER:g} rad/s and a phase margin of
        {PHASE_MARGIN:g} degrees. It gives u = V0 + C (r - y) with C = {lead}
        V/m."""
    m = loop_margins(bench.sampled * C)
    rows = (
        ("crossover [rad/s]", f"{m.crossover:.2f}"),
        ("phase margin [deg]", f"{m.phase_margin:.2f}"),
        ("gain margin [factor]", f"{m.gain_margin:.2f}"),
        ("gain reduction margin [factor]", f"{m.gain_reduction_margin:.2f}"),
        ("delay margin [ms]", f"{1e3 * m.delay_margin:.2f}"),
    )
    axes = plot.bode({"plant P (sampled)": bench.sampled, "loop C P": bench.sampled * C})
    return Section(TITLES[1], _join_lines(text), Table(("margins of the loop", ""), rows),
                   {"The plant and the loop with the lead.": axes})  # fmt: skip


def _simulate_records(
    bench: _Bench, samples: int, noise: float, seed: int
) -> tuple[Record, Record]:
    """Return the experiment as measured, and as a perfect sensor would have measured it."""
    toss, hiss = (int(s) for s in np.random.SeedSequence(seed).generate_state(2))
    r = random_binary(samples, amplitude=AMPLITUDE, hold=HOLD, around=bench.op.output, seed=toss)
    std = noise * 2 * AMPLITUDE
    measured, perfect = (simulate(bench.loop, r, sensor_noise=s, seed=hiss) for s in (std, 0.0))
    return measured, perfect


def _tell_experiment(record: Record, noise: float) -> Section:
    text = f"""
        The reference is a random binary signal with jumps of {2e3 * AMPLITUDE:g} mm, which may
        switch every {1e3 * HOLD * PERIOD:g} ms. The sensor adds white noise with a standard
        deviation of {2e6 * AMPLITUDE * noise:g} um, {100 * noise:g} % of a jump. The record has
        {len(record)} samples of reference, voltage and gap, {record.duration:g} s in all; the
        voltage is between {record.u.min():.2f} and {record.u.max():.2f} V."""
    axes = plot.figure(2, 2, (10, 4.6), sharex="col")
    plot.record(record, axes[:, 0])
    plot.record(record[: min(len(record), 16 * HOLD)], axes[:, 1])
    return Section(TITLES[2], _join_lines(text), None,
                   {"The whole record and its beginning.": axes})  # fmt: skip


def _tell_plain_fit(
    bench: _Bench, models: Models, perfect: IdentifiedModel, noise: float
) -> Section:
    plain = models["plain"]
    text = """
        The equation y(k) + a1 y(k-1) + a2 y(k-2) = b1 u(k-1) + b2 u(k-2) + c is fitted to all
        samples by least squares, as in equation (5) of the paper, "Identification of a class of
        unstable processes"."""
    largest, pole = _find_largest_pole(plain), _find_unstable_pole(plain)
    if pole is None:
        text += f"""

        NO POLE OUTSIDE THE UNIT CIRCLE: the largest absolute value is {largest:.4f}, as in equation
        (6) of the paper. The model of an unstable plant is stable."""
    else:
        text += f"""

        The unstable pole of the fit is {pole:+.2f} rad/s; that of the physics is
        {bench.pole:+.2f}."""
    clean = _find_unstable_pole(perfect)
    if noise and clean is not None:
        text += f"""

        Without sensor noise the same experiment gives {clean:+.2f} rad/s, so the noise is the
        cause. It is in the regressors y(k-1) and y(k-2) and, through the controller, in u(k-1) and
        u(k-2), and so biases least squares. More samples do not help."""
    table = _make_coefficient_table(bench, {"plain": plain, "plain, without noise": perfect})
    return Section(TITLES[3], _join_lines(text), table, {})


def _tell_constrained_fit(bench: _Bench, models: Models) -> Section:
    e, pole = models["constrained"].estimate, _find_unstable_pole(models["constrained"])
    text = f"""
        By physics the poles are a pair +/-p. In z their product is then 1, so a2 = 1; and since one
        of them is unstable, |a1| > 2. fit_arx() takes this as ReciprocalPoles() and minimises the
        same sum of squares. The result is a2 = {e["a2"]:g}"""
    if e.active_bounds or pole is None:
        text += f""" with a1 = {e["a1"]:g}: THE MODEL IS ON ITS BOUND, as in equation (8) of the
        paper. Without the constraint a1 would be beyond it: this is a symptom of bias, not a
        result."""
    else:
        text += f""" with the unstable pole {_write_against_truth(pole, bench.pole)}."""
    errors = _compute_gain_errors(bench, e)
    if max(map(abs, errors)) > WORTH_A_WORD:
        text += f"""

        The constraint gives the right structure, but does not remove the bias under feedback: the
        error of b1 is {100 * errors[0]:+z.0f} %, that of b2 {100 * errors[1]:+z.0f} %. The noise is
        still in the regressors."""
    figures = {"Poles of the fits and of the physics.": plot.poles(models, truth=bench.P)}
    return Section(TITLES[4], _join_lines(text), _make_coefficient_table(bench, models), figures)


def _tell_instruments(bench: _Bench, models: Models, doubts: list[str]) -> Section:
    e, pole = models["instruments"].estimate, _find_unstable_pole(models["instruments"])
    found = (
        "The model has no unstable pole"
        if pole is None
        else f"The unstable pole is {_write_against_truth(pole, bench.pole)}"
    )
    errors = _compute_gain_errors(bench, e)
    text = f"""
        The reference does not depend on the noise. fit_iv() uses its past as instruments: instead
        of small errors it requires errors that are uncorrelated with the reference, under the same
        constraint.

        {found}; the error of b1 is {100 * errors[0]:+z.1f} %, that of b2
        {100 * errors[1]:+z.1f} %."""
    text += "".join(f"\n\nWarning: {doubt}" for doubt in doubts)
    responses = plot.bode({"physics (sampled)": bench.sampled, **models})
    return Section(TITLES[5], _join_lines(text), _make_coefficient_table(bench, models),
                   {"Frequency responses of the fits and of the physics.": responses})  # fmt: skip


def _tell_comparisons(bench: _Bench, record: Record, models: Models) -> Section:
    record = record[:COMPARED]
    # A fit knows nothing of the operating point; like its intercept, the means stand in for it.
    means = replace(bench.op, input=float(record.u.mean()), output=float(record.y.mean()))
    loops = {k: replace(bench.loop, plant=ct.tf(G), at=means) for k, G in models.items()}
    # Curves can be compared where all look equally far ahead: one time constant of the physics.
    ahead = round(1 / (bench.pole * PERIOD))
    found = {k: compare(record, loop, horizon=ahead)
             for k, loop in {**loops, "physics": bench.loop}.items()}  # fmt: skip
    fits = {k: c["one-step"].fit for k, c in found.items()}
    steps = {k: write_fit(fit, 1) for k, fit in fits.items()}
    near = "Curves that are close together, as in figures 6 and 7 of the paper, say little."
    far = "With so much noise the two differ, but the fit does not say what the model lacks."
    text = f"""
        Each model is put into the loop with the controller and compared with the first
        {record.duration:g} s. One step ahead, the fit of the plain model is {steps["plain"]} and
        that of the physics itself {steps["physics"]}.
        {near if fits["physics"] - fits["plain"] < CLOSE else far}

        In a closed-loop simulation, which does not use the measured gap, the models differ clearly.
        The last column is the share of the variance of its error that noise explains: about 100 %
        for a model that lacks nothing."""
    rows = []
    for label, c in found.items():
        curve = next((q for q in c.curves if "simulation" in q.label), None)
        cells = ("none", "-") if curve is None else (
            write_fit(curve.fit, 1), f"{100 * curve.noise_share:.0f} %")  # fmt: skip
        # Round-off alone is not tested.
        white = "none" if not c.tests else "white" if c.tests[0].passed else "not white"
        rows.append((label, steps[label], white, *cells))
    table = Table(
        ("model in the loop", "one-step fit", "its errors", "simulation fit", "noise explains"),
        tuple(rows),
    )
    return Section(TITLES[6], _join_lines(text), table, _draw_comparisons(found))


def _draw_comparisons(found: dict[str, Comparison]) -> dict[str, Any]:
    known, good = found["constrained"], found["instruments"]
    first = _pictures.find_telling_window(known)
    t = known.record.t[first : first + _pictures.WINDOW]
    window = (t[0], t[-1] + PERIOD)
    figures = {
        "The constrained model in the loop.": plot.comparison(known, window=window),
        "The model from instruments in the loop.": plot.comparison(good, window=window),
    }
    axes = [picture.axes[0] for picture in figures.values()]
    low, high = zip(*(ax.get_ylim() for ax in axes), strict=True)
    for ax in axes:
        ax.set_ylim(min(low), max(high))
    if known.tests:
        figures["One-step errors of the constrained model."] = plot.residuals(known)
    return figures


def _tell_redesigns(bench: _Bench, models: Models) -> Section:
    crossover, margin = WANTED
    text = f"""
        A lead with a crossover of {crossover:g} rad/s and a phase margin of {margin:g} degrees is
        designed on each model. It is then tried on the nonlinear physics, with a step as large as
        the jumps of the experiment."""
    rows, outcomes = [], {}
    for label, model in models.items():
        try:
            outcome = redesign(model, bench.loop, crossover=crossover, phase_margin=margin,
                               step=2 * AMPLITUDE)  # fmt: skip
        except CtrlidError as reason:  # The page prints a refusal in the place of a design.
            text += f"\n\n{label.capitalize()}: REFUSED. {reason}"
            continue
        text += f"\n\n{label.capitalize()}: {_write_verdict(outcome)}"
        rows.append(_write_performance(label, outcome))
        outcomes[f"designed on: {label}"] = outcome
    head = ("designed on", "crossover [rad/s]", "phase margin [deg]", "overshoot [%]")
    table = Table(head, tuple(rows), "Promised / achieved on the physics.") if rows else None
    figures = {"Steps of the reference.": plot.step(outcomes)} if outcomes else {}
    return Section(TITLES[7], _join_lines(text), table, figures)


def _write_verdict(outcome: Redesign) -> str:
    p = outcome.promised
    if outcome.stable:
        return outcome.verdict
    why = outcome.failure.split(". ")[0]
    return (f"The model promises a phase margin of {p.phase_margin:.1f} deg at "
            f"{p.crossover:.0f} rad/s, but THE LOOP IS UNSTABLE on the physics. "
            f"{why[:1].upper()}{why[1:]}.")  # fmt: skip


def _write_performance(label: str, outcome: Redesign) -> tuple[str, ...]:
    p, a = outcome.promised, outcome.achieved
    pairs = ((getattr(p, name), getattr(a, name)) for name in
             ("crossover", "phase_margin", "overshoot"))  # fmt: skip
    return (label, *(f"{x:.1f} / {y:.1f}" if a.stable else f"{x:.1f} / -" for x, y in pairs))


def _find_largest_pole(G: IdentifiedModel) -> float:
    return float(np.abs(G.estimate.poles).max())


def _find_unstable_pole(G: IdentifiedModel) -> float | None:
    """Return the real part of the most unstable pole [rad/s], None without one."""
    # Two poles merged at the edge are known to half the digits only.
    return float(G.estimate.poles_s.real.max()) if _find_largest_pole(G) > 1 + 1e-6 else None


def _write_signed(value: float) -> str:
    return f"{'-' if value < 0 else '+'} {abs(value):.4f}"


def _write_against_truth(value: float, truth: float) -> str:
    error = 100 * (value / truth - 1)
    return f"{value:+.2f} rad/s ({error:+z.1f} % from sqrt(2g/x0) = {truth:.2f})"


def _compute_gain_errors(bench: _Bench, e: Estimate) -> list[float]:
    return [e[name] / bench.coefficients[name] - 1 for name in ("b1", "b2")]


def _make_coefficient_table(bench: _Bench, models: Models) -> Table:
    rows = [
        (name, f"{value:.5g}", *(f"{G.estimate[name]:.5g}" for G in models.values()))
        for name, value in bench.coefficients.items()
    ]
    poles = {k: _find_unstable_pole(G) for k, G in models.items()}
    rows.append(("unstable pole [rad/s]", f"{bench.pole:.2f}",
                 *("none" if p is None else f"{p:.2f}" for p in poles.values())))  # fmt: skip
    return Table(("", "physics", *models), tuple(rows))


def _join_lines(text: str) -> str:
    """Join the lines of each paragraph."""
    return "\n\n".join(" ".join(p.split()) for p in text.split("\n\n") if p.strip())
