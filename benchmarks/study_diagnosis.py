"""Measure how often diagnose() finds the right name, on loops drawn at random.

Run it as ``python benchmarks/study_diagnosis.py --kind named --worth ordinary --runs 62``. The
kinds are

- ``named``: one effect of the catalogue is hidden, every class in turn. Its size is drawn by its
  worth, the log-likelihood ratio of the fits with and without it (``--worth faint``: 50 to 300,
  ``moderate``: 300 to 3 000, ``ordinary``: 3 000 to 30 000);
- ``none``: nothing is hidden;
- ``inside``: nothing is hidden, and the model already has an effect, every class in turn, at its
  true values;
- ``two``, ``three``: several effects are hidden at once;
- ``outside``: the hidden effect is not in the catalogue, or was removed from it;
- ``lookalike``: where the answer has several names, the recommended experiment is simulated and
  diagnosed.

``--vary near_winner=0.3,0.9`` diagnoses the same draws also with other values of a number of the
table in ``ctrlid/diagnosis/thresholds.py``, and prints the tables one after the other. With
``--unknown`` the diagnosis does not get the controller. ``--out FILE`` writes the runs as lines of
JSON, and ``--report FILE...`` prints their tables again.

Each run draws plant, controller, reference, noise and effect from its own seed; a third have a
coloured random force. The free parameters of the model are up to 10 % off. The seeds differ from
those of the tests.
"""

from __future__ import annotations

import argparse
import difflib
import itertools
import json
import math
import signal
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import joblib
import numpy as np
from _random_loops import (
    MOVING,
    PLANTS,
    SAMPLES,
    SHARES,
    Draw,
    Noise,
    Scales,
    draw,
    hidden,
    log_uniform,
    scales_of,
)

import ctrlid as cid
from ctrlid import effects
from ctrlid.diagnosis.candidates import contains
from ctrlid.diagnosis.fitted_model import Model
from ctrlid.diagnosis.recalibration import fit_base_model
from ctrlid.diagnosis.thresholds import THRESHOLD, vary_numbers
from ctrlid.effects import CATALOGUE, AbstractEffect, equivalents

# Numbers that may be varied: a run with another value is another run.
NUMBERS = {t.name: t.value for t in THRESHOLD.table()}
KINDS = ("named", "none", "outside", "two", "three", "lookalike", "inside")
WORTH = {"faint": (50.0, 300.0), "moderate": (300.0, 3e3), "ordinary": (3e3, 3e4)}
TRIES = 40  # draws until one can carry an effect of the wanted worth
ROUNDS = 9  # of finding its size
SHORT = 5  # the first of them on records so many times shorter
LARGEST = 40.0  # of what is easily seen: beyond, friction holds everything fast
MARGINAL = 100.0  # what each of several effects must be worth beside the others
MUTE = 10.0  # of log-likelihood: what is outside gains no more than the answer has
QUICK = 0.05  # samples: how fast an actuator or a sensor follows where nothing holds it
CONFUSED = "InputDelay", "SensorLag", "ForceExponent", "PositionOffset", "LinearStiffness"


# What no catalogue has ----------------------------------------------------------------------------


@dataclass(frozen=True)
class RateLimit(effects.InputEffect):
    """An actuator that can only change so fast."""

    rate: float = effects.parameter("{u}/s", lower=0.0)
    states = ("moving",)

    def rates(self, m: Any) -> tuple[Any, ...]:
        """Return the rate, limited."""
        wanted = (m.u - m.own["moving"]) / (QUICK * m.dt)
        return (np.minimum(np.maximum(wanted, -self.rate), self.rate),)

    def rest(self, at: Any) -> tuple[float, ...]:
        """Return the input at rest."""
        return (at.input,)

    def input(self, m: Any) -> Any:
        """Return what moves."""
        return m.own["moving"]


@dataclass(frozen=True)
class GainLoss(effects.LawEffect):
    """A parameter that is a few per cent lower now and then."""

    name: str
    share: float = effects.parameter("", neutral=0.0)
    first: float = effects.parameter("Hz", default=1.0)
    second: float = effects.parameter("Hz", default=1.0)

    def law(self, m: Any) -> dict[str, Any]:
        """Return the parameter."""
        beat = np.sin(2 * np.pi * self.first * m.t) + np.sin(2 * np.pi * self.second * m.t)
        lost = np.where(beat > 1.0, self.share, 0.0)
        return {self.name: m.plant_parameter(self.name) * (1 - lost)}


@dataclass(frozen=True)
class CubicDrag(effects.ForceEffect):
    """A drag that grows with the third power of the speed."""

    c3: float = effects.parameter("s/{y}^2", neutral=0.0)

    def force(self, m: Any) -> Any:
        """Return the acceleration."""
        return -self.c3 * m.velocity**3


@dataclass(frozen=True)
class SoftStop(effects.ForceEffect):
    """A spring that is met only beyond a certain way."""

    k: float = effects.parameter("1/s^2", neutral=0.0)
    reach: float = effects.parameter("{y}", default=0.0)

    def force(self, m: Any) -> Any:
        """Return the acceleration."""
        return -self.k * np.maximum(m.deviation - self.reach, 0.0)


