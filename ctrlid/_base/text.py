"""Numbers and sentences for people; shared by every report."""

from __future__ import annotations

import difflib
import html
import math
import re
import textwrap
from collections.abc import Iterable, Sequence
from typing import Any

from .units import is_unit

PREFIXES = ((1e-1, 1.0, ""), (1e-4, 1e-3, "m"), (1e-7, 1e-6, "µ"), (0.0, 1e-9, "n"))
PREFIXED = ("m", "V", "A", "N", "m/s", "m/s^2", "N s/m", "N m", "N m s/rad", "s")


def write_number(value: complex, digits: int = 7) -> str:
    """Return the shortest usual form of a real or complex number."""
    value = complex(value)
    if value.imag == 0:
        return f"{value.real:.{digits}g}"
    return f"{value.real:.{digits}g}{value.imag:+.{digits}g}j"


def with_error(value: complex, error: float) -> str:
    """Return ``value ± error`` with as many digits as the error allows.

    Parameters
    ----------
    value : float or complex
        The number.
    error : float
        Its standard error.

    Returns
    -------
    str
        The error has two digits and the value ends at the same place.

    Examples
    --------
    >>> with_error(-2.0016412, 0.000123)
    '-2.00164 ± 0.00012'
    >>> with_error(-1.23456e-5, 2.1e-7)
    '(-1.235 ± 0.021)e-05'
    >>> with_error(1.5, 0.0)
    '1.5 (fixed)'
    """
    value = complex(value)
    if error == 0:
        return f"{write_number(value)} (fixed)"
    if not math.isfinite(error) or not math.isfinite(abs(value)):
        return f"{write_number(value)} ± {error:g}"
    size = max(abs(value), error)
    exponent = math.floor(math.log10(size))
    if -4 <= exponent <= 5:
        exponent = 0
    scale = 10.0**exponent
    # A noise-free fit has errors at rounding level: beyond twelve digits there is nothing to say.
    places = min(max(1 - math.floor(math.log10(error / scale)), 0), 12)
    text = f"{value.real / scale:.{places}f}"
    if value.imag:
        text += f"{value.imag / scale:+.{places}f}j"
    shown = error / scale
    text += f" ± {shown:.{places}f}" if shown >= 10.0**-places else f" ± {shown:.1e}"
    return f"({text})e{exponent:+03d}" if exponent else text


def write_p_value(p: float) -> str:
    """Return a p-value in words; of the very small ones the size says nothing."""
    if math.isnan(p):
        return "p is not known"
    return f"p = {p:.2g}" if p >= 1e-4 else "p < 0.0001"


def write_percent(share: float, digits: int = 2) -> str:
    """Write a share in per cent with so many digits, never as a power of ten.

    Parameters
    ----------
    share : float
        The share; 1 is all.
    digits : int, optional
        Significant digits of what is below 100 %; above, all digits before the point are written.

    Returns
    -------
    str
        The share in per cent.

    Examples
    --------
    >>> write_percent(1.0), write_percent(34.2), write_percent(0.0123), write_percent(2e-7)
    ('100 %', '3420 %', '1.2 %', 'under 0.001 %')
    """
    percent = 100 * share
    if 0 < percent < 1e-3:
        return "under 0.001 %"
    text = f"{percent:.{digits}g}"
    return f"{percent:.0f} %" if "e+" in text else f"{float(text):.10g} %"


def choose_prefix(size: float, unit: str) -> tuple[float, str]:
    """Return a factor and the unit it leads to: millimetres rather than 0.03 m.

    Parameters
    ----------
    size : float
        How large the quantity is.
    unit : str
        Its unit, of those in SI that take a prefix; others stay as they are.

    Returns
    -------
    (float, str)
        Factor and unit.

    Examples
    --------
    >>> choose_prefix(0.03, "m"), choose_prefix(0.03, "1/s")
    ((1000.0, 'mm'), (1.0, '1/s'))
    """
    if unit not in PREFIXED or not 0 < abs(size) < math.inf:
        return 1.0, unit
    factor, letter = next((f, p) for limit, f, p in PREFIXES if abs(size) >= limit)
    return 1 / factor, letter + unit


