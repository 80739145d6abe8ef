"""Step 4: where along a frequency, a length or the time an effect would have to sit."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from .._base.arrays import Array
from ..data.record import Record
from ..effects import AbstractEffect
from ..effects.context import find_output_of
from ..estimation.likelihood.force_score import compute_force_scores
from .candidates import Objection, Trial, attempt_trial
from .fitted_model import Model, carry_over_fit
from .ordering import screen_orders
from .places import find_force_channel, find_position
from .screening import screen_candidate, screen_starts
from .shape_scores import score_shapes
from .thresholds import THRESHOLD


@dataclass(frozen=True, eq=False)
class ModelSight:
    """What a fitted model sees of its records, for effects that look for their place.

    Of a plant with several signals, from the place `at` where the effect acts.
    """

    model: Model
    at: str = ""

    @property
    def dt(self) -> float:
        """Sampling period [s]."""
        return self.model.loop.dt

    @property
    def times(self) -> tuple[Array, ...]:
        """Times of the samples since the start of the experiment [s], by record."""
        return tuple(data.t for data in self.model.data)

    @property
    def inputs(self) -> Array:
        """The recorded inputs that count, one record after the other [input unit]."""
        inputs = self.model.plant.e.inputs
        column = inputs.index(self.at) if self.at in inputs else 0
        if self.model.plant.e.siso:
            return np.concatenate([data.u[data.valid] for data in self.model.data])
        return np.concatenate([data.u[data.valid.any(axis=1), column] for data in self.model.data])

    @property
    def outputs(self) -> tuple[Array, ...]:
        """The recorded outputs, by record [output unit]."""
        if self.model.plant.e.siso:
            return tuple(record.y for record in self.model.records)
        return tuple(
            np.reshape(record.y, (-1, len(record)))[self._output] for record in self.model.records
        )

    @property
    def _output(self) -> int:
        """The output of the place, or the one that shows its position."""
        e = self.model.plant.e
        return e.outputs.index(self.at) if self.at in e.outputs else find_output_of(e, self.at)

    @property
    def travel(self) -> float:
        """How far the position moves on samples that count [output unit]."""
        positions, counts = self.positions(), self.model.fit.counts
        seen = [keep if keep.ndim == 1 else keep.any(axis=1) for keep in counts]
        return max(float(np.ptp(x[keep])) for x, keep in zip(positions, seen, strict=True))

    @property
    def block(self) -> int:
        """How many waves over all samples fit into memory at once."""
        longest = max(len(t) for t in self.times)
        states = self.model.plant.size
        return max(1, THRESHOLD.scan_block // (2 * (states + 1) * longest))

    def state(self, name: str) -> tuple[Array, ...] | None:
        """Return a filtered state along each record, or None if the plant has no such state."""
        states = list(self.model.plant.e.states)
        return self._filtered(states.index(name)) if name in states else None

    def positions(self) -> tuple[Array, ...]:
        """Return the filtered position along each record [output unit]."""
        plant = self.model.plant
        return self._filtered(find_position(plant.e, self.at, plant.position))

    def _filtered(self, k: int) -> tuple[Array, ...]:
        return tuple(out.trajectory.filtered[:, k] for out in self.model.fit.filtered)

    def parameter(self, name: str) -> float | None:
        """Return the fitted value of a free parameter of the plant, or None if it is not free."""
        names = self.model.names
        return float(self.model.fit.theta[names.index(name)]) if name in names else None

    def with_free(self, name: str) -> "ModelSight":
        """Return what the model sees with a further parameter of the plant free, as it is now."""
        if name in self.model.names:
            return self
        fitted, names = self.model.fitted, (*self.model.names, name)
        return replace(self, model=Model(fitted, carry_over_fit(self.model, fitted, names)))

    def force_scores(self, draws: int) -> list[Array]:
        """Return the derivative of the log-likelihood by a force held over each single period."""
        channel = find_force_channel(self.model.plant.e, self.at) if self.at else None
        return compute_force_scores(self.model.fit, draws, channel)

    def strongest_line(self) -> float:
        """Return the frequency of the strongest line in the innovations [Hz]."""
        z = max(self.model.fit.standardized, key=len)
        z = z if z.ndim == 1 else z[:, self._output]
        return find_strongest_line(np.nan_to_num(z), self.dt)

    def score_shapes(
        self, shapes: Sequence[Array], parameter: str | None = None, width: int = 1,
        place: Literal["force", "output"] = "force",
    ) -> tuple[Array, Array]:  # fmt: skip
        """Return what forces of given shapes would gain, and the sizes that gain it."""
        return score_shapes(self.model.fit, shapes, parameter, width, place, self.at)


def find_strongest_line(errors: Array, dt: float) -> float:
    """Return the frequency of the strongest line [Hz], drifts left out."""
    size = THRESHOLD.line_padding * len(errors)
    power = np.abs(np.fft.rfft(errors, size)) ** 2
    power[: THRESHOLD.slowest_line] = 0.0
    return int(np.argmax(power)) / (size * dt)


def is_line_of_reference(record: Record, frequency: float) -> bool:
    r"""Whether the reference of a record has power at a frequency.

    .. math:: p = e^{-n R^2 / 2}

    is how often white noise has so large a share :math:`R^2` of its variance at a frequency given
    beforehand. A line there may be the loop's answer to the reference.

    Parameters
    ----------
    record : Record
        A record; without a reference the answer is no.
    frequency : float
        The frequency [Hz].
    """
    if record.r is None:
        return False
    if record.r.ndim == 2:
        return any(
            is_line_of_reference(record.select(r=name, y=record.signals["y"][0]), frequency)
            for name in record.signals["r"]
        )
    keep = record.valid_samples & np.isfinite(record.r)
    if not keep.any() or np.ptp(record.r[keep]) == 0:
        return False
    r = record.r[keep] - np.mean(record.r[keep])
    angle = 2 * np.pi * frequency * record.t[keep]
    waves = np.column_stack([np.sin(angle), np.cos(angle), np.ones(len(r))])
    left = r - waves @ np.linalg.lstsq(waves, r, rcond=None)[0]
    share = 1 - float(left @ left) / float(r @ r)
    return math.exp(-len(r) * share / 2) < THRESHOLD.telling


def scan_candidate(model: Model, effect: AbstractEffect) -> Trial:
    """Return the trial of an effect at the place where its score is largest.

    Parameters
    ----------
    model : Model
        The fitted model.
    effect : AbstractEffect
        An effect, which may have a frequency, a period or a time to be looked for.

    Returns
    -------
    Trial
        The best place, and the best order among the effects there are; the penalty of the scan is
        in `scan_penalty`.
    """
    return attempt_trial(
        lambda: screen_orders(model, _find_best_place(model, effect)),
        Trial(effect, "", model, -math.inf),
    )


def _find_best_place(model: Model, effect: AbstractEffect) -> Trial:
    """Return the trial of `scan_candidate`, where nothing fails."""
    scan = effect.scan(ModelSight(model, effect.at))
    if scan is None:
        return screen_candidate(model, effect)
    if not scan.starts:
        return Trial(effect, "", model, -math.inf, out=Objection("not seen", scan.remark))
    penalty = math.log(scan.places)
    if len(scan.starts) == len(scan.starts[0]) == 1:
        best = screen_candidate(model, scan.starts[0][0], penalty)
    else:
        tried = (screen_starts(model, group, penalty) for group in scan.starts)
        best = max(tried, key=lambda t: t.score)
        if not best.score > 0:
            # What is fainter than the first may promise something all the same.
            best = max(best, screen_candidate(model, scan.starts[0][0], penalty),
                       key=lambda t: t.score)  # fmt: skip
    return replace(best, others=scan.others)
