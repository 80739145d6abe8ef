"""What `fit_loop` returns: physical parameters, how well they are known, and the loop with them."""

from dataclasses import dataclass, replace
from typing import Any

import control as ct
import numpy as np
from scipy.stats import norm

from ..._base.arguments import check_arguments
from ..._base.arrays import Array, freeze_arrays, read_only
from ..._base.criterion import bayesian_penalty
from ..._base.errors import CtrlidError
from ..._base.text import Printed, write_number, write_quantity
from ...loop.loop import Loop
from ...physics.linearization import make_state_space, operating_point
from ..identified_model import compute_root_errors


@dataclass(frozen=True, eq=False, repr=False)
class LoopEstimate(Printed):
    """Physical parameters, their uncertainty and the noise that was found with them.

    Parameters
    ----------
    names : tuple of str
        The parameters that were fitted.
    values : ndarray, shape (p,)
        Their values [unit of each parameter].
    covariance : ndarray, shape (p, p)
        Their covariance [products of units], from the exact information matrix; infinite for what
        is not in the data.
    sensor_noise : tuple of float
        Standard deviation of the white sensor noise in each record [output unit]; of several
        outputs, a tuple for each record.
    force_noise : float or tuple of float
        Standard deviation of the white acceleration that is held over each period
        [output unit/s^2]; for a plant without a moving mass, of the noise on the states' rates. For
        a plant with several signals one for each velocity, in the unit of the force that works on
        it (`Loop.forces`).
    coloured_force : float
        Standard deviation of the coloured acceleration [output unit/s^2]; zero: none was needed.
    force_time : float
        Time constant of the coloured acceleration [s]; NaN without one.
    log_likelihood : float
        Logarithm of the likelihood.
    n_samples : int
        Samples that count.
    active : tuple of str
        The parameters that sit on a bound.
    notes : tuple of str
        What the user should know before believing the numbers.
    units : (str, str)
        Units of the sensor noise and of the force noise; empty where neither the record nor the
        plant has one.
    """

    names: tuple[str, ...]
    values: Array
    covariance: Array
    sensor_noise: tuple[Any, ...]
    force_noise: Any
    coloured_force: float
    force_time: float
    log_likelihood: float
    n_samples: int
    active: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    units: tuple[Any, Any] = ("", "")

    def __post_init__(self) -> None:
        freeze_arrays(self)

    @property
    @read_only
    def standard_errors(self) -> Array:
        """Standard errors of the parameters."""
        return np.asarray(np.sqrt(np.diag(self.covariance)), dtype=float)

    @property
    def bic(self) -> float:
        """Bayesian information criterion, smaller is better."""
        extra = len(self.names) + 2 * (self.coloured_force > 0)
        return -2 * self.log_likelihood + 2 * bayesian_penalty(extra, self.n_samples)

    def __getitem__(self, name: str) -> float:
        if name not in self.names:
            raise CtrlidError(f"{name!r} was not fitted; fitted were {', '.join(self.names)}")
        return float(self.values[self.names.index(name)])

    def confidence_interval(self, name: str, level: float = 0.95) -> tuple[float, float]:
        """Return the interval that covers the true value of a parameter with a probability.

        Parameters
        ----------
        name : str
            A fitted parameter.
        level : float, optional
            The probability, between 0 and 1, for normally distributed errors.

        Returns
        -------
        lower, upper : float
            Lower and upper end [unit of the parameter].

        Raises
        ------
        CtrlidError
            If the parameter was not fitted or the level is no probability.
        """
        check_arguments(LoopEstimate.confidence_interval, locals())
        if not 0.0 < level < 1.0:
            raise CtrlidError(f"A confidence level lies between 0 and 1; given {level!r}.")
        middle = self[name]
        half = float(norm.ppf((1 + level) / 2)) * self.standard_errors[self.names.index(name)]
        return float(middle - half), float(middle + half)

    def __str__(self) -> str:
        rows = [f"fit by maximum likelihood, {self.n_samples} samples used, log-likelihood "
                f"{self.log_likelihood:.1f}"]  # fmt: skip
        width = max((len(name) for name in self.names), default=0)
        for name, value, error in zip(self.names, self.values, self.standard_errors, strict=True):
            bound = name in self.active
            shown = (
                write_number(value, 6) if bound else write_quantity(value, error=error, digits=6)
            )
            rows.append(f"  {name:<{width}} = {shown}{' (on its bound)' if bound else ''}")
        size, push = self.units
        noise = ", ".join(_write_sizes(v, size) for v in self.sensor_noise)
        rows.append(f"  standard deviation of the sensor noise: {noise}; of the white force: "
                    f"{_write_sizes(self.force_noise, push)}")  # fmt: skip
        if self.coloured_force:
            rows.append(f"  standard deviation of the coloured force: "
                        f"{_write_size(self.coloured_force, push)}, with a time constant of "
                        f"{write_number(self.force_time, 3)} s")  # fmt: skip
        return "\n".join([*rows, *(f"  note: {note}" for note in self.notes)])


