"""The frozen study: a simulator that shares nothing with ctrlid, worths, and a table kept."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy import optimize, signal

import ctrlid as cid
from ctrlid import effects as E
from ctrlid.diagnosis.fitted_model import with_linearization
from ctrlid.diagnosis.quiet_refitting import refit_quietly
from ctrlid.diagnosis.recalibration import fit_base_model
from ctrlid.diagnosis.refitting import refit_candidate
from ctrlid.diagnosis.screening import screen_candidate
from problems import load_script

study = load_script("benchmarks", "study_frozen")
cases = study.cases
plants = cases.op
PARTS = ("outside_rigs", "outside_plants", "outside_worth", "outside_cases")


@pytest.mark.parametrize("name", PARTS)
def test_the_simulator_knows_nothing_of_ctrlid(name):
    text = (Path(study.__file__).parent / f"{name}.py").read_text("utf-8")
    assert "import ctrlid" not in text
    assert "from ctrlid" not in text


def make_drive(rng, n=400, size=0.0):
    """Return a truth with a drive, some Coulomb-free drag beside it, and its record."""
    at = np.array([0.0, 0.0, 0.0, 0.02])
    p = np.array([4.0, 1.0, 1.0, 0.0])
    e = plants.make_neutral()
    e[plants.I["stiffness"]] = size
    x0, spread = np.zeros(plants.MOST), np.full(plants.MOST, 1e-3)
    moves = 2.0 * np.repeat(rng.choice([-1.0, 1.0], n // 20), 20)
    sigma, push = 0.01, 0.3
    u, y, ok = plants.simulate(1, p, e, at, x0, np.array([5.0, -4.5]), np.array([1.0, -0.5]), True,
                               moves, push * rng.standard_normal(n), sigma * rng.standard_normal(n),
                               np.full(n, 0.02), 0.0, 100.0)  # fmt: skip
    assert ok
    return cases.Truth(
        1, p, e, at, x0, spread, sigma, push, cases.WHITE, np.ones(1), np.ones(1),
        {"k": (4.0, np.inf), "c": (1.0, np.inf)}, 1.0, u, y,
    )  # fmt: skip


@pytest.mark.slow
def test_a_worth_is_the_mean_of_many_log_likelihood_ratios():
    """By brute force: the ratio of the truth and the best model without it, on fresh records."""
    truth = make_drive(np.random.default_rng(1), size=2.0)
    without = plants.make_neutral()
    worth, theta = cases.measure_worth(truth, without)
    assert 10 < worth < 200
    ratios, worths = [], []
    for seed in range(60):
        one = make_drive(np.random.default_rng([seed, 7]), size=2.0)
        own, other = one.predict(np.zeros(4), one.e), one.predict(theta, without)
        ratios.append(plants.compute_log_likelihood(one.y, *own, one.weights)
                      - plants.compute_log_likelihood(one.y, *other, one.weights))  # fmt: skip
        worths.append(plants.sum_divergence(*own, one.weights, *other, one.weights, plants.NODES,
                                            plants.MASSES))  # fmt: skip
    error = np.std(np.array(ratios) - worths, ddof=1) / np.sqrt(len(ratios))
    assert abs(np.mean(ratios) - np.mean(worths)) < 3.5 * error


@pytest.mark.slow
def test_what_is_absent_is_worth_nothing_and_no_fit_ends_half_way():
    truth = make_drive(np.random.default_rng(2))
    assert cases.measure_worth(truth, plants.make_neutral())[0] < 1e-6
    last = 0.0
    for size in (0.1, 0.5, 2.0):
        truth = make_drive(np.random.default_rng(2), size=size)
        worth, theta = cases.measure_worth(truth, plants.make_neutral())
        assert worth > 1.5 * last
        elsewhere = theta + np.array([0.05, -0.1, 0.2, -0.5])
        again, _ = cases.measure_worth(truth, plants.make_neutral(), start=elsewhere)
        assert again == pytest.approx(worth, rel=2e-3)
        last = worth


def make_tanks(rng, n=300):
    """Return a truth of two tanks with a play, whose outlets are nearly one parameter."""
    at = np.array([0.0, 2.782, 0.0, 1.1565])
    names = plants.PARAMETERS[plants.PLANTS.index("tanks")]
    true = {"o1": 3.876e-4, "o2": 2.73e-4, "k": 2.78e-4, "A": 1.5e-2, "g": 9.81, "b": 0.0}
    p = np.array([true[name] for name in names])
    x0 = np.zeros(plants.MOST)
    x0[0] = (true["k"] * at[1] / true["o1"]) ** 2 / (2 * 9.81)
    x0[1] = (true["k"] * at[1] / true["o2"]) ** 2 / (2 * 9.81)
    at[0], at[2] = x0[0], x0[1]
    x0[5:] = at[2]
    e = plants.make_neutral()
    e[plants.I["backlash"]] = 0.1
    moves = 0.5 * np.repeat(rng.choice([-1.0, 1.0], n // 20), 20)
    sigma, push = 2e-3, 0.01
    spread = np.full(plants.MOST, 0.02)
    u, y, ok = plants.simulate(plants.PLANTS.index("tanks"), p, e, at, x0, np.array([1.0]),
                               np.array([1.0]), False, moves, push * rng.standard_normal(n),
                               sigma * rng.standard_normal(n), np.full(n, at[3]), 0.0,
                               1.0)  # fmt: skip
    assert ok
    free = {name: (1.05 * true[name], 0.05 * true[name]) for name in ("o1", "o2", "k")}
    return cases.Truth(plants.PLANTS.index("tanks"), p, e, at, x0, spread, sigma, push,
                       cases.WHITE, np.ones(1), np.ones(1), free, 1.0, u, y)  # fmt: skip


@pytest.mark.slow
def test_a_worth_is_the_smallest_where_free_parameters_nearly_are_one():
    """Against a search that needs no slopes, from where the climb ended and from elsewhere."""
    truth, without = make_tanks(np.random.default_rng(4)), plants.make_neutral()
    own = truth.predict(np.zeros(5), truth.e)

    def cost(theta):
        other = truth.predict(theta, without)
        if not np.isfinite(other[0]).all():
            return np.inf
        divergence = plants.sum_divergence(*own, truth.weights, *other, truth.weights,
                                           plants.NODES, plants.MASSES)  # fmt: skip
        return divergence + truth.compute_belief(theta)

    worth, theta = cases.measure_worth(truth, without)
    least = cost(theta)
    for start in (theta, np.zeros(5)):
        found = optimize.minimize(
            cost,
            start,
            method="Nelder-Mead",
            options={"maxiter": 1500, "fatol": 1e-4, "adaptive": True},
        )
        assert least < found.fun + 0.02 * (1 + found.fun / 5)
    assert 0 < worth < least


@pytest.mark.parametrize("laws", [1, 2])
def test_the_divergence_is_differentiated_by_hand(laws):
    rng = np.random.default_rng(5)
    weights = np.array([1.0]) if laws == 1 else np.array([0.9, 0.1])
    mean, other = rng.standard_normal((2, 7))
    variance, width = rng.uniform(0.5, 2.0, (2, 7, laws))
    rest = plants.NODES, plants.MASSES
    value, by_mean, by_variance = plants.differentiate_divergence(
        mean, variance, weights, other, width, weights, *rest
    )
    plain = lambda o, w: plants.sum_divergence(mean, variance, weights, o, w, weights, *rest)  # noqa: E731
    assert value == pytest.approx(plain(other, width), rel=1e-10)
    assert np.sum(by_mean) == pytest.approx(
        (plain(other + 1e-6, width) - plain(other - 1e-6, width)) / 2e-6, rel=1e-6
    )
    for q in range(laws):
        h = np.zeros((7, laws))
        h[:, q] = 1e-6
        assert np.sum(by_variance[:, q]) == pytest.approx(
            (plain(other, width + h) - plain(other, width - h)) / 2e-6, rel=1e-6
        )


def test_the_filter_of_a_linear_plant_is_the_kalman_filter():
    truth = make_drive(np.random.default_rng(3), n=60)
    mean, variance = truth.predict(np.zeros(4), truth.e)
    dt, k, c = 0.02, 4.0, 1.0
    decay = np.exp(-c * dt)
    f = np.array([[1.0, (1 - decay) / c], [0.0, decay]])
    g = np.array([k * (dt - (1 - decay) / c) / c, k * (1 - decay) / c])
    push = 0.3 * np.array([dt * dt / 2, dt])
    x, P = np.zeros(2), np.diag([1e-6, 1e-6])
    for j, y in enumerate(truth.y):
        s = P[0, 0] + 1e-4
        assert mean[j] == pytest.approx(x[0], abs=1e-6)
        assert variance[j, 0] == pytest.approx(s, rel=1e-4)
        gain = P[:, 0] / s
        x = f @ (x + gain * (y - x[0])) + g * truth.u[j]
        P = f @ (P - np.outer(gain, P[0])) @ f.T + np.outer(push, push)


@pytest.mark.parametrize("colour", [cases.WHITE, np.array([1.0, 0.03, 1.0, 1.0])])
def test_the_filter_of_a_sensor_with_play_knows_how_far_it_errs(colour):
    """Three states, one of which moves with the reading alone, and a walk that makes it four."""
    rng = np.random.default_rng(8)
    truth = make_drive(rng, n=800)
    e = truth.e.copy()
    e[plants.I["play"]] = 0.1
    walk = np.cumsum(rng.standard_normal(800)) * colour[1]
    u, y, _ = plants.simulate(1, truth.p, e, truth.at, truth.x0, np.array([5.0, -4.5]),
                              np.array([1.0, -0.5]), True, 2.0 * np.repeat([1.0, -1.0] * 20, 20),
                              truth.push * rng.standard_normal(800),
                              truth.sigma * (rng.standard_normal(800) + walk),
                              np.full(800, 0.02), 0.0, 100.0)  # fmt: skip
    mean, variance = plants.filter_record(
        1, truth.p, e, truth.at, truth.x0, truth.spread, u, y, truth.sigma, truth.push, colour,
        np.ones(1), np.ones(1),
    )  # fmt: skip
    assert np.mean((y - mean) ** 2 / variance[:, 0]) == pytest.approx(1.0, abs=0.15)


def test_dry_friction_holds_what_rests():
    e = plants.make_neutral()
    e[plants.I["coulomb"]] = 1.0
    at = np.array([0.0, 0.0, 0.0, 0.02])
    u = np.r_[np.full(50, 0.2), np.full(50, 0.5), np.zeros(100)]
    _, y, _ = plants.simulate(1, np.array([4.0, 1.0, 1.0, 0.0]), e, at, np.zeros(plants.MOST),
                              np.zeros(1), np.ones(1), False, u, np.zeros(200), np.zeros(200),
                              np.full(200, 0.02), 0.0, 100.0)  # fmt: skip
    assert np.all(y[:50] == 0)
    assert y[100] > 0.1
    assert np.ptp(y[-50:]) == 0


@pytest.mark.parametrize("size", [pytest.param(1e-9, marks=pytest.mark.slow), 0.5])
def test_a_change_of_the_direction_takes_nothing_but_the_friction(size):
    """A mass thrown against a constant force, with dry friction, has a path in closed form."""
    e, force, h = plants.make_neutral(), -400.0, 0.02
    e[plants.I["coulomb"]], e[plants.I["force"]] = size, force
    at = np.array([0.0, 0.0, 0.0, h])
    x, work = np.zeros(plants.MOST), np.zeros((5, plants.MOST))
    x[1] = 6.1
    plants.advance(1, np.array([1.0, 0.0, 1.0, 0.0]), e, at, x, 0.0, 0.0, h, 0.0, *work)
    up = 6.1 / (size - force)
    top = 0.5 * 6.1 * up
    assert x[0] == pytest.approx(top + 0.5 * (force + size) * (h - up) ** 2, rel=1e-9)
    assert x[1] == pytest.approx((force + size) * (h - up), rel=1e-9)


def test_a_draw_is_the_same_again_and_its_worth_is_near_what_was_drawn():
    one, two = (cases.draw_case("faint", 7, 500) for _ in range(2))
    assert np.array_equal(one.y, two.y)
    assert one.worth == two.worth
    assert abs(np.log(one.worth[0] / one.wanted)) < 3 * cases.NEAR


def test_names_that_no_record_tells_apart_count_as_one():
    assert study.group_names(["ActuatorLag", "SensorLag", "InputDelay"], "drive") == [
        {"ActuatorLag", "SensorLag"}, {"InputDelay"},
    ]  # fmt: skip
    assert len(study.group_names(["ActuatorLag", "SensorLag"], "ball")) == 2


def make_line(kind, seed, truth=(), worth=(), names=(), **more):
    found = [{"set": list(n), "equal": [], "evidence": 1.0, "values": {}} for n in names]
    return {"class": kind, "seed": seed, "n": 10, "plant": "drive", "noise": "white",
            "law": "exact", "redrawn": 0, "dt": 0.01, "truth": list(truth), "worth": list(worth),
            "sizes": [{} for _ in truth], "findings": found, "stand_ins": [], "wider": 1.0,
            "verdict": "explained" if names else "nothing missing",
            "seconds": 1.0, **more}  # fmt: skip


def test_the_table_counts_and_the_file_keeps(tmp_path):
    lines = [
        make_line("clean", 0),
        make_line("one", 0, ["InputDelay"], [200.0], [["InputDelay", "SensorLag"]]),
        make_line("one", 1, ["ActuatorLag"], [200.0], [["SensorLag"]]),
        make_line("faint", 0, ["InputDelay"], [10.0], [["CoulombFriction"]]),
        make_line("two", 0, ["InputDelay", "CubicStiffness"], [200.0, 300.0],
                  [["InputDelay"], ["CubicStiffness"]]),
    ]  # fmt: skip
    path = tmp_path / "study.jsonl.gz"
    for line in lines[::-1]:
        study.append_line(path, line)
    whole = path.read_bytes()
    path.write_bytes(whole + whole[:20])  # as a run leaves it that was killed
    assert len(study.read(path)) == len(lines)
    study.write(path, study.read(path))
    assert study.read(path) == lines
    table = {what.strip(): value for what, _, value in study.score(lines)}
    assert table["one effect, worth over 50: the truth in the set of a finding"].startswith(
        "2 of 2"
    )
    assert table["the same: mean size of the set that has the truth"] == "1.50 of 2"
    faint = "one effect, worth 5 to 50: sets of findings without the truth"
    assert table[faint].startswith("1 of 1")
    assert table["the same: exactly right, a finding for each and no other"].startswith("1 of 1")
    assert [m.split(" drive")[0] for m in study.find_misses(lines)] == ["faint 0"]
    table = load_script("docs", "study_tables")
    page = "\n".join(table.write_tables("study_frozen", path))
    assert "98 %" in page
    assert "faint 0 drive" in page
    summary = "\n".join(table.write_summary("study_frozen", path))
    assert "One effect, worth over 50: the truth first: 2 of 2: 100.0 %" in summary
    assert "the target is 98 %" in summary
    assert "no draw" not in summary


@pytest.mark.slow
def test_an_input_that_is_swallowed_whole_is_told():
    whole, most = (cases.draw_case("one", seed, 1500) for seed in (84503, 84546))
    assert [c.hidden for c in (whole, most)] == [("InputDeadZone",)] * 2
    assert whole.sizes[0]["deadzone"] > np.ptp(whole.u)
    assert (whole.swallowed, most.swallowed) == (True, False)


def test_an_input_that_is_swallowed_whole_is_counted_apart():
    """No record tells what keeps all of an input away; the table counts with and without those."""
    lines = [
        make_line("one", 0, ["InputDeadZone"], [200.0], swallowed=True, idle=True),
        make_line("one", 1, ["InputDeadZone"], [200.0], swallowed=False, idle=True),
        make_line("one", 2, ["InputDeadZone"], [200.0], swallowed=True, idle=False),
        make_line("one", 3, ["InputDeadZone"], [200.0], [["InputDeadZone"]], swallowed=True),
    ]
    (strict, _, found), (apart, _, told) = study.score(lines)[3:5]
    assert strict.startswith("one effect, worth over 50: the truth in the set")
    assert found.startswith("1 of 4")
    assert apart.strip().startswith("the same, and rightly no name")
    assert told.startswith("2 of 4")
    assert "which swallow all of u" in study.find_misses(lines)[0]


def test_a_diagnosis_rerun_from_its_seed_gives_the_same_answer():
    one, two = (study.run("clean", 1, 400) for _ in range(2))
    assert "error" not in one, one
    assert study.is_same_answer(one, two)


@pytest.mark.slow
def test_the_second_of_two_that_hide_together_shows_under_hardly_any_force():
    """A dead zone and a delay of six samples: beside the first the second has a small score."""
    case = cases.draw_case("two", 50017, 1500)
    assert set(case.hidden) == {"InputDeadZone", "InputDelay"}
    loop = study.make_loop(case.rig)
    record = cid.Record(r=case.r, u=case.u, y=case.y, dt=case.rig.dt)
    base = fit_base_model(loop, [record], tuple(loop.free))
    (zone,) = E.InputDeadZone.candidates(loop, record)
    nearly = with_linearization(refit_candidate(base, screen_candidate(base, zone)).model)
    assert nearly.fitted.effects[0].width == pytest.approx(45.2, abs=3)
    pool = [e for kind in (E.InputDelay, E.InputBacklash, E.ViscousFriction, E.LinearStiffness)
            for e in kind.candidates(loop, record)]  # fmt: skip
    scores = {type(e).__name__: screen_candidate(nearly, e).score for e in pool}
    assert scores["InputDelay"] < 40
    best = max(refit_quietly(nearly, pool, lambda f, given: [f(x) for x in given]),
               key=lambda t: t.net_gain)  # fmt: skip
    assert best.name == "InputDelay"
    assert best.net_gain > 300
    assert best.fitted.delay == pytest.approx(6 * case.rig.dt, rel=0.01)


@pytest.mark.parametrize("memory", [0.0, 0.8, 0.95, 0.98])
def test_a_wider_gap_is_told_from_chance_at_its_level(memory):
    """Errors of a closed loop remember tens of samples; blocks of a fixed length err often then."""
    rng = np.random.default_rng(4)
    chances = []
    for _ in range(500):
        e = signal.lfilter([1.0], [1.0, -memory], rng.standard_normal((2, 900)))[:, 500:875]
        chances.append(study.weigh_mean(e[1] ** 2 - e[0] ** 2))
    assert np.mean(np.array(chances) < 0.01) < 0.03
    louder = 1.6 * e[1]
    assert study.weigh_mean(np.tile(louder**2 - e[0] ** 2, 40)) < 0.01


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "names"), [
    (90114, {"ActuatorLag", "SensorLag"}),
    (81002, {"CoulombFriction", "AsymmetricCoulombFriction"}),
])  # fmt: skip
def test_what_came_close_to_a_single_finding_is_compared_under_its_noise(seed, names):
    """Fits of a round end early: a lag of the sensor lost by what its fit had not yet reached."""
    case = cases.draw_case("one", seed)
    record = cid.Record(r=case.r, u=case.u, y=case.y, dt=case.rig.dt)
    found = cid.diagnose(study.make_loop(case.rig), record, progress=False)
    assert found.verdict == "explained"
    (finding,) = found.findings
    assert set(finding.names) == names


def test_sizes_that_are_asked_for_are_those_of_the_simulator():
    power = load_script("benchmarks", "study_power")
    for name, (own, key, signs) in power.EFFECTS.items():
        parameter, compute = study.SIZES[name]
        assert parameter == own
        assert compute({key: 2.0}, 0.5) == (1.0 if name == "InputDelay" else 2.0)
        effect = getattr(cid.effects, name)
        (only,) = [p for p in effect.parameters() if p.neutral is not None]
        assert (-1 in signs) == (only.lower < 0), name


def test_the_table_of_powers_counts_what_was_shown():
    power = load_script("benchmarks", "study_power")
    lines = [{"seed": k, "power": 0.5, "commit": "a", "name": "InputDelay", "shown": k < 3}
             for k in range(4)] + [{"seed": 9, "power": 0.5, "commit": "a"}]  # fmt: skip
    told = power.write_tables(lines).splitlines()
    assert told[0] == "4 draws of commit a, 1 more without a size"
    assert told[1].startswith("50 % predicted  3 of 4: 75.0 %")
    assert told[-1].split() == ["InputDelay", "3", "of", "4,", "2.0", "due"]


def test_the_page_has_a_row_for_each_number_and_value():
    table = load_script("docs", "study_tables").write_number_tables()
    numbers = load_script("benchmarks", "study_numbers")
    rows = [line for line in table if line.startswith("   * - ")]
    assert len(rows) == 1 + 2 * len(numbers.list_judged_numbers())
    assert sum("none run" in line for line in table) <= 4  # near no draw of the study
