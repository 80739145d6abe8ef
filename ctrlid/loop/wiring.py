"""How the signals of a controller are wired to those of a plant, by their names."""

import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi
import control as ct
import numpy as np

from .._base.arrays import Array
from .._base.errors import CtrlidError, CtrlidWarning
from .._base.text import write_count, write_list
from ..data.record import Record
from ..physics.conversions import require_finite_coefficients, to_state_matrices
from ..physics.equations import Equations
from ..physics.linearization import OperatingPoint
from ..physics.trace import timebase, trace
from .controllers import PID, ControlLaw, require_proper

# The search for the state at rest takes so many implicit steps, each longer than the one before.
STEPS = 120
# A step is so many times as long as the one before it.
GROWTH = 1.3
STATE_FEEDBACK = (
    "State feedback reads states that are outputs of the plant, under their names, "
    "ct.ss([], [], [], -K, dt, inputs=[...]), or an observer's, "
    "ct.create_statefbk_iosystem(P, K, estimator=...)"
)
# A residual below this share of the largest signal is rounding.
AT_REST = 1e-9


@dataclass(frozen=True)
class Wiring:
    """Which signal every input of a controller reads, and which output drives which plant input.

    Parameters
    ----------
    inputs : tuple of (str, int)
        For each input of the controller ``("y", i)`` or ``("u", i)``, an output or input of the
        plant, or ``("r", i)``, the i-th open input.
    outputs : tuple of int
        For each input of the plant the output of the controller that drives it.
    open : tuple of str
        The inputs that are no signal of the plant: references, or held.
    held : tuple of float or None
        At which value each of them is held where the record has no reference of this name; None:
        it needs one.
    lines : tuple of str
        The wiring in words.
    """

    inputs: tuple[tuple[str, int], ...]
    outputs: tuple[int, ...]
    open: tuple[str, ...]
    held: tuple[float | None, ...]
    lines: tuple[str, ...]

    @property
    def reads_input(self) -> bool:
        """Whether the controller reads an input of the plant, as an observer does."""
        return any(kind == "u" for kind, _ in self.inputs)


def is_wired_by_name(controller: Any, plant: Equations) -> bool:
    """Return whether a controller is one of several signals, and not C(r - y) or C(r, y).

    Parameters
    ----------
    controller : object
        The controller of a loop, not None.
    plant : Equations
        The plant.

    Returns
    -------
    bool
        For a plant with one input and one output, true of a controller with more than two inputs,
        and of one whose two inputs are the plant's output and input.
    """
    if isinstance(controller, PID) or not isinstance(
        controller, ct.TransferFunction | ct.NonlinearIOSystem
    ):
        return not plant.siso
    if not plant.siso:
        return True
    names = set(controller.input_labels)
    known = {*plant.inputs, *plant.outputs}
    both = controller.ninputs == 2 and names in (known, {"y[0]", "u[0]"})
    return bool(controller.noutputs == 1 and (controller.ninputs > 2 or both))


