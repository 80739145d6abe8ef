"""Controllers as real loops have them, and their laws as equations.

`PID` is the sampled controller of practice; transfer functions, state-space systems and
python-control functions are taken as they are. `make_control_law` turns any of them into one form:
a state, a rule for its next value (or its rate) and the input it applies, in absolute physical
units.
"""

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, get_args

import casadi
import control as ct
import numpy as np

from .._base.arguments import explain_fields, is_number
from .._base.arrays import Array
from .._base.errors import CtrlidError
from .._base.periods import have_same_period, write_both_periods
from .._base.text import write_count
from ..physics.conversions import require_finite_coefficients, to_state_matrices
from ..physics.linearization import OperatingPoint
from ..physics.trace import timebase, trace

Integral = Literal["backward", "forward", "trapezoidal"]
Derivative = Literal["error", "measurement"]
AntiWindup = Literal["clamp", "back-calculation", "none"]


@explain_fields
@dataclass(frozen=True)
class PID:
    r"""A sampled PID controller with limits, as microcontrollers run it.

    .. math:: u = \mathrm{sat}\bigl(\mathrm{bias} + k_p (b r - y) + I + D\bigr), \quad
        I_k = I_{k-1} + k_i T e_k, \quad
        D_k = \frac{T_f D_{k-1} + k_d (c\,\Delta r_k - \Delta y_k)}{T_f + T}

    The gains multiply error, integral and derivative separately (parallel form) and T is the
    sampling period of the loop that it is put into.

    Parameters
    ----------
    kp : float
        Proportional gain [input unit per output unit].
    ki : float, optional
        Integral gain [input unit per output unit and second].
    kd : float, optional
        Derivative gain [input unit second per output unit].
    bias : float, optional
        Constant added to the output [input unit]; by default the input of the loop's operating
        point.
    lower, upper : float, optional
        Limits of the output [input unit].
    b, c : float, optional
        Weights of the reference in the proportional and in the derivative part.
    derivative : {"error", "measurement"}, optional
        What is differentiated; ``"measurement"`` is the same as ``c=0``.
    filter_time : float, optional
        Time constant T_f of the derivative's low-pass filter [s].
    integral : {"backward", "forward", "trapezoidal"}, optional
        Whether the integral includes the present error, excludes it, or takes half of it.
    anti_windup : {"clamp", "back-calculation", "none"}, optional
        At a limit, ``"clamp"`` stops integrating errors that push further beyond it,
        ``"back-calculation"`` pulls the integral back with `tracking_time`, ``"none"`` lets it
        grow.
    tracking_time : float, optional
        Time constant of back-calculation [s]; by default ``kp/ki``.

    Raises
    ------
    CtrlidError
        If a value is not a finite number, the limits are not in order or a word is unknown.

    References
    ----------
    Åström and Murray, *Feedback Systems*, chapter 11.

    Examples
    --------
    >>> import ctrlid as cid
    >>> cid.PID(kp=-37.81, ki=-188, kd=-1.92, bias=0.583, lower=0, upper=1).upper
    1
    """

    kp: float
    ki: float = 0.0
    kd: float = 0.0
    bias: float | None = None
    lower: float = -math.inf
    upper: float = math.inf
    b: float = 1.0
    c: float = 1.0
    derivative: Derivative = "error"
    filter_time: float = 0.0
    integral: Integral = "backward"
    anti_windup: AntiWindup = "clamp"
    tracking_time: float | None = None

    def __post_init__(self) -> None:
        for name in ("kp", "ki", "kd", "b", "c", "filter_time", "bias", "tracking_time"):
            value = getattr(self, name)
            if value is None and name in ("bias", "tracking_time"):
                continue
            if not is_number(value) or not np.isfinite(float(value)):
                raise CtrlidError(f"PID needs a finite number as {name}; given {value!r}")
        limits = (self.lower, self.upper)
        if not all(is_number(limit) for limit in limits) or not self.lower < self.upper:
            raise CtrlidError(
                f"PID needs lower < upper; given lower={self.lower}, upper={self.upper}"
            )
        if self.filter_time < 0:
            raise CtrlidError(f"filter_time is a time constant >= 0 s; given {self.filter_time}")
        for name, words in (("derivative", Derivative), ("integral", Integral),
                            ("anti_windup", AntiWindup)):  # fmt: skip
            given = getattr(self, name)
            if not isinstance(given, str) or given not in get_args(words):
                raise CtrlidError(f"PID {name} must be one of {', '.join(get_args(words))}; "
                                  f"given {getattr(self, name)!r}")  # fmt: skip
        if self.derivative == "measurement" and self.c not in (0.0, 1.0):
            raise CtrlidError(f"derivative='measurement' sets c=0; leave c={self.c} out")
        if self.anti_windup == "back-calculation":
            tracking = self.tracking_time
            if tracking is None and self.ki:
                tracking = self.kp / self.ki
            if self.ki and (tracking is None or tracking <= 0):
                raise CtrlidError("back-calculation needs tracking_time > 0 s; given "
                                  f"tracking_time={self.tracking_time} with kp={self.kp}, "
                                  f"ki={self.ki}")  # fmt: skip


