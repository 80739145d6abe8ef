"""The exact equations of a python-control system, traced into CasADi and checked."""

import copy
import linecache
import traceback
from collections.abc import Mapping
from typing import Any

import casadi
import control as ct
import numpy as np
from control.nlsys import InterconnectedSystem

from .._base.arrays import Array
from .._base.errors import CtrlidError
from .._base.text import write_count
from . import canonical
from .conversions import to_state_matrices
from .equations import Equations
from .symbols import Symbol, Symbols, TracingError, lift
from .tracing import rebind

# Traced equations are compared with the Python function at so many random points.
CHECKS = 40
# A smaller relative difference is rounding; the two are the same formula.
AGREEMENT = 1e-9


def timebase(system: Any) -> float:
    """Return the sampling period of a python-control system, 0.0 for continuous time."""
    return 0.0 if system.dt is None or system.dt == 0 else float(system.dt)


def _make_symbol_array(symbols: Any) -> Symbols:
    box = np.empty(symbols.shape[0], dtype=object)
    for k in range(box.size):
        box[k] = Symbol(symbols[k])
    return box.view(Symbols)


def _stack_expressions(result: Any, rows: int, what: str) -> Any:
    """Turn what a traced function returned into a CasADi column of known height."""
    flat = np.asarray(result, dtype=object).reshape(-1)
    if flat.size != rows:
        raise TracingError(
            f"{what} returned {write_count(flat.size, 'value')}, but {rows} are declared"
        )
    wide = next((k for k, v in enumerate(flat) if isinstance(v, np.ndarray)), None)
    if wide is not None:
        raise TracingError(
            f"value {wide + 1} of {rows} that {what} returned is an array, where a number is "
            "needed: u and x are arrays even if they have one element; write u[0] in place of u, "
            "or x[0] in place of x"
        )
    return casadi.SX(casadi.vertcat(*(lift(v) for v in flat)))


def _trace_system(system: Any, t: Any, x: Any, u: Any, p: Mapping[str, Any]) -> tuple[Any, Any]:
    """Trace one system: its (rhs, output) as CasADi columns for symbolic t, x, u."""
    known = getattr(system, "equations", None)
    # A plant with its effects, from Loop.system(), brings its equations along.
    if isinstance(known, Equations):
        values = [lift(p[name]) for name in known.parameters]
        function = casadi.Function("known", [known.t, known.x, known.u, known.p],
                                   [known.rhs, known.output])  # fmt: skip
        rhs, out = function(t, x, u, casadi.vertcat(*values) if values else casadi.SX(0, 1))
        return rhs, out
    # A linear interconnection is a StateSpace as well.
    if isinstance(system, ct.StateSpace):
        a, b, c, d = (casadi.sparsify(casadi.DM(m)) for m in
                      (system.A, system.B, system.C, system.D))  # fmt: skip
        return (
            casadi.mtimes(casadi.SX(a), x) + casadi.mtimes(casadi.SX(b), u),
            casadi.mtimes(casadi.SX(c), x) + casadi.mtimes(casadi.SX(d), u),
        )
    if isinstance(system, InterconnectedSystem):
        rhs, out = _trace_interconnected(system, t, x, u, p)
        return rhs, out
    arguments = (Symbol(t), _make_symbol_array(x), _make_symbol_array(u), dict(p))
    rhs = casadi.SX(0, 1)
    if system.nstates:
        rhs = _stack_expressions(
            rebind(system.updfcn)(*arguments), system.nstates, "the update function"
        )
    if system.outfcn is None:
        return rhs, x
    out = rebind(system.outfcn)(Symbol(t), _make_symbol_array(x), _make_symbol_array(u), dict(p))
    return rhs, _stack_expressions(out, system.noutputs, "the output function")


def _trace_interconnected(system: Any, t: Any, x: Any, u: Any, p: Mapping[str, Any]) -> Any:
    parts, offsets = system.syslist, np.cumsum([0] + [s.nstates or 0 for s in system.syslist])
    ins = np.cumsum([0] + [s.ninputs for s in parts])
    # A symbol for every internal input; outputs that depend on them are substituted until none
    # is left, which takes at most as many rounds as there are subsystems.
    wires = casadi.SX.sym("wire", int(ins[-1]))
    rhs, outs = [], []
    for k, part in enumerate(parts):
        local = {**part.params, **system.params, **p}
        fk, hk = _trace_system(part, t, x[int(offsets[k]):int(offsets[k + 1])],
                      wires[int(ins[k]):int(ins[k + 1])], local)  # fmt: skip
        rhs.append(fk)
        outs.append(hk)
    connect, external, to_output = (
        casadi.SX(casadi.sparsify(casadi.DM(np.asarray(m, float))))
        for m in (system.connect_map, system.input_map, system.output_map)
    )
    every = casadi.vertcat(*outs)
    wiring = casadi.mtimes(connect, every) + casadi.mtimes(external, u)
    solved = wiring
    for _ in parts:
        if not any(casadi.which_depends(solved, wires, 1, True)):
            break
        solved = casadi.substitute(solved, wires, wiring)
    else:
        if any(casadi.which_depends(solved, wires, 1, True)):
            raise TracingError(
                "the interconnection has an algebraic loop (outputs that depend on themselves "
                "without delay); break it with a lag or a delay, or solve it by hand"
            )
    result = casadi.vertcat(casadi.vertcat(*rhs), casadi.mtimes(to_output, casadi.vertcat(
        every, wires)))  # fmt: skip
    result = casadi.substitute(result, wires, solved)
    n = int(offsets[-1])
    return result[:n], result[n:]


