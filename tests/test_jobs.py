"""Work side by side in threads: order, errors, work within work, forked processes."""

import os
import threading
import time

import numpy as np
import pytest

from ctrlid._base.jobs import count_processors, run_side_by_side


def test_results_are_in_the_order_of_the_items():
    def slow_at_first(k):
        time.sleep(0.002 * (5 - k) if k < 5 else 0.0)
        return k * k

    assert run_side_by_side(slow_at_first, range(40)) == [k * k for k in range(40)]
    assert run_side_by_side(abs, iter([-3])) == [3]
    assert run_side_by_side(abs, ()) == []


@pytest.mark.skipif(count_processors() < 2, reason="one processor does one thing at a time")
def test_two_items_are_in_work_at_a_time():
    both = threading.Barrier(2)

    def meet(k):
        both.wait(timeout=20)  # broken, were one done after the other
        return k

    assert run_side_by_side(meet, (1, 2)) == [1, 2]


def test_threads_know_what_their_caller_has_told_numpy():
    both = threading.Barrier(min(2, count_processors()))

    def overflow(x):
        both.wait(timeout=20)
        return np.log(x)

    with np.errstate(invalid="ignore"):
        assert np.isnan(run_side_by_side(overflow, [np.float64(-1.0)] * both.parties)).all()
    with np.errstate(invalid="raise"), pytest.raises(FloatingPointError):
        run_side_by_side(overflow, [np.float64(-1.0)] * both.parties)


def test_an_error_is_raised():
    for bad in (0, 7):
        with pytest.raises(ZeroDivisionError):
            run_side_by_side(lambda k, bad=bad: 1 / (k - bad), range(8))


def test_work_within_work_ends():
    def sum_of(n):
        return sum(run_side_by_side(lambda k: k, range(n)))

    assert run_side_by_side(sum_of, range(30)) == [n * (n - 1) // 2 for n in range(30)]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are not forked here")
@pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")
def test_a_forked_process_starts_threads_of_its_own():
    run_side_by_side(abs, range(4))  # the threads of this process, which the other does not have
    child = os.fork()
    if child == 0:
        os._exit(0 if run_side_by_side(abs, (-1, -2, -3)) == [1, 2, 3] else 1)
    until = time.monotonic() + 30
    while (ended := os.waitpid(child, os.WNOHANG)) == (0, 0) and time.monotonic() < until:
        time.sleep(0.01)
    if ended == (0, 0):
        os.kill(child, 9)
        os.waitpid(child, 0)
    assert ended == (child, 0)