@dataclass(frozen=True, eq=False)
class ControlLaw:
    """A controller as equations: ``apply(t, x, r, y) -> (u, next state or rate)``.

    `dt` is 0.0 for an analog controller, whose second result is the rate of its state. `rest` is
    the state at which it waits while r and y stay at the operating point; there r is `references`,
    one value for each reference, None for the single one of a loop with one output. A controller
    that `reads_input` is told the applied input as fifth argument.
    """

    dt: float
    rest: tuple[float, ...]
    apply: Callable[..., tuple[Any, Any]]
    references: tuple[float, ...] | None = None
    reads_input: bool = False


def make_control_law(
    controller: Any, at: OperatingPoint, dt: float, output: str = "y"
) -> ControlLaw:
    """Return the law of a controller in absolute physical units.

    A linear controller of one input acts as ``u = at.input + C(r - y)``, one of two inputs as
    ``u = at.input + C(r - at.output, y - at.output)``; a `PID` or a nonlinear controller of two
    inputs computes the whole input itself.

    Parameters
    ----------
    controller : control.TransferFunction, control.StateSpace, control.NonlinearIOSystem or PID
        The controller.
    at : OperatingPoint
        Operating point of the loop.
    dt : float
        Sampling period of the loop [s].
    output : str, optional
        What the plant calls its output.

    Returns
    -------
    ControlLaw
        The law.

    Raises
    ------
    CtrlidError
        If the controller has another number of inputs or outputs, another sampling period than the
        loop, or is improper; if the names of its inputs do not say which of them is y.
    """
    if isinstance(controller, PID):
        return _make_pid_law(controller, at, dt)
    if is_number(controller):
        controller = ct.tf([float(controller)], [1.0])
    if not isinstance(controller, ct.TransferFunction | ct.NonlinearIOSystem):
        raise CtrlidError(
            "a controller is a TransferFunction, a StateSpace, a python-control system with inputs "
            f"(r, y), a PID, or None; given {type(controller).__name__}"
        )
    require_finite_coefficients(controller, "the controller")
    if controller.noutputs != 1 or controller.ninputs not in (1, 2):
        raise CtrlidError(
            f"a controller has one output u and one input (r - y) or two inputs (r, y); given "
            f"{write_count(controller.ninputs, 'input')} and "
            f"{write_count(controller.noutputs, 'output')}"
        )
    sampled = timebase(controller) if controller.dt is not True else dt
    if sampled and not have_same_period(sampled, dt):
        both = write_both_periods("the controller runs", sampled, "the loop", dt)
        raise CtrlidError(f"{both}; convert it to the period of the loop")
    order = find_input_order(controller, output)
    if isinstance(controller, ct.TransferFunction | ct.StateSpace):
        if isinstance(controller, ct.TransferFunction):
            require_proper(controller)
        a, b, c, d = to_state_matrices(controller)
        b, d = (m[:, order] if controller.ninputs == 2 else m for m in (b, d))
        return _make_linear_law(a, b, c, d, at, dt if sampled else 0.0)
    return _make_traced_law(controller, at, dt if sampled else 0.0, order)


