"""The sensor as a suspect: its scale, its drift and its hum, and what they cannot be told from."""

import control as ct
import numpy as np
import pytest

import ctrlid as cid
import ctrlid.effects as E
from ctrlid.diagnosis.findings import Finding
from ctrlid.diagnosis.scans import is_line_of_reference
from ctrlid.diagnosis.wording import describe_aliases, join_names
from ctrlid.loop.period_map import comes_to_rest
from problems import levitation

DT, N, FINE = 0.01, 400, 10
M, C, K = 2.0, 4.0, 3.0


def simulate_by_hand(read, r, kp=20.0):
    """A mass in a loop, by Runge-Kutta; the controller sees what the sensor shows."""
    x, v = 0.0, 0.0
    y, u = np.empty(len(r)), np.empty(len(r))
    for k in range(len(r)):
        t = k * DT
        y[k] = read(x, t)
        u[k] = kp * (r[k] - y[k])

        def rate(x, v, u=u[k]):
            return v, (K * u - C * v) / M

        h = DT / FINE
        for _ in range(FINE):
            a = rate(x, v)
            b = rate(x + h / 2 * a[0], v + h / 2 * a[1])
            c = rate(x + h / 2 * b[0], v + h / 2 * b[1])
            d = rate(x + h * c[0], v + h * c[1])
            x += h / 6 * (a[0] + 2 * b[0] + 2 * c[0] + d[0])
            v += h / 6 * (a[1] + 2 * b[1] + 2 * c[1] + d[1])
    return y, u


def reference():
    return np.where(np.arange(N) * DT % 1.3 < 0.6, 0.1, -0.05)


@pytest.mark.parametrize(("effect", "read"), [
    (E.SensorGain(0.05), lambda x, t: 1.05 * x),
    (E.SensorDrift(0.02), lambda x, t: x + 0.02 * t),
    (E.SensorDrift(0.02, settling=0.4), lambda x, t: x + 0.02 * 0.4 * (1 - np.exp(-t / 0.4))),
    (E.SensorHum(0.01, 7.3, 0.4),
     lambda x, t: x + 0.01 * np.sin(2 * np.pi * 7.3 * t + 0.4)),
], ids=["scale", "steady drift", "warm-up", "hum"])  # fmt: skip
def test_the_controller_sees_what_the_sensor_shows(effect, read):
    y, u = simulate_by_hand(read, reference())
    loop = cid.Loop(cid.plants.servo(M, C, K), ct.tf([20.0], [1.0], DT), dt=DT)
    record = cid.simulate(loop.with_effect(effect), reference())
    np.testing.assert_allclose(record.y, y, atol=1e-7)
    np.testing.assert_allclose(record.u, u, atol=1e-5)


def levitated(free=("K",)):
    plant = cid.plants.maglev(m=0.0213, K=3.34e-6, g=9.81)
    return cid.Loop(plant, None, dt=0.001, at=cid.operating_point(plant, output=0.012), free=free)


def cart(damping, spring=0.0):
    """A mass with or without friction and spring."""
    return ct.nlsys(
        lambda t, x, u, p: np.array([x[1], p["b"] * u[0] - p["c"] * x[1] - spring * x[0]]),
        lambda t, x, u, p: x[0],
        states=("x", "v"), inputs=("u",), outputs=("y",), params={"b": 0.5, "c": damping},
    )  # fmt: skip


def test_a_scale_is_a_force_only_where_a_free_parameter_moves_along():
    assert E.equivalents(E.SensorGain(0.03), levitated()) == ("ConstantForce", "parameter g")
    assert E.equivalents(E.ConstantForce(0.1), levitated()) == ("SensorGain", "parameter g")
    assert E.equivalents(E.SensorGain(0.03), levitated(())) == ()
    # All that a scale does to a mass without weight is to change the gain of its input.
    at = cid.operating_point(cart(0.7), output=0.0)
    drive = cid.Loop(cart(0.7), None, dt=DT, at=at)
    assert "parameter b" in E.equivalents(E.SensorGain(0.03), drive)


def test_a_ball_on_another_scale_is_a_ball_in_another_gravity():
    """The equivalence of the words above, on the ball's own equations, by hand."""
    g, k, m, e = 9.81, 3.34e-6, 0.0213, 0.04
    z, u = np.linspace(0.008, 0.016, 9), np.linspace(2.0, 4.0, 9)
    shown = (1 + e) * (g - k * u**2 / (m * (z / (1 + e)) ** 2))
    other = g * (1 + e) - k * (1 + e) ** 3 * u**2 / (m * z**2)
    np.testing.assert_allclose(shown, other, rtol=1e-12)


