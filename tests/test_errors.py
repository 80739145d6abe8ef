"""What decides: two narrow refusals put a candidate out, no other is swallowed, no text does."""

import ast
from dataclasses import dataclass, replace

import control as ct
import numpy as np
import pytest

import ctrlid as cid
from ctrlid import effects as E
from ctrlid._base.errors import CtrlidError, EffectDoesNotApply, ModelCannotRun
from ctrlid.diagnosis import growth, refitting, replicas, scans
from ctrlid.diagnosis.candidates import Objection, Trial
from ctrlid.diagnosis.recalibration import fit_base_model
from ctrlid.diagnosis.replicas import follow_record, make_replica
from ctrlid.loop.period_map import compute_growth_rate
from ctrlid.loop.simulation import SimulationStopped
from problems import ROOT, drive, levitation, tank

# Where any refusal is caught: it goes on as another one, or is printed, and decides nothing.
BOUNDARIES = {
    "__main__.py: main",
    "estimation/series.py: _fit_one",
    "reporting/cli/options.py: options_in_refusals",
    "reporting/cli/arguments.py: parse_assignment",
    "reporting/cli/arguments.py: parse_decimal",
    "reporting/cli/demo_identification.py: _tell_redesigns",
    "validation/controller_check.py: check_controller",
    "validation/wired_controller_check.py: check_wired_controller",
    "validation/sampling_sweep.py: _fit_row",
}
# A refusal is a `ValueError` too: where that is caught, in the rooms that try candidates out.
OF_OTHERS = {
    "diagnosis/loading.py: load_diagnosis",
    "diagnosis/open_loop_fit.py: fit",  # hands a refusal on
    "diagnosis/replicas.py: _design_normalized_controller",  # runs python-control alone
    "loop/loop_arguments.py: check_limits",
    "loop/simulation.py: _check_several_signals",
}
TRYING = ("diagnosis", "effects", "estimation/likelihood", "loop")


def handlers(*names):
    """Return where one of these exceptions is caught: file and function."""
    found = set()

    def look(node, place):
        if isinstance(node, ast.FunctionDef):
            place = f"{place.partition(':')[0]}: {node.name}"
        if isinstance(node, ast.ExceptHandler):
            parts = [] if node.type is None else ast.walk(node.type)
            caught = {getattr(n, "id", getattr(n, "attr", "")) for n in parts} or {"BaseException"}
            if caught & set(names):
                found.add(place)
        for child in ast.iter_child_nodes(node):
            look(child, place)

    for path in (ROOT / "ctrlid").rglob("*.py"):
        look(ast.parse(path.read_text("utf-8")), str(path.relative_to(ROOT / "ctrlid")))
    return found


def test_any_refusal_is_caught_only_where_it_decides_nothing():
    assert handlers("CtrlidError") == BOUNDARIES


def test_what_tries_candidates_out_catches_no_refusal_as_a_value_error():
    found = {
        f for f in handlers("ValueError", "Exception", "BaseException") if f.startswith(TRYING)
    }
    assert found == OF_OTHERS


# --- no decision on prose

WORDS = {"doubt", "doubt_of_several", "experiment", "failure", "loose", "message", "note", "notes",
         "refusal", "remark", "sentence", "why", "words"}  # fmt: skip
READING = {"startswith", "endswith", "find", "index", "count", "partition", "split", "search",
           "match", "fullmatch", "removeprefix", "removesuffix"}  # fmt: skip
# They leave out what is empty, and shorten.
REPORTS = ("__main__.py", "reporting/", "diagnosis/wording.py", "diagnosis/report_text.py",
           "validation/sampling_table.py")  # fmt: skip


def prose(node):
    """Whether an expression is the text of a result, or that of a refusal."""
    if isinstance(node, ast.Call):
        refused = getattr(node.func, "id", "") == "str" and prose_of_refusal(node.args[0])
        return prose(node.func) or refused
    return getattr(node, "attr", getattr(node, "id", "")) in WORDS


def prose_of_refusal(node):
    return getattr(node, "id", "") in {"error", "reason", "refusal", "trouble"}


def truths(node):
    """Return the expressions that are taken for true or false."""
    if isinstance(node, ast.BoolOp):
        return [part for value in node.values for part in truths(value)]
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
        return truths(node.operand)
    return [node]


