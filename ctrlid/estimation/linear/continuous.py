"""fit_continuous(): a continuous-time transfer function straight from samples."""

import math
import warnings
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import control as ct
import numpy as np
from scipy import stats

from ..._base.arguments import check_arguments, explain_names
from ..._base.errors import CtrlidError, CtrlidWarning
from ..._base.interruption import hold_interrupt
from ..._base.periods import have_same_period, write_both_periods
from ..._base.rounding import keep_numpy_quiet
from ..._base.signals import require_one_signal
from ..._base.text import write_count, write_list, write_number, write_p_value, write_quantity
from ...data.record import Record
from ...data.several_records import VISIBLE_MOTION, as_records, measure_input_motion
from ...loop.controller_sight import read_sight
from ...loop.controllers import PID
from ...loop.sampled_form import note_sampled_controller
from ...physics.conversions import to_state_matrices
from ..constraints import AbstractConstraint, check_constraints, divide_constraints
from ..identified_model import Estimate, IdentifiedModel, Structure
from ..whiteness import ROUNDING, note_coloured_innovations
from .prediction_error import (
    Minimum,
    NotDetermined,
    Piece,
    Task,
    add_delay,
    colour_noise,
    find_best_fit,
    measure_delay_spread,
    restrict_observer,
)
from .sampled_motion import Circuit, list_inputs

# Above this product of dt and the controller's fastest pole, u moves visibly between samples.
FAST_CIRCUIT = 0.1

# A pole this many times 1/dt decays below the rounding of a number within one period.
BEYOND = float(-np.log(np.finfo(float).eps))
# A record without a delay is said to have one in so many cases, by chance.
MISSED = 1e-3


