"""Functions without a name of their own, pickled by their code."""

import pickle
from typing import Any

from .errors import CtrlidError


def pack_by_value(thing: Any, words: str) -> bytes:
    """Pickle a value whose functions may be lambdas or stand inside others.

    Parameters
    ----------
    thing : object
        The value.
    words : str
        What it is, for the message.

    Returns
    -------
    bytes
        What `pickle.loads` makes the value of. The functions need the same version of Python.

    Raises
    ------
    CtrlidError
        If something in it cannot be pickled, such as an open file.

    Examples
    --------
    >>> import pickle
    >>> pickle.loads(pack_by_value(lambda x: 2 * x, "a function"))(3)
    6
    """
    import joblib  # Late, since it takes a while.

    try:
        return pickle.dumps(joblib.wrap_non_picklable_objects(thing, keep_wrapper=False))
    except (TypeError, AttributeError, pickle.PicklingError) as reason:
        raise CtrlidError(
            f"{words} cannot be pickled ({reason}). Save a diagnosis with found.save(...), which "
            "needs no pickle, or leave what cannot be pickled out of the functions"
        ) from reason
