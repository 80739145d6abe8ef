"""fit_iv(): instrumental variables, consistent in closed loop whatever the colour of the noise."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import stats

from ..._base import text as _text
from ..._base.arguments import check_arguments, explain_names
from ..._base.arrays import Array
from ..._base.criterion import bayesian_penalty
from ..._base.errors import CtrlidError, CtrlidWarning
from ..._base.rounding import keep_numpy_quiet
from ..._base.signals import is_several
from ..._base.statistics import sum_with_correlations
from ...data.record import Record
from ...data.several_records import as_records
from ..constraints import AbstractConstraint, check_constraints, divide_constraints
from ..constraints.constrained_minimum import Found, minimize
from ..constraints.quadratic_program import NotExcited
from ..identified_model import Estimate, IdentifiedModel, IdentifiedSystem, Structure
from ..whiteness import note_coloured_innovations
from .controller_model import (
    LinearController,
    convert_controller,
    identify_controller,
    simulate_noise_free_loop,
)
from .instruments import Signals, check_instruments
from .iv_equations import (
    Moments,
    Residuals,
    Task,
    compute_curved_force,
    compute_moments,
    separate_nuisances,
    tabulate_errors,
)
from .prefilter import (
    View,
    autoregression,
    find_slowest,
    fit_moving_average,
    measure_units,
    reflect_poles,
)
from .regression import list_structures, to_differences
from .restricted_likelihood import compute_restricted_cost, restrict_likelihood

# At most so many iterations are made for one noise model.
_MOST = 40
# Products of signals are estimated up to this degree, as a smooth plant near its equilibrium needs.
_DEGREE = 3
# So many iterations take full steps; later ones take half steps, since full ones may oscillate.
_PATIENCE = 8
# Distances from z = 1 of the poles of the first prefilters, from the widest band down, and of the
# zeros from which a moving average is sought.
_STARTS = 0.5 ** np.arange(1, 10)


@explain_names
@keep_numpy_quiet
def fit_iv(
    record: Record | Sequence[Record],
    na: int | Sequence[int],
    nb: int | Sequence[int],
    nk: int | Sequence[int] = 1,
    constraints: AbstractConstraint | Sequence[AbstractConstraint] = (),
    controller: Any = None,
    intercept: bool = True,
    instruments: str | Sequence[str] = "r",
) -> IdentifiedModel | IdentifiedSystem:
    r"""Fit a difference equation by refined instrumental variables under constraints.

    ``y(k) + a1 y(k-1) + ... + a_na y(k-na) = b1 u(k-nk) + ... + b_nb u(k-nk-nb+1) + c + A v(k)``

    with v the sensor noise, which the controller feeds back into u. Least squares minimises the
    equation error; here it only has to be uncorrelated with instruments Z, signals that come from
    outside the loop and that v does not reach:

    .. math:: \min_\theta \| (Z^T Z)^{-1/2} Z^T F (y - \Phi \theta) \|^2

    subject to what is known about the coefficients. The answer is right on average whatever the
    colour of the noise. Z and the prefilter F decide how precise it is, and are refined in turn:

    1. First Z is what delayed references explain of y and u.
    2. F whitens the equation error: 1 / C for the moving average C that it is, which is A with the
       poles outside the unit circle reflected into it where no random force acts, times an
       autoregression of the residuals where v is coloured.
    3. Z becomes y and u of the noise-free simulated loop of the last model and the controller. If
       that loop is not stable, or no controller is found, step 1 serves on.
    4. Where the residuals show that the plant is curved, squares and the product of y and u are
       estimated too: they are small, but slow, and would drown the static gain.

    Repeated until the coefficients move by less than a thousandth of their standard errors.

    Of a record of several signals each output is fitted by itself, as `fit_arx` does it. The
    instruments are then what delayed references explain (step 1), since one output does not tell
    the loop; curvature is sought for a single input only.

    Parameters
    ----------
    record : Record or sequence of Record
        Data with a held input; of several records each has its own intercept. Stretches of valid
        samples are used each on their own.
    na : int or sequence of int
        Number of poles; of several outputs, one for all or one for each.
    nb : int or sequence of int
        Number of numerator coefficients, for each input.
    nk : int or sequence of int
        Samples from u to y: 1 where ``u[k]`` is applied after ``y[k]`` is measured.
    constraints : AbstractConstraint or sequence of them
        What is known, as in `fit_arx`.
    controller : control.TransferFunction or control.StateSpace, optional
        The controller in discrete time, of r - y or of (r, y); signals named in `instruments`
        other than r are added to its output. By default it is found in the record by a regression
        of u on r and y. An inexact one costs precision only. With several signals it is refused.
    intercept : bool
        Estimate the constant c; see `fit_arx`.
    instruments : str or sequence of str
        The signals from outside the loop: ``"r"``, or channels of ``record.extra``, for instance a
        dither that was added to u.

    Returns
    -------
    IdentifiedModel or IdentifiedSystem
        A `control.TransferFunction` with ``.estimate``, of several signals with ``.estimates`` by
        output. Its residual variance is that of the
        whitened equation error: without plant noise, that of the one-step prediction. Its
        standard errors hold for coloured noise: where correlations of the residuals contradict
        the noise model, they are computed from those instead, and ``notes`` say so. Correlations
        over many samples are counted in part only (Newey, West): an echo 12 samples later, in 1200
        samples, leaves them a sixth too small.

    Raises
    ------
    CtrlidError
        If there is no signal from outside the loop, if it is too weak, if u is not held between
        samples, if there are too few samples, or for constraints as in `fit_arx`.

    Warns
    -----
    CtrlidWarning
        If the iterations do not settle.

    References
    ----------
    .. [1] Söderström and Stoica, *System Identification*, chapter 8.
    .. [2] Gilson and Van den Hof, "Instrumental variable methods for closed-loop system
       identification", Automatica 41 (2005).
    .. [3] Gilson, Garnier, Young and Van den Hof, "Optimal instrumental variable method for
       closed-loop identification", IET Control Theory and Applications 5 (2011).
    .. [4] Young, *Recursive Estimation and Time-Series Analysis*, 2nd ed., chapters 7 and 9.
    .. [5] Forssell and Ljung, "Identification of unstable systems using output error and
       Box-Jenkins model structures", IEEE Transactions on Automatic Control 45 (2000): the
       reflected poles.

    Examples
    --------
    An unstable plant with poles 1.05 and 1/1.05 under feedback, its sensor noisy:

    >>> import numpy as np
    >>> import ctrlid as cid
    >>> rng = np.random.default_rng(1)
    >>> r, v = np.repeat(rng.choice([-1.0, 1.0], 400), 20), 0.2 * rng.standard_normal(8000)
    >>> x, y, u = np.zeros(8000), np.zeros(8000), np.zeros(8000)
    >>> for k in range(8000):
    ...     if k > 1:
    ...         x[k] = (1.05 + 1/1.05) * x[k-1] - x[k-2] + 0.00125 * (u[k-1] + u[k-2])
    ...     y[k] = x[k] + v[k]
    ...     u[k] = 60.0 * (r[k] - y[k]) - 55.0 * (r[k-1] - y[k-1])
    >>> record = cid.Record(r=r, u=u, y=y, dt=0.01)
    >>> known = [cid.ReciprocalPoles(), cid.Equal("b1", "b2")]
    >>> cid.fit_arx(record, 2, 2, constraints=known).estimate.poles.real.round(2)
    array([1., 1.])
    >>> cid.fit_iv(record, 2, 2, constraints=known).estimate.poles.real.round(2)
    array([1.05, 0.95])
    """
    check_arguments(fit_iv, locals(), "record", "na", "nb", "nk", "constraints", "instruments")
    known = check_constraints(constraints)
    records = as_records(record)
    structures = list_structures(na, nb, nk, records[0])
    rows = divide_constraints(known, structures, records[0].signals["u"])
    _check_hold(records)
    names = check_instruments(records, instruments)
    if not is_several(records[0]):
        (structure,) = structures.values()
        estimate = _fit_row(records, structure, known, names, intercept, controller)
        labels = records[0].names
        return IdentifiedModel(estimate, inputs=labels.get("u", "u"), outputs=labels.get("y", "y"))
    if controller is not None:
        raise CtrlidError("fit_iv does not use controller= with several signals; leave it out")
    estimates = {
        output: _fit_row([one.select(y=output) for one in records], structure, rows[output], names,
                         intercept, None, alone=False)
        for output, structure in structures.items()
    }  # fmt: skip
    return IdentifiedSystem(estimates, records[0].signals["u"])


def _fit_row(
    records: Sequence[Record], structure: Structure, known: Sequence[AbstractConstraint],
    names: tuple[str, ...], intercept: bool, controller: Any, alone: bool = True,
) -> Estimate:  # fmt: skip
    """Fit one output, the only one of the loop if it is alone."""
    task = Task.prepare(records, structure, names, intercept)
    law = None
    if controller is not None:
        law = convert_controller(controller, names, records[0].dt, *records[0].signals["y"][:1])
    elif alone and all(len(piece.w) == len(names) for piece in task.pieces):
        law = identify_controller(task.pieces, names)
    try:
        fit = _refine_noise_model(task, known, law)
    except NotExcited as trouble:
        raise CtrlidError(_explain_no_excitation(structure, names, trouble.direction)) from None
    estimate = _make_estimate(task, fit, constrained=bool(known), dt=records[0].dt)
    _check_strength(estimate, names)
    if not fit.converged:
        warnings.warn(_describe_no_end(fit), CtrlidWarning, stacklevel=5)
    return estimate


@dataclass(frozen=True, eq=False)
class _Fit:
    """The last step of the iterations."""

    found: Found
    moments: Moments
    view: View
    hats: Signals
    source: str
    iterations: int
    converged: bool = True


def _refine_noise_model(
    task: Task, known: Sequence[AbstractConstraint], law: LinearController | None
) -> _Fit:
    """Return the fit with a force and sensor noise; with sensor noise alone where it has no end."""
    theta = _find_start(task, known)
    fit = _refine_from(task, known, law, theta, (False, True))
    if not fit.converged:
        return _refine_from(task, known, law, theta, (False,))
    return _restrict_noise(task, known, fit) if fit.view.moving else fit


def _restrict_noise(task: Task, known: Sequence[AbstractConstraint], fit: _Fit) -> _Fit:
    """Return the fit beside the moving average of the largest restricted likelihood."""
    theta, view = fit.found.theta, fit.view
    samples = sum(len(piece.y) for piece in task.pieces) - fit.moments.nuisances

    def make_view(c: Array) -> View:
        return replace(view, den=np.concatenate([[1.0], c]))

    def compute_cost(c: Array) -> float:
        if np.max(np.abs(np.roots(make_view(c).den))) > find_slowest(task.longest):
            return np.inf
        return compute_restricted_cost(
            tabulate_errors(task, theta, fit.hats, make_view(c)), samples
        )

    errors = _compute_equation_errors(task, theta, view, fit.hats)
    start = view.den[1:]
    c = restrict_likelihood(compute_cost, start, measure_units(errors, view.den))
    view = make_view(c)
    moments = compute_moments(task, fit.hats, view)
    found = minimize(moments.cost, known, task.structure)
    return replace(fit, found=found, moments=moments, view=view)


def _refine_from(
    task: Task, known: Sequence[AbstractConstraint], law: LinearController | None, theta: Array,
    kinds: Sequence[bool],
) -> _Fit:  # fmt: skip
    """Iterate: with white noises and a linear plant first, then with what the residuals ask for."""
    view, count = View(np.ones(1), np.ones(1), moving=any(kinds)), 0
    for _ in range(6):
        fit = _iterate_instruments(task, known, law, theta, view, count)
        count, theta, view = fit.iterations, fit.found.theta, fit.view
        if fit.moments.rss(theta) <= 1e-20 * fit.moments.size**2:
            # Only rounding errors are left, so that there is no noise to model.
            break
        better = _choose_noise_model(task, theta, view, fit.hats, kinds)
        highest = 1 if task.structure.inputs else _DEGREE
        if view.degree < highest and _is_curved(task, fit, replace(view, num=better.num)):
            view = replace(view, degree=view.degree + 1, curvature=())
            continue
        if better.moving == view.moving and len(better.num) == len(view.num) and np.allclose(
            better.num, view.num, atol=0.02
        ):  # fmt: skip
            break
        view = better
    return fit


def _choose_noise_model(
    task: Task, theta: Array, view: View, hats: Signals, kinds: Sequence[bool]
) -> View:
    r"""Return the view through the noise model that the Bayesian criterion prefers.

    .. math:: N \ln V + d \ln N

    for V the mean square of the whitened equation errors and d fitted coefficients: of an
    autoregression alone, beside the reflected poles of the model, or also of the moving average
    that a random force asks for. Each starts from white noise, so that its order can fall as well
    as rise.
    """
    tried = []
    for moving in kinds:
        plain = replace(view, num=np.ones(1), moving=moving)
        plain = _update_prefilter(task, theta, plain, hats)
        residuals = [part.e for part in separate_nuisances(task, theta, hats, plain)]
        model = replace(plain, num=autoregression(residuals))
        moments = compute_moments(task, hats, model)
        count = len(model.num) - 1 + moving * task.structure.na
        cost = moments.rows * np.log(moments.rss(theta) / moments.rows)
        tried.append((cost + 2 * bayesian_penalty(count, moments.rows), model))
    return min(tried, key=lambda one: one[0])[1]


def _find_start(task: Task, known: Sequence[AbstractConstraint]) -> Array:
    """Find first coefficients: delayed references, under prefilters from wide to narrow.

    The candidate with the least one-step prediction error wins.
    """
    best: tuple[float, Array | None] = (np.inf, None)
    trouble: NotExcited | None = None
    for distance in _STARTS:
        if distance * task.longest < 20:
            break
        den = np.poly(np.full(task.structure.na, 1 - distance))
        view = View(np.ones(1), np.asarray(den, dtype=float))
        try:
            theta = minimize(
                compute_moments(task, task.delayed, view).cost, known, task.structure
            ).theta
        except NotExcited as problem:
            trouble = problem
            continue
        updated = _update_prefilter(task, theta, view, task.delayed)
        moments = compute_moments(task, task.delayed, updated)
        square_sum = moments.rss(theta)
        if square_sum < best[0]:
            best = (square_sum, theta)
    if best[1] is None:
        assert trouble is not None
        raise trouble
    return best[1]


def _is_curved(task: Task, fit: _Fit, view: View) -> bool:
    """Return whether products of a higher degree explain more than Schwarz' criterion asks."""
    theta = fit.found.theta
    straight = compute_moments(task, fit.hats, view)
    curved = compute_moments(task, fit.hats, replace(view, degree=view.degree + 1, curvature=()))
    gain = straight.rows * np.log(straight.rss(theta) / curved.rss(theta))
    return bool(gain > 2 * bayesian_penalty(curved.nuisances - straight.nuisances, straight.rows))


