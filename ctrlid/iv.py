"""fit_iv(): instrumental variables, consistent in closed loop whatever the colour of the noise."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import signal, stats

from . import _text
from .constraints import AbstractConstraint, check_constraints
from .data import Record, as_records
from .errors import CtrlidError, CtrlidWarning
from .instruments import (
    Law,
    Piece,
    Signals,
    autoregression,
    check_instruments,
    cut,
    found_law,
    given_law,
    loop_signals,
    stable_factor,
    two_stage,
)
from .model import Estimate, IdentifiedModel, Structure
from .qp import Cost, NotExcited
from .regression import block_qr, check_orders, from_differences, merge, to_differences
from .search import Found, minimize

FloatArray = NDArray[np.float64]

_MOST = 40  # iterations for one noise model
_PATIENCE = 8  # of them in full steps
_STARTS = 0.5 ** np.arange(1, 10)  # distance of the first prefilters' poles from z = 1


def fit_iv(
    record: Record | Sequence[Record],
    na: int,
    nb: int,
    nk: int = 1,
    constraints: AbstractConstraint | Sequence[AbstractConstraint] = (),
    controller: Any = None,
    intercept: bool = True,
    instruments: str | Sequence[str] = "r",
) -> IdentifiedModel:
    r"""Fit a difference equation by refined instrumental variables under constraints.

    ``y(k) + a1 y(k-1) + ... + a_na y(k-na) = b1 u(k-nk) + ... + b_nb u(k-nk-nb+1) + c + A v(k)``

    with v the sensor noise, which the controller feeds back into u. Least squares minimises the
    equation error; here it only has to be uncorrelated with instruments Z, signals that come from
    outside the loop and that v does not reach:

    .. math:: \min_\theta \| (Z^T Z)^{-1/2} Z^T F (y - \Phi \theta) \|^2

    subject to what is known about the coefficients. The answer is right on average whatever the
    colour of the noise. Z and the prefilter F decide how precise it is, and are refined in turn:

    1. First Z is what delayed references explain of y and u.
    2. F whitens the equation error: 1 / A with the poles outside the unit circle reflected into it,
       times an autoregression of the residuals where v is coloured.
    3. Z becomes y and u of the noise-free simulated loop of the last model and the controller. If
       that loop is not stable, or no controller is found, step 1 serves on.
    4. Where the residuals show that the plant is curved, squares and the product of y and u are
       estimated too: they are small, but slow, and would drown the static gain.

    Repeated until the coefficients move by less than a thousandth of their standard errors.

    Parameters
    ----------
    record : Record or sequence of Record
        Data with a held input; of several records each has its own intercept. Stretches of valid
        samples are used each on their own.
    na : int
        Number of poles.
    nb : int
        Number of numerator coefficients.
    nk : int
        Samples from u to y: 1 where ``u[k]`` is applied after ``y[k]`` is measured.
    constraints : AbstractConstraint or sequence of them
        What is known, as in `fit_arx`.
    controller : control.TransferFunction or control.StateSpace, optional
        The controller in discrete time, of r - y or of (r, y); signals named in `instruments`
        other than r are added to its output. By default it is found in the record by a regression
        of u on r and y. An inexact one costs precision only.
    intercept : bool
        Estimate the constant c; see `fit_arx`.
    instruments : str or sequence of str
        The signals from outside the loop: ``"r"``, or channels of ``record.extra``, for instance a
        dither that was added to u.

    Returns
    -------
    IdentifiedModel
        A `control.TransferFunction` with ``.estimate``. Its residual variance is that of the
        whitened equation error: without plant noise, that of the one-step prediction. Its
        standard errors hold for noise of any colour: where correlations of the residuals
        contradict the noise model, they are computed from those instead, and ``solver`` says so.

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
    structure = check_orders(na, nb, nk)
    known = check_constraints(constraints)
    records = as_records(record)
    _check_hold(records)
    names = check_instruments(records, instruments)
    task = _Task.prepare(records, structure, names, intercept)
    law = found_law(task.pieces, names) if controller is None else None
    if controller is not None:
        law = given_law(controller, names, records[0].dt)
    try:
        fit = _refine(task, known, law)
    except NotExcited as trouble:
        raise CtrlidError(_not_excited(structure, names, trouble.direction)) from None
    estimate = _estimate(task, fit, constrained=bool(known), dt=records[0].dt)
    _check_strength(estimate, names)
    labels = records[0].names
    return IdentifiedModel(estimate, inputs=labels.get("u", "u"), outputs=labels.get("y", "y"))


