"""Step 9: the gap before and after, and what each effect closes of it."""

import math
import weakref
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from .._base.arrays import Array
from .._base.units import fill_unit
from ..estimation.likelihood.filter_data import (
    find_noise_units,
    has_several_noises,
    name_noise_places,
)
from ..estimation.likelihood.likelihood import Fit
from ..loop.loop import Loop
from ..validation.reproduction import (
    CLOSED_LOOP,
    choose_prediction,
    find_longest_horizon,
)
from . import gap as gaps
from .findings import Disturbance, Gap, GapKind
from .fitted_model import Model
from .fresh_data import FreshData
from .growth import Search, exchange_worst_effect
from .removal import Weighed
from .thresholds import THRESHOLD
from .verdict import gap_is_wider

Found = TypeVar("Found")

DIVERGES = (
    "the {} of the completed model diverges on the samples kept back. Where the controller hardly "
    "holds the plant, noise alone is enough for that, so the gap is that of predictions"
)
DOUBTFUL = (
    "the {} of the completed model depends on the last digits of its parameters: values within "
    "their standard errors move it as far from the fitted ones as the record is from them, as "
    "where a plant may come to rest in one of several places. So the gap is that of predictions"
)


@dataclass(frozen=True, eq=False)
class GapSummary:
    """The gap, what each effect closes of it by its position in the loop, and the random force.

    `excess_chance` is the probability that noise alone makes predictions err so much, NaN for a
    simulation; `worse_chance` is the probability that chance alone makes the gap so much wider than
    that of the model as given.
    """

    gap: Gap
    shares: Mapping[int, float]
    disturbance: Disturbance
    excess_chance: float = math.nan
    worse_chance: float = math.nan


def summarize_gap(loop: Loop, found: Search, fresh: FreshData) -> GapSummary:
    """Return the gap on data that no parameter was fitted to, and what each finding closes."""
    windows, how = fresh.windows, fresh.how
    made = _reproduce(loop, found, fresh)
    after, results = made.after, made.results
    shared = replace(fresh, windows=gaps.share_samples(windows, results))
    left = gaps.root_mean_square(shared.windows, results[2])
    smaller, start = made.choose_start(windows)
    fit = found.final.fit
    floor = gaps.compute_floor(after, fit, shared.windows, how)
    if left > THRESHOLD.excess * floor.both:
        floor = gaps.compute_floor(after, fit, shared.windows, how, THRESHOLD.floor_more_runs)
    shares: dict[int, float] = {}
    for f in found.found:
        error = smaller
        if len(found.found) > 1:
            label = list(after[0].labelled)[f.position]
            error = shared.measure_gap([x.without_effect(label) for x in after])
        shares[f.position] = _compute_share_closed(error**2 - left**2, smaller, floor.both)
    rows = (*results, start)
    if windows[0].record.y.ndim == 2:
        gap = _summarize_several(loop, shared, rows, floor, windows[0])
    else:
        unit = loop.known_units.get(loop.equations().outputs[0], "")
        gap = _make_gap(shared, rows, floor, unit, windows[0])
        gap = replace(gap, force_unit=_find_force_unit(loop))
    worse = gaps.compute_widening_chance(shared.windows, results[0], results[2])
    excess = math.nan
    if how.horizon:
        floors = [part.both for part in floor.outputs or (floor,)]
        excess = gaps.compute_excess_chance(shared.windows, results[2], floors)
    return GapSummary(gap, shares, _measure_disturbance(fit, loop, floor), excess, worse)


def _find_force_unit(loop: Loop) -> str:
    """Return the unit of the random force of a plant of single signals; empty without one."""
    e = loop.equations()
    if e.velocities:
        return fill_unit("{x}/s^2", {"x": loop.position_unit})
    # Noises on several states' rates have no unit in common.
    if e.dt or len(e.states) - len(e.rest) != 1:
        return ""
    state = e.states[0]
    return fill_unit("{x}/s", {"x": loop.state_units.get(state) or f"[{state}]"})


