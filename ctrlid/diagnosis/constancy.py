"""Whether each parameter of a model is one number: the same everywhere, and at all times."""

from collections.abc import Mapping

import numpy as np
from scipy import stats

from .._base.arrays import Array
from .._base.statistics import pseudo_inverse, sum_with_correlations
from ..estimation.likelihood.likelihood import Fit
from .thresholds import THRESHOLD


def run_constancy_tests(fit: Fit, axes: Mapping[str, Array]) -> dict[str, float]:
    r"""Test that the fitted parameters do not depend on anything.

    With the innovations :math:`e_k` of variance :math:`S_k` and their slope :math:`x_k` in a
    parameter, what the samples of a bin b say of the parameter alone is

    .. math:: U_b = \sum_{k \in b} \frac{x_k e_k}{S_k}, \quad
        I_b = \sum_{k \in b} \frac{x_k^2}{S_k}

    and :math:`\sum_b U_b^2 / I_b` has the law of `compute_bin_probability` where the parameter is
    the same in all bins: the slopes are known before the innovations are. At one frequency,
    :math:`|\sum_k x_k e_k e^{i \omega k} / S_k|^2 / I` is exponential. An effect that a known one
    only nearly describes, or that comes and goes, shows here long before it shows in the
    innovations themselves.

    Parameters
    ----------
    fit : Fit
        The fitted model.
    axes : mapping of str to ndarray
        Values of a quantity at the samples that count, records one after the other.

    Returns
    -------
    dict of str to float
        Probabilities by the name of the test.

    References
    ----------
    Nyblom, Journal of the American Statistical Association 84 (1989) 223-230 (constancy of
    parameters from scores).
    """
    names = fit.plant.names
    parts = [
        (out.slopes[keep], e[keep], s[keep], keep)
        for out, (e, s), keep in zip(
            fit.filtered, fit.working, map(np.isfinite, fit.standardized), strict=True
        )
    ]
    scores = np.concatenate([x * (e / s)[:, None] for x, e, s, _ in parts])
    rows = np.concatenate([x / np.sqrt(s)[:, None] for x, _, s, _ in parts])
    p_values = {}
    for axis, values in axes.items():
        index = find_bins(values, find_bin_edges(values))
        count = np.bincount(index)
        for j, name in enumerate(names):
            score = sum_in_bins(scores[:, [j]], index, len(count))[:, 0]
            shared = sum_in_bins(rows * rows[:, [j]], index, len(count))
            use = (count >= THRESHOLD.fewest_in_bin) & (shared[:, j] > 0)
            if use.sum() > 1:
                p_values[f"constancy of {name} over {axis}"] = compute_bin_probability(
                    score[use], shared[use, j], shared[use], fit
                )
    for j, name in enumerate(names):
        lines = [_test_slow_line(x[:, j] * e / s, whole, keep) for x, e, s, keep in parts
                 if (whole := float(np.sum(x[:, j] ** 2 / s))) > 0]  # fmt: skip
        if lines:
            p_values[f"rhythm of {name}"] = min(1.0, min(lines) * len(lines))
    return p_values


def sum_in_bins(rows: Array, index: Array, bins: int) -> Array:
    """Return the sums of rows in bins."""
    sums: Array = np.empty((bins, rows.shape[1]))
    for j, column in enumerate(rows.T):
        sums[:, j] = np.bincount(index, column, minlength=bins)
    return sums


def compute_bin_probability(sums: Array, variances: Array, shared: Array, fit: Fit) -> float:
    r"""Return the probability that noise makes as large sums in bins, the parameters being fitted.

    .. math:: Q = \sum_b u_b^2 / v_b, \quad V = \mathrm{diag}(v) - C F^{-1} C^T

    What the fit has taken out of the sums u, of variance v before it, is told by their covariance C
    with the score of the parameters and by its information F. Q is a sum of squares weighted by the
    eigenvalues of V, in units of v, and nearly a chi-squared variable with its mean and variance.

    Parameters
    ----------
    sums, variances : ndarray, shape (bins,)
        Sums in the bins, and their variances if no parameter were fitted.
    shared : ndarray, shape (bins, parameters)
        Covariances of the sums with the score of each parameter.
    fit : Fit
        The fitted model.

    Returns
    -------
    float
        The probability; one where the fit leaves the bins no freedom.

    References
    ----------
    Satterthwaite, Biometrics Bulletin 2 (1946) 110-114 (the chi-squared law of the same mean and
    variance); Durbin, Annals of Statistics 1 (1973) 279-290 (tests when parameters are estimated).
    """
    scaled = shared / np.sqrt(variances)[:, None]
    matrix = np.eye(len(sums)) - scaled @ pseudo_inverse(fit.normal[0]) @ scaled.T
    mean, square = float(np.trace(matrix)), float(np.sum(matrix**2))
    if not mean > THRESHOLD.seen * len(sums):
        return 1.0
    value = float(np.sum(sums**2 / variances))
    return float(stats.chi2.sf(value * mean / square, mean**2 / square))


