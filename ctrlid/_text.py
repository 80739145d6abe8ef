"""Numbers and sentences for people; shared by every report."""

from __future__ import annotations

import math


def number(value: complex, digits: int = 7) -> str:
    """Shortest usual form of a real or complex number."""
    value = complex(value)
    if value.imag == 0:
        return f"{value.real:.{digits}g}"
    return f"{value.real:.{digits}g}{value.imag:+.{digits}g}j"


def with_error(value: complex, error: float) -> str:
    """``value ± error`` with as many digits as the error allows.

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
        return f"{number(value)} (fixed)"
    if not math.isfinite(error) or not math.isfinite(abs(value)):
        return f"{number(value)} ± {error:g}"
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


def listing(items: list[str] | tuple[str, ...]) -> str:
    """Join items as in ``a, b and c``."""
    items = list(items)
    if len(items) < 2:
        return "".join(items)
    return ", ".join(items[:-1]) + " and " + items[-1]