def test_a_drift_is_a_steady_motion():
    spring, rubbed, free = (
        cid.Loop(cart(*given), None, dt=DT, at=cid.OperatingPoint((0.0, 0.0), 0.0, 0.0))
        for given in ((0.7, 3.0), (0.7,), (0.0,))
    )
    assert E.equivalents(E.SensorDrift(0.01), spring) == ()
    assert E.equivalents(E.SensorDrift(0.01), rubbed) == ("ConstantForce", "InputOffset")
    assert "SensorDrift" in E.equivalents(E.ConstantForce(0.1), rubbed)
    assert E.equivalents(E.SensorDrift(0.01), free) == ("the initial velocity",)
    assert E.equivalents(E.SensorDrift(0.01), levitated()) == ()


def test_a_line_in_the_reading_and_one_in_the_force_are_one_on_a_linear_plant():
    servo = cid.Loop(cid.plants.servo(M, C, K), None, dt=DT)
    line = E.SensorHum(0.01, 7.3)
    assert E.equivalents(line, servo.with_effect(line)) == ("PeriodicForce",)
    assert E.equivalents(E.PeriodicForce(0.1, 5.0), servo.with_effect(line)) == ("SensorHum",)
    assert E.equivalents(line, levitated()) == ()
    rough = servo.with_effect(E.CoulombFriction(0.1))
    assert E.equivalents(line, rough) == ()


@pytest.mark.parametrize(("frequency", "dt", "words"), [
    (40.0, 0.01, "40 Hz, or 60 Hz (of the mains) folded at 100 Hz sampling"),
    (12.3, 0.001, "12.3 Hz, or 987.7 Hz folded at 1000 Hz sampling"),
    (50.0, 0.001, "50 Hz (of the mains), or 950 Hz folded at 1000 Hz sampling"),
    (13.0, 1 / 63, "13 Hz, or 50 Hz (of the mains) folded at 63 Hz sampling"),
])  # fmt: skip
def test_aliases_of_a_line(frequency, dt, words):
    assert describe_aliases(frequency, dt) == words


def test_what_no_record_tells_apart_is_one_name():
    line = Finding(E.PeriodicForce(0.1, 5.0), {}, (), ("SensorHum",), 50.0)
    scale = Finding(E.ConstantForce(0.1), {}, (), ("SensorGain", "parameter g"), 50.0)
    assert join_names([line]) == "PeriodicForce or SensorHum"
    assert join_names([scale]) == "ConstantForce, SensorGain or the parameter g of the plant"


