"""The manual: complete, consistent with the code, and executed."""

import ast
import doctest
import functools
import inspect
import re
from pathlib import Path

import numpydoc.docscrape
import numpydoc.validate
import pytest

import ctrlid

ROOT = Path(__file__).resolve().parents[1]
DOCS, EXAMPLES = ROOT / "docs", ROOT / "examples"
PAGES = sorted(
    page for page in DOCS.rglob("*.rst") if not {"_build", "_templates", "gallery", "generated"}
    & set(page.relative_to(DOCS).parts)
)  # fmt: skip
STORIES = sorted(EXAMPLES.glob("plot_*.py"))
CHECKS = {"GL01", "GL02", "GL03", "GL08", "SS03", "PR01", "PR02", "PR03", "RT01"}
MODULES = [name for name in ctrlid.__all__ if inspect.ismodule(getattr(ctrlid, name))]


def functions_of(module):
    """Public functions and classes written in a public module, or in a file of it."""
    return [
        f"{module.__name__.rpartition('.')[2]}.{name}"
        for name, value in vars(module).items()
        if not name.startswith("_")
        and f"{getattr(value, '__module__', '')}.".startswith(f"{module.__name__}.")
        and (inspect.isfunction(value) or name in getattr(module, "__all__", ()))
    ]


def methods_of(name):
    """Public methods and properties of a class that no base class of ours describes already."""
    cls = getattr(ctrlid, name)
    return [
        f"{name}.{key}"
        for key, value in vars(cls).items()
        if not key.startswith("_")
        and (inspect.isfunction(value) or isinstance(value, property | classmethod))
        and not any(key in vars(base) for base in cls.__mro__[1:])
    ]


NAMES = [n for n in ctrlid.__all__ if not n.startswith("__") and n not in MODULES]
OF_MODULES = [
    name
    for module in MODULES
    if module != "effects"  # which have a page of their own
    for name in functions_of(getattr(ctrlid, module))
]
METHODS = [m for n in NAMES if inspect.isclass(getattr(ctrlid, n)) for m in methods_of(n)]


def identifier(path):
    return str(path.relative_to(ROOT))


@pytest.mark.parametrize("name", [*ctrlid.__all__, *OF_MODULES])
def test_every_public_name_is_in_the_reference(name):
    reference = (DOCS / "api" / "index.rst").read_text(encoding="utf-8")
    assert re.search(rf"^   {re.escape(name)}$|``ctrlid\.{re.escape(name)}``", reference, re.M), (
        f"add {name} to docs/api/index.rst"
    )


def test_the_reference_lists_nothing_that_is_gone():
    reference = (DOCS / "api" / "index.rst").read_text(encoding="utf-8")
    listed = re.findall(r"^   ([A-Za-z_][\w.]*)$", reference, re.M)
    assert len(listed) == len(set(listed))
    assert set(listed) == {*NAMES, *OF_MODULES}


def problems(name):
    """What numpydoc finds, but for what the reader finds elsewhere."""
    validated = numpydoc.validate.validate(f"ctrlid.{name}")
    found = {code: text for code, text in validated["errors"] if code in CHECKS}
    target = functools.reduce(getattr, name.split("."), ctrlid)
    parsed = numpydoc.docscrape.NumpyDocString(inspect.getdoc(target))
    if inspect.isclass(target) and parsed["Attributes"]:
        # A result, which nobody makes by hand: its fields are described as attributes.
        described = {n for a in parsed["Attributes"] for n in a.name.split(", ")}
        if set(inspect.signature(target).parameters) <= described:
            found.pop("PR01", None)
    if "." in name and parsed["Summary"][0].startswith("Return "):
        found.pop("RT01", None)  # the summary of a method without arguments says it all
    return found


@pytest.mark.parametrize("name", [*NAMES, *OF_MODULES, *METHODS])
def test_docstring_matches_signature(name):
    assert problems(name) == {}


# A unit in brackets or in words, or a word for a number that has none.
UNIT = re.compile(
    r"\[|\bunits?\b|rad/s|in seconds|degrees|percent|\bshares?\b|probabilit|\bchance\b|likelihood|"
    r"\bfactor|\bratio\b|correlation|coefficient|\bweights?\b|penalty|between 0 and 1|in samples|"
    r"number of|condition number|criterion|Axes|of bool", re.IGNORECASE
)  # fmt: skip


@pytest.mark.parametrize("name", [*NAMES, *OF_MODULES, *METHODS])
def test_every_number_has_a_unit(name):
    target = functools.reduce(getattr, name.split("."), ctrlid)
    parsed = numpydoc.docscrape.NumpyDocString(inspect.getdoc(target) or "")
    entries = [*parsed["Parameters"], *parsed["Attributes"], *parsed["Returns"]]
    silent = [entry.name or "what it returns" for entry in entries
              if re.search("float|array", entry.type)
              and not UNIT.search(f"{entry.type} {' '.join(entry.desc)}")]  # fmt: skip
    assert silent == []


@pytest.mark.parametrize("page", PAGES, ids=identifier)
def test_what_a_page_shows_is_what_the_code_does(page):
    flags = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
    outcome = doctest.testfile(
        str(page), module_relative=False, optionflags=flags, encoding="utf-8"
    )
    assert outcome.failed == 0


@pytest.mark.parametrize("page", PAGES, ids=identifier)
def test_no_page_shows_python_that_is_not_run(page):
    text = page.read_text(encoding="utf-8")
    blocks = re.findall(r"^\.\. code(?:-block)?:: *py.*\n((?:\n|[ ]+.*\n)*)", text, re.M)
    assert all(">>>" in block for block in blocks)


@pytest.mark.parametrize("story", STORIES, ids=identifier)
def test_a_story_has_a_title_a_figure_and_ends_in_an_assertion(story):
    tree = ast.parse(story.read_text(encoding="utf-8"))
    title, underline = (ast.get_docstring(tree) or "\n").splitlines()[:2]
    assert set(underline) == {"="}
    assert len(underline) >= len(title)
    calls = [ast.unparse(node) for node in ast.walk(tree) if isinstance(node, ast.Call)]
    assert "plt.show()" in calls, "a story shows a figure"
    assert isinstance(tree.body[-1], ast.Assert), "a story ends in a number that it asserts"


def test_pages_have_no_dead_links_to_stories():
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        pictures = re.findall(r"gallery/images/sphx_glr_(\w+)_\d{3}\.png", text)
        for target in [*re.findall(r"gallery/(?!images/)(\w+)", text), *pictures]:
            assert target == "index" or (EXAMPLES / f"{target}.py").is_file(), (page, target)