def find_input_order(controller: Any, *outputs: str) -> tuple[int, int]:
    """Return where (r, y) are among a controller's inputs, as the names of these say.

    Without names the reference comes first.

    Parameters
    ----------
    controller : control.InputOutputSystem
        A controller with one or two inputs.
    *outputs : str
        What the output of the plant is called, besides y.

    Returns
    -------
    (int, int)
        Places of r and y.

    Raises
    ------
    CtrlidError
        If the names do not say which of two inputs is y.
    """
    names, output = list(controller.input_labels), (*outputs, "y")[0]
    measured = [name in (*outputs, "y", "y[0]") for name in names]
    if len(names) == 1:
        if measured[0] and names[0] != "e":
            raise CtrlidError(
                f"the controller's only input is called {names[0]}, as an output is, but a "
                "controller with one input acts on r - y. Call it e if it does; a law u = C(y) has "
                f"two inputs, r and {output}, and does nothing with r"
            )
        return 0, 1
    if names == ["u[0]", "u[1]"]:
        return 0, 1
    # An error or a rate is neither: such a law is one of several signals.
    if sum(measured) != 1 or "e" in names:
        raise CtrlidError(
            f"the controller's inputs are called {names[0]} and {names[1]}, which does not say "
            f"which of them is the plant's output {output} and which the reference: call them r "
            f"and {output}, in any order"
        )
    return (1, 0) if measured[0] else (0, 1)


def require_proper(controller: Any) -> None:
    """Refuse a transfer function with more zeros than poles."""
    for nums, dens in zip(controller.num, controller.den, strict=True):
        for num, den in zip(nums, dens, strict=True):
            if len(num) > len(den):
                raise CtrlidError(
                    f"the controller has {write_count(len(num) - 1, 'zero')} but "
                    f"{write_count(len(den) - 1, 'pole')}: no circuit "
                    "and no program differentiates without delay; add a filter pole"
                )


def _make_linear_law(a: Any, b: Any, c: Any, d: Any, at: OperatingPoint, dt: float) -> ControlLaw:
    a, b, c, d = (casadi.sparsify(casadi.DM(np.atleast_2d(m))) for m in (a, b, c, d))

    def apply(t: Any, x: Any, r: Any, y: Any) -> tuple[Any, Any]:
        del t
        pair = casadi.vertcat(r - at.output, y - at.output)
        e = r - y if d.shape[1] == 1 else pair
        if not a.shape[0]:
            return at.input + casadi.mtimes(d, e), casadi.SX(0, 1)
        u = at.input + casadi.mtimes(c, x) + casadi.mtimes(d, e)
        return u, casadi.mtimes(a, x) + casadi.mtimes(b, e)

    return ControlLaw(dt, (0.0,) * a.shape[0], apply)


def _make_traced_law(
    controller: Any, at: OperatingPoint, dt: float, order: tuple[int, int]
) -> ControlLaw:
    equations = trace(controller)
    one_input = len(equations.inputs) == 1

    def apply(t: Any, x: Any, r: Any, y: Any) -> tuple[Any, Any]:
        w = r - y if one_input else casadi.vertcat(*((r, y)[k] for k in order))
        rhs, u = equations.function(t, x, w, equations.values)
        return (at.input + u if one_input else u), rhs

    return ControlLaw(dt, (0.0,) * len(equations.states), apply)


