"""Measure whether a plant is blamed for what its sensor, its noise or its controller does.

Run it as ``python benchmarks/study_suspects.py --classes ar hum --plants ball --seeds 0-24``; all
1 200 draws of the twelve noise and sensor classes are ``--classes all --seeds 0-24``. Records come
from ``outside_rigs.py``, a simulator that does not know ctrlid. The classes are

- ``white``, ``ar``, ``averaged``, ``walk``, ``pink``, ``t3``, ``outliers``, ``jitter``,
  ``converter``: nothing is wrong in plant or sensor (``--classes noise``);
- ``hum``, ``scale``, ``drift``: the sensor (``--classes sensor``). It counts as hidden where it is
  worth over 50 of log-likelihood after recalibration, by a filter of the simulator's own;
- ``plant-delay`` and others: a plant effect under coloured or heavy-tailed noise (``--classes
  plant``);
- ``controller-gain`` and others: the law that is stated is not the one that ran (``--classes
  controller``), scored by the kinds of ``audit(record, loop)`` and by whether diagnose() blames the
  plant. A fault counts where it leaves something of the logged u.

Each draw becomes a line of JSON in ``--out``, a compressed file; draws that are there already are
left out, so that a study that was interrupted goes on. ``--print FILE`` prints the table and the
misses of such a file.
"""

from __future__ import annotations

import argparse
import math
import time
import warnings
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import control as ct
import joblib
import numpy as np
import outside_rigs as rigs
from _shares import append_line, find_commit, parse_seeds, read_lines, write_lines, write_share

import ctrlid as cid

SEEN = 1e-6  # of the variance of u: from here on a fault of the controller is seen in it
HIDDEN = 50.0  # of log-likelihood: from here on a sensor effect counts as hidden
GROUPS = {
    "all": rigs.CLASSES,
    "noise": rigs.NOISES,
    "sensor": rigs.SENSORS,
    "plant": tuple(f"plant-{name}" for name in rigs.EFFECTS),
    "controller": tuple(f"controller-{name}" for name in rigs.FAULTS),
}
PARTS = {
    "with a noise of the sensor alone": GROUPS["noise"],
    "with an effect of the sensor": GROUPS["sensor"],
    "with an effect of the plant under coloured or heavy-tailed noise": GROUPS["plant"],
    "under another controller than is stated": GROUPS["controller"],
}
NAMES = {
    "hum": "SensorHum",
    "scale": "SensorGain",
    "drift": "SensorDrift",
    "plant-delay": "InputDelay",
    "plant-lag": "ActuatorLag",
    "plant-coulomb": "CoulombFriction",
    "plant-viscous": "ViscousFriction",
    "plant-periodic": "PeriodicForce",
    "plant-cubic": "CubicStiffness",
    "plant-deadzone": "InputDeadZone",
}
# Speed's friction is a free parameter of these.
ABSORBED = {("plant-viscous", "drive"), ("plant-viscous", "spring")}
WORDS = {
    "white": "white noise",
    "ar": "autoregressive noise",
    "averaged": "noise averaged over samples",
    "walk": "noise beside a random walk",
    "pink": "pink noise",
    "t3": "noise of Student's law",
    "outliers": "noise with outliers",
    "jitter": "white noise and a jittering clock",
    "converter": "white noise and a converter",
}
MUST_BE_CLEAN = ("white", "ar", "averaged", "t3", "outliers", "converter")
OF_THE_SENSOR = ("SensorHum", "SensorGain", "SensorDrift")
NOT_THE_PLANT = ("Quantization", *OF_THE_SENSOR)


def make_spring(p: dict[str, float]) -> Any:
    """Return a mass on a spring, as a user writes it."""
    return ct.nlsys(
        lambda t, x, u, q: np.array([x[1], (u[0] - q["s"] * x[0] - q["c"] * x[1]) / q["m"]]),
        lambda t, x, u, q: x[0], inputs=["F"], outputs=["x"], states=["x", "v"], params=dict(p),
        name="spring",
    )  # fmt: skip


