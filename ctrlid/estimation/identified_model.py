"""What a fit returns: a python-control transfer function that knows how well it is known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import control
import numpy as np
from scipy.linalg import block_diag
from scipy.special import binom
from scipy.stats import t as student_t

from .._base import text as _text
from .._base.arguments import check_arguments
from .._base.arrays import Array, ComplexArray, read_only
from .._base.errors import CtrlidError
from ..physics.conversions import reduce_states, to_transfer_function
from .root_errors import RESOLVED, compute_root_errors, find_coincident

# Fewer states stand for a model whose frequency response they change by at most this share.
NEAR = 0.2
# The responses are compared at so many frequencies.
FREQUENCIES = 60


@dataclass(frozen=True)
class Structure:
    """Orders of a transfer function and the names of its coefficients.

    ``domain="z"``: ``A(z) = z^na + a1 z^(na-1) + ... + a_na``, and
    ``b1 z^-nk + ... + b_nb z^-(nk+nb-1)`` over ``1 + a1 z^-1 + ... + a_na z^-na``.

    ``domain="s"``: ``b1 s^(nb-1) + ... + b_nb`` over ``s^na + a1 s^(na-1) + ... + a_na``; ``nk``
    plays no part.

    Parameters
    ----------
    na, nb : int
        Number of denominator and of numerator coefficients.
    nk : int
        Delay from input to output in samples.
    domain : {"z", "s"}
        Sampled or continuous time.
    inputs : tuple of str
        Names of several inputs, each with a numerator of its own; empty for a single one.

    Examples
    --------
    >>> Structure(na=2, nb=2).names
    ('a1', 'a2', 'b1', 'b2')
    >>> Structure(na=1, nb=1, inputs=("F1", "F2")).names
    ('a1', 'b1[F1]', 'b1[F2]')
    """

    na: int
    nb: int
    nk: int = 1
    domain: Literal["z", "s"] = "z"
    inputs: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the coefficients, in the order of the vector theta of the paper's (7)."""
        a = (f"a{i}" for i in range(1, self.na + 1))
        numbers = range(1, self.nb + 1)
        if not self.inputs:
            return (*a, *(f"b{i}" for i in numbers))
        return (*a, *(f"b{i}[{name}]" for name in self.inputs for i in numbers))

    @property
    def numerators(self) -> tuple[slice, ...]:
        """Where in the vector of coefficients the numerator of each input is."""
        starts = range(self.na, self.na + self.nb * max(len(self.inputs), 1), self.nb)
        return tuple(slice(i, i + self.nb) for i in starts)

    @property
    def span(self) -> int:
        """Samples in succession that one equation needs."""
        return max(self.na, self.nk + self.nb - 1) + 1

    def vector(self, weights: Mapping[str, float], who: str = "A constraint") -> Array:
        """Return weights by name as a ``(na + nb,)`` vector; unknown names are refused."""
        row = np.zeros(len(self.names))
        for name, weight in weights.items():
            if name not in self.names:
                raise CtrlidError(
                    f"{who} uses {name!r}, but this model has no such coefficient; it has "
                    f"{', '.join(self.names)}."
                )
            row[self.names.index(name)] = weight
        return row

    def fraction(self, theta: Array, which: int = 0) -> tuple[Array, Array]:
        """Return an input's numerator, and the denominator, in falling powers of z (or s)."""
        denominator = np.concatenate([[1.0], theta[: self.na]])
        numerator = np.asarray(theta[self.numerators[which]], dtype=float)
        if self.domain == "s":
            return numerator, denominator
        # Both polynomials in z^-1 are multiplied by the same z^m.
        m = max(self.na, self.nk + self.nb - 1)
        numerator = np.concatenate([numerator, np.zeros(m - self.nk - self.nb + 1)])
        return numerator, np.concatenate([denominator, np.zeros(m - self.na)])


