"""Records, models and controllers as a command line names them."""

import argparse
import dataclasses
import importlib
import importlib.util
import inspect
import math
import os
import re
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import control as ct
import numpy as np

from ..._base.errors import CtrlidError
from ..._base.periods import differ_by_thousand, have_same_period, write_both_periods
from ..._base.text import list_known
from ...data.record import Record
from ...loop.controllers import PID
from ...loop.loop import Loop
from ...physics import plants
from ...physics.linearization import OperatingPoint, operating_point
from ...physics.trace import trace, with_parameters
from ...validation.controller_check import take_bias_from_log
from .options import options_in_refusals

PLANTS = {"maglev": ("K",), "servo": ("c", "k"), "tank": ("outlet", "k"), "pendulum": ("m",)}
CHANNELS = ("r", "u", "y", "time")
NEXT_NAME = re.compile(r"[,\s]+(?=\w+\s*=)")
DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+(?:[eE][+-]?\d+)?")
WHOLE = re.compile(r"\s*[+-]?(0|[1-9]\d*)\s*")
SYSTEMS = (ct.NonlinearIOSystem, ct.StateSpace, ct.TransferFunction)


def read_record(path: Path, args: argparse.Namespace) -> Record:
    """Return the record in a file, or say in the words of the command line what is wrong."""
    unknown = [key for key in args.columns if key not in CHANNELS]
    if unknown:
        raise CtrlidError(f"--columns takes {', '.join(CHANNELS)}, as in --columns u=volt,y=gap; "
                          f"given {unknown[0]}")  # fmt: skip
    with options_in_refusals():
        return Record.from_csv(
            path, dt=args.dt, hold=args.hold, gaps=args.gaps, units=args.units,
            scale=dict(args.scale), names=args.names, **args.columns,
        )  # fmt: skip


def read_loop(args: argparse.Namespace, record: Record) -> Loop:
    """Return the loop that the command line describes."""
    values = dict(args.param)
    model = read_plant(args.model, values)
    if isinstance(model, Loop):
        given = {"--at-output": args.at_output, "--input-bias": args.input_bias,
                 "--controller": args.controller}  # fmt: skip
        clash = [name for name, value in given.items() if value is not None]
        if clash:
            raise CtrlidError(f"{args.model} is a ctrlid.Loop, which has its own operating point "
                              f"and controller: leave out {', '.join(clash)}")  # fmt: skip
        if not have_same_period(model.dt, record.dt):
            advice = "give both the same period"
            if model.dt < record.dt and differ_by_thousand(model.dt, record.dt):
                advice = "if the times are in milliseconds, name their column t [ms]"
            both = write_both_periods(f"{args.model} is sampled", model.dt, "the record", record.dt)
            raise CtrlidError(f"{both}; {advice}")
        free = model.free if args.free is None else _join_names(args.free)
        _require_known(args.model, list(model.parameters), [*values, *free])
        return dataclasses.replace(model.with_parameters(values), free=free)
    free = PLANTS.get(args.model, ()) if args.free is None else _join_names(args.free)
    traced = trace(model)
    _require_known(args.model, list(traced.parameters), [*values, *free])
    model = with_parameters(model, values) if values else model
    output = _take_values("--at-output", args.at_output, traced.outputs)
    bias = _take_values("--input-bias", args.input_bias, traced.inputs)
    means = _take_means(record, "y", record.valid_outputs)
    # A linear model acts on deviations from the means of the record.
    if isinstance(model, ct.TransferFunction | ct.StateSpace):
        usual = _take_means(record, "u", record.valid_somewhere)
        at = OperatingPoint((), usual, means if output is None else output)
    elif output is None and isinstance(means, tuple):
        # A plant need not rest where the means of several outputs are.
        names = ", ".join(record.signals["y"])
        raise CtrlidError(f"the model has {len(means)} outputs ({names}), and where it rests is "
                          "not known: give --at-output with a value for each, as in --at-output "
                          f"{','.join(['0'] * len(means))}")  # fmt: skip
    else:
        with options_in_refusals():
            at = operating_point(model, output=means if output is None else output)
    if bias is not None:
        at = dataclasses.replace(at, input=bias)
    given_controller = None if args.controller is None else read_controller(args.controller)
    with options_in_refusals():
        loop = Loop(model, given_controller, dt=record.dt, at=at, free=free)
    return loop if args.input_bias is not None else take_bias_from_log(loop, record)


def _take_values(option: str, given: Sequence[float] | None, names: Sequence[str]) -> Any:
    """Return what an option gives for each signal, a number where there is one; None without."""
    if given is None:
        return None
    if len(given) != len(names):
        raise CtrlidError(f"{option} takes a number for each of {', '.join(names)}, with commas "
                          f"between them and decimal points; given {len(given)}")  # fmt: skip
    return tuple(given) if len(given) > 1 else given[0]