def _update_curvature(task: Task, fit: _Fit) -> View:
    """Return the view with the curvature and the equilibria that this step found."""
    residuals = separate_nuisances(task, fit.found.theta, fit.hats, fit.view)
    gain = float(fit.found.theta[task.structure.na :].sum())
    shift: tuple[float, ...] = ()
    if task.intercept and gain != 0.0:
        # At the equilibrium of the mean output: 0 = B(1) shift + c.
        reach = max(float(np.abs(hat[1]).max()) for hat in fit.hats)
        constants = _average_by_record(task, [part.constant for part in residuals])
        shift = tuple(float(x) for x in np.clip(-constants / gain, -reach, reach))
    return replace(fit.view, curvature=tuple(part.curvature for part in residuals), shift=shift)


def _average_by_record(task: Task, values: Sequence[float]) -> Array:
    """Return the mean of what each stretch says, over the samples of each record."""
    owners = [piece.owner for piece in task.pieces]
    sizes = [len(piece.y) for piece in task.pieces]
    total = np.bincount(owners, np.multiply(values, sizes), task.records)
    return np.asarray(total / np.bincount(owners, sizes, task.records), dtype=float)


def _update_prefilter(task: Task, theta: Array, view: View, hats: Signals) -> View:
    """Return the same view through what whitens the equation errors of another model."""
    reflected = reflect_poles(task.structure, theta, task.longest)
    if not view.moving:
        return replace(view, den=reflected)
    errors = _compute_equation_errors(task, theta, view, hats)
    # The search is short from near by only: in the beginning zeros of all speeds are tried.
    wide = [np.poly(np.full(task.structure.na, 1 - distance)) for distance in _STARTS]
    known = len(view.den) == len(reflected)
    starts = [reflected, *([view.den] if known else wide)]
    return replace(view, den=fit_moving_average(errors, starts, task.longest))