def test_no_text_decides():
    found = set()
    for path in (ROOT / "ctrlid").rglob("*.py"):
        place = str(path.relative_to(ROOT / "ctrlid"))
        if place.startswith(REPORTS):
            continue
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            asked = []
            if isinstance(node, ast.If | ast.IfExp | ast.While | ast.Assert):
                asked = truths(node.test)
            elif isinstance(node, ast.comprehension):
                asked = [part for test in node.ifs for part in truths(test)]
            elif isinstance(node, ast.BoolOp):
                asked = truths(node)
            elif isinstance(node, ast.Compare) and not isinstance(node.ops[0], ast.Is | ast.IsNot):
                asked = [node.left, *node.comparators]
            elif isinstance(node, ast.Call) and getattr(node.func, "attr", "") in READING:
                asked = [node.func.value, *node.args]
            if any(map(prose, asked)):
                found.add(f"{place}: {ast.unparse(node)[:60]}")
    assert sorted(found) == []


def test_an_objection_puts_a_candidate_out_whatever_its_words():
    trial = Trial(E.CoulombFriction(0.1), "CoulombFriction", None, 20.0, gain=20.0, penalty=3.0)
    assert trial.net_gain == 17.0
    assert replace(trial, out=Objection("artefact", "")).net_gain == -np.inf
    for refusal, ground in ((ModelCannotRun("lost"), "cannot run"),
                            (EffectDoesNotApply("no mass"), "does not apply")):  # fmt: skip
        assert Objection.of(refusal) == Objection(ground, str(refusal))


# --- where the narrow ones are raised


def record_of(loop, n=400):
    r = loop.point.output + cid.random_binary(n, amplitude=0.3, hold=40, seed=1)
    return cid.simulate(loop, r, sensor_noise=1e-3, seed=2)


def fast_mass():
    plant = ct.nlsys(lambda t, x, u, params: np.array([x[1], u[0] - 1e9 * x[1]]),
                     lambda t, x, u, params: x[0], inputs=1, outputs=1, states=2)  # fmt: skip
    return cid.Loop(plant, dt=0.01)


def root():
    """A plant without a derivative at rest."""
    plant = ct.nlsys(lambda t, x, u, params: -np.sqrt(np.abs(x)) + u,
                     lambda t, x, u, params: x[0], inputs=1, outputs=1, states=1)  # fmt: skip
    return cid.Loop(plant, dt=0.01)


def lost():
    plant = ct.nlsys(lambda t, x, u, params: np.array([x[1], u[0] - x[0] + np.exp(x[0])]),
                     lambda t, x, u, params: x[0], inputs=1, outputs=1, states=2)  # fmt: skip
    y = 900 + np.sin(np.arange(300))
    return cid.predict(cid.Loop(plant, dt=0.1), cid.Record(u=np.zeros(300), y=y, dt=0.1))


