"""A controller of any kind: what it promises on a linear model, and what it does on the physics."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from .._base.arrays import ComplexArray
from .._base.text import Printed, write_list, write_quantity
from ..loop.loop import Loop
from .input_margins import LoopPerformance
from .reference_steps import ReferenceStep, find_followed, write_or_dash
from .settling import TAIL, explain_unsettled, settles_otherwise
from .step_height import advise_step

# The loss of more than this share of what was promised is reported.
CLOSE = 0.25


@dataclass(frozen=True, eq=False, repr=False)
class ControllerTrial(Printed):
    """A controller that a function designed on a model, with the promise and what came of it.

    Parameters
    ----------
    controller : control.TransferFunction, control.StateSpace, control.NonlinearIOSystem or PID
        What the function returned.
    promised, achieved : LoopPerformance
        On the model, and on the physics of the loop near its operating point.
    steps : tuple of ReferenceStep
        One for each reference that was stepped.
    loop : Loop
        The physics with the new controller.
    model : control.TransferFunction or control.StateSpace
        The linear model that the function was given.
    failure : str or None
        Why the physics was not kept stable; None if it was.
    """

    controller: Any
    promised: LoopPerformance
    achieved: LoopPerformance
    steps: tuple[ReferenceStep, ...]
    loop: Loop
    model: Any
    failure: str | None = None

    @property
    def stable(self) -> bool:
        """Whether the controller keeps the physics stable."""
        return self.achieved.stable

    @property
    def verdict(self) -> str:
        """The outcome in words."""
        if self.promised.growth_rate > 0:
            text = (
                "The design DOES NOT STABILIZE ITS OWN MODEL: small deviations grow at "
                f"{self.promised.growth_rate:.3g} 1/s. Check the signs and the weights."
            )
            if self.achieved.growth_rate > 0:
                return f"{text} Nor does it stabilize the physics."
            return f"{text} Near its operating point the physics is stable."
        if self.achieved.growth_rate > 0:
            return (
                "The controller DOES NOT STABILIZE THE PHYSICS: the model is too different from "
                f"it. {self.failure}"
            )
        text = self._compare_margins()
        if self.achieved.growth_rate == 0:
            text += (
                " A pole at zero remains: a state that the controller does not hold, such as a "
                "position that it does not read, stays where a push has taken it."
            )
        if self.failure is not None:
            return f"{text} This is for small signals: WITH THE STEP THE LOOP DIVERGES. " + (
                self.failure
            )
        restless = [s for s in self.steps if np.isfinite(s.promised.settling_time)
                    and not np.isfinite(s.achieved.settling_time)]  # fmt: skip
        if restless:
            names = write_list([f"{s.reference} by {self._write_height(s)}" for s in restless])
            reasons = [explain_unsettled(self.loop, s.output, s.height) for s in restless]
            return (f"{text} WITH THE STEP OF {names} THE RESPONSE DOES NOT SETTLE. "
                    + " ".join(dict.fromkeys(reasons)))  # fmt: skip
        return f"{text} {self._compare_steps()}".rstrip()

    def _write_height(self, step: ReferenceStep) -> str:
        """Return the height of a step with the unit of what it asks for, where that is known."""
        followed = find_followed(self.loop, self.model, step.reference)
        return write_quantity(step.height, self.loop.known_units.get(followed or "", ""))

    def _compare_margins(self) -> str:
        """Return what became of the smallest promised phase margin."""
        inputs = self.loop.signals["u"]
        pairs = [(p.phase_margin - a.phase_margin, p, a, name) for name, p, a in
                 zip(inputs, self.promised.margins, self.achieved.margins, strict=True)
                 if np.isfinite([p.phase_margin, a.phase_margin]).all()]  # fmt: skip
        if not pairs:
            return "The controller keeps the physics stable."
        loss, p, a, name = max(pairs, key=lambda pair: pair[0] / pair[1].phase_margin)
        text = (
            f"At {name} the model promises a phase margin of {p.phase_margin:.1f} deg; achieved on "
            f"the physics are {a.phase_margin:.1f} deg"
        )
        if loss > CLOSE * p.phase_margin:
            return f"{text}: {loss:.1f} DEGREES OF PHASE MARGIN ARE LOST."
        return f"{text}, so the controller keeps the physics stable."

    def _compare_steps(self) -> str:
        """Return how far the responses are from the promised ones."""
        far = []
        for step in self.steps:
            k = self.loop.signals["y"].index(step.output)
            promised, achieved = step.promised.y[k], step.achieved.y[k]
            size = np.max(np.abs(promised), initial=0.0)
            if len(promised) == len(achieved) and size:
                far.append((float(np.max(np.abs(achieved - promised)) / size), step.reference))
        if not far:
            return ""
        share, name = max(far)
        if share > CLOSE:
            return (f"THE STEP OF {name} DIFFERS from what is promised by up to "
                    f"{100 * share:.0f} % of its size.")  # fmt: skip
        kept = f"The steps are as promised within {max(math.ceil(100 * share), 1)} % of their size"
        tails = [
            f"{s.reference} settles after {s.achieved.settling_time:.4g} s where "
            f"{s.promised.settling_time:.4g} s is promised"
            for s in self.steps
            if settles_otherwise(s.promised.settling_time, s.achieved.settling_time, self.loop.dt)
        ]
        return f"{kept}, but {write_list(tails)}: {TAIL}." if tails else f"{kept}."

    @property
    def rows(self) -> tuple[tuple[str, str, str], ...]:
        """Return quantity, promised and achieved value as printed, row by row."""
        sides = (self.promised, self.achieved)

        def row(label: str, values: Iterable[str]) -> tuple[str, str, str]:
            promised, achieved = values
            return label, promised, achieved

        made = [
            row("slowest pole [rad/s]", (_write_slowest(side.poles) for side in sides)),
            row("smallest damping ratio", (write_or_dash(side.damping, ".3f") for side in sides)),
        ]
        for k, name in enumerate(self.loop.signals["u"]):
            for label, field, form in (
                ("phase margin at {} [deg]", "phase_margin", ".2f"),
                ("gain margin at {} [factor]", "gain_margin", ".3f"),
                ("gain reduction margin at {}", "gain_reduction_margin", ".3f"),
                ("delay margin at {} [s]", "delay_margin", ".3g"),
            ):
                values = (write_or_dash(getattr(side.margins[k], field), form) for side in sides)
                made.append(row(label.format(name), values))
        if np.isfinite(self.promised.disk_margin):
            values = (write_or_dash(side.disk_margin, ".3f") for side in sides)
            made.append(row("disk margin [1]", values))
        for step in self.steps:
            both = (step.promised, step.achieved)
            for label, field, form in (
                (f"final {step.output} per unit", "final_value", ".3f"),
                (f"overshoot of {step.output} [%]", "overshoot", ".2f"),
                ("settling time [s]", "settling_time", ".4g"),
            ):
                values = (write_or_dash(getattr(side, field), form) for side in both)
                made.append(row(f"step of {step.reference}: {label}", values))
            made += [
                row(f"step of {step.reference}: largest change of {signal}", texts)
                for signal, texts in self._list_peaks(step)
            ]
        return tuple(made)

    def _list_peaks(self, step: ReferenceStep) -> list[tuple[str, list[str]]]:
        """Return the largest deviations of inputs, and of outputs that do not follow the step."""
        signals, units = self.loop.signals, self.loop.known_units
        peaks = [
            ("peak_outputs", k, name) for k, name in enumerate(signals["y"]) if name != step.output
        ]
        peaks += [("peak_inputs", k, name) for k, name in enumerate(signals["u"])]
        return [
            (name, [write_quantity(getattr(side, field)[k],
                                   units.get(name, ""), digits=3) if side.u.size else "-"
                    for side in (step.promised, step.achieved)])
            for field, k, name in peaks
        ]  # fmt: skip

    def __str__(self) -> str:
        rows = self.rows
        width = max(len(label) for label, _, _ in rows) + 2
        table = [
            f"  {a:<{width}}{b:>18}{c:>18}" for a, b, c in (("", "promised", "achieved"), *rows)
        ]
        kind = "analog" if self.loop.analog else f"digital, {self.loop.dt:g} s"
        wiring = self.loop.wiring
        lines = () if wiring is None else tuple(f"    {line}" for line in wiring.lines)
        head = f"controller: {type(self.controller).__name__}, {kind}"
        heights = [f"{s.reference} by {self._write_height(s)}" for s in self.steps]
        tried = (
            f"  Achieved steps ({', '.join(heights)}) are those of the nonlinear physics. "
            f"{advise_step(self.loop)}" if heights else
            "  The controller has no reference to step."
        )  # fmt: skip
        reasons = [f"  {text}" for text in dict.fromkeys(s.reason for s in self.steps) if text]
        lacking = [
            "  The disk margin of several inputs is not known: python-control needs slycot for it."
        ] if len(self.promised.margins) > 1 and np.isnan(self.promised.disk_margin) and (
            self.promised.growth_rate <= 0) else []  # fmt: skip
        return "\n".join([head, *lines, *table, *lacking, tried, *reasons, "  " + self.verdict])


def _write_slowest(poles: ComplexArray) -> str:
    """Return the pole with the largest real part."""
    if not len(poles):
        return "-"
    pole = poles[int(np.argmax(poles.real))]
    if abs(pole.imag) <= 1e-9 * abs(pole):
        return f"{pole.real:.4g}"
    return f"{pole.real:.4g} ± {abs(pole.imag):.4g}j"
