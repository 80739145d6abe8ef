"""What a diagnosis tells while it works: a bar in terminal or notebook, else a line a round."""

import math
import sys
import time
from typing import Any

from tqdm import tqdm

from .._base.interruption import Budget
from .._base.text import write_count, write_number
from ..effects.base import name_with_subject
from .candidates import Trial
from .thresholds import THRESHOLD

# The bar is drawn anew after so many seconds, also while nothing is finished.
REFRESH = 0.5
BAR = "{desc} |{bar:20}| {n_fmt}/{total_fmt}{postfix}"
# A step without candidates has nothing to count.
PLAIN = "{desc}{postfix}"


def _runs_in_notebook() -> bool:
    """Whether a kernel shows what is written, whose front end redraws a line after a return.

    A kernel has IPython loaded, so that nothing is imported here.
    """
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return getattr(shell, "kernel", None) is not None


class Progress:
    """What a diagnosis is doing, how much of it is done, what leads, and how long it may take.

    Parameters
    ----------
    shown : bool
        Whether anything is shown.
    """

    def __init__(self, shown: bool) -> None:
        self.start = self.drawn = self.begun = self.first = time.monotonic()
        self.step, self.round = "checking the records", ""
        self.done, self.total, self.ranked = 0, 0, True
        self.leader: Trial | None = None
        # Where the search was stopped and after what; empty if it was not.
        self.ended = self.spent = ""
        self.budget: Budget | None = None
        terminal = sys.stderr.isatty() or _runs_in_notebook()
        self.lines = shown and not terminal
        self.bar = tqdm(total=0, disable=not (shown and terminal), leave=False, bar_format=BAR)

    def tell(self, step: str, *, ranked: bool = True) -> None:
        """Begin a step; what stands before its colon is the round that it belongs to.

        Parameters
        ----------
        step : str
            What is done in it.
        ranked : bool, optional
            Whether the candidates that are fitted in it compete with each other.
        """
        head = step.partition(":")[0]
        now = time.monotonic()
        if head != self.round:
            if self.lines:
                self._write_line(head, now)
            # What led in a round leads nothing after it.
            self.leader = None
            self.round, self.begun = head, now
        self.step, self.ranked, self.done, self.total = step, ranked, 0, 0
        self._draw(now)

    def _write_line(self, head: str, now: float) -> None:
        """Write what is begun, how long what was before it took, and what led in it."""
        words = f"ctrlid diagnose: {now - self.start:.0f} s, {head}"
        if self.leader is not None or (self.round and now - self.begun >= 1):
            last = f"{self.round} took {now - self.begun:.0f} s"
            if self.leader is not None:
                last += f", {self.describe_leader()}"
            words += f" ({last})"
        sys.stderr.write(f"{words}\n")
        sys.stderr.flush()

    def begin(self, total: int) -> None:
        """Begin with so many candidates."""
        if total:
            self.done, self.total, self.first = 0, total, time.monotonic()
            self._draw(self.first)

    def count(self, result: Any) -> None:
        """Count a candidate, which may lead from now on."""
        self.done += 1
        if self.ranked and isinstance(result, Trial) and result.net_gain > 0:
            lead = self.leader
            if lead is None or result.net_gain > lead.net_gain:
                self.leader = result
        self.beat()

    def beat(self) -> None:
        """Draw the bar anew, if it is time."""
        now = time.monotonic()
        if now - self.drawn > REFRESH:
            self._draw(now)

    def _draw(self, now: float) -> None:
        self.drawn = now
        if self.bar.disable:
            return
        self.bar.n, self.bar.total = self.done, self.total
        self.bar.bar_format = BAR if self.total else PLAIN
        self.bar.set_description_str(f"diagnose, {now - self.start:.0f} s: {self.step}",
                                     refresh=False)  # fmt: skip
        more = [self.describe_leader()] if self.leader is not None else []
        if self.done:
            rest = (now - self.first) / self.done * (self.total - self.done)
            more.append(f"about {rest:.0f} s more for this step")
        self.bar.set_postfix_str("; ".join(more), refresh=False)
        self.bar.refresh()

    def describe_leader(self) -> str:
        """Say what leads, and by how much."""
        assert self.leader is not None
        gain = self.leader.gain
        evidence = write_number(gain, 3) if gain < THRESHOLD.certain else f"{gain:.0f}"
        return f"{name_with_subject(self.leader.effect)} leads with an evidence of {evidence}"

    def describe_place(self) -> str:
        """Say where the search is."""
        words = self.step
        if self.total:
            words += f", {self.done} of {write_count(self.total, 'candidate')} done"
        if self.leader is not None:
            words += f"; {self.describe_leader()}"
        return words

    def make_budget(self, seconds: float, samples: float, started: float) -> Budget:
        """Return a budget of samples, and of seconds since a start, that keeps the bar moving."""
        self.budget = Budget(seconds, self.beat, samples, started)
        return self.budget

    def end(self) -> None:
        """Note where the search is at its end and what was spent, the first time."""
        if self.ended:
            return
        self.ended = self.describe_place()
        budget = self.budget
        # A process of its own that was stopped by its work says no more of what it did.
        timed = budget is None or math.isfinite(budget.seconds) or budget.asked
        if budget is not None and (budget.left_samples < 0 or not timed):
            size = write_number(THRESHOLD.search_samples / 1e6, 3)
            self.spent = f"the work of {size} million filtered samples that it has without seconds="
        else:
            spent = time.monotonic() - self.start
            self.spent = f"{spent:.0f} s" if spent >= 10 else f"{spent:.1f} s"

    def settle(self) -> None:
        """Forget that the search was stopped, for what it had found answers the question."""
        self.ended = self.spent = ""

    def close(self) -> None:
        """Remove the bar."""
        self.bar.close()