@dataclass(frozen=True)
class ActiveBound:
    """An inequality on which the estimate sits.

    Parameters
    ----------
    row : str
        The inequality, for instance ``"a1 <= -2"``.
    constraint : str
        The constraint it comes from, as the user wrote it.
    quantity : str
        What is bounded, for instance ``"a1"``.
    bound : float
        The value it is held at.
    free : float
        The value it would take if no inequality held it back; NaN where that is not known.
    unstable : bool
        Whether the constraint says that the plant is unstable, as a pair of poles ±p does.
    """

    row: str
    constraint: str
    quantity: str
    bound: float
    free: float
    unstable: bool = False

    def __str__(self) -> str:
        return f"{self.row} [{self.constraint}]"


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class Estimate(_text.Printed):
    """Coefficients of a fitted model, their uncertainty, and how they were found.

    The covariance is ``sigma^2 Z (Z' R'R Z)^-1 Z'`` with ``Z`` the directions that the constraints
    leave free, and R what the estimator of `method` regresses on. Those of `fit_arx` hold only if
    the equation error is white (uncorrelated from sample to sample): in closed loop with sensor
    noise it is not, the coefficients are biased as well, and the standard errors are too small.
    Those of `fit_iv` and `fit_continuous` hold under feedback.

    Parameters
    ----------
    structure : Structure
        Orders and names of the coefficients.
    values : (p,) array
        The coefficients ``a1 .. a_na, b1 .. b_nb``.
    covariance : (p, p) array
        Their covariance, in products of their units; zero for what a constraint or an active bound
        fixes.
    intercepts : (records,) array
        The constant of each record, in units of the output.
    rss, residual_variance : float
        Sum of squared equation errors, and that divided by the degrees of freedom.
    n_samples, degrees_of_freedom : int
        Rows used, and rows less what was estimated.
    active_bounds : tuple of ActiveBound
        The inequalities on which the estimate sits.
    branch : str
        Which alternative won where a constraint has several, for instance ``"a1 <= -2"``.
    method, solver : str
        What was minimised, and by which road the minimum was found and checked.
    dt : float
        Sampling period in seconds; 0 for a continuous model, as in python-control.
    condition : float
        Condition number of the scaled regression that was solved.
    notes : tuple of str
        What the user should know before believing the numbers.
    errors : {"equation error", "prediction error"}
        What the residuals are: those of the ARX equation, or of the output's prediction.
    delay, delay_error : float
        Delay of the input [s] and its standard error, zero for one that was not fitted.
    delay_covariance : (p,) array
        Covariance of a fitted delay with each coefficient; empty for one that was not.
    """

    structure: Structure
    values: Array
    covariance: Array
    intercepts: Array
    rss: float
    residual_variance: float
    n_samples: int
    degrees_of_freedom: int
    active_bounds: tuple[ActiveBound, ...] = ()
    branch: str = ""
    method: str
    solver: str
    dt: float
    condition: float
    notes: tuple[str, ...] = ()
    errors: Literal["equation error", "prediction error"] = "prediction error"
    delay: float = 0.0
    delay_error: float = 0.0
    delay_covariance: Array = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        for name in ("values", "covariance", "intercepts", "delay_covariance"):
            array = np.array(getattr(self, name), dtype=float)
            array.setflags(write=False)
            object.__setattr__(self, name, array)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the coefficients."""
        return self.structure.names

    @property
    def active(self) -> tuple[str, ...]:
        """The inequalities on which the estimate sits, by name."""
        return tuple(str(bound) for bound in self.active_bounds)

    @property
    @read_only
    def standard_errors(self) -> Array:
        """Standard errors of the coefficients, valid for white equation error only."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))

    def __getitem__(self, name: str) -> float:
        return float(self.values[self._find_index(name)])

    def _find_index(self, name: str) -> int:
        if name not in self.names:
            raise CtrlidError(f"No coefficient {name!r}: this model has {', '.join(self.names)}.")
        return self.names.index(name)

    def confidence_interval(self, name: str, level: float = 0.95) -> tuple[float, float]:
        """Return the interval that covers a coefficient with the given probability (Student's t).

        Parameters
        ----------
        name : str
            Coefficient, for instance ``"a1"``, or ``"delay"``, which is never negative.
        level : float
            Probability, between 0 and 1.

        Returns
        -------
        lower, upper : float
            Both equal to the value where a constraint fixes the coefficient.
        """
        check_arguments(Estimate.confidence_interval, locals())
        if not 0.0 < level < 1.0:
            raise CtrlidError(f"A confidence level lies between 0 and 1; given {level!r}.")
        half = float(student_t.ppf(0.5 + level / 2, self.degrees_of_freedom))
        if name == "delay":
            half *= self.delay_error
            return max(self.delay - half, 0.0), self.delay + half
        half *= float(self.standard_errors[self._find_index(name)])
        return self[name] - half, self[name] + half

    @property
    def _shifted_poles(self) -> ComplexArray:
        """Roots of A(1 + x): poles near z = 1, where fast sampling puts them, stay accurate."""
        _, a = self.structure.fraction(self.values)
        a = a[: self.structure.na + 1]
        if self.structure.domain == "s":
            return np.roots(a).astype(complex)
        n = self.structure.na
        power = np.arange(n + 1)
        # Column i of the Taylor shift holds the coefficients of (1 + x)^i.
        shifted = binom(power[None, :], power[:, None]) @ a[::-1]
        return np.roots(shifted[::-1]).astype(complex)

    @property
    @read_only
    def poles(self) -> ComplexArray:
        """The na roots of A, in z for a sampled model and in s for a continuous one."""
        return self._shifted_poles + (1.0 if self.structure.domain == "z" else 0.0)

    @property
    @read_only
    def poles_s(self) -> ComplexArray:
        """The poles in the s-plane, ``log(z) / dt`` for a sampled model, in rad/s."""
        if self.structure.domain == "s":
            return self.poles
        with np.errstate(divide="ignore", invalid="ignore"):
            poles = np.asarray(np.log1p(self._shifted_poles) / self.dt, dtype=complex)
        return np.where(_are_at_zero(self.poles), -np.inf, poles)

    @property
    @read_only
    def poles_standard_errors(self) -> Array:
        """Standard errors of ``poles`` by the delta method.

        ``dz/da_i = -z^(na-i) / A'(z)``. For a complex pole it is the root of the summed variances
        of its two parts. Where poles coincide there is no first-order answer: infinite, unless
        they are held together, as on the bound of a constraint, where it is that of their mean.
        """
        na = self.structure.na
        return compute_root_errors(self.poles, self.covariance[:na, :na])

    @property
    @read_only
    def poles_s_standard_errors(self) -> Array:
        """Standard errors of ``poles_s`` by the delta method, in rad/s."""
        if self.structure.domain == "s":
            return self.poles_standard_errors
        with np.errstate(divide="ignore", invalid="ignore"):
            errors: Array = self.poles_standard_errors / (np.abs(self.poles) * self.dt)
        return errors

    def __str__(self) -> str:
        return _write_report(self)