@dataclass(frozen=True, eq=False)
class _Task:
    """What stays the same through all iterations."""

    structure: Structure
    pieces: list[Piece]
    delayed: Signals
    records: int
    intercept: bool

    @classmethod
    def prepare(
        cls,
        records: Sequence[Record],
        structure: Structure,
        names: tuple[str, ...],
        intercept: bool,
    ) -> _Task:
        """Cut the records and project them on the delayed external signals."""
        na, span = structure.na, max(structure.na, structure.nk + structure.nb - 1) + 1
        shortest = span + na + 10
        pieces = cut(records, names, intercept, shortest)
        for number, one in enumerate(records):
            if not any(piece.owner == number for piece in pieces):
                longest = max((j - i for i, j in one.segments()), default=0)
                raise CtrlidError(
                    f"Record {number + 1} of {len(records)} has no stretch of {shortest} valid "
                    f"samples in succession, the longest has {longest}. Record longer, leave it "
                    "out or lower the orders."
                )
        unknowns = na + structure.nb + len(records) + na * len(pieces)
        total = sum(len(piece.y) for piece in pieces)
        if total < 10 * unknowns:
            raise CtrlidError(
                f"Too few samples: {total} valid ones for {unknowns} unknowns. Instrumental "
                f"variables need at least {10 * unknowns}; record longer or lower the orders."
            )
        return cls(structure, pieces, two_stage(pieces), len(records), intercept)

    @property
    def longest(self) -> int:
        return max(len(piece.y) for piece in self.pieces)


@dataclass(frozen=True, eq=False)
class _View:
    """How the data are looked at: through ``num / den``, and with curvature taken out or not."""

    num: FloatArray
    den: FloatArray
    curved: bool = False

    def __call__(self, s: FloatArray) -> FloatArray:
        """Filter a signal, from rest."""
        return np.asarray(signal.lfilter(self.num, self.den, s), dtype=float)

    def decays(self, n: int) -> FloatArray:
        """All ways in which the filter's unknown initial state decays, ``(n, order)``.

        Estimated with the model they make the start of each stretch exact: else the filter would
        need several of its time constants to forget it.
        """
        order = len(self.den) - 1
        impulse = np.zeros(n + order)
        impulse[0] = 1.0
        h = np.asarray(signal.lfilter([1.0], self.den, impulse), dtype=float)
        h[np.abs(h) < 1e-30 * np.abs(h).max()] = 0.0
        return np.column_stack([h[order - i : order - i + n] for i in range(1, order + 1)])


@dataclass(frozen=True, eq=False)
class _Moments:
    """Triangular factor of ``[instruments | regressors | target]``, nuisances eliminated."""

    factor: FloatArray
    rows: int
    nuisances: int
    structure: Structure
    floor: FloatArray

    @property
    def cost(self) -> Cost:
        """``|| (Z'Z)^(-1/2) Z' (y - Phi theta) ||^2`` in the differenced basis."""
        p = len(self.structure.names)
        upper = self.factor[:p, p : 2 * p]
        size = np.linalg.norm(upper, axis=0)
        excited = size > 10 * self.floor
        noise = np.linalg.norm(self.floor[excited] / size[excited])
        basis, origin = from_differences(self.structure)
        rest = max(1e-11, 10 * float(noise))
        return Cost(np.where(excited, upper, 0.0), self.factor[:p, -1], basis, origin, rest)

    def rss(self, theta: FloatArray) -> float:
        """Sum of squares of the filtered equation error."""
        p = len(self.structure.names)
        delta = to_differences(self.structure, theta)
        return float(np.sum((self.factor[:, -1] - self.factor[:, p : 2 * p] @ delta) ** 2))

    @property
    def size(self) -> float:
        """Norm of the target."""
        return float(np.linalg.norm(self.factor[:, -1]))


