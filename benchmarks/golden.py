"""Keep diagnoses and the printed text of the stories, to compare two versions of ctrlid.

Write the files with each version, on one machine, and compare them::

    python benchmarks/golden.py write before
    python benchmarks/golden.py write after
    python benchmarks/golden.py compare before after

``--only NAME`` selects some of the cases, and ``--jobs 2`` runs two at a time, each in a process
with one thread. For each case the text of the report and its numbers with all digits are written.
The signals of the gap are written as a checksum only, so that no measured sample is stored.
`compare` says which files are the same byte for byte. Where a diagnosis differs, it says whether
verdict and names are the same, and by how many standard errors the parameters differ at most.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import io
import json
import math
import os
import runpy
import subprocess
import sys
import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

EXAMPLES = Path(__file__).parents[1] / "examples"
ARRAYS = 64  # numbers: what is longer is kept as a checksum


def levitation(free=("K",)):
    """Return a levitated ball under a digital lead."""
    import ctrlid as cid

    plant = cid.plants.maglev(m=0.0213, K=3.34e-6)
    at = cid.operating_point(plant, output=0.012)
    lead = cid.design_lead(cid.linearize(plant, at), crossover=100, phase_margin=50)
    return cid.Loop(plant, lead.sample(2e-3, "tustin"), dt=2e-3, at=at, free=free)


def drive():
    """Return a position drive under a PID controller."""
    import ctrlid as cid

    plant = cid.plants.servo(m=2.0, c=5.0, k=30.0)
    law = cid.PID(kp=6.0, ki=4.0, kd=0.4, filter_time=0.02)
    rest = cid.OperatingPoint((0.0, 0.0), 0.0, 0.0)
    return cid.Loop(plant, law, dt=0.01, at=rest, free=("c", "k"))


def tanks(**values):
    """Return two tanks without a controller, the upper running into the lower."""
    import control as ct
    import numpy as np

    import ctrlid as cid

    def rates(t, x, u, p):
        upper, lower = np.sqrt(np.maximum(x, 1e-6))
        return np.array([p["k4"] * u[0] - p["k1"] * upper, p["k1"] * upper - p["k3"] * lower])

    plant = ct.nlsys(
        rates, lambda t, x, u, p: x[1], inputs=["u"], outputs=["y"], states=["h1", "h2"],
        params={"k1": 0.05, "k3": 0.06, "k4": 0.05} | values, name="two tanks",
    )  # fmt: skip
    at = cid.operating_point(plant, output=6.0)
    return cid.Loop(plant, None, dt=4.0, at=at, free=("k1", "k3", "k4"))


def walk(n, levels, seed, hold=400):
    """Return set-points visited one after the other."""
    import numpy as np

    rng = np.random.default_rng(seed)
    return np.repeat(rng.uniform(-levels, levels, -(-n // hold)), hold)[:n]


def experiment(loop, seed, swing, levels=0.0, n=4000, hold=20, **noise):
    """Return a record of a loop whose reference jumps by random."""
    import ctrlid as cid

    r = cid.random_binary(n, amplitude=swing, hold=hold, around=loop.point.output, seed=seed)
    return cid.simulate(loop, r + walk(n, levels, seed + 1), seed=seed + 2, **noise)


def friction():
    """Diagnose a levitated ball with dry friction."""
    import ctrlid as cid

    loop = levitation()
    real = loop.with_effect(cid.effects.CoulombFriction(fc=0.05))
    record = experiment(real, 7100, 1e-4, sensor_noise=2e-6, force_noise=0.02)
    return cid.diagnose(loop.with_parameters({"K": 3.1e-6}), record, progress=False)


def nothing():
    """Diagnose a levitated ball without anything hidden."""
    import ctrlid as cid

    loop = levitation()
    record = experiment(loop, 7600, 1e-4, 5e-4, sensor_noise=2e-6, force_noise=0.02)
    return cid.diagnose(loop.with_parameters({"K": 3.5e-6}), record, progress=False)


def two_effects():
    """Diagnose a levitated ball with dry friction and a bent sensor."""
    import ctrlid as cid

    E = cid.effects
    loop = levitation()
    real = loop.with_effect(E.CoulombFriction(fc=0.06)).with_effect(E.SensorNonlinearity(8.0))
    record = experiment(real, 7500, 1e-4, 1e-3, sensor_noise=2e-6)
    return cid.diagnose(loop, record, progress=False)


def lag_and_ripple():
    """Diagnose a drive with a lag of its actuator and a ripple along its way."""
    import ctrlid as cid

    E = cid.effects
    loop = drive()
    real = loop.with_effect(E.ActuatorLag(tau=0.02)).with_effect(E.PositionRipple(0.5, 0.04, 0.3))
    record = experiment(real, 7300, 0.03, 0.1, hold=60, sensor_noise=2e-4)
    return cid.diagnose(loop, record, progress=False)


def stepped_parameter():
    """Diagnose a drive whose gain drops while the record runs."""
    import ctrlid as cid

    loop = drive()
    real = loop.with_effect(cid.effects.ParameterStep(name="k", time=17.0, size=-0.1))
    record = experiment(real, 7350, 0.03, hold=60, sensor_noise=2e-4)
    return cid.diagnose(loop, record, progress=False)


def unknown_controller():
    """Diagnose a levitated ball with drag, whose controller and reference nobody knows."""
    import ctrlid as cid

    loop = levitation()
    real = loop.with_effect(cid.effects.ViscousFriction(c=3.0))
    record = experiment(real, 7700, 1e-4, sensor_noise=2e-6)
    bare = cid.Record(u=record.u, y=record.y, dt=record.dt)
    return cid.diagnose(replace(loop, controller=None), bare, progress=False)


def stable_plant():
    """Two tanks in open loop, of which one runs over, with a wrong zero of the sensor."""
    import numpy as np

    import ctrlid as cid

    E = cid.effects
    real = tanks().with_effect(E.StateLimit(name="h1", upper=8.0, spill_to="h2", share=1.0))
    real = real.with_effect(E.SensorOffset(0.6))
    rng = np.random.default_rng(5)
    u = np.repeat(rng.uniform(1.5, 4.0, 30), 30)
    record = cid.simulate(real, d=u - real.point.input, sensor_noise=0.02, seed=5)
    return cid.diagnose(tanks(k1=0.055, k3=0.055, k4=0.052), record, progress=False)


def several_records():
    """Two records of a drive, each with something else in it."""
    import ctrlid as cid

    E = cid.effects
    loop = drive()
    rubbing = loop.with_effect(E.CoulombFriction(fc=0.4))
    late = loop.with_effect(E.InputDelay(delay=0.008))
    records = [experiment(real, 8300 + 10 * k, 0.3, n=1200, hold=60, sensor_noise=1e-3)
               for k, real in enumerate((rubbing, late))]  # fmt: skip
    return cid.diagnose(loop, records, progress=False)


def outside_the_catalogue():
    """Diagnose a levitated ball with a ripple that the catalogue given lacks."""
    import ctrlid as cid

    E = cid.effects
    loop = levitation()
    real = loop.with_effect(E.PositionRipple(0.3, 3e-4, 0.7)).with_effect(E.InputDelay(1e-3))
    record = experiment(real, 8600, 1e-4, 1e-3, sensor_noise=2e-6)
    poor = (E.SensorNonlinearity, E.InputDelay, E.CubicStiffness, E.InputOffset)
    return cid.diagnose(loop, record, catalogue=poor, progress=False)


def inteco():
    """Diagnose a real levitated ball whose coil lags (`examples/real_inteco.py`)."""
    import numpy as np

    import ctrlid as cid

    raw = cid.datasets.load("inteco_pid_step")
    record = averaged(replace(raw, valid=np.ones(len(raw), dtype=bool)).between(2.0, 18.0), 10)
    plant = cid.plants.maglev(m=0.058, K=0.058 * 9.81 * 0.012**2 / 0.42**2)
    at = cid.operating_point(plant, output=0.012)
    model = cid.Loop(plant, None, dt=record.dt, at=at, free=("K",))
    return cid.diagnose(model, record, progress=False)


def magnetoshield():
    """Diagnose a real levitated magnet (`examples/real_magnetoshield.py`)."""
    import ctrlid as cid

    records = cid.datasets.load("magnetoshield_r3")
    plant = cid.plants.maglev(m=0.000945, K=0.000945 * 9.81 * 0.014**2 / 5.0**2)
    at = cid.operating_point(plant, output=0.014)
    model = cid.Loop(plant, None, dt=records[0].dt, at=at, free=("K",))
    return cid.diagnose(model, records[0], validation=records[3], progress=False)


def emps():
    """Diagnose a real drive whose reference repeats, by a quarter of its samples."""
    import ctrlid as cid

    record, pulses = (averaged(cid.datasets.load(k), 4) for k in ("emps", "emps_pulses"))
    plant = cid.plants.servo(m=95.0, c=200.0, k=35.15065)
    rest = cid.OperatingPoint(states=(0.0, 0.0), input=0.0, output=0.0)
    model = cid.Loop(plant, None, dt=record.dt, at=rest, free=("m", "c"))
    return cid.diagnose(model, record, validation=pulses, progress=False)


def averaged(record, factor):
    """Return a record with the means of blocks of its samples, whatever the version calls it."""
    try:
        from ctrlid.validation.sampling_sweep import average_input as means
    except ImportError:
        from ctrlid.sampling import averaged as means
    return means(record, factor)


DIAGNOSES: dict[str, Callable[[], Any]] = {
    f.__name__: f
    for f in (
        friction, nothing, two_effects, lag_and_ripple, stepped_parameter, unknown_controller,
        stable_plant, several_records, outside_the_catalogue, inteco, magnetoshield, emps,
    )
}  # fmt: skip
STORIES = sorted(p.stem for p in EXAMPLES.glob("plot_*.py"))


def story() -> str:
    """Return what ``python -m ctrlid`` prints."""
    from ctrlid.__main__ import main

    out = io.StringIO()
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(out):
        os.chdir(folder)
        main(["--quiet"])
    return without_times(out.getvalue())


def told(name: str) -> str:
    """Return what a story of the manual prints."""
    import matplotlib as mpl

    mpl.use("Agg")
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        runpy.run_path(str(EXAMPLES / f"{name}.py"))
    return without_times(out.getvalue())


def without_times(text: str) -> str:
    """Return a text without the lines that say how long a diagnosis took."""

    def is_time(line: str) -> bool:
        words = line.split()
        return words[:2] == ["computed", "in"] and words[3:] == ["s"]

    return "\n".join(line for line in text.splitlines() if not is_time(line)) + "\n"


def kept(found: Any) -> dict[str, str]:
    """Return the files that are kept of a diagnosis: its report and its numbers."""
    found = replace(found, seconds=0.0)
    with tempfile.TemporaryDirectory() as folder:
        data = json.loads(found.save(Path(folder) / "found.json").read_text("utf-8"))
    return {"txt": f"{found}\n", "json": json.dumps(_short(data), indent=1) + "\n"}


def _short(value: Any) -> Any:
    """Return numbers as they are, and long arrays as their checksum."""
    if isinstance(value, dict):
        return {k: _short(v) for k, v in value.items()}
    if isinstance(value, list):
        if len(value) > ARRAYS:
            return "sha256 " + hashlib.sha256(json.dumps(value).encode()).hexdigest()
        return [_short(v) for v in value]
    return value


def write(folder: Path, only: list[str], jobs: int) -> None:
    """Write the files of all cases, each in a process of its own."""
    folder.mkdir(parents=True, exist_ok=True)
    names = only or [*DIAGNOSES, "story", *STORIES]
    env = os.environ | {f"{k}_NUM_THREADS": "1" for k in ("OPENBLAS", "OMP", "MKL", "NUMBA")}

    def one(name: str) -> str:
        command = [sys.executable, __file__, "case", str(folder.resolve()), "--only", name]
        done = subprocess.run(command, env=env, capture_output=True, text=True)
        return "" if done.returncode == 0 else f"{name}: {done.stderr.strip()[-2000:]}"

    with ThreadPoolExecutor(jobs) as pool:
        for name, error in zip(names, pool.map(one, names), strict=True):
            print(error or f"{name} written", flush=True)


def case(folder: Path, name: str) -> None:
    """Write the files of one case."""
    if name in DIAGNOSES:
        files = kept(DIAGNOSES[name]())
    else:
        files = {"txt": story() if name == "story" else told(name)}
    for ending, text in files.items():
        (folder / f"{name}.{ending}").write_text(text, encoding="utf-8")


@dataclass
class Difference:
    """How two diagnoses differ: in verdict or names, and in standard errors at most."""

    names: bool
    errors: float


def difference(before: dict[str, Any], after: dict[str, Any]) -> Difference:
    """Return how the numbers of two diagnoses differ."""

    def names(data: dict[str, Any]) -> Any:
        return data["verdict"], [
            (f["effect"]["name"], [a["name"] for a in f["alternatives"]], f["equivalents"])
            for f in data["findings"]
        ]

    largest = 0.0
    for old, new in zip(before["calibrated"], after["calibrated"], strict=True):
        largest = max(largest, _distance(old["after"], new["after"], old["standard_error"]))
    if names(before) == names(after):
        for old, new in zip(before["findings"], after["findings"], strict=True):
            for name, error in old["standard_errors"].items():
                values = (f["effect"]["parameters"][name] for f in (old, new))
                largest = max(largest, _distance(*values, error))
    return Difference(names(before) != names(after), largest)


def _distance(old: Any, new: Any, error: Any) -> float:
    old, new, error = (float(v) for v in (old, new, error))
    if old == new or (math.isnan(old) and math.isnan(new)):
        return 0.0
    return abs(new - old) / error if 0 < error < math.inf else abs(new / old - 1)


def compare(before: Path, after: Path) -> int:
    """Print what differs between two folders; return how many files do."""
    different = 0
    for path in sorted(before.iterdir()):
        other = after / path.name
        if not other.exists():
            print(f"{path.name:40} missing")
            different += 1
        elif path.read_bytes() != other.read_bytes():
            different += 1
            print(f"{path.name:40} differs", end="")
            if path.suffix == ".json":
                d = difference(*(json.loads(p.read_text("utf-8")) for p in (path, other)))
                said = "VERDICT OR NAMES DIFFER" if d.names else "same verdict and names"
                print(f": {said}, by {d.errors:.1e} standard errors", end="")
            print()
    print(f"{different} of {len(list(before.iterdir()))} files differ")
    return different


def main() -> int:
    """Write or compare."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("task", choices=("write", "compare", "case"))
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--only", action="append", default=[])
    parser.add_argument("--jobs", type=int, default=1)
    args = parser.parse_args()
    if args.task == "compare":
        return 1 if compare(*args.folders) else 0
    if args.task == "case":
        case(args.folders[0], args.only[0])
    else:
        write(args.folders[0], args.only, args.jobs)
    return 0


if __name__ == "__main__":
    sys.exit(main())