def _are_at_zero(poles: Any) -> Any:
    """Tell which poles in z are at zero; they are found as differences from one."""
    return np.abs(poles) < 8 * np.finfo(float).eps


def _write_report(e: Estimate) -> str:
    """Return lines of text: normal facts in normal case, bad news in capitals."""
    held = {bound.quantity for bound in e.active_bounds}
    used = _text.write_count(e.n_samples, "sample")
    lines = [f"{e.method}, {used} used" + (f", dt = {e.dt:g} s" if e.dt else "")]
    for name, value, error in zip(e.names, e.values, e.standard_errors, strict=True):
        if name in held:
            lines.append(f"  {name} = {value:.10g} (on its bound)")
        elif error == 0:
            lines.append(f"  {name} = {value:.10g} (fixed)")
        else:
            lines.append(f"  {name} = {_text.with_error(value, error)}")
    if e.delay_error:
        none = ", which may be none" if e.confidence_interval("delay")[0] == 0 else ""
        lines.append(f"  delay = {_text.with_error(e.delay, e.delay_error)} s{none}")
    if e.branch:
        lines.append(f"  branch of the constraint: {e.branch}")
    pairs = zip(e.poles, e.poles_standard_errors, e.poles_s, e.poles_s_standard_errors, strict=True)
    for z, dz, s, ds in pairs:
        pole = f"  pole at s = {_text.with_error(s, ds)} rad/s"
        if e.structure.domain == "z":
            # What is gone within one sample has no rate.
            if _are_at_zero(z):
                pole = "  pole at z = 0, a delay of one sample"
            else:
                rate = f"s = {_text.with_error(s, ds)} rad/s"
                pole = f"  pole at z = {_text.with_error(z, dz)}, {rate}"
        lines.append(pole)
    # Least squares minimises the error of the difference equation, the others that of a prediction.
    what = e.errors
    lines.append(f"  {what}: standard deviation {np.sqrt(e.residual_variance):.3g}")
    lines.append(f"  solved by {e.solver}")
    lines.append("  active bounds: " + (", ".join(e.active) or "none"))
    return "\n".join([*lines, *_list_bad_news(e)])


