r"""What an effect is worth in a record, by a textbook filter that knows nothing of ctrlid.

.. math:: w = \min_\theta E\left[\ln p_{true}(y) - \ln p_\theta(y)\right]

over the free parameters and the noise of the model without the effect, with what is believed of
the parameters. The expectation is that of the log-likelihood ratio given each sample's past, summed
along the record (`outside_plants.sum_divergence`), so that the noise of the record averages out.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import outside_plants as op

# A climb ends where the next step would gain so much of log-likelihood, or after so many steps.
ENOUGH = 0.005
ROUNDS = 60
TRIES = 12
# Logarithms of the random force, over the true one, from which climbs begin.
PUSHES = (0.0, 2.0, 4.0)
# Differences are so wide that predictions move by so much of their deviation in all.
CHANGE = 0.03
NARROWEST, FIRST_WIDTH, WIDEST = 1e-8, 1e-6, 1e-3
LAWS = {
    # Student's law with three degrees of freedom as a mixture, by its scale; variance one.
    "t3": (np.array([0.36, 0.44, 0.17, 0.03]), np.array([0.49, 0.86, 1.60, 3.6])),
    "outliers": (np.array([0.99, 0.01]), np.array([1.0, 10.0])),
}
WHITE = np.array([0.0, 0.0, 1.0, 1.0])


@dataclass(frozen=True)
class Truth:
    """A record and the model that made it.

    `free` holds for each uncertain parameter its value as given and the standard deviation of that
    belief, infinite where nothing is known; `scale` is the size of the bias.
    """

    plant: int
    p: np.ndarray
    e: np.ndarray
    at: np.ndarray
    x0: np.ndarray
    spread: np.ndarray
    sigma: float
    push: float
    colour: np.ndarray
    weights: np.ndarray
    ratios: np.ndarray
    free: dict[str, tuple[float, float]]
    scale: float
    u: np.ndarray = field(default_factory=lambda: np.zeros(0))
    y: np.ndarray = field(default_factory=lambda: np.zeros(0))

    def predict(self, theta: np.ndarray, e: np.ndarray, sizes: tuple[int, ...] = ()) -> tuple:
        """Return the predictions of a model; all zero is the truth, less what `e` lacks.

        In order: what the free parameters are off, relatively, then the logarithms of the noise's
        size and the force's, that of an autoregression's memory, and what the sizes of other
        effects are off, relatively.
        """
        names = op.PARAMETERS[self.plant]
        p, e, colour = self.p.copy(), e.copy(), self.colour.copy()
        for value, name in zip(theta, self.free, strict=False):
            k = names.index(name)
            p[k] = p[k] + self.scale * value if name == "b" else p[k] * np.exp(value)
        rest = theta[len(self.free) :]
        sigma, push = self.sigma * np.exp(rest[0]), self.push * np.exp(rest[1])
        rest = rest[2:]
        if 0 < colour[0] < 1:
            colour[0] = np.tanh(np.arctanh(colour[0]) + rest[0])
            rest = rest[1:]
        for k, value in zip(sizes, rest, strict=True):
            e[k] *= 1 + value
        return op.filter_record(self.plant, p, e, self.at, self.x0, self.spread, self.u, self.y,
                                sigma, push, colour, self.weights, self.ratios)  # fmt: skip

    def compute_belief(self, theta: np.ndarray) -> float:
        """Return what the free parameters cost by what is believed of them."""
        total = 0.0
        for value, (name, (given, deviation)) in zip(theta, self.free.items(), strict=False):
            if np.isfinite(deviation):
                true = self.p[op.PARAMETERS[self.plant].index(name)]
                total += 0.5 * ((true * np.exp(value) - given) / deviation) ** 2
        return total


def measure_worth(
    truth: Truth,
    without: np.ndarray,
    sizes: tuple[int, ...] = (),
    start: np.ndarray | None = None,
    right: Truth | None = None,
) -> tuple[float, np.ndarray]:
    """Return what the truth is worth beside the best model without an effect, and that model.

    Parameters
    ----------
    truth : Truth
        The record and what made it.
    without : ndarray
        The effects of the model that lacks one.
    sizes : tuple of int
        Indices of effects that the model has, whose sizes are refitted.
    start : ndarray, optional
        Where a single search begins, for a worth that is not needed exactly. By default several
        begin at the truth, with more and more random force: the noise has several optima.
    right : Truth, optional
        The truth, where `truth` has a wrong value of a parameter that is called exact.

    Returns
    -------
    worth : float
        The divergence [log-likelihood].
    theta : ndarray
        Where it is smallest.
    """
    m = len(truth.free) + 2 + int(0 < truth.colour[0] < 1) + len(sizes)
    right = right or truth
    own = right.predict(np.zeros(m), right.e, sizes)
    starts = [start] if start is not None else [np.zeros(m) for _ in PUSHES]
    if start is None:
        for theta, push in zip(starts, PUSHES, strict=True):
            theta[len(truth.free) + 1] = push
    found = [_climb(truth, own, without, sizes, theta) for theta in starts]
    best, theta = min(found, key=lambda pair: pair[0])
    if not np.isfinite(best) and start is not None:
        return measure_worth(truth, without, sizes, None, right)
    if not right.compute_belief(np.zeros(m)):
        return best, theta
    # What is believed moves the model that has the effect as well.
    within, _ = _climb(right, own, right.e, sizes, np.zeros(m))
    return max(best - within, 0.0), theta


def _climb(
    truth: Truth, own: tuple[np.ndarray, np.ndarray], without: np.ndarray,
    sizes: tuple[int, ...], theta: np.ndarray,
) -> tuple[float, np.ndarray]:  # fmt: skip
    """Return the smallest divergence near a point by Levenberg's steps, and where it is.

    The divergence is that from the predictions of the truth, `own`, to those of the model. Free
    parameters may nearly be one (two outlets in a row), so that the steps need slopes of many
    digits: the predictions are differenced, and the divergence is differentiated by hand.
    """
    m, k = len(theta), len(truth.free)
    low, high = np.full(m, -2.0), np.full(m, 2.0)
    low[k : k + 2], high[k : k + 2] = (-2.0, -9.0), (5.0, 9.0)
    biases = [i for i, name in enumerate(truth.free) if name == "b"]
    low[biases], high[biases] = -np.inf, np.inf
    theta = np.clip(theta, low, high)

    def compare(t: np.ndarray) -> tuple:
        other, variance = truth.predict(t, without, sizes)
        if not np.isfinite(other).all():
            return np.inf, other, variance, other, variance
        value, by_mean, by_variance = op.differentiate_divergence(
            *own, truth.weights, other, variance, truth.weights, op.NODES, op.MASSES
        )
        return value + truth.compute_belief(t), other, variance, by_mean, by_variance

    value, *there = compare(theta)
    damping, widths = 1e-3, np.full(m, WIDEST)
    widths[:k] = FIRST_WIDTH
    for _ in range(ROUNDS):
        if not np.isfinite(value):
            break
        slope, hessian = _compute_slopes(truth, theta, without, sizes, widths, *there)
        # What lies on a limit, and would go beyond, stays there.
        free = ~(((theta <= low) & (slope > 0)) | ((theta >= high) & (slope < 0)))
        free &= np.diag(hessian) > 0
        slope, hessian = slope[free], hessian[np.ix_(free, free)]
        widths[free] = np.clip(CHANGE / np.sqrt(np.diag(hessian)), NARROWEST, WIDEST)
        step = np.linalg.lstsq(hessian, slope, rcond=1e-14)[0]
        if 0.5 * slope @ step < ENOUGH * (1 + value / 5):
            break
        better = False
        for _ in range(TRIES):
            lifted = hessian + damping * np.diag(np.diag(hessian))
            new = theta.copy()
            new[free] = np.clip(theta[free] - np.linalg.solve(lifted, slope), low[free],
                                high[free])  # fmt: skip
            again = compare(new)
            if again[0] < value:
                better = True
                break
            damping *= 5
        if not better:
            break
        theta, (value, *there) = new, again
        damping = max(damping / 8, 1e-12)
    return value, theta


def _compute_slopes(
    truth: Truth, theta: np.ndarray, without: np.ndarray, sizes: tuple[int, ...],
    widths: np.ndarray, mean: np.ndarray, variance: np.ndarray, by_mean: np.ndarray,
    by_variance: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Return the slope of the divergence and belief, and the information of the predictions."""
    m = len(theta)
    slope, rows = np.zeros(m), np.zeros((m, 2 * len(by_mean)))
    for j in range(m):
        step = np.zeros(m)
        step[j] = widths[j]
        beyond, larger = truth.predict(theta + step, without, sizes)
        if not np.isfinite(beyond).all():
            continue
        moved, grown = (beyond - mean) / widths[j], (larger - variance) / widths[j]
        slope[j] = by_mean @ moved + np.sum(by_variance * grown)
        grown = np.sqrt(0.5) * grown[:, 0] / variance[:, 0]
        rows[j] = np.r_[moved / np.sqrt(variance[:, 0]), grown]
    hessian = rows @ rows.T
    for i, (name, (given, deviation)) in enumerate(truth.free.items()):
        if np.isfinite(deviation):
            there = truth.p[op.PARAMETERS[truth.plant].index(name)] * np.exp(theta[i])
            slope[i] += (there - given) * there / deviation**2
            hessian[i, i] += (there / deviation) ** 2
    return slope, hessian
