"""redesign(): what is promised on a model and what the physics does with it.

Groups: exact models; wrong models; limits and large steps; texts; refusals.
"""

import re
import warnings
from dataclasses import replace

import control as ct
import numpy as np
import pytest

import ctrlid as cid
from ctrlid import CtrlidError
from ctrlid.design.settling import explain_unsettled
from ctrlid.design.step_height import StepHeight, try_heights
from problems import levitation

DT = 1e-3
LOOP = replace(levitation(dt=DT, free=()), controller=None)
PLANT, AT = LOOP.plant, LOOP.at
P = cid.linearize(PLANT, AT)
SAMPLED = ct.tf(ct.sample_system(ct.ss(ct.tf(P.num, P.den)), DT))
NUMBERS = ("phase_margin", "gain_margin", "gain_reduction_margin", "crossover", "final_value",
           "overshoot", "settling_time")  # fmt: skip


def gain(factor):
    return ct.tf(factor * P.num[0][0], P.den[0][0])


# --- exact models


@pytest.mark.parametrize(("crossover", "margin"), [(100, 50), (70, 40), (200, 65)])
@pytest.mark.parametrize("model", [P, SAMPLED], ids=["continuous", "discrete"])
def test_an_exact_model_keeps_its_promise(model, crossover, margin):
    found = cid.redesign(model, LOOP, crossover=crossover, phase_margin=margin)
    for side in (found.promised, found.achieved):
        assert side.stable
        assert side.phase_margin == pytest.approx(margin, abs=1e-6)
        assert side.crossover == pytest.approx(crossover, rel=1e-6)
    assert found.stable
    assert found.achieved.gain_margin == pytest.approx(found.promised.gain_margin, rel=1e-6)
    assert found.nu_gap < 1e-6 < found.robust_margin
    assert "the promise holds" in found.verdict
    assert "is guaranteed: the nu-gap between model and physics is 0.000" in found.verdict
    assert found.failure == ""
    assert found.loop.analog is (model is P)
    assert found.controller.dt == model.dt


def test_small_steps_on_the_physics_equal_the_promised_ones():
    for model in (P, SAMPLED):
        found = cid.redesign(model, LOOP, crossover=100, phase_margin=50, step=1e-7)
        assert len(found.time) == len(found.promised_step) == len(found.achieved_step) == 600
        assert np.abs(found.achieved_step - found.promised_step).max() < 1e-3
        assert found.achieved.settling_time == found.promised.settling_time
        assert found.step == 1e-7


def test_step_figures_against_python_control():
    found = cid.redesign(P, LOOP, crossover=100, phase_margin=30)
    closed = ct.feedback(P * found.controller, 1)
    info = ct.step_info(closed)
    assert found.promised.final_value == pytest.approx(float(ct.dcgain(closed)), rel=1e-4)
    assert found.promised.overshoot == pytest.approx(info["Overshoot"], abs=0.5)
    assert found.promised.settling_time == pytest.approx(info["SettlingTime"], abs=0.005)


def test_a_state_space_model_and_an_identified_one():
    found = cid.redesign(ct.ss(SAMPLED), LOOP, crossover=100, phase_margin=50)
    assert found.achieved.phase_margin == pytest.approx(50, abs=1e-5)
    C = ct.sample_system(cid.design_lead(P, 100, 50), DT, "tustin")
    r = cid.random_binary(3000, amplitude=1e-5, hold=20, around=AT.output, seed=1)
    record = cid.simulate(cid.Loop(PLANT, C, dt=DT, at=AT), r)
    G = cid.fit_arx(record, 2, 2, constraints=[cid.ReciprocalPoles()])
    found = cid.redesign(G, LOOP, crossover=100, phase_margin=50)
    assert found.stable
    assert found.achieved.phase_margin == pytest.approx(50, abs=0.5)
    assert type(found.controller) is ct.TransferFunction


def test_a_sampled_loop_of_another_period():
    found = cid.redesign(SAMPLED, cid.Loop(PLANT, None, dt=0.02, at=AT), 100, 50)
    assert found.loop.dt == DT


def test_linear_plants_and_a_point_at_zero():
    plant = ct.tf([2.0], [1.0, 0.0, -9.0], inputs="u", outputs="y")
    found = cid.redesign(plant, cid.Loop(plant, None, dt=0.01), crossover=8, phase_margin=45)
    assert found.step == 0.01
    assert found.stable
    assert "the promise holds" in found.verdict


