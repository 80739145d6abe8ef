"""Refusals and warnings of the library in the words of the command line."""

import re
from collections.abc import Iterator
from contextlib import contextmanager

from ..._base.errors import CtrlidError

# What a keyword of the library is for someone who typed a command.
OPTIONS = {
    "r": "--columns", "u": "--columns", "y": "--columns", "time": "--columns", "dt": "--dt",
    "units": "--units", "scale": "--scale", "names": "--names", "hold": "--hold",
    "gaps": "--gaps", "free": "--free",
    "controller": "--controller", "validation": "--validation", "jobs": "--jobs",
    "seconds": "--seconds", "valid": "the column valid",
}  # fmt: skip
# Whole phrases of the library that are no keyword, or have no counterpart.
PHRASES = {
    "at=operating_point(plant, output=...)": "--at-output",
    "or give guess= near an equilibrium": "with --at-output",
    "jobs is a number": "--jobs is a number",
    ", or None for what joblib.parallel_config says": "",
    "seconds is the time": "--seconds is the time",
    ", or None for no such end": "",
}
KEYWORD = (
    rf"\b(?P<key>{'|'.join(OPTIONS)})=(?!=)"
    r"""(?P<value>'[^']*'|"[^"]*"|\{[^{}]*\}|\.\.\.|[\d.e+-]*\d)?"""
)
# A call around keywords is taken away; one that makes an object belongs to the file of a model.
CALLS = r"(?:Record\.from_csv|from_csv|record\.select|dataclasses\.replace)\((?P<given>[^()]*)\)"
PYTHON = re.compile(rf"\b(?:Loop|Record|PID)\([^()]*\)|{CALLS}|{KEYWORD}")


@contextmanager
def options_in_refusals() -> Iterator[None]:
    """Let a refusal of the library name the options to give, in place of keywords of Python."""
    try:
        yield
    except CtrlidError as reason:  # Any refusal stays one.
        raise CtrlidError(name_options(str(reason))) from reason


def name_options(text: str) -> str:
    """Return a sentence of the library with options of the command line for keywords of Python.

    Parameters
    ----------
    text : str
        A refusal or a warning.

    Returns
    -------
    str
        The same, for someone who typed a command.

    Examples
    --------
    >>> name_options("Name it with u=, or give gaps='mask'")
    'Name it with --columns u=NAME, or give --gaps mask'
    >>> name_options("convert it: Record.from_csv(..., scale={'y': 0.001}, units={'y': 'm'})")
    'convert it: --scale y=0.001 --units y=m'
    """
    for phrase, option in PHRASES.items():
        text = text.replace(phrase, option)
    return PYTHON.sub(_translate, text)


def _translate(found: re.Match[str]) -> str:
    if found["key"]:
        return _write_options([(found["key"], found["value"] or "")])
    if found["given"] is None:
        return found[0]
    inside = re.finditer(KEYWORD, found["given"])
    return _write_options([(one["key"], one["value"] or "") for one in inside]) or found[0]


def _write_options(given: list[tuple[str, str]]) -> str:
    """Write keywords with their values as options; the columns of a file are one option."""
    plain = {key: re.sub(r"[{}'\"]", "", value).replace(": ", "=") for key, value in given}
    columns = [f"{k}={v or 'NAME'}" for k, v in plain.items() if OPTIONS[k] == "--columns"]
    others = [f"{OPTIONS[k]} {v}".strip() for k, v in plain.items() if OPTIONS[k] != "--columns"]
    return " ".join([*(["--columns " + ",".join(columns)] if columns else []), *others])