@explain_names
@hold_interrupt()
@keep_numpy_quiet
def fit_continuous(
    record: Record | Sequence[Record],
    poles: int,
    zeros: int = 0,
    constraints: Sequence[AbstractConstraint] = (),
    controller: Any = None,
    delay: float | None = 0.0,
) -> IdentifiedModel:
    r"""Fit a continuous-time transfer function to sampled data, in open or closed loop.

    .. math:: G(s) = \frac{b_1 s^{m} + \dots + b_{m+1}}{s^n + a_1 s^{n-1} + \dots + a_n}, \quad
        \min_{\theta, K} \sum_k \bigl(y_k - \hat y_{k|k-1}(\theta, K)\bigr)^2

    The prediction moves the model exactly over each period, so nothing is lost at fast sampling,
    and corrects its state with an observer gain K that is estimated along. Since K takes whatever
    mixture of sensor noise and force noise the data hold, the estimate is right under feedback,
    without the reference and without knowing the controller; with white Gaussian noises it is
    maximum likelihood, K by the restricted likelihood [3]_. Where the innovations are not white,
    the sensor noise becomes a moving average of an order chosen by the Bayesian criterion; a note
    says where one more pole and white noise predict better. Initial state and operating point are
    estimated for each valid stretch.

    Parameters
    ----------
    record : Record or sequence of Record
        The data; several records share the model.
    poles, zeros : int
        Number of poles n and of zeros m. As many zeros as poles mean that y follows u at once,
        within the sample: then u must not react to y within it, as under feedback it does.
    constraints : sequence of constraints, optional
        What is known: `SymmetricPoles`, `Integrator`, `StaticGain`, `Fixed`, `Bounds`, ...
    controller : control.TransferFunction or control.StateSpace, optional
        The analog controller of r - y, if one moves u between the samples: then u is
        reconstructed there. A digital controller holds u and need not be given.
    delay : float or None, optional
        Time from u to the plant [s], for a held input; None estimates it.

    Returns
    -------
    IdentifiedModel
        The transfer function in s, with `.estimate`. A delay is in the attribute
        `delay`, and counts wherever ctrlid looks at the model. One that was estimated has its
        standard error in `.estimate.delay_error`, and ``.estimate.confidence_interval("delay")``.

    Raises
    ------
    CtrlidError
        If orders, constraints or controller are unusable, the data are too few or do not excite
        what is to be estimated.

    Warns
    -----
    CtrlidWarning
        If an analog controller is at work (the record's hold is ``"foh"``) that is not known and
        moves u visibly within a period.

    References
    ----------
    .. [1] Ljung, *System Identification*, 2nd edition, sections 7.4 and 13.4.
    .. [2] Garnier and Wang (eds.), *Identification of Continuous-time Models from Sampled Data*.
    .. [3] Patterson and Thompson, Biometrika 58 (1971) 545-554.

    Examples
    --------
    >>> import control as ct
    >>> import ctrlid as cid
    >>> plant = ct.tf([-6.5], [1, 0, -1600])
    >>> C = cid.design_lead(plant, crossover=100, phase_margin=50)
    >>> C = ct.sample_system(ct.ss(C), 0.001, "tustin")
    >>> loop = cid.Loop(plant, C, dt=0.001)
    >>> r = cid.random_binary(3000, amplitude=1e-4, hold=20, seed=1)
    >>> record = cid.simulate(loop, r, sensor_noise=1e-6, seed=2)
    >>> G = cid.fit_continuous(record, poles=2, constraints=[cid.SymmetricPoles()])
    >>> G.estimate["a1"], round(G.estimate.poles.real.max())
    (0.0, 40)
    """
    check_arguments(fit_continuous, locals(), "record", "poles", "zeros", "constraints")
    structure = _check_orders(poles, zeros)
    known = check_constraints(constraints)
    records = as_records(record)
    require_one_signal("fit_continuous", records)
    divide_constraints(known, records[0].signals["y"], records[0].signals["u"])
    circuit = _make_circuit(controller, records)
    if circuit and zeros == poles:
        raise CtrlidError(
            "with controller= a plant has fewer zeros than poles: one that passes u on at once and "
            "a circuit that answers at once have no solution"
        )
    pieces = _cut_pieces(records, structure.na)
    needed = 4 * (len(structure.names) + structure.na + 2)
    total = sum(p.n for p in pieces)
    if total < needed:
        raise CtrlidError(
            f"Too few samples: {write_count(total, 'valid sample')} for "
            f"{write_count(len(structure.names), 'coefficient')} and "
            f"the noise model, which need {needed}. Record longer or lower the orders."
        )
    if delay is not None and not (np.isfinite(delay) and delay >= 0):
        raise CtrlidError(f"delay is a time >= 0 s, or None to estimate it; given {delay!r}")
    if (delay is None or delay) and (circuit or records[0].hold != "zoh"):
        raise CtrlidError("a delay can be fitted only where the input is held (hold='zoh') and "
                          "controller= is not given; give delay=0")  # fmt: skip
    longest = max(p.n for p in pieces) * records[0].dt
    if delay is not None and delay >= longest:
        raise CtrlidError(f"delay is {delay:g} s, but no stretch of valid samples is longer than "
                          f"{longest:g} s, so that no input would reach its output")  # fmt: skip
    task = Task(structure, pieces, records[0].dt, records[0].hold, circuit, delay is None, 1.0)
    size = max(float(np.max(np.abs(p.signals["y"]))) for p in pieces)

    def note_colour(fit: Minimum) -> tuple[str, ...]:
        fitted = len(structure.names) + len(fit.point.gain)
        return note_coloured_innovations(fit.residuals, fitted, _TOO_NARROW, size)

    best = find_best_fit(task, known, delay or 0.0)
    notes = note_colour(best)
    if len(notes) > 0:
        coloured = colour_noise(best, known)
        # Noise that leaves its innovations coloured stands for what the plant lacks, and bends it.
        if not len(note_colour(coloured)):
            best, notes = coloured, _note_missed_pole(coloured)
    # Errors that are rounding beside y leave nothing to gain.
    beyond_rounding = best.rss > (ROUNDING * size) ** 2 * total
    if not best.settled and beyond_rounding:
        notes = (_NOT_CONVERGED, *notes)
    if delay == 0 and not circuit and task.hold == "zoh" and beyond_rounding:
        notes = (*notes, *_note_missed_delay(best, known))
    if beyond_rounding and best.settled:
        # The restricted likelihood is climbed from the largest likelihood, and from nowhere else.
        best = restrict_observer(best, known)
    point, found, rss = best.point, best.found, best.rss
    degrees = best.used - best.fitted
    notes = (*note_sampled_controller(controller, records, "fit_continuous"), *notes)
    late, delay_variance, delay_covariance = "", 0.0, np.zeros(0)
    if task.free_delay:
        late = ", with the delay"
        delay_variance, delay_covariance = measure_delay_spread(best)
    if best.task.colour:
        late += f", sensor noise a moving average of order {best.task.colour}"
    estimate = Estimate(
        structure=structure, values=found.theta, covariance=found.spread * rss / degrees,
        intercepts=np.zeros(0), rss=rss, residual_variance=rss / degrees,
        n_samples=sum(p.n for p in best.task.pieces),
        degrees_of_freedom=degrees, active_bounds=found.active_bounds, branch=found.branch,
        method=("constrained " if known else "") + "prediction error (continuous time)",
        solver=f"Gauss-Newton steps, {found.solver}{late}", dt=0.0, condition=found.condition,
        notes=notes, delay=point.delay, delay_error=math.sqrt(delay_variance * rss / degrees),
        delay_covariance=delay_covariance * rss / degrees,
    )  # fmt: skip
    _check_speed(estimate.poles, records[0].dt)
    names = records[0].names
    model = IdentifiedModel(estimate, inputs=names.get("u", "u"), outputs=names.get("y", "y"))
    model.delay = point.delay
    return model


