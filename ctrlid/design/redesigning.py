"""redesign(): a controller designed on an identified model, and what it does on the physics."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, overload

import control as ct
import numpy as np

from .._base.arguments import check_arguments, explain_names, is_number, point_at_part
from .._base.arrays import Array, freeze_arrays
from .._base.errors import CtrlidError, ModelCannotRun
from .._base.interruption import hold_interrupt
from .._base.rounding import keep_numpy_quiet
from .._base.signals import require_one_signal
from .._base.text import Printed, write_polynomial, write_quantity
from ..estimation.identified_model import IdentifiedModel, IdentifiedSystem
from ..estimation.likelihood.physics_estimate import LoopFit, linearize_at_rest
from ..loop.loop import Loop, describe_other_output, find_input_limits
from ..loop.period_map import compute_growth_rate
from ..loop.simulation import SimulationStopped, simulate
from ..physics.conversions import sample_held, to_transfer_function
from ..physics.trace import timebase
from .controller_trial import CLOSE, ControllerTrial
from .design_trial import try_design
from .lead import design_lead
from .margins import loop_margins, nu_gap, robust_margin
from .reference_steps import LOST, write_sentence
from .settling import SETTLED, TAIL, explain_unsettled, settles_otherwise
from .step_height import StepHeight, advise_step, choose_height, try_heights

# A step response lasts so many radians at the crossover, and so many time constants of its slowest
# pole; poles slower than this share of the crossover are not waited for.
WAVES, LASTING, SLOWEST = 60.0, 8.0, 1e-3
# It has so many samples at most.
LONGEST = 50_000


@dataclass(frozen=True)
class Performance:
    """What a controller promises on a model, or achieves on the physics.

    A number that does not exist is NaN.

    Parameters
    ----------
    stable : bool
        Whether the closed loop is stable.
    phase_margin : float
        Smallest phase margin [deg]; NaN for an unstable loop.
    gain_margin : float
        Factor by which the gain may grow; infinite if any may.
    gain_reduction_margin : float
        Factor to which the gain may fall, below one: an unstable plant needs its loop gain.
    crossover : float
        Gain crossover [rad/s].
    overshoot : float
        Of a reference step, in percent of the final value. On the physics the step has a height.
    settling_time : float
        Until the step response stays within 2 % of its final value [s]; infinite if it never does.
    final_value : float
        Of the output per unit of reference: a lead alone leaves a steady error.
    """

    stable: bool
    phase_margin: float
    gain_margin: float
    gain_reduction_margin: float
    crossover: float
    overshoot: float
    settling_time: float
    final_value: float


@dataclass(frozen=True, eq=False, repr=False)
class Redesign(Printed):
    """A controller designed on a model, with the promise and what came of it.

    Parameters
    ----------
    controller : control.TransferFunction
        The lead compensator, in the time base of the model: analog on one in continuous time.
    promised, achieved : Performance
        On the model, and on the nonlinear physics of the loop.
    nu_gap : float
        Distance [1] between the model and the linearized physics (0 the same, 1 worlds apart).
    robust_margin : float
        Nu-gap [1] that the design is sure to survive.
    loop : Loop
        The physics with the new controller.
    time : ndarray
        Time of the step responses [s].
    promised_step, achieved_step : ndarray
        Responses to a step of the reference by 1 [output unit per output unit]; what was achieved
        ends early where the simulation broke off.
    step : float
        Height of the reference step that was tried on the physics [output unit].
    failure : str
        Why the physics was not kept stable, or empty.
    step_reason : str
        Why the step has this height where none was given and the output rests at zero, or empty.
    sampled_margin : float or None
        Phase margin [deg] of an analog lead that runs as a program with the sampling period of the
        loop (bilinear rule, held output) on the linearized physics, where the controller of the
        loop is a program; NaN where that is not stable, None where the question does not arise.
    """

    controller: Any
    promised: Performance
    achieved: Performance
    nu_gap: float
    robust_margin: float
    loop: Loop
    time: Array
    promised_step: Array
    achieved_step: Array
    step: float
    failure: str = ""
    step_reason: str = ""
    sampled_margin: float | None = None

    def __post_init__(self) -> None:
        freeze_arrays(self)

    @property
    def stable(self) -> bool:
        """Whether the controller keeps the physics stable."""
        return self.achieved.stable

    @property
    def _unit(self) -> str:
        """The unit of the output, which is that of the step."""
        return self.loop.known_units.get(self.loop.signals["y"][0], "")

    @property
    def verdict(self) -> str:
        """The outcome in words."""
        return f"{self._tell_as_program()} {self._compare()}".lstrip()

    def _tell_as_program(self) -> str:
        """Return what becomes of an analog lead as a program; empty where nobody asks."""
        if self.sampled_margin is None:
            return ""
        p, dt = self.promised, self.loop.dt
        start = (
            "This lead is an analog circuit, because the model is in continuous time, while the "
            f"controller of the loop is a program that runs every {dt:g} s. As such a program "
        )
        cure = (
            f"Design on the sampled model, redesign(ct.sample_system(ct.ss(G), {dt:g}), loop, "
            "...), or sample the lead and try that, redesign(G, loop, design=lambda P: "
            f'ct.sample_system(outcome.controller, {dt:g}, "tustin")).'
        )
        if math.isnan(self.sampled_margin):
            return f"{start}it DOES NOT STABILIZE THE PHYSICS. {cure} What follows is the circuit."
        lost = p.phase_margin - self.sampled_margin
        kept = f"{start}(bilinear rule) it has a phase margin of {self.sampled_margin:.1f} deg"
        if lost > CLOSE * p.phase_margin:
            return (f"{kept}: {lost:.1f} DEGREES ARE LOST BY SAMPLING. {cure} What follows is the "
                    "circuit.")  # fmt: skip
        return f"{kept}. What follows is the circuit."

    def _compare(self) -> str:
        """Return what was promised against what was achieved."""
        p, a = self.promised, self.achieved
        if not a.stable and not np.isfinite(a.phase_margin):
            return (
                "The controller DOES NOT STABILIZE THE PHYSICS: the model is too different from "
                f"it. {self.failure}"
            )
        text = (f"The model promises a phase margin of {p.phase_margin:.1f} deg at "
                f"{p.crossover:.4g} rad/s; achieved on the physics are {a.phase_margin:.1f} deg at "
                f"{a.crossover:.4g} rad/s")  # fmt: skip
        loss = p.phase_margin - a.phase_margin
        shift = a.crossover / p.crossover - 1
        apart = a.final_value / p.final_value - 1 if p.final_value else 0.0
        restless = np.isfinite(p.settling_time) and not np.isfinite(a.settling_time)
        step = write_quantity(self.step, self._unit)
        # An unstable loop has no final value.
        apart = abs(apart) if np.isfinite(apart) else 0.0
        if loss > CLOSE * p.phase_margin:
            text += f": {loss:.1f} DEGREES OF PHASE MARGIN ARE LOST."
        elif abs(shift) > CLOSE:
            side = "LOWER" if shift < 0 else "HIGHER"
            text += f": THE CROSSOVER IS {side} BY {100 * abs(shift):.0f} %."
        else:
            worst, which = max(loss / p.phase_margin, abs(shift)), "the margins hold"
            if apart <= CLOSE and not restless:
                worst, which = max(worst, apart), "the promise holds"
            text += f", so {which} within {max(math.ceil(100 * worst), 1)} %."
        if not a.stable:
            text += (f" This is for small signals: WITH A STEP OF {step} THE LOOP "
                     f"DIVERGES. {self.failure} Where such a step is beyond the range "
                     "of the plant, give a smaller step= to redesign.")  # fmt: skip
        elif restless:
            why = explain_unsettled(self.loop, self.loop.signals["y"][0], self.step)
            text += (f" This is for small signals: WITH A STEP OF {step} THE RESPONSE "
                     f"DOES NOT SETTLE. {why}")  # fmt: skip
        elif apart > CLOSE:
            text += (f" THE RESPONSE TO A STEP of {step} ends at {a.final_value:.3g} per "
                     f"unit, where {p.final_value:.3g} is promised.")  # fmt: skip
        elif settles_otherwise(p.settling_time, a.settling_time, self.loop.dt):
            text += (f" The step settles after {a.settling_time:.4g} s where {p.settling_time:.4g} "
                     f"s is promised: {TAIL}.")  # fmt: skip
        sure = self.nu_gap < self.robust_margin
        # Where the units of a loop make the margin small, it has more digits.
        digits = max(3, 1 - math.floor(math.log10(max(self.robust_margin, 1e-14))))
        return (
            f"{text} Stability near the operating point is {'' if sure else 'not '}guaranteed: "
            f"the nu-gap between model and physics is {self.nu_gap:.{digits}f}, and it has to be "
            f"below the robust margin of {self.robust_margin:.{digits}f}."
        )

    @property
    def rows(self) -> tuple[tuple[str, str, str], ...]:
        """Return quantity, promised and achieved value as printed, row by row."""
        made = []
        for label, name, form in (
            ("phase margin [deg]", "phase_margin", ".2f"),
            ("gain margin [factor]", "gain_margin", ".3f"),
            ("gain reduction margin [factor]", "gain_reduction_margin", ".3f"),
            ("crossover [rad/s]", "crossover", ".2f"),
            ("final value per step", "final_value", ".3f"),
            ("overshoot [%]", "overshoot", ".2f"),
            ("settling time [s]", "settling_time", ".4f"),
        ):
            promised, achieved = (
                "-" if np.isnan(v) else f"{v:{form}}"
                for v in (getattr(self.promised, name), getattr(self.achieved, name))
            )
            made.append((label, promised, achieved))
        return tuple(made)

    def __str__(self) -> str:
        rows = [
            f"  {a:<32}{b:>12}{c:>12}" for a, b, c in (("", "promised", "achieved"), *self.rows)
        ]
        variable = "z" if self.controller.dt else "s"
        num, den = (write_polynomial(p[0][0], variable)
                    for p in (self.controller.num, self.controller.den))  # fmt: skip
        step = (
            "  The last three values achieved are for a step of "
            f"{write_quantity(self.step, self._unit)} on the nonlinear physics. "
            + advise_step(self.loop)
            + f" {self.step_reason}".rstrip()
        )
        kind = "an analog lead" if self.loop.analog else f"a digital lead, {self.loop.dt:g} s"
        head = f"controller: ({num}) / ({den}), {kind}"
        return "\n".join([head, *rows, step, "  " + self.verdict])


@overload
def redesign(
    G: Any, loop: Loop, crossover: float, phase_margin: float, *, step: float | None = None
) -> Redesign: ...
@overload
def redesign(
    G: Any, loop: Loop, *, design: Callable[[Any], Any],
    step: float | Mapping[str, float] | None = None,
) -> ControllerTrial: ...  # fmt: skip
@explain_names
@hold_interrupt()
@keep_numpy_quiet
def redesign(
    G: Any, loop: Loop, crossover: float | None = None, phase_margin: float | None = None, *,
    design: Callable[[Any], Any] | None = None,
    step: float | Mapping[str, float] | None = None,
) -> Redesign | ControllerTrial:  # fmt: skip
    """Design a controller on a model and try it on the physics of a loop.

    With a crossover and a phase margin the controller is the lead of `design_lead` on `G`. With
    `design`, a function from the model to a controller, it is any that python-control knows, for
    any number of signals: ``design=lambda P: ct.create_statefbk_iosystem(P, ct.lqr(P, Q, R)[0])``
    where the outputs of the model are all of its states, else with an observer as below.

    The promise is that of the linear loop with `G`. What the controller achieves is measured on the
    loop's own plant: poles and margins on the plant linearized at the operating point (and sampled,
    for a digital controller), step responses on the nonlinear equations, within the loop's input
    limits.

    Parameters
    ----------
    G : control.TransferFunction, control.StateSpace, Loop or LoopFit
        The model, for instance an `IdentifiedModel`; of a loop or a fitted loop its linear model at
        the operating point, in the states of the plant. A model in discrete time needs a digital
        controller at its sampling period; the lead on a continuous one is analog.
    loop : Loop
        The physics and its operating point; its own controller is not used.
    crossover : float, optional
        Gain crossover to design for [rad/s].
    phase_margin : float, optional
        Phase margin to design for [deg].
    design : callable, optional
        Function of the model, with the signal names of the loop; what `fit_arx`
        found of several signals comes in states, a delay as Padé's approximation. It returns the
        controller, alone or with the closed loop, as `control.create_statefbk_iosystem` does. The
        controller is wired as `Loop` says; its own time base decides whether it is digital.
    step : float or mapping of str to float, optional
        Height of the reference step [output unit]; by default 1 % of the output at the operating
        point. Where that is zero, what moves the input by a tenth of its way to a limit by the
        model, or without limits 0.01 in SI units, or the largest tenth, hundredth, ... of it with
        which the physics does not break off; the text says which. Of an output that is read in
        steps (`Quantization`) it is at least fifty of these, where that is not too much. Of several
        references, a mapping of names says which are tried; by default those that cannot be held
        and each ``xd[i]`` that is an output.

    Returns
    -------
    Redesign or ControllerTrial
        Controller, promise, achievement and a verdict in words as its text: a `ControllerTrial`
        where a function designed it.

    Raises
    ------
    CtrlidError
        If one lead cannot do it on this model, the function fails or returns no controller, or the
        arguments do not fit.

    References
    ----------
    Vinnicombe, "Frequency domain uncertainty and the graph topology", IEEE Transactions on
    Automatic Control 38 (1993) 1371-1383.

    Examples
    --------
    >>> import ctrlid as cid
    >>> plant = cid.plants.maglev(m=0.0213, K=3.34e-6)
    >>> op = cid.operating_point(plant, output=0.012)
    >>> loop = cid.Loop(plant, None, dt=0.001, at=op)
    >>> outcome = cid.redesign(cid.linearize(plant, op), loop, crossover=100, phase_margin=50)
    >>> outcome.stable, round(outcome.achieved.phase_margin, 6)
    (True, 50.0)

    A cart with a pole, under state feedback on an observer:

    >>> import control as ct
    >>> import numpy as np
    >>> cart = cid.plants.cart_pole(M=0.5, m=0.2, length=0.3)
    >>> rig = cid.Loop(cart, dt=0.01)
    >>> def design(P):
    ...     K = ct.lqr(P, np.diag([10, 10, 1, 1]), np.eye(1))[0]
    ...     L = ct.lqe(P, np.eye(1), 1e-4 * np.eye(2))[0]
    ...     return ct.ss(P.A - L @ P.C - P.B @ K, np.hstack([L, P.B @ K]), -K,
    ...                  np.hstack([np.zeros((1, 2)), K]), outputs="F",
    ...                  inputs=["x", "theta", "xd[0]", "xd[1]", "xd[2]", "xd[3]"])
    >>> trial = cid.redesign(rig, rig, design=design)
    >>> trial.stable, [s.reference for s in trial.steps]
    (True, ['xd[0]'])
    """
    check_arguments(redesign, locals(), "loop", "step", "design")
    if isinstance(G, Loop | LoopFit):
        G = G.linearize(states=True) if isinstance(G, Loop) else linearize_at_rest(G.loop, True)
    if not isinstance(G, ct.TransferFunction | ct.StateSpace):
        raise CtrlidError("redesign needs a linear model (a TransferFunction, as the fits return); "
                          f"given {type(G).__name__}{point_at_part(G, Loop)}")  # fmt: skip
    if not isinstance(loop, Loop):
        raise CtrlidError("redesign needs a Loop, on which the controller is tried; given "
                          f"{type(loop).__name__}{point_at_part(loop, Loop)}")  # fmt: skip
    other = describe_other_output(loop)
    if other:
        # The controller would be tried about another point than that which it was designed for.
        given = ", ".join(f"{y:.4g}" for y in loop.point.outputs)
        raise CtrlidError(f"the output of the loop's operating point is {given}, but {other}. Give "
                          "the loop at=operating_point(plant, output=...)")  # fmt: skip
    if isinstance(design, ct.InputOutputSystem):
        # A transfer function can be called too, with a frequency.
        raise CtrlidError(
            "design= is a function from the model to a controller. To try a controller that there "
            f"is already, give design=lambda P: C; given {type(design).__name__}"
        )
    if design is not None:
        if crossover is not None or phase_margin is not None:
            raise CtrlidError("redesign takes a crossover and a phase margin, or design= with a "
                              "function of the model; given both")  # fmt: skip
        if not callable(design):
            raise CtrlidError("design= is a function from the model to a controller, such as "
                              "lambda P: ct.create_statefbk_iosystem(P, ct.lqr(P, Q, R)[0]); given "
                              f"{design!r}")  # fmt: skip
        return try_design(_make_plain(G), loop, design, step)
    require_one_signal("redesign without design=", loop)
    if crossover is None or phase_margin is None:
        raise CtrlidError("redesign needs the crossover and the phase margin of a lead, or design= "
                          "with a function from the model to a controller")  # fmt: skip
    # The design needs a plain transfer function with the delay of the fit in it.
    G = G.with_delay() if isinstance(G, IdentifiedModel) else to_transfer_function(G)
    C = design_lead(G, crossover=crossover, phase_margin=phase_margin)
    dt = timebase(G)
    # What limits the input is the actuator, which stays when a PID that knew it goes.
    trial = replace(loop, controller=C, dt=dt or loop.dt, input_limits=find_input_limits(loop))
    P = loop.linearize()
    if dt and not timebase(P):
        P = sample_held(P, dt)
    # The response is long enough for the slowest promised pole, at the sampling period of the loop.
    length = _choose_length(ct.poles(ct.feedback(G * C, 1)), dt, crossover, trial.dt)
    time: Array = np.arange(length, dtype=float) * trial.dt
    promised_step = _simulate_linear_step(ct.feedback(G * C, 1), time)
    chosen = _choose_height(
        loop, step, lambda: np.max(np.abs(_simulate_linear_step(ct.feedback(C, G), time)))
    )
    promised = _measure_performance(loop_margins(G * C), time, promised_step)
    margins = loop_margins(P * C)
    growth = compute_growth_rate(trial)
    stable = growth < 0 and margins.stable
    name = loop.signals["y"][0]
    height, made = try_heights(
        chosen, loop.known_units.get(name, ""), stable,
        lambda value: _simulate_physical_step(trial, value, promised_step),
    )  # fmt: skip
    failure = made.failure
    if not stable:
        achieved = Performance(False, *(float("nan"),) * 7)
        if not made.tells_growth:
            # Dry friction holds what is at rest; the loop around it may be unstable all the same.
            why = (f"Small deviations grow at {growth:.3g} 1/s." if growth >= 0 else
                   "Without friction the loop is unstable.")  # fmt: skip
            failure = why if failure is None else f"{why} {failure}"
    else:
        achieved = _measure_performance(
            margins, time, made.response if failure is None else np.empty(0)
        )
        achieved = replace(achieved, stable=failure is None)
    # The model has gain 1 at the crossover, so that volts per metre do not matter.
    omega = np.exp(1j * crossover * dt) if dt else 1j * crossover
    unit = float(np.abs(G(omega)))
    return Redesign(C, promised, achieved, nu_gap(G / unit, P / unit),
                    robust_margin(G / unit, C * unit), trial, time, promised_step, made.response,
                    height.value, "" if failure is None else failure, height.reason,
                    _measure_sampled(loop, C, P))  # fmt: skip


def _measure_sampled(loop: Loop, C: Any, P: Any) -> float | None:
    """Return the phase margin of an analog lead that runs as a program of the loop [deg].

    NaN where the program does not stabilize the linearized physics; None where no program is asked
    for, because the lead is one already or the controller of the loop is a circuit.
    """
    if timebase(C) or loop.controller is None or loop.analog:
        return None
    program = ct.sample_system(C, loop.dt, "tustin")
    margins = loop_margins(sample_held(P, loop.dt) * program)
    return margins.phase_margin if margins.stable else math.nan


def _make_plain(G: Any) -> Any:
    """Return a model with its delay; one of several signals by states, as designs take it."""
    if isinstance(G, IdentifiedModel):
        return G.with_delay()
    if isinstance(G, IdentifiedSystem):
        return G.to_states()
    if isinstance(G, ct.TransferFunction) and not G.issiso():
        raise CtrlidError(
            "redesign needs a model of several signals in states, a StateSpace: a "
            "transfer function counts a pole for each entry that shows it"
        )
    return G


def _choose_height(loop: Loop, step: Any, find_peak: Callable[[], Any]) -> StepHeight:
    """Return the height of the step, and why it is that where it was not given."""
    if step is None:
        return choose_height(loop, loop.signals["y"][0], find_peak)
    if not is_number(step) or not np.isfinite(float(step)) or step == 0:
        raise CtrlidError("step must be the height of the reference step in output units, a "
                          f"finite number other than zero; given {step!r}")  # fmt: skip
    return StepHeight(float(step))


def _simulate_linear_step(closed: Any, time: Array) -> Array:
    return np.asarray(ct.forced_response(closed, time, np.ones(len(time))).outputs, float)


@dataclass(frozen=True, eq=False)
class _Response:
    """The response to a step less that to no step, per unit of reference.

    With why it broke off, None if it did not, and whether that says how fast deviations grow.
    """

    response: Array
    failure: str | None = None
    tells_growth: bool = False


def _simulate_physical_step(loop: Loop, height: float, promised: Array) -> _Response:
    """Return what a step of some height comes to on the physics."""
    rest: Array = np.full(len(promised), loop.point.output)
    try:
        still = simulate(loop, rest)
    except SimulationStopped as reason:
        return _Response(np.empty(0), write_sentence(reason), reason.unstable)
    except ModelCannotRun as reason:
        return _Response(np.empty(0), write_sentence(reason))
    try:
        moved = simulate(loop, rest + height)
    except SimulationStopped as reason:
        response = (reason.y - still.y[: len(reason.y)]) / height
        return _Response(response, write_sentence(reason), reason.unstable)
    response = np.asarray((moved.y - still.y) / height, dtype=float)
    far = np.abs(response) > LOST * np.max(np.abs(promised))
    if not far.any():
        return _Response(response)
    k = int(np.argmax(far))
    text = f"After {k * loop.dt:.4g} s {moved.names['y']} has diverged to {moved.y[k]:.4g}"
    lower, upper = loop.input_limits
    if np.any(moved.u[: k + 1] <= lower) or np.any(moved.u[: k + 1] >= upper):
        text += f", with {moved.names['u']} at its limit ({lower:g} to {upper:g})"
    return _Response(response[: k + 1], text + ".")


def _measure_performance(margins: Any, time: Array, response: Array) -> Performance:
    overshoot = settling = final = float("nan")
    if margins.stable and response.size:
        final = float(np.mean(response[-max(len(response) // 20, 1) :]))
        if final:
            overshoot = max(0.0, 100 * (float(np.max(response / final)) - 1))
            outside = np.flatnonzero(np.abs(response / final - 1) > SETTLED)
            last = int(outside[-1]) + 1 if outside.size else 0
            settling = float(time[last]) if last < len(time) else float("inf")
    return Performance(margins.stable, margins.phase_margin, margins.gain_margin,
                       margins.gain_reduction_margin, margins.crossover, overshoot, settling,
                       final)  # fmt: skip


def _choose_length(poles: Any, sampled: float, crossover: float, dt: float) -> int:
    """Return how many samples a step response lasts: until the slowest pole has settled."""
    with np.errstate(divide="ignore"):
        rates = -(np.log(poles.astype(complex)) / sampled if sampled else poles).real
    # A pole a thousand times as slow as the crossover is not waited for.
    slowest = float(np.min(rates[rates > SLOWEST * crossover], initial=math.inf))
    return int(np.clip(max(WAVES / crossover, LASTING / slowest) / dt, 20, LONGEST))
