"""A user's own effect is one file: it says itself what bounds, scans and instants it has.

The names of the parameters are those of effects in the catalogue, which must not matter.
"""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pytest

import ctrlid as cid
import problems
from ctrlid import effects as E
from ctrlid.diagnosis.candidates import Objection, is_same_kind
from ctrlid.diagnosis.fitted_model import carry_over_fit
from ctrlid.diagnosis.information import find_objection
from ctrlid.diagnosis.recalibration import fit_base_model
from ctrlid.diagnosis.refitting import place_instants, refit_candidate
from ctrlid.diagnosis.scans import ModelSight, scan_candidate
from ctrlid.effects.scanning import Scan

N, DT = 1500, 0.01
drive = partial(problems.drive, free=("k",))


def record_of(effect, seed=1, n=N):
    loop = drive().with_effect(effect)
    return problems.record_of(loop, swing=0.3, hold=60, n=n, seed=seed, sensor_noise=1e-3)


@dataclass(frozen=True)
class Brake(E.ForceEffect):
    """A brake whose damping is not a ratio: it may be far above one."""

    damping: float = E.parameter("1/s", lower=0.0, upper=20.0, neutral=0.0)

    def force(self, m):
        return -self.damping * m.velocity * np.abs(m.velocity) / 0.5


@dataclass(frozen=True)
class Shaker(E.ForceEffect):
    """Something shakes the drive, at a frequency in revolutions per minute."""

    size: float = E.parameter("{y}/s^2", neutral=0.0)
    frequency: float = E.parameter("1/min", lower=1.0, upper=6000.0)

    def force(self, m):
        return self.size * np.sin(2 * np.pi * self.frequency / 60 * m.t)

    @classmethod
    def candidates(cls, loop, record=None):
        return (cls(0.0, 100.0),)


@dataclass(frozen=True)
class ScannedShaker(Shaker):
    """The same, and it says where to look."""

    def scan(self, sight):
        grid = np.linspace(10.0, 600.0, 400)
        shapes = [np.sin(2 * np.pi * np.outer(t, grid) / 60) for t in sight.times]
        gains, sizes = sight.score_shapes(shapes)
        k = int(np.argmax(gains))
        return Scan(((replace(self, size=float(sizes[k, 0]), frequency=float(grid[k])),),),
                    places=len(grid))  # fmt: skip


@dataclass(frozen=True)
class Waves(E.ForceEffect):
    """A force that repeats every so many seconds, far more often than the way repeats."""

    size: float = E.parameter("{y}/s^2", neutral=0.0)
    period: float = E.parameter("s", lower=0.1, upper=100.0)
    phase: float = E.parameter("rad", default=0.0)

    def force(self, m):
        return self.size * np.sin(2 * np.pi * m.t / self.period + self.phase)

    @classmethod
    def candidates(cls, loop, record=None):
        return (cls(0.1, 6.3),)


@dataclass(frozen=True)
class Knock(E.ForceEffect):
    """A short push; its time is no instant, for nothing says so."""

    size: float = E.parameter("{y}/s^2", neutral=0.0)
    time: float = E.parameter("s", lower=0.0)

    def force(self, m):
        return self.size * np.exp(-(((m.t - self.time) / 0.03) ** 2))


@dataclass(frozen=True)
class TimedKnock(Knock):
    """The same push, whose time is declared as an instant."""

    time: float = E.parameter("s", lower=0.0, instant=True)


def refitted(effect, record):
    base = fit_base_model(drive(), [record], ("k",))
    return base, refit_candidate(base, scan_candidate(base, effect))


def bounds_of(effect, record):
    base = fit_base_model(drive(), [record], ("k",))
    loop = base.fitted.with_effect(effect)
    label = next(iter(loop.labelled))
    names = [*base.names, *(f"{label}.{k}" for k in effect.values())]
    problem = carry_over_fit(base, loop, names).problem
    return dict(zip(names, zip(problem.lower, problem.upper, strict=True), strict=True))


def test_damping_is_fitted_within_its_own_bounds():
    record = record_of(Brake(2.5))
    assert bounds_of(Brake(0.1), record)["Brake.damping"] == (0.0, 20.0)
    found = cid.diagnose(drive(), record, catalogue=(Brake, E.ViscousFriction), progress=False)
    assert [f.name for f in found.findings] == ["Brake"]
    assert found.findings[0].effect.damping == pytest.approx(2.5, rel=0.05)
    # The damping ratio of the catalogue's flexible mode keeps its own.
    mode = E.FlexibleMode(frequency=5.0, damping=0.1, coupling=0.0)
    assert bounds_of(mode, record)["FlexibleMode.damping"] == (0.0, 1.0)


def test_frequency_and_period_have_the_bounds_that_they_declare():
    record = record_of(E.ConstantForce(0.0), n=600)
    assert bounds_of(Shaker(0.1, 100.0), record)["Shaker.frequency"] == (1.0, 6000.0)
    assert bounds_of(Waves(0.1, 6.3), record)["Waves.period"] == (0.1, 100.0)
    own = bounds_of(E.PeriodicForce(0.1, 3.0), record)["PeriodicForce.frequency"]
    np.testing.assert_allclose(own, (1 / (600 * DT), 0.4 / DT))
    longest = bounds_of(E.PositionRipple(0.1, 0.1), record)["PositionRipple.period"][1]
    # What is seen once does not repeat.
    assert 0.25 * np.ptp(record.y) < longest < 0.75 * np.ptp(record.y)


