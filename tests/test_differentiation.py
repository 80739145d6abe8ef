"""A period differentiated stage by stage, against CasADi's derivative of the whole expression."""

import casadi
import numpy as np
import pytest

import ctrlid as cid
from ctrlid import effects as E
from ctrlid.physics.differentiation import Stages, differentiate
from ctrlid.physics.integration import Scheme, advance, cut_input
from problems import levitation


def write_period(e, dt, scheme, stages=None):
    """Return the state after a period, and the symbols it depends on."""
    x, p, s = (casadi.SX.sym(k, n) for k, n in (("x", len(e.states)), ("p", e.p.shape[0]),
                                                ("s", len(e.states))))  # fmt: skip
    t, path = casadi.SX.sym("t"), [casadi.SX.sym(f"u{k}", len(e.inputs)) for k in range(3)]
    pieces = [tuple(casadi.substitute(casadi.SX(v), e.p, p) for v in piece)
              for piece in cut_input(e, dt, path, "foh")]  # fmt: skip
    end = advance(e, t, x, pieces, p, s, scheme=scheme, stages=stages)[0]
    return end, x, p, [t, x, *path, p, s]


def make_seeds(n, m):
    """Return the derivatives of n states and m parameters, each by itself."""
    return [casadi.horzcat(casadi.SX.eye(n), casadi.SX(n, m)),
            casadi.horzcat(casadi.SX(m, n), casadi.SX.eye(m))]  # fmt: skip


@pytest.mark.parametrize("scheme", [Scheme(4, 1), Scheme(4, 3), Scheme(8, 1), Scheme(8, 2, (8, 2))])
@pytest.mark.parametrize("effects", [
    (), (E.CoulombFriction(fc=0.004),), (E.ActuatorLag(tau=2e-4), E.ViscousFriction(c=0.1)),
    (E.InputDelay(delay=5e-4), E.SensorLag(tau=1e-3)),
], ids=["plain", "kink", "lag", "delay"])  # fmt: skip
def test_derivatives_are_those_of_the_whole_expression(effects, scheme):
    loop = levitation(*effects)
    e, dt = loop.equations(), loop.dt
    index = [k for k, name in enumerate(e.parameters) if name == "K" or "." in name]
    end, x, p, given = write_period(e, dt, scheme)
    free = casadi.vertcat(*(p[k] for k in index))
    whole = casadi.Function("whole", given, [end, casadi.jacobian(end, casadi.vertcat(x, free))])
    stages = Stages(e)
    end, x, p, given = write_period(e, dt, scheme, stages)
    free, n, m = casadi.vertcat(*(p[k] for k in index)), x.shape[0], len(index)
    seeds = make_seeds(n, m)
    parts = differentiate(end, stages, index, [x, free], seeds)
    staged = casadi.Function("staged", given, [*parts])
    rest = np.array(loop.point.states)
    rng = np.random.default_rng(3)
    for _ in range(5):
        state = rest * (1 + 1e-2 * rng.standard_normal(n)) + 1e-3 * rng.standard_normal(n)
        state[0] = 0.012 * (1 + 0.05 * rng.standard_normal())
        u = loop.at.input * (1 + 0.05 * rng.standard_normal(3))
        values = [0.0, state, *u, e.values, np.full(n, 1e-3)]
        for mine, theirs in zip(staged(*values), whole(*values), strict=True):
            scale = np.maximum(np.abs(np.array(theirs)), 1e-9)
            assert np.all(np.abs(np.array(mine - theirs)) < 1e-9 * scale)


def test_a_kink_takes_fewer_instructions():
    """What is differentiated as a whole repeats the formula of the kink for every direction."""
    plant = cid.plants.cart_pole(M=0.5, m=0.2, length=0.3, J=0.006, c=0.1, gamma=0.002)
    loop = cid.Loop(plant, None, dt=0.01, at=cid.operating_point(plant, output=[0.0, 0.0]))
    e = loop.with_effect(E.CoulombFriction(fc=0.1, at="x_dot")).equations()
    index = list(range(len(e.parameters)))
    end, x, p, given = write_period(e, 0.01, Scheme(4, 1))
    slopes = casadi.jacobian(end, casadi.vertcat(x, p))
    whole = casadi.Function("whole", given, [end, slopes], {"cse": True}).n_instructions()
    stages = Stages(e)
    end, x, p, given = write_period(e, 0.01, Scheme(4, 1), stages)
    n, m = x.shape[0], p.shape[0]
    seeds = make_seeds(n, m)
    parts = differentiate(end, stages, index, [x, p], seeds)
    staged = casadi.Function("staged", given, [*parts], {"cse": True}).n_instructions()
    assert staged < 0.8 * whole