def write_quantity(
    value: float, unit: str = "", error: float | None = None, digits: int = 3
) -> str:
    """Write a value with its unit, and its standard error if one is given.

    Parameters
    ----------
    value : float
        The value.
    unit : str, optional
        Its unit.
    error : float, optional
        Its standard error; infinite if the data do not determine the value.
    digits : int, optional
        Significant digits where there is no error.

    Returns
    -------
    str
        The quantity.

    Examples
    --------
    >>> write_quantity(6.1234e-4, "s", 3e-6), write_quantity(1.23456e-5, "m")
    ('0.6123 ± 0.0030 ms', '12.3 µm')
    """
    spread = error if error is not None and math.isfinite(error) else 0.0
    factor, unit = choose_prefix(max(abs(value), spread), unit)
    if error is None or error == 0 or not math.isfinite(error):
        known = (
            "" if error is None else " (fixed)" if error == 0 else " (not determined by the data)"
        )
        return f"{write_number(factor * value, digits)} {unit}".strip() + known
    return f"{with_error(factor * value, factor * error)} {unit}".strip()


def drop_roundoff(value: float, error: float) -> float:
    """Return the number without the digits that only round-off gave it.

    Parameters
    ----------
    value : float
        The number.
    error : float
        How far off round-off may have put it.

    Returns
    -------
    float
        The number of at most 12 digits within the error, or the number itself.

    Examples
    --------
    >>> drop_roundoff(0.1 + 0.2, 1e-15), drop_roundoff(1 / 3, 1e-15)
    (0.3, 0.3333333333333333)
    """
    short = float(f"{value:.12g}")
    return short if abs(short - value) <= error else value


def write_polynomial(coefficients: Sequence[float], variable: str, digits: int = 6) -> str:
    """Write a polynomial by falling powers.

    Parameters
    ----------
    coefficients : sequence of float
        Highest power first.
    variable : str
        Name of the variable.
    digits : int, optional
        Significant digits.

    Returns
    -------
    str
        Zero if all are zero.

    Examples
    --------
    >>> write_polynomial([2.0, -1.0, 0.0, 0.5], "s"), write_polynomial([-1, 0, 1], "z")
    ('2 s^3 - s^2 + 0.5', '-z^2 + 1')
    >>> write_polynomial([0], "z")
    '0'
    """
    text = ""
    for power, value in zip(range(len(coefficients) - 1, -1, -1), coefficients, strict=True):
        if value == 0:
            continue
        times = {0: "", 1: variable}.get(power, f"{variable}^{power}")
        size = "" if times and abs(value) == 1 else f"{abs(value):.{digits}g}"
        sign = "-" if value < 0 else "+"
        text += f" {sign} " if text else sign.strip("+")
        text += f"{size} {times}".strip()
    return text or "0"


def write_list(items: list[str] | tuple[str, ...]) -> str:
    """Join items as in ``a, b and c``."""
    items = list(items)
    if len(items) < 2:
        return "".join(items)
    return ", ".join(items[:-1]) + " and " + items[-1]


