"""Call every public function with values of every kind: answers that are right, or refusals.

Each call starts from arguments that fit. In half of the calls one or two of them are replaced by
something wild: a wrong type, a number out of range, an empty or damaged array, another object of
the library. An answer has to pass an invariant of its own; a refusal has to be a `CtrlidError`.
Everything else is printed: another exception, a warning of numpy, an answer that breaks its
invariant.

    python benchmarks/fuzz.py --calls 10000 --seed 1
"""

# A row stands for each call, however long it is.
# ruff: noqa: E501

from __future__ import annotations

import argparse
import collections
import contextlib
import inspect
import io
import math
import os
import tempfile
import time
import traceback
import types
import warnings
from collections.abc import Callable
from decimal import Decimal
from fractions import Fraction
from pathlib import Path
from typing import Any

import control as ct
import numpy as np

import ctrlid as cid
from ctrlid import effects

FOLDER = Path(tempfile.mkdtemp(prefix="ctrlid_fuzz_"))


# --- what fits


class World:
    """Plants, loops, records and results that the calls share; drawn once."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        servo = cid.plants.servo(m=rng.uniform(0.5, 2), c=rng.uniform(1, 3), k=rng.uniform(2, 4))
        gain = ct.tf([rng.uniform(2, 6)], [1], 0.05)
        self.plants = [
            servo, cid.plants.pendulum(m=0.2, length=rng.uniform(0.3, 0.7), c=0.01),
            cid.plants.maglev(m=0.02, K=3e-6), cid.plants.tank(area=0.01, outlet=1e-5, k=1e-5),
        ]  # fmt: skip
        self.loop = cid.Loop(servo, gain, dt=0.05, free=("c",))
        self.open = cid.Loop(servo, dt=0.05, free=("c", "k"))
        law = ct.nlsys(None, lambda t, x, u, params: 3.0 * (u[0] - u[1]), inputs=["r", "y"],
                       outputs=["u"], dt=0.05)  # fmt: skip
        self.law = cid.Loop(servo, law, dt=0.05, free=("c",))
        # Most functions take one input and one output, and are to refuse this loop and its record.
        cart = cid.plants.cart_pole(M=0.5, m=0.2, length=0.3)
        self.cart = cid.Loop(cart, dt=0.05, at=cid.OperatingPoint((0.0,) * 4, 0.0, (0.0, 0.0)))
        self.wide = cid.simulate(self.cart, d=0.1 * rng.standard_normal(20), sensor_noise=1e-3)
        # An integrator without a law wanders, so that its record is short.
        self.pid = cid.Loop(servo, cid.PID(kp=5.0, ki=1.0, kd=0.5), dt=0.05, free=("k",))
        r = cid.random_binary(240, amplitude=0.1, hold=12, seed=int(rng.integers(1e6)))
        self.records = [
            cid.simulate(loop, r, sensor_noise=1e-3, seed=int(rng.integers(1e6)))
            for loop in (self.loop, self.pid)
        ]
        self.records.append(
            cid.simulate(self.open, d=r, sensor_noise=1e-4, seed=int(rng.integers(1e6)))
        )
        valid = np.arange(240) % 97 > 20
        self.records.append(cid.Record(u=r, y=np.cumsum(r), dt=0.05, valid=valid))
        self.model = cid.fit_arx(self.records[0], 2, 2)
        self.continuous = cid.fit_continuous(self.records[0], 2)
        self.linear = [ct.tf([2.0], [1, 1, 0]), ct.tf([1.0], [1, -1]), ct.tf([3.0, 1], [1, 2, 5]),
                       ct.tf([0.1], [1, -0.9], 0.05), ct.ss(ct.tf([1.0], [1, 3, 2]))]  # fmt: skip
        self.comparison = cid.compare(self.records[0], self.loop)
        self.sweep = cid.sweep_sampling_period(self.records[0], [0.05, 0.1], estimators=["fit_arx"])
        self.series = cid.fit_each(cid.fit_arx, self.records[:2], na=2, nb=2)
        self.redesign = cid.redesign(self.continuous, self.pid, 2.0, 80.0)
        self.found = cid.diagnose(
            self.loop, self.records[0], catalogue=[effects.ViscousFriction], progress=False
        )
        self.fit = cid.fit_loop(self.loop, self.records[0])
        self.saved = FOLDER / "found.json"
        self.found.save(self.saved)
        tracks = np.cumsum(rng.standard_normal((2, 240)), axis=1)
        self.system = cid.fit_arx(cid.Record(u=r, y=tracks, dt=0.05), 2, 2)
        self.csv = FOLDER / "record.csv"
        self.records[0].to_csv(self.csv)


Arguments = dict[str, Any]
Recipe = Callable[[World, np.random.Generator], Arguments]


def pick(rng: np.random.Generator, *values: Any) -> Any:
    """Return one of some values."""
    return values[int(rng.integers(len(values)))]


def wild(w: World, rng: np.random.Generator) -> Any:
    """Return something that fits nowhere, or hardly anywhere."""
    n = int(rng.integers(0, 4))
    makers: list[Callable[[], Any]] = [
        lambda: None, lambda: True, lambda: False, lambda: 0, lambda: -1, lambda: 1, lambda: 2,
        lambda: 3, lambda: 10**9, lambda: -(10**9), lambda: 10**400, lambda: 10**30,
        lambda: Fraction(1, 3), lambda: Decimal("0.1"), lambda: 0.0, lambda: -0.0,
        lambda: 0.5, lambda: 1.5, lambda: -2.5, lambda: 1e300, lambda: 1e-300, lambda: 5e-324,
        lambda: math.nan, lambda: math.inf, lambda: -math.inf, lambda: 1 + 2j, lambda: "x",
        lambda: "", lambda: "1", lambda: "fit_arx", lambda: "no", lambda: b"bytes", lambda: [],
        lambda: (), lambda: {}, lambda: set(), lambda: [1, "a"], lambda: [None], lambda: [[1], [1, 2]],
        lambda: {"a": 1}, lambda: {"y": "m"}, lambda: {1: 2}, lambda: object(), lambda: int,
        lambda: len, lambda: (lambda *a, **k: 5), lambda: range(3), lambda: range(0),
        lambda: slice(1, 2), lambda: np.zeros(n), lambda: np.ones((2, 3)), lambda: np.zeros((0, 3)),
        lambda: np.array(["a", "b"]), lambda: np.array([1, None], dtype=object),
        lambda: np.full(240, math.nan), lambda: np.full(240, 1e308), lambda: np.full(240, 1e-310),
        lambda: np.zeros(240), lambda: np.ones(240), lambda: rng.standard_normal(240),
        lambda: rng.standard_normal(239), lambda: rng.standard_normal(240) * 1j,
        lambda: np.ma.array(np.ones(240), mask=np.arange(240) < 100), lambda: np.float32(0.05),
        lambda: np.array(0.05), lambda: np.int8(3), lambda: np.datetime64("2020-01-01"),
        lambda: w.cart, lambda: w.wide, lambda: w.law, lambda: w.loop, lambda: w.pid, lambda: w.records[0], lambda: w.records, lambda: w.records[3],
        lambda: w.model, lambda: w.system, lambda: w.found, lambda: w.fit, lambda: w.comparison,
        lambda: pick(rng, *w.linear), lambda: pick(rng, *w.plants), lambda: cid.Loop,
        lambda: ct.tf([[[1], [1]]], [[[1, 1], [1, 2]]]), lambda: ct.tf([1, 0, 0], [1, 1]),
        lambda: ct.tf([0], [1]), lambda: ct.ss([], [], [], [[1.0]]), lambda: ct.tf([1], [1, 1], True),
        lambda: cid.PID(kp=1.0), lambda: effects.CoulombFriction(0.1), lambda: effects.InputDelay,
        lambda: cid.Integrator(), lambda: cid.PoleAt(0), lambda: cid.OperatingPoint((1, 2, 3), 0, 0),
        lambda: cid.Record(u=np.zeros(240), y=np.zeros(240), dt=0.05),
        lambda: cid.Record(u=[0, 1.0], y=[0, 1.0], dt=1.0),
        lambda: cid.Record(u=np.ones(240), y=np.ones(240), r=np.ones(240), dt=0.05,
                           valid=np.zeros(240, bool)),
        lambda: Path("/nonexistent/x.csv"), lambda: FOLDER, lambda: iter([1, 2]), lambda: [-1, 0, 1],
        lambda: [1.0, 2.0], lambda: (1.0, 0.0), lambda: (0.0, 1.0), lambda: [cid.Integrator(), 3],
    ]  # fmt: skip
    return pick(rng, *makers)()


def fields(rng: np.random.Generator) -> Arguments:
    """Return what makes a record."""
    n = int(rng.integers(2, 300))
    r = rng.standard_normal(n)
    return {
        "u": rng.standard_normal(n), "y": np.cumsum(rng.standard_normal(n)),
        "dt": 10.0 ** rng.uniform(-5, 2), "r": pick(rng, None, r), "hold": pick(rng, "zoh", "foh"),
        "extra": pick(rng, {}, {"current": r}), "valid": pick(rng, None, r > -1),
        "names": pick(rng, {}, {"y": "angle"}), "units": pick(rng, {}, {"y": "rad", "u": "V"}),
        "name": pick(rng, "", "run $1$ <b>"), "start": float(rng.normal()),
    }  # fmt: skip


def make_effect(name: str, rng: np.random.Generator) -> Arguments:
    """Return parameters of an effect within their bounds."""
    cls = getattr(effects, name)
    values: Arguments = {}
    for field in cls.__dataclass_fields__.values():
        about = field.metadata.get("parameter")
        if about is None:
            if field.init and field.type in (str, "str"):
                values[field.name] = pick(rng, "c", "k", "x", "")
            continue
        low = about["lower"] if math.isfinite(about["lower"]) else -1.0
        high = about["upper"] if math.isfinite(about["upper"]) else low + 2.0
        values[field.name] = float(rng.uniform(low, high))
    return values


def data(w: World, rng: np.random.Generator) -> Any:
    """Return a record, or several."""
    return pick(rng, *w.records, w.records[:2])


RECIPES: dict[str, Recipe] = {
    "Record": lambda w, rng: fields(rng),
    "Record.between": lambda w, rng: {"self": w.records[0], "t0": rng.uniform(-1, 6), "t1": rng.uniform(2, 20)},
    "Record.select": lambda w, rng: {"self": w.records[0], "y": w.records[0].signals["y"][0]},
    "Record.split": lambda w, rng: {"self": w.records[0], "*": sorted(rng.uniform(0.1, 0.9, 2).tolist())},
    "Record.decimate": lambda w, rng: {"self": pick(rng, *w.records), "q": int(rng.integers(1, 12)), "antialias": pick(rng, True, False)},
    "Record.with_input": lambda w, rng: {"self": cid.Record(**{**fields(rng), "extra": {}}), "channel": "current"},
    "Record.with_output": lambda w, rng: {"self": cid.Record(u=[0, 1.0], y=[1, 2.0], dt=1.0, extra={"i": [3, 4.0]}), "channel": "i"},
    "Record.segments": lambda w, rng: {"self": pick(rng, *w.records)},
    "Record.from_csv": lambda w, rng: {"path": w.csv, "r": pick(rng, None, "r"), "u": pick(rng, "u", "y"), "y": "y", "time": pick(rng, None, "t"), "dt": pick(rng, None, 0.05), "extra": None, "units": pick(rng, None, {"y": "m"}), "hold": pick(rng, None, "zoh"), "name": pick(rng, None, "a"), "gaps": pick(rng, "error", "mask"), "names": pick(rng, None, {"y": "level"})},
    "Record.to_csv": lambda w, rng: {"self": pick(rng, *w.records), "path": FOLDER / "out.csv"},
    "Record.from_response": lambda w, rng: {"response": ct.step_response(ct.tf([1], [1, 1], inputs="u", outputs="y"), timepts=np.linspace(0, 1, 20)), "r": None, "u": pick(rng, None, "u"), "y": pick(rng, None, "y")},
    "Record.to_response": lambda w, rng: {"self": pick(rng, *w.records)},
    "Loop": lambda w, rng: {"plant": pick(rng, w.plants[0], w.plants[1], *w.linear[:3]), "controller": pick(rng, None, cid.PID(kp=2.0), ct.tf([2.0], [1], 0.05)), "dt": 0.05, "at": None, "free": pick(rng, (), ("c",)), "input_limits": pick(rng, (-5, 5), (-math.inf, math.inf)), "effects": pick(rng, (), (effects.CoulombFriction(0.1),))},
    "Loop.equations": lambda w, rng: {"self": w.loop, "keep": pick(rng, True, False)},
    "Loop.with_effect": lambda w, rng: {"self": w.loop, "effect": pick(rng, effects.ViscousFriction(0.2), effects.InputDelay(0.01))},
    "Loop.without_effect": lambda w, rng: {"self": w.loop.with_effect(effects.InputDelay(0.01)), "effect": pick(rng, "InputDelay", effects.InputDelay(0.01))},
    "Loop.with_parameters": lambda w, rng: {"self": w.loop, "values": {pick(rng, "c", "m", "k"): rng.uniform(0.5, 3)}},
    "Loop.law": lambda w, rng: {"self": pick(rng, w.loop, w.pid, w.open)},
    "Loop.system": lambda w, rng: {"self": pick(rng, w.loop, w.pid, w.open)},
    "Loop.linearize": lambda w, rng: {"self": pick(rng, w.loop, w.pid, w.open)},
    "PID": lambda w, rng: {"kp": rng.normal(), "ki": rng.uniform(0, 2), "kd": rng.uniform(0, 1), "bias": pick(rng, None, 0.1), "lower": -5.0, "upper": 5.0, "b": 1.0, "c": pick(rng, 0.0, 1.0), "derivative": pick(rng, "error", "measurement"), "filter_time": rng.uniform(0, 0.1), "integral": pick(rng, "backward", "forward", "trapezoidal"), "anti_windup": pick(rng, "clamp", "none"), "tracking_time": pick(rng, None, 1.0)},
    "OperatingPoint": lambda w, rng: {"states": (0.0, rng.normal()), "input": rng.normal(), "output": rng.normal()},
    "Bounds": lambda w, rng: {"name": pick(rng, "a1", "b1"), "lower": -1.0, "upper": pick(rng, 1.0, math.inf)},
    "Equal": lambda w, rng: {"first": "a1", "second": pick(rng, "a2", "b1")},
    "Fixed": lambda w, rng: {"name": "a1", "value": rng.normal()},
    "Integrator": lambda w, rng: {},
    "Linear": lambda w, rng: {"weights": {"a1": 1.0, "a2": rng.normal()}, "lower": -2.0, "upper": 2.0, "equals": None},
    "Nonlinear": lambda w, rng: {"equality": pick(rng, None, lambda e: e["a1"] + 1.0), "inequality": None},
    "PoleAt": lambda w, rng: {"pole": pick(rng, 1.0, 0.5, 0.5 + 0.2j)},
    "ReciprocalPoles": lambda w, rng: {},
    "StaticGain": lambda w, rng: {"gain": rng.normal()},
    "SymmetricPoles": lambda w, rng: {},
    "Section": lambda w, rng: {"title": "a", "text": pick(rng, "", "b $x$"), "result": pick(rng, None, w.comparison), "figure": None},
    "audit": lambda w, rng: {"record": pick(rng, *w.records), "loop": pick(rng, None, w.loop)},
    "check_feedback": lambda w, rng: {"record": pick(rng, *w.records)},
    "compare": lambda w, rng: {"record": pick(rng, *w.records), "model_or_loop": pick(rng, w.loop, w.law, w.model, w.linear[3]), "horizon": pick(rng, None, 3)},
    "design_lead": lambda w, rng: {"P": pick(rng, *w.linear), "crossover": 10.0 ** rng.uniform(-1, 1), "phase_margin": rng.uniform(20, 70)},
    "diagnose": lambda w, rng: {"loop": w.loop, "record": w.records[0], "catalogue": (effects.ViscousFriction,), "progress": False},
    "fit_arx": lambda w, rng: {"record": data(w, rng), "na": int(rng.integers(1, 4)), "nb": int(rng.integers(1, 3)), "nk": pick(rng, 1, 2), "constraints": pick(rng, (), (cid.Integrator(),), cid.PoleAt(0.9)), "intercept": pick(rng, True, False), "jobs": None},
    "fit_continuous": lambda w, rng: {"record": pick(rng, *w.records[:3]), "poles": pick(rng, 1, 2), "zeros": 0, "constraints": pick(rng, (), (cid.Integrator(),)), "controller": None, "delay": pick(rng, 0.0, 0.02)},
    "fit_each": lambda w, rng: {"fit": pick(rng, cid.fit_arx, cid.fit_iv), "records": w.records[:2], "jobs": None, "na": 2, "nb": pick(rng, 1, 2)},
    "fit_iv": lambda w, rng: {"record": pick(rng, *w.records[:2]), "na": 2, "nb": 1, "nk": 1, "constraints": (), "controller": None, "intercept": pick(rng, True, False), "instruments": "r"},
    "fit_loop": lambda w, rng: {"loop": pick(rng, w.loop, w.pid), "record": pick(rng, w.records[0], w.records[:2]), "free": pick(rng, None, ("c",)), "coloured": pick(rng, None, False)},
    "fit_simulation": lambda w, rng: {"loop": pick(rng, w.loop, w.pid), "record": pick(rng, w.records[0], w.records[:2]), "free": pick(rng, None, ("c",)), "intercept": pick(rng, True, False)},
    "linearize": lambda w, rng: {"plant": w.plants[0], "at": cid.OperatingPoint((0.0, 0.0), 0.0, 0.0)},
    "load_diagnosis": lambda w, rng: {"path": w.saved, "loop": w.loop},
    "loop_margins": lambda w, rng: {"L": pick(rng, *w.linear)},
    "multisine": lambda w, rng: {"n": int(rng.integers(10, 300)), "amplitude": rng.uniform(0.1, 2), "period": pick(rng, None, 64), "band": pick(rng, (0.0, 1.0), (0.1, 0.6)), "phases": pick(rng, "schroeder", "random"), "around": rng.normal(), "seed": 1},
    "nu_gap": lambda w, rng: {"P1": pick(rng, *w.linear[:3]), "P2": pick(rng, *w.linear[:3])},
    "operating_point": lambda w, rng: {"plant": w.plants[2], "output": rng.uniform(0.005, 0.02), "guess": pick(rng, None, (0.01, 0.0))},
    "prbs": lambda w, rng: {"n": int(rng.integers(1, 300)), "amplitude": 1.0, "order": int(rng.integers(2, 8)), "hold": 3, "around": 0.0, "seed": 1},
    "predict": lambda w, rng: {"loop": w.loop, "record": pick(rng, *w.records[:2]), "noise_ratio": pick(rng, None, 0.1)},
    "random_binary": lambda w, rng: {"n": int(rng.integers(1, 300)), "amplitude": 1.0, "hold": 4, "around": rng.normal(), "seed": pick(rng, None, 3)},
    "redesign": lambda w, rng: {"G": pick(rng, w.continuous, w.linear[0]), "loop": w.pid, "crossover": rng.uniform(1, 3), "phase_margin": rng.uniform(30, 60), "step": pick(rng, None, 0.05)},
    "replay_controller": lambda w, rng: {"loop": pick(rng, w.loop, w.pid, w.law), "record": pick(rng, *w.records[:2])},
    "response_band": lambda w, rng: {"model": pick(rng, w.model, w.continuous), "omega": np.geomspace(0.1, 10, 9), "level": rng.uniform(0.5, 0.99)},
    "robust_margin": lambda w, rng: {"P": pick(rng, *w.linear[:3]), "C": pick(rng, 1.0, ct.tf([1.0, 1], [0.1, 1]))},
    "select_order": lambda w, rng: {"record": pick(rng, *w.records[:3]), "na": range(1, 3), "nb": [1], "nk": pick(rng, [1], (1, 2))},
    "simulate": lambda w, rng: {"loop": pick(rng, w.loop, w.pid, w.law), "r": 0.1 * rng.standard_normal(60), "sensor_noise": pick(rng, 0.0, 1e-3), "force_noise": 0.0, "d": pick(rng, None, np.ones(60)), "initial": pick(rng, None, (0.1, 0.0)), "seed": pick(rng, None, 4)},
    "staircase": lambda w, rng: {"n": int(rng.integers(1, 200)), "levels": [0.0, 1.0, 0.5], "hold": 7},
    "sweep_sampling_period": lambda w, rng: {"record": w.records[0], "periods": pick(rng, None, [0.05, 0.1]), "estimators": ["fit_arx"], "constraints": pick(rng, (), {"fit_arx": (cid.Integrator(),)}), "poles": 2, "zeros": 0, "controller": None, "jobs": None},
    "write_report": lambda w, rng: {"result": pick(rng, w.records[0], w.comparison, w.found), "path": FOLDER / "out.html", "title": pick(rng, "", "a & b")},
    "Estimate.confidence_interval": lambda w, rng: {"self": w.model.estimate, "name": pick(rng, "a1", "b1"), "level": rng.uniform(0.1, 0.99)},
    "ParameterEstimate.confidence_interval": lambda w, rng: {"self": w.fit.estimate, "name": "c", "level": rng.uniform(0.1, 0.99)},
    "IdentifiedSystem.to_states": lambda w, rng: {"self": w.system, "order": pick(rng, None, 2, 4)},
    "IdentifiedModel.with_delay": lambda w, rng: {"self": w.continuous, "order": 2},
    "Diagnosis.find_sensitivity": lambda w, rng: {
        "self": w.found, "power": float(rng.uniform(0.05, 0.95))
    },
    "Diagnosis.save": lambda w, rng: {"self": w.found, "path": FOLDER / "again.json"},
    "plants.ball_on_beam": lambda w, rng: {"m": 0.05, "J": rng.uniform(0.01, 1), "radius": 0.01},
    "plants.cart_pole": lambda w, rng: {"M": rng.uniform(0.1, 2), "m": 0.2, "length": 0.3, "c": 0.1},
    "plants.quadrotor_planar": lambda w, rng: {"m": rng.uniform(0.1, 2), "J": 2e-3, "arm": 0.15},
    "plants.rotary_pendulum": lambda w, rng: {"m": 0.024, "length": 0.06, "arm": rng.uniform(0.05, 0.2),
                                              "arm_inertia": 6e-5, "kt": 0.04, "R": 8.4},
    "plants.maglev": lambda w, rng: {"m": rng.uniform(0.01, 1), "K": 10.0 ** rng.uniform(-7, -4), "g": 9.81},
    "plants.pendulum": lambda w, rng: {"m": 0.2, "length": rng.uniform(0.1, 2), "c": 0.0, "g": 9.81},
    "plants.servo": lambda w, rng: {"m": 1.0, "c": rng.uniform(0, 3), "k": rng.uniform(0.1, 3)},
    "plants.tank": lambda w, rng: {"area": 0.01, "outlet": 1e-5, "k": 1e-5, "g": 9.81},
    "datasets.describe": lambda w, rng: {"name": pick(rng, *cid.datasets.names())},
    "datasets.names": lambda w, rng: {},
    "plot.record": lambda w, rng: {"record": pick(rng, *w.records), "ax": None, "extra": ()},
    "plot.bode": lambda w, rng: {"models": pick(rng, w.model, w.continuous), "ax": None, "omega": None, "level": 0.9},
    "plot.comparison": lambda w, rng: {"comparison": w.comparison, "window": pick(rng, None, (0.0, 3.0))},
    "plot.diagnosis": lambda w, rng: {"found": w.found},
    "plot.poles": lambda w, rng: {"models": pick(rng, w.model, w.continuous), "truth": pick(rng, None, [0.9])},
    "plot.residuals": lambda w, rng: {"comparison": w.comparison},
    "plot.step": lambda w, rng: {"redesigns": w.redesign},
    "plot.trend": lambda w, rng: {"series": w.series},
    "plot.figure": lambda w, rng: {"rows": pick(rng, 1, 2), "columns": pick(rng, 1, 3), "size": (3.0, 2.0), "sharex": pick(rng, False, True, "col")},
    "plot.png": lambda w, rng: {"drawn": cid.plot.figure(1, 1, (2.0, 1.5)), "dpi": pick(rng, 50, 72.5)},
    "plot.style": lambda w, rng: {},
    "effects.parameter": lambda w, rng: {"unit": pick(rng, "", "1/s", "{y}"), "lower": pick(rng, -1.0, 0.0), "upper": 2.0, "neutral": pick(rng, None, 0.0), "instant": False},
    "effects.equivalents": lambda w, rng: {"loop": w.loop, "effect": effects.ViscousFriction(0.1)},
}  # fmt: skip
RECIPES |= {
    f"effects.{name}": (lambda w, rng, name=name: make_effect(name, rng))
    for name in effects.__all__
    if isinstance(cls := getattr(effects, name), type)
    and issubclass(cls, effects.AbstractEffect)
    and cls in effects.CATALOGUE
}
# A picture takes as long as fifty other calls.
RARE = {"diagnose": 0.1, "write_report": 0.1, "sweep_sampling_period": 0.2, "redesign": 0.3}


# --- what is right


def check_answer(name: str, given: Arguments, answer: Any) -> str | None:
    """Return what is wrong with an answer, None if nothing is."""
    text = str(answer) + repr(answer)
    if not text:
        return "an answer without a text"
    check = INVARIANTS.get(name)
    if check is not None and not check(given, answer):
        return "the answer breaks its invariant"
    writable = [k for k in getattr(answer, "__dataclass_fields__", {})
                if isinstance(v := getattr(answer, k), np.ndarray) and v.flags.writeable
                and type(answer).__module__.startswith("ctrlid")]  # fmt: skip
    # A section holds what the user gave it, and a picture is there to be drawn upon.
    own = name == "Section" or name.startswith("plot.")
    return f"writable arrays: {writable}" if writable and not own else None


def is_finite_record(given: Arguments, record: Any) -> bool:
    """Tell whether a record is whole: finite signals of one length, a positive period."""
    return bool(
        np.isfinite(record.u).all() and np.isfinite(record.y).all()
        and len(record.u) == len(record.y) == len(record.valid) and 0 < record.dt < math.inf
    )  # fmt: skip


def is_finite_model(given: Arguments, model: Any) -> bool:
    """Tell whether a model has finite coefficients and no negative variance."""
    each = model.estimates.values() if hasattr(model, "estimates") else [model.estimate]
    return all(np.isfinite(e.values).all() and (np.diag(e.covariance) >= 0).all() for e in each)


INVARIANTS: dict[str, Callable[[Arguments, Any], bool]] = {
    "Diagnosis.find_sensitivity": lambda given, out: all(size > 0 for size in out.values()),
    "Record": is_finite_record, "Record.between": is_finite_record,
    "Record.decimate": is_finite_record, "Record.from_csv": is_finite_record,
    "Record.from_response": is_finite_record, "Record.with_input": is_finite_record,
    "Record.split": lambda g, parts: sum(map(len, parts)) == len(g["self"]),
    "simulate": is_finite_record, "fit_arx": is_finite_model, "fit_iv": is_finite_model,
    "fit_continuous": is_finite_model,
    "fit_loop": lambda g, fit: bool(np.isfinite(fit.estimate.values).all()),
    "fit_simulation": lambda g, fit: bool(np.isfinite(fit.estimate.values).all()),
    "nu_gap": lambda g, v: 0 <= v <= 1, "robust_margin": lambda g, v: 0 <= v <= 1,
    "loop_margins": lambda g, m: not m.stable or (m.gain_margin > 1 > m.gain_reduction_margin >= 0),
    "replay_controller": lambda g, u: bool(np.isfinite(u).all()),
    "random_binary": lambda g, s: s.shape == (g["n"],) and bool(np.isfinite(s).all()),
    "prbs": lambda g, s: s.shape == (g["n"],) and bool(np.isfinite(s).all()),
    "multisine": lambda g, s: s.shape == (g["n"],) and bool(np.isfinite(s).all()),
    "staircase": lambda g, s: s.shape == (g["n"],) and bool(np.isfinite(s).all()),
    "compare": lambda g, c: not any(math.isnan(curve.fit) for curve in c.curves),
    "diagnose": lambda g, d: d.gap.before > 0 and bool(d.verdict),
    "operating_point": lambda g, p: math.isclose(p.output, float(g["output"]), abs_tol=1e-9),
    "response_band": lambda g, b: bool((b.magnitude_low <= b.magnitude_high).all()),
    "Estimate.confidence_interval": lambda g, i: i[0] <= i[1],
    "ParameterEstimate.confidence_interval": lambda g, i: i[0] <= i[1],
}  # fmt: skip


def find_public() -> set[str]:
    """Return the names of what a user calls; results, which only functions make, by their methods.

    Their constructors are no doors: what they are given was computed.
    """
    inputs = {"PID", "Record", "Loop", "OperatingPoint", "Section", "Bounds", "Equal", "Fixed",
              "Integrator", "Linear", "Nonlinear", "PoleAt", "ReciprocalPoles", "StaticGain",
              "SymmetricPoles"}  # fmt: skip
    found = set()
    for name in cid.__all__:
        thing = getattr(cid, name)
        if isinstance(thing, type) and not issubclass(thing, BaseException):
            found |= {name} & inputs
            if name in inputs and not {"Record", "Loop"} & {name}:
                continue
            found |= {f"{name}.{k}" for k, v in vars(thing).items() if not k.startswith("_")
                      and isinstance(v, types.FunctionType | classmethod)}  # fmt: skip
        elif isinstance(thing, types.FunctionType):
            found.add(name)
    for module in (cid.plants, cid.datasets, cid.plot, effects):
        short = module.__name__.rpartition(".")[2]
        names = getattr(module, "__all__", None) or [
            k for k, v in vars(module).items()
            if isinstance(v, types.FunctionType) and v.__module__ == module.__name__
        ]  # fmt: skip
        found |= {f"{short}.{k}" for k in names if not k.startswith("_")
                  and (isinstance(getattr(module, k), types.FunctionType)
                       or getattr(module, k) in effects.CATALOGUE)}  # fmt: skip
    return found


# Downloads.
LEFT_OUT = {"datasets.load"}


# --- the calls


def call(name: str, arguments: Arguments) -> Any:
    """Call a public function or method by name."""
    thing: Any = cid
    for part in name.split("."):
        thing = getattr(thing, part)
    arguments = dict(arguments)
    first = [arguments.pop("self")] if "self" in arguments else []
    more = arguments.pop("*", [])
    return thing(*first, *more, **arguments)


def run(calls: int, seed: int, only: str | None = None) -> dict[str, Any]:
    """Make so many calls and return the counts and what was neither answer nor refusal."""
    os.environ.setdefault("MPLBACKEND", "Agg")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        world = World(seed)
    rng = np.random.default_rng([seed, 1])
    names = sorted(k for k in RECIPES if only is None or k.startswith(only))
    weights = np.array([0.05 if n.startswith("plot.") else RARE.get(n, 1.0) for n in names])
    counts: collections.Counter[str] = collections.Counter()
    per_name: dict[str, collections.Counter[str]] = collections.defaultdict(collections.Counter)
    failures: dict[str, tuple[int, str]] = {}
    started, slowest = time.perf_counter(), (0.0, "")
    # A path may be any word, and files are written there.
    here = os.getcwd()
    os.chdir(FOLDER)
    for _ in range(calls):
        name = names[int(rng.choice(len(names), p=weights / weights.sum()))]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            arguments = RECIPES[name](world, rng)
            if rng.random() < 0.55:
                keys = [k for k in arguments if k != "self"]
                for _ in range(pick(rng, 1, 1, 1, 2) if keys else 0):
                    key = pick(rng, *keys)
                    value = wild(world, rng)
                    arguments[key] = [value] if key == "*" else value
        begun = time.perf_counter()
        outcome, detail = try_call(name, arguments)
        slowest = max(slowest, (time.perf_counter() - begun, f"{name}({write(arguments)})"))
        counts[outcome] += 1
        per_name[name][outcome] += 1
        if outcome == "failure":
            times, first = failures.get(f"{name}: {detail}", (0, write(arguments)))
            failures[f"{name}: {detail}"] = (times + 1, first)
    os.chdir(here)
    return {"counts": counts, "per_name": per_name, "failures": failures, "seed": seed,
            "seconds": time.perf_counter() - started, "slowest": slowest}  # fmt: skip


def try_call(name: str, arguments: Arguments) -> tuple[str, str]:
    """Return whether a call gave an answer, a refusal or a failure, and what the failure was."""
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("error")
        warnings.simplefilter("ignore", cid.CtrlidWarning)
        try:
            answer = call(name, arguments)
            wrong = check_answer(name, arguments, answer)
        except cid.CtrlidError as refusal:
            return ("refusal", "") if len(str(refusal)) > 15 else ("failure", "a bare refusal")
        except BaseException as error:
            if isinstance(error, KeyboardInterrupt):
                raise
            frames = [f for f in traceback.extract_tb(error.__traceback__) if "ctrlid" in f.filename
                      and "fuzz" not in f.filename]  # fmt: skip
            at = f"{Path(frames[-1].filename).name}:{frames[-1].lineno}" if frames else "call"
            return (
                "failure",
                f"{type(error).__name__} at {at}: {' '.join(str(error).split())[:110]}",
            )
        finally:
            if name.startswith("plot."):
                import matplotlib.pyplot as plt

                plt.close("all")
    return ("failure", wrong) if wrong else ("answer", "")


def write(arguments: Arguments) -> str:
    """Return arguments in one line."""
    parts = []
    for key, value in arguments.items():
        if isinstance(value, np.ndarray):
            text = f"array{value.shape} of {value.dtype}"
        elif inspect.isfunction(value):
            text = "function"
        else:
            text = type(value).__name__ + " " + " ".join(repr(value)[:40].split())
        parts.append(f"{key}={text}")
    return ", ".join(parts)[:300]


def main() -> None:
    """Print the seed, the counts and every failure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--calls", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", help="names that start so")
    parser.add_argument("--names", action="store_true", help="counts by name")
    options = parser.parse_args()
    done = run(options.calls, options.seed, options.only)
    for words, (times, first) in sorted(done["failures"].items()):
        print(f"{times:4d}  {words}\n        {first}")
    if options.names:
        for name, counts in sorted(done["per_name"].items()):
            print(f"{name:32} {dict(counts)}")
    total = sum(done["counts"].values())
    shares = ", ".join(f"{n} {k}s ({100 * n / total:.0f} %)" for k, n in done["counts"].items())
    print(f"seed {done['seed']}: {total} calls in {done['seconds']:.0f} s: {shares}")
    print(f"slowest {done['slowest'][0]:.1f} s: {done['slowest'][1]}")


if __name__ == "__main__":
    main()
