"""What another effect, or the noise of the sensor, hides at first, on draws from outside."""

import pytest

from ctrlid import effects as E
from ctrlid.diagnosis.candidates import borrow_size
from ctrlid.diagnosis.recalibration import fit_base_model
from ctrlid.diagnosis.screening import screen_at
from problems import diagnose_draw, levitation, record_of

DRAWS = {
    # A long lag of the actuator looks like none beside parameters that are fitted without it.
    "a lag": ("one", 93174, (E.ActuatorLag, E.SensorLag, E.ConstantForce)),
    # Friction and a mode stood for a gain that falls, and left the sensor's colour no trace.
    "a colour": ("one", 93060, (E.InputSaturatingGain, E.ViscousFriction, E.FlexibleMode)),
    # Noise that is an average of samples took the place of a backlash, and then left it nothing.
    "an average": ("one", 93167, (E.InputBacklash, E.InputDeadZone, E.ParameterDrift)),
}


@pytest.mark.parametrize(
    "draw",
    ["a lag", *(pytest.param(k, marks=pytest.mark.slow) for k in ("a colour", "an average"))],
)
def test_what_is_hidden_by_something_like_it_is_found(draw):
    case, found = diagnose_draw(*DRAWS[draw])
    assert [found.findings[0].name] == [*case.hidden]
    assert len(found.findings) == 1
    assert found.verdict == "explained"


@pytest.mark.slow
def test_what_can_only_stand_in_is_no_rival_of_a_colour():
    """A curve of the input beside the law of force, which a colour of the sensor leaves its turn.

    It gains a small share of what is missing as long as the colour is, and the search ended there.
    """
    some = E.ForceExponent, E.InputNonlinearity, E.InputSaturatingGain, E.LinearStiffness
    case, found = diagnose_draw("two", 93060, some)
    assert {*case.hidden} == {"InputSaturatingGain", "ForceExponent"}
    named = [set(f.names) for f in found.findings]
    assert len(named) == 2
    assert all(any(name in each for each in named) for name in case.hidden)


def test_a_size_is_borrowed_in_its_unit_alone():
    loop = levitation()
    record = record_of(loop, swing=1e-4, hold=40, n=400, seed=1, sensor_noise=2e-6)
    base = fit_base_model(loop, [record], loop.free)

    def borrow(effect, other):
        return borrow_size(screen_at(base, effect), screen_at(base, other))

    lag = E.SensorLag(tau=3e-3)
    assert borrow(E.ActuatorLag(tau=1e-5), lag) == E.ActuatorLag(tau=3e-3)
    assert borrow(E.InputDelay(delay=0.0), lag) == E.InputDelay(delay=3e-3)
    # A share has no unit, and an exponent is none.
    assert borrow(E.ForceExponent(n=2.0), E.SensorGain(error=0.1)) is None
    assert borrow(E.FlexibleMode(30.0, 0.1, 0.0), lag) is None
