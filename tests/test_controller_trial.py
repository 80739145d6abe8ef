"""redesign() with a function that designs any controller: promise and achievement.

Groups: numbers against python-control; several signals; texts and pictures; refusals.
"""

import functools
import math
from dataclasses import replace

import control as ct
import numpy as np
import pytest

import ctrlid as cid
from ctrlid import CtrlidError
from ctrlid.design.input_margins import measure_performance, open_at_inputs
from ctrlid.design.settling import settles_otherwise
from problems import levitation
from test_wiring import CART, QUAD, at_rest

DT = 0.01
AT = at_rest(CART)
RIG = cid.Loop(CART, dt=DT, at=AT)
BALL = levitation(dt=1e-3, free=())
P = cid.linearize(BALL.plant, BALL.at)
XD = [f"xd[{k}]" for k in range(4)]


def observer_design(P, weights=(10.0, 10.0, 1.0, 1.0), noise=1e-4):
    """LQR on a Kalman filter that reads outputs and input, analog."""
    K = ct.lqr(P, np.diag(weights), np.eye(P.ninputs))[0]
    L = ct.lqe(P, np.eye(P.ninputs), noise * np.eye(P.noutputs))[0]
    n, m, p = P.nstates, P.ninputs, P.noutputs
    return ct.ss(
        P.A - L @ P.C, np.hstack([L, P.B, np.zeros((n, n)), -P.B]), -K,
        np.hstack([np.zeros((m, p + m)), K, np.eye(m)]), outputs=P.input_labels,
        inputs=[*P.output_labels, *P.input_labels, *(f"xd[{k}]" for k in range(n)),
                *(f"ud[{k}]" for k in range(m))],
    )  # fmt: skip


def sampled_design(P):
    """The same by python-control's own functions, digital."""
    G = ct.sample_system(P, DT)
    G = ct.ss(G.A, G.B, G.C, G.D, DT, inputs=P.input_labels, outputs=P.output_labels)
    K = ct.dlqr(G, np.diag([10.0, 10, 1, 1]), np.eye(1))[0]
    observer = ct.create_estimator_iosystem(G, np.eye(1), 1e-4 * np.eye(2))
    feedback, _ = ct.create_statefbk_iosystem(G, K, estimator=observer)
    return ct.interconnect(
        [observer, feedback], inputs=["y[0]", "y[1]", *XD, "ud[0]"], outputs=["F"]
    )


def sampled_gain(P):
    """The same as one digital system, without references."""
    G = ct.sample_system(P, DT)
    K = ct.dlqr(G, np.diag([10.0, 10, 1, 1]), np.eye(1))[0]
    L = G.A @ ct.dlqe(G, np.eye(1), 1e-4 * np.eye(2))[0]
    return ct.ss(G.A - L @ G.C - G.B @ K, L, -K, np.zeros((1, 2)), DT, inputs=P.output_labels,
                 outputs=P.input_labels)  # fmt: skip


@functools.cache
def tried(design):
    """An exact model of the cart, and its trial."""
    return cid.redesign(RIG, RIG, design=design)


# --- numbers against python-control


@pytest.mark.parametrize(
    "design",
    [
        lambda P: cid.design_lead(P, 100, 50),
        lambda P: ct.sample_system(cid.design_lead(P, 100, 50), 1e-3, "tustin"),
        lambda P: cid.PID(kp=-5000, kd=-20, filter_time=2e-3),
    ],
    ids=["analog", "digital", "pid"],
)
def test_margins_of_one_signal_are_those_of_the_open_loop(design):
    found = cid.redesign(P, BALL, design=design)
    assert found.stable
    C = found.controller
    if isinstance(C, cid.PID):
        z, dt = ct.tf("z"), 1e-3
        C = C.kp + C.kd * (1 - 1 / z) / (C.filter_time * (1 - 1 / z) + dt)
        C.dt = dt
    G = ct.tf(ct.sample_system(ct.ss(P), 1e-3)) if C.dt else P
    expected = cid.loop_margins(G * C)
    for side in (found.promised, found.achieved):
        (margins,) = side.margins
        for name in ("crossover", "phase_margin", "gain_margin", "gain_reduction_margin",
                     "modulus_margin", "delay_margin"):  # fmt: skip
            assert getattr(margins, name) == pytest.approx(getattr(expected, name), rel=1e-5), name


