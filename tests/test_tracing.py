"""Tracing plants: every numpy style works or is refused with its cure, nothing is silently wrong.

Groups: styles that must trace; styles that must be refused; interconnections; parameters; domains.
"""

import functools
import math
from math import sin as sine

import control as ct
import numpy as np
import pytest
from numpy import clip

import ctrlid as cid
from ctrlid import CtrlidError
from ctrlid.physics.trace import trace

BUFFER = np.zeros(2)
CALLS = {"n": 0}


def plant(update, output=None, **kwargs):
    output = output or (lambda t, x, u, params: x[0])
    return ct.nlsys(
        update, output, inputs=["u"], outputs=["y"], states=["a", "b"], name="test", **kwargs
    )


def filled_line_by_line(t, x, u, params):
    dx = np.zeros(2)
    dx[0] = x[1]
    dx[1] = math.sin(x[0]) + u[0]
    return dx


def filled_like_state(t, x, u, params):
    dx = np.zeros_like(x)
    dx += x
    dx[1] += u[0]
    return dx


def unpacked(t, x, u, params):
    a, b = x
    (force,) = u
    return [b, -params.get("k", 2.0) * float(a) ** 3 + force]


def imported_names(t, x, u, params):
    push = clip(u[0], -1, 1) + np.sign(x[1]) * max(x[0], 0.0) - min(x[1], u[0], 1.0)
    return np.array([x[1], sine(x[0]) + push])


def imported_inside(t, x, u, params):
    import math as m

    import numpy  # noqa: ICN001

    def shape(z):
        return numpy.tanh(z) * numpy.where(z > 0, 1.0, 2.0)

    return numpy.hstack([x[1], shape(x[0]) + u[0] + m.atan2(x[0], 2.0)])


def mass_matrix(t, x, u, params):
    inertia = np.array([[2 + np.cos(x[0]), 1.0], [1.0, 3.0]])
    return np.linalg.solve(inertia, np.array([u[0], x[1] ** 2]))


def whole_vectors(t, x, u, params):
    a = np.array([[0, 1], [2.0, -1]])
    return a @ x + np.array([0, 1.0]) * np.where(u > 1, 1, u)


def table(t, x, u, params):
    return [x[1], np.interp(x[0], [0, 1, 2], [0, 1, 4]) * u[0]]


def column(t, x, u, params):
    return np.array([[x[1]], [u[0] - x[0]]])


def math_module(t, x, u, params):
    root = math.copysign(1.0, x[1]) * math.sqrt(abs(x[0]))
    return [x[1], root + math.pow(x[0], 2) - math.exp(-(x[0] ** 2)) + math.hypot(x[0], u[0])]