def make_loop(draw: rigs.Draw) -> cid.Loop:
    """Return the model that the user of a rig has."""
    rig, p = draw.rig, draw.rig.given
    plant = {
        "ball": lambda: cid.plants.maglev(m=p["m"], K=p["K"]),
        "drive": lambda: cid.plants.servo(m=p["J"], c=p["c"], k=p["k"]),
        "pendulum": lambda: cid.plants.pendulum(m=p["m"], length=p["l"], c=p["c"]),
        "spring": lambda: make_spring(p),
    }[rig.plant]()
    at = cid.OperatingPoint((rig.at, 0.0), rig.rest_input if rig.law is None else rig.law.bias,
                            rig.at)  # fmt: skip
    law = rig.law and ct.tf(list(rig.law.num), list(rig.law.den), rig.dt)
    return cid.Loop(plant, law, dt=rig.dt, at=at, free=rigs.FREE[rig.plant])


def make_record(draw: rigs.Draw) -> cid.Record:
    """Return the log of a draw."""
    r = None if draw.rig.law is None else draw.r
    return cid.Record(r=r, u=draw.u, y=draw.y, dt=draw.rig.dt)


def list_names(findings: Iterable[Any]) -> list[list[str]]:
    """Return the names of each finding, those that no record can tell from it among them."""
    return [list(dict.fromkeys((*f.names, *f.equivalents))) for f in findings]


def run(name: str, plant: str, seed: int, n: int, worth: bool = True) -> dict[str, Any]:
    """Diagnose a draw and return its line."""
    line: dict[str, Any] = {"class": name, "plant": plant, "seed": seed, "n": n,
                            "commit": find_commit()}  # fmt: skip
    try:
        draw = rigs.draw(name, plant, seed, n)
    except RuntimeError as reason:
        return line | {"error": str(reason), "undrawn": True}
    rig = draw.rig
    line |= {"truth": draw.truth, "redrawn": draw.redrawn, "reference": rig.reference,
             "law": rig.law.kind if rig.law else "", "force": rig.force > 0}  # fmt: skip
    if worth and name in rigs.SENSORS:
        line["worth"] = rigs.measure_worth(draw)
    if name.startswith("controller-"):
        line["visible"] = rigs.measure_visibility(draw)
    loop, record = make_loop(draw), make_record(draw)
    start = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            if name.startswith("controller-"):
                found = cid.audit(record, loop)
                line["audit"] = [f.kind for f in found.findings]
                line["audit text"] = [f.text for f in found.findings if f.channel == "u"
                                      or f.kind == "controller"]  # fmt: skip
            found = cid.diagnose(loop, record, progress=False)
        except Exception as reason:  # a study counts what a user would see
            return line | {"error": f"{type(reason).__name__}: {reason}"}
    noise, gap = getattr(found, "noise", None), found.gap
    return line | {
        "verdict": found.verdict,
        "findings": list_names(found.findings),
        "evidence": [f.evidence for f in found.findings],
        "stand_ins": list_names(getattr(found, "stand_ins", ())),
        "gap": [gap.given, gap.before, gap.after, gap.floor],
        "gap kind": gap.kind,
        "noise": "" if noise is None else str(noise),
        "calibrated": {c.name: c.before / rig.true.get(c.name, math.nan) for c in found.calibrated},
        "seconds": round(time.process_time() - start, 2),
    }


# --- scores


def list_named_sets(line: dict[str, Any], stand_ins: bool = True) -> list[list[str]]:
    """Return the sets of a line; a converter's resolution is a remark and no name."""
    sets = line.get("findings", []) + (line.get("stand_ins", []) if stand_ins else [])
    return [s for s in sets if s[0] != "Quantization"]


def is_hidden(line: dict[str, Any]) -> bool:
    """Whether there is something to find: a fault, an effect of the plant, or a sensor's effect."""
    name = line["class"]
    if name in rigs.SENSORS:
        return line.get("worth", math.inf) > HIDDEN
    return name not in rigs.NOISES and (name, line["plant"]) not in ABSORBED


def is_in_set(line: dict[str, Any]) -> bool:
    """Whether the truth is among the names of a finding."""
    return any(NAMES[line["class"]] in s for s in line.get("findings", []))


def blames_the_plant_alone(line: dict[str, Any]) -> bool:
    """Whether the record is explained by sets without a name of the sensor."""
    sets = list_named_sets(line, stand_ins=False)
    return (line.get("verdict") == "explained" and bool(sets)
            and not any(set(s) & set(OF_THE_SENSOR) for s in sets))  # fmt: skip