def test_a_lead_does_what_it_does_without_design():
    ours = cid.redesign(P, BALL, design=lambda P: cid.design_lead(P, 100, 50), step=1e-6)
    lead = cid.redesign(P, BALL, 100, 50, step=1e-6)
    (step,) = ours.steps
    n = min(step.time.size, lead.time.size)
    np.testing.assert_allclose(step.promised.y[0, :n] / 1e-6, lead.promised_step[:n], atol=1e-5)
    np.testing.assert_allclose(step.achieved.y[0, :n] / 1e-6, lead.achieved_step[:n], atol=1e-5)
    assert step.promised.final_value == pytest.approx(lead.promised.final_value, rel=1e-3)
    assert step.promised.settling_time == lead.promised.settling_time


def test_poles_of_feedback_and_observer_are_those_they_were_designed_for():
    G = cid.linearize(CART, AT)
    found = tried(observer_design)
    _, _, feedback = ct.lqr(G, np.diag([10.0, 10, 1, 1]), np.eye(1))
    _, _, observer = ct.lqe(G, np.eye(1), 1e-4 * np.eye(2))
    expected = np.sort_complex(np.concatenate([feedback, observer]))
    for side in (found.promised, found.achieved):
        np.testing.assert_allclose(np.sort_complex(side.poles), expected, rtol=1e-6)


def test_the_disk_margin_is_that_of_python_control():
    found = tried(observer_design)
    L = open_at_inputs(found.loop)
    omega = np.geomspace(1e-2, 1e3, 20_000)
    size, decibels, phase = ct.disk_margins(L, omega)
    assert found.achieved.disk_margin == pytest.approx(size, rel=1e-3)
    assert found.achieved.disk_gain == pytest.approx(10 ** (decibels / 20), rel=1e-3)
    assert found.achieved.disk_phase == pytest.approx(phase, rel=1e-3)
    # The margin of an observer's loop is cut behind it: less than the 60 degrees of the feedback.
    assert found.achieved.margins[0].phase_margin < 45


@pytest.mark.parametrize("design", [observer_design, sampled_design])
def test_the_margins_are_where_the_loop_ceases_to_be_stable(design):
    found = tried(design)
    (margins,) = found.achieved.margins
    L = open_at_inputs(found.loop)
    for factor in (margins.gain_margin, margins.gain_reduction_margin):
        for share, stable in ((0.999, True), (1.001, False)):
            k = 1 + (factor - 1) * share
            poles = np.linalg.eigvals(L.A - k * L.B @ L.C)
            worst = np.max(np.abs(poles)) - 1 if L.dt else np.max(poles.real)
            assert (worst < 0) == stable


def test_inputs_are_cut_one_at_a_time():
    rig = cid.Loop(QUAD, dt=0.005, at=at_rest(QUAD))
    found = cid.redesign(rig, rig, step={"xd[1]": 0.1},
                         design=lambda P: observer_design(P, (10.0, 10, 10, 1, 1, 1)))  # fmt: skip
    first, second = found.achieved.margins
    assert first.phase_margin == pytest.approx(second.phase_margin, rel=1e-6)
    L = open_at_inputs(found.loop)
    for share, stable in ((0.999, True), (1.001, False)):
        gains = np.diag([1 + (first.gain_margin - 1) * share, 1.0])
        assert (np.max(np.linalg.eigvals(L.A - L.B @ gains @ L.C).real) < 0) == stable
    assert math.isnan(found.achieved.disk_margin) or found.achieved.disk_margin > 0
    (step,) = found.steps
    assert (step.reference, step.output, step.height) == ("xd[1]", "z", 0.1)
    assert step.achieved.final_value == pytest.approx(1, abs=0.01)
    # Nothing but height moves.
    assert step.achieved.peak_outputs[0] == step.achieved.peak_outputs[2] == 0


# --- several signals


@pytest.mark.parametrize("design", [observer_design, sampled_design])
def test_an_exact_model_keeps_its_promise(design):
    found = tried(design)
    assert found.stable
    assert found.failure is None
    assert found.loop.analog is (design is observer_design)
    assert [s.reference for s in found.steps] == ["xd[0]"]
    (step,) = found.steps
    assert step.output == "x"
    assert step.promised.y.shape == (2, step.time.size)
    assert step.promised.u.shape == (1, step.time.size)
    np.testing.assert_allclose(step.achieved.y, step.promised.y, atol=1e-4 * step.height)
    assert step.promised.final_value == pytest.approx(1, abs=2e-3)
    assert "the controller keeps the physics stable. The steps are as promised" in found.verdict