def _list_bad_news(e: Estimate) -> list[str]:
    news = [f"  {note}" for note in e.notes]
    for bound in e.active_bounds:
        free = f" Without {bound.constraint} the estimate would be {bound.free:.7g}."
        news.append(
            f"  {bound.quantity} IS ON ITS BOUND {bound.bound:.10g}."
            f"{free if np.isfinite(bound.free) else ''} An active bound is a symptom of bias, not "
            "a result: check for noise fed back through the controller, a sampling period that is "
            "too short, or a constraint that does not hold."
        )
    z = e.poles
    merged = [
        f"  TWO POLES COINCIDE at {e.structure.domain} = {_text.write_number(z[k])}."
        for k in range(len(z) - 1)
        if e.active_bounds and np.any(np.abs(z[k + 1 :] - z[k]) < 1e-6)
    ]
    news += merged
    # A merged pair at the edge is known to half the digits only.
    twice = np.array([np.count_nonzero(find_coincident(z, one)) > 1 for one in z], dtype=bool)
    edges = 1 + np.where(twice, RESOLVED, 1e-9)
    unstable = np.abs(z) > edges if e.structure.domain == "z" else z.real > 0
    if not unstable.any():
        edge = "outside the unit circle" if e.structure.domain == "z" else "in the right half plane"
        if any(bound.unstable for bound in e.active_bounds):
            news.append(f"  NO POLE {edge.upper()}.")
        else:
            news.append(f"  no pole is {edge}: the model is stable. If the plant is unstable, the "
                        "model is wrong.")  # fmt: skip
    return news


def read_delay(model: Any) -> float:
    """Return the delay [s] that an identified model has beside its polynomials, 0 for others."""
    return model.delay if isinstance(model, IdentifiedModel) else 0.0


