"""How often a record shows an effect of the size that a clean diagnosis calls visible.

``python benchmarks/study_power.py run --seeds 0-99 --out power.jsonl.gz`` draws rigs of the frozen
study (``outside_cases.py``, white sensor noise) with nothing hidden, diagnoses a record, and asks
it for the sizes that are shown with a probability of 50, 80 and 95 % (`find_sensitivity`). For each
probability an effect is drawn, hidden with its size in a record of the same rig with other noise,
and diagnosed with all of the catalogue. It is shown if it is in the set of a finding. ``print
FILE`` prints the shares with Wilson's 95 % intervals; a run that was interrupted goes on.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import joblib
import numpy as np
import outside_cases as cases
import outside_plants as op
import study_frozen as study
from _shares import append_line, find_commit, parse_seeds, read_lines, write_lines, write_share

import ctrlid as cid

POWERS = (0.5, 0.8, 0.95)
# The parameter of an effect, the size of the simulator that it is, and which signs it may have.
EFFECTS: dict[str, tuple[str, str, tuple[int, ...]]] = {
    "InputDelay": ("delay", "delay", (1,)), "ActuatorLag": ("tau", "lag", (1,)),
    "InputDeadZone": ("width", "deadzone", (1,)), "InputBacklash": ("width", "backlash", (1,)),
    "InputNonlinearity": ("curvature", "curvature", (-1, 1)),
    "InputSaturatingGain": ("saturation", "saturation", (1,)),
    "ViscousFriction": ("c", "viscous", (1,)), "CoulombFriction": ("fc", "coulomb", (1,)),
    "QuadraticDrag": ("c2", "drag", (1,)), "EddyCurrentDamping": ("ce", "eddy", (1,)),
    "LinearStiffness": ("k1", "stiffness", (-1, 1)), "CubicStiffness": ("k3", "cubic", (-1, 1)),
    "ConstantForce": ("bias", "force", (-1, 1)), "PositionOffset": ("offset", "position", (-1, 1)),
    "SensorLag": ("tau", "sensor_lag", (1,)),
    "SensorNonlinearity": ("curvature", "bend", (-1, 1)), "SensorGain": ("error", "scale", (-1, 1)),
}  # fmt: skip
Line = dict[str, Any]


def simulate(rig: cases.Rig, r: np.ndarray, hidden: dict[str, float], seed: Sequence[int]) -> Any:
    """Return a record of a rig with effects hidden, and None where it leaves its range."""
    rng, n = np.random.default_rng(list(seed)), len(r)
    e, x0 = op.make_neutral(), np.zeros(op.MOST)
    for key, size in hidden.items():
        e[op.I[key]] = size
    x0[:2], x0[5:] = rig.x0, rig.at[2]
    moves = r - (rig.at[2] if rig.closed else rig.at[1])
    reach = 0.9 * abs(rig.at[2]) if rig.plant in ("ball", "tanks") else 1.0 + 1e3 * rig.swing
    u, y, ok = op.simulate(
        op.PLANTS.index(rig.plant), cases.make_array(rig.plant, rig.true), e, rig.at, x0, rig.num,
        rig.den, rig.closed, moves, rig.push * rng.standard_normal(n),
        rig.sigma * rng.standard_normal(n), np.full(n, rig.dt), 0.0, reach,
    )  # fmt: skip
    return cid.Record(r=r if rig.closed else None, u=u, y=y, dt=rig.dt) if ok else None


def run(seed: int, n: int = study.SAMPLES) -> list[Line]:
    """Ask a clean record for visible sizes, hide them, and return a line for each probability."""
    start, commit = time.process_time(), find_commit()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        case = cases.draw_case("clean", seed, n)
        # The controller is stated as it is: what is asked is a power, and not robustness.
        rig = replace(case.rig, stated="exact", stated_gain=1.0)
        loop, rng = study.make_loop(rig), np.random.default_rng([seed, 80])
        record = simulate(rig, case.r, {}, (seed, 81))
        found = None if record is None else cid.diagnose(loop, record, progress=False)
        if found is None or found.verdict != "nothing missing":
            return [{"seed": seed, "power": p, "n": n, "commit": commit} for p in POWERS]
        able = [k for k, (own, _, _) in EFFECTS.items() if rig.plant in cases.HOSTS[k]
                and np.isfinite(found.sensitivity.get(f"{k}.{own}", np.inf))]  # fmt: skip
        lines = []
        for power in POWERS:
            name = str(rng.choice(able))
            own, key, signs = EFFECTS[name]
            size = float(rng.choice(signs)) * found.find_sensitivity(power)[f"{name}.{own}"]
            line: Line = {"seed": seed, "power": power, "n": n, "commit": commit,
                          "plant": rig.plant, "name": name, "size": size}  # fmt: skip
            scale = 1 / rig.dt if name == "InputDelay" else 1.0
            hiding = simulate(rig, case.r, {key: size * scale}, (seed, 82, int(100 * power)))
            if hiding is not None:
                again = cid.diagnose(loop, hiding, progress=False)
                sets = [list(f.names) for f in again.findings]
                shown = any(cases.is_same(name, one, rig.plant) for s in sets for one in s)
                line |= {"shown": shown, "verdict": again.verdict, "sets": sets}
            lines.append(line | {"seconds": round(time.process_time() - start, 2)})
    return lines


def make_key(line: Line) -> tuple[int, float]:
    """Return what names a line."""
    return line["seed"], line["power"]


def write_tables(lines: Sequence[Line]) -> str:
    """Return the shares, for each probability and for each effect."""
    told = [x for x in lines if "shown" in x]
    commits = " and ".join(sorted({x["commit"] for x in lines}))
    out = [f"{len(told)} draws of commit {commits}, {len(lines) - len(told)} more without a size"]
    for power in POWERS:
        own = [x["shown"] for x in told if x["power"] == power]
        out.append(f"{100 * power:.0f} % predicted  {write_share(own)}")
    for name in sorted({x["name"] for x in told}):
        own = [x for x in told if x["name"] == name]
        due = sum(x["power"] for x in own)
        out.append(f"{name:<22} {sum(x['shown'] for x in own):3d} of {len(own)}, {due:.1f} due")
    return "\n".join(out)


def main() -> None:
    """Run the study, or print it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    runs = commands.add_parser("run", help="draw and diagnose")
    runs.add_argument("--seeds", type=parse_seeds, default=range(20), metavar="0-19")
    runs.add_argument("--jobs", type=int, default=1)
    runs.add_argument("--out", required=True, help="the file, such as power.jsonl.gz")
    prints = commands.add_parser("print", help="print the shares of a file")
    prints.add_argument("file")
    options = parser.parse_args()
    if options.command == "run":
        done = {x["seed"] for x in read_lines(options.out, make_key)}
        work = joblib.Parallel(n_jobs=options.jobs, return_as="generator_unordered")
        tasks = [joblib.delayed(run)(s) for s in options.seeds if s not in done]
        for lines in work(tasks):
            for line in lines:
                append_line(options.out, line)
                print(*(line.get(k, "") for k in ("seed", "plant", "name", "power", "size", "shown",
                                                  "sets")), flush=True)  # fmt: skip
        if Path(options.out).exists():
            write_lines(options.out, read_lines(options.out, make_key))
    print(write_tables(read_lines(options.out if options.command == "run" else options.file,
                                  make_key)))  # fmt: skip


if __name__ == "__main__":
    main()