def bool_algebra(t, x, u, params):
    inside = (x[0] > 0) & ~(x[0] > 1) | (u[0] < -1)
    return [x[1], np.where(np.logical_or(inside, x[1] > 2), u[0], -u[0]) + x[0] % 3 + x[1] // 2]


def array_methods(t, x, u, params):
    y = np.concatenate([x, u])
    return [y.max() - y.min(), y.sum() + y.clip(-1, 1).sum() + np.round(x[0], 1)]


def in_place(t, x, u, params):
    y = x.copy()
    y *= 2
    y -= np.ones(2)
    np.sin(y, out=y)
    return [y[1], y[0] + np.heaviside(u[0], 0.5) + np.linalg.norm(x)]


def helper(z, gain):
    return gain * math.tanh(z)


def calls_helper(t, x, u, params):
    return [x[1], helper(x[0], 2.0) + functools.reduce(lambda a, b: a * b, x) + u[0]]


def time_varying(t, x, u, params):
    return [x[1], np.sin(10 * t) * x[0] + u[0]]


TRACEABLE = [
    filled_line_by_line, filled_like_state, unpacked, imported_names, imported_inside,
    mass_matrix, whole_vectors, table, column, math_module, bool_algebra, array_methods, in_place,
    calls_helper, time_varying, functools.partial(unpacked),
]  # fmt: skip


class Rig:
    """A user's plant object: bound methods that call each other."""

    stiffness = 3.0

    def update(self, t, x, u, params):
        return [x[1], self.force(x) + u[0]]

    def force(self, x):
        return math.sin(x[0]) * self.stiffness

    def __call__(self, t, x, u, params):
        return self.update(t, x, u, params)

    def remembering(self, t, x, u, params):
        self.last = x[0]
        return [x[1], u[0]]


def name_of(f):
    return getattr(f, "__name__", type(f).__name__)


@pytest.mark.parametrize("update", [*TRACEABLE, Rig().update, Rig()], ids=name_of)
def test_traced_equations_equal_the_function(update):
    system = plant(update)
    equations = trace(system)
    rng = np.random.default_rng(0)
    for _ in range(50):
        x, u, t = rng.standard_normal(2) * 2, rng.standard_normal(1) * 2, rng.uniform(0, 3)
        rhs, out = equations.evaluate(x, u, t)
        np.testing.assert_allclose(rhs, system.dynamics(t, x, u), rtol=1e-12, atol=1e-13)
        np.testing.assert_allclose(out, system.output(t, x, u), rtol=1e-12)


def test_the_users_function_and_numpy_stay_untouched():
    before = (filled_line_by_line.__globals__["np"], np.zeros, math.sin)
    trace(plant(filled_line_by_line))
    assert (filled_line_by_line.__globals__["np"], np.zeros, math.sin) == before
    assert np.zeros(2).dtype == float


def if_on_state(t, x, u, params):
    if x[0] > 0:
        return [x[1], u[0]]
    return [x[1], -u[0]]


def conditional_expression(t, x, u, params):
    return [x[1], (1 if x[1] > 0 else -1) * 3.0 + u[0]]


def chained_comparison(t, x, u, params):
    return [x[1], (0 < x[0] < 1) * u[0]]


def global_buffer(t, x, u, params):
    BUFFER[0] = x[1]
    BUFFER[1] = u[0]
    return BUFFER


def cubic_spline(t, x, u, params):
    from scipy.interpolate import CubicSpline

    return [x[1], float(CubicSpline([0, 1, 2], [0, 1, 4])(x[0])) * u[0]]


def with_memory(t, x, u, params):
    CALLS["n"] += 1
    return [x[1], u[0] + CALLS["n"]]


def with_chance(t, x, u, params):
    return [x[1], u[0] + np.random.rand()]  # noqa: NPY002


def too_short(t, x, u, params):
    return [x[1]]


def whole_input(t, x, u, params):
    return np.array([x[1], -x[0] + u])


@pytest.mark.parametrize(
    ("update", "words"),
    [
        (whole_input, ["value 2 of 2 that the update function", r"write u\[0\] in place of u,"]),
        (if_on_state, [r"line \d+ of .*test_tracing.py: if x\[0\] > 0", "np.where"]),
        (conditional_expression, ["np.where"]),
        (chained_comparison, ["& and |"]),
        (global_buffer, ["preallocated array", "in one expression"]),
        (cubic_spline, ["turned into a plain float", "numpy's functions"]),
        (with_memory, ["do not reproduce", "no memory"]),
        (with_chance, ["the rate of b", "no random numbers"]),
        (too_short, ["returned 1 value, but 2 are declared"]),
        (Rig().remembering, ["stores self.last", "make it a state"]),
    ],
    ids=lambda v: getattr(v, "__name__", ""),
)
def test_untraceable_functions_are_refused_with_their_cure(update, words):
    with pytest.raises(CtrlidError) as refusal:
        trace(plant(update))
    import re

    for word in words:
        assert re.search(word, str(refusal.value)) or word in str(refusal.value)


def test_nowhere_defined_is_refused():
    with (
        pytest.raises(CtrlidError, match="gave no finite value at 240 random points"),
        np.errstate(all="ignore"),
    ):
        trace(plant(lambda t, x, u, params: [np.sqrt(-1.0 - x[0] ** 2), u[0]]))


def test_other_objects_are_refused():
    with pytest.raises(CtrlidError, match=r"a plant is a control.NonlinearIOSystem.*given list"):
        trace([1, 2])


def test_undeclared_signals_are_refused():
    system = ct.nlsys(lambda t, x, u, params: -x, None, inputs=1)
    with pytest.raises(CtrlidError, match="does not declare"):
        trace(system)


def power_law(t, x, u, params):
    return [x[1], sum(x[0] ** i for i in range(params["n"])) + params["k"] * u[0]]


def switched_by_parameter(t, x, u, params):
    return [x[1], u[0]] if params["k"] > 0 else [x[1], -u[0]]


def test_parameters_become_symbols_where_the_function_allows_it():
    whole = trace(plant(power_law, params={"n": 3, "k": 2.0, "label": "x", "on": True}))
    assert dict(whole.parameters) == {"k": 2.0}
    assert whole.evaluate([2.0, 0.0], 1.0)[0][1] == 9.0
    assert dict(trace(plant(switched_by_parameter, params={"k": 1.0})).parameters) == {}


def servo(**kwargs):
    return ct.nlsys(
        lambda t, x, u, params: [x[1], params["k"] * u[0] - x[1]], lambda t, x, u, params: x[0],
        inputs=["F"], outputs=["y"], states=["x", "v"], params={"k": 3.0}, name="servo", **kwargs,
    )  # fmt: skip


def lag(name="lag"):
    return ct.nlsys(
        lambda t, x, u, params: (u[0] - x[0]) / params["tau"], lambda t, x, u, params: x[0],
        inputs=["u"], outputs=["F"], states=["i"], params={"tau": 0.1}, name=name,
    )  # fmt: skip


def test_interconnected_systems_trace_part_by_part():
    whole = ct.interconnect([lag(), servo()], inputs="u", outputs="y", name="whole")
    equations = trace(whole)
    assert equations.states == ("lag_i", "servo_x", "servo_v")
    assert dict(equations.parameters) == {"tau": 0.1, "k": 3.0}
    rng = np.random.default_rng(0)
    for _ in range(20):
        x, u = rng.standard_normal(3), rng.standard_normal(1)
        np.testing.assert_allclose(equations.evaluate(x, u)[0], whole.dynamics(0, x, u), rtol=1e-12)


def test_products_and_feedback_of_systems_trace():
    loop = ct.feedback(servo() * lag(), ct.tf([2.0], [0.1, 1.0]))
    equations = trace(loop)
    x = np.array([0.3, -0.2, 0.5, 0.1])
    np.testing.assert_allclose(equations.evaluate(x, 0.7)[0], loop.dynamics(0, x, [0.7]))


def test_algebraic_loop_is_refused():
    direct = ct.nlsys(None, lambda t, x, u, params: 0.5 * u[0], inputs=["e"], outputs=["F"],
                      name="direct")  # fmt: skip
    loop = ct.interconnect(
        [direct, ct.summing_junction(["u", "F"], "e", name="sum")], inputs="u", outputs="F",
        name="loop",
    )  # fmt: skip
    with pytest.raises(CtrlidError, match="algebraic loop"):
        trace(loop)


def test_structure_velocities_and_feedthrough():
    assert trace(servo()).velocities == (1,)
    assert trace(lag()).velocities == ()
    assert not trace(servo()).feedthrough
    assert trace(ct.ss([[-1.0]], [[1.0]], [[1.0]], [[0.5]])).feedthrough


def test_functions_without_params_are_told_their_arguments():
    plant = ct.nlsys(lambda t, x, u: [u[0]], lambda t, x, u: x[0], inputs="V", outputs="x",
                     states=["x"])  # fmt: skip
    with pytest.raises(CtrlidError, match=r"take \(t, x, u, params\)"):
        cid.Loop(plant, None, dt=0.01)