def replace_simulation(
    loop: Loop, found: Search, summary: GapSummary, fresh: FreshData
) -> tuple[FreshData, GapSummary, tuple[str, ...]]:
    """Return the gap of predictions where a simulation tells nothing, and a note why it does not.

    Where a controller hardly holds a plant, noise alone drives the right model away from the
    record, by more than all that the record moves or without an end. Where a plant may come to rest
    in one of several places, the last digits of its parameters decide in which. Such a simulation
    would take a right name back.
    """
    blindness = None if fresh.how.horizon else _find_blindness(found, summary, fresh)
    if blindness is None:
        return fresh, summary, ()
    how = choose_prediction(found.final.fitted, fresh.windows[0].record)
    ahead = lengthen_horizon(loop, found, replace(fresh, how=how)).weigh_outputs(found.final)
    other = summarize_gap(loop, found, ahead)
    if not math.isfinite(other.gap.after):
        return fresh, summary, ()
    return ahead, other, (blindness.format(fresh.how.name),)


def _find_blindness(found: Search, summary: GapSummary, fresh: FreshData) -> str | None:
    """Say why the simulation of the completed model tells nothing; None if it tells something."""
    gap = summary.gap
    lost = gap.floor > gaps.measure_constant_error(fresh.windows)
    if lost or not math.isfinite(gap.after):
        return DIVERGES
    if not found.found or not gap_is_wider(gap, summary.disturbance):
        return None
    runs = np.hypot(fresh.measure_doubt(found.final), gap.floor)
    if not np.isfinite(runs).all():
        return DOUBTFUL
    beyond = gaps.compute_chance_among_runs(gap.after, runs) >= 1 - THRESHOLD.beyond_chance
    return None if beyond else DOUBTFUL


def _summarize_several(
    loop: Loop, shared: FreshData, rows: Sequence[Sequence[Array]], floor: gaps.Floor,
    first: gaps.Window,
) -> Gap:  # fmt: skip
    """Return the gap of all outputs in units of the floors, with that of each in its own unit.

    The curves are those of the `first` window, with what no model makes anything of.
    """
    how, names = shared.how, loop.equations().outputs
    whole = _make_gap(shared, rows, floor, "", first)
    outputs = []
    for k, name in enumerate(names):
        part = FreshData(tuple(w.choose_output(k) for w in shared.windows), None, how)
        own = tuple(tuple(y[k] for y in each) for each in rows)
        unit = loop.known_units.get(name, "")
        curves = first.choose_output(k)
        outputs.append(_make_gap(part, own, floor.outputs[k], unit, curves, name))
    shown = max(outputs, key=lambda g: g.before / g.floor if g.floor > 0 else 0.0)
    drawn = {name: getattr(shown, name) for name in
             ("time", "measured", "simulated_before", "simulated_after", "output")}  # fmt: skip
    return replace(whole, **drawn, outputs=tuple(outputs))


def _make_gap(
    fresh: FreshData, rows: Sequence[Sequence[Array]], floor: gaps.Floor, unit: str,
    first: gaps.Window, name: str = "",
) -> Gap:  # fmt: skip
    """Return a gap from what the model as given, recalibrated, complete and at best had before.

    The curves are those of the `first` window; several outputs together have none.
    """
    how, windows = fresh.how, fresh.windows
    given, recalibrated, left, before = (gaps.root_mean_square(windows, y) for y in rows)
    alone = first.mask.ndim == 1
    mask = first.mask if alone else first.mask.any(axis=0)
    time = first.start_time + np.asarray(first.record.t - first.record.start)[mask]
    measured, start, end = (
        np.asarray(y)[mask] if alone else np.zeros(0)
        for y in (first.record.y, rows[3][0], rows[2][0])
    )
    trivial = gaps.measure_trivial_error(windows, how.horizon) if how.horizon else math.nan
    kind: GapKind = "prediction" if how.horizon else "simulation"
    return Gap(
        kind, given, before, left, floor.both, unit, time, measured, start, end, floor.widest,
        how.horizon, recalibrated, how == CLOSED_LOOP, trivial,
        sum(int(np.count_nonzero(w.mask)) for w in windows), name, reason=how.reason,
    )  # fmt: skip


