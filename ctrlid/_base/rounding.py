"""Numbers that overflow or vanish within a computation, whatever numpy is told about them."""

import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import numpy as np

Given = ParamSpec("Given")
Answer = TypeVar("Answer")

# What becomes of an overflow, a division by zero and the like inside a public function. Results
# are checked where they can fail, so that users see refusals and no warnings of numpy. The tests
# of ctrlid set this to "warn".
HANDLING = {"divide": "ignore", "over": "ignore", "invalid": "ignore", "under": "ignore"}


def keep_numpy_quiet(function: Callable[Given, Answer]) -> Callable[Given, Answer]:
    """Run a public function under our own handling of floating-point errors.

    ``np.seterr(all="raise")``, with which some search their own code for errors, would stop it
    at every number that dies out.

    Examples
    --------
    >>> with np.errstate(all="raise"):
    ...     keep_numpy_quiet(lambda x: x * x)(np.array([1e-200]))
    array([0.])
    """

    @functools.wraps(function)
    def handled(*args: Given.args, **kwargs: Given.kwargs) -> Answer:
        with np.errstate(**HANDLING):  # type: ignore[arg-type]
            return function(*args, **kwargs)

    return handled