def test_a_fitted_loop_is_a_model():
    start = cid.Loop(CART, dt=DT, at=AT, free=("c",))
    C = sampled_gain(cid.linearize(CART, AT))
    d = 0.5 * cid.random_binary(300, amplitude=1, hold=5, seed=1)
    record = cid.simulate(cid.Loop(CART, C, dt=DT, at=AT), d=d, sensor_noise=(1e-4, 1e-3), seed=2)
    fitted = cid.fit_loop(start, record)
    found = cid.redesign(fitted, RIG, design=observer_design)
    assert found.stable
    np.testing.assert_allclose(found.model.A, fitted.model.A)
    assert found.model.state_labels == ["x", "theta", "x_dot", "theta_dot"]


def test_a_fitted_loop_of_one_signal_comes_with_its_states():
    def design(P):
        assert P.nstates == 2
        K = ct.lqr(P, np.diag([1e4, 1.0]), np.eye(1))[0]
        L = ct.lqe(P, np.eye(1), 1e-8 * np.eye(1))[0]
        return ct.ss(P.A - P.B @ K - L @ P.C, -L, -K, [[0.0]])

    found = cid.redesign(BALL, BALL, design=design)
    assert found.stable


def test_a_wrong_model_does_not_stabilize_and_that_is_reported():
    wrong = RIG.with_parameters({"length": 0.9, "m": 0.9})
    found = cid.redesign(wrong, RIG, design=lambda P: observer_design(P, noise=1.0))
    assert not found.stable
    assert found.promised.stable
    assert found.achieved.growth_rate > 0
    assert "DOES NOT STABILIZE THE PHYSICS" in found.verdict
    assert "Small deviations grow at" in found.verdict
    assert "nan" not in str(found)


def test_a_design_that_fails_on_its_own_model():
    found = cid.redesign(P, BALL, design=lambda P: -1 * cid.design_lead(P, 100, 50))
    assert not found.promised.stable
    assert "DOES NOT STABILIZE ITS OWN MODEL" in found.verdict


def test_limits_that_lose_the_pole_are_said():
    tight = cid.Loop(CART, dt=DT, at=AT, input_limits=(-0.05, 0.05))
    found = cid.redesign(RIG, tight, design=observer_design, step=2.0)
    assert not found.stable
    assert "WITH THE STEP THE LOOP DIVERGES. " in found.verdict
    assert np.isfinite(found.achieved.margins[0].phase_margin)


def test_an_output_that_moves_in_second_order_only_is_no_flight():
    rig = cid.Loop(QUAD, observer_design(cid.linearize(QUAD, at_rest(QUAD)),
                                         (10.0, 10, 10, 1, 1, 1)), dt=0.005,
                   at=at_rest(QUAD))  # fmt: skip
    record = cid.simulate(rig, {"xd[0]": np.full(300, 0.5)})
    assert record.y[0, -1] == pytest.approx(0.5, abs=0.05)
    assert 1e-4 < np.abs(record.y[1]).max() < 0.1


def test_results_are_values():
    found = tried(observer_design)
    (step,) = found.steps
    for array in (found.promised.poles, step.time, step.promised.y, step.achieved.u):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1


def test_a_controller_without_reference_has_no_step():
    found = tried(sampled_gain)
    assert found.stable
    assert found.steps == ()
    assert "The controller has no reference to step." in str(found)
    with pytest.raises(CtrlidError, match="nothing to draw: the controller has no reference"):
        cid.plot.step(found)


def test_margins_of_an_unstable_loop_are_unknown():
    unstable = cid.Loop(BALL.plant, -1 * BALL.controller, dt=1e-3, at=BALL.at)
    found = measure_performance(unstable)
    assert not found.stable
    assert math.isnan(found.disk_margin)


def test_another_settling_time_is_said_beside_a_promise_that_holds():
    found = tried(observer_design)
    assert "settles after" not in found.verdict
    (step,) = found.steps
    time = step.promised.settling_time
    slow = replace(step, achieved=replace(step.achieved, settling_time=2 * time))
    verdict = replace(found, steps=(slow,)).verdict
    assert "of their size, but xd[0] settles after" in verdict
    assert f"where {time:.4g} s is promised: the response stays near the edge of the 2 %" in verdict
    # A difference that the samples do not resolve is none.
    assert not settles_otherwise(0.01, 0.02, 0.01)
    assert settles_otherwise(0.1, 0.06, 0.01)
    assert not settles_otherwise(math.nan, 1.0, 0.01)