@dataclass(frozen=True)
class SensorHysteresis(effects.OutputEffect):
    """A sensor with play."""

    width: float = effects.parameter("{y}", lower=0.0, neutral=0.0)
    states = ("shown",)

    def rates(self, m: Any) -> tuple[Any, ...]:
        """Return the rate at which the shown value is taken along."""
        apart = m.y - m.own["shown"]
        half = self.width / 2
        return ((apart - np.minimum(np.maximum(apart, -half), half)) / (QUICK * m.dt),)

    def rest(self, at: Any) -> tuple[float, ...]:
        """Return the output at rest."""
        return (at.output,)

    def output(self, m: Any) -> Any:
        """Return the shown value."""
        return m.own["shown"]


@dataclass(frozen=True)
class BoucWen(effects.ForceEffect):
    """A force with hysteresis, after Bouc and Wen."""

    push: float = effects.parameter("{y}/s^2", neutral=0.0)
    way: float = effects.parameter("{y}", default=1.0)
    states = ("memory",)

    def rates(self, m: Any) -> tuple[Any, ...]:
        """Return the rate of the memory, which stays between -1 and 1."""
        z, v = m.own["memory"], m.velocity / self.way
        return (v - 0.5 * np.abs(v) * z - 0.5 * v * np.abs(z),)

    def force(self, m: Any) -> Any:
        """Return the acceleration."""
        return -self.push * m.own["memory"]


@dataclass(frozen=True)
class ChangingLag(effects.InputEffect):
    """An actuator whose delay comes and goes, as on a busy bus."""

    tau: float = effects.parameter("s", lower=0.0, neutral=0.0)
    frequency: float = effects.parameter("Hz", default=1.0)
    states = ("late",)

    def rates(self, m: Any) -> tuple[Any, ...]:
        """Return the lag, of a time constant that swings."""
        tau = self.tau * (1.02 + np.sin(2 * np.pi * self.frequency * m.t)) + 0.02 * m.dt
        return ((m.u - m.own["late"]) / tau,)

    def rest(self, at: Any) -> tuple[float, ...]:
        """Return the input at rest."""
        return (at.input,)

    def input(self, m: Any) -> Any:
        """Return the late input."""
        return m.own["late"]


def _rate(rng: np.random.Generator, one: Draw, s: Scales) -> Any:
    moves = np.abs(np.diff(s.u)) / s.dt
    top = float(moves.max())
    return lambda z: RateLimit(top / (1 + z))


def _loss(rng: np.random.Generator, one: Draw, s: Scales) -> Any:
    name, base = str(rng.choice(one.loop.free)), rng.uniform(3, 20) / s.duration
    return lambda z: GainLoss(name, 0.02 * z, base, base * 1.618)


def _drag(rng: np.random.Generator, one: Draw, s: Scales) -> Any:
    return lambda z: CubicDrag(0.02 * z * s.push / s.speed**3)


def _stop(rng: np.random.Generator, one: Draw, s: Scales) -> Any:
    where = float(np.quantile(s.y, rng.uniform(0.75, 0.95))) - s.rest[1]
    return lambda z: SoftStop(0.1 * z * s.push / s.reach, where)


def _play(rng: np.random.Generator, one: Draw, s: Scales) -> Any:
    return lambda z: SensorHysteresis(0.05 * z * s.reach)


def _bouc(rng: np.random.Generator, one: Draw, s: Scales) -> Any:
    way = s.reach * rng.uniform(0.2, 0.8)
    return lambda z: BoucWen(0.05 * z * s.push, way)


def _late(rng: np.random.Generator, one: Draw, s: Scales) -> Any:
    wave = rng.uniform(3, 30) / s.duration
    return lambda z: ChangingLag(0.3 * z * s.dt, wave)


OUTSIDE: dict[str, Callable[..., Any] | None] = {
    "RateLimit": _rate, "GainLoss": _loss, "CubicDrag": _drag, "SoftStop": _stop,
    "SensorHysteresis": _play, "BoucWen": _bouc, "ChangingLag": _late,
    "multiplicative noise": None, "removed": None,
}  # fmt: skip


# What the truth is worth --------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Case:
    """A draw with what is hidden in it, the record, and the refit that knows."""

    one: Draw
    real: cid.Loop
    effects: tuple[AbstractEffect, ...]
    record: cid.Record
    seed: int
    truth: Model
    worth: float
    shares: tuple[float, ...] = ()  # what each of several effects is worth beside the others
    catalogue: tuple[type[AbstractEffect], ...] = CATALOGUE
    spread: bool = False  # no refit knows what is hidden
    label: str = ""


def knowing(one: Draw, hidden_ones: Sequence[AbstractEffect], record: cid.Record) -> Model:
    """Refit a loop that has what is hidden, starting from the truth."""
    loop = one.loop
    for effect in hidden_ones:
        loop = loop.with_effect(effect)
    own = [
        f"{label}.{p.name}"
        for label, e in loop.labelled.items()
        for p in e.parameters()
        if math.isfinite(getattr(e, p.name))
    ]
    return fit_base_model(loop, [record], (*loop.free, *own))


def worth(
    one: Draw, hidden_ones: Sequence[AbstractEffect], record: cid.Record
) -> tuple[float, Model]:
    """Return the gain of log-likelihood of a refit that knows, and that refit."""
    base = fit_base_model(one.believed, [record], one.believed.free)
    truth = knowing(one, hidden_ones, record)
    return truth.fit.value - base.fit.value, truth


def with_all(loop: cid.Loop, hidden_ones: Iterable[AbstractEffect]) -> cid.Loop:
    """Return a loop with several effects."""
    for effect in hidden_ones:
        loop = loop.with_effect(effect)
    return loop


