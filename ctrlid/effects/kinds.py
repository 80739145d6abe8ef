"""Base classes of effects, one for each place in the loop, each with one method to write."""

import dataclasses
from typing import Any, ClassVar

import casadi
import numpy as np

from .._base.errors import EffectDoesNotApply
from ..physics.equations import Equations, InputMemory
from ..physics.integration import put_entry
from ..physics.symbols import Symbol
from .base import AbstractEffect, Place, refuse_missing_formula, require_motion
from .context import Moment
from .scanning import Scan, Sight
from .symbolic import substitute_symbol, to_expression, trace_hook

# A gap or a zone is tried so many times as wide as the narrow one that a fit starts from.
WIDER = (1.0, 2.0, 4.0)


class LawEffect(AbstractEffect):
    """A change inside the plant's own law: a parameter or a state is seen differently."""

    place: ClassVar[Place] = "law"
    stage: ClassVar[int] = 0

    def law(self, m: Moment) -> dict[str, Any]:
        """Return what the plant sees in place of parameters or states, by their names."""
        refuse_missing_formula("LawEffect", "law(self, m)")

    def build(self, e: Equations, m: Moment) -> Equations:
        """Return the equations with the law's parameters and states replaced.

        A state is seen differently by the rates only: the output still shows what it is.
        """
        seen = trace_hook(self.law)(m)
        known = {**m.states, **m.parameters}
        unknown = [name for name in seen if name not in known]
        if unknown:
            raise EffectDoesNotApply(
                f"{type(self).__name__} changes {unknown[0]!r}, but {e.name} has the states "
                f"{list(e.states)} and the numeric parameters {list(e.parameters)}"
            )
        for name, value in seen.items():
            old, new = known[name].sx, to_expression(value)
            output = e.output if name in m.states else casadi.substitute(e.output, old, new)
            e = dataclasses.replace(substitute_symbol(e, old, new), output=output)
        return e


class ForceEffect(AbstractEffect):
    """A force on the moving mass, as the acceleration that it causes."""

    place: ClassVar[Place] = "force"
    stage: ClassVar[int] = 1

    def force(self, m: Moment) -> Any:
        """Return the acceleration of the moving mass [output unit/s^2]."""
        refuse_missing_formula("ForceEffect", "force(self, m)")

    def build(self, e: Equations, m: Moment) -> Equations:
        """Return the equations with the force added to the rate of the velocity."""
        _, j = require_motion(self, e)
        rhs, size = casadi.SX(e.rhs), to_expression(trace_hook(self.force)(m))
        if self.at and e.pushes is not None:
            n = e.pushes.shape[0]
            rhs[:n] = rhs[:n] + e.pushes[:, e.velocities.index(j)] * size
        else:
            rhs[j] = rhs[j] + size
        return dataclasses.replace(e, rhs=rhs)


class InputEffect(AbstractEffect):
    """Something between the computed input and what reaches the plant."""

    place: ClassVar[Place] = "input"
    stage: ClassVar[int] = 4
    ordered: ClassVar[bool] = True

    def input(self, m: Moment) -> Any:
        """Return the input that is applied [input unit]."""
        refuse_missing_formula("InputEffect", "input(self, m)")

    def build(self, e: Equations, m: Moment) -> Equations:
        """Return the equations with the applied input in place of the computed one."""
        applied = to_expression(trace_hook(self.input)(m))
        if len(e.inputs) > 1:
            applied = put_entry(e.u, e.inputs.index(self.at), applied)
        if e.memory is not None and not _depends_on_others(applied, e):
            return _put_ahead_of_memory(e, e.memory, applied)
        return substitute_symbol(e, e.u, applied)


def _depends_on_others(applied: Any, e: Equations) -> bool:
    """Whether an applied input depends on more than the computed one and parameters."""
    return bool(casadi.depends_on(applied, casadi.vertcat(e.t, e.x, casadi.vec(e.spread))))


def _put_ahead_of_memory(e: Equations, memory: InputMemory, bent: Any) -> Equations:
    """Return equations whose memory follows the input as it is bent, in place of the input."""
    plain = casadi.vertcat(memory.u, memory.at_rest)
    given = casadi.vertcat(*(casadi.substitute(casadi.SX(bent), e.u, value)
                             for value in (memory.u, memory.at_rest)))  # fmt: skip
    after, applied, start, reach = (
        casadi.substitute(casadi.SX(value), plain, given)
        for value in (memory.after, memory.applied, memory.start, memory.reach)
    )
    memory = dataclasses.replace(memory, after=after, applied=applied, start=start, reach=reach)
    return dataclasses.replace(e, memory=memory)


