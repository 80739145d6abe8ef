"""Records and loops of several signals: their names, and what takes one signal only."""

from collections.abc import Mapping, Sequence
from typing import Any

from .errors import CtrlidError
from .text import write_list


def list_signals(key: str, given: Any, count: int) -> tuple[str, ...]:
    """Return one word for each signal of r, u or y: those given, else numbered ones.

    Parameters
    ----------
    key : str
        ``"r"``, ``"u"`` or ``"y"``.
    given : str or sequence of str or None
        The words.
    count : int
        How many signals there are.

    Returns
    -------
    tuple of str
        The words.

    Examples
    --------
    >>> list_signals("y", None, 2), list_signals("u", None, 1), list_signals("y", "gap", 1)
    (('y[0]', 'y[1]'), ('u',), ('gap',))
    """
    if given is None:
        return (key,) if count == 1 else tuple(f"{key}[{k}]" for k in range(count))
    return (given,) if isinstance(given, str) else tuple(given)


def is_several(given: Any) -> bool:
    """Tell whether a record has several inputs or outputs."""
    return any(len(given.signals[key]) != 1 for key in ("u", "y"))


def require_one_signal(function: str, *given: Any) -> None:
    """Refuse a record or a loop with several signals where a function takes one of each.

    Parameters
    ----------
    function : str
        What was called.
    *given : Record, Loop or sequence of them
        What it was given; anything else passes, since others check it.

    Raises
    ------
    CtrlidError
        If one of them has several inputs, outputs or references.
    """
    for one in given:
        if isinstance(one, list | tuple):
            require_one_signal(function, *one)
            continue
        # A class has the property itself, and is refused by whoever needs one of its values.
        signals: Mapping[str, Sequence[str]] = (
            {} if isinstance(one, type) else getattr(one, "signals", {})
        )
        several = [(key, names) for key, names in signals.items() if len(names) != 1]
        if not several:
            continue
        listed = write_list([f"{key} = ({', '.join(names)})" for key, names in several])
        raise CtrlidError(
            f"{function} takes one input and one output; the {type(one).__name__.lower()} has "
            f"{listed}. fit_loop, fit_arx, fit_iv, predict, simulate and redesign with "
            "design= take several. Of a record, pick one with "
            f"record.select({', '.join(f'{key}={names[0]!r}' for key, names in several if names)})"
        )