def lost(one: Draw, record: cid.Record, seed: int) -> tuple[float, Model]:
    """Return what a hidden effect costs in log-likelihood, and the model without any.

    The same noise without the effect is what a model that knew everything would leave. No filter
    has to describe what is hidden, such as a hysteresis with its kinks.
    """
    quiet = one.run(one.loop, seed)
    clean = fit_base_model(one.loop, [quiet], one.loop.free)
    base = fit_base_model(one.believed, [record], one.believed.free)
    return clean.fit.value - base.fit.value, clean


def sized(
    one: Draw, make: Any, band: tuple[float, float], target: float, seed: int,
    describable: bool = True,
) -> Case | None:  # fmt: skip
    """Scale an effect until it is worth what it should be; None where it cannot be.

    The gain grows about with the square of the size; between two sizes with known gains the next
    one is interpolated on logarithmic scales. The first sizes are tried on short records.
    """
    near_enough = 0.5 if describable else 2.0
    first = make(1.0)
    timed = isinstance(first, effects.ParameterStep | effects.ParameterDrift | GainLoss)
    z, full, known, failed = 1.0, timed, [], math.inf
    for _ in range(ROUNDS):
        tried = one if full else replace(one, samples=one.samples // SHORT)
        try:
            effect = make(z)
            real = one.loop.with_effect(effect)
            record = tried.run(real, seed)
            if describable:
                gain, truth = worth(one, [effect], record)
            else:
                gain, truth = lost(tried, record, seed)
        except cid.CtrlidError:
            failed = min(failed, z)
            z /= 4
            continue
        near = abs(math.log(max(gain, 0.5) * one.samples / tried.samples / target))
        if full and band[0] <= gain <= band[1] and near < near_enough:
            if any(f.kind == "constant signal" for f in cid.audit(record).findings):
                return None  # the plant is gone, the sensor sits on its limit
            own = [k for k, n in enumerate(truth.names) if "." in n]
            if describable and not np.any(np.diag(truth.fit.normal[0])[own] > 0):
                return None  # nothing moves any more: any size is the same
            label = type(effect).__name__
            return Case(one, real, (effect,), record, seed, truth, gain, label=label)
        if near < near_enough and not full:
            full, known = True, []
            continue
        known.append((z, max(gain, 0.5) * one.samples / tried.samples))
        if len(known) > 2 and _flat(known[-3:]):
            return None  # the noise model takes it for noise, however large it is
        z = _next_size(known, target)
        if z >= failed:
            z = math.sqrt(failed * known[-1][0])
            if z > 0.8 * failed:
                return None
        if not 1e-6 < z < LARGEST:
            return None
    return None


def _flat(known: list[tuple[float, float]]) -> bool:
    (z0, gain0), (z1, gain1) = min(known), max(known)
    return z1 > 3 * z0 and gain1 < gain0 * (z1 / z0) ** 0.3


def _next_size(known: list[tuple[float, float]], target: float) -> float:
    z, gain = known[-1]
    slope = 2.0
    if len(known) > 1:
        near = sorted(known, key=lambda pair: abs(math.log(pair[1] / target)))[:2]
        (z, gain), (z1, gain1) = near
        if z != z1 and gain != gain1:
            slope = math.log(gain / gain1) / math.log(z / z1)
            slope = min(max(slope, 0.3), 6.0)
    return z * min(max((target / gain) ** (1 / slope), 0.05), 20.0)


def calm(one: Draw, seed: int) -> bool:
    """Whether the undisturbed loop runs, and noise leaves the motion to be seen."""
    try:
        quiet = scales_of(one, seed)
        noisy = one.run(one.loop, seed)
    except cid.CtrlidError:
        return False
    low, high = one.loop.input_limits
    at_limit = np.mean((noisy.u <= low) | (noisy.u >= high))
    return bool(np.std(noisy.y - quiet.y) < 0.5 * np.std(quiet.y) and at_limit < 0.02)


def plants_for(kind: type[AbstractEffect] | None) -> list[str]:
    """Return the kinds of plant that an effect may be drawn for."""
    if kind is None:
        return list(PLANTS)
    if kind is effects.StateLimit:
        return ["tank", "two tanks"]
    if kind is effects.ForceExponent:
        return ["maglev"]
    if kind is effects.PositionOffset:
        return ["maglev", "pendulum"]
    moving = kind.place in ("force", "law") and kind not in (
        effects.ParameterDrift, effects.ParameterStep
    )  # fmt: skip
    return list(MOVING) if moving else list(PLANTS)


def a_plant(rng: np.random.Generator, kinds: Sequence[str]) -> str:
    """Draw a kind of plant."""
    shares = np.array([SHARES[k] for k in kinds])
    return str(rng.choice(list(kinds), p=shares / shares.sum()))


def seen_at_all(effect: AbstractEffect, one: Draw) -> bool:
    """Whether an effect is not exactly what a free parameter or the initial state can be."""
    same = equivalents(effect, one.loop)
    mute = {f"parameter {name}" for name in one.loop.free} | {"the initial position"}
    return not mute & set(same)


def case_of(
    kind: str, band: tuple[float, float], seed: int, index: int,
    classes: Sequence[Any] = CATALOGUE, samples: int = SAMPLES,
) -> Case | None:  # fmt: skip
    """Draw until a loop can carry what is to be hidden."""
    for attempt in range(TRIES):
        rng = np.random.default_rng([seed, index, attempt, KINDS.index(kind)])
        case = _case(kind, band, rng, index, classes, samples)
        if case is not None:
            return case
    return None


def _case(
    kind: str, band: tuple[float, float], rng: np.random.Generator, index: int, classes: Any,
    samples: int,
) -> Case | None:  # fmt: skip
    coloured = index % 3 == 0
    number = int(rng.integers(1 << 30))
    target = log_uniform(rng, *band)
    if kind == "none":
        one = draw(rng, a_plant(rng, list(PLANTS)), coloured, samples)
        if not calm(one, number):
            return None
        record = one.run(one.loop, number)
        return Case(one, one.loop, (), record, number, knowing(one, (), record), 0.0, label="none")
    if kind == "outside":
        return _outside(rng, index, coloured, number, band, target, samples)
    if kind in ("two", "three"):
        return _several(2 if kind == "two" else 3, rng, coloured, number, band, index, samples)
    cls = classes[index % len(classes)]
    one = draw(rng, a_plant(rng, plants_for(cls)), coloured, samples)
    made = _made(cls, one, rng, number)
    case = made and sized(one, made, band, target, number)
    return _inside(case) if case and kind == "inside" else case


def _inside(case: Case) -> Case:
    """Return a case whose model has what was to be hidden: nothing is missing then."""
    (effect,) = case.effects
    model = case.one.believed.with_effect(effect)
    return replace(case, one=replace(case.one, believed=model), effects=(), label=key(effect))


def _made(cls: Any, one: Draw, rng: np.random.Generator, number: int) -> Any:
    """Return an effect of a class by its size, None where the loop cannot show it."""
    if not calm(one, number):
        return None
    s = scales_of(one, number)
    try:
        made = hidden(rng, cls, one, s)
        one.loop.with_effect(made(1.0))
    except cid.CtrlidError:
        return None
    return made if seen_at_all(made(1.0), one) else None


def _outside(
    rng: np.random.Generator, index: int, coloured: bool, number: int, band: Any, target: float,
    samples: int,
) -> Case | None:  # fmt: skip
    what = list(OUTSIDE)[index % len(OUTSIDE)]
    if what == "removed":
        cls = CATALOGUE[int(rng.integers(len(CATALOGUE)))]
        one = draw(rng, a_plant(rng, plants_for(cls)), coloured, samples)
        made = _made(cls, one, rng, number)
        case = made and sized(one, made, band, target, number)
        if not case:
            return None
        out = {cls.__name__, *equivalents(case.effects[0], one.loop)}
        if any(" with " in name for name in out):  # two of the others together are the same
            return None
        # A friction is an asymmetric friction without a difference.
        others = [e for c in CATALOGUE for e in c.candidates(one.loop, case.record)]
        out |= {type(e).__name__ for e in others if contains(e, case.effects[0])}
        left = tuple(c for c in CATALOGUE if c.__name__ not in out)
        return replace(case, catalogue=left, label=f"removed {cls.__name__}")
    one = draw(rng, a_plant(rng, MOVING), coloured, samples)
    if not calm(one, number):
        return None
    s = scales_of(one, number)
    make = OUTSIDE[what]
    if make is None:  # the noise grows with the distance from rest
        y = one.run(one.loop, number, replace(one.noise, sensor=0.0)).y
        spread = 1 + rng.uniform(1, 3) * np.abs(y - s.rest[1]) / float(np.std(y))
        record = one.run(one.loop, number, spread=spread)
        bits = 0.5 * len(y) * (math.log(np.mean(spread**2)) - float(np.mean(np.log(spread**2))))
        return Case(one, one.loop, (), record, number, knowing(one, (), record), bits, label=what,
                    spread=True)  # fmt: skip
    case = sized(one, make(rng, one, s), band, target, number, describable=False)
    return case and replace(case, spread=True)


def _several(
    count: int, rng: np.random.Generator, coloured: bool, number: int, band: Any, index: int,
    samples: int,
) -> Case | None:  # fmt: skip
    """Hide several effects, each of which is worth something beside the others."""
    plant = a_plant(rng, MOVING)
    one = draw(rng, plant, coloured, samples)
    if not calm(one, number):
        return None
    fitting = [c for c in CATALOGUE if plant in plants_for(c)]
    start = index * 7 % len(fitting)  # every class in turn
    picked = [fitting[start], *rng.choice(fitting, 3 * count, replace=True)]
    chosen: list[AbstractEffect] = []
    for cls in picked:
        made = _made(cls, one, rng, number)
        taken = {n for e in chosen for n in (type(e).__name__, *equivalents(e, one.loop))}
        if made is None or cls.__name__ in taken:
            continue
        case = sized(one, made, band, log_uniform(rng, *band), number)
        if case is not None:
            chosen.append(case.effects[0])
        if len(chosen) == count:
            break
    if len(chosen) < count:
        return None
    try:
        real = with_all(one.loop, chosen)
        record = one.run(real, number)
        gain, truth = worth(one, chosen, record)
        shares = []
        for k in range(count):
            less = knowing(one, [e for i, e in enumerate(chosen) if i != k], record)
            shares.append(truth.fit.value - less.fit.value)
    except cid.CtrlidError:
        return None
    if min(shares) < MARGINAL:
        return None
    return Case(one, real, tuple(chosen), record, number, truth, gain, tuple(shares),
                label=" + ".join(type(e).__name__ for e in chosen))  # fmt: skip


# One run and its judgement ------------------------------------------------------------------------


@dataclass
class Row:
    """What a run gave; written as one line of JSON."""

    kind: str
    worth_class: str
    seed: int
    index: int
    plant: str = ""
    truth: tuple[str, ...] = ()
    sizes: str = ""
    worth: float = math.nan
    shares: tuple[float, ...] = ()
    verdict: str = ""
    named: tuple[tuple[str, ...], ...] = ()
    right: bool = False  # exact name first and alone, nothing beside it
    in_set: bool = False  # every true name is in a set
    beside: bool = False  # a further, false effect beside the right ones
    equal: tuple[str, ...] = ()
    left: float = math.nan  # log-likelihood of the truth over that of the answer
    before: float = math.nan
    after: float = math.nan
    floor: float = math.nan
    ratio: float = math.nan  # gap on fresh data over that of the refit that knows
    inside: tuple[bool, ...] = ()  # true parameters within their 95 % intervals
    test: str = ""
    seconds: float = math.nan
    levels: bool = False
    coloured: bool = False
    error: str = ""
    shrunk: tuple[str, ...] = ()  # names left after the recommended experiment
    shrunk_right: bool = False
    extra: dict[str, Any] = field(default_factory=dict)

    def text(self) -> str:
        """Return the run in one line."""
        what = f"{self.kind}/{self.worth_class}" if self.worth_class else self.kind
        head = f"{self.index:4d} {what:<15} {self.plant:<9}"
        head += f"{'L' if self.levels else '-'}{'C' if self.coloured else '-'} "
        hid = self.sizes or ", ".join(self.truth)
        if self.error:
            return f"{head}{hid} worth {self.worth:.0f}: RAISED {self.error}"
        names = "; ".join(" | ".join(n) for n in self.named) or "-"
        mark = "right" if self.right else "WRONG"
        if self.kind == "outside" and self.verdict in ("unknown", "partly explained"):
            mark = "not taken for known"
        elif self.kind in ("none", "inside") and self.verdict == "nothing missing":
            mark = "right"
        elif self.in_set and not self.right:
            mark = "in set" if self.verdict == "explained" else "in set, DOWNGRADED"
        text = f"{head}{hid} worth {self.worth:.0f}: {self.verdict}: {names}: {mark}"
        if self.beside:
            text += " + FALSE"
        text += f"; left {self.left:.1f}; gap {self.before:.3g} {self.after:.3g} {self.floor:.3g}"
        text += f", fresh/knowing {self.ratio:.4f}"
        if self.inside:
            text += f"; in 95 %: {sum(self.inside)}/{len(self.inside)}"
        text += f"; {self.test}; {self.seconds:.1f} s"
        if self.shrunk:
            text += f"; after the experiment {' | '.join(self.shrunk)}"
            text += " right" if self.shrunk_right else " WRONG"
        return text


def key(effect: AbstractEffect) -> str:
    """Return the name of an effect, with the parameter or state that it names."""
    name = getattr(effect, "name", "")
    return f"{type(effect).__name__}({name})" if name else type(effect).__name__


def same_as(effect: AbstractEffect, loop: cid.Loop) -> set[str]:
    """Return all names of an effect: its own and those of its exact equivalents."""
    return {key(effect), *equivalents(effect, loop)}


def judge(row: Row, found: Any, case: Case) -> None:
    """Fill in what was named and whether it is right."""
    row.verdict = found.verdict
    sets = [(key(f.effect), *(key(e) for e in f.alternatives)) for f in found.findings]
    row.named = tuple(sets)
    row.extra["evidence"] = [round(f.evidence, 1) for f in found.findings]
    truths = [same_as(e, case.one.loop) for e in case.effects]
    row.equal = tuple(sorted(set().union(*truths) - set(row.truth))) if truths else ()
    hit = [next((k for k, s in enumerate(sets) if s[0] in t), None) for t in truths]
    inset = [any(set(s) & t for s in sets) for t in truths]
    everyone = set().union(*truths) if truths else set()
    row.in_set = bool(truths) and all(inset)
    row.beside = any(not set(s) & everyone for s in sets)
    first = all(h is not None for h in hit) and not row.beside and len(sets) == len(truths)
    single = all(len(set(s) - everyone) == 0 for s in sets)
    row.extra["first"] = bool(truths) and first
    row.right = bool(truths) and first and single and found.verdict == "explained"
    row.test = min(found.tests.items(), key=lambda p: p[1])[0] if found.tests else ""
    if found.tests:
        row.test += f" p={min(found.tests.values()):.1e}"
    inside = []
    for f in found.findings:
        for e in case.effects:
            if key(f.effect) != key(e):
                continue
            for name, value in e.values().items():
                if math.isfinite(value) and name in f.standard_errors and name != "phase":
                    off = abs(getattr(f.effect, name) - value)
                    inside.append(bool(off <= 1.96 * f.standard_errors[name]))
    row.inside = tuple(inside)
    row.before, row.after, row.floor = found.gap.before, found.gap.after, found.gap.floor


def fresh_ratio(found: Any, case: Case) -> float:
    """Return the gap on a fresh record over that of the refit that knows what is hidden."""
    if case.spread:
        return math.nan
    one, quiet = case.one, Noise(0.0)
    whole = replace(found.loop, controller=one.loop.controller)
    try:
        y = one.run(case.real, case.seed + 1).y
        made = [one.run(loop, case.seed + 1, quiet).y for loop in (whole, case.truth.fitted)]
    except cid.CtrlidError:
        return math.nan
    later = slice(len(y) // 20, None)  # equivalent effects start from different places
    sizes = [float(np.sqrt(np.mean((y - other)[later] ** 2))) for other in made]
    return sizes[0] / sizes[1] if sizes[1] > 0 else math.nan


def answered(found: Any, case: Case) -> float:
    """Return how much more likely the record is to the refit that knows than to the answer."""
    loop = found.loop
    own = [
        f"{label}.{p.name}" for label, e in loop.labelled.items() for p in e.parameters()
        if math.isfinite(getattr(e, p.name))
    ]  # fmt: skip
    if case.spread and not case.effects:
        return math.nan
    mine = fit_base_model(loop, [case.record], (*loop.free, *own))
    return case.truth.fit.value - mine.fit.value


def _too_long(*_: Any) -> None:
    raise TimeoutError("the diagnosis took longer than --limit")


def run(
    kind: str, band_name: str, seed: int, index: int, classes: Sequence[Any] = CATALOGUE,
    limit: int = 0, samples: int = SAMPLES, known: bool = True,
    numbers: Mapping[str, float] = MappingProxyType({}),
) -> Row:  # fmt: skip
    """Draw, simulate, diagnose and judge once, with the controller known or not.

    `numbers` are other values of the table of numbers, by name; they hold for the diagnosis only,
    so that the draw is the same with all of them.
    """
    warnings.simplefilter("ignore")
    row = Row(kind, band_name, seed, index)
    band = WORTH.get(band_name, (WORTH["moderate"][0], WORTH["ordinary"][1]))
    case = case_of(kind, band, seed, index, classes, samples)
    if case is None:
        row.extra["skipped"] = True
        row.truth = (classes[index % len(classes)].__name__,) if kind == "named" else ()
        return row
    describe(row, case)
    believed = case.one.believed if known else replace(case.one.believed, controller=None)
    row.extra["known controller"] = known
    started = time.perf_counter()
    try:
        if limit:
            signal.signal(signal.SIGALRM, _too_long)
            signal.alarm(limit)
        with vary_numbers(**numbers):
            found = cid.diagnose(believed, case.record, catalogue=case.catalogue, progress=False)
        signal.alarm(0)
        row.seconds = time.perf_counter() - started
        judge(row, found, case)
        row.ratio = fresh_ratio(found, case)
        row.left = answered(found, case)
        if kind == "lookalike":
            shrink(row, found, case)
    except (TimeoutError, SystemError):  # the alarm; compiled code tells of it in its own way
        row.error = f"the diagnosis took longer than {limit} s"
    except Exception as error:  # every failure of a healthy record is to be listed
        row.error = f"{type(error).__name__}: {' '.join(str(error).split())[:300]}"
    finally:
        signal.alarm(0)
    return row


def describe(row: Row, case: Case) -> None:
    """Write down what was drawn."""
    one = case.one
    controller = one.loop.controller
    row.plant = one.plant
    row.truth = tuple(key(e) for e in case.effects) or (case.label,)
    if case.label.startswith("removed") or case.label in OUTSIDE:
        row.truth = (case.label,)
    row.sizes = "; ".join(str(e) for e in case.effects)
    row.worth, row.shares = case.worth, case.shares
    row.levels, row.coloured = one.levels > 0, one.noise.coloured > 0
    row.extra |= {
        "seed": case.seed, "dt": one.loop.dt,
        "controller": type(controller).__name__ if controller is not None else "none",
        "free": list(one.loop.free),
    }  # fmt: skip


def shrink(row: Row, found: Any, case: Case) -> None:
    """Run the recommended experiment on the real loop and diagnose both records together."""
    finding = next((f for f in found.findings if len(f.names) > 1), None)
    if finding is None:
        row.extra["set"] = False
        return
    row.extra["set"] = True
    if finding.reference is None:
        row.extra["experiment"] = finding.experiment or "none"
        return
    try:
        second = case.one.run(case.real, case.seed + 2, r=finding.reference)
    except cid.CtrlidError as error:
        row.extra["experiment"] = f"the loop does not survive it: {error}"
        return
    both = cid.diagnose(case.one.believed, [case.record, second], progress=False)
    row.shrunk = tuple(n for f in both.findings for n in (key(f.effect), *map(key, f.alternatives)))
    true = same_as(case.effects[0], case.one.loop)
    row.shrunk_right = bool(row.shrunk) and set(row.shrunk) <= true


# Tables -------------------------------------------------------------------------------------------


def share(rows: Sequence[Any]) -> str:
    """Return a share of true values as per cent with the count."""
    if not rows:
        return "-"
    return f"{100 * sum(map(bool, rows)) / len(rows):.1f} % of {len(rows)}"


def report(rows: Sequence[Row]) -> None:
    """Print the targets against what was measured, and what was taken for what."""
    done = [r for r in rows if not r.extra.get("skipped")]
    print(f"\n{len(done)} runs, {len(rows) - len(done)} draws could not carry their effect, "
          f"{sum(bool(r.error) for r in done)} raised")  # fmt: skip
    lines: list[tuple[str, str, str]] = []
    for worth_class in WORTH:
        some = [r for r in done if r.kind == "named" and r.worth_class == worth_class]
        if some:
            lines += _named(worth_class, some)
    for kind in ("none", "inside"):
        some = [r for r in done if r.kind == kind]
        if some:
            lines += [
                (f"{kind}: any name given", "<= 1 %", share([r.named for r in some])),
                (f"{kind}: a needless unknown", "<= 2 %",
                 share([r.verdict not in ("nothing missing", "explained") for r in some])),
            ]  # fmt: skip
    outside = [r for r in done if r.kind == "outside"]
    if outside:
        open_end = [r.verdict in ("unknown", "partly explained") for r in outside]
        lines.append(("outside: unknown or partly explained", ">= 95 %", share(open_end)))
        mute = [not o and r.left < MUTE for o, r in zip(open_end, outside, strict=True)]
        lines.append(("outside: the record says no more than the answer", "", share(mute)))
    for kind, both, exact in (("two", ">= 95 %", ">= 90 %"), ("three", ">= 85 %", "")):
        some = [r for r in done if r.kind == kind]
        if some:
            lines += [
                (f"{kind}: all in the sets", both, share([r.in_set for r in some])),
                (f"{kind}: exactly right", exact, share([r.right for r in some])),
                (
                    f"{kind}: the right names first, and no others",
                    "",
                    share([r.extra.get("first", False) for r in some]),
                ),
            ]
    sets = [r for r in done if r.kind == "lookalike" and r.extra.get("set")]
    if sets:
        with_reference = [r for r in sets if "experiment" not in r.extra]
        lines.append(("look-alikes: set shrinks to the truth", ">= 90 %",
                      share([r.shrunk_right for r in with_reference])))  # fmt: skip
    lines += _all(done)
    width = max(len(what) for what, _, _ in lines) if lines else 0
    for what, target, measured in lines:
        print(f"{what:<{width}}  {target:>10}  {measured}")
    _confusion([r for r in done if r.kind in ("named", "lookalike")])


TARGETS = {
    "ordinary": (">= 98 %", "none", "", "", "", ""),
    "moderate": ("", "", ">= 98 %", ">= 99 %", "<= 1.4", ">= 60 %"),
    "faint": ("", "", ">= 97 %", ">= 97 %", "<= 2.5", ""),
}


def _named(name: str, rows: list[Row]) -> list[tuple[str, str, str]]:
    """Return the lines of one class of worth."""
    found = [r for r in rows if r.named]
    sizes = [len(_different(r)) for r in found]
    single = [r for r, size in zip(found, sizes, strict=True) if size == 1]
    first = [r.extra.get("first", False) for r in rows]
    wrong_single = [r for r in single if not r.in_set]
    wanted = TARGETS[name]
    lines = [
        ("exact name first", wanted[0], share(first)),
        ("a wrong single name", wanted[1], str(len(wrong_single))),
        ("detected", "", share([bool(r.named) for r in rows])),
        ("truth in the set when detected", wanted[2], share([r.in_set for r in found])),
        ("one-name answers right", wanted[3], share([r.in_set for r in single])),
        ("mean set size", wanted[4], f"{np.mean(sizes):.2f}" if sizes else "-"),
        ("share of one-name answers", wanted[5], share([r in single for r in found])),
    ]
    if name == "moderate":
        clear = [r for r in rows if not _declared(r)]
        lines.append(("exact name first, outside declared look-alikes", ">= 97 %",
                      share([r.extra.get("first", False) for r in clear])))  # fmt: skip
    return [(f"{name}: {what}", target, measured) for what, target, measured in lines]


def _different(row: Row) -> set[str]:
    """Return the names of an answer, those that are exactly the same on this plant as one."""
    one = {*row.truth, *row.equal}
    return {row.truth[0] if n in one else n for s in row.named for n in s}


def _declared(row: Row) -> bool:
    """Whether what was named first is a declared look-alike of the truth."""
    known = {c.__name__: c for c in CATALOGUE}
    bare = [n.partition("(")[0] for n in row.truth]
    if not row.named:
        return False
    first = row.named[0][0].partition("(")[0]
    if first in bare or first in row.equal:
        return False
    alike = set().union(*(known[b].look_alikes for b in bare if b in known), set())
    back = known[first].look_alikes if first in known else ()
    return first in alike or any(b in back for b in bare)


def _all(done: list[Row]) -> list[tuple[str, str, str]]:
    inside = [x for r in done for x in r.inside]
    hit = [r for r in done if r.kind in ("named", "two", "three") and r.in_set]
    ratios = np.array([r.ratio for r in hit if math.isfinite(r.ratio)])
    seconds = np.array([r.seconds for r in done if math.isfinite(r.seconds)])
    lines = []
    if hit:
        down = [r.verdict != "explained" for r in hit]
        lines += [("right names wrongly downgraded", "<= 1 %", share(down)),
                  ("a false effect beside the right one", "<= 2 %",
                   share([r.beside for r in hit]))]  # fmt: skip
    if len(ratios):
        high = np.quantile(ratios, 0.95)
        lines.append(("gap on fresh data / of the refit that knows: median, 95th percentile",
                      "1.005, 1.02", f"{np.median(ratios):.4f}, {high:.4f}"))  # fmt: skip
    if inside:
        lines.append(("true parameter inside its 95 % interval", ">= 90 %", share(inside)))
    if len(seconds):
        lines.append(("seconds: median, largest", "<= 15",
                      f"{np.median(seconds):.1f}, {seconds.max():.1f}"))  # fmt: skip
    lines.append(("raised", "none", str(sum(bool(r.error) for r in done))))
    return lines


def _confusion(rows: list[Row]) -> None:
    """Print true class by first name, off the diagonal."""
    totals: Counter[str] = Counter()
    off: Counter[tuple[str, str]] = Counter()
    for r in rows:
        (truth,) = r.truth if len(r.truth) == 1 else (" + ".join(r.truth),)
        totals[truth] += 1
        if r.extra.get("first"):
            continue
        named = " + ".join(s[0] for s in r.named) or (r.verdict or "raised")
        inside = " (true name in the set)" if r.in_set else ""
        off[truth, named + inside] += 1
    if not rows:
        return
    print("\ntrue effect                    first names, where they are not the truth")
    for truth in sorted(totals):
        parts = [f"{n} {what}" for (t, what), n in sorted(off.items()) if t == truth]
        right = totals[truth] - sum(n for (t, _), n in off.items() if t == truth)
        print(f"{truth:<30} {right}/{totals[truth]}  {', '.join(parts)}")


def read(paths: Iterable[str]) -> list[Row]:
    """Read runs from files of JSON lines; of a run that is there twice the last one counts."""
    rows: dict[Any, Row] = {}
    for line in itertools.chain.from_iterable(Path(p).read_text().splitlines() for p in paths):
        row = Row(**json.loads(line))
        row.truth, row.equal = tuple(row.truth), tuple(row.equal)
        row.named = tuple(tuple(s) for s in row.named)
        varied = tuple((k, v) for k, v in sorted(row.extra.items()) if k in NUMBERS)
        rows[row.kind, row.worth_class, row.seed, row.index, varied] = row
    return list(rows.values())


def parse_vary(text: str) -> list[dict[str, float]]:
    """Return the settings of ``near_winner=0.3,0.9``: first the table's own value, then the others.

    >>> parse_vary("gate=4,6")
    [{'gate': 5.0}, {'gate': 4.0}, {'gate': 6.0}]
    """
    name, _, values = text.partition("=")
    if isinstance(NUMBERS.get(name), tuple):
        raise argparse.ArgumentTypeError(f"needs a single number; {name} is several")
    if name not in NUMBERS:
        near = difflib.get_close_matches(name, NUMBERS, 3)
        raise argparse.ArgumentTypeError(
            f"needs a number of ctrlid/diagnosis/thresholds.py; given {name!r}. Alike are "
            f"{', '.join(near) or 'none'}"
        )
    kind = type(NUMBERS[name])
    try:
        others = [kind(v) for v in values.split(",")]
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"needs values such as {name}={NUMBERS[name]:g},{2 * NUMBERS[name]:g}; given {text!r}"
        ) from None
    return [{name: v} for v in (NUMBERS[name], *others)]


def main() -> None:
    """Run the study, or print the tables of one that was run."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kind", choices=KINDS, default="named")
    parser.add_argument("--worth", choices=list(WORTH), help="for named; by default moderate")
    parser.add_argument("--runs", type=int, default=len(CATALOGUE))
    parser.add_argument("--samples", type=int, default=SAMPLES, help="length of the records")
    parser.add_argument("--first", type=int, default=0, help="number of the first run")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--limit", type=int, default=0, help="seconds for a diagnosis; 0: none")
    parser.add_argument("--only", nargs="+", type=int, help="numbers of runs")
    parser.add_argument("--effect", choices=[c.__name__ for c in CATALOGUE],
                        help="hide this one only, with --kind named")  # fmt: skip
    parser.add_argument("--unknown", action="store_true", help="diagnose without the controller")
    parser.add_argument("--vary", type=parse_vary, metavar="NUMBER=V1,V2", default=[{}],
                        help="diagnose with other values of a number that decides")  # fmt: skip
    parser.add_argument("--out", help="a file to which each run is appended as a line of JSON")
    parser.add_argument("--report", nargs="+", metavar="FILE", help="print the tables of files")
    options = parser.parse_args()
    if options.report:
        report(read(options.report))
        return
    one_effect = options.kind in ("named", "lookalike", "inside")
    band = options.worth or ("moderate" if one_effect else "")
    numbers = options.only or range(options.first, options.first + options.runs)
    classes: Sequence[Any] = CATALOGUE
    if options.kind == "lookalike":
        classes = [getattr(effects, name) for name in CONFUSED]
    if options.effect:
        if options.kind != "named":
            parser.error("--effect goes with --kind named")
        classes = [getattr(effects, options.effect)]
    work = joblib.Parallel(n_jobs=options.jobs, return_as="generator")
    answers: dict[tuple[int, str], list[str]] = {}
    for setting in options.vary:
        if setting:
            print(f"\n{', '.join(f'{name} = {v:g}' for name, v in setting.items())}")
        rows = []
        for row in work(
            joblib.delayed(run)(options.kind, band, options.seed, k, classes, options.limit,
                                options.samples, not options.unknown, setting)
            for k in numbers
        ):  # fmt: skip
            row.extra |= setting
            rows.append(row)
            named = "; ".join(" or ".join(names) for names in row.named)
            answer = f"{row.verdict}: {named or 'no name'}"
            answers.setdefault((row.index, " + ".join(row.truth)), []).append(answer)
            print(row.text() if not row.extra.get("skipped") else
                  f"{row.index:4d} {row.kind} {', '.join(row.truth)}: no draw carries it",
                  flush=True)  # fmt: skip
            if options.out:
                with Path(options.out).open("a") as file:
                    file.write(json.dumps(vars(row)) + "\n")
        report(rows)
    if len(options.vary) > 1:
        changed = {k: told for k, told in answers.items() if len(set(told)) > 1}
        print(f"\n{len(changed)} of {len(answers)} draws have another answer")
        for (index, truth), told in changed.items():
            print(f"{index:4d} {truth} -> {' | '.join(told)}")


if __name__ == "__main__":
    main()
