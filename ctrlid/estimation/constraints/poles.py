"""What may be known of a model's poles."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, final

import numpy as np
from scipy.special import eval_chebyt, eval_chebyu

from ..._base.arguments import is_number
from ..._base.errors import CtrlidError
from ..identified_model import Structure
from .base import Branch, Known, Row, equals, make_denominator_weights, require_poles


def _write_pole_rows(structure: Structure, pole: complex) -> list[Row]:
    """Return ``A(pole) = 0``; both parts of it if the pole is complex."""
    # Products, unlike powers of complex numbers, are exact for poles such as 1j.
    powers = np.cumprod([1.0, *[complex(pole)] * structure.na])[::-1]
    # Beyond the unit circle the powers grow: divided by the largest, the row stays of size one.
    powers = powers / max(1.0, abs(powers[0]))
    parts = [powers.real] if complex(pole).imag == 0 else [powers.real, powers.imag]
    return [equals(make_denominator_weights(p[1:], structure.na), 0.0 - float(p[0])) for p in parts]


@final
@dataclass(frozen=True, repr=False)
class ReciprocalPoles(Known):
    """Among the poles there is a real pair z and 1/z: a sampled symmetric pair s = ±p.

    For two poles the paper's constraints ``a2 = 1`` and ``|a1| > 2``: two alternatives,
    ``a1 <= -2`` (poles at positive z) and ``a1 >= 2``, of which the cheaper one wins. The bound
    itself, where the poles merge, is allowed, and reported in capitals when the estimate sits on
    it. For more poles ``A(z) = A(1/z) = 0`` for some real z, which is searched for.

    Parameters
    ----------
    output : str, optional
        The output that it speaks of; by default all.

    Examples
    --------
    >>> for branch in ReciprocalPoles().branches(Structure(2, 2)):
    ...     print(branch.rows)
    (a2 = 1, a1 <= -2)
    (a2 = 1, a1 >= 2)
    """

    unstable: ClassVar[bool] = True

    def branches(self, structure: Structure) -> Sequence[Branch]:
        """See the base class."""
        if structure.domain == "s":
            raise CtrlidError(
                "ReciprocalPoles() is about sampled poles z and 1/z, but this model is in "
                "continuous time: write SymmetricPoles() for poles at s = ±p."
            )
        require_poles(self, structure, 2)
        na = structure.na
        if na == 2:
            reciprocal = equals({"a2": 1.0}, 1.0)
            return (
                Branch((reciprocal, Row({"a1": 1.0}, upper=-2.0)), label="a1 <= -2"),
                Branch((reciprocal, Row({"a1": 1.0}, lower=2.0)), label="a1 >= 2"),
            )

        def pair(z: float) -> Sequence[Row]:
            # A(z) ± A(1/z), divided by what vanishes at z = ±1, are Chebyshev polynomials of
            # (z + 1/z)/2: independent rows right down to the double pole.
            c = math.copysign(1.0 + (abs(z) - 1.0) ** 2 / (2.0 * abs(z)), z)
            even = eval_chebyt(np.arange(na, -1, -1), c)
            odd = np.append(eval_chebyu(np.arange(na - 1, -1, -1), c), 0.0)
            return [
                equals(make_denominator_weights(v[1:] / abs(v[0]), na), -float(v[0] / abs(v[0])))
                for v in (even, odd)
            ]

        # Up to a factor of e^9 from sample to sample, beyond which no log shows a plant.
        outwards = np.concatenate([[0.0], np.geomspace(1e-4, 9.0, 86)])
        positive = np.exp(outwards)
        label = "reciprocal pair at z"
        return (
            Branch(label=label, family=pair, grid=tuple(positive)),
            Branch(label=label, family=pair, grid=tuple(-positive[::-1])),
        )


@final
@dataclass(frozen=True, repr=False)
class SymmetricPoles(Known):
    """Among the poles there is a real pair s = ±p, as in ``-beta / (s^2 - alpha)``.

    In continuous time with two poles ``a1 = 0`` and ``a2 <= 0``; with more,
    ``A(p) = A(-p) = 0`` for some p between 1e-3 and 1e5 rad/s, which is searched for. In a
    sampled model the same fact reads z and 1/z, hence the rows of `ReciprocalPoles`, with z > 0.

    Parameters
    ----------
    output : str, optional
        The output that it speaks of; by default all.

    Examples
    --------
    >>> SymmetricPoles().branches(Structure(2, 1, domain="s"))[0].rows
    (a1 = 0, a2 <= 0)
    """

    unstable: ClassVar[bool] = True

    def branches(self, structure: Structure) -> Sequence[Branch]:
        """See the base class."""
        require_poles(self, structure, 2)
        if structure.domain == "z":
            # exp(p dt) is positive: the alternative at negative z is no sampled real pole.
            return ReciprocalPoles().branches(structure)[:1]
        na = structure.na
        if na == 2:
            return (Branch((equals({"a1": 1.0}, 0.0), Row({"a2": 1.0}, upper=0.0))),)

        def pair(p: float) -> Sequence[Row]:
            # Even and odd part of A vanish at p; the odd one is divided by p, for p = 0.
            power = np.arange(na, -1, -1)
            rows = []
            for parity in (0, 1):
                part = np.where(power % 2 == parity, float(p) ** np.maximum(power - parity, 0), 0.0)
                part = part / part.max()
                rows.append(equals(make_denominator_weights(part[1:], na), 0.0 - float(part[0])))
            return rows

        grid = tuple(np.concatenate([[0.0], np.geomspace(1e-3, 1e5, 160)]))
        return (Branch(label="symmetric pair at s = ±p, p", family=pair, grid=grid),)


@final
@dataclass(frozen=True, repr=False)
class PoleAt(Known):
    """``A(pole) = 0``: the model has this pole; a complex one brings its conjugate.

    Parameters
    ----------
    pole : float or complex
        In z for a sampled model, in rad/s for a continuous one.
    output : str, optional
        The output that it speaks of; by default all.

    Examples
    --------
    >>> PoleAt(0.5).branches(Structure(2, 1))[0].rows
    (0.5 a1 + a2 = -0.25,)
    """

    pole: complex

    def __post_init__(self) -> None:
        given = self.pole
        if not (is_number(given) or isinstance(given, complex | np.complexfloating)):
            raise CtrlidError(f"PoleAt needs a number; given {given!r}.")
        if not np.isfinite(complex(given)):
            raise CtrlidError(f"PoleAt needs a finite pole; given {self.pole!r}.")

    def branches(self, structure: Structure) -> Sequence[Branch]:
        """See the base class."""
        require_poles(self, structure, 1 if complex(self.pole).imag == 0 else 2)
        return (Branch(tuple(_write_pole_rows(structure, self.pole))),)


@final
@dataclass(frozen=True, repr=False)
class Integrator(Known):
    """A pole at the origin of the s-plane: z = 1 in a sampled model, last a = 0 in s.

    Parameters
    ----------
    output : str, optional
        The output that it speaks of; by default all.

    Examples
    --------
    >>> Integrator().branches(Structure(2, 1))[0].rows
    (a1 + a2 = -1,)
    """

    def branches(self, structure: Structure) -> Sequence[Branch]:
        """See the base class."""
        require_poles(self, structure, 1)
        pole = 1.0 if structure.domain == "z" else 0.0
        return (Branch(tuple(_write_pole_rows(structure, pole))),)
