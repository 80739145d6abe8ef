"""Step 10: the decision table, and the verdict in words."""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from .._base.text import write_p_value, write_quantity
from ..effects import AbstractEffect
from ..effects.base import name_with_subject
from ..estimation.likelihood.likelihood import Fit
from .findings import BinnedErrors, Disturbance, Finding, Gap, SensorNoise, Verdict
from .noise_tests import NoiseTests, choose_alarm_level
from .thresholds import THRESHOLD
from .wording import join_names, name_test

if TYPE_CHECKING:
    from .result import Diagnosis


def choose_verdict(complete: bool, named: bool) -> Verdict:
    """Return the verdict by the decision table.

    ==========================  =================  =====================
    what is left                something named    nothing named
    ==========================  =================  =====================
    noise, on fresh data too    explained          nothing missing
    more, or the names are      partly explained   unknown
    doubtful together
    ==========================  =================  =====================

    Parameters
    ----------
    complete : bool
        Whether the tests pass, the gap on fresh data is that of noise, and the names together are
        above doubt.
    named : bool
        Whether any effect was named.
    """
    if complete:
        return "explained" if named else "nothing missing"
    return "partly explained" if named else "unknown"


def gap_is_left(
    gap: Gap, disturbance: Disturbance, fit: Fit, excess_chance: float, worse_chance: float
) -> bool:
    """Whether the gap with the effects shows that something is left.

    A random force that may do anything explains everything, and nothing: beside one, a gap wider
    than that of the model as given is no explanation. Neither counts where it may be chance: forty
    predictions that overlap by forty samples say as much as one or two.

    Parameters
    ----------
    gap : Gap
        The gap on fresh data.
    disturbance : Disturbance
        The random forces of the model.
    fit : Fit
        The fit of the model.
    excess_chance : float
        Probability that noise alone makes predictions err so much; NaN for a simulation.
    worse_chance : float
        Probability that chance alone makes the gap so much wider than that of the model as given.
    """
    blamed = disturbance.large or math.isnan(disturbance.share)
    worse = gap.after > THRESHOLD.worse_than_given * gap.given
    worse = worse and worse_chance < THRESHOLD.beyond_chance
    return gap_stands_out(gap, fit, excess_chance) or (blamed and worse)


def find_doubt(
    effects: Sequence[AbstractEffect], gains: Sequence[float], total: float
) -> str | None:
    """Say why effects that explain a record together may yet be no explanation.

    Parameters
    ----------
    effects : sequence of effects
        Those that were found.
    gains : sequence of float
        What each gains of log-likelihood beside the others.
    total : float
        What they gain together.

    Returns
    -------
    str or None
        The reason; None if there is none.
    """
    if len(effects) >= THRESHOLD.many_effects:
        return "so many effects together can describe almost any error"
    for (kind, _), count in Counter((type(e), e.at) for e in effects).items():
        if count > 1 and kind.doubt_of_several is not None:
            return kind.doubt_of_several
    if len(effects) >= THRESHOLD.some_effects and min(gains) < THRESHOLD.slight_effect * max(gains):
        return "the smallest of these effects may only correct an error in the form of a larger one"
    for one, other in itertools.combinations(range(len(effects)), 2):
        alone = max(gains[one], gains[other]) < THRESHOLD.residue * total
        if alone and _are_look_alikes(effects[one], effects[other]):
            names = [name_with_subject(effects[k]) for k in (one, other)]
            return (f"{names[0]} and {names[1]} are look-alikes, and either alone explains nearly "
                    "all of the error: both may stand in for one other effect")  # fmt: skip
    return None


