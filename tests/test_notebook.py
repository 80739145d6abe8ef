"""What a notebook shows of a result, and the notebook among the examples."""

import html
import re
from dataclasses import fields, is_dataclass, replace
from pathlib import Path

import control as ct
import nbclient
import nbformat
import numpy as np
import pytest

import ctrlid as cid
from ctrlid._base.text import Printed, write_html
from ctrlid.reporting.tables import Table
from problems import REST, record_of, servo

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOK = ROOT / "examples" / "ten_lines.ipynb"


def read(page):
    """Return what a reader sees of a block, and check that it is one."""
    assert re.fullmatch(r'<pre class="ctrlid" style="[^"]*">.*</pre>', page, re.DOTALL)
    inside = page[page.index(">") + 1 : -len("</pre>")]
    bare = re.sub(r"</?strong>", "", inside)
    assert "<" not in bare
    return html.unescape(bare)


@pytest.fixture(scope="module")
def loop():
    return servo(cid.PID(kp=20.0, kd=1.0), at=REST, free=("k",))


@pytest.fixture(scope="module")
def record(loop):
    return record_of(loop, swing=0.1, hold=50, n=1000, seed=1, sensor_noise=1e-3)


@pytest.fixture(scope="module")
def results(loop, record):
    G = cid.fit_arx(record, na=2, nb=2)
    fitted = cid.fit_loop(loop, record)
    return [
        G.estimate, fitted, fitted.estimate, cid.compare(record, loop), cid.audit(record),
        cid.check_feedback(record), cid.select_order(record, na=[1, 2], nb=[1, 2], nk=[1]),
        cid.sweep_sampling_period(record, [0.01, 0.02]),
        cid.redesign(G, loop, crossover=8.0, phase_margin=60.0), Table(("a", "b"), (("1", "2"),)),
    ]  # fmt: skip


def test_a_notebook_shows_what_print_shows(results, record):
    for shown in results:
        assert read(shown._repr_html_()).split() == str(shown).split(), type(shown).__name__
        assert repr(shown) == str(shown)
    assert read(record._repr_html_()) == repr(record)


def test_every_printed_result_is_shown():
    """A public result with a text of its own has it in a notebook, and at a prompt as well."""
    for name in cid.__all__:
        value = getattr(cid, name)
        # Fitted transfer functions are shown as python-control shows them, with their estimates.
        fitted = name in ("IdentifiedModel", "IdentifiedSystem")
        if isinstance(value, type) and "__str__" in vars(value) and not fitted:
            assert issubclass(value, Printed), name
            assert value.__repr__ is Printed.__repr__ or name == "Diagnosis"
    assert issubclass(cid.Record, Printed)


@pytest.fixture(scope="module")
def parts(loop, record, results):
    """Public values that are only parts of results, which a user looks at one by one."""
    friction = cid.effects.CoulombFriction(0.5)
    real = record_of(loop.with_effect(friction), swing=0.1, hold=50, n=1000, seed=1,
                     sensor_noise=1e-3)  # fmt: skip
    found = cid.diagnose(loop, real, progress=False, catalogue=[type(friction)])
    trial = cid.redesign(
        ct.ss(loop.linearize(states=True)), loop, design=lambda _: loop.controller, step=0.05
    )  # fmt: skip
    compared = results[3]
    return [
        found.gap, *found.findings, *found.where, *found.ranking, *found.calibrated,
        *compared.curves, *compared.tests, *cid.audit(real, loop).findings,
        *results[6].rows, *results[7].table, trial.promised, trial.achieved, *trial.steps,
        *(step.achieved for step in trial.steps), results[8].promised, found.disturbance,
    ]  # fmt: skip


