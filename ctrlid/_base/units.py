"""Units as text: products, powers and quotients, and which texts are units at all."""

import math
import re
from collections.abc import Mapping

# What takes a prefix such as m or k, and what does not.
WITH_PREFIX = ("m", "g", "s", "A", "K", "Hz", "rad", "N", "Nm", "Pa", "J", "W", "V", "F", "Ω",
               "ohm", "H", "T", "bar", "l", "L")  # fmt: skip
ALONE = ("%", "‰", "°", "deg", "grad", "°C", "C", "°F", "min", "h", "rpm", "cm", "in", "inch", "ft",
         "psi", "rev", "turns", "ticks", "counts", "steps", "LSB")  # fmt: skip
PREFIXES = ("", "n", "µ", "μ", "u", "m", "k", "M")
KNOWN = frozenset([*ALONE, *(p + unit for p in PREFIXES for unit in WITH_PREFIX)])
# Other spellings of these, as they stand in headers.
SPELLINGS = {
    "°": "deg", "degree": "deg", "degrees": "deg", "radian": "rad", "radians": "rad", "Nm": "N m",
    "N.m": "N m", "Ω": "ohm", "°C": "C", "percent": "%", "volt": "V", "volts": "V", "amp": "A",
    "amps": "A", "ampere": "A", "newton": "N", "newtons": "N", "meter": "m", "metre": "m",
    "meters": "m", "metres": "m", "sec": "s", "second": "s", "seconds": "s", "l": "L",
    "celsius": "C", "degc": "C", "fahrenheit": "°F", "degf": "°F", "kelvin": "K",
}  # fmt: skip
# How many of these make one of the SI: prefixes, and units with that of the SI.
PER_SI = {"n": 1e9, "µ": 1e6, "m": 1e3, "k": 1e-3, "M": 1e-6}
SCALES = {
    "deg": ("rad", 180 / math.pi), "rev": ("rad", 0.5 / math.pi), "cm": ("m", 100.0),
    "%": ("1", 100.0), "1": ("1", 1.0), "g": ("kg", 1e3), "kg": ("kg", 1.0), "min": ("s", 1 / 60),
    "h": ("s", 1 / 3600),
}  # fmt: skip
# Scales of temperature: kelvins in one degree, and at zero.
TEMPERATURES = {"K": (1.0, 0.0), "C": (1.0, 273.15), "°F": (5 / 9, 459.67 * 5 / 9)}
MARKS = re.compile(r"[/()*·]|\^-?\d+|[^\s/()*·^]+|\S")


def fill_unit(template: str, signals: Mapping[str, str]) -> str:
    """Return a unit in which names in braces stand for the units of signals.

    Parameters
    ----------
    template : str
        As in ``1/(s {u}^2)``.
    signals : mapping of str to str
        The unit of each name.

    Returns
    -------
    str
        The unit, in which powers of the same unit are one. A product keeps together: its square
        is ``(N m)^2``.

    Examples
    --------
    >>> fill_unit("1/(s {u}^2)", {"u": "N m"}), fill_unit("{y}/s^2", {"y": "m/s"})
    ('1/(s (N m)^2)', 'm/s^3')
    >>> fill_unit("{y}/s^2", {"y": "%"}), fill_unit("{y}", {"y": "N m"})
    ('%/s^2', 'N m')
    """
    if "{" not in template:
        return template
    filled: dict[str, int] = {}
    for symbol, power in _parse_unit(template).items():
        unit = signals[symbol[1:-1]] if symbol.startswith("{") else symbol
        parts = _parse_unit(unit)
        if len(parts) > 1 and min(parts.values()) > 0 and "s" not in parts:
            parts = {unit: 1}
        for part, times in parts.items():
            filled[part] = filled.get(part, 0) + power * times
    return _write_unit(filled)


def is_unit(text: str) -> bool:
    """Return whether a text is made of the usual symbols of units.

    Parameters
    ----------
    text : str
        What may be a unit.

    Returns
    -------
    bool
        True if each symbol in it is known.

    Examples
    --------
    >>> [is_unit(text) for text in ("ms", "°/s", "N m", "(m/s)", "volt", "y")]
    [True, True, True, True, False, False]
    """
    parts = _parse_unit(text)
    return bool(parts) and KNOWN.issuperset(parts)


def is_same_unit(first: str, second: str) -> bool:
    """Return whether two texts are the same unit in other words.

    Parameters
    ----------
    first, second : str
        Units.

    Returns
    -------
    bool
        True if their symbols have the same powers; a rad beside other symbols is none.

    Examples
    --------
    >>> [is_same_unit(*both) for both in (("°", "deg"), ("N m", "Nm"), ("um/s", "µm s^-1"))]
    [True, True, True]
    >>> [is_same_unit(*both) for both in (("mm", "m"), ("deg", "rad"), ("rad", "1"))]
    [False, False, False]
    """
    return _spell_alike(first) == _spell_alike(second)


def count_per_si_unit(text: str) -> float:
    """Return how many of a unit make one SI unit of the same quantity.

    Parameters
    ----------
    text : str
        A unit.

    Returns
    -------
    float
        The number; 1 for a unit that is not known, or of several symbols.

    Examples
    --------
    >>> count_per_si_unit("mm"), count_per_si_unit("m"), count_per_si_unit("volts")
    (1000.0, 1.0, 1.0)
    """
    return _find_scale(text)[1]


