"""Physical parameters, how well they are known, and the loop with them: what fits return."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import control as ct
import numpy as np
from scipy.stats import norm

from ..._base.arguments import check_arguments
from ..._base.arrays import Array, freeze_arrays, read_only
from ..._base.criterion import bayesian_penalty
from ..._base.errors import CtrlidError
from ..._base.text import (
    Printed,
    write_count,
    write_list,
    write_noises,
    write_number,
    write_quantity,
)
from ...loop.loop import Loop, write_loop
from ...physics.linearization import make_state_space, operating_point
from ..root_errors import compute_root_errors

# A direction of which the scaled information has a smaller relative eigenvalue is not in the data.
UNSEEN = 1e-9
# A parameter that a fit has moved by more than this factor is hardly one of the plant.
ABSURD = 1000.0


@dataclass(frozen=True, eq=False, repr=False)
class ParameterEstimate(Printed):
    """Physical parameters and how well they are known; what fits share.

    Parameters
    ----------
    names : tuple of str
        The parameters that were fitted.
    values : ndarray, shape (p,)
        Their values [unit of each parameter].
    covariance : ndarray, shape (p, p)
        Their covariance [products of units]; infinite for what is not in the data.
    """

    names: tuple[str, ...]
    values: Array
    covariance: Array

    def __post_init__(self) -> None:
        freeze_arrays(self)

    @property
    @read_only
    def standard_errors(self) -> Array:
        """Standard errors of the parameters."""
        return np.asarray(np.sqrt(np.diag(self.covariance)), dtype=float)

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
        check_arguments(ParameterEstimate.confidence_interval, locals())
        if not 0.0 < level < 1.0:
            raise CtrlidError(f"A confidence level lies between 0 and 1; given {level!r}.")
        middle = self[name]
        half = float(norm.ppf((1 + level) / 2)) * self.standard_errors[self.names.index(name)]
        return float(middle - half), float(middle + half)

    def _list_rows(self, active: tuple[str, ...]) -> list[str]:
        """Return a line for each parameter."""
        rows, width = [], max((len(name) for name in self.names), default=0)
        for name, value, error in zip(self.names, self.values, self.standard_errors, strict=True):
            bound = name in active
            shown = (
                write_number(value, 6) if bound else write_quantity(value, error=error, digits=6)
            )
            rows.append(f"  {name:<{width}} = {shown}{' (on its bound)' if bound else ''}")
        return rows


@dataclass(frozen=True, eq=False, repr=False)
class LoopEstimate(ParameterEstimate):
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
    places : (tuple of str, tuple of str)
        Of several signals, the output of each sensor noise and the velocity that each force works
        on; without a moving mass, the state whose rate it is.
    """

    sensor_noise: tuple[Any, ...]
    force_noise: Any
    coloured_force: float
    force_time: float
    log_likelihood: float
    n_samples: int
    active: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    units: tuple[Any, Any] = ("", "")
    places: tuple[tuple[str, ...], tuple[str, ...]] = ((), ())

    @property
    def bic(self) -> float:
        """Bayesian information criterion, smaller is better."""
        extra = len(self.names) + 2 * (self.coloured_force > 0)
        return -2 * self.log_likelihood + 2 * bayesian_penalty(extra, self.n_samples)

    def __str__(self) -> str:
        rows = [f"fit by maximum likelihood, {write_count(self.n_samples, 'sample')} used, "
                f"log-likelihood "
                f"{self.log_likelihood:.1f}"]  # fmt: skip
        rows += self._list_rows(self.active)
        size, push = self.units
        outputs, velocities = self.places
        noise = ", ".join(write_noises(v, size, outputs) for v in self.sensor_noise)
        rows.append(f"  standard deviation of the sensor noise: {noise}; of the white force: "
                    f"{write_noises(self.force_noise, push, velocities, '/s')}")  # fmt: skip
        if self.coloured_force:
            rows.append(f"  standard deviation of the coloured force: "
                        f"{_write_size(self.coloured_force, push)}, with a time constant of "
                        f"{write_number(self.force_time, 3)} s")  # fmt: skip
        return "\n".join([*rows, *(f"  note: {note}" for note in self.notes)])


