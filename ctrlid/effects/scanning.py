"""What an effect sees of a record in a scan, and the starts that a scan returns."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal, Protocol

import numpy as np

from .._base.arrays import Array

if TYPE_CHECKING:
    from .base import AbstractEffect


# Vibrations above this share of the sampling frequency are aliased.
VISIBLE = 0.4
# Quantiles of a signal that a limit may cut off, from the highest down.
CUT_OFF = (0.999, 0.998, 0.995, 0.99, 0.98, 0.95, 0.9, 0.8)


class Range(Protocol):
    """What a record covers, for the bounds that it sets to the parameters of an effect."""

    @property
    def dt(self) -> float:
        """Sampling period [s]."""

    @property
    def duration(self) -> float:
        """Length of the longest record [s]; stretches of one are as long as from first to last."""

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

    def with_free(self, name: str) -> Sight:
        """Return what the model sees with a further parameter of the plant free, as it is now."""

    def force_scores(self, draws: int) -> Sequence[Array]:
        """Return the derivative of the log-likelihood by a force held over each single period.

        Parameters
        ----------
        draws : int
            Of as many records of the same model they are computed as well.

        Returns
        -------
        sequence of ndarray, shape (n, 1 + draws)
            By record, its own scores in the first column.
        """

    def score_shapes(
        self, shapes: Sequence[Array], parameter: str | None = None, width: int = 1,
        place: Literal["force", "output"] = "force",
    ) -> tuple[Array, Array]:  # fmt: skip
        """Return what forces of given shapes would gain, and the sizes that gain it.

        Parameters
        ----------
        shapes : sequence of ndarray, shape (n, shapes)
            For each record, the shapes over its samples.
        parameter : str, optional
            What is modulated: by default a force, else the named parameter of the plant.
        width : int, optional
            Neighbouring shapes that belong together, such as a sine and a cosine.
        place : {"force", "output"}, optional
            Whether the shapes are forces, or are added to the reading.

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


def choose_middle_frequency(loop: Any, record: Any) -> float:
    """Return a frequency [Hz] halfway, on a logarithmic scale, of what a record can show."""
    samples = 1000 if record is None else len(record)
    return math.sqrt(0.5 / samples) / float(loop.dt)


def find_visible_frequencies(seen: Range) -> tuple[float, float]:
    """Return the frequencies that samples show [Hz]: one period in the record, below Nyquist's."""
    return 1.0 / seen.duration, VISIBLE / seen.dt


def make_waves(angles: Array) -> Array:
    """Return sine and cosine of each column of angles, side by side."""
    both = np.stack([np.sin(angles), np.cos(angles)], axis=2)
    return both.reshape(len(angles), -1)


def compute_amplitude_and_phase(size: Array) -> tuple[float, float]:
    """Return amplitude and phase of ``size[0] sin + size[1] cos``."""
    return float(np.hypot(*size)), float(np.arctan2(size[1], size[0]))


def scan_line(line: Any, sight: Sight, place: Literal["force", "output"] = "force") -> Scan:
    """Return a wave of an effect with amplitude, frequency and phase at the strongest line."""
    frequency = sight.strongest_line()
    angles = [2 * np.pi * frequency * t for t in sight.times]
    waves = [make_waves(a[:, None]) for a in angles]
    _, sizes = sight.score_shapes(waves, width=2, place=place)
    amplitude, phase = compute_amplitude_and_phase(sizes[0])
    start = replace(line, amplitude=amplitude, frequency=frequency, phase=phase)
    return Scan(((start,),), places=max(map(len, angles)) / 2)
