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

ROUNDS = 25
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
        Where the search begins.
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
    best, theta = np.inf, np.zeros(m)
    for first in (start, np.zeros(m)):
        if first is None or np.isfinite(best):
            continue
        best, theta = _climb(truth, own, without, sizes, first)
    if not right.compute_belief(np.zeros(m)):
        return best, theta
    # What is believed moves the model that has the effect as well.
    within, _ = _climb(right, own, right.e, sizes, np.zeros(m))
    return max(best - within, 0.0), theta


def _climb(
    truth: Truth, own: tuple[np.ndarray, np.ndarray], without: np.ndarray,
    sizes: tuple[int, ...], theta: np.ndarray,
) -> tuple[float, np.ndarray]:  # fmt: skip
    """Return the smallest divergence near a point by damped Gauss-Newton steps, and where it is.

    The divergence is that from the predictions of the truth, `own`, to those of the model.
    """
    m, width = len(theta), 1e-5
    low, high = np.full(m, -2.0), np.full(m, 2.0)
    k = len(truth.free)
    low[k : k + 2], high[k : k + 2] = (-2.0, -9.0), (5.0, 9.0)
    high[[i for i, name in enumerate(truth.free) if name == "b"]] = 20.0
    low[[i for i, name in enumerate(truth.free) if name == "b"]] = -20.0

    def cost(t):
        other, variance = truth.predict(t, without, sizes)
        if not np.isfinite(other).all():
            return np.inf, other, variance
        value = op.sum_divergence(own[0], own[1], truth.weights, other, variance, truth.weights,
                                  op.NODES, op.MASSES)  # fmt: skip
        return value + truth.compute_belief(t), other, variance

    value, mean, variance = cost(theta)
    damping = 1e-3
    for _ in range(ROUNDS):
        if not np.isfinite(value):
            break
        slope, rows = np.zeros(m), []
        for j in range(m):
            step = np.zeros(m)
            step[j] = width
            up, mean_up, variance_up = cost(theta + step)
            if not np.isfinite(up):
                rows.append(np.zeros(2 * len(mean)))
                continue
            slope[j] = (up - value) / width
            rows.append(np.r_[
                (mean_up - mean) / np.sqrt(variance[:, 0]),
                np.sqrt(0.5) * (variance_up[:, 0] - variance[:, 0]) / variance[:, 0],
            ] / width)  # fmt: skip
        rows = np.array(rows)
        hessian = rows @ rows.T
        for i, (_, deviation) in enumerate(truth.free.values()):
            if np.isfinite(deviation):
                given = list(truth.free.values())[i][0]
                hessian[i, i] += (given / deviation) ** 2
        better = False
        for _ in range(8):
            lifted = hessian + damping * np.diag(np.diag(hessian)) + 1e-9 * np.eye(m)
            new = np.clip(theta - np.linalg.solve(lifted, slope), low, high)
            again, mean_new, variance_new = cost(new)
            if again < value:
                better = True
                break
            damping = max(4 * damping, 1e-3)
        if not better:
            break
        gained = value - again
        theta, value, mean, variance = new, again, mean_new, variance_new
        damping = max(damping / 6, 1e-7)
        if gained < 0.01 + 2e-3 * value:
            break
    return value, theta