@dataclass(frozen=True, eq=False, repr=False)
class SimulationEstimate(ParameterEstimate):
    """Physical parameters that make a simulation follow the record, and what it leaves.

    Parameters
    ----------
    names : tuple of str
        The parameters that were fitted.
    values : ndarray, shape (p,)
        Their values [unit of each parameter].
    covariance : ndarray, shape (p, p)
        Their covariance [products of units], which allows for correlated errors; infinite for what
        is not in the data.
    errors : tuple of float
        Root mean square error of the simulation of each output [output unit].
    n_samples : int
        Values of outputs that count.
    active : tuple of str
        The parameters that sit on a bound.
    notes : tuple of str
        What the user should know before believing the numbers.
    units : str or tuple of str
        Units of the errors; empty where neither the record nor the plant has one.
    """

    errors: tuple[float, ...]
    n_samples: int
    active: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    units: Any = ""

    def __str__(self) -> str:
        rows = [f"fit by the error of the simulation, {write_count(self.n_samples, 'sample')} used"]
        rows += self._list_rows(self.active)
        units = self.units if isinstance(self.units, tuple) else (self.units,)
        rows.append(f"  root mean square error of the simulation: "
                    f"{write_noises(self.errors, units)}")  # fmt: skip
        return "\n".join([*rows, *(f"  note: {note}" for note in self.notes)])


def _write_size(value: float, unit: str) -> str:
    return f"{write_number(value, 3)} {unit}".strip()


@dataclass(frozen=True, eq=False, repr=False)
class LoopFit(Printed):
    """What `fit_loop` and `fit_simulation` return.

    Parameters
    ----------
    loop : Loop
        The loop with the fitted values.
    estimate : LoopEstimate or SimulationEstimate
        Values, standard errors, and the noise or the errors that were found with them.
    """

    loop: Loop
    estimate: Any

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
        return f"{write_loop(self.loop)}\n{self.estimate}"


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


def note_absurd_values(
    names: Sequence[str], starts: Mapping[str, float], values: Array, errors: Array
) -> tuple[str, ...]:
    """Return a note of parameters that are absurdly far from where a fit began; empty without one.

    A friction that began at a trace, or that may be none, is told by its standard error.

    Parameters
    ----------
    names : sequence of str
        The parameters.
    starts : mapping of str to float
        Their values before the fit; those without one, or of zero, are passed over.
    values : ndarray, shape (p,)
        Their values now.
    errors : ndarray, shape (p,)
        Their standard errors.

    Returns
    -------
    tuple of str
        The note, if there is one.
    """
    far = [
        f"{name} = {value:.4g} in place of {start:.4g}"
        for name, value, error in zip(names, values.tolist(), errors.tolist(), strict=True)
        if (start := starts.get(name, 0.0)) and abs(value) > ABSURD * abs(start)
        and not abs(value) < 2 * error < math.inf
    ]  # fmt: skip
    if not far:
        return ()
    return (
        f"ABSURDLY FAR FROM THE START: {write_list(far)}. The fit has lost the record, or the "
        "record says nothing of this. Check that each column is the signal that the loop takes it "
        "for, with its sign and unit: audit(record, loop) compares them with the controller of the "
        "loop, where it has one",
    )


def mark_unseen(
    covariance: Array, matrix: Array, inside: Any, names: tuple[str, ...]
) -> tuple[Array, tuple[str, ...]]:
    """Return a covariance that is infinite for what is not in the data, and a note of it.

    Parameters
    ----------
    covariance : ndarray, shape (p, p)
        Covariance of the parameters.
    matrix : ndarray, shape (q, q)
        Information of the parameters, and of what was fitted with them.
    inside : ndarray of bool, shape (q,)
        Which of them are not on a bound.
    names : tuple of str
        The parameters.

    Returns
    -------
    covariance : ndarray, shape (p, p)
        The covariance.
    notes : tuple of str
        The note, if there is one.
    """
    p, covariance = len(names), covariance.copy()
    rows = np.flatnonzero(inside & (np.diag(matrix) > 0))
    lost = [k for k in range(p) if inside[k] and (matrix[k, k] <= 0 or is_unseen(matrix, rows, k))]
    for k in lost:
        covariance[k, :] = covariance[:, k] = 0.0
        covariance[k, k] = math.inf
    if not lost:
        return covariance, ()
    return covariance, (
        f"THE DATA DO NOT DETERMINE {write_list([names[k] for k in lost])}: other parameters can "
        f"compensate a change of {'them' if len(lost) > 1 else 'it'}",
    )


def is_unseen(matrix: Array, rows: Any, k: int) -> bool:
    """Return whether a parameter takes part in a direction that is not in the data."""
    if k not in rows:
        return False
    part = matrix[np.ix_(rows, rows)]
    size = np.sqrt(np.diag(part))
    values, vectors = np.linalg.eigh(part / np.outer(size, size))
    weak = vectors[list(rows).index(k), values < UNSEEN * values.max()]
    return bool(np.any(np.abs(weak) > 0.1))