@pytest.mark.parametrize(
    ("unit", "scale"), [("m", 1.0), ("mm", 1e3), ("rad", 1.0), ("deg", 180 / np.pi), ("odd", 1.0)]
)
def test_a_step_from_zero_is_the_same_in_other_units(unit, scale):
    """It was 0.01 of whatever the output is in: 10 µm of a plant in millimetres."""
    plant = ct.tf([2.0 * scale], [1.0, 0.0, -9.0], inputs="u", outputs="y")
    loop = cid.Loop(plant, None, dt=0.01, units={"y": unit})
    found = cid.redesign(plant, loop, crossover=8, phase_margin=45)
    assert found.step == pytest.approx(0.01 * scale)
    assert "y rests at zero, and no limit of the input says what is small" in str(found)


@pytest.mark.parametrize("scale", [1.0, 1e3])
def test_a_step_from_zero_leaves_the_input_far_from_its_limits(scale):
    plant = ct.tf([2.0 * scale], [1.0, 0.0, -9.0], inputs="u", outputs="y")
    loop = cid.Loop(plant, None, dt=0.01, input_limits=(-5.0, 10.0))
    found = cid.redesign(plant, loop, crossover=8, phase_margin=45)
    closed = ct.feedback(found.controller, plant)
    peak = np.max(np.abs(ct.step_response(closed, np.linspace(0, 5, 5000)).outputs))
    assert peak * found.step == pytest.approx(0.5, rel=0.05)
    assert "to move the input by 10 % of its way to a limit" in str(found)
    assert "to move the input" in found.step_reason
    # A stated height, or an output at rest elsewhere, needs no reason.
    given = cid.redesign(plant, loop, crossover=8, phase_margin=45, step=0.1)
    assert (given.step, given.step_reason) == (0.1, "")
    trial = cid.redesign(ct.ss(plant), loop, design=lambda P: found.controller)
    assert [s.height for s in trial.steps] == [pytest.approx(found.step, rel=0.05)]
    assert "to move the input by 10 %" in str(trial)


def bearing_force(x, u):
    """Two magnets, 0.4 mm to either side of a shaft."""
    return 6e-6 * ((2 + u) ** 2 / (4e-4 - x) ** 2 - (2 - u) ** 2 / (4e-4 + x) ** 2)


BEARING = cid.Loop(
    ct.nlsys(lambda t, x, u, p: [x[1], bearing_force(x[0], u[0]) / 2],
             lambda t, x, u, p: [x[0]], inputs=["i"], outputs=["x"], states=["x", "v"]),
    dt=2e-4, units={"x": "m", "i": "A"},
)  # fmt: skip


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("design", [False, True])
def test_a_guessed_step_that_the_physics_cannot_do_is_a_smaller_one(design):
    """10 mm were asked of a gap of 0.4 mm, and the verdict was that the loop diverges."""
    model = BEARING.linearize()

    def make(loop, **more):
        if not design:
            found = cid.redesign(model, loop, crossover=2700, phase_margin=45, **more)
            return found, found.step, found.step_reason
        found = cid.redesign(model, loop, **more,
                             design=lambda P: cid.design_lead(model, 2700, 45))  # fmt: skip
        return found, found.steps[0].height, found.steps[0].reason

    found, height, reason = make(BEARING)
    assert found.stable
    assert height in (1e-4, 1e-5)
    assert "is a guess" in reason
    assert reason.endswith(f"that {1e6 * height:g} µm was taken.")
    assert "With 10 mm the physics leaves the range" in str(found)
    assert "DIVERGES" not in str(found)
    # Ten times as much does not work, and a height that is given is not exchanged.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", cid.CtrlidWarning)
        found, more, reason = make(BEARING, step=10 * height)
    assert (found.stable, more, reason) == (False, 10 * height, "")