def find_factor(given: str, wanted: str) -> float | None:
    """Return what turns numbers in one unit into numbers in another one of the same quantity.

    Parameters
    ----------
    given, wanted : str
        Units of a single symbol.

    Returns
    -------
    float or None
        The factor; None where they are not known to be of the same quantity.

    Examples
    --------
    >>> find_factor("mm", "m"), round(find_factor("deg", "rad"), 6), find_factor("V", "A")
    (0.001, 0.017453, None)
    """
    (first, per_given), (second, per_wanted) = _find_scale(given), _find_scale(wanted)
    return per_wanted / per_given if first and first == second else None


def find_shift(given: str, wanted: str) -> tuple[float, float] | None:
    """Return what turns temperatures of one scale into those of another: factor, then shift.

    Parameters
    ----------
    given, wanted : str
        Units.

    Returns
    -------
    (float, float) or None
        As in wanted = factor given + shift; None where they are no scales with different zeros.

    Examples
    --------
    >>> find_shift("°C", "K"), find_shift("mm", "m")
    ((1.0, 273.15), None)
    >>> factor, shift = find_shift("°F", "°C")
    >>> round(factor, 6), round(shift, 4)
    (0.555556, -17.7778)
    """
    scales = []
    for powers in map(_spell_alike, (given, wanted)):
        symbol = next(iter(powers)) if list(powers.values()) == [1] else ""
        scales.append(TEMPERATURES.get(symbol))
    first, second = scales
    if first is None or second is None or first == second:
        return None
    return first[0] / second[0], round((first[1] - second[1]) / second[0], 10)


def write_shift(name: str, factor: float, shift: float) -> str:
    """Return the conversion of a signal between scales with different zeros.

    Examples
    --------
    >>> write_shift("y", 1.0, 273.15), write_shift("y", 1.8, 32.0)
    ('y + 273.15', '1.8 * y + 32')
    """
    scaled = name if factor == 1 else f"{factor:.6g} * {name}"
    return f"{scaled} {'+' if shift > 0 else '-'} {abs(shift):.6g}"


def _find_scale(text: str) -> tuple[str, float]:
    """Return the SI unit of a unit, and how many make one; empty, and 1, for one not known."""
    powers = _spell_alike(text)
    if list(powers.values()) != [1]:
        return "", 1.0
    (symbol,) = powers
    if symbol in SCALES:
        return SCALES[symbol]
    if symbol in WITH_PREFIX:
        return symbol, 1.0
    if symbol[1:] in WITH_PREFIX and symbol[0] in PER_SI:
        return symbol[1:], PER_SI[symbol[0]]
    return "", 1.0


def _spell_alike(text: str) -> dict[str, int]:
    """Return the powers of the symbols in a unit, each in one spelling."""
    powers: dict[str, int] = {}
    for symbol, power in _parse_unit(text.strip().strip("[]")).items():
        plain = SPELLINGS.get(symbol, SPELLINGS.get(symbol.lower(), symbol)).replace("μ", "µ")
        if plain in KNOWN and plain[0] == "u":
            plain = f"µ{plain[1:]}"
        for part in plain.split():
            powers[part] = powers.get(part, 0) + power
    if len(powers) > 1:
        powers.pop("rad", None)
    return {symbol: n for symbol, n in powers.items() if n}


def _parse_unit(text: str) -> dict[str, int]:
    """Return the powers of the symbols in a unit; a text that is none is a symbol of its own."""
    marks = MARKS.findall(text.replace("²", "^2").replace("³", "^3"))
    try:
        powers = _read_product(marks)
    except (ValueError, IndexError):
        return {text: 1}
    return {text: 1} if marks else powers


def _read_product(marks: list[str]) -> dict[str, int]:
    """Take a product off the front of a list of marks, up to its end or a closing bracket."""
    powers: dict[str, int] = {}
    sign = 1
    while marks and marks[0] != ")":
        mark = marks.pop(0)
        if mark in "*·":
            continue
        if mark == "/":
            sign = -1
            continue
        part = {} if mark == "1" else {mark: 1}
        if mark == "(":
            part = _read_product(marks)
            marks.pop(0)
        elif mark.startswith("^"):
            raise ValueError(mark)
        power = int(marks.pop(0)[1:]) if marks and marks[0].startswith("^") else 1
        for symbol, times in part.items():
            powers[symbol] = powers.get(symbol, 0) + sign * power * times
        sign = 1
    return {symbol: n for symbol, n in powers.items() if n}


def _write_unit(factors: Mapping[str, int]) -> str:
    above = " ".join(_write_power(f, n) for f, n in factors.items() if n > 0)
    below = [_write_power(f, -n, below=True) for f, n in factors.items() if n < 0]
    if not below:
        return above
    return f"{above or '1'}/{below[0] if len(below) == 1 else '(' + ' '.join(below) + ')'}"


def _write_power(factor: str, power: int, below: bool = False) -> str:
    whole = f"({factor})" if " " in factor and (power > 1 or below) else factor
    return whole if power == 1 else f"{whole}^{power}"