def find_near_name(name: str, known: Iterable[str]) -> str | None:
    """Return what a wrong name probably means; None if nothing is near.

    Parameters
    ----------
    name : str
        The name as it was typed.
    known : iterable of str
        The names that there are.

    Returns
    -------
    str or None
        One that differs in capitals only, or begins or ends with it, or else is spelled alike.

    Examples
    --------
    >>> find_near_name("Coulomb", ("ViscousFriction", "CoulombFriction")), find_near_name("q", "ab")
    ('CoulombFriction', None)
    >>> find_near_name("fc", ("c", "CoulombFriction.fc"))
    'CoulombFriction.fc'
    """
    lower = {k.lower(): k for k in sorted(known, reverse=True)}
    typed = name.lower().replace("_", "")
    plain = {k.replace("_", ""): v for k, v in lower.items()}
    if typed in plain:
        return plain[typed]
    # Two letters begin or end too many names, but all that follows a dot is a name of its own.
    parts = [v for k, v in sorted(plain.items()) if k.endswith(f".{typed}") or (len(typed) > 2
             and (k.startswith(typed) or k.endswith(typed)))]  # fmt: skip
    near = difflib.get_close_matches(typed, plain, 1)
    # A single letter begins a name; it is a part of too many.
    near = [k for k in near if len(typed) > 1 or k.startswith(typed)]
    alike = parts or [plain[k] for k in near]
    return alike[0] if alike else None


def list_known(name: str, known: Iterable[str]) -> str:
    """Say which names there are instead of a wrong one, and which of them is near.

    Parameters
    ----------
    name : str
        The name as it was typed.
    known : iterable of str
        The names that there are.

    Returns
    -------
    str
        The end of a refusal.

    Examples
    --------
    >>> list_known("M", ("m", "c")), list_known("J", ("m", "c")), list_known("J", ())
    ('it has m, c; did you mean m?', 'it has m, c', 'it has none')
    """
    names = list(known)
    near = find_near_name(name, names)
    return f"it has {', '.join(names) or 'none'}" + (f"; did you mean {near}?" if near else "")


def write_count(number: int, noun: str, plural: str = "") -> str:
    """Write a number of things: one sample, two samples.

    Parameters
    ----------
    number : int
        How many there are.
    noun : str
        What one of them is called.
    plural : str, optional
        What several are called; by default the noun with an s.

    Returns
    -------
    str
        Number and noun.

    Examples
    --------
    >>> write_count(1, "sample"), write_count(20, "sample")
    ('1 sample', '20 samples')
    """
    return f"{number} {noun if number == 1 else plural or noun + 's'}"


def write_noises(values: Any, units: Any, places: Sequence[str] = (), per: str = "") -> str:
    """Write the size of a noise with its unit, or of several with theirs and their places.

    Parameters
    ----------
    values : float or sequence of float
        The sizes.
    units : str or sequence of str
        Their units; empty where they are not known.
    places : sequence of str, optional
        Where each noise is, such as an output; a unit that is not known is named after it.
    per : str, optional
        What follows such a name.

    Returns
    -------
    str
        The sizes.

    Examples
    --------
    >>> write_noises(0.1, "m"), write_noises((0.1, 2.0), ("N", ""), ("v", "omega"), "/s")
    ('0.1 m', '0.1 N at v and 2 [omega]/s at omega')
    """
    if not isinstance(values, tuple):
        return f"{write_number(values, 3)} {units}".strip()
    if not places:
        return write_list([write_noises(v, u) for v, u in zip(values, units, strict=True)])
    return write_list([f"{write_noises(v, u or f'[{place}]{per}')} at {place}"
                       for v, u, place in zip(values, units, places, strict=True)])  # fmt: skip


def write_time(seconds: float, dt: float) -> str:
    """Write a time of a record, to a hundredth of the sampling period or finer [s].

    Time stamps of a logger jitter by less, which says nothing.

    Examples
    --------
    >>> write_time(-7e-06, 0.01), write_time(12.34567, 0.01), write_time(300.0, 5.0)
    ('0', '12.3457', '300')
    """
    digits = max(2 - math.floor(math.log10(dt)), 0)
    text = f"{seconds:.{digits}f}"
    text = text.rstrip("0").rstrip(".") if digits else text
    return "0" if text in ("-0", "") else text


def with_unit(name: str, unit: str) -> str:
    """Return ``name [unit]``, so written that `split_unit` takes it apart again.

    Parameters
    ----------
    name, unit : str
        A signal and its unit; the unit may be empty.

    Returns
    -------
    str
        The label.

    Examples
    --------
    >>> with_unit("u", "V"), with_unit("u", ""), with_unit("x[k]", "")
    ('u [V]', 'u', 'x[k] []')
    """
    if unit or split_unit(name) != (name, ""):
        return f"{name} [{unit}]"
    return name