def _note_missed_delay(best: Minimum, known: Sequence[AbstractConstraint]) -> tuple[str, ...]:
    r"""Return what to say where a free delay explains more than chance does.

    .. math:: N \ln(V_0 / V_1) \sim \chi^2_1

    for the sums of squares without and with the delay, if there is none.
    """
    late = add_delay(best, known)
    if not 0 < late.rss < best.rss:
        return ()
    p = float(stats.chi2.sf(best.used * math.log(best.rss / late.rss), 1))
    if p >= MISSED:
        return ()
    return (
        f"WITH A DELAY OF {write_quantity(late.point.delay, 's')} THE MODEL PREDICTS BETTER "
        f"({write_p_value(p)}): something acts later than in this model, and its coefficients "
        "stand in for that. Give delay=None to estimate a delay, or more poles for a lag.",
    )


def _note_missed_pole(coloured: Minimum) -> tuple[str, ...]:
    r"""Return what to say where one more pole, with white noise, explains more than coloured noise.

    .. math:: N \ln(V_c / V_1) > (d_1 - d_c) \ln N

    for the sums of squares and the numbers of what is fitted, with coloured noise (c) and with one
    more pole (1). A moving average follows what a lag leaves in the innovations, and then bends the
    poles. The larger model has no constraints: they speak of the coefficients of the smaller one.
    """
    task = coloured.task
    larger = Structure(na=task.structure.na + 1, nb=task.structure.nb, domain="s")
    try:
        white = find_best_fit(replace(task, structure=larger, colour=0), (), coloured.point.delay)
    except NotDetermined:
        return ()
    gained = coloured.used * math.log(coloured.rss / white.rss) if white.rss > 0 else math.inf
    if gained <= (white.fitted - coloured.fitted) * math.log(coloured.used):
        return ()
    return (
        f"{larger.na} POLES AND WHITE NOISE PREDICT BETTER than this model with its moving average "
        f"of order {task.colour}: something acts later than in this model, and its coefficients "
        "stand in for that. Give more poles for a lag, or delay=None to estimate a delay.",
    )


_NOT_CONVERGED = (
    "THE SEARCH ENDED WITHOUT CONVERGENCE: a further step promised a better fit, and none of those "
    "tried gave it. Lower the orders, add a constraint, or excite the loop more."
)
_TOO_NARROW = (
    "The observer takes a mixture of white force noise and sensor noise of short memory, so that "
    "the standard errors are too small and coefficients may be biased: compare with fit_iv, or "
    "raise the order."
)


def _check_speed(poles: Any, dt: float) -> None:
    """Refuse a pole whose motion over one period is below rounding, or overflows it."""
    fastest = poles[int(np.argmax(np.abs(poles.real)))]
    if not np.isfinite(poles).all() or abs(fastest.real) * dt > BEYOND:
        raise CtrlidError(
            f"The data do not determine the model: the fit ended with a pole at "
            f"{write_number(fastest.real, 3)} rad/s, of which nothing is left after one period of "
            f"{dt:g} s. Lower the number of poles, or add a constraint."
        )


