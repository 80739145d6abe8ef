"""fit_arx(): the paper's estimator, least squares on a difference equation under constraints."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence, Sized
from dataclasses import replace

import numpy as np
from scipy.signal import lfilter

from ..._base import text as _text
from ..._base.arguments import check_arguments, explain_names
from ..._base.arrays import Array
from ..._base.errors import CtrlidError
from ..._base.jobs import check_jobs
from ..._base.rounding import keep_numpy_quiet
from ..._base.signals import is_several
from ...data.record import Record
from ...data.several_records import VISIBLE_MOTION, measure_input_motion, stream_records
from ...data.validity import find_whole_past
from ..constraints import AbstractConstraint, check_constraints, divide_constraints
from ..constraints.constrained_minimum import Found, minimize
from ..constraints.quadratic_program import Cost, NotExcited
from ..identified_model import Estimate, IdentifiedModel, IdentifiedSystem, Structure
from ..whiteness import ENOUGH, LEVEL, are_rounding, note_coloured_innovations
from .instruments import compute_independence_probability
from .regression import (
    Regression,
    build_arx_regression,
    count_equations,
    from_differences,
    list_structures,
)

# Longer records, in samples for each coefficient, have equations enough, but for gaps everywhere.
COUNTED = 100
# So many samples of an iterator are kept, by which its errors are tested.
KEPT = 20_000


@explain_names
@keep_numpy_quiet
def fit_arx(
    record: Record | Iterable[Record],
    na: int | Sequence[int],
    nb: int | Sequence[int],
    nk: int | Sequence[int] = 1,
    constraints: AbstractConstraint | Sequence[AbstractConstraint] = (),
    intercept: bool = True,
    jobs: int | None = None,
) -> IdentifiedModel | IdentifiedSystem:
    """Fit a difference equation by least squares under constraints, equations (5) and (7) of [1]_.

    ``y(k) + a1 y(k-1) + ... + a_na y(k-na) = b1 u(k-nk) + ... + b_nb u(k-nk-nb+1) + c + e(k)``

    minimises the sum of squares of e, subject to whatever is known about the coefficients. Exact
    without noise. With noise it is unbiased only if e is white; sensor noise, above all in closed
    loop and at short sampling periods, biases it, and a constraint alone does not cure that.

    Of a record of several signals each output is fitted by itself, with a numerator for each input:
    ``A_i y_i = B_i1 u_1 + B_i2 u_2 + ... + c_i + e_i``. The coefficients are then called ``b1[F1]``
    after the input, and a constraint may speak of one output, ``ReciprocalPoles(output="alpha")``.

    Parameters
    ----------
    record : Record or iterable of Record
        Data; of several records each has its own intercept, since set-points differ. Rows that
        touch a sample marked not valid are left out. An iterator, such as a generator that cuts a
        memory-mapped log into records, is read once and in constant memory, and whether its errors
        are noise is asked of its first 20 000 samples.
    na : int or sequence of int
        Number of poles; of several outputs, one for all or one for each.
    nb : int or sequence of int
        Number of numerator coefficients, for each input.
    nk : int or sequence of int
        Samples from u to y: 1 where ``u[k]`` is applied after ``y[k]`` is measured. Where one input
        is later than another, `Fixed` holds its first coefficients at zero.
    constraints : AbstractConstraint or sequence of them
        What is known: `ReciprocalPoles`, `PoleAt`, `Integrator`, `StaticGain`, `Fixed`, `Bounds`,
        `Equal`, `Linear`, `Nonlinear`, ...
    intercept : bool
        Estimate the constant c. Signals are absolute and the operating point is never known
        exactly, so leave it on unless the signals are deviations from a true equilibrium.
    jobs : int, optional
        Jobs among which the records are shared, through joblib; by default one, or what
        ``joblib.parallel_config`` says. The answer does not depend on it.

    Returns
    -------
    IdentifiedModel or IdentifiedSystem
        A `control.TransferFunction` with ``.estimate``; of several signals, one of them with
        ``.estimates`` by output.

    Raises
    ------
    CtrlidError
        If orders or constraints are unusable or contradict each other, if there are too few
        samples, or if the data do not excite what is to be estimated.

    References
    ----------
    .. [1] "Identification of a class of unstable processes", section IV.

    Examples
    --------
    An unstable plant with poles 1.25 and 0.8 under feedback:

    >>> import numpy as np
    >>> import ctrlid as cid
    >>> r = np.random.default_rng(1).choice([-1.0, 1.0], 200)
    >>> y, u = np.zeros(200), np.zeros(200)
    >>> for k in range(200):
    ...     if k > 1:
    ...         y[k] = 2.05 * y[k-1] - y[k-2] + 0.1 * u[k-1] + 0.1 * u[k-2]
    ...     u[k] = 12.0 * (r[k] - y[k]) - 8.0 * (r[k-1] - y[k-1])
    >>> record = cid.Record(r=r, u=u, y=y, dt=0.01)
    >>> G = cid.fit_arx(record, na=2, nb=2, constraints=[cid.ReciprocalPoles()])
    >>> G.estimate["a2"]
    1.0
    >>> G.estimate.poles.real.round(6)
    array([1.25, 0.8 ])
    """
    check_arguments(fit_arx, locals(), "record", "na", "nb", "nk", "constraints", "jobs")
    known = check_constraints(constraints)
    first, records = stream_records(record)
    structures = list_structures(na, nb, nk, first)
    rows = divide_constraints(known, structures, first.signals["u"])
    if not is_several(first):
        (structure,) = structures.values()
        # An iterator of records is read once: the first samples tell whether its errors are noise.
        begun: list[Record] = []
        if isinstance(record, Iterator):
            records = _keep_first(records, begun)
        estimate = _fit_row(records, first, structure, known, intercept, jobs)
        notes = _note_errors(begun or list(records), estimate)
        estimate = replace(estimate, notes=(*notes, *estimate.notes))
        names = first.names
        return IdentifiedModel(estimate, inputs=names.get("u", "u"), outputs=names.get("y", "y"))
    if isinstance(record, Iterator):
        raise CtrlidError("fit_arx reads records of several signals once for each output: give a "
                          "list of records instead of an iterator")  # fmt: skip
    estimates = {}
    for output, structure in structures.items():
        parts = [one.select(y=output) for one in records]
        estimate = _fit_row(parts, parts[0], structure, rows[output], intercept, jobs)
        notes = (*_note_errors(parts, estimate), *estimate.notes)
        estimates[output] = replace(estimate, notes=notes)
    return IdentifiedSystem(estimates, first.signals["u"])


def _require_equations(records: Iterable[Record], structure: Structure, intercept: bool) -> None:
    """Refuse records with fewer equations than unknowns, before the regression is formed."""
    each = [count_equations(record, structure) for record in records]
    unknowns = len(structure.names) + len(each) * intercept
    # A record that gives none is refused by its number.
    if min(each) > 0 and sum(each) <= unknowns:
        raise CtrlidError(_lack_equations(sum(each), unknowns, structure))


def _lack_equations(rows: int, unknowns: int, structure: Structure) -> str:
    """Say that there are too few equations."""
    return (
        f"Too few samples: {_text.write_count(rows, 'equation')} for "
        f"{_text.write_count(unknowns, 'unknown')}. An equation needs "
        f"{_text.write_count(structure.span, 'valid sample')} in succession. Record longer or "
        "lower the orders."
    )


def _fit_row(
    records: Iterable[Record], first: Record, structure: Structure,
    known: Sequence[AbstractConstraint], intercept: bool, jobs: int | None,
) -> Estimate:  # fmt: skip
    """Fit one output."""
    if isinstance(records, Sized) and sum(map(len, records)) < COUNTED * len(structure.names):
        # A large regression takes long, and is in vain where it has too few rows.
        _require_equations(records, structure, intercept)
    motions: list[float] = []
    watched = records if first.hold == "zoh" else _note_motion(records, motions)
    regression = build_arx_regression(watched, structure, intercept, check_jobs(jobs))
    unknowns = len(structure.names) + len(regression.intercept_rows)
    if regression.rows <= unknowns:
        raise CtrlidError(_lack_equations(regression.rows, unknowns, structure))
    try:
        found = minimize(make_arx_cost(regression), known, structure)
    except NotExcited as trouble:
        message = _explain_no_excitation(regression, trouble.direction)
        raise CtrlidError(message) from None
    estimate = _make_estimate(regression, found, constrained=bool(known), dt=first.dt)
    share = max(motions, default=0.0)
    if share > VISIBLE_MOTION:
        instead = " with the controller" if first.hold == "foh" else ""
        note = (
            f"u CHANGES BETWEEN THE SAMPLES (hold={first.hold!r}, by {100 * share:.0f} % of its "
            "standard deviation in a period), but a difference equation takes it as held, so the "
            f"poles are biased. Sample faster, or use fit_continuous{instead}."
        )
        estimate = replace(estimate, notes=(*estimate.notes, note))
    return estimate


def _keep_first(records: Iterable[Record], begun: list[Record]) -> Iterator[Record]:
    """Pass records on, and keep the first of them, as far as a test of their errors needs."""
    left = KEPT
    for record in records:
        if left > 0:
            begun.append(record[:left])
            left -= len(record)
        yield record


def _note_motion(records: Iterable[Record], motions: list[float]) -> Iterator[Record]:
    """Pass records on, and note of each how far its input moves between samples."""
    for record in records:
        motions.append(measure_input_motion([record], reconstructed=False))
        yield record


def _note_errors(records: Sequence[Record], estimate: Estimate) -> tuple[str, ...]:
    """Return a note if the equation errors are not white, or depend on the past reference.

    Those of the first samples tell.
    """
    structure = estimate.structure
    fractions = [structure.fraction(estimate.values, k) for k in range(len(structure.numerators))]
    den = fractions[0][1]
    # Both are in falling powers of z, so that a shorter numerator begins later.
    nums = [np.concatenate([np.zeros(len(den) - len(num)), num]) for num, _ in fractions]
    order, left = len(den) - 1, ENOUGH
    stretches, driven, size = list[Array](), list[tuple[Array, Array]](), 0.0
    for record in records:
        part = record[:left]
        error = lfilter(den, [1.0], part.y)
        for num, u in zip(nums, np.atleast_2d(part.u), strict=True):
            error = error - lfilter(num, [1.0], u)
        error[~find_whole_past(part.valid, order)] = np.nan
        stretches.append(error)
        if part.r is not None:
            driven += [(error[i:j], np.atleast_2d(part.r)[:, i:j]) for i, j in part.segments()]
        size = max(size, float(np.max(np.abs(part.y[part.valid]), initial=0.0)))
        left -= len(part)
        if left <= 0:
            break
    coloured = note_coloured_innovations(stretches, estimate.structure.na, _BIASED, size)
    if coloured or not driven or are_rounding(stretches, size):
        return coloured
    p = compute_independence_probability(*zip(*driven, strict=True))
    if p >= LEVEL:
        return ()
    return (
        f"THE ERRORS DEPEND ON THE PAST REFERENCE ({_text.write_p_value(p)}), of which those of a "
        "right model hold nothing: the noise is that of the sensor and not of the equation, or the "
        f"orders are too low. {_BIASED}",
    )


_BIASED = (
    "In closed loop the coefficients are then biased and their standard errors too small: use "
    "fit_iv, fit_continuous or fit_loop."
)


def make_arx_cost(regression: Regression) -> Cost:
    """Return the regression as a quadratic cost; columns that are only rounding errors are zero."""
    size = np.linalg.norm(regression.R, axis=0)
    excited = size > 10 * regression.floor
    noise = regression.floor[excited] / size[excited]
    basis, origin = from_differences(regression.structure)
    floor = max(1e-11, 10 * float(np.linalg.norm(noise)))
    return Cost(np.where(excited, regression.R, 0.0), regression.d, basis, origin, floor)


def _make_estimate(regression: Regression, found: Found, constrained: bool, dt: float) -> Estimate:
    constants = len(regression.intercept_rows)
    degrees = regression.rows - found.free - constants
    rss = regression.rss + found.cost
    return Estimate(
        structure=regression.structure,
        values=found.theta,
        covariance=found.spread * rss / degrees,
        intercepts=regression.intercepts(found.theta),
        rss=rss,
        residual_variance=rss / degrees,
        n_samples=regression.rows,
        degrees_of_freedom=degrees,
        active_bounds=found.active_bounds,
        branch=found.branch,
        method=("constrained " if constrained else "") + "least squares (ARX)",
        errors="equation error",
        solver=found.solver,
        dt=dt,
        condition=found.condition,
    )


def _explain_no_excitation(regression: Regression, direction: Array) -> str:
    """Say which signal is constant, or which coefficients the data cannot tell apart."""
    structure: Structure = regression.structure
    na = structure.na
    size = np.linalg.norm(regression.R, axis=0)
    still = size <= 10 * regression.floor
    head = "The data do not determine the coefficients: "
    inputs = structure.inputs or ("u",)
    starts = [part.start for part in structure.numerators]
    for signal, column in (*zip(inputs, starts, strict=True), ("y", 0)):
        if still[column]:
            return (
                f"{head}{signal} is constant in all valid samples. Excite the loop: vary the "
                "reference (random_binary) or add a signal to u."
            )
    # Weighted by the size of the signals: what the coefficients do to a prediction.
    effect = np.abs(direction) * np.concatenate(
        [np.full(na, size[0]), *(np.full(structure.nb, size[start]) for start in starts)]
    )
    involved = [n for n, e in zip(structure.names, effect, strict=True) if e > 1e-3 * effect.max()]
    weights = direction / np.abs(direction).max()
    moves = ", ".join(f"{n} by {weights[structure.names.index(n)]:.3g}" for n in involved)
    return (
        f"{head}{_text.write_list(involved)} can change together ({moves}) without a change of any "
        "prediction. Either only the controller changes u (vary the reference, or add a signal to "
        "u), or the orders are higher than those of the plant (lower na or nb), or a constraint is "
        "missing."
    )