def _compute_equation_errors(task: Task, theta: Array, view: View, hats: Signals) -> list[Array]:
    """Return the equation errors of each stretch with their levels, not yet whitened."""
    plain = replace(view, den=np.ones(1))
    return [part.e + part.constant for part in separate_nuisances(task, theta, hats, plain)]


def _iterate_instruments(
    task: Task,
    known: Sequence[AbstractConstraint],
    law: LinearController | None,
    theta: Array,
    view: View,
    count: int,
) -> _Fit:
    """Repeat with filters and instruments of the last model until it no longer moves."""
    best, least = theta, np.inf
    hats = task.delayed
    for step in range(_MOST):
        if not view.moving or (step < _PATIENCE and len(view.num) == 1):
            # A moving average is held in the end, so that full steps converge, and beside an
            # autoregression that was fitted to what it left.
            view = _update_prefilter(task, theta, view, hats)
        simulated = None
        if law is not None:
            forces = compute_curved_force(task, hats, view)
            simulated = simulate_noise_free_loop(task.pieces, law, task.structure, theta, forces)
        if simulated is None and step >= _PATIENCE:
            # The simulated loop is stable in some iterations only, so that it is given up for good.
            law = None
        hats = task.delayed if simulated is None else simulated
        source = "delayed references" if simulated is None or law is None else law.source
        moments = compute_moments(task, hats, view)
        cost = moments.cost
        found = minimize(cost, known, task.structure)
        square_sum = moments.rss(theta)
        if square_sum < least:
            best, least = theta, square_sum
        fit = _Fit(found, moments, view, hats, source, count + step + 1)
        move = to_differences(task.structure, found.theta) - to_differences(task.structure, theta)
        moved = float(np.linalg.norm(cost.R @ move))
        noise = np.sqrt(moments.rss(found.theta) / moments.rows)
        converged = moved <= 1e-3 * noise or moved <= 1e-10 * moments.size
        if converged and (view.degree == 1 or step > 1):
            return fit
        if view.degree > 1:
            view = _update_curvature(task, fit)
        # The first iterations take full steps; where these oscillate, half of them converge.
        share = 1.0 if step < _PATIENCE else 0.5
        theta = theta + share * (found.theta - theta)
    view = _update_prefilter(task, best, view, fit.hats)
    moments = compute_moments(task, fit.hats, view)
    found = minimize(moments.cost, known, task.structure)
    return replace(fit, found=found, moments=moments, view=view, converged=False)


