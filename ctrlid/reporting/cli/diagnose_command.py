"""The command ``ctrlid diagnose``: a CSV file and a model in words, and the report."""

import argparse
import itertools
import os
import sys
from pathlib import Path
from typing import Any

from ..._base.errors import CtrlidError
from ...diagnosis import diagnose
from .. import plot
from ..html_page import write_report
from .arguments import PLANTS, parse_assignment, parse_assignments, read_loop, read_record

EPILOG = """\
example: a levitated ball was logged in log.csv with the columns time [s], ref [m], volt [V] and
gap [m]; the magnet constant K is known to 10 % only, the controller is a sampled PID:

  ctrlid diagnose log.csv --columns r=ref,u=volt,y=gap --model maglev \\
      --param m=0.0213 K=3.3e-6 --free K --at-output 0.012 \\
      --controller kp=-1200,kd=-20,bias=3.0 --save found

It prints what the model lacks, and found/ holds the report, its picture and the diagnosis as a
file that ctrlid.load_diagnosis() reads. For a plant of your own write plant.py with a
control.nlsys called ball, or with a whole ctrlid.Loop, and give --model plant.py:ball.
"""


def add_parser(commands: Any) -> None:
    """Add ``diagnose`` to the commands.

    Parameters
    ----------
    commands : object
        What ``ArgumentParser.add_subparsers`` returned.
    """
    parser = commands.add_parser(
        "diagnose", help="find what a model lacks that a measured record has",
        description="Find the physics that a model lacks and a measured record shows.",
        epilog=EPILOG, formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    add = parser.add_argument
    add("file", type=Path, metavar="FILE.csv", help="record: columns for u and y, better also r")
    add("--model", required=True, metavar="MODEL",
        help=f"{', '.join(PLANTS)}, or MODULE:NAME or FILE.py:NAME of a control system, of a "
        "ctrlid.Loop, or of a function that returns one")  # fmt: skip
    add(
        "--param",
        type=parse_assignment,
        nargs="+",
        action="extend",
        default=[],
        metavar="NAME=VALUE",
        help="parameters of the model, in SI units",
    )
    add("--free", nargs="*", metavar="NAME",
        help="parameters that are uncertain and recalibrated first; by default "
        + ", ".join(f"{' and '.join(v)} of {k}" for k, v in PLANTS.items()))  # fmt: skip
    add("--at-output", type=float, metavar="Y", help="operating point; by default the mean of y")
    add("--input-bias", type=float, metavar="U",
        help="what the controller adds to u; by default what holds the model at rest")  # fmt: skip
    add("--dt", type=float, metavar="S", help="sampling period; by default of the time column")
    add("--columns", type=parse_assignments, default={}, metavar="r=REF,u=VOLT,y=GAP",
        help="names of the columns for r, u, y and time")  # fmt: skip
    add("--controller", metavar="C",
        help="as for --model, or a PID as in kp=..,ki=..,kd=..; by default unknown")  # fmt: skip
    add("--hold", choices=("zoh", "foh"),
        help="u between samples: held (default), or straight, as of an analog circuit")  # fmt: skip
    add("--gaps", choices=("error", "mask"), default="error",
        help="missing samples: refuse the file (default), or leave them out")  # fmt: skip
    add("--validation", type=Path, metavar="FILE2.csv",
        help="a second record, to show the gap on; by default a part of the first")  # fmt: skip
    add("--jobs", type=int, default=None, metavar="N", help="processor cores to use")
    add("--save", type=Path, metavar="DIR", help="new folder for report, picture and diagnosis")
    add("--quiet", action="store_true", help="no progress on the terminal")
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
        0.
    """
    record = read_record(args.file, args)
    loop = read_loop(args, record)
    settings: dict[str, Any] = {} if args.jobs is None else {"jobs": args.jobs}
    if args.validation is not None:
        settings["validation"] = read_record(args.validation, args)
    folder = None if args.save is None else make_folder(args.save, "--save")
    try:
        found = diagnose(loop, record, progress=not args.quiet and sys.stderr.isatty(), **settings)
    except BaseException:
        if folder is not None:
            folder.rmdir()
        raise
    sys.stdout.write(f"{found}\n")
    if folder is not None:
        found.save(folder / "diagnosis.json")
        (folder / "diagnosis.png").write_bytes(plot.png(plot.diagnosis(found)))
        (folder / "report.txt").write_text(f"{found}\n", encoding="utf-8")
        write_report(found, folder / "report.html")
        files = "report.html, report.txt, diagnosis.png and diagnosis.json"
        sys.stdout.write(f"{files} are in {folder}{os.sep}\n")
    return 0


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
