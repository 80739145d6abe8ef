"""What the pictures show, apart from the drawing: units, windows, poles and frequency grids."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import control as ct
import numpy as np

from .._base import text as _text
from .._base.arrays import Array
from .._base.errors import CtrlidError
from ..diagnosis.findings import BinnedErrors, Candidate, Gap
from ..diagnosis.result import Diagnosis
from ..diagnosis.thresholds import THRESHOLD
from ..effects.base import name_at_place, name_with_subject
from ..physics.trace import timebase
from ..validation.comparison import Comparison

# So many samples of a comparison can be told apart on a page.
WINDOW = 250
# So many candidates of a round are drawn.
BARS = 7
# So many poles are listed in a legend, a pair of conjugates as one.
POLES = 6
LEAST = -10.0  # A net gain below says no more than this one.


def choose_scale(signals: Sequence[Array], unit: str) -> tuple[float, str]:
    """Return a factor and the unit it leads to: millimetres rather than 0.03 m."""
    if not unit:
        return 1.0, "unit not given"
    return _text.choose_prefix(max(float(np.abs(s).max()) for s in signals), unit)


def find_telling_window(comparison: Comparison) -> int:
    """Return the first sample of a lively window with a usual error."""
    whole = comparison.record
    n, width = len(whole), min(WINDOW, len(whole))
    if n == width or not comparison.curves:
        return 0
    curve = comparison.curves[-1].y
    known = whole.valid & np.isfinite(curve)
    starts = np.arange(0, n - width + 1, max(width // 5, 1))

    def means(values: Array) -> Array:
        total = np.concatenate([[0.0], np.cumsum(np.where(known, values, 0.0))])
        mean: Array = (total[starts + width] - total[starts]) / width
        return mean

    y = whole.y - np.mean(whole.y)
    full = means(np.ones(n))
    movement = means(y**2) - means(y) ** 2
    movement[full < 0.95 * full.max()] = -np.inf
    error = means((np.where(known, curve, whole.y) - whole.y) ** 2)
    lively = movement >= np.median(movement[np.isfinite(movement)])
    usual = np.abs(error - np.median(error[lively]))
    return int(starts[np.argmin(np.where(lively, usual, np.inf))])


def check_models(models: Any, who: str, several: bool = False) -> dict[str, Any]:
    """Return models by label, a single one by its name, or refuse in the name of a picture.

    Those of several signals are refused unless the picture can show them.
    """
    if isinstance(models, ct.TransferFunction | ct.StateSpace):
        models = {models.name: models}
    if not isinstance(models, Mapping) or not models:
        raise CtrlidError(f"{who} takes a mapping from labels to models, {{'fitted': G}}, with at "
                          f"least one model; given {type(models).__name__}")  # fmt: skip
    for label, model in models.items():
        if not isinstance(model, ct.TransferFunction | ct.StateSpace):
            raise CtrlidError(f"{who}: {label!r} must be a TransferFunction or StateSpace; given "
                              f"{type(model).__name__}")  # fmt: skip
        if not several and (model.ninputs != 1 or model.noutputs != 1):
            raise CtrlidError(f"{who}: {label!r} must have one input and one output")
    return {str(k): m for k, m in models.items()}


def find_period(models: Mapping[str, Any]) -> float:
    """Return the one sampling period among the models, 0 if all are continuous."""
    periods = {k: timebase(m) for k, m in models.items() if timebase(m)}
    if len({round(p, 12) for p in periods.values()}) > 1:
        listed = ", ".join(f"{k}: {p:g} s" for k, p in periods.items())
        raise CtrlidError(f"poles at different sampling periods cannot be compared ({listed}); "
                          "draw each period on its own axes")  # fmt: skip
    return next(iter(periods.values()), 0.0)


def find_poles(model: Any, dt: float) -> Any:
    """Return the poles in the z-plane of period dt (in the s-plane for 0), the outermost first."""
    # The fit knows its poles more accurately than the roots of its coefficients.
    estimate = getattr(model, "estimate", None)
    poles = np.asarray(model.poles() if estimate is None else estimate.poles, dtype=complex)
    poles = np.exp(poles * dt) if dt and not timebase(model) else poles
    poles = np.where(np.abs(poles.imag) < 1e-9 * np.maximum(np.abs(poles), 1.0), poles.real, poles)
    return poles[np.lexsort((-poles.imag, -poles.real))]


def list_poles(places: Any) -> str:
    """Return poles in words, a pair of conjugates once, and of many the first.

    Examples
    --------
    >>> list_poles(np.array([1.2, 0.5 + 0.1j, 0.5 - 0.1j]))
    '1.2, 0.5±0.1j'
    """
    listed = []
    for p in places:
        paired = p.imag and np.isclose(p.conjugate(), places, rtol=1e-9, atol=0).any()
        if paired and p.imag < 0:
            continue
        pair = f"{p.real:.4g}±{p.imag:.4g}j"
        listed.append(pair if paired else _text.write_number(p, 4))
    left = len(listed) - POLES
    return ", ".join([*listed[:POLES], *([f"and {left} more"] if left > 0 else [])]) or "none"


def make_frequency_grid(models: Mapping[str, Any]) -> Any:
    """Return a grid from well below the slowest to well above the fastest pole or zero."""
    corners, limits = [], []
    for model in models.values():
        dt = timebase(model)
        places = np.concatenate([np.atleast_1d(model.poles()), np.atleast_1d(model.zeros())])
        places = places[np.isfinite(places) & (np.abs(places) > 1e-12)].astype(complex)
        if dt:
            places = np.log(places) / dt
            limits.append(np.pi / dt)
        corners += [c for c in np.abs(places) if c > 1e-6 and (not dt or c < np.pi / dt)]
    corners = corners or [min(limits, default=1.0)]
    top = max(limits) if limits else 10 * max(corners)
    return np.geomspace(min(0.1 * min(corners), 0.01 * top), top, 600)


def find_largest_gap(gap: Gap) -> slice:
    """Return the stretch of the samples kept back in which the model errs most."""
    n = len(gap.time)
    width = min(WINDOW, n)
    if n == width:
        return slice(0, n)
    error = np.nan_to_num((gap.measured - gap.simulated_before) ** 2, posinf=0.0)
    step = np.diff(gap.time)
    # A window over a break in time shows none of its two sides.
    broken = np.abs(step - np.median(step)) > 0.5 * np.median(step)
    error[1:][broken] = -np.inf
    with np.errstate(invalid="ignore"):
        sums = np.convolve(np.where(np.isinf(error), -1e9 * (1 + error[error > 0].sum()), error),
                           np.ones(width), "valid")  # fmt: skip
    first = int(np.argmax(sums))
    return slice(first, first + width)


def choose_two_most_telling(found: Diagnosis) -> list[BinnedErrors]:
    """Return the two most telling places."""
    return sorted(found.where, key=lambda place: place.p_before)[:2]


Kind = Literal[
    "found", "in the model, but its name does not stand", "not told apart",
    "taken, later replaced or dropped", "fitted, not taken", "put out", "screened only, not fitted",
]  # fmt: skip


@dataclass(frozen=True)
class Bar:
    """One candidate of a ranking.

    Parameters
    ----------
    label : str
        Its name.
    net_gain : float
        Its gain of log-likelihood less the penalty of the Bayesian criterion.
    kind : str
        What became of it, in the words of the legend; of one that was only screened the gain is
        the score, which its first step expects.
    evidence : float
        The evidence of what was found, in the end: its gain over the model without it but with all
        other effects; NaN for others.
    fitted : bool
        Whether a fit has confirmed the gain.
    """

    label: str
    net_gain: float
    kind: Kind
    evidence: float = math.nan
    fitted: bool = True


def make_ranking(found: Diagnosis) -> dict[str, list[Bar]]:
    """Return the best candidates of each round as bars, the best first, by the round in words."""
    value = {id(c): _compute_net_gain(c) for c in found.ranking}
    kinds: dict[int, Kind] = {}
    evidence: dict[int, float] = {}
    for finding in found.added:
        # Once it is taken an effect is no candidate any more, so that it was taken in the last
        # round in which it earned a place. One that was read off the record has no bar.
        own = [c for c in found.ranking
               if name_with_subject(c.effect) == name_with_subject(finding.effect)
               and value[id(c)] > 0 and id(c) not in kinds]  # fmt: skip
        others = {name_with_subject(e) for e in finding.alternatives}
        # Records that were diagnosed alone have a search each.
        for record in {c.record for c in own} & {0, *finding.records}:
            searched = [c for c in own if c.record == record]
            earned = [c for c in searched if value[id(c)] > THRESHOLD.gate] or searched
            taken = max(earned, key=lambda c: (c.taken, c.round))
            stands = finding in found.findings
            kinds[id(taken)] = "found" if stands else "in the model, but its name does not stand"
            # The evidence of all records together is that of none of them.
            evidence[id(taken)] = math.nan if record else finding.evidence
            for c in found.ranking:
                alike = (
                    name_with_subject(c.effect) in others
                    or name_at_place(c.effect) in finding.equivalents
                )
                if (c.record, c.round) == (record, taken.round) and alike:
                    kinds.setdefault(id(c), "not told apart")
    rounds: dict[str, list[Bar]] = {}
    for record, number in sorted({(c.record, c.round) for c in found.ranking}):
        tried = sorted((c for c in found.ranking if (c.record, c.round) == (record, number)),
                       key=lambda c: (id(c) not in kinds, -value[id(c)]))  # fmt: skip
        shown = sorted(tried[:BARS], key=lambda c: -value[id(c)])
        rounds[tried[0].round_name] = [
            Bar(name_with_subject(c.effect), value[id(c)], kinds.get(id(c), _tell_kind(c)),
                evidence.get(id(c), math.nan), math.isfinite(c.gain))
            for c in shown
        ]  # fmt: skip
    return rounds


def _tell_kind(c: Candidate) -> Kind:
    """Return what became of a candidate that is not in the answer."""
    if c.taken:
        return "taken, later replaced or dropped"
    if c.remark:
        return "put out"
    return "fitted, not taken" if math.isfinite(c.gain) else "screened only, not fitted"


# What is told of bars beyond the line that are no names, by what became of the candidate.
REASONS: dict[Kind, str] = {
    "taken, later replaced or dropped": "One that was taken gives way where, at the end, another "
    "explains the record as well or better, or where it is superfluous or widens the gap.",
    "put out": "One is put out where its gain proves nothing; 'What was tried' in the report of "
    "write_report() says why.",
    "screened only, not fitted": "The gain of one that was only screened is a rough estimate by "
    "one step of a fit; it fell too far behind the best of its round to be fitted.",
    "in the model, but its name does not stand": "The note of one whose name does not stand says "
    "on what ground.",
}  # fmt: skip


def explain_bars(rounds: Mapping[str, Sequence[Bar]]) -> str:
    """Say why candidates beyond the line need not be names; empty where there are none."""
    beyond = {bar.kind for bars in rounds.values() for bar in bars
              if bar.net_gain > THRESHOLD.gate} - {"found"}  # fmt: skip
    if not beyond:
        return ""
    words = ["A bar beyond the dashed line need not be a name: each round takes one effect, and "
             "the others must earn their place again beside it in the next round."]  # fmt: skip
    words += [text for kind, text in REASONS.items() if kind in beyond]
    if any(map(_took_shorter_bar, rounds.values())):
        words.append("A shorter bar is taken where the search looked back and saw that it leads "
                     "further, together with the next effect.")  # fmt: skip
    return " ".join(words)


def _took_shorter_bar(bars: Sequence[Bar]) -> bool:
    """Whether a round took an effect that gains less than another which stood to be taken."""
    kept = ("found", "in the model, but its name does not stand",
            "taken, later replaced or dropped")  # fmt: skip
    best = max((bar.net_gain for bar in bars if bar.kind in kept), default=math.inf)
    return any(bar.net_gain > best for bar in bars if bar.kind == "fitted, not taken")


def _compute_net_gain(c: Candidate) -> float:
    gain = c.gain if math.isfinite(c.gain) else c.score
    return max(gain - c.penalty, LEAST) if math.isfinite(gain) else LEAST


def scale_edges(place: BinnedErrors) -> tuple[Array, str]:
    """Return the edges of the bins of a place as they are drawn, and the title of their axis."""
    edges = np.array(place.edges, dtype=float)
    # A bin without an end is drawn as wide as its neighbour.
    if not np.isfinite(edges[0]):
        edges[0] = 2 * edges[1] - edges[2]
    if not np.isfinite(edges[-1]):
        edges[-1] = 2 * edges[-2] - edges[-3]
    factor, unit = choose_scale([edges], place.unit)
    of = f", errors of {place.output}" if place.output else ""
    return factor * edges, f"{place.axis} [{unit}]{of}"