def compare_stretches(fit: Fit, name: str, harmless: float = 0.0) -> float:
    r"""Return the probability that a parameter is as unlike in stretches of the records by chance.

    .. math:: \delta_b = \bigl(I_b^{-1} U_b\bigr)_j, \quad
        V_b = \bigl(I_b^{-1} J_b I_b^{-1}\bigr)_{jj} + h^2, \quad
        \chi^2 = \sum_b (\delta_b - \bar\delta)^2 / V_b

    with score :math:`U_b` and information :math:`I_b` of all parameters in stretch b, so that the
    others move along, and the variance :math:`J_b` of the score by its own correlations: beside
    something unknown the innovations are not white. Stretches that say nothing of it do not count.

    Parameters
    ----------
    fit : Fit
        The fitted model.
    name : str
        The parameter.
    harmless : float, optional
        Differences h that do no harm [unit of the parameter]: with little noise a record tells
        sizes apart that are one size to whoever uses the model.

    Returns
    -------
    float
        The probability; one where fewer than two stretches say anything.

    References
    ----------
    White, Econometrica 50 (1982) 1-25 (the variance of estimates of a wrong model).
    """
    j = fit.plant.names.index(name)
    moves, sizes = [], []
    for out, (errors, width), shown in zip(
        fit.filtered, fit.working, map(np.isfinite, fit.standardized), strict=True
    ):
        deviation = np.sqrt(width[shown])
        slopes = out.slopes[shown] / deviation[:, None]
        z = errors[shown] / deviation
        for x, e in zip(
            np.array_split(slopes, THRESHOLD.stretches_compared),
            np.array_split(z, THRESHOLD.stretches_compared), strict=True,
        ):  # fmt: skip
            move, variance = _estimate_alone(x, e, j)
            if variance > 0:
                moves.append(move)
                sizes.append(variance + harmless**2)
    if len(moves) < 2:
        return 1.0
    d, weights = np.array(moves), 1 / np.array(sizes)
    spread = float(weights @ (d - weights @ d / weights.sum()) ** 2)
    return float(stats.chi2.sf(spread, len(d) - 1))


def _estimate_alone(x: Array, e: Array, j: int) -> tuple[float, float]:
    """Return how far a stretch moves a parameter, and the variance; zeros if it says nothing."""
    matrix = x.T @ x
    size = np.sqrt(np.maximum(np.diag(matrix), THRESHOLD.tiny))
    scaled = matrix / np.outer(size, size)
    others = [k for k in range(len(size)) if k != j]
    inverse = pseudo_inverse(scaled[np.ix_(others, others)], THRESHOLD.seen)
    row = np.zeros(len(size))
    row[j] = 1.0
    row[others] = -inverse @ scaled[others, j]
    left = float(row @ scaled @ row)
    if not (np.isfinite(left) and left > THRESHOLD.seen) or matrix[j, j] <= THRESHOLD.tiny:
        return 0.0, 0.0
    shares = (x / size) @ row * e / (left * size[j])
    # A few hundred samples may show less correlation than white noise has on the average.
    variance = max(float(sum_with_correlations(shares[:, None])[0, 0]), 1 / (left * size[j] ** 2))
    return float(shares.sum()), variance


def _test_slow_line(score: Array, size: float, keep: Array) -> float:
    """Return the probability that the score of a constant has as strong a slow line."""
    filled = np.zeros(keep.shape)
    filled[keep] = score
    if filled.ndim == 2:
        # What several outputs say at one time belongs together.
        filled = filled.sum(axis=1)
    power = np.abs(np.fft.rfft(filled)) ** 2 / size
    return compute_line_probability(power[1 : max(int(THRESHOLD.slow_rhythm * len(power)), 2)])


def compute_line_probability(power: Array) -> float:
    """Return the probability that noise, of mean power one, has as strong a line somewhere."""
    return float(-np.expm1(len(power) * np.log1p(-np.exp(-power.max(initial=0.0)))))


def find_bin_edges(values: Array, bins: int | None = None) -> Array:
    """Return edges of bins that hold equally many samples; what rounding left of zero is zero."""
    edges = np.quantile(values, np.linspace(0, 1, (bins or THRESHOLD.bins) + 1))
    edges = np.unique(np.where(np.abs(edges) < THRESHOLD.rounding * np.ptp(values), 0.0, edges))
    return edges if len(edges) > 2 else np.array([values.min(), values.mean(), values.max()])


def find_bins(values: Array, edges: Array) -> Array:
    """Return the bin of each value."""
    return np.clip(np.searchsorted(edges, values, side="right") - 1, 0, len(edges) - 2)