@pytest.mark.slow
def test_parts_of_results_are_short_words_too(parts):
    """``found.gap`` filled a screen with numbers at a prompt, and a curve with dots."""
    kinds = {type(shown).__name__ for shown in parts}
    assert {"Gap", "Finding", "BinnedErrors", "Curve", "Correlation", "AuditFinding", "OrderRow",
            "SamplingRow", "LoopPerformance", "ReferenceStep", "StepMotion"} <= kinds  # fmt: skip
    for shown in parts:
        assert "array(" not in repr(shown), type(shown).__name__
        assert len(repr(shown)) <= 600, type(shown).__name__
        if isinstance(shown, Printed):
            # A notebook folds long sentences, also at a hyphen.
            assert "".join(read(shown._repr_html_()).split()) == "".join(str(shown).split())


def test_no_public_value_with_arrays_shows_them():
    """A dataclass with an array among its fields has a text of its own."""
    public = [v for v in vars(cid).values() if isinstance(v, type) and is_dataclass(v)]
    with_arrays = [v for v in public if any("rray" in str(f.type) for f in fields(v))]
    assert len(with_arrays) > 10
    assert [v.__name__ for v in with_arrays if v.__repr__ is v.__dict__.get("__repr__")
            and v not in (cid.Record, cid.Diagnosis)] == []  # fmt: skip


def test_a_model_shows_formula_and_estimate(record):
    G = cid.fit_arx(record, na=2, nb=2)
    page = G._repr_html_()
    formula, block = page.split("<pre", 1)
    assert formula.rstrip() == ct.TransferFunction._repr_html_(G).rstrip()
    assert r"\dfrac" in formula
    # Long sentences are folded in a notebook.
    assert read("<pre" + block).split() == str(G.estimate).split()
    assert G._repr_markdown_() == page
    assert "$" not in block  # which a notebook would read as a formula
    plain = ct.tf(G)
    plain.repr_format = "latex"
    assert repr(plain).startswith("&lt;TransferFunction")  # what control has stays as it is


def test_bad_news_is_bold_and_names_are_escaped(record):
    held = cid.fit_arx(record, na=2, nb=2, constraints=[cid.Bounds("a1", -1.0, 0.0)])
    page = held.estimate._repr_html_()
    bold = re.findall("<strong>(.*?)</strong>", page, re.DOTALL)
    assert any("IS ON ITS BOUND" in part for part in bold)
    named = replace(record, name="<b> & co")
    assert "&lt;b&gt; &amp; co" in named._repr_html_()
    assert "<b>" not in named._repr_html_()


def test_sentences_are_wrapped_and_tables_are_not():
    sentence, table = "  " + 40 * "word ", "a" + 40 * "  1.0"
    lines = read(write_html(f"{sentence}\n\n{table}")).splitlines()
    assert max(map(len, lines[:2])) <= 100
    assert all(line.startswith("  word") for line in lines[:-2])
    assert lines[-2:] == ["", table]


def test_the_block_suits_light_and_dark():
    """No colour of its own: text and background are those of the notebook."""
    assert "color" not in write_html("NO POLE OUTSIDE")
    assert "background" not in write_html("NO POLE OUTSIDE")


PICTURES = (
    "import ctrlid as cid\nrecord = cid.Record(u=[0, 1, 0, 1], y=[0, 0, 1, 1], dt=0.1)",
    "cid.plot.record(record)", "picture = cid.plot.record(record)", "picture",
)  # fmt: skip
DIAGNOSES = (
    "plant = cid.plants.servo(m=1.0, c=2.0, k=3.0)\n"
    "loop = cid.Loop(plant, cid.PID(kp=20.0, kd=1.0), dt=0.01, free=('k',))\n"
    "r = cid.random_binary(300, amplitude=0.1, hold=50, seed=1)\n"
    "record = cid.simulate(loop, r, sensor_noise=1e-3, seed=2)\n"
    "few = [cid.effects.InputOffset]\n",
    "found = cid.diagnose(loop, record, catalogue=few)",
    "found = cid.diagnose(loop, record, catalogue=few, progress=False)",
)