def make_wiring(controller: Any, plant: Equations, at: OperatingPoint) -> Wiring:
    """Return how a controller is wired to a plant.

    Parameters
    ----------
    controller : control.TransferFunction, control.StateSpace or control.NonlinearIOSystem
        The controller.
    plant : Equations
        The plant, with the inputs that it is driven by.
    at : OperatingPoint
        The operating point, at whose states and inputs ``xd`` and ``ud`` are held.

    Returns
    -------
    Wiring
        The wiring.

    Raises
    ------
    CtrlidError
        If the controller has no output for an input of the plant, or reads none of its outputs.
    """
    if isinstance(controller, PID) or not isinstance(
        controller, ct.TransferFunction | ct.NonlinearIOSystem
    ):
        raise CtrlidError(
            f"the plant {plant.name} has inputs {list(plant.inputs)} and outputs "
            f"{list(plant.outputs)}; its controller is a TransferFunction, a StateSpace or a "
            f"python-control system of several signals; given {type(controller).__name__}. Several "
            "PIDs are put together with ct.append or ct.interconnect"
        )
    names = list(controller.input_labels)
    nameless = names == [f"u[{k}]" for k in range(len(names))]
    if nameless:
        _refuse_state_feedback(controller, plant)
        inputs, open_names = _wire_by_position(len(names), plant)
    else:
        inputs, open_names = _wire_by_name(names, plant)
    held = tuple(_find_held_value(name, at) for name in open_names)
    lines = [
        f"{name} <- {_name_source(kind, k, plant, open_names, held)}"
        for name, (kind, k) in zip(names, inputs, strict=True)
    ]
    if not any(kind in ("y", "e") for kind, _ in inputs):
        raise CtrlidError(
            f"the controller reads {names}, and none of these is an output of the plant "
            f"({', '.join(plant.outputs)}): give its inputs these names, or y[0], y[1], ..., or "
            f"leave the names u[0], u[1], ... for {write_count(len(plant.outputs), 'input')} r - y"
        )
    if nameless and len(names) != len(plant.outputs):
        lines.append("(inputs without names read the references and then the outputs)")
    outputs = list(controller.output_labels)
    if set(plant.inputs) <= set(outputs):
        drives = [outputs.index(name) for name in plant.inputs]
    elif len(outputs) == len(plant.inputs):
        drives = list(range(len(outputs)))
    else:
        raise CtrlidError(
            f"the controller has outputs {outputs}, the plant inputs {list(plant.inputs)}: give it "
            "one output for each input of the plant, of the same name or in the same order"
        )
    lines += [f"{name} <- {outputs[k]} of the controller"
              for name, k in zip(plant.inputs, drives, strict=True)]  # fmt: skip
    return Wiring(tuple(inputs), tuple(drives), tuple(open_names), held, tuple(lines))


def _refuse_state_feedback(controller: Any, plant: Equations) -> None:
    """Refuse a gain of the plant's states that would be wired to references and outputs."""
    count, p = controller.ninputs, len(plant.outputs)
    linear = isinstance(controller, ct.TransferFunction | ct.StateSpace)
    if not linear or controller_states(controller) or count != len(plant.states) or count == p:
        return
    gain = to_state_matrices(controller)[3]
    # What weighs references and outputs alike is no feedback of states.
    if count != 2 * p or not np.array_equal(gain[:, :p], -gain[:, p:]):
        raise CtrlidError(
            f"the controller is a gain with {write_count(count, 'input')} without names, and "
            f"{plant.name} has "
            f"{write_count(count, 'state')} ({', '.join(plant.states)}) but "
            f"{write_count(p, 'output')} "
            f"({', '.join(plant.outputs)}). {STATE_FEEDBACK}. If it reads "
            f"{'references and then outputs' if count == 2 * p else 'anything else'}, name its "
            "inputs likewise"
        )


def _wire_by_position(
    count: int, plant: Equations
) -> tuple[list[tuple[str, int]], list[str]]:  # fmt: skip
    """Return the wiring of a controller without names: r - y, or r and then y."""
    p = len(plant.outputs)
    if count not in (p, 2 * p):
        raise CtrlidError(
            f"the controller has {write_count(count, 'input')} without names, the plant "
            f"{write_count(p, 'output')} "
            f"({', '.join(plant.outputs)}): give it {p} for r - y, or {2 * p} for r and then y, or "
            "name its inputs after the plant's signals"
        )
    references = list(plant.outputs)
    if count == p:
        return [("e", k) for k in range(p)], references
    return [("r", k) for k in range(p)] + [("y", k) for k in range(p)], references


def _wire_by_name(
    names: Sequence[str], plant: Equations
) -> tuple[list[tuple[str, int]], list[str]]:  # fmt: skip
    """Return the wiring of a controller whose inputs have names."""
    found: list[tuple[str, int]] = []
    open_names: list[str] = []
    own = {**{name: ("u", k) for k, name in enumerate(plant.inputs)},
           **{name: ("y", k) for k, name in enumerate(plant.outputs)}}  # fmt: skip
    numbered = {
        f"{kind}[{k}]": (kind, k)
        for kind, signals in (("y", plant.outputs), ("u", plant.inputs))
        for k in range(len(signals))
    }
    for name in names:
        if name in own or name in numbered:
            found.append(own.get(name) or numbered[name])
        else:
            found.append(("r", len(open_names)))
            open_names.append(name)
    return found, open_names


