"""Where a loop and a record go together, either may come first."""

import numpy as np
import pytest

import ctrlid as cid
from ctrlid import CtrlidError
from ctrlid.data.several_records import order_model_and_data
from problems import REST, record_of, servo


@pytest.fixture(scope="module")
def pair():
    loop = servo(cid.PID(kp=20.0, kd=1.0), at=REST, free=("k",))
    return loop, record_of(loop, swing=0.1, hold=50, n=600, seed=1, sensor_noise=1e-4)


CALLS = {
    "compare": cid.compare,
    "audit": cid.audit,
    "fit_loop": cid.fit_loop,
    "predict": lambda a, b: cid.predict(a, b).innovations,
    "replay_controller": cid.replay_controller,
    "diagnose": lambda a, b: cid.diagnose(a, b, catalogue=(), progress=False).gap.given,
}


@pytest.mark.parametrize("name", CALLS)
def test_either_order_gives_the_same(pair, name):
    loop, record = pair
    one, other = CALLS[name](loop, record), CALLS[name](record, loop)
    if isinstance(one, np.ndarray | float):
        np.testing.assert_array_equal(one, other)
    else:
        assert str(one) == str(other)


def test_several_records_and_models_of_any_kind(pair):
    loop, record = pair
    assert order_model_and_data([record, record], loop) == (loop, [record, record])
    assert order_model_and_data(None, record) == (None, record)
    assert order_model_and_data(record, None) == (None, record)
    model = cid.linearize(loop.plant, loop.at)
    assert order_model_and_data(record, model) == (model, record)


def test_two_of_a_kind_are_refused_as_they_were_given(pair):
    loop, record = pair
    with pytest.raises(
        CtrlidError, match=r"compare needs a Loop, or a transfer function such as .* given Record"
    ):
        cid.compare(record, record)
    with pytest.raises(CtrlidError, match="a Record or a list of Records is needed; given Loop"):
        cid.fit_loop(loop, loop)