# --- texts and pictures


def test_the_report():
    text = str(tried(observer_design))
    for words in (
        "controller: StateSpace, analog", "theta <- theta", "F <- F of the controller",
        "phase margin at F [deg]", "disk margin [1]", "step of xd[0]: final x per unit",
        "step of xd[0]: largest change of theta", "step of xd[0]: largest change of F",
        "Achieved steps (xd[0] by 10 mm) are those of the nonlinear physics.",
    ):  # fmt: skip
        assert words in text


def test_the_picture_shows_every_signal():
    found = cid.redesign(RIG, RIG, design=observer_design, step={"xd[0]": 0.1, "xd[1]": 0.01})
    picture = cid.plot.step(found)
    assert len(picture) == 6
    labels = [ax.get_ylabel() for ax in picture]
    assert labels == ["x [m]", "x [m]", "theta [rad]", "theta [rad]", "F [N]", "F [N]"]
    assert picture[4].get_xlabel() == "time after the step of xd[0] [s]"
    texts = [t.get_text() for t in picture[1].get_legend().get_texts()]
    assert texts[0] == "promised: theta returns to rest"


def test_the_page(tmp_path):
    found = tried(observer_design)
    page = cid.write_report(found, tmp_path / "page.html").read_text("utf-8")
    assert "phase margin at F [deg]" in page
    assert "Response to a step of each reference." in page


# --- refusals


@pytest.mark.parametrize(
    ("design", "words"),
    [
        (lambda P: None, "returned nothing"),
        (lambda P: np.ones((1, 4)), r"returned a ndarray; of a gain matrix K make one"),
        (lambda P: "LQR", "returned a str"),
        (lambda P: ct.lqr(P, np.eye(3), np.eye(1)), "design raised ControlDimension on the model"),
        (lambda P: ct.create_statefbk_iosystem(P, np.ones((1, 4))),
         "design raised ControlArgument .* output must include the full state"),
        (lambda P: 1 / 0, "design raised ZeroDivisionError"),
        (lambda P: ct.ss([], [], [], [[1.0, 1.0, 1.0]], inputs=["a", "b", "c"]),
         "none of these is an output of the plant"),
        (lambda P: ct.ss([], [], [], np.ones((2, 2)), inputs=["x", "theta"]),
         "the controller has outputs"),
        (lambda P: ct.ss([], [], [], [[1.0, 1.0, 0.5]], inputs=["x", "theta", "F"]),
         "algebraic loop"),
        (lambda P: ct.append(ct.tf([1], [1, 1], 0.1), ct.tf([1], [1, 1], 0.2)),
         "design raised"),
    ],
)  # fmt: skip
def test_designs_are_refused_in_words(design, words):
    with pytest.raises(CtrlidError, match=words):
        cid.redesign(RIG, RIG, design=design)


def test_a_state_feedback_without_all_states_is_told_of_observers():
    with pytest.raises(CtrlidError, match=r"needs all 4 states, and the model has 2 outputs: add"):
        cid.redesign(RIG, RIG, design=lambda P: ct.create_statefbk_iosystem(P, np.ones((1, 4))))
    # What is wrong elsewhere is no matter of the states.
    with pytest.raises(CtrlidError, match="design raised ZeroDivisionError") as refusal:
        cid.redesign(RIG, RIG, design=lambda P: 1 / 0)
    assert "observer" not in str(refusal.value)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: cid.redesign(RIG, RIG, 10, 50), "takes one input and one output"),
        (lambda: cid.redesign(P, BALL), "needs the crossover and the phase margin of a lead, or"),
        (lambda: cid.redesign(P, BALL, 100, 50, design=abs), "given both"),
        (lambda: cid.redesign(P, BALL, design="lqr"), "design= is a function from the model"),
        (lambda: cid.redesign(P, RIG, design=abs), r"model has 1 output \(x\), the loop 2"),
        (lambda: cid.redesign(RIG, RIG, design=observer_design, step={"x_d": 1}),
         r"step= names x_d; the controller has the references xd\[0\]"),
        (lambda: cid.redesign(RIG, RIG, design=observer_design, step=0), "other than zero"),
        (lambda: cid.redesign(RIG, RIG, design=observer_design, step={"xd[0]": "1"}),
         "a mapping of references"),
        (lambda: cid.redesign(cid.linearize(CART, AT)[[1, 0], :], RIG, design=abs),
         "put them into the order of the loop"),
        (lambda: cid.redesign(ct.ss([[0.5]], [[1]], [[1], [1]], 0, 0.02), RIG,
                              design=lambda P: ct.ss([], [], [], [[1.0, 1.0]], 0.01)),
         "0.01"),
    ],
)  # fmt: skip
def test_refusals(call, words):
    with pytest.raises(CtrlidError, match=words):
        call()


