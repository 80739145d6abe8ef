"""Why the response to a step may not settle on the physics of a loop, by what the loop has."""

import numpy as np

from .._base.text import with_unit, write_list, write_number, write_quantity
from ..effects import (
    AsymmetricCoulombFriction,
    CoulombFriction,
    InputBacklash,
    InputDeadZone,
    InputRateLimit,
    InputSaturation,
    StribeckFriction,
)
from ..loop.loop import Loop, find_converter_steps
from ..physics.trace import trace

# A response has settled when it stays within this share of its final value.
SETTLED = 0.02
# Settling times that differ by more than this share are said to.
OTHER_TIME = 0.25
TAIL = f"the response stays near the edge of the {100 * SETTLED:.0f} % that count as settled"
FRICTION = (AsymmetricCoulombFriction, CoulombFriction, StribeckFriction)


def find_reading_step(loop: Loop, output: str) -> float:
    """Return the step in which an output is read, as by an encoder; 0 where it has none.

    Parameters
    ----------
    loop : Loop
        The loop with its effects.
    output : str
        Name of the output.

    Returns
    -------
    float
        The largest step of a `Quantization` of this output [unit of the output].
    """
    steps = dict(zip(loop.signals["y"], find_converter_steps(loop), strict=True))
    return steps.get(output, 0.0)


def settles_otherwise(promised: float, achieved: float, dt: float) -> bool:
    """Return whether two settling times [s] differ by much, and by more than the samples resolve.

    A response that is nearly the promised one may have a tail just outside what counts as settled.
    """
    apart = abs(achieved - promised)
    return bool(np.isfinite(apart) and apart > max(OTHER_TIME * promised, 1.5 * dt))


def explain_unsettled(loop: Loop, output: str, height: float) -> str:
    """Return what may keep a response from settling, of what this very loop has.

    Parameters
    ----------
    loop : Loop
        The physics with its controller.
    output : str
        The output that follows the step.
    height : float
        Height of the step [unit of the output].

    Returns
    -------
    str
        Sentences.
    """
    reasons = [
        *_explain_reading(loop, output, height), *_explain_kinks(loop), *_explain_limits(loop),
        *_explain_bends(loop),
    ]  # fmt: skip
    if not reasons:
        return (
            "Nothing in this loop is known to hold it or to bend it, so that it is slower than "
            "what is simulated."
        )
    return f"In this loop the reason may be: {'; '.join(reasons)}."


def _explain_reading(loop: Loop, output: str, height: float) -> list[str]:
    """Say how the step compares with that of an encoder."""
    step = find_reading_step(loop, output)
    if not step:
        return []
    unit = loop.known_units.get(output, "")
    count = abs(height) / step
    text = (
        f"{output} is read in steps of {write_quantity(step, unit)} (Quantization), of which the "
        f"step of the reference is {write_number(count, 3)}"
    )
    if count * SETTLED < 1:
        text += (
            f", so that the {100 * SETTLED:.0f} % within which a response counts as settled are "
            "less than one of them"
        )
    return [text]


def _explain_kinks(loop: Loop) -> list[str]:
    """Say what may hold the plant or leave it without force near rest."""
    found = []
    for kinds, one, several in (
        (FRICTION, "holds the plant where it stands", "hold the plant where it stands"),
        ((InputDeadZone, InputBacklash), "takes away small motions of the input",
         "take away small motions of the input"),
    ):  # fmt: skip
        names = [k for k, e in loop.labelled.items() if isinstance(e, kinds) and not e.neutral]
        if names:
            found.append(f"{write_list(names)} {one if len(names) == 1 else several}")
    return found


def _explain_limits(loop: Loop) -> list[str]:
    """Say which inputs have a limit."""
    inputs = loop.signals["u"]
    lower, upper = (np.broadcast_to(v, len(inputs)) for v in loop.input_limits)
    units = loop.known_units
    found = [
        f"{with_unit(name, units.get(name, ''))} reaches its limits ({low:g} to {high:g})"
        for name, low, high in zip(inputs, lower, upper, strict=True)
        if np.isfinite([low, high]).any()
    ]
    for kind, said in (
        (InputSaturation, "limits the input"), (InputRateLimit, "limits how fast the input moves"),
    ):  # fmt: skip
        found += [f"{k} {said}" for k, e in loop.labelled.items() if isinstance(e, kind)]
    return found


def _explain_bends(loop: Loop) -> list[str]:
    """Say whether the physics is linear, of which no step can leave the range."""
    found = []
    if loop.equations().bent:
        found.append("the physics is not linear, and the step leaves the range where it nearly is")
    if not loop.linear_plant and trace(loop.plant).has_sign:
        found.append("the equations of the plant contain a sign, as of dry friction")
    return found