def _find_held_value(name: str, at: OperatingPoint) -> float | None:
    """Return the value at the operating point of xd[i], a state, or ud[i], an input."""
    match = re.fullmatch(r"(x|u)d\[(\d+)\]", name)
    if match is None:
        return None
    values = at.states if match[1] == "x" else at.inputs
    return values[int(match[2])] if int(match[2]) < len(values) else None


def _name_source(
    kind: str, k: int, plant: Equations, open_names: Sequence[str], held: Sequence[float | None]
) -> str:
    if kind == "e":
        return f"reference {open_names[k]} - {plant.outputs[k]}"
    if kind == "r":
        value = held[k]
        rest = "" if value is None else f", else held at {value:g}"
        # It was meant to be measured, where a state has its name.
        doubt = " (NOT THE STATE, which is no output)" if open_names[k] in plant.states else ""
        return f"reference {open_names[k]}{rest}{doubt}"
    return (plant.outputs if kind == "y" else plant.inputs)[k]


def suggest_transpose(name: str, given: Any) -> str:
    """Say that an array looks transposed, if it has more rows, of signals, than samples.

    Examples
    --------
    >>> suggest_transpose("r", np.zeros((100, 2)))
    '. It looks transposed, with a row for each sample: give r.T'
    >>> suggest_transpose("r", np.zeros((2, 100)))
    ''
    """
    shape = np.shape(given)
    if len(shape) != 2 or shape[0] <= shape[1]:
        return ""
    return f". It looks transposed, with a row for each sample: give {name}.T"


def stack_references(
    wiring: Wiring, given: Any, names: Sequence[str] | None, n: int | None = None
) -> tuple[Array, tuple[str, ...]]:
    """Return the series of all open inputs of a controller, and the names of those given.

    Parameters
    ----------
    wiring : Wiring
        The wiring.
    given : None, mapping of str to array_like, or array_like of shape (n,) or (references, n)
        The references. Without names they are those that cannot be held, or else all, in order.
    names : sequence of str or None
        Names of the rows.
    n : int, optional
        Number of samples, where no reference tells it.

    Returns
    -------
    series : ndarray, shape (open, n)
        One row for each open input.
    names : tuple of str
        Of those that were given.

    Raises
    ------
    CtrlidError
        If a reference is missing, has another name, or is of another length.
    """
    strict = isinstance(given, Mapping)
    needed = [name for name, v in zip(wiring.open, wiring.held, strict=True) if v is None]
    if isinstance(given, Mapping):
        names, given = list(given), list(given.values())
    rows = [] if given is None else list(np.atleast_2d(np.asarray(given, dtype=float)))
    if names is None or not set(names) <= set(wiring.open):
        unknown = [] if names is None else [name for name in names if name not in wiring.open]
        if names is not None and not strict and len(rows) == len(names) > 1:
            order = _find_reference_order(wiring, len(rows))
            if order:
                _refuse_some_names("r", names, order)
        # A record's own names may be others; then its references are taken in order.
        choices = [c for c in (needed, list(wiring.open)) if len(c) == len(rows) and not strict]
        if not choices and rows:
            shape = np.shape(given)
            turned = suggest_transpose("r", given)
            what = (f"given {write_list(unknown)}, which the controller does not have" if unknown
                    else f"given {len(rows)}, an array of shape {shape}{turned}")  # fmt: skip
            known = write_list(list(wiring.open))
            every = f"the reference {known}" if len(wiring.open) == 1 else f"the references {known}"
            which = "" if needed == list(wiring.open) else (
                f", of which it needs {write_list(needed) or 'none'}")  # fmt: skip
            raise CtrlidError(
                f"the controller has {every}{which}; {what}. Give one series for each, or a "
                f"mapping such as {{{wiring.open[0]!r}: r}}"
            )
        names = choices[0] if choices else []
    missing = [name for name in needed if name not in names]
    if missing:
        raise CtrlidError(
            f"the controller reads {write_list(missing)}, which is no input and no output of the "
            f"plant, and no reference of this name is given (given: {', '.join(names) or 'none'}). "
            f"Give r= with a series for each of {', '.join(needed)}, or rename this input of the "
            "controller. A state of the plant is read only where it is an output"
        )
    if not rows and n is None:
        raise CtrlidError("simulate needs r or d to know how many samples to run")
    n = len(rows[0]) if rows else n
    table = dict(zip(names, rows, strict=True))
    series = [
        table.get(name, np.full(n or 0, value))
        for name, value in zip(wiring.open, wiring.held, strict=True)
    ]
    return np.array(series).reshape(len(series), n or 0), tuple(names)


