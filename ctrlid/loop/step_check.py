"""Whether the readings of a record have steps of which its loop knows nothing."""

import numpy as np

from .._base.statistics import rounding_variance
from .._base.text import write_list, write_percent
from ..data.converter_grid import find_grid_step
from ..data.record import Record
from .loop import Loop, find_converter_steps
from .unit_check import list_recorded_units

# Rounding that makes so much of the noise's variance is worth a word; `diagnose` adds the steps to
# the loop from the same share on.
COARSE = 0.25


def describe_unstated_steps(loop: Loop, record: Record, noise: object) -> str:
    r"""Say that readings have steps which make much of their noise, and what to type for them.

    Rounding to steps q adds a variance of :math:`q^2/12`, which is no white noise while a plant
    rests or moves slowly.

    Parameters
    ----------
    loop : Loop
        The loop.
    record : Record
        A record with the signals of the loop, in its order.
    noise : float or sequence of float
        Standard deviation of the noise of each output [its unit].

    Returns
    -------
    str
        Sentences that begin in capitals; empty where the loop has the steps or they are fine.
    """
    e = loop.equations()
    rows = np.reshape(record.y, (-1, len(record)))
    sizes = np.broadcast_to(np.asarray(noise, dtype=float), len(rows))
    each = [unit for key, _, unit in list_recorded_units(loop, record) if key == "y"]
    told, typed = [], []
    for name, y, use, stated, size, unit in zip(
        e.outputs, rows, record.valid_outputs, find_converter_steps(loop), sizes, each, strict=True
    ):
        step = 0.0 if stated or not use.any() else find_grid_step(y[use])
        made = float(rounding_variance(step))
        if not step or made < COARSE * size**2:
            continue
        share = write_percent(min(made / size**2, 1.0)) if size else "all"
        signal = "y" if e.siso else name
        told.append(f"{signal} in steps of {step:.6g}{f' {unit}' if unit not in ('', '1') else ''}"
                    f", whose rounding makes {share} of the variance of its noise")  # fmt: skip
        place = "" if e.siso else f", at={name!r}"
        typed.append(f"Quantization(step={step:.6g}{place})")
    if not told:
        return ""
    add = "".join(f".with_effect(ctrlid.effects.{one})" for one in typed)
    return (f"THE READINGS HAVE STEPS: the record has {write_list(told)}, and the loop has no "
            "Quantization. While the plant rests or moves slowly such noise is not white, which "
            "may be all that seems to be missing. Give the loop the steps and look again: "
            f"loop{add}.")  # fmt: skip
