"""What an effect sees of a record in a scan, and the starts that a scan returns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from .._base.arrays import Array

if TYPE_CHECKING:
    from .base import AbstractEffect


# Quantiles of a signal that a limit may cut off, from the highest down.
CUT_OFF = (0.999, 0.998, 0.995, 0.99, 0.98, 0.95, 0.9, 0.8)


class Range(Protocol):
    """What a record covers, for the bounds that it sets to the parameters of an effect."""

    @property
    def dt(self) -> float:
        """Sampling period [s]."""

    @property
    def duration(self) -> float:
        """Length of the longest record [s]."""

    @property
    def travel(self) -> float:
        """How far the position moves [output unit]; infinite for a plant without a moving mass."""

    @property
    def fastest(self) -> float:
        """The largest usual speed [output unit/s]; 1 where nothing moves."""


class Overview(Protocol):
    """What a model sees of the records along the way, whether filtered or simulated."""

    @property
    def times(self) -> Sequence[Array]:
        """Times of the samples since the start of the experiment [s], by record."""

    def state(self, name: str) -> Sequence[Array] | None:
        """Return a state along each record, or None if the plant has no such state."""

    def strongest_line(self) -> float:
        """Return the frequency of the strongest line in the errors of the model [Hz]."""


class Sight(Overview, Protocol):
    """What a fitted model sees of the records, for an effect that has to be looked for."""

    @property
    def dt(self) -> float:
        """Sampling period [s]."""

    @property
    def inputs(self) -> Array:
        """The recorded inputs that count, one record after the other [input unit]."""

    @property
    def outputs(self) -> Sequence[Array]:
        """The recorded outputs, by record [output unit]."""

    @property
    def travel(self) -> float:
        """How far the position moves on samples that count [output unit]."""

    @property
    def block(self) -> int:
        """How many waves over all samples fit into memory at once."""

    def positions(self) -> Sequence[Array]:
        """Return the position along each record [output unit]."""

    def parameter(self, name: str) -> float | None:
        """Return the fitted value of a free parameter of the plant, or None if it is not free."""

    def score_shapes(
        self, shapes: Sequence[Array], parameter: str | None = None, width: int = 1
    ) -> tuple[Array, Array]:
        """Return what forces of given shapes would gain, and the sizes that gain it.

        Parameters
        ----------
        shapes : sequence of ndarray, shape (n, shapes)
            For each record, the shapes over its samples.
        parameter : str, optional
            What is modulated: by default a force, else the named parameter of the plant.
        width : int, optional
            Neighbouring shapes that belong together, such as a sine and a cosine.

        Returns
        -------
        gains : ndarray, shape (shapes / width,)
            Gains of log-likelihood, the model's own parameters moving along.
        sizes : ndarray, shape (shapes / width, width)
            The sizes that the first step gives them.
        """


@dataclass(frozen=True)
class Scan:
    """The places at which an effect was looked for.

    Parameters
    ----------
    starts : tuple of tuples of effects
        Effects to be screened, in groups that differ in their values only; the one with the
        largest score is refitted. Empty if the record cannot show the effect, and `remark` says
        why.
    places : float
        At how many places it was looked for: something is found by chance in one of them, and the
        logarithm of this number is taken off the gain.
    others : tuple of effects
        Starts whose score is nearly as large, which only a refit tells apart.
    remark : str
        Why the record cannot show the effect.
    """

    starts: tuple[tuple[AbstractEffect, ...], ...]
    places: float = 1.0
    others: tuple[AbstractEffect, ...] = ()
    remark: str = ""
