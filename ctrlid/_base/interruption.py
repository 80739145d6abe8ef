"""Where a long search ends before its time: a budget of seconds, a request to stop, Ctrl-C."""

import functools
import math
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import Any

from .errors import CtrlidError

# Of a budget at most this share is kept for what has to be done after a search.
MOST_KEPT = 0.25


class Stopped(Exception):
    """The budget of a search is spent.

    It is no refusal, so that nothing takes it for one, and it never leaves the search.
    """


@dataclass(frozen=True, eq=False)
class Budget:
    """How long a search may go on.

    Parameters
    ----------
    seconds : float, optional
        From now [s]; no end by default.
    beat : callable, optional
        Called without arguments at every pass of a filter, so that something moves on the screen.
    samples : float, optional
        How many samples filters may go through, which tells the work without a clock: the search
        ends at the same place on every machine, whatever is done side by side.
    """

    seconds: float = math.inf
    beat: Callable[[], None] | None = None
    samples: float = math.inf
    start: float = field(default_factory=time.monotonic)
    # A search within a search ends with the one around it.
    outer: "Budget | None" = field(default_factory=lambda: find_budget())
    _stop: threading.Event = field(default_factory=threading.Event)
    _spent: list[int] = field(default_factory=lambda: [0])
    _kept: list[float] = field(default_factory=lambda: [0.0])
    _lock: Any = field(default_factory=threading.Lock)

    def spend(self, samples: int) -> None:
        """Count samples that a filter goes through."""
        with self._lock:
            self._spent[0] += samples
        if self.outer is not None:
            self.outer.spend(samples)

    @property
    def spent(self) -> int:
        """Samples that filters went through."""
        return self._spent[0]

    @property
    def left_samples(self) -> float:
        """Samples that filters may still go through; negative where the last pass was too many."""
        around = math.inf if self.outer is None else self.outer.left_samples
        return min(around, self.samples - self.spent)

    def keep_back(self, seconds: float) -> None:
        """Keep seconds for what has to be done after the search, a quarter of all at most."""
        self._kept[0] = min(seconds, MOST_KEPT * self.seconds)

    @property
    def kept(self) -> float:
        """Seconds that the search leaves for what comes after it [s]."""
        return self._kept[0]

    def stop(self) -> None:
        """Ask the search to end at its next step."""
        self._stop.set()

    @property
    def asked(self) -> bool:
        """Whether `stop` was called, here or around it."""
        return self._stop.is_set() or (self.outer is not None and self.outer.asked)

    @property
    def left(self) -> float:
        """Seconds that are left; zero after `stop`, and where the samples are used up [s]."""
        if self.asked or self.left_samples < 0:
            return 0.0
        around = math.inf if self.outer is None else self.outer.left
        end = self.start + self.seconds - self.kept
        return max(0.0, min(around, end - time.monotonic()))

    @contextmanager
    def running(self, binding: bool = True) -> Iterator[None]:
        """Work under this budget; `check_budget` raises `Stopped` at its end if it is `binding`."""
        token = _BUDGET.set((self, binding))
        try:
            yield
        finally:
            _BUDGET.reset(token)


# Threads begin without a budget: what others have begun with them ends with those.
_BUDGET: ContextVar[tuple[Budget, bool] | None] = ContextVar("budget", default=None)


def find_budget() -> Budget | None:
    """Return the budget under which this thread works; None without one."""
    found = _BUDGET.get()
    return None if found is None else found[0]


@contextmanager
def ending() -> Iterator[None]:
    """Work on after the end of a budget: what is told of a search that was stopped."""
    budget = find_budget()
    if budget is None:
        yield
        return
    with budget.running(binding=False):
        yield


# Set between Ctrl-C and the next pass of a filter.
_INTERRUPTED = threading.Event()


@contextmanager
def hold_interrupt() -> Iterator[None]:
    """Let Ctrl-C wait for the end of a pass, where `check_budget` raises `KeyboardInterrupt`.

    Inside the compiled code of others it would become a `SystemError`, or be lost. A second Ctrl-C
    does not wait. Where the program has a handler of its own, or in another thread than the main
    one, nothing changes.
    """
    main = threading.current_thread() is threading.main_thread()
    if not main or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield
        return

    def note(number: int, frame: Any) -> None:
        if _INTERRUPTED.is_set():
            raise KeyboardInterrupt
        _INTERRUPTED.set()

    _INTERRUPTED.clear()
    signal.signal(signal.SIGINT, note)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        check_interrupt()


def check_interrupt() -> None:
    """Raise `KeyboardInterrupt` if Ctrl-C waits for it."""
    if _INTERRUPTED.is_set() and threading.current_thread() is threading.main_thread():
        _INTERRUPTED.clear()
        raise KeyboardInterrupt


def lend_budget(function: Callable[[], None]) -> Callable[[], None]:
    """Return a function that another thread calls under the budget of this one."""
    found = _BUDGET.get()
    if found is None:
        return function
    budget, binding = found
    lent = Budget(outer=budget)

    def call() -> None:
        with lent.running(binding):
            function()

    return call


def check_budget(samples: int = 0) -> None:
    """Raise `Stopped` if this thread works under a budget that is spent, by these samples too."""
    check_interrupt()
    found = _BUDGET.get()
    if found is None:
        return
    budget, binding = found
    budget.spend(samples)
    if budget.beat is not None:
        budget.beat()
    if binding and not budget.left:
        raise Stopped


def check_seconds(seconds: Any) -> float:
    """Return a budget in seconds, infinite for None, refused in words if it is no such number."""
    if seconds is None:
        return math.inf
    number = isinstance(seconds, int | float) and not isinstance(seconds, bool)
    if number and 0 < seconds <= sys.float_info.max:
        return float(seconds)
    raise CtrlidError(
        "seconds is the time after which the search ends with its best answer so far, a number "
        f"above 0, or None for no such end; given {seconds!r}"
    )


def keep_interrupt(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a compiled function out of which Ctrl-C comes as what it is.

    Where the signal arrives inside numba's code, numba reports a `SystemError` about its own
    result, and the `KeyboardInterrupt` is only the cause of its cause.

    Parameters
    ----------
    function : callable
        A function that numba compiled.

    Returns
    -------
    callable
        The same function.
    """

    @functools.wraps(function)
    def call(*arguments: Any) -> Any:
        try:
            return function(*arguments)
        except SystemError as reason:
            first: BaseException | None = reason
            while first is not None and not isinstance(first, KeyboardInterrupt):
                first = first.__cause__ or first.__context__
            if first is None:
                raise
        raise KeyboardInterrupt

    return call