def trace(system: Any) -> Equations:
    """Return the exact equations of a python-control system, or refuse.

    The update and output functions are called once with symbols in place of numbers and the
    resulting formulas are compared with the Python functions at random points. Scalar parameters
    become symbols where the functions allow it.

    Parameters
    ----------
    system : control.NonlinearIOSystem, control.StateSpace or control.TransferFunction
        The plant. Interconnected systems are traced part by part. The coefficients of a transfer
        function become parameters, a1, ... of the monic denominator and b1, ... of the numerator.

    Returns
    -------
    Equations
        The traced equations.

    Raises
    ------
    CtrlidError
        If the system is of another kind, if a function cannot be traced (the message names the
        line and the cure), or if the formulas disagree with the function.
    """
    if isinstance(system, Equations):
        return system
    if isinstance(system, ct.TransferFunction) and system.issiso() and _is_proper(system):
        return _trace_transfer_function(system)
    if isinstance(system, ct.TransferFunction):
        system = ct.ss(*to_state_matrices(system), system.dt, name=system.name,
                       inputs=system.input_labels, outputs=system.output_labels)  # fmt: skip
    if not isinstance(system, ct.NonlinearIOSystem):
        raise CtrlidError(
            f"a plant is a control.NonlinearIOSystem (ct.nlsys), a StateSpace or a "
            f"TransferFunction; given {type(system).__name__}"
        )
    if system.ninputs is None or system.noutputs is None or system.nstates is None:
        raise CtrlidError(f"the plant {system.name} does not declare its inputs, outputs and "
                          "states; give inputs=, outputs= and states= to ct.nlsys")  # fmt: skip
    scalars = {
        key: float(value)
        for key, value in system.params.items()
        if isinstance(value, int | float | np.number) and not isinstance(value, bool)
    }
    fractional = {k: v for k, v in scalars.items() if not isinstance(system.params[k], int)}
    # An integer may be a count or an exponent and a parameter may decide an `if`: then the
    # equations are traced for its present value.
    error: TracingError | None = None
    for symbolic in (scalars, fractional, {}):
        try:
            return _check_equations(system, _trace_functions(system, symbolic))
        except TracingError as reason:
            error = error or reason
    assert error is not None
    raise error


def _is_proper(system: Any) -> bool:
    names = canonical.list_coefficients(system)
    return len(names) <= 2 * canonical.count_poles(list(names)) + 1


def _trace_transfer_function(system: Any) -> Equations:
    values = canonical.list_coefficients(system)
    n, dt = canonical.count_poles(list(values)), timebase(system)
    t, x, u, p = (
        casadi.SX.sym("t"),
        _make_vector("x", n),
        _make_vector("u", 1),
        _make_vector("p", len(values)),
    )
    named = {name: p[k] for k, name in enumerate(values)}
    rates, output = canonical.make_state_equations(named, [x[k] for k in range(n)], u, dt == 0)
    return Equations(
        system.name, tuple(f"x[{k}]" for k in range(n)), tuple(system.input_labels),
        tuple(system.output_labels), values, dt, t, x, u, p,
        casadi.SX(casadi.vertcat(*rates)) if n else casadi.SX(0, 1), casadi.SX(output),
    )  # fmt: skip


def _trace_functions(system: Any, symbolic: Mapping[str, float]) -> Equations:
    t = casadi.SX.sym("t")
    x = _make_vector("x", system.nstates)
    u = _make_vector("u", system.ninputs)
    p = _make_vector("p", len(symbolic))
    params = {**system.params, **{key: Symbol(p[k]) for k, key in enumerate(symbolic)}}
    try:
        rhs, output = _trace_system(system, t, x, u, params)
    except Exception as reason:
        raise TracingError(_explain_failure(system, reason)) from reason
    return Equations(
        system.name, tuple(system.state_labels), tuple(system.input_labels),
        tuple(system.output_labels), dict(symbolic), timebase(system), t, x, u, p, rhs, output,
    )  # fmt: skip


def _make_vector(name: str, size: int) -> Any:
    return casadi.vertcat(*(casadi.SX.sym(f"{name}{k}") for k in range(size))) if size else (
        casadi.SX(0, 1)
    )  # fmt: skip


