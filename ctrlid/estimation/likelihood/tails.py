"""Heavy tails of the sensor noise: their law, and what a robust filter makes of a wild reading."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from scipy import optimize, special, stats

from ..._base.arrays import Array

# Starts of the search: degrees of freedom, and shares of readings that are so many times as wild.
FREEDOMS = 2.5, 6.0
MIXTURES = (0.003, 10.0), (0.02, 6.0), (0.1, 3.0)
# With fewer degrees of freedom noise has no variance, with more it is Gaussian.
LEAST_FREEDOM, MOST_FREEDOM = 2.05, 100.0
# Wild readings are fewer than the others, and wilder.
MOST_SHARE, LEAST_RATIO, MOST_RATIO = 0.5, 1.5, 1e3
# The scale is found when it changes by less than this share.
SETTLED, STEPS = 1e-6, 200
# A secant with a larger slope than this one leads astray, and a plain step is taken.
STEEPEST = 0.9
# Expectations are sums over so many points, evenly spaced in the inverse hyperbolic sine.
POINTS, REACH = 4001, 12.0
# What the compiled filter takes for noise without heavy tails.
GAUSSIAN = 0.0, 0.0, 0.0, 0.0


@dataclass(frozen=True)
class Tails:
    r"""Heavy-tailed sensor noise: Student's law, or a share of wild readings.

    .. math:: p(z) \propto (1 + z^2/\nu)^{-(\nu+1)/2}, \quad
        p(z) = (1 - \varepsilon) N(z; 0, 1) + \varepsilon N(z; 0, \kappa^2)

    Parameters
    ----------
    freedom : float
        Degrees of freedom of Student's law; zero: the other law.
    share, ratio : float
        Share of the wild readings and how many times as large they are as the others.
    scale : float
        Variance of the usual readings, by which the filter weighs a wild one [output unit^2].

    References
    ----------
    Lange, Little and Taylor, Journal of the American Statistical Association 84 (1989) 881-896;
    Harvey, *Dynamic Models for Volatility and Heavy Tails* (2013), chapter 3.
    """

    freedom: float = 0.0
    share: float = 0.0
    ratio: float = 1.0
    scale: float = 1.0

    @property
    def parameters(self) -> int:
        """Number of parameters beyond those of Gaussian noise."""
        return 1 if self.freedom else 2

    @property
    def variance(self) -> float:
        """Variance of the noise, in units of the scale."""
        if self.freedom:
            return self.freedom / (self.freedom - 2)
        return 1 + self.share * (self.ratio**2 - 1)

    @property
    def numbers(self) -> Array:
        """What the compiled filter takes, in a row."""
        return np.array([[self.freedom, self.share, self.ratio, self.scale]])

    def compute_log_density(self, z: Array) -> Array:
        """Return the logarithm of the density of errors in units of the scale's root."""
        if self.freedom:
            half = (self.freedom + 1) / 2
            constant = special.gammaln(half) - special.gammaln(self.freedom / 2)
            constant -= 0.5 * math.log(self.freedom * math.pi)
            return np.asarray(constant - half * np.log1p(z**2 / self.freedom))
        usual = math.log1p(-self.share) - 0.5 * z**2
        wild = math.log(self.share / self.ratio) - 0.5 * (z / self.ratio) ** 2
        return np.asarray(np.logaddexp(usual, wild) - 0.5 * math.log(2 * math.pi))

    def compute_weight(self, z: Array) -> Array:
        """Return what an error counts for: the score of the law, divided by the error."""
        if self.freedom:
            return np.asarray((self.freedom + 1) / (self.freedom + z**2))
        odds = math.log(self.share / (1 - self.share) / self.ratio)
        wild = special.expit(odds + 0.5 * z**2 * (1 - self.ratio**-2))
        return np.asarray(1 - wild * (1 - self.ratio**-2))

    def normalize(self, z: Array) -> Array:
        """Return errors as standard normal deviates of the same probability."""
        size = np.abs(z)
        if self.freedom:
            beyond = stats.t.sf(size, self.freedom)
        else:
            beyond = (1 - self.share) * special.ndtr(-size)
            beyond += self.share * special.ndtr(-size / self.ratio)
        # Zero stands for what is too small to be written.
        return np.asarray(-np.sign(z) * special.ndtri(np.maximum(beyond, 1e-300)))

    def draw(self, normal: Array, seed: int | tuple[int, ...]) -> Array:
        """Return noise of the scale one, made of standard normal noise."""
        rng = np.random.default_rng([*(seed if isinstance(seed, tuple) else (seed,)), 2])
        if self.freedom:
            squares = rng.chisquare(self.freedom, len(normal))
            return np.asarray(normal * np.sqrt(self.freedom / squares))
        return np.where(rng.random(len(normal)) < self.share, self.ratio, 1.0) * normal

    def find_scale(self, squares: Array, start: float) -> float:
        r"""Return the likeliest variance of the usual errors, of squared errors.

        .. math:: \sigma^2 = \overline{w(e/\sigma)\, e^2}
        """
        return _find_scale(self, squares, start)