def _make_estimate(task: Task, fit: _Fit, constrained: bool, dt: float) -> Estimate:
    s, found, moments = task.structure, fit.found, fit.moments
    rss = moments.rss(found.theta)
    degrees = moments.rows - moments.nuisances - found.free
    residuals = separate_nuisances(task, found.theta, fit.hats, fit.view)
    covariance = found.spread * rss / degrees
    sandwich = _compute_sandwich(moments, found, residuals)
    words = [_text.write_count(fit.iterations, "iteration"), f"instruments from {fit.source}"]
    notes = [] if fit.converged else [_describe_no_end(fit)]
    if fit.view.degree > 1:
        notes.append(_CURVED.format(degree=fit.view.degree))
    if fit.view.moving:
        words.append(f"noise that is a moving average of order {len(fit.view.den) - 1}")
    if len(fit.view.num) > 1:
        words.append(f"a noise model of order {len(fit.view.num) - 1}")
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.nanmax(np.diag(sandwich) / np.diag(covariance), initial=0.0)
    size = max(float(np.max(np.abs(piece.y))) for piece in task.pieces)
    errors = [part.e for part in residuals]
    coloured = note_coloured_innovations(errors, len(s.names), _COLOURED, size)
    # Where the innovations are not white, no noise model is left that would know better.
    if ratio > (1.0 if coloured else 2.0) and rss > 1e-20 * moments.size**2:
        covariance = sandwich
        notes.append(_CORRELATED)
    notes += coloured
    delta = to_differences(s, found.theta)
    # A(1) = -delta_0 and B(1) = beta_0 return the levels that were taken off.
    constants = [
        part.constant
        - delta[0] * piece.levels[0]
        - sum(
            delta[p.start] * level for p, level in zip(s.numerators, piece.levels[1:], strict=True)
        )
        for piece, part in zip(task.pieces, residuals, strict=True)
    ]
    return Estimate(
        structure=s,
        values=found.theta,
        covariance=covariance,
        intercepts=_average_by_record(task, constants) if task.intercept else np.zeros(0),
        rss=rss,
        residual_variance=rss / degrees,
        n_samples=moments.rows,
        degrees_of_freedom=degrees,
        active_bounds=found.active_bounds,
        branch=found.branch,
        method=("constrained " if constrained else "") + "refined instrumental variables",
        solver=f"{found.solver}; {', '.join(words)}",
        dt=dt,
        condition=found.condition,
        notes=tuple(notes),
    )