def test_a_period_longer_than_the_way_is_found():
    record = record_of(Waves(0.8, 6.0))
    _, trial = refitted(Waves(0.1, 6.3), record)
    assert trial.out is None
    assert trial.fitted.period == pytest.approx(6.0, rel=0.02)


def test_an_effect_is_scanned_if_it_says_so_and_not_otherwise():
    record = record_of(Shaker(1.0, 317.0))
    plain, scanned = Shaker(0.0, 100.0), ScannedShaker(0.0, 100.0)
    assert not plain.is_scanned()
    assert scanned.is_scanned()
    base, alone = refitted(plain, record)
    _, found = refitted(scanned, record)
    assert found.fitted.frequency == pytest.approx(317.0, rel=1e-3)
    assert found.scan_penalty == pytest.approx(np.log(400))
    assert alone.scan_penalty == 0.0
    assert found.net_gain > alone.net_gain + 100
    assert is_same_kind(scan_candidate(base, plain).effect, plain)
    sight = ModelSight(base)
    assert sight.strongest_line() == pytest.approx(317.0 / 60, abs=0.1)
    assert sight.parameter("c") is None
    assert sight.parameter("k") == pytest.approx(30.0, rel=0.05)
    assert sight.state("nothing") is None


def test_an_edge_speaks_against_what_was_searched_only():
    record = record_of(Waves(0.8, 6.0))

    @dataclass(frozen=True)
    class Narrow(Waves):
        period: float = E.parameter("s", lower=0.1, upper=5.5)

    @dataclass(frozen=True)
    class NarrowSearched(Narrow):
        period: float = E.parameter("s", lower=0.1, upper=5.5, searched=True)

    edge = Objection("on a bound", "period ends on its bound 5.5 s")
    for kind, objection in ((Narrow, None), (NarrowSearched, edge)):
        base = fit_base_model(drive(), [record], ("k",))
        trial = refit_candidate(base, scan_candidate(base, kind(0.5, 5.4)))
        assert trial.fitted.period == 5.5
        assert find_objection(trial) == objection


def test_a_time_is_an_instant_only_if_it_is_declared():
    record = record_of(Knock(40.0, 7.0), n=1000)
    base = fit_base_model(drive(), [record], ("k",))
    for kind, moved in ((Knock, False), (TimedKnock, True)):
        loop = base.fitted.with_effect(kind(40.0, 6.36))
        label = kind.__name__
        fit = carry_over_fit(base, loop, ("k", f"{label}.time"))
        there = place_instants(fit)
        assert (there.value > fit.value + 100) == moved
        assert (abs(there.theta[1] - 7.0) < 0.02) == moved


def test_what_may_occur_twice_and_what_has_an_order():
    assert E.PeriodicForce.repeatable
    assert not E.CoulombFriction.repeatable
    assert not Brake.repeatable
    for kind in E.CATALOGUE:
        assert kind.ordered == (kind.place in ("input", "output"))


@dataclass(frozen=True)
class Formless(E.ForceEffect):
    """An effect whose method is misspelt."""

    size: float = E.parameter("{y}/s^2", neutral=0.0)

    def forces(self, m):
        return self.size * m.y


class Undecorated(E.ForceEffect):
    """An effect without the line above its class."""

    size: float = E.parameter("{y}/s^2", neutral=0.0)


def test_an_effect_that_is_not_finished_says_what_it_lacks():
    with pytest.raises(cid.CtrlidError, match=r"of ForceEffect needs a method force\(self, m\)"):
        cid.simulate(drive().with_effect(Formless(1.0)), np.zeros(9))
    with pytest.raises(cid.CtrlidError, match=r"declares size, .* write @dataclass\(frozen=True\)"):
        Undecorated(size=1.0)


@dataclass(frozen=True)
class Pull(E.ForceEffect):
    """A magnet at a place that has a default, which no fit has to guess."""

    strength: float = E.parameter("{y}^3/s^2", neutral=0.0)
    site: float = E.parameter("{y}", default=2.0)

    def force(self, m):
        return self.strength / (self.site - m.position) ** 2


@dataclass(frozen=True)
class Lost(E.ForceEffect):
    """One whose place nobody says."""

    strength: float = E.parameter("{y}^3/s^2", neutral=0.0)
    site: float = E.parameter("{y}")

    def force(self, m):
        return self.strength / (self.site - m.position) ** 2


def test_a_parameter_without_a_neutral_value_starts_from_its_default():
    """The effect of the manual was never tried, without a word."""
    assert Pull.candidates(drive()) == (Pull(0.0, 2.0),)
    with pytest.raises(cid.CtrlidError, match=r"Lost would never be tried: nothing says .* site"):
        cid.diagnose(drive(), record_of(Brake(1.0)), catalogue=[Lost], progress=False)


@dataclass(frozen=True)
class Wild(E.ForceEffect):
    """A state that no sampling follows."""

    size: float = E.parameter("{y}/s^2", neutral=0.0)
    states = ("z",)

    def rates(self, m):
        return ((m.velocity - m.own["z"]) * 4e9,)

    def force(self, m):
        return self.size * m.own["z"]


def test_an_effect_that_cannot_be_tried_is_told():
    found = cid.diagnose(drive(), record_of(Brake(1.0)), catalogue=[Wild], progress=False)
    assert [note for note in found.notes if note.startswith("Wild could not be tried: ")]


def test_a_unit_has_names_that_mean_something():
    with pytest.raises(cid.CtrlidError, match=r"unit takes \{u\}, \{y\} and \{x\}.* given \{z\}"):
        E.parameter("1/{z}")
