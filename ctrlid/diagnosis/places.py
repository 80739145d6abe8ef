"""Step 4: the places of a plant with several signals at which each effect may act."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from ..data.record import Record
from ..effects import AbstractEffect, ReadingEffect
from ..effects.context import find_motion, find_output_of
from ..loop.loop import Loop
from ..physics.equations import Equations
from ..physics.linearization import OperatingPoint


@dataclass(frozen=True, eq=False)
class PlacedLoop:
    """A loop of several signals as an effect sees it that acts at one place.

    Its first input and output are those of the place, so that an effect that was written for one of
    each finds its scale, and what is added acts there.
    """

    loop: Loop
    at: str
    input: int
    output: int

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return getattr(self.loop, name)

    @property
    def point(self) -> OperatingPoint:
        """The operating point with the input and the output of the place."""
        at = self.loop.point
        return OperatingPoint(at.states, at.inputs[self.input], at.outputs[self.output])

    def equations(self, keep: bool = False) -> Equations:
        """Return the equations of the loop."""
        return self.loop.equations(keep)

    def with_effect(self, effect: AbstractEffect) -> Loop:
        """Return the loop with an effect at the place."""
        return self.loop.with_effect(replace(effect, at=self.at))


def needs_place(loop: Loop, kind: type[AbstractEffect]) -> bool:
    """Whether an effect has to say where it acts, as it has on a plant with several signals.

    A force acts at each velocity of a mechanism, whatever is measured, if it is known which input
    works there.
    """
    e = loop.equations()
    return not e.siso or (kind.place == "force" and e.pushes is not None)


def list_places(loop: Loop, kind: type[AbstractEffect]) -> list[str]:
    """Return where an effect may act; nowhere in particular on a plant with one of each."""
    e = loop.equations()
    if not needs_place(loop, kind):
        return [""]
    velocities = [e.states[j] for j in e.velocities]
    names = {"input": e.inputs, "output": e.outputs, "force": velocities, "law": [""]}
    return list(names[kind.place])


def list_placed_candidates(
    kind: type[AbstractEffect], loop: Loop, record: Record
) -> list[AbstractEffect]:
    """Return an effect at its start, at each place of a plant with several signals."""
    e = loop.equations()
    if issubclass(kind, ReadingEffect):
        # The filter does not see what becomes of a noisy reading: steps are read off the record.
        return []
    u, y = record.signals["u"], record.signals["y"]
    found: list[AbstractEffect] = []
    for at in list_places(loop, kind):
        i = e.inputs.index(at) if kind.place == "input" else 0
        k = e.outputs.index(at) if kind.place == "output" else 0
        k = find_output_of(e, at) if kind.place == "force" else k
        part = record.select(u=u[i], y=y[k])
        placed = kind.candidates(PlacedLoop(loop, at, i, k), part)
        found += [replace(effect, at=at) for effect in placed]
    return found


def find_force_channel(e: Equations, at: str) -> int:
    """Return which random force works on a velocity."""
    velocities: Sequence[str] = [e.states[j] for j in e.velocities]
    return velocities.index(at) if at in velocities else 0


def find_position(e: Equations, at: str, otherwise: int) -> int:
    """Return the state that is the position of a velocity, else another one.

    A speed whose position is no state stands for it.
    """
    motion = find_motion(e, at) if at else None
    if motion is None:
        return otherwise
    position, velocity = motion
    return velocity if position is None else position