def knows_references(wiring: Wiring | None, record: Record) -> bool:
    """Return whether the references of a controller are known, from a record or since held."""
    return record.r is not None or (wiring is not None and None not in wiring.held)


def match_signals(record: Record, plant: Equations, wiring: Wiring | None = None) -> Record:
    """Return a record with the inputs and outputs of a plant, in its order and under its names.

    Signals of the plant's names are found by these, in whatever order. Where none has the name of
    one, they are taken in order, and a warning says so of several that have names.

    Parameters
    ----------
    record : Record
        The data.
    plant : Equations
        The plant.
    wiring : Wiring, optional
        The wiring of a controller, whose references are matched likewise.

    Returns
    -------
    Record
        With the names of the plant's signals; those of a plant with one input and one output
        keep theirs.

    Raises
    ------
    CtrlidError
        If the record has another number of signals, or the names of some of them only.
    """
    chosen: dict[str, Any] = {}
    placed: dict[str, tuple[str, ...]] = {}
    for key, names in (("u", plant.inputs), ("y", plant.outputs)):
        known = record.signals[key]
        if set(names) <= set(known):
            chosen[key] = names
        elif len(known) == len(names):
            placed[key] = names
        else:
            raise CtrlidError(
                f"{plant.name} has {'inputs' if key == 'u' else 'outputs'} ({', '.join(names)}), "
                f"but {key} of the record is ({', '.join(known)}): give it these, pick them with "
                f"record.select({key}=...), or name the inputs that it has with Loop(driven=...)"
            )
    record = record.select(**chosen) if chosen else record
    if plant.siso:
        return record
    # A single reference needs no name, so that it keeps its own.
    given = record.signals.get("r", ())
    if wiring is not None and len(given) > 1 and not set(given) <= set(wiring.open):
        order = _find_reference_order(wiring, len(given))
        placed |= {"r": tuple(order)} if order else {}
    for key, names in placed.items():
        _refuse_some_names(key, record.signals[key], names)
        if len(names) > 1 and key in record.names:
            _warn_of_order(key, record.names[key], names)
    # One name stands for one signal, as in every record.
    called = {key: names[0] if len(names) == 1 else names for key, names in placed.items()}
    return replace(record, names={**record.names, **called})


def _find_reference_order(wiring: Wiring, count: int) -> list[str]:
    """Return which references so many series without their names are; empty if no such number."""
    needed = [name for name, v in zip(wiring.open, wiring.held, strict=True) if v is None]
    return next((c for c in (needed, list(wiring.open)) if len(c) == count), [])


def _suggest_names(key: str, given: Sequence[str], wanted: Sequence[str]) -> str:
    """Say how the signals of a record get the names of those of the loop."""
    pairs = {a: b for a, b in zip(given, wanted, strict=True) if a != b}
    return (f"Record.from_csv(..., names={pairs}) where a file has these columns, or "
            f"dataclasses.replace(record, names={{**record.names, {key!r}: "
            f"{tuple(wanted)}}})")  # fmt: skip


def _refuse_some_names(key: str, given: Sequence[str], wanted: Sequence[str]) -> None:
    """Refuse signals of which some have the names of the loop and others have not."""
    common = [name for name in wanted if name in given]
    if not common:
        return
    other = [name for name in given if name not in wanted]
    rest = [name for name in wanted if name not in given]
    # The others may stand in any order; the suggestion is no more than one.
    order = iter(rest)
    likely = [name if name in wanted else next(order) for name in given]
    raise CtrlidError(
        f"{key} of the record is ({', '.join(given)}), and the loop has ({', '.join(wanted)}): "
        f"{write_list(common)} {'is' if len(common) == 1 else 'are'} found by name, but which of "
        f"the others is {write_list(rest)}? Name {write_list(other)} so, as in "
        f"{_suggest_names(key, given, likely)}"
    )