def test_a_line_is_not_blamed_on_the_sensor_alone_where_no_mass_moves():
    """The tension of a web behind a roll that runs out of true, which no effect of it can name."""
    k, tau, dt, n, line = 2.0, 0.5, 0.05, 800, 0.9
    rng = np.random.default_rng(3)
    r = np.repeat(rng.choice([9.0, 11.0], n // 40), 40)
    y, u, tension, integral = np.zeros(n), np.zeros(n), 10.0, 10.0 / k
    for i in range(n):
        y[i] = tension + 0.02 * rng.standard_normal()
        integral += 0.1 * (r[i] - y[i]) * dt
        u[i] = 0.3 * (r[i] - y[i]) + integral
        for j in range(20):
            t = (i + j / 20) * dt
            push = 0.5 * np.sin(2 * np.pi * line * t)
            tension += dt / 20 * ((k * u[i] - tension) / tau + push)
    plant = ct.nlsys(lambda t, x, u, q: (q["k"] * u - x) / q["tau"], lambda t, x, u, q: x,
                     inputs=["u"], outputs=["T"], states=["T"], params={"k": k, "tau": tau},
                     name="web")  # fmt: skip
    at = cid.OperatingPoint((10.0,), 10.0 / k, 10.0)
    loop = cid.Loop(plant, None, dt=dt, at=at, free={"k": 0.05, "tau": 0.05})
    found = cid.diagnose(loop, cid.Record(r=r, u=u, y=y, dt=dt), progress=False,
                         catalogue=(E.SensorHum, E.SensorLag))  # fmt: skip
    assert found.findings[0].names == ("SensorHum",)
    assert found.findings[0].effect.frequency == pytest.approx(line, rel=0.01)
    assert "a disturbance of the plant itself at this frequency" in " ".join(str(found).split())
    assert E.SensorHum(0.1, 1.0).disguise(levitated().equations()) is None


def test_a_step_stays_within_the_record_and_a_parameter_keeps_its_sign():
    class Seen:
        dt, duration, travel, fastest = DT, 4.0, 1.0, 1.0

    step = E.ParameterStep("k", 2.0, 0.1)
    assert step.limits(Seen) == {"time": (0.0, 4.0), "size": (-1.0, np.inf)}
    assert E.ParameterDrift("k", 0.1).limits(Seen) == {"rate": (-0.25, np.inf)}
    assert next(p for p in step.parameters() if p.name == "time").searched


def test_hum_is_never_the_plant_alone():
    loop = cid.Loop(cid.plants.servo(M, C, K), ct.tf([20.0], [1.0], DT), dt=DT, free=("c", "k"))
    r = np.tile(reference(), 4)
    rng = np.random.default_rng(5)
    noise = 1e-3 * rng.standard_normal(len(r))
    y, u = simulate_by_hand(
        lambda x, t: x + noise[round(t / DT)] + 1e-3 * np.sin(2 * np.pi * 60 * t), r
    )
    found = cid.diagnose(loop, cid.Record(dt=DT, r=r, u=u, y=y),
                         catalogue=(E.PeriodicForce, E.SensorHum, E.ConstantForce))  # fmt: skip
    assert found.verdict == "explained"
    assert "PeriodicForce" in found.sentence
    assert "SensorHum" in found.sentence
    text = " ".join(str(found).split())
    assert "60 Hz (of the mains) folded at 100 Hz" in text
    assert " N at " not in text


def test_a_drift_that_settles_is_told_from_a_steady_one():
    loop = cid.Loop(cid.plants.servo(M, C, K), ct.tf([20.0], [1.0], DT), dt=DT, free=("c", "k"))
    r = np.tile(reference(), 5)
    last = DT * (len(r) - 1)
    noise = 1e-3 * np.random.default_rng(6).standard_normal(len(r))
    time = 0.2 * last
    for way in (lambda t: t / last, lambda t: 1 - np.exp(-t / time)):
        y, u = simulate_by_hand(lambda x, t, way=way: x + noise[round(t / DT)] + 2e-2 * way(t), r)
        found = cid.diagnose(loop, cid.Record(dt=DT, r=r, u=u, y=y),
                             catalogue=(E.SensorDrift, E.ParameterDrift))  # fmt: skip
        (finding,) = found.findings
        assert finding.name == "SensorDrift"
        values = finding.effect.values()
        if way(last) == 1:
            assert set(values) == {"rate"}
            assert values["rate"] == pytest.approx(2e-2 / last, rel=0.1)
        else:
            assert values["settling"] == pytest.approx(time, rel=0.2)
            assert values["rate"] * values["settling"] == pytest.approx(2e-2, rel=0.1)


def test_a_drift_that_settles_is_no_constant_force():
    servo = cid.Loop(cid.plants.servo(M, C, K), None, dt=DT)
    assert "ConstantForce" in E.equivalents(E.SensorDrift(0.1), servo)
    assert E.equivalents(E.SensorDrift(0.1, settling=3.0), servo) == ()


@pytest.mark.slow
def test_hum_on_a_levitated_ball_is_named_beside_the_force_that_fits_as_well():
    """What a scan found pays for the scan on both sides of a comparison."""
    loop = levitation()
    r = 0.012 + cid.random_binary(1200, amplitude=2e-4, hold=60, seed=4)
    record = cid.simulate(levitation(E.SensorHum(8e-6, 60.0, 0.3)), r, sensor_noise=8e-6, seed=4)
    found = cid.diagnose(loop, record, catalogue=(E.SensorHum, E.PeriodicForce))
    (finding,) = found.findings
    assert set(finding.names) == {"SensorHum", "PeriodicForce"}


def test_a_line_of_the_reference():
    t = np.arange(2000) * DT
    quiet = np.zeros(len(t))
    sine = cid.Record(dt=DT, u=quiet, y=quiet, r=0.012 + 1e-3 * np.sin(2 * np.pi * 1.7 * t + 0.3))
    assert is_line_of_reference(sine, 1.7)
    assert not is_line_of_reference(sine, 7.3)
    rest = cid.Record(dt=DT, u=quiet, y=quiet, r=np.full(len(t), 0.012))
    assert not is_line_of_reference(rest, 1.7)
    assert not is_line_of_reference(cid.Record(dt=DT, u=quiet, y=quiet), 1.7)


def test_a_loop_with_two_hums_comes_to_rest() -> None:
    """Effects that the linear model leaves out are numbered anew as they go."""
    rest = cid.OperatingPoint((0.0, 0.0), 0.0, 0.0)
    loop = cid.Loop(cid.plants.servo(m=1.0, c=2.0, k=3.0), 0.5, dt=0.01, at=rest)
    hums = [E.SensorHum(amplitude=0.1, frequency=f, phase=0.0) for f in (5.0, 7.0)]
    assert comes_to_rest(loop.with_effect(hums[0]).with_effect(hums[1]))
