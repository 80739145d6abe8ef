"""response_band(): how well the frequency response of a fitted model is known."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import t as student_t

from .._base.arguments import check_arguments, explain_names
from .._base.arrays import Array, freeze_arrays, to_real_array
from .._base.errors import CtrlidError
from .._base.rounding import keep_numpy_quiet
from .._base.text import Printed, write_count
from .identified_model import IdentifiedModel

# A band of more frequencies is printed at so many of them, evenly over its range.
MOST_ROWS = 12


@dataclass(frozen=True, eq=False, repr=False)
class ResponseBand(Printed):
    """Frequency response of a model with its confidence limits, each frequency on its own.

    Attributes
    ----------
    omega : (n,) array
        Frequencies [rad/s].
    magnitude, magnitude_low, magnitude_high : (n,) arrays
        Size of the response and its limits [output unit per input unit].
    phase, phase_low, phase_high : (n,) arrays
        Phase without jumps and its limits [deg].
    level : float
        Probability with which the limits hold at one frequency.
    """

    omega: Array
    magnitude: Array
    magnitude_low: Array
    magnitude_high: Array
    phase: Array
    phase_low: Array
    phase_high: Array
    level: float

    def __post_init__(self) -> None:
        freeze_arrays(self)

    def __str__(self) -> str:
        rows = [f"Frequency response with {100 * self.level:g} % confidence limits at each "
                f"frequency ({write_count(len(self.omega), 'frequency', 'frequencies')})",
                f"{'omega [rad/s]':>15}{'magnitude':>12}{'from':>12}{'to':>12}"
                f"{'phase [deg]':>14}{'from':>10}{'to':>10}"]  # fmt: skip
        shown = np.unique(np.linspace(0, len(self.omega) - 1, MOST_ROWS).astype(int))
        rows += [
            f"{self.omega[k]:>15.4g}{self.magnitude[k]:>12.4g}{self.magnitude_low[k]:>12.4g}"
            f"{self.magnitude_high[k]:>12.4g}{self.phase[k]:>14.2f}{self.phase_low[k]:>10.2f}"
            f"{self.phase_high[k]:>10.2f}"
            for k in shown
        ]
        return "\n".join(rows)


@explain_names
@keep_numpy_quiet
def response_band(model: IdentifiedModel, omega: Any, level: float = 0.95) -> ResponseBand:
    r"""Return the confidence band of a fitted model's frequency response.

    .. math:: \ln G = \ln B - \ln A, \quad
        g = \frac{\partial \ln G}{\partial \theta}
          = \Bigl( -\frac{\partial A / \partial a_i}{A}, \frac{\partial B / \partial b_i}{B} \Bigr),
        \quad \operatorname{var} \ln |G| = \Re g^T \Sigma \, \Re g, \quad
        \operatorname{var} \arg G = \Im g^T \Sigma \, \Im g

    with the covariance :math:`\Sigma` of the coefficients, which is zero in directions that
    constraints fix, and of a fitted delay, whose slope is :math:`-j\omega`. The limits are
    symmetric in the logarithm of the magnitude (in dB) and in the phase. This is the first order in
    the errors: where the band is wide, beyond a factor of two or so, it says that little is known,
    and not exactly how little. It counts scatter, not bias: the band of `fit_arx` under feedback
    may miss the truth everywhere.

    Parameters
    ----------
    model : IdentifiedModel
        What `fit_iv`, `fit_continuous` or `fit_arx` return.
    omega : array_like, shape (n,)
        Frequencies [rad/s], for a sampled model below its Nyquist frequency.
    level : float, optional
        Probability, between 0 and 1, that the limits hold at one frequency.

    Returns
    -------
    ResponseBand
        Magnitude and phase with their limits.

    Raises
    ------
    CtrlidError
        If the model carries no estimate, or a frequency or the level is out of range.

    References
    ----------
    Ljung, *System Identification*, 2nd edition, section 9.4 (transfer functions of estimates).

    Examples
    --------
    >>> import control as ct
    >>> import ctrlid as cid
    >>> loop = cid.Loop(cid.plants.servo(m=1.0, c=2.0, k=3.0), ct.tf(5, 1, 0.05), dt=0.05)
    >>> r = cid.random_binary(2000, amplitude=0.1, hold=10, seed=1)
    >>> G = cid.fit_iv(cid.simulate(loop, r, sensor_noise=1e-3, seed=2), na=2, nb=2)
    >>> band = cid.response_band(G, [0.5, 5.0])
    >>> bool((band.magnitude_low < abs(3.0 / (0.5j * (0.5j + 2))))[0])
    True
    """
    check_arguments(response_band, locals(), "model")
    estimate = getattr(model, "estimate", None)
    if not isinstance(model, IdentifiedModel) or estimate is None:
        raise CtrlidError(
            "response_band needs a fitted model, as fit_iv, fit_continuous or fit_arx return it; "
            f"given {type(model).__name__}. Arithmetic of models drops the estimate"
        )
    if not 0.0 < level < 1.0:
        raise CtrlidError(f"A confidence level lies between 0 and 1; given {level!r}.")
    w = np.atleast_1d(to_real_array(omega, "omega"))
    # A power of the frequency has to be a number too.
    limit = np.pi / estimate.dt if estimate.dt else 1e300 ** (1 / (1 + len(estimate.names)))
    if w.ndim != 1 or not w.size or not np.all((w > 0) & (w < limit)):
        below = f" below the Nyquist frequency {limit:.6g} rad/s" if estimate.dt else (
            f" below {limit:.3g} rad/s")  # fmt: skip
        raise CtrlidError(f"omega needs positive frequencies in rad/s{below}; given {omega!r}")
    at = np.exp(1j * w * estimate.dt) if estimate.dt else 1j * w
    structure, p = estimate.structure, len(estimate.names)
    num, den = (np.polyval(f, at) for f in structure.fraction(estimate.values))
    # A and B are linear in the coefficients: their slopes are differences.
    num0, den0 = structure.fraction(np.zeros(p))
    slopes = np.empty((p, w.size), dtype=complex)
    for i, e in enumerate(np.eye(p)):
        num1, den1 = structure.fraction(e)
        slopes[i] = np.polyval(num1 - num0, at) / num - np.polyval(den1 - den0, at) / den
    covariance = np.asarray(estimate.covariance)
    if estimate.delay_covariance.size:
        # A fitted delay turns the phase by -w for each second.
        slopes = np.vstack([slopes, -1j * w])
        beside = np.append(estimate.delay_covariance, estimate.delay_error**2)
        covariance = np.column_stack([np.vstack([covariance, beside[:-1]]), beside])
    half = float(student_t.ppf(0.5 + level / 2, estimate.degrees_of_freedom))
    errors = [
        half * np.sqrt(np.maximum(np.einsum("ik,ij,jk->k", part, covariance, part), 0.0))
        for part in (slopes.real, slopes.imag)
    ]
    response = num / den * np.exp(-1j * w * model.delay)
    magnitude, phase = np.abs(response), np.degrees(np.unwrap(np.angle(response)))
    spread, turn = np.exp(errors[0]), np.degrees(errors[1])
    return ResponseBand(
        w, magnitude, magnitude / spread, magnitude * spread, phase, phase - turn, phase + turn,
        level,
    )  # fmt: skip