def _warn_of_order(key: str, given: Sequence[str], wanted: Sequence[str]) -> None:
    """Warn of several signals that are taken in order, since no name of theirs is one of a loop."""
    warnings.warn(
        f"{key} of the record is ({', '.join(given)}), and none of these is a name in the loop: "
        f"they are taken in order as ({', '.join(wanted)}). If that is their order, name them so, "
        f"with {_suggest_names(key, given, wanted)}; if not, give each its own of these names",
        CtrlidWarning, stacklevel=4,
    )  # fmt: skip


def make_wired_law(controller: Any, wiring: Wiring, at: OperatingPoint, dt: float) -> ControlLaw:
    """Return the law of a controller of several signals, in absolute physical units.

    Wired by position to r - y a controller adds the input of the operating point, as one of a
    single signal does; one that is linear and reads r and then y acts on their deviations. Wired by
    name it computes the whole input.

    Parameters
    ----------
    controller : control.TransferFunction, control.StateSpace or control.NonlinearIOSystem
        The controller.
    wiring : Wiring
        Its wiring.
    at : OperatingPoint
        Operating point of the loop.
    dt : float
        Sampling period of the loop [s].

    Returns
    -------
    ControlLaw
        The law; its r has a row for each open input.

    Raises
    ------
    CtrlidError
        If the controller has another sampling period than the loop, is improper, or computes its
        output from the very input that it drives.
    """
    require_finite_coefficients(controller, "the controller")
    sampled = timebase(controller) if controller.dt is not True else dt
    if sampled and abs(sampled - dt) > 1e-9 * dt:
        raise CtrlidError(f"the controller runs at {sampled:g} s, the loop at {dt:g} s; "
                          "convert it to the period of the loop")  # fmt: skip
    rates, outputs = _make_function(controller)
    linear = isinstance(controller, ct.TransferFunction | ct.StateSpace)
    errors = all(kind == "e" for kind, _ in wiring.inputs)
    nameless = list(controller.input_labels) == [f"u[{k}]" for k in range(controller.ninputs)]
    deviations = nameless and (errors or linear)
    y0, u0 = casadi.DM(at.outputs), casadi.DM(at.inputs)

    def read(r: Any, y: Any, u: Any) -> Any:
        values = []
        for kind, k in wiring.inputs:
            if kind == "e":
                values.append(r[k] - y[k])
            elif deviations:
                values.append((r if kind == "r" else y)[k] - y0[k])
            else:
                values.append({"r": r, "y": y, "u": u}[kind][k])
        return casadi.vertcat(*values)

    u = casadi.SX.sym("u", len(at.inputs))
    sizes = controller_states(controller), len(wiring.open), len(at.outputs)
    t, (x, r, y) = casadi.SX.sym("t"), (casadi.SX.sym("v", size) for size in sizes)
    every = outputs(t, x, read(r, y, u))
    wish = casadi.vertcat(*(every[k] for k in wiring.outputs))
    if wiring.reads_input and casadi.depends_on(wish, u):
        raise CtrlidError(
            "the controller computes the plant's input from that very input (an algebraic loop): "
            "let it read the input through a delay or a state, as an observer does"
        )
    wish = wish + u0 if deviations else wish
    moved = rates(t, x, read(r, y, u))
    law = casadi.Function("law", [t, x, r, y, u], [wish, moved])

    def apply(t: Any, x: Any, r: Any, y: Any, u: Any = None) -> tuple[Any, Any]:
        if u is None:
            u = law(t, x, r, y, u0)[0] if wiring.reads_input else u0
        wish, moved = law(t, x, r, y, u)
        return wish, moved

    held = [_default_reference(v, k, at, wiring) for k, v in enumerate(wiring.held)]
    rest = _find_rest(law, np.array(held), at, bool(sampled), controller, dt)
    return ControlLaw(dt if sampled else 0.0, tuple(rest.tolist()), apply, tuple(held),
                      wiring.reads_input)  # fmt: skip


