"""The way of a record through `fit_loop`: which functions it passes, and how often it turns back.

Run it as ``python benchmarks/record_path.py``; ``--calls`` lists the calls that cross files. One
small simulated record is fitted under a profiler. Counted are distinct functions of ctrlid that
are entered, the files that they stand in, and distinct calls (from one function to another) that
cross files. A call goes back up if what it calls stands higher than its caller in the layers that
``[tool.importlinter]`` declares: no import does, but a callback or a method of an object that was
handed down may. Returning does not count, nor do numpy's and Python's own frames in between.
"""

from __future__ import annotations

import argparse
import re
import sys
import threading
import tomllib
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import ctrlid as cid

PACKAGE = Path(cid.__file__).parent
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


def trace_calls(run: Any) -> set[tuple[Function | None, Function]]:
    """Return the distinct calls between functions of ctrlid while something runs."""
    calls: set[tuple[Function | None, Function]] = set()

    def note(frame: FrameType, event: str, _: Any) -> None:
        callee = name_function(frame.f_code) if event == "call" else None
        if callee is None:
            return
        above, caller = frame.f_back, None
        while above is not None and caller is None:
            caller, above = name_function(above.f_code), above.f_back
        calls.add((caller, callee))

    threading.setprofile(note)
    sys.setprofile(note)
    try:
        run()
    finally:
        sys.setprofile(None)
        threading.setprofile(None)
    return calls


def main() -> None:
    """Fit one record of a levitated ball and count."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--calls", action="store_true", help="list the calls that cross files")
    listed = parser.parse_args().calls
    plant = cid.plants.maglev(m=0.0213, K=3.34e-6)
    at = cid.operating_point(plant, output=0.012)
    lead = cid.design_lead(cid.linearize(plant, at), crossover=100, phase_margin=50)
    loop = cid.Loop(plant, lead.sample(0.001, "tustin"), dt=0.001, at=at, free=("K",))
    r = cid.random_binary(1000, amplitude=1e-4, hold=20, around=at.output, seed=1)
    record = cid.simulate(loop, r, sensor_noise=2e-6, seed=2)
    start = loop.with_parameters({"K": 3.1e-6})
    calls = trace_calls(lambda: cid.fit_loop(start, record))
    functions = {f for call in calls for f in call if f is not None}
    across = sorted((a, b) for a, b in calls if a is not None and a[0] != b[0])
    ranks = read_layers()
    up = [call for call in across if goes_up(call[0][0], call[1][0], ranks)]
    if listed:
        for (m1, f1), (m2, f2) in across:
            mark = "UP " if ((m1, f1), (m2, f2)) in up else "   "
            print(f"{mark}{m1}.{f1} -> {m2}.{f2}")
    print(f"functions of ctrlid entered   {len(functions)}")
    print(f"files that they stand in      {len({module for module, _ in functions})}")
    print(f"calls                         {len([c for c in calls if c[0] is not None])}")
    print(f"calls that cross files        {len(across)}")
    print(f"of these, back up             {len(up)}")


if __name__ == "__main__":
    main()