def _check_orders(poles: Any, zeros: Any) -> Structure:
    for name, value, least in (("poles", poles, 1), ("zeros", zeros, 0)):
        if not isinstance(value, int | np.integer) or value < least:
            raise CtrlidError(f"{name} must be an integer of at least {least}; given {value!r}")
    if zeros > poles:
        raise CtrlidError(
            f"a plant has no more zeros than poles; given {write_count(zeros, 'zero')} and "
            f"{write_count(poles, 'pole')}"
        )
    return Structure(na=int(poles), nb=int(zeros) + 1, domain="s")


def _make_circuit(controller: Any, records: Sequence[Record]) -> Circuit | None:
    if isinstance(controller, PID) or (
        isinstance(controller, ct.InputOutputSystem) and controller.dt not in (0, None)
    ):
        # A digital controller holds u, which is therefore known between the samples.
        period = getattr(controller, "dt", None)
        if period and period is not True and not have_same_period(period, records[0].dt):
            both = write_both_periods("the controller runs", period, "the record", records[0].dt)
            raise CtrlidError(f"{both}; give the record its period, or the controller that ran")
        return None
    if controller is None:
        moves = measure_input_motion(records)
        if moves > VISIBLE_MOTION:
            warnings.warn(
                f"u is not held (hold={records[0].hold!r}): it changes by {100 * moves:.0f} % of "
                "its standard deviation from sample to sample, and a straight line is assumed "
                "between the samples. If the record was decimated, give the one that was logged; "
                "with an analog controller, give controller= (and record the reference) so that u "
                "can be reconstructed, or sample faster",
                CtrlidWarning, stacklevel=5,
            )  # fmt: skip
        return None
    if not isinstance(controller, ct.TransferFunction | ct.StateSpace) or (
        controller.ninputs != 1 or controller.noutputs != 1
    ):
        raise CtrlidError(
            "controller= takes the analog controller of r - y as a TransferFunction or StateSpace "
            f"with one input and one output; given {type(controller).__name__}"
        )
    a, b, c, d = to_state_matrices(controller)
    gain = float(d[0, 0])
    sight = read_sight(records[0]) if gain else "reading"
    circuit = Circuit(a, b[:, 0], c[0], gain, records[0].hold_r, sight)
    if any(r.r is None for r in records):
        if records[0].dt * circuit.fastest > FAST_CIRCUIT:
            warnings.warn(
                "the record has no reference, so a straight line is assumed for u between the "
                "samples, but the fastest pole of the controller times dt is "
                f"{records[0].dt * circuit.fastest:.2g}; record the reference or sample faster",
                CtrlidWarning, stacklevel=5,
            )  # fmt: skip
        return None
    return circuit


def _cut_pieces(records: Sequence[Record], order: int) -> tuple[Piece, ...]:
    pieces = []
    for record in records:
        y0, u0 = (float(np.mean(s[record.valid])) if record.valid.any() else 0.0
                  for s in (record.y, record.u))  # fmt: skip
        for start, stop in record.segments():
            if stop - start < 4 * (order + 2):
                continue
            part = {
                "y": record.y[start:stop] - y0,
                **list_inputs(record.u[start:stop] - u0, record.hold),
            }
            if record.r is not None:
                # The same level is taken off r and y, so that r - y keeps its value.
                part["r"] = record.r[start:stop] - y0
            pieces.append(Piece(part, stop - start))
    if not pieces:
        raise CtrlidError(f"a fit of this order needs {4 * (order + 2)} valid samples in "
                          "succession; the record has no stretch so long. Record longer, or lower "
                          "the orders")  # fmt: skip
    flat = [name for name in ("u", "y") if all(np.ptp(p.signals[name]) == 0 for p in pieces)]
    if flat:
        raise CtrlidError(
            f"The data do not determine the coefficients: {write_list(flat)} "
            f"{'are' if len(flat) > 1 else 'is'} constant in all valid samples. Excite the loop: "
            "vary the reference (random_binary) or add a signal to u."
        )
    return tuple(pieces)