def split_unit(label: str) -> tuple[str, str]:
    """Take a label apart into name and unit.

    Parameters
    ----------
    label : str
        As in ``u [V]``, ``u[V]``, ``u (V)`` or ``u(V)``, or quantity over unit as in ``u/V`` (ISO
        80000-1) where what follows the slash is a unit; ``x[0]`` is an index, not a unit.

    Returns
    -------
    (str, str)
        Name and unit; the unit is empty where there is none.

    Examples
    --------
    >>> split_unit("position [m]"), split_unit("x[0]"), split_unit("u (V)")
    (('position', 'm'), ('x[0]', ''), ('u', 'V'))
    >>> split_unit("Zeit/ms"), split_unit("speed/(m/s)"), split_unit("up/down")
    (('Zeit', 'ms'), ('speed', 'm/s'), ('up/down', ''))
    """
    found = re.fullmatch(r"(.*\S)(\s*)\[([^\[\]]*)\]|(.*[^\s/])(\s*)\(([^()]*)\)", label)
    if found is None:
        quantity, slash, unit = label.partition("/")
        if slash and quantity.strip() and is_unit(unit):
            return quantity.strip(), unit.strip().removeprefix("(").removesuffix(")")
        return label, ""
    name, space, unit = found.groups()[:3] if found[1] else found.groups()[3:]
    if not found[1] and not space and not is_unit(unit):
        return label, ""  # A function of something, as in f(x).
    return (name, unit) if space or not unit.isdigit() else (label, "")


def is_bad_news(text: str) -> bool:
    """Return whether a sentence has bad news in it: three or more words in capitals in a row.

    Parameters
    ----------
    text : str
        A sentence.

    Returns
    -------
    bool
        True for bad news; two such words may be abbreviations.

    Examples
    --------
    >>> is_bad_news("a1 IS ON ITS BOUND -2"), is_bad_news("a PID under FOH")
    (True, False)
    """
    words = [w.strip(".,:;()") for w in text.split()]
    loud = [len(w) > 1 and w.isalpha() and w.isupper() for w in words]
    return any(all(loud[i : i + 3]) for i in range(len(words) - 2))


def write_html(text: str, width: int = 100) -> str:
    r"""Return a printed report as HTML for a notebook.

    The block has no colours of its own and so suits a light and a dark notebook. Columns stay
    columns, long sentences are wrapped, bad news is bold.

    Parameters
    ----------
    text : str
        What ``print`` shows.
    width : int, optional
        Where sentences are wrapped [characters].

    Returns
    -------
    str
        One ``pre`` element.

    Examples
    --------
    >>> print(write_html("p < 1\n  NO POLE OUTSIDE"))
    <pre class="ctrlid" style="font-family: monospace; line-height: 1.35; overflow-x: auto">p &lt; 1
    <strong>  NO POLE OUTSIDE</strong></pre>
    """
    shown = []
    for line in text.splitlines():
        indent = line[: len(line) - len(line.lstrip())]
        # Two spaces within a line make a table of it.
        folded = [line]
        if "  " not in line.strip():
            folded = textwrap.wrap(line, width, subsequent_indent=indent)
        escaped = html.escape("\n".join(folded))
        shown.append(f"<strong>{escaped}</strong>" if is_bad_news(line) else escaped)
    # The page around it may say otherwise, and columns need letters of one width.
    style = "font-family: monospace; line-height: 1.35; overflow-x: auto"
    return f'<pre class="ctrlid" style="{style}">' + "\n".join(shown) + "</pre>"


class Printed:
    """A result with a text of its own: a prompt and a notebook show what ``print`` shows."""

    def __repr__(self) -> str:
        return str(self)

    def _repr_html_(self) -> str:
        return write_html(str(self))