def lengthen_horizon(loop: Loop, found: Search, fresh: FreshData) -> FreshData:
    """Return fresh data with a horizon at which a model predicts better than a trivial predictor.

    A horizon at which the last value or a straight line wins says nothing of the models, so it is
    doubled until it does not, up to a tenth of the record; where none does, it stays as it is. It
    also stays where models without effects already err by more than a constant: the predictions of
    an unstable plant leave the record further and further, and any effect closes much of that.
    """
    horizon, windows = fresh.how.horizon, fresh.windows
    if not horizon:
        return fresh
    longest = max(find_longest_horizon(w.record) for w in windows)
    loops = [(x,) * len(windows) for x in (loop, found.base.fitted, found.final.fitted)]
    while True:
        longer = replace(fresh, how=replace(fresh.how, horizon=horizon))
        results = [longer.simulate_outputs(x) for x in loops]
        shared = gaps.share_samples(windows, results)
        *bare, complete = (gaps.root_mean_square(shared, y) for y in results)
        if min(*bare, complete) <= gaps.measure_trivial_error(shared, horizon):
            return longer
        if horizon >= longest or min(bare) > gaps.measure_constant_error(shared):
            return fresh
        horizon = min(2 * horizon, longest)


@dataclass(frozen=True, eq=False)
class _Reproductions:
    """What the model as given, recalibrated and with the effects make of each window."""

    after: tuple[Loop, ...]
    results: list[tuple[Array, ...]]

    def choose_start(self, windows: Sequence[gaps.Window]) -> tuple[float, tuple[Array, ...]]:
        """Return the smaller RMS error of those without the effects, and that model's outputs.

        Effects that only undo what a recalibration spoiled close nothing.
        """
        given, recalibrated, _ = self.results
        windows = gaps.share_samples(windows, self.results)
        pairs = [(gaps.root_mean_square(windows, y), y) for y in (recalibrated, given)]
        return min(pairs, key=lambda pair: pair[0])

    def compute_widening_chance(self, windows: Sequence[gaps.Window]) -> float:
        """Return the probability with which chance alone widens the gap so much."""
        start = self.choose_start(windows)[1]
        windows = gaps.share_samples(windows, self.results)
        return gaps.compute_widening_chance(windows, start, self.results[2])


def _reproduce(loop: Loop, found: Search, fresh: FreshData) -> _Reproductions:
    before, after = (fresh.prepare_loops(m) for m in (found.base, found.final))
    for effect in found.base.loop.effects[len(loop.effects) :]:
        before = tuple(x.without_effect(type(effect).__name__) for x in before)
    cases = ((loop,) * len(fresh.windows), before, after)
    return _Reproductions(after, [fresh.simulate_outputs(x) for x in cases])


def take_back_widening(
    loop: Loop, found: Search, summary: GapSummary, fresh: FreshData
) -> tuple[Search, GapSummary]:
    """Take effects back, the worst first, while they leave the gap wider beyond chance.

    What names something and leaves more unexplained than before has a wrong name among its names.
    The half of the samples that shows it better decides which name goes, and what fresh data like
    in its place; the gap is reported on the other half.
    """
    if not found.found or not gap_is_wider(summary.gap, summary.disturbance):
        return found, summary
    made = _reproduce(loop, found, fresh)
    if made.compute_widening_chance(fresh.windows) >= THRESHOLD.beyond_chance:
        return found, summary
    halves = fresh.halve()
    deciding, reported = sorted(halves, key=lambda h: made.compute_widening_chance(h.windows))
    refused: set[str] = set()
    # What is reported is never wider beyond chance either.
    while found.found and THRESHOLD.beyond_chance > min(
        made.compute_widening_chance(part.windows) for part in (fresh, reported)
    ):
        found, worst = exchange_worst_effect(found, refused, deciding)
        refused.add(worst)
        made = _reproduce(loop, found, fresh)
    return found, summarize_gap(loop, found, reported)