def blames_the_plant(line: dict[str, Any]) -> bool:
    """Whether a finding has names of the plant only."""
    return any(not set(s) & set(NOT_THE_PLANT) for s in list_named_sets(line, stand_ins=False))


def is_fault_told(line: dict[str, Any]) -> bool:
    """Whether the audit names the fault of the controller and no other; none where none is seen."""
    fault = line["class"].removeprefix("controller-")
    named = [kind for kind in line.get("audit", []) if kind in rigs.FAULTS]
    return named == ([fault] if line.get("visible", 1.0) > SEEN else [])


def is_right(line: dict[str, Any]) -> bool:
    """Whether the answer is the one that is right."""
    name = line["class"]
    if "error" in line:
        return False
    if name.startswith("controller-"):
        return is_fault_told(line) and not blames_the_plant(line)
    if is_hidden(line):
        return is_in_set(line) and len(list_named_sets(line)) == 1
    return line["verdict"] == "nothing missing" and not list_named_sets(line)


def score(lines: Sequence[dict[str, Any]]) -> list[tuple[str, str, str]]:
    """Return the table: what is asked with its conditions, the target, and what was measured."""
    drawn = [x for x in lines if not x.get("undrawn")]
    clean = [x for x in drawn if x["class"] in rigs.NOISES]
    hidden = [x for x in drawn if x["class"] in rigs.SENSORS and is_hidden(x)]
    faint = [x for x in drawn if x["class"] in rigs.SENSORS and not is_hidden(x)]
    plant = [x for x in drawn if x["class"].startswith("plant-") and is_hidden(x)]
    laws = [x for x in drawn if x["class"].startswith("controller-")]
    rows = [("nothing wrong in plant or sensor: any name, stand-ins included", "<= 1 %",
             write_share([bool(list_named_sets(x)) for x in clean]))]  # fmt: skip
    for name in rigs.NOISES:
        own = [x.get("verdict") == "nothing missing" for x in clean if x["class"] == name]
        target = ">= 90 %" if name in MUST_BE_CLEAN else ""
        rows.append((f'  the same, {WORDS[name]}: "nothing missing"', target, write_share(own)))
    rows += [
        (f"an effect of the sensor, worth over {HIDDEN:g}: in the set of a finding", "98 %",
         write_share([is_in_set(x) for x in hidden])),
        ("  the same: names of the plant alone, explained", "none",
         write_share([blames_the_plant_alone(x) for x in hidden])),
        (f'an effect of the sensor, worth at most {HIDDEN:g}: "nothing missing"', "",
         write_share([x.get("verdict") == "nothing missing" for x in faint])),
        ("an effect of the plant under coloured or heavy-tailed noise, of any worth: in the set of "
         "a finding", "97 %", write_share([is_in_set(x) for x in plant])),
        ("  the same: false company, stand-ins included", "<= 2 %",
         write_share([any(NAMES[x["class"]] not in s for s in list_named_sets(x)) for x in plant])),
    ]  # fmt: skip
    seen = [x for x in laws if x.get("visible", 1.0) > SEEN]
    rows.append(("another controller than is stated, seen in u: named right", "95 %",
                 write_share([is_fault_told(x) for x in seen])))  # fmt: skip
    for fault in rigs.FAULTS:
        own = [is_fault_told(x) for x in seen if x["class"] == f"controller-{fault}"]
        rows.append((f"  the same, {fault}: named right", "", write_share(own)))
    unseen = [is_fault_told(x) for x in laws if x.get("visible", 1.0) <= SEEN]
    rows.append(("another controller, not seen in u: no fault named", "", write_share(unseen)))
    rows.append(("another controller, seen or not: the plant blamed", "<= 0.5 %",
                 write_share([blames_the_plant(x) for x in laws])))  # fmt: skip
    rows.append(("raised, all classes", "none", write_share(["error" in x for x in drawn])))
    seconds = [x["seconds"] for x in drawn if "seconds" in x]
    if seconds:
        rows.append(("CPU seconds of a diagnosis: median, mean, largest", "",
                     f"{np.median(seconds):.1f}, {np.mean(seconds):.1f}, "
                     f"{max(seconds):.1f}"))  # fmt: skip
    rows.append(("not drawn; drawn again for want of margins", "",
                 f"{len(lines) - len(drawn)}; {sum(x['redrawn'] for x in drawn)}"))  # fmt: skip
    return rows