def test_where_no_smaller_step_works_the_loop_diverges():
    class Outcome:
        def __init__(self, value, least):
            self.value, self.failure = value, "lost" if value > least else None

    asked = []

    def run(least):
        def tried(value):
            asked.append(value)
            warnings.warn(f"tried {value:g}", cid.CtrlidWarning, stacklevel=2)
            return Outcome(value, least)

        return tried

    guess = StepHeight(0.01, "A guess.", guessed=True)
    with pytest.warns(cid.CtrlidWarning, match=r"^tried 0.01$") as told:
        height, outcome = try_heights(guess, "m", True, run(0.0))
    assert len(told) == 1
    assert asked == pytest.approx([0.01 / 10**k for k in range(6)])
    assert (height.value, outcome.value) == (0.01, 0.01)
    assert height.reason == "A guess. Steps down to 0.1 µm break off as well."
    with pytest.warns(cid.CtrlidWarning, match=r"^tried 0.001$") as told:
        assert try_heights(guess, "m", True, run(0.005))[0].value == 0.001
    assert len(told) == 1
    # No height helps where small deviations grow, and what is given or known is no guess.
    for first, stable in ((guess, False), (StepHeight(0.01, "Known."), True)):
        asked.clear()
        with pytest.warns(cid.CtrlidWarning):
            assert try_heights(first, "m", stable, run(0.005))[0] == first
        assert asked == [0.01]


# --- kinks at rest


def test_with_dry_friction_a_larger_step_is_advised_and_the_verdict_is_that_of_the_table():
    plant = ct.tf([2.0], [1.0, 0.5, -9.0], inputs="u", outputs="y")
    bare = cid.Loop(plant, None, dt=0.01)
    rubbing = bare.with_effect(cid.effects.CoulombFriction(fc=0.02))
    given = {"crossover": 8, "phase_margin": 45}
    found = {h: cid.redesign(plant, rubbing, **given, step=h) for h in (0.1, 0.01, 0.001)}
    off = [abs(f.achieved.final_value - f.promised.final_value) for f in found.values()]
    assert off == sorted(off)
    for one in found.values():
        assert "CoulombFriction counts for more the smaller the step is" in str(one)
        assert "With a smaller step=" not in str(one)
    assert "the promise holds" in found[0.1].verdict
    assert "the promise holds" not in found[0.001].verdict
    assert (
        "the margins hold within 1 %. THE RESPONSE TO A STEP of 0.001 ends at"
        in found[0.001].verdict
    )
    smooth = str(cid.redesign(plant, bare, **given))
    assert "With a smaller step= they are closer to the promised values, unless" in smooth


def test_a_trial_advises_a_larger_step_with_dry_friction():
    plant = ct.tf([2.0], [1.0, 0.5, -9.0], inputs="u", outputs="y")
    loop = cid.Loop(plant, None, dt=0.01).with_effect(cid.effects.InputDeadZone(width=0.01))
    lead = cid.design_lead(plant, 8, 45)
    assert "InputDeadZone counts for more" in str(cid.redesign(plant, loop, design=lambda P: lead))


# --- wrong models


def test_a_gain_that_is_a_little_wrong():
    found = cid.redesign(gain(1.1), LOOP, crossover=100, phase_margin=50)
    assert found.stable
    assert 0 < found.nu_gap < found.robust_margin
    assert found.achieved.crossover < 95
    assert "the promise holds" in found.verdict


def test_a_crossover_that_moves_is_said():
    found = cid.redesign(gain(1.3), LOOP, crossover=100, phase_margin=50)
    assert "48.8 deg at 74.2 rad/s: THE CROSSOVER IS LOWER BY 26 %." in found.verdict


def test_lost_degrees_are_said():
    found = cid.redesign(gain(0.25), LOOP, crossover=100, phase_margin=50)
    assert found.stable
    lost = 50 - found.achieved.phase_margin
    assert f"{lost:.1f} DEGREES OF PHASE MARGIN ARE LOST" in found.verdict
    assert "is not guaranteed: the nu-gap between model and physics is 0.600" in found.verdict
    assert "below the robust margin of 0.208" in found.verdict


def test_a_small_robust_margin_is_printed_with_its_digits():
    found = cid.redesign(gain(1.1), LOOP, crossover=100, phase_margin=50)
    small = replace(found, nu_gap=3.1e-5, robust_margin=2.3e-4)
    assert "model and physics is 0.00003" in small.verdict
    assert "below the robust margin of 0.00023" in small.verdict


