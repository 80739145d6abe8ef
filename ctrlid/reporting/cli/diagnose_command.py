"""The command ``ctrlid diagnose``: a CSV file and a model in words, and the report."""

import argparse
import itertools
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from ..._base.errors import CtrlidError
from ..._base.files import replace_file
from ..._base.interruption import Budget
from ...diagnosis import Diagnosis, diagnose
from .. import plot
from ..html_page import write_report
from ..plot.axes import off_screen
from .arguments import (
    PLANTS,
    MergePairs,
    parse_assignment,
    parse_assignments,
    parse_decimal,
    parse_decimals,
    parse_names,
    read_loop,
    read_record,
)
from .options import options_in_refusals

# The exit status of a command that Ctrl-C ended, by the convention of shells.
INTERRUPTED = 128 + signal.SIGINT
STOPPING = b"\nctrlid: writing the answer so far; Ctrl-C again gives it up\n"
EPILOG = """\
example: a levitated ball was logged in log.csv with the columns time [s], ref [m], volt [V] and
gap [m]. The magnet constant K is known only to 10 %, and the controller is a sampled PID:

  ctrlid diagnose log.csv --columns r=ref,u=volt,y=gap --model maglev \\
      --param m=0.0213 K=3.3e-6 --free K --at-output 0.012 \\
      --controller kp=-1200,kd=-20,bias=3.0 --save found

It prints what the model lacks. The folder found/ then holds the report, its picture and the
diagnosis as a file that ctrlid.load_diagnosis() reads. For a plant of your own, write a file
plant.py with a control.nlsys system or a whole ctrlid.Loop called ball, and give
--model plant.py:ball.
"""


