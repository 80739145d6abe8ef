"""The way of a record through `fit_loop`: which functions it passes, and how often it turns back.

Run it as ``python benchmarks/record_path.py``; ``--list`` names the functions in the order in which
they are entered first, as one would read them. One small simulated record is fitted under a
profiler. Counted are

- the distinct functions of ctrlid that are entered, and the files that they stand in; and of
  these the ones that are handed the record itself, or what is made of it for the filter;
- along that order, how often the next function stands in another file, and how often in one
  higher up in the layers that ``[tool.importlinter]`` declares: there a reader turns back;
- the distinct calls from one function to another in another file, and how many of these go up:
  no import does, but a callback or a method of an object that was handed down may.

Numpy's and Python's own frames in between are passed over.
"""

from __future__ import annotations

import argparse
import itertools
import re
import sys
import threading
import tomllib
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import ctrlid as cid

PACKAGE = Path(cid.__file__).parent
RECORDS = {"Record", "FilterData"}  # types of a record along its way
Function = tuple[str, str]  # module below ctrlid, qualified name


def read_layers() -> dict[str, dict[str, int]]:
    """Return the layer of each child, 0 for the highest, by the package that declares its order."""
    text = (PACKAGE.parent / "pyproject.toml").read_text("utf-8")
    ranks = {}
    for contract in tomllib.loads(text)["tool"]["importlinter"]["contracts"]:
        for container in contract.get("containers", ()):
            ranks[container] = {
                name.strip(): k
                for k, layer in enumerate(contract["layers"])
                for name in re.split(r"[|:]", layer)
            }
    return ranks


def goes_up(caller: str, callee: str, ranks: dict[str, dict[str, int]]) -> bool:
    """Whether the called module stands in a higher layer, where their ways through rooms part."""
    room = "ctrlid"
    for a, b in zip(caller.split("."), callee.split("."), strict=False):
        known = ranks.get(room, {})
        if a != b:
            return a in known and b in known and known[b] < known[a]
        room = f"{room}.{a}"
    return False


def name_function(code: CodeType) -> Function | None:
    """Return module and name of a function of ctrlid; None for what is not ctrlid's."""
    path = Path(code.co_filename)
    if not path.is_relative_to(PACKAGE) or code.co_name == "<module>":
        return None
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    # An expression in brackets belongs to the function that it stands in.
    name = re.sub(r"(\.<locals>)?\.<(genexpr|listcomp|dictcomp|setcomp|lambda)>", "",
                  code.co_qualname)  # fmt: skip
    return ".".join(parts), name


def gets_record(frame: FrameType) -> bool:
    """Whether a record, or a sequence of records, is among the arguments of a call."""
    code = frame.f_code
    names = code.co_varnames[: code.co_argcount + code.co_kwonlyargcount]
    given = [frame.f_locals.get(name) for name in names]
    parts = [part for v in given if isinstance(v, list | tuple) for part in v[:1]]
    return any(type(v).__name__ in RECORDS for v in (*given, *parts))


def trace_calls(run: Any) -> tuple[list[tuple[Function | None, Function]], list[Function]]:
    """Return the calls between functions of ctrlid while something runs, and who gets a record.

    Each once, in the order in which they come first.
    """
    calls: dict[tuple[Function | None, Function], None] = {}
    handed: dict[Function, None] = {}

    def note(frame: FrameType, event: str, _: Any) -> None:
        callee = name_function(frame.f_code) if event == "call" else None
        if callee is None:
            return
        above, caller = frame.f_back, None
        while above is not None and caller is None:
            caller, above = name_function(above.f_code), above.f_back
        calls[caller, callee] = None
        if gets_record(frame):
            handed[callee] = None

    threading.setprofile(note)
    sys.setprofile(note)
    try:
        run()
    finally:
        sys.setprofile(None)
        threading.setprofile(None)
    return list(calls), list(handed)


def main() -> None:
    """Fit one record of a levitated ball and count."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--list", action="store_true", help="name the functions in their order")
    listed = parser.parse_args().list
    plant = cid.plants.maglev(m=0.0213, K=3.34e-6)
    at = cid.operating_point(plant, output=0.012)
    lead = cid.design_lead(cid.linearize(plant, at), crossover=100, phase_margin=50)
    loop = cid.Loop(plant, lead.sample(0.001, "tustin"), dt=0.001, at=at, free=("K",))
    r = cid.random_binary(1000, amplitude=1e-4, hold=20, around=at.output, seed=1)
    record = cid.simulate(loop, r, sensor_noise=2e-6, seed=2)
    start = loop.with_parameters({"K": 3.1e-6})
    calls, handed = trace_calls(lambda: cid.fit_loop(start, record))
    ranks = read_layers()
    functions = list(dict.fromkeys(callee for _, callee in calls))
    across = [(a[0], b[0]) for a, b in calls if a is not None and a[0] != b[0]]
    up = [pair for pair in across if goes_up(*pair, ranks)]
    if listed:
        for above, here in itertools.pairwise([functions[0], *functions]):
            mark = "back up to" if goes_up(above[0], here[0], ranks) else ""
            print(f"{mark:<11}{'.'.join(here)}{' (record)' if here in handed else ''}")
    for label, way in (("functions of ctrlid entered", functions),
                       ("functions handed the record", handed)):  # fmt: skip
        turns = [(a, b) for (a, _), (b, _) in itertools.pairwise(way) if a != b]
        back = [pair for pair in turns if goes_up(*pair, ranks)]
        print(f"{label:<42}{len(way):>4}")
        print(f"  files that they stand in                {len({m for m, _ in way}):>4}")
        print(f"  turns to another file, in reading order {len(turns):>4}")
        print(f"  of these, back up                       {len(back):>4}")
    print(f"calls that cross files                    {len(across):>4}")
    print(f"  of these, up                            {len(up):>4}")


if __name__ == "__main__":
    main()