MODELS = {
    "the filter loses the record": lost,
    "a simulation stops": lambda: cid.simulate(levitation(), np.full(200, 0.1)),
    "too fast": lambda: cid.predict(fast_mass(), record_of(drive())),
    "no equilibrium": lambda: cid.operating_point(cid.plants.maglev(m=0.02, K=3e-6), output=-1.0),
    "no derivative": lambda: compute_growth_rate(root()),
    "no state at rest": lambda: cid.OperatingPoint((np.nan,), 0.0, 0.0),
    "too few samples": lambda: cid.predict(drive(), record_of(drive())[:5]),
    "no reference": lambda: cid.replay_controller(
        drive(), cid.Record(u=np.ones(50), y=np.ones(50), dt=0.01)
    ),
}
EFFECTS = {
    "no moving mass": lambda: tank().with_effect(E.CoulombFriction(0.1)),
    "no such parameter": lambda: drive().with_effect(E.ParameterDrift("R", 0.1)),
    "no such state": lambda: tank().with_effect(E.StateLimit("h9", 1.0)),
    "no force that falls": lambda: drive().with_effect(E.ForceExponent(3.0)),
    "crossed limits": lambda: E.InputSaturation(lower=1.0, upper=-1.0),
    "beyond a bound": lambda: drive().with_effect(E.CoulombFriction(0.1)).with_parameters(
        {"CoulombFriction.fc": -1.0}
    ),
    "two of one": lambda: drive().with_effect(E.InputBacklash(0.1)).with_effect(
        E.InputBacklash(0.1)
    ),
    "a delay ahead of a circuit": lambda: compute_growth_rate(
        levitation(analog=True).with_effect(E.InputDelay(0.001))
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", MODELS)
def test_a_model_that_cannot_run_says_so(name):
    with pytest.raises(ModelCannotRun):
        MODELS[name]()


@pytest.mark.parametrize("name", EFFECTS)
def test_an_effect_that_does_not_apply_says_so(name):
    with pytest.raises(EffectDoesNotApply):
        EFFECTS[name]()


def test_the_two_are_refusals_apart():
    for kind, other in ((ModelCannotRun, EffectDoesNotApply), (EffectDoesNotApply, ModelCannotRun)):
        assert issubclass(kind, CtrlidError)
        assert not issubclass(kind, other)
    assert issubclass(SimulationStopped, ModelCannotRun)


# --- what a diagnosis makes of them


def diagnose(*catalogue):
    """Diagnose a drive that has friction nobody told of."""
    loop = drive()
    record = record_of(loop.with_effect(E.CoulombFriction(0.5)))
    return cid.diagnose(loop, record, catalogue=catalogue, progress=False)


def raising(error, after=0, of=None):
    """Return a function that raises an error, of some calls only."""
    count = 0

    def call(*args, **options):
        nonlocal count
        count += 1
        if count > after:
            raise error
        return of(*args, **options)

    return call


@pytest.mark.parametrize(
    "error",
    [ModelCannotRun("lost"), pytest.param(EffectDoesNotApply("crossed"), marks=pytest.mark.slow)],
)
def test_a_candidate_that_fails_fails_alone(monkeypatch, error):
    """The refit of the first candidate fails; the second is found all the same."""
    whole = refitting.place_instants

    def place(fit):
        if "CoulombFriction" in fit.problem.plant.loop.labelled:
            raise error
        return whole(fit)

    monkeypatch.setattr(refitting, "place_instants", place)
    found = diagnose(E.CoulombFriction, E.StribeckFriction, E.AsymmetricCoulombFriction)
    rows = {type(c.effect).__name__: c for c in found.ranking if c.round == 1}
    assert rows["CoulombFriction"].remark == str(error)
    assert [f.name for f in found.findings] == ["AsymmetricCoulombFriction"]


@pytest.mark.parametrize(
    ("module", "name"),
    [(refitting, "place_instants"), (refitting, "find_objection"), (scans, "screen_candidate"),
     (growth, "weigh_effects"), (replicas, "maximize")],
)  # fmt: skip
def test_another_refusal_is_not_swallowed(monkeypatch, module, name):
    monkeypatch.setattr(module, name, raising(CtrlidError("a bug")))
    if module is replicas:
        base = fit_base_model(drive(), [record_of(drive())], ("c", "k"))
        with pytest.raises(CtrlidError, match="a bug"):
            make_replica(base)
        return
    with pytest.raises(CtrlidError, match="a bug"):
        diagnose(E.CoulombFriction)


def test_a_formula_that_cannot_be_traced_is_said():
    """Not that the effect, which the user wrote, is no candidate."""

    @dataclass(frozen=True)
    class Wrong(E.ForceEffect):
        size: float = E.parameter("{y}/s^2", neutral=0.0)

        def force(self, m):
            return self.size if m.velocity > 0 else 0.0

    with pytest.raises(CtrlidError, match=r"np\.where"):
        diagnose(Wrong)


def test_a_user_s_own_effect_refuses_plants_and_values():
    @dataclass(frozen=True)
    class Heater(E.InputEffect):
        gain: float = E.parameter("", neutral=0.0)

        def input(self, m):
            if "heat" not in m.states:
                raise E.EffectDoesNotApply(f"nothing is heated; there are {list(m.states)}")
            return m.u

    assert Heater.candidates(drive()) == ()
    found = diagnose(Heater, E.CoulombFriction)
    assert {type(c.effect) for c in found.ranking} == {E.CoulombFriction}
    assert [f.name for f in found.findings] == ["CoulombFriction"]


def test_no_controller_follows_a_plant_that_passes_its_input_on():
    plant = ct.tf([1.0, 0.5], [1.0, -1.1], 0.01)
    loop = cid.Loop(plant, dt=0.01)
    record = cid.Record(u=np.arange(50.0), y=np.arange(50.0), dt=0.01)
    assert follow_record(loop, record) is None
