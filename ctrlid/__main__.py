"""The command ``ctrlid``, also ``python -m ctrlid``: demonstrations and ``diagnose``."""

import argparse
import codecs
import inspect
import io
import itertools
import math
import os
import re
import sys
import textwrap
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TextIO

from tqdm import tqdm

import ctrlid

from . import __version__
from ._base.errors import CtrlidError, CtrlidWarning
from ._base.files import replace_file
from .diagnosis import Diagnosis
from .reporting import plot
from .reporting.cli.demo_diagnosis import TITLES as SECOND
from .reporting.cli.demo_diagnosis import tell_diagnosis
from .reporting.cli.demo_identification import TITLES, tell_identification
from .reporting.cli.diagnose_command import INTERRUPTED, add_parser, make_folder
from .reporting.cli.options import name_options
from .reporting.html_page import Section, write_report
from .reporting.plot.axes import off_screen
from .reporting.tables import Table

FOLDER = "ctrlid-report"
# What the story is told with where no option says otherwise.
STORY: dict[str, Any] = {"output": None, "seed": 1, "samples": 45_000, "noise": 0.1}
NEGATIVE = re.compile(r"-\.?\d")
# The story can be told with at least so many samples.
FEWEST = 500
# Paragraphs are wrapped at so many characters.
WIDTH = 88
# Signs of the reports, for terminals whose encoding lacks them.
PLAIN = {
    "±": "+-", "−": "-", "·": "*", "×": "x", "≤": "<=", "≥": ">=", "²": "^2", "³": "^3", "°": "deg",
    "µ": "u", "μ": "u", "–": "-", "—": "-", "…": "...", "√": "sqrt",
}  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command.

    Parameters
    ----------
    arguments : sequence of str, optional
        By default those of the command line.

    Returns
    -------
    int
        0; 1 after a refusal, which is on stderr in one line; 130 after Ctrl-C. A wrong usage exits
        with 2.
    """
    for stream in (sys.stdout, sys.stderr):
        # A terminal that has no sign for plus or minus is no reason to lose a result.
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="ctrlid")
    parser = _make_parser()
    words = sys.argv[1:] if arguments is None else list(arguments)
    if words and (advice := _name_python_line(*words[:2])):
        parser.error(advice)
    args, unknown = parser.parse_known_args(_join_negatives(words))
    if unknown:
        advice = ""
        if all("=" in word and not word.startswith("-") for word in unknown):
            advice = (
                ". The names of --columns and those of --units are one word, with commas between "
                "them or in quotes: --columns r=ref,u=volt,y=gap"
            )
        parser.error(f"unrecognized arguments: {' '.join(unknown)}{advice}")
    foreign = [k for k in STORY if getattr(args, k) is not None and args.run is not _tell_stories]
    if foreign:
        parser.error(f"--{foreign[0]} belongs to the demonstration, and no command takes it; "
                     "ctrlid diagnose writes its files into the folder of --save")  # fmt: skip
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _show_warning
            code: int = args.run(args)
        sys.stdout.flush()
    except CtrlidError as refusal:  # The command says any refusal in one line.
        print(f"ctrlid: {' '.join(str(refusal).split())}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("ctrlid: interrupted", file=sys.stderr)
        return INTERRUPTED
    # The reader of the output, such as `head`, has seen enough.
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    return code


def _join_negatives(words: list[str]) -> list[str]:
    """Return the words with negative numbers joined to their options.

    By itself, -5e-4 is an option for argparse.
    """
    joined: list[str] = []
    for word in words:
        option = joined[-1] if joined else ""
        if NEGATIVE.match(word) and option.startswith("--") and "=" not in option:
            joined[-1] += f"={word}"
        else:
            joined.append(word)
    return joined


def _name_python_line(word: str, file: str = "log.csv") -> str:
    """Say which line of Python does what is no command but a function; empty for other words."""
    function = getattr(ctrlid, word, None) if word in ctrlid.__all__ else None
    if word == "diagnose" or not inspect.isfunction(function):
        return ""
    parameters = inspect.signature(function).parameters.values()
    plain = [p for p in parameters if p.kind is p.POSITIONAL_OR_KEYWORD]
    # An audit says more with a loop.
    needed = [p.name for p in plain if p.default is p.empty or word == "audit"]
    lines = ["import ctrlid as cid"]
    if "record" in needed:
        file = "log.csv" if file.startswith("-") else file
        lines.append(f'record = cid.Record.from_csv("{file}", r="ref", u="volt", y="gap")')
    if "loop" in needed:
        period = "record.dt" if "record" in needed else "0.001"
        lines.append(f"loop = cid.Loop(plant, controller, dt={period})")
    lines.append(f"print(cid.{word}({', '.join(needed)}))")
    return (
        f"there is no command {word}, only diagnose; without a command the demonstration runs. "
        f"In Python it is: {'; '.join(lines)}"
    )


def _show_warning(
    message: Warning | str, category: type[Warning], filename: str, lineno: int,
    file: TextIO | None = None, line: str | None = None,
) -> None:  # fmt: skip
    """Print a warning of ctrlid as a refusal is printed, without the line of code it comes from."""
    if not issubclass(category, CtrlidWarning):
        shown = warnings.formatwarning(message, category, filename, lineno, line)
        (file or sys.stderr).write(shown)
        return
    print(f"ctrlid: {' '.join(name_options(str(message)).split())}", file=sys.stderr)


def _spell_out(error: UnicodeError) -> tuple[str, int]:
    """Replace signs that an encoding lacks by plain ones."""
    assert isinstance(error, UnicodeEncodeError)
    signs = error.object[error.start : error.end]
    return "".join(PLAIN.get(sign, "?") for sign in signs), error.end


codecs.register_error("ctrlid", _spell_out)


def _make_parser() -> argparse.ArgumentParser:
    """Return the parser; without a command the story is told."""
    parser = argparse.ArgumentParser(
        prog="ctrlid",
        description="Identify an unstable plant in closed loop: physics, lead controller, "
        "experiment, plain and constrained fit, comparison, and a redesign tried on the physics. "
        "Then find what a model lacks: the seed draws an effect and hides it in a record, and the "
        "diagnosis has to find it. Results are printed; figures and report.html are written to a "
        "new folder.",
    )
    parser.add_argument("--version", action="version", version=f"ctrlid {__version__}")
    parser.add_argument(
        "--seed",
        type=_parse_natural,
        help=f"seed of the reference, the noise and the hidden effect (default: {STORY['seed']})",
    )
    parser.add_argument(
        "--samples",
        type=_parse_samples,
        metavar="N",
        help=f"samples of the experiment (default: {STORY['samples']})",
    )
    parser.add_argument("--noise", type=_parse_share, metavar="SHARE",
                        help="standard deviation of the sensor noise, as a share of the jump "
                        f"of the reference (default: {STORY['noise']})")  # fmt: skip
    parser.add_argument("--output", type=Path, metavar="DIR",
                        help=f"folder for figures and report (default: {FOLDER}, with a number "
                        "if it exists)")  # fmt: skip
    parser.add_argument("--quiet", action="store_true", help="do not show the progress")
    add_parser(parser.add_subparsers(title="commands", metavar="COMMAND"))
    parser.set_defaults(run=_tell_stories)
    return parser


def _parse_natural(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"needs a whole number >= 0; given {text}")
    return int(text)


def _parse_samples(text: str) -> int:
    if not text.isdecimal() or int(text) < FEWEST:
        raise argparse.ArgumentTypeError(f"needs at least {FEWEST} samples; given {text}")
    return int(text)


def _parse_share(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value >= 0):
        raise argparse.ArgumentTypeError(f"needs a share >= 0, such as 0.1; given {text}")
    return value


def _tell_stories(args: argparse.Namespace) -> int:
    given = {k: v for k in STORY if (v := getattr(args, k)) is not None}
    wanted = STORY | given
    folder = make_folder(wanted.pop("output"), "--output", FOLDER)
    sections = []
    first = tell_identification(**wanted)
    second = tell_diagnosis(samples=wanted["samples"], seed=wanted["seed"])
    chapters = itertools.chain(first, second)
    titles = (*TITLES, *SECOND)
    try:
        # With disable=None the bar is silent where stderr is no terminal.
        with tqdm(total=len(titles), disable=args.quiet or None, leave=False, unit="step") as bar:
            for number, title in enumerate(titles, 1):
                bar.set_description(title)
                with off_screen():
                    section = _save_figures(next(chapters), number, folder)
                # Terminal, report and names of the files count the chapters alike.
                section = replace(section, title=f"{number}. {section.title}")
                sections.append(section)
                with tqdm.external_write_mode():
                    print(_write_text(section))
                bar.update()
        title = "An unstable plant, identified and diagnosed in closed loop"
        report = write_report(sections, folder / "report.html", title=title)
    except BaseException:
        if not any(folder.iterdir()):
            folder.rmdir()
        raise
    pictures = len(list(folder.glob("*.png")))
    print(f"{pictures} figures and {report.name} are in {folder}{os.sep}")
    return 0


def _save_figures(section: Section, number: int, folder: Path) -> Section:
    """Write the figures of a section as files; the section keeps their bytes for the report."""
    figures = {caption: plot.png(figure) for caption, figure in section.figures.items()}
    several = len(figures) > 1
    for letter, (caption, data) in zip("abcdefgh", figures.items(), strict=False):
        words = caption if several else section.title
        slug = re.sub(r"[^a-z]+", "-", words.lower()).strip("-")
        name = f"{number:02}{letter if several else ''}-{slug}.png"
        with replace_file(folder / name, binary=True) as file:
            file.write(data)
    return replace(section, figure=figures)


def _write_text(section: Section) -> str:
    lines = [section.title]
    for paragraph in filter(None, section.text.split("\n\n")):
        lines += [textwrap.fill(paragraph, WIDTH, break_on_hyphens=False), ""]
    results = section.result if isinstance(section.result, tuple) else (section.result,)
    for table in results:
        if isinstance(table, Table):
            lines += [textwrap.indent(str(table), "    "), ""]
        if isinstance(table, Diagnosis):
            lines += [str(table), ""]
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