def blame_slow_force(disturbance: Disturbance, unit: str) -> str | None:
    """Say that a slow force moves the plant, where it makes most of what noise accounts for.

    White noise is what any plant has. What pushes it the same way for many samples is something,
    even where the catalogue has no name for it: a parameter that wanders, say, or the wind.

    Parameters
    ----------
    disturbance : Disturbance
        The random forces of a model in which nothing was named.
    unit : str
        Unit of the force.

    Returns
    -------
    str or None
        What acts, as a clause; None where no slow force is large.
    """
    if not (disturbance.large and disturbance.coloured):
        return None
    return (f"{_describe_slow_force(disturbance, unit)} acts on the plant, and causes "
            f"{_write_share(disturbance)}")  # fmt: skip


def _describe_slow_force(disturbance: Disturbance, unit: str) -> str:
    # Where forces act on several states, this one has no unit of its own.
    size = write_quantity(disturbance.coloured, "" if disturbance.forces else unit, digits=2)
    time = write_quantity(disturbance.time_constant, "s", digits=2)
    return f"a slowly varying random force of {size} RMS with a time constant of {time}"


def _write_share(disturbance: Disturbance) -> str:
    return f"{100 * disturbance.share:.0f} % of the variance of the noise floor"


def _are_look_alikes(one: AbstractEffect, other: AbstractEffect) -> bool:
    """Whether one of two effects is known to resemble the other."""
    if one.place == other.place and one.at != other.at:
        return False
    names = type(one).__name__, type(other).__name__
    return names[1] in type(one).look_alikes or names[0] in type(other).look_alikes


def gap_stands_out(gap: Gap, fit: Fit, chance: float = math.nan) -> bool:
    """Whether the gap with the effects is wider than noise, as a fit knows it, accounts for.

    A loop that hunts leaves a narrow gap in one run and a wide one in another; the record is but
    one more run, so the widest of several counts.

    Parameters
    ----------
    gap : Gap
        The gap on fresh data.
    fit : Fit
        The fit of the model.
    chance : float, optional
        Probability that noise alone makes predictions err so much; NaN where it is not known, as
        for a simulation.
    """
    noise = max(gap.floor, gap.widest)
    return (
        math.isfinite(noise)
        and gap.after > THRESHOLD.excess * (2 if fit.noise.drift else 1) * noise
        and not chance > THRESHOLD.beyond_chance
    )


def gap_is_wider(gap: Gap, disturbance: Disturbance) -> bool:
    """Whether effects leave a wider gap than sensor noise does, by itself, in a loop with them.

    Two gaps about the floor say nothing of names: a drift that was fitted to three quarters of a
    record is off by its error in the last one. A loop that hunts is followed by no simulation for
    long, so that the widest of several runs counts.
    """
    noise = max(gap.floor, gap.widest)
    by_noise = not disturbance.large and gap.after <= THRESHOLD.excess * noise
    return max(gap.before, gap.floor) < gap.after and not by_noise


def describe_grounds(stand_ins: Sequence[tuple[Finding, str]]) -> str | None:
    """Say why names do not stand, in one clause; None without any."""
    grounds: dict[str, dict[str, None]] = {}
    for f, why in stand_ins:
        grounds.setdefault(join_names([f]), {})[why] = None
    words = [f"the name {name} does not stand, since {' and since '.join(reasons)}"
             for name, reasons in grounds.items()]  # fmt: skip
    return ", and ".join(words) or None


def declare_unfinished(found: Diagnosis, place: str, spent: str) -> Diagnosis:
    """Return a diagnosis whose search was stopped, which claims no more than was checked.

    Parameters
    ----------
    found : Diagnosis
        The answer so far.
    place : str
        Where the search was, in words.
    spent : str
        After how long or how much it was stopped, in words.

    Returns
    -------
    Diagnosis
        Its verdict is ``"partly explained"`` or ``"unknown"``.
    """
    named = bool(found.findings)
    level = choose_alarm_level(len(found.findings))
    noise = min(found.tests.values(), default=1.0) * len(found.tests) > level
    left = "only noise is left so far" if noise else "what is left is not noise alone"
    so_far = (
        f"So far the model lacks {join_names(found.findings)}" if named else "Nothing is named yet"
    )
    sentence = (
        f"THE SEARCH WAS NOT FINISHED: it was stopped after {spent} "
        f"({place}). {so_far}, and {left}. What was not tried may explain it better. Give the "
        "search more time, or fewer effects to try."
    )
    return replace(found, verdict=choose_verdict(False, named), sentence=sentence, finished=False)