@pytest.mark.parametrize(
    ("model", "reason"),
    [
        (
            gain(3.0),
            r"^Small deviations grow at 5.77 1/s. After 0.319 s x has diverg",
        ),
        (ct.tf(SAMPLED.num[0][0] * 3, SAMPLED.den[0][0], DT), "Small deviations grow at"),
        (gain(-1.0), r"^The simulation stops at t = 0.032 s .* The closed loop is unstable"),
    ],
    ids=["continuous", "discrete", "sign"],
)
def test_an_unstable_outcome_is_reported_not_raised(model, reason):
    found = cid.redesign(model, LOOP, crossover=100, phase_margin=50)
    assert found.stable is False
    assert found.promised.stable
    assert found.promised.phase_margin == pytest.approx(50)
    assert not found.achieved.stable
    assert all(np.isnan(getattr(found.achieved, name)) for name in NUMBERS)
    assert found.nu_gap >= found.robust_margin  # it could not be guaranteed
    assert "DOES NOT STABILIZE THE PHYSICS: the model is too different from it." in found.verdict
    assert found.verdict.endswith(found.failure)
    assert re.search(reason, found.failure)
    assert "nan" not in str(found)


# --- limits and large steps


def test_limits_that_lose_the_ball_are_not_called_stable():
    tight = cid.Loop(PLANT, None, dt=DT, at=AT, input_limits=(2.95, 3.05))
    found = cid.redesign(P, tight, crossover=100, phase_margin=50)
    assert not found.stable
    assert found.achieved.phase_margin == pytest.approx(50)  # for small signals
    assert np.isnan(found.achieved.settling_time)
    assert "WITH A STEP OF 0.12 mm THE LOOP DIVERGES. After " in found.verdict
    assert "with V at its limit (2.95 to 3.05)" in found.verdict
    assert "give a smaller step= to redesign" in found.verdict
    assert len(found.achieved_step) < len(found.time)
    small = cid.redesign(P, tight, crossover=100, phase_margin=50, step=1e-6)
    assert small.stable
    assert "LOSES" not in small.verdict


def test_a_step_too_large_for_the_physics():
    found = cid.redesign(P, LOOP, crossover=100, phase_margin=50, step=-0.009)
    assert not found.stable
    assert "WITH A STEP OF -9 mm THE LOOP DIVERGES. The simulation stops at t = " in found.verdict
    # What there is before the ball is lost is shown: every sample until the one of the message.
    assert f"(sample {found.achieved_step.size})" in found.verdict
    assert found.achieved_step[0] == pytest.approx(0)
    assert np.all(np.diff(found.achieved_step) > 0)


def test_a_response_that_never_settles_is_said():
    found = cid.redesign(P, LOOP, crossover=100, phase_margin=50)
    assert np.isfinite(found.achieved.settling_time)
    hunting = replace(found, achieved=replace(found.achieved, settling_time=float("inf")))
    assert "WITH A STEP OF 0.12 mm THE RESPONSE DOES NOT SETTLE" in hunting.verdict
    # This loop has neither limits nor friction nor an encoder.
    assert "In this loop the reason may be: the physics is not linear" in hunting.verdict
    for absent in ("read in steps", "limit", "holds the plant", "small motions"):
        assert absent not in hunting.verdict


UNSTABLE = ct.tf([2.0], [1.0, 0.5, -9.0], inputs="u", outputs="y")


# A digital controller sees the steps of an encoder once a period.
EACH_PERIOD = ct.sample_system(ct.ss(UNSTABLE), 0.01)


def unsettled(loop, **more):
    return cid.redesign(EACH_PERIOD, loop, crossover=8, phase_margin=45, **more)


def design_lead(P):
    return cid.design_lead(ct.tf(P), 8, 45)


def test_only_what_a_loop_has_may_keep_it_from_settling():
    bare = cid.Loop(UNSTABLE, None, dt=0.01, units={"y": "m"})
    coarse = unsettled(bare.with_effect(cid.effects.Quantization(step=0.02)), step=0.01)
    assert coarse.achieved.settling_time == np.inf
    assert "WITH A STEP OF 10 mm THE RESPONSE DOES NOT SETTLE" in coarse.verdict
    assert "the margins hold within" in coarse.verdict
    told = coarse.verdict.partition("DOES NOT SETTLE. ")[2]
    assert told.startswith("In this loop the reason may be: y is read in steps of 20 mm "
                           "(Quantization), of which the step of the reference is 0.5, so that the "
                           "2 % within which")  # fmt: skip
    for absent in ("limit", "linear", "friction", "Friction", "kink"):
        assert absent not in told
    for effect, words in (
        (cid.effects.CoulombFriction(0.1), "CoulombFriction holds the plant where it stands"),
        (cid.effects.InputDeadZone(0.1), "InputDeadZone takes away small motions of the input"),
        (cid.effects.InputSaturation(-1, 1), "InputSaturation limits the input"),
        (cid.effects.CubicStiffness(1.0), "the physics is not linear"),
    ):
        assert words in explain_unsettled(bare.with_effect(effect), "y", 0.01)
    limited = replace(bare, input_limits=(-1, 2))
    assert "u reaches its limits (-1 to 2)" in explain_unsettled(limited, "y", 0.01)
    assert "it is slower than what is simulated" in explain_unsettled(bare, "y", 0.01)
    rubbing = ct.nlsys(lambda t, x, u, params: [x[1], u[0] - np.sign(x[1])],
                       lambda t, x, u, params: [x[0]], inputs=1, outputs=1, states=2)  # fmt: skip
    told = explain_unsettled(cid.Loop(rubbing, dt=0.01), "y[0]", 0.01)
    assert "the equations of the plant contain a sign" in told