@dataclass(frozen=True)
class JointTails:
    """The sensor noise of several outputs, of which some have heavy tails of their own.

    Errors are columns, one of each output, in units of one scale: that of an output relative to
    the first is `Noise.sensors`.

    Parameters
    ----------
    each : tuple of Tails or None
        The law of each output, whose own scale is not used; None: it is Gaussian.
    scale : float
        Variance of the usual readings, relative to what each output has.
    """

    each: tuple[Tails | None, ...]
    scale: float = 1.0

    @property
    def parameters(self) -> int:
        """Number of parameters beyond those of Gaussian noise."""
        return sum(law.parameters for law in self.each if law is not None)

    @property
    def numbers(self) -> Array:
        """What the compiled filter takes, with a row for each output."""
        laws = [Tails(scale=self.scale) if law is None else law for law in self.each]
        return np.array([(law.freedom, law.share, law.ratio, self.scale) for law in laws])

    def reorder(self, order: Sequence[int]) -> "JointTails":
        """Return the same for outputs in another order."""
        return replace(self, each=tuple(self.each[k] for k in order))

    def choose(self, keep: Any) -> "FlatTails":
        """Return the law of those errors alone for which `keep` holds, in one row."""
        return FlatTails(self.each, self.scale, np.nonzero(keep)[1])

    def compute_weight(self, z: Array) -> Array:
        """Return what errors count for, as `Tails` does."""
        return self._apply("compute_weight", z)

    def normalize(self, z: Array) -> Array:
        """Return errors as standard normal deviates, as `Tails` does."""
        return self._apply("normalize", z)

    def _apply(self, method: str, z: Array) -> Array:
        flat: Array = getattr(self.choose(np.ones(z.shape, dtype=bool)), method)(z.ravel())
        return flat.reshape(z.shape)


@dataclass(frozen=True, eq=False)
class FlatTails:
    """The law of errors of several outputs in one row; `output` says of which output each is."""

    each: tuple[Tails | None, ...]
    scale: float
    output: Any = field(repr=False)

    def compute_log_density(self, z: Array) -> Array:
        """Return the logarithm of the density of errors, as `Tails` does."""
        return self._apply("compute_log_density", z, -0.5 * z**2 - 0.5 * math.log(2 * math.pi))

    def compute_weight(self, z: Array) -> Array:
        """Return what errors count for, as `Tails` does."""
        return self._apply("compute_weight", z, np.ones_like(z))

    def normalize(self, z: Array) -> Array:
        """Return errors as standard normal deviates, as `Tails` does."""
        return self._apply("normalize", z, z)

    def find_scale(self, squares: Array, start: float) -> float:
        """Return the likeliest variance of the usual errors of all outputs, as `Tails` does."""
        return _find_scale(self, squares, start)

    def _apply(self, method: str, z: Array, gaussian: Array) -> Array:
        found = np.array(gaussian)
        for law, mine in self.heavy:
            found[mine] = getattr(law, method)(z[mine])
        return found

    @cached_property
    def heavy(self) -> list[tuple[Tails, Any]]:
        """The laws with heavy tails, each with the places of its errors in the row."""
        laws = enumerate(self.each)
        return [(law, np.flatnonzero(self.output == k)) for k, law in laws if law is not None]