def _deny_tried(tried: int) -> str:
    """Say that nothing which was tried explains the error."""
    if tried == 1:
        return "The one effect of the catalogue does not explain it"
    return f"None of the {tried} effects of the catalogue explains it"


def write_conclusion(
    verdict: Verdict, findings: Sequence[Finding], gap: Gap, disturbance: Disturbance,
    after: NoiseTests, where: Sequence[BinnedErrors], objection: str | None = None,
    tried: int = 0, stand_ins: Sequence[tuple[Finding, str]] = (),
    noise: SensorNoise | None = None,
) -> str:  # fmt: skip
    """Return the verdict with what it rests on.

    Parameters
    ----------
    verdict : str
        The verdict.
    findings : sequence of Finding
        The effects found.
    gap : Gap
        The gap.
    disturbance : Disturbance
        The random forces.
    after : NoiseTests
        The tests of what is left.
    where : sequence of BinnedErrors
        Where the disagreement sits.
    objection : str, optional
        Why effects that leave nothing but noise may yet be no explanation.
    tried : int, optional
        How many effects of the catalogue were tried.
    stand_ins : sequence of (Finding, str), optional
        Effects in the model whose names do not stand, with the ground of each.
    noise : SensorNoise, optional
        The noise of the sensor, told beside a clean bill that needs more than white noise.

    Returns
    -------
    str
        A few sentences.
    """
    names = join_names(findings)
    name, p = after.worst
    why = f"the test of {name_test(name)} fails ({write_p_value(p)})"
    if after.passed:
        why = "on the samples kept back, the RMS error is well above the noise floor"
        if gap.after > gap.given:
            why = "on the samples kept back, the RMS error exceeds that of the model as given"
    verb, them = ("explain", "them") if len(findings) > 1 else ("explains", "it")
    if verdict == "nothing missing":
        text = ("No effect that is large enough to show in this record is missing: the residuals "
                "are noise.")  # fmt: skip
        if noise is not None and noise.kind != "white":
            text += f" {noise}"
    elif verdict == "explained":
        text = f"The model lacks {names}. With {them} the residuals are noise."
    elif after.passed and objection is not None:
        every = [*findings, *(f for f, _ in stand_ins)]
        if every:
            text = f"With {join_names(every)} the residuals are noise, but {objection}."
        else:
            text = f"The residuals are noise, but {objection}. {_deny_tried(tried)}."
    elif verdict == "partly explained":
        text = (f"{names} {verb} part of the error. The rest is not noise alone: {why}. "
                f"{_deny_tried(tried)}.")  # fmt: skip
    else:
        text = (f"The error is not noise alone: {why}. {_deny_tried(tried)}."
                )  # fmt: skip
    doubted = after.passed and objection is not None
    grounds = None if doubted else describe_grounds(stand_ins)
    if grounds is not None:
        text += f" {grounds[:1].upper()}{grounds[1:]}."
    left = [w for w in where if w.p_after < THRESHOLD.surely_left]
    if left and verdict in ("partly explained", "unknown"):
        axes = list(dict.fromkeys(w.axis for w in left))[:2]
        text += f" The remaining error depends on {' and '.join(axes)}."
    told = verdict == "unknown" and not stand_ins and doubted
    if disturbance.large and not told:
        kind = "a random force"
        if disturbance.coloured:
            kind = _describe_slow_force(disturbance, gap.force_unit)
        text += (f" {kind[:1].upper()}{kind[1:]} causes {_write_share(disturbance)}. It is treated "
                 "as noise here, and may hide a missing effect.")  # fmt: skip
    return text