def _differences(signal: FloatArray, start: int, n: int, count: int) -> list[FloatArray]:
    """Return ``s, D s, D^2 s, ..``, each ``(n,)`` from sample ``start`` on."""
    return [np.diff(signal, k)[start : start + n] for k in range(count)]


def _table(
    task: _Task, piece: Piece, hats: tuple[FloatArray, FloatArray], view: _View
) -> tuple[list[FloatArray], int]:
    """Columns ``nuisances | 1 | instruments | regressors | target``; the number of the first.

    Nuisances are what the prefilter's initial state leaves behind and, of a curved plant, the
    squares and the product of y and u, as far as the external signals cause them: near an
    operating point every smooth plant is linear but for these.
    """
    s = task.structure
    first = max(s.na, s.nk + s.nb - 1) + len(view.num) - 1
    n = len(piece.y) - first
    i, j = first - s.na, first - s.nk - s.nb + 1
    columns = list(view.decays(len(piece.y))[first:].T)
    if view.curved:
        y, u = hats
        for product in (u * u, u * y, y * y):
            columns += _differences(view(product / product.max()), j, n, s.nb)
    nuisances = len(columns)
    columns.append(view(np.ones(len(piece.y)))[first:] if task.intercept else np.zeros(n))
    for y, u in (hats, (piece.y, piece.u)):
        ys = _differences(view(y), i, n, s.na + 1)
        columns += [*ys[:-1], *_differences(view(u), j, n, s.nb)]
    return [*columns, ys[-1]], nuisances


def _moments(task: _Task, hats: Signals, view: _View) -> _Moments:
    """Pass over the data with given instruments and prefilter."""
    s = task.structure
    owned: list[list[FloatArray]] = [[] for _ in range(task.records)]
    rows, nuisances = 0, task.records * task.intercept
    for piece, hat in zip(task.pieces, hats, strict=True):
        columns, skip = _table(task, piece, hat, view)

        def fill(out: FloatArray, i: int, j: int, columns: Any = columns) -> None:
            for k, column in enumerate(columns):
                out[:, k] = column[i:j]

        n, width = len(columns[0]), len(columns)
        factor = block_qr(fill, n, width)
        owned[piece.owner].append(factor[skip:, skip:])
        rows += n
        nuisances += skip
    whole = merge([merge(factors)[1:, 1:] for factors in owned])
    return _Moments(whole, rows, nuisances, s, _rounding(task, view))


def _rounding(task: _Task, view: _View) -> FloatArray:
    """Return the rounding errors of the data in each column, as far as instruments pick them up."""
    s = task.structure
    impulse = np.zeros(task.longest)
    impulse[0] = 1.0
    h = view(impulse)
    gains = [np.sqrt(np.sum(np.diff(h, k, prepend=np.zeros(k)) ** 2)) for k in range(s.na + s.nb)]
    eps = float(np.finfo(float).eps) * np.sqrt(len(s.names))
    y = max(abs(piece.levels[0]) + float(np.abs(piece.y).max()) for piece in task.pieces)
    u = max(abs(piece.levels[1]) + float(np.abs(piece.u).max()) for piece in task.pieces)
    sizes = [y * gain for gain in gains[: s.na]] + [u * gain for gain in gains[: s.nb]]
    return np.asarray(eps * np.array(sizes, dtype=float))


# -- iterations ----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Fit:
    """The last step of the iterations."""

    found: Found
    moments: _Moments
    view: _View
    hats: Signals
    source: str
    iterations: int


def _refine(task: _Task, known: Sequence[AbstractConstraint], law: Law | None) -> _Fit:
    """Iterate: with white noise and a linear plant first, then with what the residuals ask for."""
    theta = _start(task, known)
    ar, curved, count = np.ones(1), False, 0
    for _ in range(4):
        fit = _iterate(task, known, law, theta, _View(ar, ar, curved), count)
        count, theta = fit.iterations, fit.found.theta
        if fit.moments.rss(theta) <= 1e-20 * fit.moments.size**2:
            break  # nothing but rounding errors is left: there is no noise to model
        if not curved and _is_curved(task, fit):
            curved = True
            continue
        # From white again, so that the order can fall as well as rise.
        plain = replace(fit.view, num=np.ones(1))
        better = autoregression([e for _, e, _ in _residuals(task, theta, fit.hats, plain)])
        if len(better) == len(ar) and np.allclose(better, ar, atol=0.02):
            break
        ar = better
    return fit


