"""The frozen study: how often names are right on records of a simulator that is not ctrlid's.

``python benchmarks/study_frozen.py run --seeds 0-599 --classes clean --out study.jsonl.gz`` draws
(``outside_cases.py`` says what, and from what), weighs what is hidden before ctrlid sees the
record, diagnoses and writes a line for each draw; draws that the file has already are left out, so
that a run that was interrupted goes on. The full study is ``run --full``. ``print FILE`` prints
tables with Wilson's 95 % intervals, ``print --misses FILE`` each wrong answer as well.
``rerun FILE --lines 5`` diagnoses lines of the file again and compares the answers, and
``rerun FILE --draws two:85012 clean:85300`` those that are named.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import math
import time
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import control as ct
import joblib
import numpy as np
import outside_cases as cases
from _shares import append_line, find_commit, parse_seeds, read_lines, write_lines, write_share
from scipy import signal, stats
from watched_numbers import watch_numbers

import ctrlid as cid

FULL = {"clean": 600, "rubbing": 150, "one": 400, "faint": 400, "two": 200, "three": 15,
        "outside": 200, "parameter": 100}  # fmt: skip
SAMPLES = 1500
FAINT, FOUND = 5.0, 50.0  # worth from which a wrong name counts, and from which an effect is due
BESIDE = 100.0  # the same of each of two
EDGES = (0, 5, 10, 20, 50, 100, 300, 1000, 3000, math.inf)
G = 9.81
# How an answer begins that names nothing because the record does not show that the input acts.
IDLE = ("THE INPUT DOES NOT SEEM TO REACH", "THE OUTPUT DOES NOT SEEM TO MOVE")

Rates = Callable[[Any, Any, Any], tuple[Any, ...]]
# What a user writes: rates from states, input and parameters; names; the state that is measured.
MODELS: dict[str, tuple[Rates, tuple[str, ...], str, int]] = {
    "ball": (lambda x, u, q: (x[1], q["g"] - q["K"] / q["m"] * (u + q["b"]) ** 2 / x[0] ** 2),
             ("x", "v"), "V", 0),
    "drive": (lambda x, u, q: (x[1], (q["k"] * (u + q["b"]) - q["c"] * x[1]) / q["J"]),
              ("angle", "speed"), "V", 0),
    "pendulum": (lambda x, u, q: (x[1], q["g"] / q["l"] * np.sin(x[0])
                                  + (u + q["b"] - q["c"] * x[1]) / (q["m"] * q["l"] ** 2)),
                 ("theta", "omega"), "tau", 0),
    "spring": (lambda x, u, q: (x[1], (u + q["b"] - q["s"] * x[0] - q["c"] * x[1]) / q["m"]),
               ("x", "v"), "F", 0),
    "cart": (lambda x, u, q: (x[1], (
        (q["M"] + q["m"]) * q["g"] * np.sin(x[0])
        + np.cos(x[0]) * (u + q["b"] - q["m"] * q["l"] * np.sin(x[0]) * x[1] ** 2)
    ) / (q["l"] * (q["M"] + q["m"] * np.sin(x[0]) ** 2))), ("theta", "omega"), "F", 0),
    "tanks": (lambda x, u, q: (
        (q["k"] * u - q["o1"] * np.sqrt(2 * q["g"] * x[0])) / q["A"],
        (q["o1"] * np.sqrt(2 * q["g"] * x[0]) - q["o2"] * np.sqrt(2 * q["g"] * x[1])) / q["A"],
    ), ("h1", "h2"), "u", 1),
}  # fmt: skip
# The size that an interval is asked to cover, by the name and the parameter of the catalogue.
SIZES: dict[str, tuple[str, Callable[[dict[str, float], float], float]]] = {
    "InputDelay": ("delay", lambda v, dt: v["delay"] * dt),
    "ActuatorLag": ("tau", lambda v, dt: v["lag"]),
    "InputDeadZone": ("width", lambda v, dt: v["deadzone"]),
    "InputBacklash": ("width", lambda v, dt: v["backlash"]),
    "InputRateLimit": ("rate", lambda v, dt: v["rate"]),
    "InputNonlinearity": ("curvature", lambda v, dt: v["curvature"]),
    "InputSaturatingGain": ("saturation", lambda v, dt: v["saturation"]),
    "ViscousFriction": ("c", lambda v, dt: v["viscous"]),
    "CoulombFriction": ("fc", lambda v, dt: v["coulomb"]),
    "QuadraticDrag": ("c2", lambda v, dt: v["drag"]),
    "EddyCurrentDamping": ("ce", lambda v, dt: v["eddy"]),
    "LinearStiffness": ("k1", lambda v, dt: v["stiffness"]),
    "CubicStiffness": ("k3", lambda v, dt: v["cubic"]),
    "ConstantForce": ("bias", lambda v, dt: v["force"]),
    "PeriodicForce": ("amplitude", lambda v, dt: v["periodic"]),
    "PositionRipple": ("amplitude", lambda v, dt: v["ripple"]),
    "PositionOffset": ("offset", lambda v, dt: v["position"]),
    "ForceExponent": ("n", lambda v, dt: v["exponent"]),
    "ParameterDrift": ("rate", lambda v, dt: v["drift"]),
    "ParameterStep": ("size", lambda v, dt: v["step"]),
    "SensorLag": ("tau", lambda v, dt: v["sensor_lag"]),
    "SensorNonlinearity": ("curvature", lambda v, dt: v["bend"]),
    "SensorGain": ("error", lambda v, dt: v["scale"]),
    "SensorDrift": ("rate", lambda v, dt: v["sensor_drift"]),
    "SensorHum": ("amplitude", lambda v, dt: v["hum"]),
}


def make_loop(rig: cases.Rig, friction: float = 0.0) -> cid.Loop:
    """Return the model that the user of a rig has, with friction of a free size if one is given."""
    rates, states, entry, shown = MODELS[rig.plant]
    given = {k: v for k, v in rig.given.items() if k != "b" or "b" in cases.FREE[rig.plant]}
    plant = ct.nlsys(
        lambda t, x, u, q: np.array(rates(x, u[0], q)), lambda t, x, u, q: x[shown],
        inputs=[entry], outputs=[states[shown]], states=list(states), params=given, name=rig.plant,
    )  # fmt: skip
    # The law's own bias is what it is; where the plant then rests, follows from what is given.
    _, x0 = cases.find_rest(rig.plant, rig.given, rig.at[2])
    at = cid.OperatingPoint(tuple(x0.tolist()), float(rig.at[1]), float(rig.at[2]))
    law = None
    if rig.closed and rig.stated != "unknown":
        law = ct.tf((rig.stated_gain * rig.num).tolist(), rig.den.tolist(), rig.dt)
    free = {name: rig.deviation.get(name, math.inf) for name in cases.FREE[rig.plant]}
    loop = cid.Loop(plant, law, dt=rig.dt, at=at, free=free)
    if not friction:
        return loop
    rubbing = loop.with_effect(cid.effects.CoulombFriction(fc=friction))
    return replace(rubbing, free={**free, "CoulombFriction.fc": math.inf})


def run(name: str, seed: int, n: int = SAMPLES, watched: bool = True) -> dict[str, Any]:
    """Draw, weigh and diagnose; return the line.

    Its entry "near" counts for each number of judgement the comparisons that would have come out
    otherwise with half or twice of it (`watched_numbers`); if it is not `watched`, it is left out.
    """
    line: dict[str, Any] = {"class": name, "seed": seed, "n": n, "commit": find_commit()}
    start = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            case = cases.draw_case(name, seed, n)
        except RuntimeError as reason:
            return line | {"undrawn": str(reason)}
        rig = case.rig
        line |= {
            "plant": rig.plant, "noise": case.noise, "law": rig.stated if rig.closed else "open",
            "reference": rig.reference, "redrawn": case.redrawn, "dt": rig.dt,
            "truth": list(case.hidden), "sizes": [_round(s) for s in case.sizes],
            "worth": [round(float(w), 3) for w in case.worth],
            "swallowed": case.swallowed, "drawing": round(time.process_time() - start, 2),
        }  # fmt: skip
        loop = make_loop(rig, case.friction)
        record = cid.Record(r=case.r if rig.closed else None, u=case.u, y=case.y, dt=rig.dt)
        start = time.process_time()
        try:
            with watch_numbers() if watched else contextlib.nullcontext({}) as noted:
                found = cid.diagnose(loop, record, progress=False)
        except Exception as reason:  # a study counts what a user would see
            seconds = round(time.process_time() - start, 2)
            return line | {"error": f"{type(reason).__name__}: {reason}"[:300], "seconds": seconds}
    gap = found.gap
    return line | {
        "verdict": found.verdict,
        "idle": found.sentence.startswith(IDLE),
        "findings": [_describe(f) for f in found.findings],
        "stand_ins": [_describe(f) for f in found.stand_ins],
        "gap": _digits([gap.given, gap.before, gap.after, gap.floor]),
        "gap kind": gap.name,
        "wider": _digits([compare_errors(gap)])[0],
        "sensor noise": "" if found.noise is None else found.noise.kind,
        **({"near": dict(sorted(noted.items()))} if watched else {}),
        "seconds": round(time.process_time() - start, 2),
    }


def _round(values: dict[str, float]) -> dict[str, float]:
    return {k: float(f"{v:.5g}") for k, v in values.items()}


def _digits(values: Iterable[float]) -> list[float | None]:
    """Return numbers of five digits; what is not finite is none."""
    return [float(f"{v:.5g}") if math.isfinite(v) else None for v in values]


def _describe(finding: Any) -> dict[str, Any]:
    """Return the set of a finding, its evidence, and its sizes with their standard errors."""
    values = {k: v for k, v in finding.effect.values().items() if isinstance(v, int | float)}
    return {
        "set": list(finding.names),
        "equal": list(finding.equivalents),
        "evidence": _digits([finding.evidence])[0],
        "values": {k: [*_digits([v, finding.standard_errors.get(k, math.nan)])]
                   for k, v in values.items()},
    }  # fmt: skip


def compare_errors(gap: Any) -> float:
    """Return the chance that noise alone widens the gap as much."""
    one, other = gap.simulated_before - gap.measured, gap.simulated_after - gap.measured
    both = np.isfinite(one) & np.isfinite(other)
    return weigh_mean((other**2 - one**2)[both])


def weigh_mean(d: np.ndarray[Any, Any]) -> float:
    """Return the chance of so large a mean where the true one is zero: Student's test of blocks.

    The blocks are as long as the correlation of the samples asks for. Of 25 blocks of any record,
    4 % and 11 % are beyond 1 % where errors remember 20 and 50 samples, as in a closed loop.
    """
    if len(d) < 2 or not np.ptp(d) > 0:
        return 1.0
    z = d - d.mean()
    raw = signal.correlate(z, z, "full")[len(z) - 1 :]
    rho = raw / raw[0]
    ends = np.flatnonzero(rho[: len(rho) // 4] <= 0)
    stop = ends[0] if len(ends) else len(rho) // 4
    length = max(1, math.ceil(4 * (1 + 2 * rho[1:stop].sum())))
    count = len(d) // length
    if count < 2:
        return 1.0
    means = d[: count * length].reshape(count, length).mean(axis=1)
    return float(stats.t.sf(means.mean() / (means.std(ddof=1) / math.sqrt(count)), count - 1))


# --- scores


def group_names(names: Iterable[str], plant: str) -> list[set[str]]:
    """Return names in groups that no record of the plant tells apart."""
    groups: list[set[str]] = []
    for name in names:
        for group in groups:
            if any(cases.is_same(name, other, plant) for other in group):
                group.add(name)
                break
        else:
            groups.append({name})
    return groups


def list_sets(line: dict[str, Any], stand_ins: bool = False) -> list[list[set[str]]]:
    """Return the findings of a line, each as groups of names; the resolution is a remark."""
    found = line.get("findings", []) + (line.get("stand_ins", []) if stand_ins else [])
    return [
        group_names(dict.fromkeys((*f["set"], *f["equal"])), line["plant"])
        for f in found
        if f["set"][0] != "Quantization"
    ]


def holds_truth(groups: Sequence[set[str]], truth: str, plant: str) -> bool:
    """Whether a truth, or what is exactly equivalent, is among the names of a finding."""
    return any(cases.is_same(truth, name, plant) for group in groups for name in group)


def is_in_sets(line: dict[str, Any], truth: str) -> bool:
    """Whether a truth is in the set of a finding."""
    return any(holds_truth(groups, truth, line["plant"]) for groups in list_sets(line))


def is_rightly_nameless(line: dict[str, Any]) -> bool:
    """Whether all of the input is swallowed, by whatever it is, and the answer says just that."""
    return bool(line.get("swallowed") and line.get("idle"))


def is_first(line: dict[str, Any]) -> bool:
    """Whether the first name is the truth."""
    sets = list_sets(line)
    return bool(sets) and holds_truth(sets[0][:1], line["truth"][0], line["plant"])


def is_wrong(line: dict[str, Any], groups: Sequence[set[str]]) -> bool:
    """Whether no name of a finding is true."""
    return not any(holds_truth(groups, truth, line["plant"]) for truth in line.get("truth", ()))


def is_exact(line: dict[str, Any]) -> bool:
    """Whether each of several truths is in a finding of its own, and there is no other finding."""
    return (len(list_sets(line)) == len(line["truth"])
            and all(is_in_sets(line, t) for t in line["truth"])
            and not any(is_wrong(line, s) for s in list_sets(line)))  # fmt: skip


def is_wider(line: dict[str, Any]) -> bool:
    """Whether the gap is wider beyond chance (1 %) with the effects than without."""
    chance = line.get("wider")
    return chance is not None and chance < 0.01


def find_interval(line: dict[str, Any]) -> float | None:
    """Return by how many standard errors a size that was named first is off, None without one."""
    if len(line["truth"]) != 1 or line["truth"][0] not in SIZES or not line.get("findings"):
        return None
    name = line["truth"][0]
    key, compute = SIZES[name]
    for f in line["findings"]:
        if f["set"][0] == name and key in f["values"]:
            value, error = f["values"][key]
            if value is None or not error:
                return None
            return (value - compute(line["sizes"][0], line["dt"])) / error
    return None


def score(lines: Sequence[dict[str, Any]]) -> list[tuple[str, str, str]]:
    """Return the table: what is asked with its conditions, the target, and what was measured."""
    drawn = [x for x in lines if "undrawn" not in x]
    of = {name: [x for x in drawn if x["class"] == name] for name in cases.CLASSES}
    one = [x for x in of["one"] if x["worth"][0] > FOUND]
    faint = [x for x in of["faint"] + of["one"] if FAINT <= x["worth"][0] <= FOUND]
    two = [x for x in of["two"] if min(x["worth"]) > BESIDE]
    three = [x for x in of["three"] if min(x["worth"]) > BESIDE]
    outside = [x for x in of["outside"] if x["worth"][0] > FOUND]
    fixed = [x for x in of["parameter"] if x["worth"][0] > FOUND]
    pairs = [(x, s) for x in faint for s in list_sets(x)]
    right = [s for x in one for s in list_sets(x) if holds_truth(s, x["truth"][0], x["plant"])]
    rows = [
        ("nothing hidden, under nine kinds of sensor noise: any name, stand-ins included",
         "<= 1 %", write_share([bool(list_sets(x, stand_ins=True)) for x in of["clean"]])),
        ("  the same: a finding", "", write_share([bool(list_sets(x)) for x in of["clean"]])),
        ('  the same: "nothing missing"', "",
         write_share([x.get("verdict") == "nothing missing" for x in of["clean"]])),
        *_score_rubbing(of["rubbing"]),
        (f"one effect, worth over {FOUND:g}: the truth in the set of a finding", "98 %",
         write_share([is_in_sets(x, x["truth"][0]) for x in one])),
        ("  the same, and rightly no name where nothing of the input reaches the plant", "",
         write_share([is_in_sets(x, x["truth"][0]) or is_rightly_nameless(x) for x in one])),
        ("  the same: the truth first", "93 %", write_share([is_first(x) for x in one])),
        ("  the same: answers with one name that are right", "98 %",
         write_share([is_first(x) for x in one
                      if len(list_sets(x)) == 1 and len(list_sets(x)[0]) == 1])),
        ("  the same: a finding in whose set nothing is true", "",
         write_share([any(is_wrong(x, s) for s in list_sets(x)) for x in one])),
        ("  the same: mean size of the set that has the truth", "<= 1.5",
         f"{np.mean([len(s) for s in right]):.2f} of {len(right)}" if right else "no draw"),
        (f"one effect, worth 5 to {FOUND:g}: sets of findings without the truth", "<= 5 %",
         write_share([is_wrong(x, s) for x, s in pairs])),
        (f"two effects, each worth over {BESIDE:g} beside the other: both in the sets", "95 %",
         write_share([all(is_in_sets(x, t) for t in x["truth"]) for x in two])),
        ("  the same, and rightly no name where nothing of the input reaches the plant", "",
         write_share([all(is_in_sets(x, t) for t in x["truth"]) or is_rightly_nameless(x)
                      for x in two])),
        ("  the same: exactly right, a finding for each and no other", "80 %",
         write_share([is_exact(x) for x in two])),
        (f"three effects, each worth over {BESIDE:g} beside the others: all in the sets", "",
         write_share([all(is_in_sets(x, t) for t in x["truth"]) for x in three])),
        (f"outside the catalogue, worth over {FOUND:g}: a clean bill", "<= 4 %",
         write_share([x.get("verdict") == "nothing missing" for x in outside])),
        ('  the same: "explained" by names of the catalogue', "",
         write_share([x.get("verdict") == "explained" for x in outside])),
        (f"a parameter called exact is 2 % off, worth over {FOUND:g}: it, or what is exactly "
         "equivalent, in a set", "", write_share([is_in_sets(x, x["truth"][0]) for x in fixed])),
        ("  the same: a finding in whose set nothing is true", "",
         write_share([any(is_wrong(x, s) for s in list_sets(x)) for x in fixed])),
        ("findings, all classes: the gap wider beyond chance (1 %)", "never",
         write_share([is_wider(x) for x in drawn if list_sets(x)])),
    ]  # fmt: skip
    off = [v for x in of["one"] + of["faint"] if (v := find_interval(x)) is not None]
    rows.append(("one effect, named first: the true size in its 95 % interval", ">= 90 %",
                 write_share([abs(v) < 1.96 for v in off])))  # fmt: skip
    rows.append(("raised, all classes", "none", write_share(["error" in x for x in drawn])))
    seconds = [x["seconds"] for x in drawn if "seconds" in x]
    if seconds:
        rows.append(("CPU seconds of a diagnosis: median, mean, largest", "",
                     f"{np.median(seconds):.1f}, {np.mean(seconds):.1f}, "
                     f"{max(seconds):.1f}"))  # fmt: skip
    rows.append(("not drawn; drawn again for want of margins", "",
                 f"{len(lines) - len(drawn)}; {sum(x['redrawn'] for x in drawn)}"))  # fmt: skip
    return rows


def _score_rubbing(lines: Sequence[dict[str, Any]]) -> list[tuple[str, str, str]]:
    """Return the rows of what the model has as well; none for a study that did not ask it."""
    if not lines:
        return []
    return [
        ("dry friction that the model has as well, nothing else hidden: any name", "<= 1 %",
         write_share([bool(list_sets(x, stand_ins=True)) for x in lines])),
        ('  the same: "nothing missing"', "",
         write_share([x.get("verdict") == "nothing missing" for x in lines])),
    ]  # fmt: skip


def find_power(lines: Sequence[dict[str, Any]]) -> list[tuple[str, str, str, str]]:
    """Return detection and power by worth: anything found, the truth in a set, a wrong set."""
    own = [x for x in lines if x["class"] in ("one", "faint") and x.get("worth")]
    rows = []
    for low, high in itertools.pairwise(EDGES):
        here = [x for x in own if low <= x["worth"][0] < high]
        rows.append((
            f"{low:g} to {high:g}" if math.isfinite(high) else f"over {low:g}",
            write_share([bool(list_sets(x)) for x in here]),
            write_share([is_in_sets(x, x["truth"][0]) for x in here]),
            write_share([any(is_wrong(x, s) for s in list_sets(x)) for x in here]),
        ))  # fmt: skip
    return rows


def find_misses(lines: Sequence[dict[str, Any]]) -> list[str]:
    """Return every wrong answer, with the truth and what it was worth."""
    out = []
    for x in lines:
        if "undrawn" in x:
            continue
        truths = [t for t, w in zip(x["truth"], x["worth"], strict=True) if w > FOUND]
        wrong = "error" in x or any(is_wrong(x, s) for s in list_sets(x, stand_ins=not x["truth"]))
        if x["class"] == "outside":
            wrong = "error" in x or x["verdict"] == "nothing missing"
        elif any(not is_in_sets(x, t) for t in truths):
            wrong = True
        if is_wider(x) and list_sets(x):
            wrong = True
        if not wrong:
            continue
        hidden = " + ".join(f"{t} ({w:.0f})" for t, w in zip(x["truth"], x["worth"], strict=True))
        out.append(f"{x['class']} {x['seed']} {x['plant']}, {x['noise']} noise, law {x['law']}: "
                   f"{hidden or 'nothing'}{', which swallow all of u' * bool(x.get('swallowed'))} "
                   f"-> {write_answer(x)}")  # fmt: skip
    return out


def write_answer(line: dict[str, Any]) -> str:
    """Return the verdict of a line, its findings and what only stands in."""
    found, stand_ins = (
        " + ".join("/".join(f["set"]) for f in line.get(kind, []))
        for kind in ("findings", "stand_ins")
    )
    answer = line.get("error") or found or "no name"
    told = f"{line.get('verdict', 'raised')}: {answer}"
    return f"{told}; stand-ins {stand_ins}" if stand_ins else told


def describe_draws(lines: Sequence[dict[str, Any]]) -> str:
    """Return in a sentence of which commit the lines are, from what seeds, and of which classes."""
    seeds = [x["seed"] for x in lines]
    commits = " and ".join(sorted({x.get("commit") or "unknown" for x in lines}))
    counts = ((name, sum(x["class"] == name for x in lines)) for name in cases.CLASSES)
    told = ", ".join(f"{count} {name}" for name, count in counts if count)
    return f"{len(lines)} draws of commit {commits}, seeds {min(seeds)} to {max(seeds)}: {told}."


def write_tables(lines: Sequence[dict[str, Any]], misses: bool = False) -> str:
    """Return the tables of a file as text."""
    if not lines:
        return "no draw"
    text = [describe_draws(lines), ""]
    text += [f"{what:<98} {target:<8} {value}" for what, target, value in score(lines)]
    text += ["", "one effect, by worth: a finding; the truth in a set; a set without the truth"]
    text += [f"  {a:<16} {b:<36} {c:<36} {d}" for a, b, c, d in find_power(lines)]
    if misses:
        text += ["", *find_misses(lines)]
    return "\n".join(text)


# --- files


def make_key(line: dict[str, Any]) -> tuple[str, int, int]:
    """Return what tells one draw from another."""
    return line["class"], line["seed"], line["n"]


def make_changed_key(line: dict[str, Any]) -> tuple[Any, ...]:
    """Return what tells one draw from another where a number had another value as well."""
    return *make_key(line), line["number"], line["factor"]


def read(
    path: str | Path, key: Callable[[dict[str, Any]], tuple[Any, ...]] = make_key
) -> list[dict[str, Any]]:
    """Return the lines of a file; of those with the same key the last one counts."""
    return read_lines(path, key)


def write(path: str | Path, lines: Iterable[dict[str, Any]]) -> None:
    """Write lines as one compressed file, in the order of classes and seeds."""
    order = {name: i for i, name in enumerate(cases.CLASSES)}
    changed = ("number", "factor")

    def rank(x: dict[str, Any]) -> tuple[Any, ...]:
        return order[x["class"]], x["seed"], x["n"], *(x[k] for k in changed if k in x)

    write_lines(path, sorted(lines, key=rank))


def is_same_answer(one: dict[str, Any], other: dict[str, Any]) -> bool:
    """Whether two lines have the same truth, worth and answer, whatever time they took."""
    told = ("truth", "worth", "verdict", "findings", "stand_ins", "gap", "error")
    return all(one.get(k) == other.get(k) for k in told)


def main() -> None:
    """Run the study, print it, or rerun some of its lines."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    runs = commands.add_parser("run", help="draw, weigh and diagnose")
    runs.add_argument("--classes", nargs="+", choices=cases.CLASSES, default=list(cases.CLASSES))
    runs.add_argument("--seeds", type=parse_seeds, default=range(6), metavar="0-5")
    runs.add_argument("--full", action="store_true", help="all draws of the study")
    runs.add_argument("--first", type=int, default=0, help="the first seed of a full study")
    runs.add_argument("--samples", type=int, default=SAMPLES, help="length of the records")
    runs.add_argument("--jobs", type=int, default=1)
    runs.add_argument("--out", required=True, help="the file, such as study.jsonl.gz")
    prints = commands.add_parser("print", help="print the tables of a file")
    prints.add_argument("file")
    prints.add_argument("--misses", action="store_true", help="and each wrong answer")
    again = commands.add_parser("rerun", help="diagnose lines of a file again")
    again.add_argument("file")
    again.add_argument("--lines", type=int, default=5, help="so many, spread evenly")
    again.add_argument("--draws", nargs="+", metavar="CLASS:SEED", help="these in their place")
    options = parser.parse_args()
    if options.command == "print":
        print(write_tables(read(options.file), options.misses))
        return
    if options.command == "rerun":
        lines = read(options.file)
        if options.draws:
            named = {f"{x['class']}:{x['seed']}": x for x in lines}
            chosen = [named[draw] for draw in options.draws]
        else:
            chosen = lines[:: max(len(lines) // options.lines, 1)][: options.lines]
        for x in chosen:
            again = run(*make_key(x), watched=False)
            told = "the same"
            if not is_same_answer(x, again):
                one, other = write_answer(x), write_answer(again)
                told = f"the same names: {one}" if one == other else f"{one} -> {other}"
            print(*make_key(x), " + ".join(x["truth"]) or "nothing", told, sep="  ", flush=True)
        return
    if options.full:
        first = options.first
        wanted = [(c, s) for s in range(first, first + max(FULL.values()))
                  for c in FULL if s < first + FULL[c]]  # fmt: skip
    else:
        wanted = [(c, s) for s in options.seeds for c in options.classes]
    done = {make_key(x) for x in read(options.out)}
    if Path(options.out).exists():
        write(options.out, read(options.out))
    tasks = [(c, s, options.samples) for c, s in wanted if (c, s, options.samples) not in done]
    work = joblib.Parallel(n_jobs=options.jobs, return_as="generator_unordered")
    for line in work(joblib.delayed(run)(*task) for task in tasks):
        append_line(options.out, line)
        print(
            *make_key(line)[:2],
            line.get("plant"),
            line.get("truth"),
            line.get("worth"),
            "->",
            line.get("verdict", line.get("error", "")),
            [f["set"] for f in line.get("findings", [])],
            line.get("seconds"),
            flush=True,
        )
    write(options.out, read(options.out))
    print(write_tables(read(options.out)))


if __name__ == "__main__":
    main()