def test_a_trial_says_the_unit_of_its_step_and_what_may_hold_it():
    loop = cid.Loop(UNSTABLE, None, dt=0.01, units={"y": "m"})
    loop = loop.with_effect(cid.effects.Quantization(step=0.02))
    text = str(cid.redesign(EACH_PERIOD, loop, design=design_lead, step=0.01))
    assert "Achieved steps (y by 10 mm) are those of the nonlinear physics" in text
    assert "WITH THE STEP OF y by 10 mm THE RESPONSE DOES NOT SETTLE. In this loop" in text
    assert "y is read in steps of 20 mm (Quantization)" in text


def test_the_default_step_is_several_steps_of_the_encoder():
    bare = cid.Loop(UNSTABLE, None, dt=0.01, units={"y": "m"})
    coarse = bare.with_effect(cid.effects.Quantization(step=0.02))
    found = unsettled(coarse)
    assert found.step == pytest.approx(1.0)
    assert "y is read in steps of 20 mm, of which 50 are taken" in str(found)
    trial = cid.redesign(EACH_PERIOD, coarse, design=design_lead)
    assert trial.steps[0].height == pytest.approx(1.0)
    # A fine encoder changes nothing; where several of its steps are too much, the text says so.
    fine = unsettled(bare.with_effect(cid.effects.Quantization(step=1e-4)))
    assert fine.step == unsettled(bare).step
    limited = unsettled(replace(coarse, input_limits=(-10.0, 10.0)))
    assert limited.step < 0.02
    assert "of which this is only 0." in str(limited)
    assert "50 of them may be too much for this loop" in str(limited)


# --- texts


def test_another_settling_time_is_said():
    found = cid.redesign(P, LOOP, crossover=100, phase_margin=50)
    assert "settles after" not in found.verdict
    late = 2 * found.promised.settling_time
    slow = replace(found, achieved=replace(found.achieved, settling_time=late))
    assert f"The step settles after {late:.4g} s where" in slow.verdict


def test_an_analog_lead_in_place_of_a_program_is_said():
    program = replace(LOOP, controller=ct.tf([-4000.0, 3000.0], [1.0, 0.0], DT))
    found = cid.redesign(P, program, crossover=100, phase_margin=50)
    text = str(found)
    assert "while the controller of the loop is a program that runs every 0.001 s" in text
    # What it says of the program is what the program does, and what it tells to do works.
    sampled = cid.redesign(P, program, step=1e-5, design=lambda _: ct.sample_system(
        found.controller, 0.001, "tustin"))  # fmt: skip
    assert not sampled.loop.analog
    (margin,) = sampled.achieved.margins
    assert 40 < margin.phase_margin < 49
    assert found.sampled_margin == pytest.approx(margin.phase_margin, abs=1e-6)
    assert f"a phase margin of {margin.phase_margin:.1f} deg. What follows is the" in text
    digital = cid.redesign(ct.sample_system(ct.ss(P), 0.001), program, 100, 50)
    assert not digital.loop.analog
    circuit = replace(LOOP, controller=found.controller)
    for other in (digital, cid.redesign(P, LOOP, 100, 50), cid.redesign(P, circuit, 100, 50)):
        assert "is a program" not in str(other)
    assert ", a digital lead, 0.001 s\n" in str(digital)