def _compute_sandwich(moments: Moments, found: Found, residuals: Sequence[Residuals]) -> Array:
    """Return the covariance by the correlations of ``z e``, without a noise model (Newey, West)."""
    p = len(moments.structure.names)
    upper = moments.factor[:p, :p]
    cost = moments.cost
    # This is R in the coefficients instead of the differenced basis.
    slope = np.linalg.solve(cost.basis.T, cost.R.T).T
    middle = np.zeros((p, p))
    for part in residuals:
        g = np.linalg.lstsq(upper.T, (part.z * part.e[:, None]).T, rcond=None)[0].T
        middle += sum_with_correlations(np.asarray(g, dtype=float))
    bread = found.spread @ slope.T
    return np.asarray(bread @ middle @ bread.T)


# -- words ---------------------------------------------------------------------------------------

_CURVED = (
    "THE PLANT IS NONLINEAR over the range of this record: products of y and u up to degree "
    "{degree} were fitted as well, and the coefficients above are those of the linear model at the "
    "equilibrium. Use smaller signals, or fit_loop with the physics."
)
_COLOURED = (
    "Check with compare() whether the residuals depend on past u: then the orders are too low, or "
    "physics is missing, and the coefficients are wrong."
)
_CORRELATED = (
    "THE NOISE MODEL DOES NOT HOLD: the standard errors were computed from the correlations of "
    "the residuals instead. Check with compare() whether the residuals depend on the reference: "
    "physics may be missing."
)