def _write_sizes(values: Any, units: Any) -> str:
    """Return a size with its unit, or several with theirs."""
    if not isinstance(values, tuple):
        return _write_size(values, units)
    return " and ".join(_write_size(v, u) for v, u in zip(values, units, strict=True))


def _write_size(value: float, unit: str) -> str:
    return f"{write_number(value, 3)} {unit}".strip()


@dataclass(frozen=True, eq=False, repr=False)
class LoopFit(Printed):
    """What `fit_loop` returns.

    Parameters
    ----------
    loop : Loop
        The loop with the fitted values.
    estimate : LoopEstimate
        Values, standard errors and noise.
    """

    loop: Loop
    estimate: LoopEstimate

    @property
    def model(self) -> Any:
        """The plant with its effects, linearized where it rests at the loop's output."""
        return linearize_at_rest(self.loop)

    @property
    @read_only
    def poles(self) -> Any:
        """The poles of `model`, in rad/s (in z for a plant in discrete time)."""
        return np.roots(_find_denominator(self.model)).astype(complex)

    @property
    @read_only
    def poles_standard_errors(self) -> Array:
        """The standard errors of `poles`, by the delta method.

        The denominator is differenced along each fitted parameter; the operating point moves with
        it. Infinite where a pole depends on a parameter that the data do not determine.
        """
        estimate, values = self.estimate, self.estimate.values
        slopes = []
        for name, value, error in zip(
            estimate.names, values, estimate.standard_errors, strict=True
        ):
            h = 1e-4 * abs(value) or 1e-2 * (error if np.isfinite(error) else 1.0)
            if name in estimate.active or h == 0:
                slopes.append(np.zeros(len(self.poles)))
                continue
            ends = [
                linearize_at_rest(self.loop.with_parameters({name: value + d})) for d in (h, -h)
            ]
            above, below = (_find_denominator(end) for end in ends)
            slopes.append((above - below)[1:] / (2 * h))
        slope = np.column_stack(slopes)
        lost = ~np.isfinite(estimate.standard_errors)
        if np.any(slope[:, lost] != 0):
            return np.full(len(slope), np.inf)
        covariance = np.where(np.outer(~lost, ~lost), estimate.covariance, 0.0)
        return compute_root_errors(self.poles, slope @ covariance @ slope.T)

    def __str__(self) -> str:
        return f"{self.loop!r}\n{self.estimate}"


def _find_denominator(model: Any) -> Any:
    """Return the denominator of a linear model."""
    return np.poly(model.A) if isinstance(model, ct.StateSpace) else model.den[0][0]


def linearize_at_rest(loop: Loop, states: bool = False) -> Any:
    """Return the linear model at the loop's output, with input and states solved for anew.

    Parameters
    ----------
    loop : Loop
        The loop.
    states : bool, optional
        Whether to keep the states of the plant, as `Loop.linearize` does.

    Returns
    -------
    control.TransferFunction or control.StateSpace
        The model.
    """
    e = loop.equations()
    if not e.siso:
        # The outputs stay; the input that holds them there depends on the parameters.
        if loop.effects or loop.linear_plant:
            return loop.linearize()
        return make_state_space(e, operating_point(e, output=loop.point.output, guess=loop.point))
    if not loop.linear_plant:
        assert loop.at is not None
        at = operating_point(loop.plant, output=loop.at.output, guess=loop.at)
        loop = replace(loop, at=at)
    return loop.linearize(states=states)