@pytest.fixture(scope="module")
def shown_by_cells(tmp_path_factory):
    """Return what each of these cells shows: a kernel takes seconds to begin, so they share one."""
    folder = str(tmp_path_factory.mktemp("cells"))
    cells = [nbformat.v4.new_code_cell(source) for source in PICTURES + DIAGNOSES]
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("IPYTHONDIR", folder)
        patch.setenv("JUPYTER_PLATFORM_DIRS", "1")
        patch.setenv("MPLBACKEND", "module://matplotlib_inline.backend_inline")
        done = nbclient.NotebookClient(
            nbformat.v4.new_notebook(cells=cells), timeout=300, kernel_name="python3",
            resources={"metadata": {"path": folder}},
        ).execute()  # fmt: skip
    return [cell.outputs for cell in done.cells]


def test_a_notebook_without_pyplot_shows_each_picture_once(shown_by_cells):
    shown = shown_by_cells[: len(PICTURES)]
    assert [sum("image/png" in o.get("data", {}) for o in cell) for cell in shown] == [0, 1, 1, 1]
    assert shown[0] == []  # not even a warning that the bars of progress will be text
    assert not any("array(" in str(cell) for cell in shown)


@pytest.fixture(scope="module")
def notebook():
    return nbformat.read(NOTEBOOK, as_version=4)


def test_the_notebook_is_committed_without_outputs(notebook):
    nbformat.validate(notebook)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert all(cell.outputs == [] and cell.execution_count is None for cell in code)
    assert notebook.metadata == {
        "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
        "language_info": {"name": "python"},
    }


def test_the_notebook_has_the_ten_lines_of_the_readme(notebook):
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    script = re.search(r"```python\n(.*?)```", readme, re.DOTALL)[1]
    lines = [line for line in script.splitlines() if line]
    cells = [line for cell in notebook.cells if cell.cell_type == "code"
             for line in cell.source.splitlines() if line]  # fmt: skip
    # A notebook shows the last value of a cell, and a model with its estimate: no print is needed.
    wanted = [re.sub(r"^print\((.*)\)$", r"\1", line).replace("G.estimate", "G") for line in lines]
    missing = [line for line in wanted if not any(line in cell for cell in cells)]
    assert missing == []


def test_the_notebook_runs_from_top_to_bottom(notebook, monkeypatch, tmp_path):
    monkeypatch.setenv("IPYTHONDIR", str(tmp_path))
    monkeypatch.setenv("JUPYTER_PLATFORM_DIRS", "1")
    monkeypatch.setenv("MPLBACKEND", "module://matplotlib_inline.backend_inline")
    done = nbclient.NotebookClient(
        notebook.copy(), timeout=300, kernel_name="python3",
        resources={"metadata": {"path": str(tmp_path)}},
    ).execute()  # fmt: skip
    outputs = [out for cell in done.cells if cell.cell_type == "code" for out in cell.outputs]
    pages = [out.data["text/html"] for out in outputs if "text/html" in out.get("data", {})]
    pictures = [out for out in outputs if "image/png" in out.get("data", {})]
    # Without the widgets tqdm warns that its bars will be text.
    said = [out for out in outputs if out.output_type in ("error", "stream")]
    assert [out for out in said if "IProgress" not in out.get("text", "")] == []
    assert any(r"\dfrac" in page and "pole at s = 40.4" in page.replace("-", "") for page in pages)
    assert any("the promise holds" in " ".join(page.split()) for page in pages)
    assert any("one-step prediction" in page for page in pages)
    assert len(pictures) == 2
    assert np.all([len(out.data["image/png"]) > 10_000 for out in pictures])


def test_the_progress_of_a_diagnosis_is_one_line_that_is_redrawn(shown_by_cells):
    """It was a line a round, as for a file."""
    _, shown, silent = shown_by_cells[len(PICTURES) :]
    text = "".join(out.text for out in shown)
    frames = text.split("\r")
    assert any("round 1: screening" in frame for frame in frames)
    assert "\n" not in text
    assert frames[-1].strip() == ""
    assert silent == []