def _take_means(record: Record, key: str, counts: Any) -> Any:
    """Return the mean of each signal over the samples that count, a number where there is one."""
    rows = np.reshape(getattr(record, key), (-1, len(record)))
    each = zip(rows, np.broadcast_to(counts, rows.shape), strict=True)
    means = tuple(float(np.mean(row[use])) for row, use in each)
    return means if len(means) > 1 else means[0]


def read_plant(text: str, values: dict[str, float]) -> Any:
    """Return the system or loop that ``--model`` names; values that made it are taken out."""
    made = getattr(plants, text) if text in PLANTS else import_object("--model", text)
    if isinstance(made, (Loop, *SYSTEMS)):
        return made
    if not inspect.isfunction(made):
        raise CtrlidError(f"--model {text} is a {type(made).__name__}; needed is a python-control "
                          "system, a ctrlid.Loop, or a function that returns one")  # fmt: skip
    known = inspect.signature(made).parameters
    _require_known(text, list(known), list(values))
    rest = (inspect.Parameter.VAR_KEYWORD, inspect.Parameter.VAR_POSITIONAL)
    needed = {k for k, p in known.items() if p.default is p.empty and p.kind not in rest}
    lacking = [k for k in known if k in needed and k not in values]
    if len(known) in (3, 4) and list(known)[:3] == ["t", "x", "u"]:
        raise CtrlidError(f"--model {text} is a function of t, x and u, the update function of a "
                          f"system: wrap it, system = ct.nlsys({made.__name__}, output_function, "
                          "inputs=..., outputs=..., states=..., params=...), and name that, as in "
                          f"{text.rpartition(':')[0]}:system")  # fmt: skip
    if lacking:
        raise CtrlidError(f"the model {text} needs {', '.join(lacking)}; give them in SI units, as "
                          f"in --param {' '.join(f'{k}=...' for k in lacking)}")  # fmt: skip
    system = made(**values)
    values.clear()
    if not isinstance(system, (Loop, *SYSTEMS)):
        raise CtrlidError(f"--model {text} returns a {type(system).__name__}; needed is a "
                          "python-control system or a ctrlid.Loop")  # fmt: skip
    return system


def read_controller(text: str) -> Any:
    """Return the controller that ``--controller`` describes."""
    if "=" not in text:
        return import_object("--controller", text)
    types = {f.name: f.type for f in dataclasses.fields(PID)}
    values: dict[str, Any] = {}
    try:
        given = parse_assignments(text)
    except argparse.ArgumentTypeError as reason:
        raise CtrlidError(f"--controller {reason}") from reason
    for key, value in given.items():
        _require_known("a PID", list(types), [key])
        words = types[key] not in (float, float | None)
        plain = value if isinstance(value, str) else ",".join(value)
        values[key] = value if words else _parse_number(f"--controller {key}=", plain)
    if "kp" not in values:
        raise CtrlidError(f"a PID needs kp, as in --controller kp=2,ki=1; given {text}")
    return PID(**values)


def import_object(option: str, text: str) -> Any:
    """Return an object given as ``module:object`` or ``file.py:object``."""
    module, colon, name = text.rpartition(":")
    if not colon or not module or not name:
        known = f"one of {', '.join(PLANTS)}, " if option == "--model" else ""
        raise CtrlidError(f"{option} is {known}MODULE:NAME or FILE.py:NAME; given {text}")
    if module.endswith(".py") and not Path(module).is_file():
        raise CtrlidError(
            f"{option} {text}: {module} cannot be imported: there is no such file. Give a file, as "
            "in plant.py:ball, or a module that Python finds from here"
        )
    try:
        found = _run_file(Path(module)) if module.endswith(".py") else _import_module(module)
    except ModuleNotFoundError as reason:
        cure = "Give a file, as in plant.py:ball, or a module that Python finds from here"
        if module.endswith(".py") or reason.name != module.partition(".")[0]:
            cure = "It is imported there: install it, or put it beside the file"
        raise CtrlidError(
            f"{option} {text}: {module} cannot be imported: {reason}. {cure}"
        ) from reason
    except Exception as reason:
        raise CtrlidError(f"{option} {text}: {_explain_run(module, reason)}") from reason
    if not hasattr(found, name):
        systems = [k for k, v in vars(found).items() if isinstance(v, (Loop, *SYSTEMS))]
        raise CtrlidError(f"{option} {text}: {module} has no {name}; its python-control "
                          f"systems and loops are {', '.join(systems) or 'none'}")  # fmt: skip
    return getattr(found, name)