class IdentifiedModel(control.TransferFunction):
    """A fitted transfer function that carries its ``.estimate``.

    It is a `control.TransferFunction` and goes wherever one goes (`control.margin`,
    `control.feedback`, ...). Arithmetic gives plain transfer functions: a product of two fits has
    no estimate. Copies and pickles keep it.

    Parameters
    ----------
    estimate : Estimate
        Coefficients with their uncertainty.
    inputs, outputs : str
        Signal names.
    name : str
        Name of the system.

    Attributes
    ----------
    delay : float
        Delay of the input that `fit_continuous` was given or found [s]. A rational function cannot
        hold it: `compare`, `redesign`, `diagnose` and Bode plots add it, `with_delay` does for
        everything else.

    Examples
    --------
    >>> import numpy as np
    >>> estimate = Estimate(
    ...     structure=Structure(1, 1), values=np.array([-1.1, 0.5]), covariance=np.zeros((2, 2)),
    ...     intercepts=np.zeros(1), rss=0.0, residual_variance=0.0, n_samples=10,
    ...     degrees_of_freedom=8, method="by hand", solver="nothing", dt=0.1, condition=1.0)
    >>> G = IdentifiedModel(estimate)
    >>> G.estimate["a1"]
    -1.1
    >>> type(2 * G).__name__
    'TransferFunction'
    """

    estimate: Estimate
    delay: float = 0.0

    def __init__(
        self, estimate: Estimate, *, inputs: str = "u", outputs: str = "y", name: str = "identified"
    ) -> None:
        num, den = estimate.structure.fraction(estimate.values)
        super().__init__(num, den, estimate.dt, inputs=inputs, outputs=outputs, name=name)
        self.estimate = estimate

    def with_delay(self, order: int = 3) -> control.TransferFunction:
        r"""Return the model with its delay, as a rational function.

        .. math:: G(s)\, e^{-s\tau} \approx G(s)\, P(s)

        with Padé's approximation P, whose phase at the order n is right to a degree up to
        :math:`\omega \tau \approx n`.

        Parameters
        ----------
        order : int, optional
            Order of the approximation.

        Returns
        -------
        control.TransferFunction
            A plain transfer function; the model itself if it has no delay.
        """
        check_arguments(IdentifiedModel.with_delay, locals())
        plain = to_transfer_function(self)
        return plain * control.tf(*control.pade(self.delay, order)) if self.delay else plain

    def __str__(self) -> str:
        text: Any = super().__str__()
        return f"{text}\n\n{self.estimate}"

    def _repr_html_(self, var: str | None = None) -> str:
        # The formula looks as python-control shows every transfer function.
        formula: Any = super()._repr_html_(var)
        return f"{formula}\n{_text.write_html(str(self.estimate))}"