def choose_law(tails: Tails | JointTails | None, keep: Any) -> Tails | FlatTails | None:
    """Return the law of those errors for which `keep` holds, in one row; None: it is Gaussian."""
    return tails.choose(keep) if isinstance(tails, JointTails) else tails


def _find_scale(law: Tails | FlatTails, squares: Array, start: float) -> float:
    """Return the likeliest variance of the usual errors; see `Tails.find_scale`.

    The fixed point is found by secants (Wegstein): plain iteration takes about thrice as many
    steps.
    """
    scale = before = previous = start
    for step in range(STEPS):
        old = max(scale, 1e-300)
        found = float(np.mean(law.compute_weight(np.sqrt(squares / old)) * squares))
        if abs(found - old) <= SETTLED * old:
            return found
        scale = found
        if step and before != old:
            slope = (found - previous) / (old - before)
            further = (found - slope * old) / (1 - slope) if slope < STEEPEST else 0.0
            scale = further if further > 0 else found
        before, previous = old, found
    return scale


def compute_information_shares(tails: Tails | JointTails | None) -> tuple[Any, Any]:
    """Return what samples tell of a mean and of a scale, relative to samples of Gaussian noise.

    Of several outputs, for each of them.
    """
    if isinstance(tails, JointTails):
        mean, scale = np.transpose([_compute_shares(law) for law in tails.each])
        return mean, scale
    return _compute_shares(tails)


@lru_cache(maxsize=64)
def _compute_shares(tails: Tails | None) -> tuple[float, float]:
    if tails is None:
        return 1.0, 1.0
    grid, step = np.linspace(-REACH, REACH, POINTS, retstep=True)
    z = np.sinh(grid)
    chance = np.exp(tails.compute_log_density(z)) * np.cosh(grid) * step
    w = tails.compute_weight(z)
    mean = float(np.sum(chance * (w * z) ** 2))
    return mean, float(0.5 * np.sum(chance * (w * z**2 - 1) ** 2))


def fit_tails(tails: Tails, squares: Array, logs: float) -> tuple[Tails, float]:
    """Return the likeliest tails of the same kind, and their log-likelihood.

    Parameters
    ----------
    tails : Tails
        Where to begin.
    squares : ndarray, shape (n,)
        Squared errors over their variances, relative to the sensor noise's [output unit^2].
    logs : float
        Half the sum of the logarithms of these variances.
    """
    size = len(squares)

    def make(x: Array) -> Tails:
        if tails.freedom:
            freedom = 2 + math.exp(min(max(x[0], -9.0), 9.0))
            return Tails(freedom=min(max(freedom, LEAST_FREEDOM), MOST_FREEDOM), scale=tails.scale)
        share = MOST_SHARE * float(special.expit(x[0]))
        ratio = min(max(1 + math.exp(min(x[1], 9.0)), LEAST_RATIO), MOST_RATIO)
        return Tails(share=max(share, 0.1 / size), ratio=ratio, scale=tails.scale)

    def measure(law: Tails) -> tuple[float, float]:
        scale = max(law.find_scale(squares, tails.scale), 1e-300)
        density = law.compute_log_density(np.sqrt(squares / scale))
        return float(np.sum(density)) - 0.5 * size * math.log(scale) - logs, scale

    if tails.freedom:
        start = np.array([math.log(tails.freedom - 2)])
    else:
        # At a limit the logarithm is infinite, from which no search goes on.
        share = min(tails.share / MOST_SHARE, 1 - 1e-6)
        start = np.array([special.logit(share), math.log(tails.ratio - 1)])
    minimize: Any = optimize.minimize
    found = minimize(
        lambda x: -measure(make(x))[0], start, method="Nelder-Mead",
        options={"xatol": 0.01, "fatol": 0.01, "maxfev": 80},
    )  # fmt: skip
    law = make(found.x)
    value, scale = measure(law)
    return Tails(law.freedom, law.share, law.ratio, scale), value


def list_tails(squares: Array) -> list[Tails]:
    """Return heavy tails to begin a search with, for squared errors over their variances."""
    scale = max(float(np.median(squares)) / float(stats.chi2.median(1)), 1e-300)
    return [*(Tails(freedom=v, scale=scale) for v in FREEDOMS),
            *(Tails(share=s, ratio=k, scale=scale) for s, k in MIXTURES)]  # fmt: skip