def _run_file(path: Path) -> Any:
    """Return the module that a file makes, run as Python runs it: it finds its neighbours.

    Dataclasses look for their module while it runs. Afterwards it is not among the modules, so that
    its functions go to other processes by value.
    """
    spec = importlib.util.spec_from_file_location(f"ctrlid_model_{path.stem}", path)
    assert spec is not None
    assert spec.loader is not None
    found = importlib.util.module_from_spec(spec)
    folder = str(path.resolve().parent)
    if folder not in sys.path:
        sys.path.insert(0, folder)
    sys.modules[spec.name] = found
    try:
        spec.loader.exec_module(found)
    finally:
        del sys.modules[spec.name]
    return found


def _import_module(name: str) -> Any:
    """Return a module that Python finds from here."""
    if not {"", os.getcwd()} & set(sys.path):
        sys.path.insert(0, os.getcwd())
    return importlib.import_module(name)


def _explain_run(module: str, reason: Exception) -> str:
    """Say in one line what a user's file does wrong, and at which of its own lines."""
    frames = traceback.extract_tb(reason.__traceback__)
    own = [f for f in frames if Path(f.filename).name == Path(module).name] or frames
    words, line = " ".join(str(reason).split()), own[-1].lineno
    if isinstance(reason, SyntaxError):
        words, line = reason.msg, reason.lineno
    run = module if module.endswith(".py") else f"-m {module}"
    return (f"{module} cannot be run: {type(reason).__name__}: {words} (line {line}). Run it by "
            f"itself, python {run}, until it does")  # fmt: skip


def _join_names(given: Sequence[Sequence[str]]) -> tuple[str, ...]:
    """Return the names of an option whose words may hold several with commas between them."""
    return tuple(name for names in given for name in names)


def _require_known(what: str, known: Sequence[str], names: Sequence[str]) -> None:
    for name in names:
        if name not in known:
            raise CtrlidError(f"{what} has no parameter {name!r}; {list_known(name, known)}")


def parse_assignment(text: str) -> tuple[str, float]:
    """Read NAME=VALUE with a number."""
    name, equal, value = text.partition("=")
    if "," in value and "=" in value:
        raise argparse.ArgumentTypeError(
            "takes several with blanks between them, as in "
            f"{' '.join(NEXT_NAME.split(text))}; given {text}"
        )
    if not (name.strip() and equal):
        raise argparse.ArgumentTypeError(f"needs NAME=VALUE, as in K=3.3e-6; given {text}")
    try:
        return name.strip(), _parse_number(f"{name}=", value)
    except CtrlidError as reason:  # argparse prints what it is told in its own error alone.
        raise argparse.ArgumentTypeError(str(reason)) from reason


def parse_assignments(text: str) -> dict[str, str | tuple[str, ...]]:
    """Read NAME=VALUE,NAME=VALUE, or NAME=VALUE,VALUE NAME=VALUE where a name has several."""
    parts: list[str] = []
    for part in filter(str.strip, NEXT_NAME.split(text)):
        # A name may have blanks in it: what has no value yet goes on.
        if parts and "=" not in parts[-1]:
            parts[-1] += f" {part}"
        else:
            parts.append(part)
    pairs = [part.partition("=") for part in parts]
    if not pairs or not all(key.strip() and equal and value for key, equal, value in pairs):
        raise argparse.ArgumentTypeError(f"needs NAME=VALUE,NAME=VALUE; given {text}")
    values = {
        key.strip(): tuple(v.strip() for v in value.split(",") if v.strip())
        for key, _, value in pairs
    }
    return {key: each[0] if len(each) == 1 else each for key, each in values.items()}


class MergePairs(argparse.Action):
    """Keep the pairs of an option that is given more than once."""

    def __call__(
        self, parser: argparse.ArgumentParser, namespace: argparse.Namespace, values: Any,
        option_string: str | None = None,
    ) -> None:  # fmt: skip
        """Add the pairs to those that were given before."""
        del parser, option_string
        setattr(namespace, self.dest, {**getattr(namespace, self.dest), **values})


def parse_decimal(text: str) -> float:
    """Read a number that is the value of an option."""
    try:
        return _parse_number("it", text)
    except CtrlidError as reason:  # argparse prints what it is told in its own error alone.
        raise argparse.ArgumentTypeError(str(reason)) from reason


def parse_decimals(text: str) -> tuple[float, ...]:
    """Read NUMBER or NUMBER,NUMBER; what looks like one with a decimal comma is refused."""
    parts = text.split(",")
    if DECIMAL_COMMA.fullmatch(text.strip()) and not all(map(WHOLE.fullmatch, parts)):
        parts = [text]
    return tuple(parse_decimal(part) for part in parts)


def parse_names(text: str) -> list[str]:
    """Read NAME or NAME,NAME."""
    return [name.strip() for name in text.split(",") if name.strip()]


def _parse_number(what: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if DECIMAL_COMMA.fullmatch(text.strip()):
        raise CtrlidError(
            f"{what} needs a number with a decimal point; given {text}: type "
            f"{text.strip().replace(',', '.')}"
        )
    if math.isnan(value):
        raise CtrlidError(f"{what} needs a number; given {text}")
    return value