def _default_reference(value: float | None, k: int, at: OperatingPoint, wiring: Wiring) -> float:
    """Return the value of an open input at rest: that of the output which it is a reference for.

    By position, or the one that the controller reads at the same place among its outputs.
    """
    if value is not None:
        return value
    read = list(dict.fromkeys(i for kind, i in wiring.inputs if kind == "y"))
    if not any(kind == "e" for kind, _ in wiring.inputs) and len(read) == len(wiring.open):
        return at.outputs[read[k]]
    by_position = any(kind == "e" for kind, _ in wiring.inputs) or len(wiring.open) == len(
        at.outputs
    )
    return at.outputs[k] if by_position else 0.0


def controller_states(controller: Any) -> int:
    """Return the number of states of a controller as its equations have them."""
    if isinstance(controller, ct.TransferFunction):
        return len(to_state_matrices(controller)[0])
    return int(controller.nstates or 0)


def _make_function(controller: Any) -> tuple[Any, Any]:
    """Return rate (or next state) and output of a controller as functions of t, x and inputs."""
    if isinstance(controller, ct.TransferFunction | ct.StateSpace):
        if isinstance(controller, ct.TransferFunction):
            require_proper(controller)
        a, b, c, d = (casadi.sparsify(casadi.DM(np.atleast_2d(m)))
                      for m in to_state_matrices(controller))  # fmt: skip
        n = a.shape[0] if a.numel() else 0
        if not n:
            return lambda t, x, w: casadi.SX(0, 1), lambda t, x, w: casadi.mtimes(d, w)
        return (
            lambda t, x, w: casadi.mtimes(a, x) + casadi.mtimes(b, w),
            lambda t, x, w: casadi.mtimes(c, x) + casadi.mtimes(d, w),
        )
    e = trace(controller)
    return (
        lambda t, x, w: e.function(t, x, w, e.values)[0],
        lambda t, x, w: e.function(t, x, w, e.values)[1],
    )


def _find_rest(
    law: Any, r: Array, at: OperatingPoint, sampled: bool, controller: Any, dt: float
) -> Array:  # fmt: skip
    r"""Return the state of a controller while all signals stay at the operating point.

    Implicit steps :math:`(I/h - J) \Delta x = f` with growing h follow the controller into the rest
    that it reaches by itself, whatever else solves its equations; what its output then lacks, as
    that of an integrator does, is added along the states that stay where they are.
    """
    n = controller_states(controller)
    x = np.zeros(n)
    if not n:
        return x
    _t, s = casadi.SX.sym("t"), casadi.SX.sym("x", n)
    wish, moved = law(0.0, s, casadi.DM(r), casadi.DM(at.outputs), casadi.DM(at.inputs))
    rate = moved - s if sampled else moved
    f = casadi.Function("rest", [s], [rate, casadi.jacobian(rate, s), wish,
                                      casadi.jacobian(wish, s)])  # fmt: skip
    # From a period on, within which no controller moves far.
    h = 1.0 if sampled else dt
    for _ in range(STEPS):
        rate_now, slope, _, _ = (np.asarray(v, float) for v in f(x))
        if not (np.isfinite(rate_now).all() and np.isfinite(slope).all()):
            return np.zeros(n)
        x = x + np.linalg.lstsq(np.eye(n) / h - slope, rate_now.ravel(), rcond=None)[0]
        h = GROWTH * h
    target = np.array(at.inputs)
    rate_now, slope, output, gain = (np.asarray(v, float) for v in f(x))
    both = np.vstack([slope, gain])
    left = np.concatenate([rate_now.ravel(), output.ravel() - target])
    better = x - np.linalg.lstsq(both, left, rcond=1e-10)[0]
    ends = [np.concatenate([np.asarray(a, float).ravel(), np.asarray(b, float).ravel() - target])
            for a, b in (f(v)[::2] for v in (x, better))]  # fmt: skip
    size = 1.0 + float(np.max(np.abs(target), initial=0.0))
    if np.max(np.abs(ends[1])) < AT_REST * size:
        found = better
    else:
        # One that moves on for ever, as an integrator whose reference is elsewhere, has no rest.
        found = x if np.max(np.abs(ends[0][:n])) < AT_REST * size else np.zeros(n)
    return np.where(np.abs(found) < 1e-14, 0.0, found)