class MemoryEffect(InputEffect):
    """Something that the input passes once per sample, of which it depends what went before."""

    stage: ClassVar[int] = 6
    in_linear_model: ClassVar[bool] = False

    @classmethod
    def is_scanned(cls) -> bool:
        """Say no: a few widths or speeds hardly take longer than one."""
        return False

    def remember(self, memory: Any, u: Any, period: Any, at_rest: Any) -> InputMemory:
        """Return what the input passes, as expressions of these symbols."""
        refuse_missing_formula("MemoryEffect", "remember(self, memory, u, period, at_rest)")

    def build(self, e: Equations, m: Moment) -> Equations:
        """Return the equations with the memory ahead of them."""
        require_one_input(self, e)
        if e.memory is not None:
            raise EffectDoesNotApply(
                f"the input of {e.name} has a memory already, and one loop takes a single "
                "InputBacklash or InputRateLimit"
            )
        symbols = (casadi.SX.sym(name) for name in ("m", "u", "period", "at_rest"))
        return dataclasses.replace(e, memory=self.remember(*symbols))


def require_one_input(effect: AbstractEffect, e: Equations) -> None:
    """Refuse a plant with several inputs, whose memories would be one for all of them."""
    if len(e.inputs) > 1:
        raise EffectDoesNotApply(
            f"{type(effect).__name__} remembers the one input of a plant; {e.name} has "
            f"{', '.join(e.inputs)}. Write it as states of the plant"
        )


def choose_widths(loop: Any, record: Any) -> tuple[float, float]:
    """Return the widths of a gap or a zone to start from.

    It swallows a tenth of the range of the recorded input, or all but a tenth of it: no climb leads
    from the one to the other.
    """
    known = record is not None
    reach = float(np.ptp(record.u)) if known else max(abs(float(loop.point.input)), 1.0)
    return 0.1 * reach, 0.9 * reach


def scan_widths(effect: Any, sight: Sight) -> Scan | None:
    """Look at a gap or a zone that is narrow beside the range of the input, and at wider ones.

    Kicks of a controller make the range many times as large as what the input usually does, and a
    width from which a climb leads to the right one may promise less than nothing by itself.
    """
    reach = float(np.ptp(sight.inputs))
    widths = [w for w in (effect.width * times for times in WIDER) if w < 0.5 * reach]
    if len(widths) < 2:
        return None
    return Scan((tuple(dataclasses.replace(effect, width=width) for width in widths),))


def replace_output(e: Equations, at: str, shown: Any) -> Equations:
    """Return equations with another expression for the output, or for one of several."""
    if len(e.outputs) > 1:
        shown = put_entry(e.output, e.outputs.index(at), shown)
    return dataclasses.replace(e, output=shown)


class OutputEffect(AbstractEffect):
    """Something between the plant's output and the sensor's noise."""

    place: ClassVar[Place] = "output"
    stage: ClassVar[int] = 7
    ordered: ClassVar[bool] = True

    def output(self, m: Moment) -> Any:
        """Return the output that the sensor shows [output unit]."""
        refuse_missing_formula("OutputEffect", "output(self, m)")

    def build(self, e: Equations, m: Moment) -> Equations:
        """Return the equations with the new output."""
        return replace_output(e, self.at, to_expression(trace_hook(self.output)(m)))


class ReadingEffect(AbstractEffect):
    """What happens to a reading after the sensor's noise is in it."""

    place: ClassVar[Place] = "output"
    stage: ClassVar[int] = 8
    ordered: ClassVar[bool] = True

    def read(self, m: Moment) -> Any:
        """Return what is recorded of the noisy reading ``m.y`` [output unit]."""
        refuse_missing_formula("ReadingEffect", "read(self, m)")

    def build(self, e: Equations, m: Moment) -> Equations:
        """Return the equations with the readout appended to what there is."""
        reading = casadi.SX.sym("reading", len(e.outputs)) if e.reading is None else e.reading
        each = casadi.vertsplit(reading if e.readout is None else e.readout)
        place = e.outputs.index(self.at) if self.at else 0
        m.y = Symbol(each[place])
        each[place] = to_expression(trace_hook(self.read)(m))
        return dataclasses.replace(e, reading=reading, readout=casadi.vertcat(*each))
