"""write_report(): a result as one page that opens in any browser, without the network."""

import base64
import html
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .._base.arguments import check_arguments, check_fields, explain_names
from .._base.errors import CtrlidError
from .._base.files import replace_file
from .._base.text import is_bad_news
from ..data.record import Record
from ..design.controller_trial import ControllerTrial
from ..design.redesigning import Redesign
from ..diagnosis.result import Diagnosis
from ..estimation.identified_model import IdentifiedModel, IdentifiedSystem
from ..estimation.likelihood.physics_estimate import LoopFit
from ..validation.comparison import Comparison
from . import plot
from .plot.axes import BINS, off_screen
from .tables import Table, Title, make_blocks, write_heading

STYLE = """
:root { color-scheme: light dark; --ink: #1c1e21; --paper: #ffffff; --faint: #5b6168;
  --line: #d5d9de; --head: #eef1f4; --bad: #a33a00; }
@media (prefers-color-scheme: dark) { :root { --ink: #e6e8ea; --paper: #16181b; --faint: #a3aab2;
  --line: #3b4148; --head: #23272c; --bad: #ffab7a; } }
* { box-sizing: border-box; }
body { margin: 0; background: var(--paper); color: var(--ink);
  font: 1.02rem/1.55 system-ui, -apple-system, "Segoe UI", Roboto, "DejaVu Sans", sans-serif; }
main { max-width: 48rem; margin: 0 auto; padding: 2rem 1.2rem 4rem; }
h1 { font-size: 1.75rem; line-height: 1.25; margin: 0 0 1.5rem; }
h2 { font-size: 1.25rem; margin: 2.6rem 0 0.6rem; padding-top: 0.9rem;
  border-top: 1px solid var(--line); }
h3 { font-size: 1.05rem; margin: 1.8rem 0 0.4rem; }
p { margin: 0.6rem 0; overflow-wrap: anywhere; }
p.bad { color: var(--bad); font-weight: 600; }
.wide { overflow-x: auto; margin: 1rem 0; }
table { border-collapse: collapse; min-width: min(100%, 32rem); font-size: 0.92rem;
  font-variant-numeric: tabular-nums; }
caption { text-align: left; color: var(--faint); padding-bottom: 0.3rem; }
th, td { padding: 0.28rem 0.8rem; border-bottom: 1px solid var(--line); text-align: right;
  vertical-align: top; }
th:first-child, td:first-child { text-align: left; padding-left: 0.5rem; }
thead th { background: var(--head); font-weight: 600; }
tbody th { font-weight: 400; }
tbody th, td { white-space: nowrap; }
figure { margin: 1.2rem 0; }
figure img { display: block; width: 100%; height: auto; background: #ffffff; padding: 0.6rem;
  border: 1px solid var(--line); border-radius: 6px; }
figcaption { color: var(--faint); font-size: 0.92rem; margin-top: 0.4rem; }
footer { margin-top: 3rem; color: var(--faint); font-size: 0.85rem; }
@media print { :root { --ink: #000000; --paper: #ffffff; --faint: #444444; --line: #bbbbbb;
  --head: #eeeeee; --bad: #7a2b00; }
  body { font-size: 10.5pt; } main { max-width: none; padding: 0; }
  figure, table { break-inside: avoid; } h2 { margin-top: 1.6rem; }
  figure img { width: auto; max-width: 15cm; max-height: 21cm; }
  h2, h3 { break-after: avoid; } .wide { overflow: visible; }
  tbody th, td:last-child { white-space: normal; } }
"""


# So many samples of a long record are also drawn one by one.
CLOSE = 600
DIAGNOSIS = (
    "Output and errors where the gap is largest; normalized RMS of the one-step errors in bins of "
    "two quantities; the candidates by rounds of the search."
)


@dataclass(frozen=True, eq=False)
class Section:
    """One chapter of a report.

    Parameters
    ----------
    title : str
        Heading.
    text : str, optional
        Plain words; an empty line starts a new paragraph.
    result : object, optional
        A `Table`, `Record`, `IdentifiedModel`, `IdentifiedSystem`, `LoopFit`, `Comparison`,
        `Redesign`, `ControllerTrial` or `Diagnosis`, or a tuple of them.
    figure : object, optional
        A `plot.Picture`, a matplotlib figure or axes, or the bytes of a PNG file, or a mapping of
        such by caption. By default the pictures that belong to the result, an empty mapping for
        none.

    Examples
    --------
    >>> Section("Physics", "The ball hangs under a magnet.").title
    'Physics'
    """

    title: str
    text: str = ""
    result: Any = None
    figure: Any = None

    def __post_init__(self) -> None:
        check_fields(self)

    @property
    def figures(self) -> dict[str, Any]:
        """The figures by caption."""
        if self.figure is None:
            return {k: f for r in _as_tuple(self.result) for k, f in _draw_pictures(r).items()}
        if isinstance(self.figure, Mapping):
            return dict(self.figure)
        return {"": self.figure}