def describe_draws(lines: Sequence[dict[str, Any]]) -> str:
    """Return in a sentence of which commit the lines are, from what seeds, and of which classes."""
    commits = " and ".join(sorted({x["commit"] or "unknown" for x in lines}))
    seeds, sizes = [x["seed"] for x in lines], sorted({x["n"] for x in lines})
    told = ", ".join(f"{sum(x['class'] in group for x in lines)} {words}"
                     for words, group in PARTS.items())  # fmt: skip
    return (f"{len(lines)} draws of {' and '.join(map(str, sizes))} samples, of commit {commits}, "
            f"seeds {min(seeds)} to {max(seeds)}: {told}.")  # fmt: skip


def write_table(lines: Sequence[dict[str, Any]]) -> str:
    """Return the table as text."""
    if not lines:
        return "no draw"
    rows = (f"{what:<108} {target:<8} {value}" for what, target, value in score(lines))
    return "\n".join([describe_draws(lines), "", *rows])


def find_misses(lines: Sequence[dict[str, Any]]) -> list[str]:
    """Return every wrong answer, with the truth and what it is worth."""
    out = []
    for x in lines:
        if is_right(x) or x.get("undrawn"):
            continue
        truth = ", ".join(f"{k} {v:.3g}" if isinstance(v, float) else f"{k} {v}"
                          for k, v in x["truth"].items())  # fmt: skip
        if "worth" in x:
            truth = ", ".join(filter(None, (truth, f"worth {x['worth']:.0f}")))
        if "error" in x:
            answer = x["error"][:150]
        else:
            sets = " + ".join("/".join(s) for s in x["findings"]) or "no name"
            stand_ins = " + ".join("/".join(s) for s in x["stand_ins"])
            answer = f"{x['verdict']}: {sets}" + (f"; stand-ins {stand_ins}" if stand_ins else "")
            answer += f"; audit {', '.join(x['audit'])}" if "audit" in x else ""
        out.append(f"{x['class']} {x['plant']} {x['seed']} ({truth}): {answer}")
    return out


def read(path: str | Path) -> list[dict[str, Any]]:
    """Return the lines of a file; of a draw that is there twice the last one counts."""
    return read_lines(path, make_key)


def make_key(line: dict[str, Any]) -> tuple[Any, ...]:
    """Return what tells one draw from another."""
    return line["class"], line["plant"], line["seed"], line["n"]


def main() -> None:
    """Run the study, or print the table of one that was run."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    known = [*GROUPS, *dict.fromkeys(c for group in GROUPS.values() for c in group)]
    parser.add_argument("--classes", nargs="+", choices=known, default=["all"], metavar="CLASS")
    parser.add_argument("--plants", nargs="+", choices=rigs.PLANTS, default=list(rigs.PLANTS))
    parser.add_argument("--seeds", type=parse_seeds, default=range(25), metavar="0-24")
    parser.add_argument("--samples", type=int, default=3000, help="length of the records")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--no-worth", action="store_true",
                        help="do not weigh sensor effects; all count as hidden")  # fmt: skip
    parser.add_argument("--out", default="suspects.jsonl.gz", help="the file of results")
    parser.add_argument("--print", metavar="FILE", help="print the table of a file")
    options = parser.parse_args()
    if options.print:
        lines = read(options.print)
        print(write_table(lines), *find_misses(lines), sep="\n")
        return
    classes = dict.fromkeys(c for name in options.classes for c in GROUPS.get(name, (name,)))
    done = {make_key(x) for x in read(options.out)}
    wanted = [(c, p, s, options.samples)
              for s in options.seeds for c in classes for p in options.plants]  # fmt: skip
    work = joblib.Parallel(n_jobs=options.jobs, return_as="generator")
    tasks = [w for w in wanted if w not in done]
    for line in work(joblib.delayed(run)(*w, not options.no_worth) for w in tasks):
        append_line(options.out, line)
        print(*make_key(line)[:3], "right" if is_right(line) else "MISS", line.get("verdict", ""),
              line.get("findings", line.get("error")), line.get("seconds", ""),
              flush=True)  # fmt: skip
    lines = sorted(read(options.out), key=make_key)
    write_lines(options.out, lines)
    print(write_table(lines), *find_misses(lines), sep="\n")


if __name__ == "__main__":
    main()