# --- a pole at zero, and limits that a PID knew


def balancing(plant_states=("angle", "rate", "speed")):
    """A body that falls, held by a wheel whose speed nobody reads."""
    plant = ct.nlsys(
        lambda t, x, u, p: [x[1], p["a"] * np.sin(x[0]) - u[0], 0.7 * u[0]],
        lambda t, x, u, p: x[0], inputs=["u"], outputs=["angle"], states=list(plant_states),
        params={"a": 30.0}, name="body",
    )  # fmt: skip
    control = cid.PID(kp=-120.0, kd=-14.0, filter_time=0.005)
    return cid.Loop(plant, control, dt=0.01), control


def test_a_pole_at_zero_is_no_instability():
    loop, control = balancing()
    trial = cid.redesign(loop, loop, design=lambda P: control, step=0.01)
    assert trial.stable
    for side in (trial.promised, trial.achieved):
        assert side.growth_rate == 0.0
        assert side.damping > 0
        assert side.margins[0].phase_margin > 10
    assert "A pole at zero remains" in trial.verdict
    assert "STABILIZE" not in trial.verdict


def test_a_slow_pole_that_is_not_at_zero_is_an_instability():
    loop, control = balancing()
    wrong = replace(control, kp=-29.9)
    trial = cid.redesign(loop, loop, design=lambda P: wrong, step=0.01)
    assert 0 < trial.promised.growth_rate < 0.1
    assert "DOES NOT STABILIZE ITS OWN MODEL" in trial.verdict


def test_the_limits_of_the_former_pid_stay_those_of_the_input():
    plant = cid.plants.servo(m=1.0, c=2.0, k=3.0)
    loop = cid.Loop(plant, cid.PID(kp=5.0, lower=-0.5, upper=0.4), dt=0.01)
    free = cid.Loop(plant, cid.PID(kp=5.0), dt=0.01)
    runs = [cid.redesign(one, one, design=lambda P: ct.tf([20.0], [1.0], 0.01), step=0.1)
            for one in (loop, free)]  # fmt: skip
    limited, wide = (run.steps[0].achieved.peak_inputs[0] for run in runs)
    assert limited == pytest.approx(0.5)
    assert wide == pytest.approx(2.0)
    other = cid.PID(kp=20.0, lower=-1.0, upper=1.0)
    own = cid.redesign(loop, loop, design=lambda P: other, step=0.1)
    assert own.steps[0].achieved.peak_inputs[0] == pytest.approx(1.0)
    ball = cid.plants.maglev(m=0.0213, K=3.34e-6)
    at = cid.operating_point(ball, output=0.012)
    held = cid.Loop(ball, cid.PID(kp=-3e3, kd=-60.0, lower=0.0, upper=12.0), dt=0.001, at=at)
    lead = cid.redesign(cid.linearize(ball, at), held, crossover=100, phase_margin=50)
    assert lead.loop.input_limits == (0.0, 12.0)


@pytest.mark.parametrize("square", [1.0, 7.0, 16.0, 1234.5])
def test_an_undamped_plant_has_its_margins(square):
    """The grid of frequencies has its pole exactly, where numpy refuses to solve."""
    P = ct.ss([[0, 1], [-square, 0]], [[0], [1]], [[1, 0]], 0, inputs="u", outputs="y")
    loop = cid.Loop(P, None, dt=0.1 / np.sqrt(square))
    w = np.sqrt(square)
    law = ct.tf([3.0 * square, 4.0 * w * square], [1.0, 10.0 * w])
    found = cid.redesign(P, loop, design=lambda P: law)
    assert found.stable