class IdentifiedSystem(control.TransferFunction):
    """A fitted transfer function of several signals; each output carries an estimate of its own.

    It is a `control.TransferFunction` and goes wherever one goes. The entries of an output have one
    denominator, ``A_i y_i = sum of B_ij u_j``. Arithmetic gives plain transfer functions.

    Parameters
    ----------
    estimates : mapping of str to Estimate
        Coefficients with their uncertainty, by the name of the output.
    inputs : sequence of str
        Names of the inputs.
    name : str
        Name of the system.

    Attributes
    ----------
    estimates : mapping of str to Estimate
        By output; ``G.estimates["alpha"].poles_s``.

    Examples
    --------
    >>> import numpy as np
    >>> rows = {name: Estimate(
    ...     structure=Structure(1, 1), values=np.array([-a, 0.5]), covariance=np.zeros((2, 2)),
    ...     intercepts=np.zeros(1), rss=0.0, residual_variance=0.0, n_samples=10,
    ...     degrees_of_freedom=8, method="by hand", solver="nothing", dt=0.1, condition=1.0)
    ...     for name, a in (("x", 0.9), ("theta", 1.1))}
    >>> G = IdentifiedSystem(rows, ["F"])
    >>> G.output_labels, G.estimates["theta"]["a1"], G.to_states(order=2).nstates
    (['x', 'theta'], -1.1, 2)
    """

    estimates: Mapping[str, Estimate]

    def __init__(
        self, estimates: Mapping[str, Estimate], inputs: Sequence[str], *, name: str = "identified"
    ) -> None:
        rows = [[e.structure.fraction(e.values, j) for j in range(len(inputs))]
                for e in estimates.values()]  # fmt: skip
        nums, dens = ([[part[k] for part in row] for row in rows] for k in (0, 1))
        dt = next(iter(estimates.values())).dt
        super().__init__(nums, dens, dt, inputs=list(inputs), outputs=list(estimates), name=name)
        self.estimates = dict(estimates)

    def to_states(self, order: int | None = None) -> control.StateSpace:
        """Return the model in states.

        They are no physical quantities: a state feedback on them needs an observer. Where all
        outputs show the same poles they get one denominator, the mean weighted by what each of
        them knows, and the system of all equations is reduced to `order` states by its pulse
        response. Outputs that move by poles of their own keep them.

        Parameters
        ----------
        order : int, optional
            Number of states; by default the smallest from the largest number of poles of an
            output on whose frequency response is that of the model within a fifth. As many as all
            outputs have together leaves the model as it is.

        Returns
        -------
        control.StateSpace
            With the names of the signals.

        Raises
        ------
        CtrlidError
            If the order is not between 1 and the number of all poles.
        """
        check_arguments(IdentifiedSystem.to_states, locals())
        counts = [e.structure.fraction(e.values)[1].size - 1 for e in self.estimates.values()]
        if order is None:
            least = min(max(e.structure.na for e in self.estimates.values()), sum(counts))
            each = (self.to_states(k) for k in range(least, sum(counts)))
            near = (states for states in each if self._measure_distance(states) <= NEAR)
            return next(near, None) or self.to_states(sum(counts))
        if not 1 <= order <= sum(counts):
            raise CtrlidError(f"order is a number of states from 1 to {sum(counts)}; given {order}")
        blocks = []
        values = self._share_denominator() if order < sum(counts) else None
        for i, e in enumerate(self.estimates.values()):
            theta = e.values if values is None else values[i]
            parts = [e.structure.fraction(theta, j) for j in range(self.ninputs)]
            den = parts[0][1]
            n = len(den) - 1
            padded = [np.concatenate([np.zeros(n + 1 - len(num)), num]) for num, _ in parts]
            a = np.eye(n, k=1)
            a[:, 0] -= den[1:]
            d = np.array([[num[0] for num in padded]])
            b = np.column_stack([num[1:] - den[1:] * num[0] for num in padded])
            blocks.append((a, b, np.eye(1, n), d))
        a, b, c, d = zip(*blocks, strict=True)
        system = block_diag(*a), np.vstack(b), block_diag(*c)
        if order < sum(counts):
            system = reduce_states(*system, order)
        return control.ss(*system, np.vstack(d), self.dt,
                          inputs=self.input_labels, outputs=self.output_labels)  # fmt: skip

    def _measure_distance(self, states: control.StateSpace) -> float:
        """Return by which share the response of a system of states differs from that of the model.

        The mean over frequencies of the output that differs most.
        """
        points = np.exp(1j * np.pi * np.logspace(-3, 0, FREQUENCIES))
        mine, other = (np.array([g(z) for z in points]) for g in (self, states))
        shape = (len(points), self.noutputs, self.ninputs)
        mine, other = (np.reshape(v, shape) for v in (mine, other))
        apart = np.linalg.norm(mine - other, axis=2)
        share = apart / np.maximum(np.linalg.norm(mine, axis=2), 1e-300)
        return float(np.max(np.mean(share, axis=0)))

    def _share_denominator(self) -> list[Array] | None:
        """Return the coefficients of all outputs with one denominator, by generalized averaging."""
        estimates = list(self.estimates.values())
        na = estimates[0].structure.na
        if any(e.structure.na != na for e in estimates):
            return None
        weights = []
        for e in estimates:
            part = e.covariance[:na, :na]
            # What is known exactly, or without noise, counts very much.
            floor = 1e-10 * np.diag(np.diag(part)) + 1e-16 * np.eye(na)
            weights.append(np.linalg.inv(part + floor))
        known = sum(w @ e.values[:na] for w, e in zip(weights, estimates, strict=True))
        shared = np.linalg.solve(np.sum(weights, axis=0), known)
        return [
            np.concatenate([shared, e.values[na:]
                            + e.covariance[na:, :na] @ w @ (shared - e.values[:na])])
            for w, e in zip(weights, estimates, strict=True)
        ]  # fmt: skip

    def __str__(self) -> str:
        text: Any = super().__str__()
        return "\n\n".join([text, *(f"{n}: {e}" for n, e in self.estimates.items())])

    def _repr_html_(self, var: str | None = None) -> str:
        formula: Any = super()._repr_html_(var)
        words = "\n\n".join(f"{name}: {e}" for name, e in self.estimates.items())
        return f"{formula}\n{_text.write_html(words)}"
