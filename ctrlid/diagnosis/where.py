"""Step 3: where along time, frequency, position, velocity and input innovations are not noise."""

from collections.abc import Mapping

import numpy as np

from .._base.arrays import Array
from .constancy import find_bin_edges, find_bins
from .findings import BinnedErrors
from .noise_tests import NoiseTests
from .thresholds import THRESHOLD


def locate_errors(
    before: NoiseTests, after: NoiseTests, units: Mapping[str, str]
) -> tuple[BinnedErrors, ...]:
    """Return where the innovations are not noise, before and after; most telling first."""
    if before.outputs:
        each = [
            place
            for name, one in before.outputs.items()
            for place in _locate_output(one, after.outputs[name], units, name)
        ] if after.outputs else []  # fmt: skip
        return tuple(sorted(each, key=lambda place: place.p_before))
    return _locate_output(before, after, units)


def _locate_output(
    before: NoiseTests, after: NoiseTests, units: Mapping[str, str], output: str = ""
) -> tuple[BinnedErrors, ...]:
    """Return where the innovations of one output are not noise; it has a name among several."""
    found: list[BinnedErrors] = []
    for name in before.axes:
        # The model without the effects may have been where the rig never was.
        values = after.axes.get(name, np.zeros(0))
        if len(values) != len(before.axes[name]):
            continue
        edges = find_bin_edges(values)
        index = find_bins(values, edges)
        count = np.maximum(np.bincount(index, minlength=len(edges) - 1), 1)
        was, now = (np.bincount(index, o.z**2, minlength=len(count)) / count
                    for o in (before, after))  # fmt: skip
        p_was, p_now = (
            min(1.0, 2 * min(o.p_values[f"{what} by {name}"] for what in ("mean", "size")))
            for o in (before, after)
        )
        unit = units.get(name, "")
        # What only the effects brought in sits where the errors with them are.
        brought_in = p_now < THRESHOLD.telling <= p_was
        z, since = (after.z, "afterwards ") if brought_in else (before.z, "")
        words, told = _describe_place(name, unit, edges, z, index, count, output, since)
        found.append(BinnedErrors(name, unit, edges, was, now, p_was, p_now, words, output, told))
    return tuple(sorted(found, key=lambda place: place.p_before))


def _describe_place(
    name: str, unit: str, edges: Array, z: Array, index: Array, count: Array, output: str,
    since: str,
) -> tuple[str, int]:  # fmt: skip
    """Return where the errors are farthest from noise, in words, and the bin."""
    mean = np.bincount(index, z, minlength=len(count)) / count
    square = np.bincount(index, z**2, minlength=len(count)) / count
    strength = np.sqrt(count) * np.abs(mean)
    spread = np.sqrt(count / 2) * np.abs(square - 1)
    k = int(np.argmax(np.maximum(strength, spread)))
    unit = "" if unit == "1" else unit
    place = f"at {name} from {edges[k]:.4g} to {edges[k + 1]:.4g} {unit}".rstrip()
    if strength[k] >= spread[k]:
        side = "above" if mean[k] > 0 else "below"
        what = output or "the output"
        return (f"{place}, {since}{what} is {side} its prediction by {abs(mean[k]):.2g} standard "
                "deviations on average", k)  # fmt: skip
    side = "larger" if square[k] > 1 else "smaller"
    errors = f"the one-step errors of {output}" if output else "the one-step errors"
    return f"{place}, {since}{errors} are {side} than noise", k