def _compute_once(function: Callable[[Model], Found]) -> Callable[[Model], Found]:
    """Return a function that computes once for each model, and keeps none of them in memory."""
    found = weakref.WeakKeyDictionary[Model, Found]()

    def find(model: Model) -> Found:
        if model not in found:
            found[model] = function(model)
        return found[model]

    return find


def make_fresh_data_test(fresh: FreshData) -> Callable[[Weighed, Model], bool]:
    """Return whether an effect closes a fair part of what is left without it, on fresh data.

    Of the gap, or, where noise is known, of the one-step errors: a small fast force is seen there.
    """
    loops = _compute_once(fresh.prepare_loops)

    def helps(f: Weighed, model: Model) -> bool:
        with_it, without = loops(model), loops(f.base)
        if model.fit.known is not None:
            left = fresh.measure_excess(without, model.fit)
            if left - fresh.measure_excess(with_it, model.fit) > THRESHOLD.helps * left:
                return True
        floor = gaps.compute_floor(with_it, model.fit, fresh.windows, fresh.how).both
        gap, before = fresh.measure_gap(with_it), fresh.measure_gap(without)
        return _compute_share_closed(before**2 - gap**2, before, floor) > THRESHOLD.helps

    return helps


def make_noise_test(fresh: FreshData) -> Callable[..., bool]:
    """Return whether fresh data falsify the noise of a model.

    Noise leaves errors of its size there: no prediction is better than what cannot be predicted.
    A noise model that explains a record only by being larger is falsified. So is one that claims
    to be far larger than the error, by chance as it may be, and beside which the model errs more
    than beside the noise that it would take the place of: a wander that nearly never ends takes
    what is still missing. Not so one that exceeds the error by no more than that other noise does,
    or beside which the model errs less.
    """
    # A model is asked of alone first, and then beside another: that is computed once.
    prepare_loops = _compute_once(fresh.prepare_loops)

    @_compute_once
    def is_too_large(model: Model) -> bool:
        chance = fresh.compute_size_chance(prepare_loops(model), model.fit)
        return chance < THRESHOLD.beyond_chance

    def compute_ratio(model: Model) -> float:
        loops = prepare_loops(model)
        floor = gaps.compute_floor(loops, model.fit, fresh.windows, fresh.how).both
        return floor / max(fresh.measure_gap(loops), THRESHOLD.tiny)

    def errs_more(model: Model, other: Model) -> bool:
        return fresh.compute_widening_chance(other, model) < THRESHOLD.beyond_chance

    def is_false(model: Model, other: Model | None = None) -> bool:
        if other is None:
            return is_too_large(model)
        ratio = compute_ratio(model)
        far = ratio > THRESHOLD.excess
        if far and errs_more(model, other):
            return True
        if not is_too_large(model) or (not far and errs_more(other, model)):
            return False
        return not (compute_ratio(other) >= ratio and is_too_large(other))

    return is_false


def _compute_share_closed(closed: float, before: float, floor: float) -> float:
    above = before**2 - (floor**2 if math.isfinite(floor) else 0.0)
    if not (math.isfinite(closed) and math.isfinite(above)) or above <= 0:
        return math.nan
    return float(min(max(closed / above, 0.0), 1.0))


def _measure_disturbance(fit: Fit, loop: Loop, floor: gaps.Floor) -> Disturbance:
    noise, scale = fit.noise, float(np.mean(fit.sensor))
    time_constant = -loop.dt / math.log(noise.memory) if noise.drift else math.nan
    share = 1 - (floor.sensor / floor.both) ** 2 if floor.both > 0 else math.nan
    coloured = math.sqrt(scale * noise.coloured) if noise.drift else 0.0
    share = float(np.clip(share, 0.0, 1.0))
    sizes = np.sqrt(scale * np.array(noise.force)).tolist()
    if not has_several_noises(fit.plant.e):
        return Disturbance(sizes[0], coloured, time_constant, share)
    units = find_noise_units(fit.plant.loop, fit.data[0].record)[1]
    names = name_noise_places(fit.plant.loop)[1]
    rows = tuple(zip(names, sizes, units, strict=True))
    return Disturbance(math.nan, coloured, time_constant, share, rows)