def _explain_failure(system: Any, reason: Exception) -> str:
    here = __file__.rpartition("/")[0]
    user = [f for f in traceback.extract_tb(reason.__traceback__)
            if not f.filename.startswith(here) and "site-packages" not in f.filename]  # fmt: skip
    where = ""
    if user:
        line = linecache.getline(user[-1].filename, user[-1].lineno or 0).strip()
        where = f" at line {user[-1].lineno} of {user[-1].filename}" + (f": {line}" if line else "")
    cure = str(reason)
    if isinstance(reason, KeyError) and str(reason).strip("'") not in system.params:
        cure = (
            f"it asks for the parameter {reason}, which the system does not have: give "
            f"params={{{reason}: value}} to ct.nlsys (it has {list(system.params)})"
        )
    elif isinstance(reason, TypeError) and not user:
        # No line of the user's functions ran: it is their arguments.
        cure = (f"{type(reason).__name__}: {reason}. The functions of ct.nlsys take (t, x, u, "
                "params), the parameters even where there are none")  # fmt: skip
    elif not isinstance(reason, CtrlidError):
        cure = (f"{type(reason).__name__}: {reason}. Write the equations with arithmetic and numpy "
                "functions of the states, np.where for cases and np.interp for tables")  # fmt: skip
    return f"the equations of {system.name} cannot be traced{where}: {cure}"


def _check_equations(system: Any, equations: Equations) -> Equations:
    """Compare the traced equations with the Python functions at random points."""
    rng = np.random.default_rng(20090317)
    n, m = len(equations.states), len(equations.inputs)
    found, failure = 0, ""
    for trial in range(12 * CHECKS):
        if found >= CHECKS or (found and trial >= 6 * CHECKS):
            break
        # From micrometres to kilometres, both signs and positive only: a plant is rarely defined
        # everywhere, and a wrong branch rarely shows at one scale.
        # Some have no value but at large numbers, such as temperatures in K and pressures in Pa.
        size = 10.0 ** rng.uniform(-4, 3 if trial < 6 * CHECKS else 8, n + m + 1)
        z = rng.standard_normal(n + m + 1) * size
        z = np.abs(z) if trial % 2 else z
        x, u, t = z[:n], z[n : n + m], abs(z[-1])
        values = equations.values * rng.uniform(0.8, 1.25, len(equations.parameters))
        params = dict(zip(equations.parameters, values.tolist(), strict=True))
        expected = _evaluate_functions(system, t, x, u, params)
        if isinstance(expected, str):
            failure = f" (it says: {expected})"
            continue
        traced = np.concatenate(equations.evaluate(x, u, t, values))
        good = np.isfinite(expected)
        found += bool(good.all())
        scale = AGREEMENT * (np.abs(expected[good]) + _estimate_size(expected[good]))
        wrong = np.isfinite(traced) != good
        wrong[good] |= ~(np.abs(traced[good] - expected[good]) <= scale)
        if wrong.any():
            row = int(np.argmax(wrong))
            label = (f"the rate of {equations.states[row]}" if row < n
                     else f"the output {equations.outputs[row - n]}")  # fmt: skip
            raise TracingError(
                f"the traced equations of {system.name} do not reproduce its Python function: "
                f"{label} is {expected[row]:.6g} but traces as {traced[row]:.6g} at t={t:.4g}, "
                f"x={np.array2string(x, precision=4)}, u={np.array2string(u, precision=4)}. The "
                "function must depend on t, x, u and params only (no memory, no random numbers) "
                "and compute with numpy or math functions of them"
            )
    if not found:
        raise TracingError(
            f"the Python function of {system.name} gave no finite value at {6 * CHECKS} random "
            f"points, nor at as many with larger numbers{failure}, so the traced equations cannot "
            "be checked; make sure that its parameters are finite, and that it has a value for "
            "states of some size between 1e-4 and 1e8, for instance by np.maximum(..., 0) below a "
            "root"
        )
    return equations


def _estimate_size(values: Array) -> float:
    return float(np.max(np.abs(values), initial=0.0)) * 1e-3


def _evaluate_functions(system: Any, t: float, x: Array, u: Array, params: Any) -> Array | str:
    try:
        with np.errstate(all="ignore"):
            given = () if isinstance(system, ct.StateSpace) else (params,)
            rhs = system.dynamics(t, x, u, *given) if system.nstates else np.empty(0)
            out = system.output(t, x, u, *given)
        values = np.concatenate([np.ravel(rhs), np.ravel(out)])
    except (ArithmeticError, ValueError) as reason:
        # Functions such as math.sqrt refuse values outside their domain.
        return str(reason)
    if np.iscomplexobj(values):
        return "the values are complex"
    return np.asarray(values, dtype=float)


def with_parameters(system: Any, values: Mapping[str, float]) -> Any:
    """Return a copy of a system with other parameter values; the original stays as it is.

    Parameters
    ----------
    system : control.NonlinearIOSystem or control.TransferFunction
        The system.
    values : mapping of str to float
        New values; the parameters that are not named keep theirs.

    Returns
    -------
    control.NonlinearIOSystem or control.TransferFunction
        A shallow copy, or the transfer function with the new coefficients.
    """
    if isinstance(system, ct.TransferFunction):
        return canonical.replace_coefficients(system, values)
    changed = copy.copy(system)
    changed.params = {**system.params, **values}
    return changed