def add_parser(commands: Any) -> None:
    """Add ``diagnose`` to the commands.

    Parameters
    ----------
    commands : object
        What ``ArgumentParser.add_subparsers`` returned.
    """
    parser = commands.add_parser(
        "diagnose", help="find the physics that a model lacks, from a measured record",
        description="Find the physics that a model lacks, from a measured record.",
        epilog=EPILOG, formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    add = parser.add_argument
    add(
        "file",
        type=Path,
        metavar="FILE.csv",
        help="file of the record, with columns for u, y and, if possible, r",
    )
    add("--model", required=True, metavar="MODEL",
        help=f"one of {', '.join(PLANTS)}; or MODULE:NAME or FILE.py:NAME, where NAME is a "
        "python-control system, a ctrlid.Loop, or a function that returns one; the file is run as "
        "a Python program, so give only one that you trust")  # fmt: skip
    add(
        "--param",
        type=parse_assignment,
        nargs="+",
        action="extend",
        default=[],
        metavar="NAME=VALUE",
        help="parameters of the model, in SI units",
    )
    add("--free", nargs="*", type=parse_names, metavar="NAME",
        help="uncertain parameters of the model, which are fitted first, as in --free K m or "
        "--free K,m (default: "
        + ", ".join(f"{' and '.join(v)} of {k}" for k, v in PLANTS.items()) + ")")  # fmt: skip
    add("--at-output", type=parse_decimals, metavar="Y",
        help="output at the operating point, of several outputs each, as in 0.1,0 (default: the "
        "mean of y)")  # fmt: skip
    add("--input-bias", type=parse_decimals, metavar="U",
        help="bias that the controller adds to u (default: as the log has it where the controller "
        "is known, else the input that holds the model at rest)")  # fmt: skip
    add("--dt", type=parse_decimal, metavar="S",
        help="sampling period in seconds (default: that of the time column)")  # fmt: skip
    add("--columns", type=parse_assignments, action=MergePairs, default={},
        metavar="r=REF,u=VOLT,y=GAP",
        help="columns of r, u, y and time; several as in 'y=theta,alpha u=V'")  # fmt: skip
    add("--units", type=parse_assignments, action=MergePairs, default={}, metavar="y=UNIT,u=UNIT",
        help="units of the channels r, u and y, or of single columns, instead of those in the "
        "header")  # fmt: skip
    add("--scale", type=parse_assignment, nargs="+", action="extend", default=[],
        metavar="NAME=FACTOR",
        help="factors of the channels r, u and y, or of single columns: y=0.0174533 r=0.0174533 "
        "makes radians of degrees; say the new unit with --units")  # fmt: skip
    add(
        "--names",
        type=parse_assignments,
        action=MergePairs,
        default={},
        metavar="COLUMN=NAME",
        help="what the model calls the signals of columns, as in --names Ball=x,Wippe=theta",
    )
    add("--controller", metavar="C",
        help="the controller: MODULE:NAME, FILE.py:NAME, or a PID written as "
        "kp=..,ki=..,kd=.. (default: not known)")  # fmt: skip
    add("--hold", choices=("zoh", "foh", "bandlimited"),
        help="u between the samples: zoh for held (default), foh for straight lines, as an analog "
        "controller makes them, bandlimited for a measured signal that does not react to "
        "y")  # fmt: skip
    add("--gaps", choices=("error", "mask"), default="error",
        help="missing samples: error to refuse the file (default), mask to leave them "
        "out")  # fmt: skip
    add("--validation", type=Path, metavar="FILE2.csv",
        help="a second record, on which model and data are compared (default: the last quarter "
        "of the first)")  # fmt: skip
    add(
        "--jobs",
        type=int,
        default=None,
        metavar="N",
        help="number of processor cores to use (default: 1)",
    )
    add(
        "--save",
        type=Path,
        metavar="DIR",
        help="new folder for the report, its picture and the diagnosis",
    )
    add("--seconds", type=parse_decimal, metavar="S",
        help="end the search after so many seconds with the best answer so far (default: when it "
        "is finished). Ctrl-C does the same at once")  # fmt: skip
    # Without a default, what was given before the command stays.
    add("--quiet", action="store_true", default=argparse.SUPPRESS,
        help="show no progress on the terminal")  # fmt: skip
    parser.set_defaults(run=run_diagnosis)


def run_diagnosis(args: argparse.Namespace) -> int:
    """Diagnose a file as the command line says, and print the report.

    Parameters
    ----------
    args : argparse.Namespace
        The arguments.

    Returns
    -------
    int
        0; 130 if Ctrl-C ended the search, whose answer so far is printed and saved.
    """
    record = read_record(args.file, args)
    loop = read_loop(args, record)
    given = {"jobs": args.jobs, "seconds": args.seconds}
    settings: dict[str, Any] = {k: v for k, v in given.items() if v is not None}
    if args.validation is not None:
        settings["validation"] = read_record(args.validation, args)
    own = args.save is not None and args.save.is_dir()
    folder = None if args.save is None else make_folder(args.save, "--save")
    try:
        with _stop_on_interrupt() as budget, options_in_refusals():
            found = diagnose(loop, record, progress=not args.quiet, **settings)
    except BaseException:
        if folder is not None and not own:
            folder.rmdir()
        raise
    # What took minutes to find is saved before a terminal can refuse to show it, and shown even
    # where it cannot be saved.
    where = ""
    try:
        where = "" if folder is None else _save_files(found, folder)
    finally:
        sys.stdout.write(f"{found}\n{where}")
    return INTERRUPTED if budget.asked else 0


def _save_files(found: Diagnosis, folder: Path) -> str:
    """Write all that is kept of a diagnosis into a folder, and say so."""
    try:
        found.save(folder / "diagnosis.json")
        with replace_file(folder / "report.txt") as file:
            file.write(f"{found}\n")
        with off_screen(), replace_file(folder / "diagnosis.png", binary=True) as file:
            file.write(plot.png(plot.diagnosis(found)))
        write_report(found, folder / "report.html")
    except OSError as reason:
        raise CtrlidError(f"not all of the answer is saved in {folder}: {reason}. It is in the "
                          "report on the terminal; keep that") from reason  # fmt: skip
    files = "report.html, report.txt, diagnosis.png and diagnosis.json"
    return f"{files} are in {folder}{os.sep}\n"


@contextmanager
def _stop_on_interrupt() -> Iterator[Budget]:
    """Let the first Ctrl-C end a search with its answer so far, and the second one the command."""
    budget = Budget()

    def stop(number: int, frame: Any) -> None:
        if budget.asked:
            raise KeyboardInterrupt
        budget.stop()
        # A signal may come in the middle of a write to the same stream, which Python refuses.
        with suppress(OSError):
            os.write(2, STOPPING)

    # Only the main thread may say what a signal does.
    main = threading.current_thread() is threading.main_thread()
    before = signal.signal(signal.SIGINT, stop) if main else None
    try:
        with budget.running(binding=False):
            yield budget
    finally:
        if main:
            signal.signal(signal.SIGINT, before)


def make_folder(wanted: Path | None, option: str, default: str = "ctrlid-report") -> Path:
    """Make a folder; nothing that exists is touched.

    Parameters
    ----------
    wanted : Path or None
        What the user gave; None for `default` in the current directory, numbered if it exists.
    option : str
        The option it is given with.
    default : str, optional
        Name without the option.

    Returns
    -------
    Path
        The empty folder.

    Raises
    ------
    CtrlidError
        If it holds something or cannot be made.
    """
    try:
        if wanted is not None:
            wanted.mkdir(parents=True, exist_ok=True)
            if any(wanted.iterdir()):
                raise CtrlidError(f"{wanted} is not empty and nothing is overwritten; give "
                                  f"{option} a new folder")  # fmt: skip
            return wanted
        for number in itertools.count(1):
            folder = Path(default if number == 1 else f"{default}-{number}")
            try:
                folder.mkdir()
            except FileExistsError:
                continue
            return folder
    except OSError as reason:
        raise CtrlidError(f"cannot make a folder for the report: {reason}. Change to a directory "
                          f"that may be written to, or give {option}") from reason  # fmt: skip
    raise AssertionError("unreachable")