def _describe_no_end(fit: _Fit) -> str:
    """Say that the iterations with the last noise model did not end, of all that were made."""
    count = fit.iterations
    whole = _text.write_count(count, "step")
    made = f"the last {_MOST} of {whole}" if count > _MOST else whole
    return (
        f"THE ITERATIONS DID NOT CONVERGE in {made}: the coefficients above are those of the "
        "step with the smallest prediction error. The orders may be too high, or the reference too "
        "weak."
    )


def _check_hold(records: Sequence[Record]) -> None:
    if records[0].hold != "zoh":
        raise CtrlidError(
            "fit_iv needs an input that is held between samples, but this record has "
            f"hold={records[0].hold!r}: u changes between the samples, as that of an analog "
            "controller does, and that of a digital one after record.decimate(), whose filter "
            "smooths it. A difference equation, which knows u at the samples only, is then biased. "
            "If the record was decimated, give the one that was logged: fit_iv needs no slower "
            "period. With an analog controller, use fit_continuous with controller=, or fit_loop. "
            "If u is held in fact, or r and u are smooth and dt is short, use "
            "dataclasses.replace(record, hold='zoh')."
        )


def _explain_no_excitation(structure: Structure, names: tuple[str, ...], direction: Array) -> str:
    size = np.abs(direction)
    involved = [n for n, d in zip(structure.names, size, strict=True) if d > 1e-3 * size.max()]
    return (
        f"The instruments do not determine the coefficients: {_text.write_list(involved)} can "
        f"change together without a change of the response to {_text.write_list(names)}. Excite "
        "the loop with more frequencies (random_binary), lower na or nb, or add what you know as a "
        "constraint."
    )


def _check_strength(estimate: Estimate, names: tuple[str, ...]) -> None:
    """Refuse where no effect of u on y is seen: the instruments then have nothing to do with it."""
    na = estimate.structure.na
    values, covariance = estimate.values[na:], estimate.covariance[na:, na:]
    free = np.diag(covariance) > 0
    if not free.any() or (~free & (values != 0)).any():
        return
    values, covariance = values[free], covariance[np.ix_(free, free)]
    wald = float(values @ np.linalg.pinv(covariance, hermitian=True) @ values)
    rank = int(np.linalg.matrix_rank(covariance, hermitian=True))
    if wald < stats.chi2.ppf(0.999, rank):
        raise CtrlidError(
            f"The instruments are too weak: in the response to {_text.write_list(names)} the "
            "coefficients b cannot be distinguished from zero. Check that this signal drives the "
            "loop and that it is logged at the right time; if so, make it larger or record longer."
        )