@pytest.mark.parametrize(("crossover", "words", "stable"), [
    (200, "DEGREES ARE LOST BY SAMPLING", True), (600, "it DOES NOT STABILIZE THE PHYSICS", False),
])  # fmt: skip
def test_a_fast_lead_that_a_slow_program_cannot_be_is_the_first_sentence(crossover, words, stable):
    slow = replace(LOOP, dt=0.003, controller=ct.tf([-4000.0, 3000.0], [1.0, 0.0], 0.003))
    found = cid.redesign(P, slow, crossover=crossover, phase_margin=50, step=1e-5)
    assert found.stable
    assert words in found.verdict
    assert found.verdict.startswith("This lead is an analog circuit")
    program = cid.redesign(P, slow, step=1e-5, design=lambda _: ct.sample_system(
        found.controller, 0.003, "tustin"))  # fmt: skip
    assert program.stable is stable
    assert np.isfinite(found.sampled_margin) == stable


def test_the_limits_of_a_pid_say_what_a_small_step_is():
    motor = cid.plants.servo(m=0.002, c=0.01, k=0.5)
    free = cid.Loop(motor, cid.PID(kp=5.0, kd=0.2), dt=0.005)
    limited = replace(free, controller=cid.PID(kp=5.0, kd=0.2, lower=-2.0, upper=2.0))
    stated = replace(free, input_limits=(-2.0, 2.0))
    G = cid.linearize(motor, free.point)
    for given in ({"crossover": 20, "phase_margin": 60}, {"design": lambda _: ct.tf([5.0], [1.0])}):
        heights = [cid.redesign(G, loop, **given) for loop in (free, limited, stated)]
        heights = [trial.steps[0].height if "design" in given else trial.step for trial in heights]
        assert heights[1] == heights[2] != heights[0]


def test_the_report():
    text = str(cid.redesign(P, LOOP, crossover=100, phase_margin=50)).splitlines()
    assert text[0] == "controller: (-4890.28 s - 177992) / (s + 274.748), an analog lead"
    assert text[1].split() == ["promised", "achieved"]
    assert text[2].split() == ["phase", "margin", "[deg]", "50.00", "50.00"]
    assert [line.split("  ")[1] for line in text[2:9]] == [
        "phase margin [deg]", "gain margin [factor]", "gain reduction margin [factor]",
        "crossover [rad/s]", "final value per step", "overshoot [%]", "settling time [s]",
    ]  # fmt: skip
    assert "a step of 0.12 mm on the nonlinear physics" in text[-2]
    assert text[-1].startswith(
        "  The model promises a phase margin of 50.0 deg at 100 rad/s; achieved"
    )


# --- refusals


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: cid.redesign(PLANT, LOOP, 100, 50), "redesign needs a linear model .*Nonlinear"),
        (
            lambda: cid.redesign(P, PLANT, 100, 50),
            "needs a Loop, on which the controller is tried; given Nonlin",
        ),
        (lambda: cid.redesign(P, LOOP, 100, 50, step=0), "height of the reference step .* given 0"),
        (lambda: cid.redesign(P, LOOP, 100, 50, step=np.nan), "other than zero; given nan"),
        (lambda: cid.redesign(P, LOOP, 100, 50, step="1 mm"), "other than zero; given '1 mm'"),
        (lambda: cid.redesign(P, LOOP, -100, 50), "crossover is -100 rad/s"),
        (lambda: cid.redesign(SAMPLED, LOOP, 4000, 50), "must be below pi/dt"),
        (lambda: cid.redesign(P, LOOP, 100, 200), "phase_margin is 200 degrees"),
        (lambda: cid.redesign(ct.tf([1], [1, 1]), LOOP, 100, 50), "would need a phase lag"),
        (
            lambda: cid.redesign(P, cid.Loop(SAMPLED, None, dt=DT), 100, 50),
            "an analog controller cannot act on a plant in discrete time",
        ),
    ],
)
def test_refusals(call, words):
    with pytest.raises(CtrlidError, match=words):
        call()


@pytest.mark.parametrize(
    ("num", "den", "crossover", "margin", "final"),
    [([1, 0.005], np.polymul([1, 0.1, 0], [0.02, 1]), 1.0, 95, 1.0),
     ([1], [1, 0.02, 1], 1.02, 30, 0.04104)],
)  # fmt: skip
def test_a_step_lasts_until_the_slowest_pole_has_settled(num, den, crossover, margin, final):
    """After 60 / crossover the first was at 0.93, and was said to have settled in 7 s."""
    G = ct.tf(num, den)
    found = cid.redesign(G, cid.Loop(G, None, dt=0.02), crossover=crossover, phase_margin=margin)
    assert found.promised.final_value == pytest.approx(final, rel=0.003)
    assert found.promised.settling_time > 100.0