def _start(task: _Task, known: Sequence[AbstractConstraint]) -> FloatArray:
    """First coefficients: delayed references, under prefilters from wide to narrow.

    The candidate with the least one-step prediction error wins.
    """
    best: tuple[float, FloatArray | None] = (np.inf, None)
    trouble: NotExcited | None = None
    for distance in _STARTS:
        if distance * task.longest < 20:
            break
        den = np.poly(np.full(task.structure.na, 1 - distance))
        view = _View(np.ones(1), np.asarray(den, dtype=float))
        try:
            theta = minimize(_moments(task, task.delayed, view).cost, known, task.structure).theta
        except NotExcited as problem:
            trouble = problem
            continue
        moments = _moments(task, task.delayed, _through(task, theta, view))
        merit = moments.rss(theta)
        if merit < best[0]:
            best = (merit, theta)
    if best[1] is None:
        assert trouble is not None
        raise trouble
    return best[1]


def _is_curved(task: _Task, fit: _Fit) -> bool:
    """Whether squares of the signals explain more than Schwarz' criterion asks of them."""
    moments = _moments(task, fit.hats, replace(fit.view, curved=True))
    theta = fit.found.theta
    gain = moments.rows * np.log(fit.moments.rss(theta) / moments.rss(theta))
    return bool(gain > (moments.nuisances - fit.moments.nuisances) * np.log(moments.rows))


def _through(task: _Task, theta: FloatArray, view: _View) -> _View:
    """Return the same view through the denominator of another model."""
    return replace(view, den=stable_factor(task.structure, theta, task.longest))


def _iterate(
    task: _Task,
    known: Sequence[AbstractConstraint],
    law: Law | None,
    theta: FloatArray,
    view: _View,
    count: int,
) -> _Fit:
    """Repeat with filters and instruments of the last model until it no longer moves."""
    best, least = theta, np.inf
    for step in range(_MOST):
        view = _through(task, theta, view)
        simulated = None if law is None else loop_signals(task.pieces, law, task.structure, theta)
        if simulated is None and step >= _PATIENCE:
            law = None  # the simulated loop comes and goes: stay without it
        hats = task.delayed if simulated is None else simulated
        source = "delayed references" if simulated is None or law is None else law.source
        moments = _moments(task, hats, view)
        cost = moments.cost
        found = minimize(cost, known, task.structure)
        merit = moments.rss(theta)
        if merit < least:
            best, least = theta, merit
        fit = _Fit(found, moments, view, hats, source, count + step + 1)
        move = to_differences(task.structure, found.theta) - to_differences(task.structure, theta)
        moved = float(np.linalg.norm(cost.R @ move))
        noise = np.sqrt(moments.rss(found.theta) / moments.rows)
        if moved <= 1e-3 * noise or moved <= 1e-10 * moments.size:
            return fit
        # Full steps first; where they swing to and fro, half of them.
        share = 1.0 if step < _PATIENCE else 0.5
        theta = theta + share * (found.theta - theta)
    warnings.warn(
        f"fit_iv did not settle in {_MOST} iterations; the coefficients with the least prediction "
        "error among them are returned. The orders may be too high, or the reference too weak.",
        CtrlidWarning,
        stacklevel=4,
    )
    view = _through(task, best, view)
    moments = _moments(task, fit.hats, view)
    found = minimize(moments.cost, known, task.structure)
    return replace(fit, found=found, moments=moments, view=view)


def _residuals(
    task: _Task, theta: FloatArray, hats: Signals, view: _View
) -> list[tuple[FloatArray, FloatArray, float]]:
    """Of each stretch: instruments and viewed equation errors, nuisances out; the constant."""
    s = task.structure
    p = len(s.names)
    delta = to_differences(s, theta)
    found = []
    for piece, hat in zip(task.pieces, hats, strict=True):
        columns, skip = _table(task, piece, hat, view)
        table, skip = np.column_stack(columns), skip + 1
        nuisance, z = table[:, :skip], table[:, skip : skip + p]
        error = table[:, -1] - table[:, skip + p : -1] @ delta
        size = np.linalg.norm(nuisance, axis=0)
        size[size == 0] = 1.0
        both = np.column_stack([z, error])
        x = np.linalg.lstsq(nuisance / size, both, rcond=1e-12)[0] / size[:, None]
        both -= nuisance @ x
        found.append((both[:, :-1], both[:, -1], float(x[skip - 1, -1])))
    return found


