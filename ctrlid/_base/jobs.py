"""Work shared among processes, threads or a cluster: through joblib, in bounded memory."""

from __future__ import annotations

import contextvars
import functools
import math
import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import islice
from numbers import Integral
from typing import Any, TypeVar

from .errors import CtrlidError
from .interruption import Budget, check_budget, check_interrupt, find_budget, lend_budget
from .rounding import keep_numpy_quiet

Item = TypeVar("Item")
Result = TypeVar("Result")

# So many items are in work at a time, which bounds memory.
BATCH = 16
# Each process takes memory of its own, before it has done anything; more than these are a slip.
MOST = 256


def check_jobs(jobs: Any) -> int | None:
    """Return a number of jobs as joblib takes it, refused in words otherwise."""
    if jobs is None:
        return None
    if isinstance(jobs, Integral) and not isinstance(jobs, bool) and 0 < abs(int(jobs)) <= MOST:
        return int(jobs)
    raise CtrlidError(
        f"jobs is a number of processes from 1 to {MOST}, or -1 for all processors, or None for "
        f"what joblib.parallel_config says; given {jobs!r}"
    )


def share_out(
    function: Callable[[Item], Result], items: Iterable[Item], jobs: int | None
) -> Iterator[Result]:
    """Apply a function to each item, in order, with at most `BATCH` items in memory.

    Parameters
    ----------
    function : callable
        It and the items must be picklable if there is more than one job.
    items : iterable
        May be a generator without end in sight.
    jobs : int or None
        As in joblib; None is 1, or what ``joblib.parallel_config`` says. Which backend does the
        work (processes, threads, dask) is for that to say too.

    Yields
    ------
    object
        ``function(item)`` for each item, in the order of the items.

    Examples
    --------
    >>> list(share_out(abs, (-1, 2, -3), None))
    [1, 2, 3]
    """
    import joblib  # Late, since it takes a while and a fit alone does not need it.

    if joblib.effective_n_jobs(jobs) == 1:
        for item in items:
            check_budget()
            yield function(item)
        return
    source = iter(items)
    with joblib.Parallel(n_jobs=jobs, return_as="generator") as run:
        while batch := list(islice(source, BATCH)):
            try:
                for result, samples in run(_list_calls(function, batch)):
                    check_budget(samples)
                    yield result
            finally:
                # A process that Ctrl-C ended before its first item is reported as lost.
                check_interrupt()


def _list_calls(function: Callable[[Item], Result], items: Sequence[Item]) -> Iterator[Any]:
    """Yield the calls that joblib makes, each with what is left when it is handed out."""
    budget = find_budget()
    import joblib

    for item in items:
        left = (math.inf, math.inf) if budget is None else (budget.left, budget.left_samples)
        yield joblib.delayed(_call_elsewhere)(function, item, *left)


def _call_elsewhere(
    function: Callable[[Item], Result], item: Item, left: float, samples: float
) -> tuple[Result, int]:
    """Call a function in another process or thread, for so many seconds and samples.

    Returns
    -------
    result : object
        What it returns.
    samples : int
        Samples that filters went through for it.
    """
    process = multiprocessing.parent_process() is not None
    if process and threading.current_thread() is threading.main_thread():
        # Ctrl-C reaches all processes of a terminal; the one that asked decides what it means.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    budget = Budget(left, samples=samples)
    with budget.running():
        return keep_numpy_quiet(function)(item), budget.spent


def run_side_by_side(function: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """Apply a function to each item in threads, one for each processor, in order.

    For work whose loops are compiled and leave Python alone meanwhile. Nothing in it may build or
    call CasADi's functions: whole candidates of a diagnosis in threads crashed once in a while.

    Parameters
    ----------
    function : callable
        Called from several threads.
    items : iterable
        Its arguments.

    Returns
    -------
    list
        ``function(item)`` for each item, in the order of the items.

    Examples
    --------
    >>> run_side_by_side(abs, (-1, 2, -3))
    [1, 2, 3]
    """
    given = list(items)
    waiting, results = deque(range(len(given))), dict[int, Result]()

    def take() -> None:
        while waiting:
            try:
                k = waiting.popleft()
            # Another thread may have taken the last item.
            except IndexError:
                return
            try:
                results[k] = function(given[k])
            except BaseException:
                # Nobody waits for the rest any more, after Ctrl-C for instance.
                waiting.clear()
                raise

    help_out = lend_budget(take)
    # A thread does not know by itself what its caller has told numpy of rounding and overflows.
    helpers = [
        _start_threads().submit(contextvars.copy_context().run, help_out)
        for _ in range(min(count_processors(), len(given)) - 1)
    ]
    # The calling thread works too, while the others start.
    take()
    for helper in helpers:
        # A thread that has not started yet is not needed any more.
        if not helper.cancel():
            helper.result()
    return [results[k] for k in range(len(given))]


@functools.cache
def count_processors() -> int:
    """Return the number of processors that this process may use."""
    import joblib

    return int(joblib.cpu_count())


@functools.cache
def _start_threads() -> ThreadPoolExecutor:
    """Return the threads, started once: that takes as long as a short job."""
    return ThreadPoolExecutor(count_processors())


# A forked process has none of its parent's threads.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_start_threads.cache_clear)