@explain_names
def write_report(result: Any, path: str | Path, *, title: str = "") -> Path:
    """Write a result as one self-contained HTML page.

    The page needs nothing else: the figures are inside, there is no script and no reference to the
    network. It follows the reader's choice of a light or dark screen, and prints.

    Parameters
    ----------
    result : Record, Audit, IdentifiedModel, LoopFit, Comparison, Redesign, Diagnosis or Section
        What to report (all that a `Section` takes), or several of them in a sequence.
    path : str or Path
        The file; one that exists is replaced.
    title : str, optional
        Heading of the page.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    CtrlidError
        If there is no page for such a result, or the file cannot be written.

    Examples
    --------
    >>> import tempfile, ctrlid as cid
    >>> record = cid.Record(u=[0, 1, 0, 1], y=[0, 0, 1, 1], dt=0.1, name="two steps")
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     page = cid.write_report(record, folder + "/report.html").read_text("utf-8")
    >>> page.startswith("<!DOCTYPE html>")
    True
    """
    check_arguments(write_report, locals())
    given = (
        list(result) if isinstance(result, Sequence) and not isinstance(result, str) else [result]
    )
    if not given:
        raise CtrlidError("write_report needs at least one result; given an empty sequence")
    sections = [r if isinstance(r, Section) else Section(write_heading(r), "", r) for r in given]
    title = title or (sections[0].title if len(sections) == 1 else "ctrlid report")
    alone = len(sections) == 1 and sections[0].title == title
    with off_screen():
        body = "\n".join(_write_section(s, alone) for s in sections)
    page = (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{html.escape(title)}</title>\n<style>{STYLE}</style>\n</head>\n<body>\n<main>\n"
        f"<h1>{html.escape(title)}</h1>\n{body}\n<footer>Written by ctrlid.</footer>\n"
        "</main>\n</body>\n</html>\n"
    )
    path = Path(path)
    try:
        with replace_file(path) as file:
            file.write(page)
    except OSError as reason:
        raise CtrlidError(f"the report cannot be written to {path}: {reason.strerror}. Give a file "
                          "in a folder that exists and may be written to") from reason  # fmt: skip
    return path


def _as_tuple(result: Any) -> tuple[Any, ...]:
    if result is None:
        return ()
    return tuple(result) if isinstance(result, tuple | list) else (result,)


def _draw_pictures(result: Any) -> dict[str, Any]:
    """Draw what belongs to a result."""
    match result:
        case Record():
            made = {"The experiment.": plot.record(result)}
            if len(result) > 2 * BINS:
                middle = len(result) // 2
                part = result[middle : middle + CLOSE]
                made["A part of it."] = plot.record(part)
            return made
        case IdentifiedModel():
            return {"Poles.": plot.poles({"identified": result}),
                    "Frequency response.": plot.bode({"identified": result})}  # fmt: skip
        case IdentifiedSystem():
            rows = {name: result[name, result.input_labels[0]] for name in result.output_labels}
            return {"Poles of each output.": plot.poles(rows)}
        case LoopFit():
            made = {"Poles of the fitted physics.": plot.poles({"fitted": result.model})}
            if result.loop.equations().siso:
                made["Its frequency response."] = plot.bode({"fitted": result.model})
            return made
        case Comparison():
            made = {"Measured output, predictions and simulations.": plot.comparison(result)}
            if result.tests:
                made["Correlations of the one-step errors."] = plot.residuals(result)
            return made
        case ControllerTrial():
            return (
                {"Response to a step of each reference.": plot.step(result)}
                if (result.steps)
                else {}
            )
        case Redesign():
            return {"Response to a step of the reference.": plot.step(result)}
        case Diagnosis():
            return {DIAGNOSIS: plot.diagnosis(result)}
    return {}


def _write_section(section: Section, alone: bool) -> str:
    parts = ["<section>"]
    if not alone:
        parts.append(f"<h2>{html.escape(section.title)}</h2>")
    parts += [_write_paragraph(p) for p in section.text.split("\n\n") if p.strip()]
    for result in _as_tuple(section.result):
        for block in make_blocks(result):
            parts.append(_write_block(block))
    for caption, picture in section.figures.items():
        data = base64.b64encode(_make_png(picture)).decode("ascii")
        words = html.escape(caption, quote=True)
        below = f"<figcaption>{words}</figcaption>" if caption else ""
        alt = words or html.escape(section.title, quote=True)
        parts.append(
            f'<figure><img alt="{alt}" src="data:image/png;base64,{data}">{below}</figure>'
        )
    return "\n".join([*parts, "</section>"])


def _make_png(picture: Any) -> bytes:
    return picture if isinstance(picture, bytes) else plot.png(picture)


def _write_block(block: Table | Title | str) -> str:
    if isinstance(block, Title):
        return f"<h3>{html.escape(block.text)}</h3>"
    return _write_table(block) if isinstance(block, Table) else _write_paragraph(block)


def _write_paragraph(text: str) -> str:
    kind = ' class="bad"' if is_bad_news(text) else ""
    return f"<p{kind}>{html.escape(' '.join(text.split()))}</p>"


def _write_table(table: Table) -> str:
    def row(cells: tuple[str, ...], tag: str) -> str:
        first = f'<th scope="{"col" if tag == "th" else "row"}">{html.escape(cells[0])}</th>'
        kind = ' scope="col"' if tag == "th" else ""
        rest = "".join(f"<{tag}{kind}>{html.escape(c)}</{tag}>" for c in cells[1:])
        return f"<tr>{first}{rest}</tr>"

    caption = f"<caption>{html.escape(table.caption)}</caption>" if table.caption else ""
    body = "\n".join(row(cells, "td") for cells in table.rows)
    return (f'<div class="wide"><table>{caption}<thead>{row(table.head, "th")}</thead>\n<tbody>\n'
            f"{body}\n</tbody></table></div>")  # fmt: skip