def _estimate(task: _Task, fit: _Fit, constrained: bool, dt: float) -> Estimate:
    s, found, moments = task.structure, fit.found, fit.moments
    rss = moments.rss(found.theta)
    degrees = moments.rows - moments.nuisances - found.free
    residuals = _residuals(task, found.theta, fit.hats, fit.view)
    covariance = found.spread * rss / degrees
    sandwich = _sandwich(moments, found, residuals)
    words = [f"{fit.iterations} iterations", f"instruments from {fit.source}"]
    if fit.view.curved:
        words.append("curvature of the plant taken out")
    if len(fit.view.num) > 1:
        words.append(f"sensor noise of order {len(fit.view.num) - 1}")
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.nanmax(np.diag(sandwich) / np.diag(covariance), initial=0.0)
    if ratio > 2.0 and rss > 1e-20 * moments.size**2:
        covariance = sandwich
        words.append("standard errors from the residuals' own correlations")
    delta = to_differences(s, found.theta)
    constants = np.zeros(task.records)
    weight = np.zeros(task.records)
    for piece, (_, error, constant) in zip(task.pieces, residuals, strict=True):
        level = constant - delta[0] * piece.levels[0] - delta[s.na] * piece.levels[1]
        constants[piece.owner] += len(error) * level
        weight[piece.owner] += len(error)
    return Estimate(
        structure=s,
        values=found.theta,
        covariance=covariance,
        intercepts=constants / weight if task.intercept else np.zeros(0),
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
    )


def _sandwich(
    moments: _Moments, found: Found, residuals: Sequence[tuple[FloatArray, FloatArray, float]]
) -> FloatArray:
    """Covariance without a noise model, from the correlations of ``z e`` (Newey and West)."""
    p = len(moments.structure.names)
    upper = moments.factor[:p, :p]
    cost = moments.cost
    slope = np.linalg.solve(cost.basis.T, cost.R.T).T  # R in the coefficients themselves
    middle = np.zeros((p, p))
    for z, e, _ in residuals:
        g = np.linalg.lstsq(upper.T, (z * e[:, None]).T, rcond=None)[0].T
        lags = int(np.ceil(1.5 * len(g) ** (1 / 3)))
        for lag in range(lags + 1):
            part = g[lag:].T @ g[: len(g) - lag] * (1 - lag / (lags + 1))
            middle += part if lag == 0 else part + part.T
    bread = found.spread @ slope.T
    return np.asarray(bread @ middle @ bread.T)


# -- refusals ------------------------------------------------------------------------------------


def _check_hold(records: Sequence[Record]) -> None:
    if records[0].hold != "zoh":
        raise CtrlidError(
            "fit_iv needs an input that is held between samples, but this record has "
            f"hold={records[0].hold!r}: u of an analog controller moves meanwhile, and a "
            "difference equation that knows it at the samples only is biased. Use fit_continuous "
            "with controller=, or fit_loop. Where u is held in truth, or reference and u are "
            "smooth and dt short, say so with dataclasses.replace(record, hold='zoh')."
        )


def _not_excited(structure: Structure, names: tuple[str, ...], direction: FloatArray) -> str:
    size = np.abs(direction)
    involved = [n for n, d in zip(structure.names, size, strict=True) if d > 1e-3 * size.max()]
    return (
        f"The instruments do not determine the coefficients: {_text.listing(involved)} can move "
        f"together and nothing that {_text.listing(names)} causes would change. Excite the loop "
        "with more frequencies (random_binary), lower na or nb, or add what is known as a "
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
            f"The instruments are too weak: with what {_text.listing(names)} causes, b is not "
            "distinguishable from zero. Check that it is the signal that drives this loop and is "
            "logged at the right time; else move it further or longer."
        )