def _make_pid_law(pid: PID, at: OperatingPoint, dt: float) -> ControlLaw:
    bias = at.input if pid.bias is None else pid.bias
    c = 0.0 if pid.derivative == "measurement" else pid.c

    def apply(t: Any, x: Any, r: Any, y: Any) -> tuple[Any, Any]:
        del t
        integral, last_error, last_difference, slope = casadi.vertsplit(x)
        error, difference = r - y, c * r - y
        now = {"backward": dt * error, "forward": 0.0,
               "trapezoidal": 0.5 * dt * (error + last_error)}[pid.integral]  # fmt: skip
        later = dt * error if pid.integral == "forward" else 0.0
        slope = pid.filter_time * slope + pid.kd * (difference - last_difference)
        slope = slope / (pid.filter_time + dt)
        rest = bias + pid.kp * (pid.b * r - y) + slope
        wish = rest + integral + pid.ki * now
        u = casadi.fmin(casadi.fmax(wish, pid.lower), pid.upper)
        step = pid.ki * (now + later)
        if pid.anti_windup == "clamp":
            outward = casadi.logic_or(
                casadi.logic_and(wish > pid.upper, step > 0),
                casadi.logic_and(wish < pid.lower, step < 0),
            )
            step = casadi.if_else(outward, 0.0, step)
        elif pid.anti_windup == "back-calculation":
            tracking = pid.tracking_time or (pid.kp / pid.ki if pid.ki else math.inf)
            step = step + dt / tracking * (u - wish)
        return u, casadi.vertcat(integral + step, error, difference, slope)

    return ControlLaw(dt, (0.0, 0.0, (c - 1.0) * at.output, 0.0), apply)


@functools.lru_cache(maxsize=64)
def linearize_law(law: ControlLaw, at: OperatingPoint) -> tuple[Array, ...]:
    """Return the state matrices of a controller at rest; the last ones are kept.

    Parameters
    ----------
    law : ControlLaw
        The controller.
    at : OperatingPoint
        Operating point of its loop.

    Returns
    -------
    tuple of ndarray
        A, B from y, B from u, C and D from y.
    """
    nc, p, m = len(law.rest), len(at.outputs), len(at.inputs)
    r = casadi.SX(casadi.DM(at.outputs if law.references is None else law.references))
    x, y, u = casadi.SX.sym("x", nc), casadi.SX.sym("y", p), casadi.SX.sym("u", m)
    given = (0.0, x, r, y, *((u,) if law.reads_input else ()))
    wish, moved = (casadi.vertcat(v) for v in law.apply(*given))
    parts = [
        casadi.jacobian(f, v) for f, v in ((moved, x), (moved, y), (moved, u), (wish, x), (wish, y))
    ]
    found = casadi.Function("law", [x, y, u], parts)(list(law.rest), at.outputs, at.inputs)
    sizes = ((nc, nc), (nc, p), (nc, m), (m, nc), (m, p))
    return tuple(
        np.asarray(part, dtype=float).reshape(size) for part, size in zip(found, sizes, strict=True)
    )


def connect_law(
    a: Array, b: Array, c: Array, law: ControlLaw, at: OperatingPoint
) -> tuple[Array, Array, Array]:
    r"""Return the state matrices of a plant with its controller, opened at the plant's inputs.

    .. math:: \dot z = A z + B u, \quad u = K z

    with the states z of the plant and then of the controller. Closed, the loop is
    :math:`A + B K`. An observer in the controller reads the input that the controller asks for.

    Parameters
    ----------
    a, b, c : ndarray
        State matrices of the plant, in the time base of the controller and without feedthrough.
    law : ControlLaw
        The controller.
    at : OperatingPoint
        Operating point of the loop.

    Returns
    -------
    tuple of ndarray
        A, B and K.
    """
    ac, by, bu, cc, dy = linearize_law(law, at)
    n, nc = len(a), len(ac)
    # The observer's reading of u is what the controller computes: u = cc x_c + dy y.
    both = np.block([[a, np.zeros((n, nc))], [(by + bu @ dy) @ c, ac + bu @ cc]])
    return both, np.vstack([b, np.zeros((nc, b.shape[1]))]), np.hstack([dy @ c, cc])
