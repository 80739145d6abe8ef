"""Redesigned controllers: promised against achieved."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..._base.errors import CtrlidError
from ...design.redesigning import Redesign
from .axes import MARKERS, Picture, choose_line_style, finish_axes, require_kind, take_axes


def step(redesigns: Any, ax: Any = None) -> Picture:
    """Draw what redesigns promised against what they achieved on the physics.

    Parameters
    ----------
    redesigns : Redesign or mapping of str to Redesign
        From `redesign`: one, or several by a label, each with axes of its own.
    ax : matplotlib Axes or sequence of them, optional
        By default those of a new figure.

    Returns
    -------
    Picture
        With axes for each redesign, in their order.

    Raises
    ------
    CtrlidError
        If something else than redesigns is given.

    Examples
    --------
    >>> import ctrlid as cid
    >>> plant = cid.plants.maglev(m=0.0213, K=3.34e-6)
    >>> op = cid.operating_point(plant, output=0.012)
    >>> loop = cid.Loop(plant, None, dt=0.001, at=op)
    >>> G = cid.linearize(plant, op)
    >>> slow = cid.redesign(G, loop, crossover=100, phase_margin=50)
    >>> cid.plot.step(slow).axes[0].get_xlabel()
    'time after the step [s]'
    >>> fast = cid.redesign(G, loop, crossover=200, phase_margin=50)
    >>> cid.plot.step({"100 rad/s": slow, "200 rad/s": fast})
    Picture with 2 axes
    """
    several = redesigns if isinstance(redesigns, Mapping) else {"": redesigns}
    if not several:
        raise CtrlidError("plot.step has nothing to draw: the mapping is empty")
    needed = "plot.step draws a Redesign, as redesign() returns, or a mapping of them"
    for redesign in several.values():
        require_kind(redesign, Redesign, needed)
    size = (7.2, 3.2 * len(several)) if len(several) > 1 else None
    axes = take_axes(ax, len(several), size, sharex=True)
    ends = []
    for ax, (label, redesign) in zip(axes, several.items(), strict=True):
        ends.append(_draw_step(ax, redesign))
        if label:
            ax.get_legend().set_title(label)
            ax.get_legend().set_alignment("left")
    for ax in axes:
        ax.set_xlim(0, max(ends))
        ax.set_xlabel("time after the step [s]" if ax is axes[-1] else "")
    return Picture(axes)


def _draw_step(ax: Any, redesign: Redesign) -> float:
    """Draw the promised and the achieved response; return where the axis should end."""
    cases = (("promised on the model", redesign.promised, redesign.promised_step),
             ("achieved on the physics", redesign.achieved, redesign.achieved_step))  # fmt: skip
    for i, (what, performance, values) in enumerate(cases):
        if not performance.stable:
            label = f"{what}: UNSTABLE"
            if len(values) < len(redesign.time):
                label += f", the simulation stops after {redesign.time[len(values)]:.2g} s"
        elif not np.isfinite(performance.settling_time):
            label = f"{what}: DOES NOT SETTLE"
        else:
            label = (f"{what}: {performance.overshoot:.0f} % overshoot, "
                     f"settling time {performance.settling_time:.2g} s")  # fmt: skip
        ax.plot(redesign.time[: len(values)], values, label=label, **choose_line_style(i),
                marker=MARKERS[i], markevery=max(len(values) // 25, 1), markersize=4)  # fmt: skip
    promised = redesign.promised_step
    restless = any(p.stable and not np.isfinite(p.settling_time) for _, p, _ in cases)
    reach = (1.5 if restless else 0.6) * max(float(np.ptp(promised)), 1e-12)
    low, high = ax.get_ylim()
    ax.set_ylim(max(low, promised.min() - reach), min(high, promised.max() + reach))
    settled = [t for t in (redesign.promised.settling_time, redesign.achieved.settling_time)
               if np.isfinite(t)]  # fmt: skip
    ax.set_ylabel("output per step\nof the reference [1]")
    finish_axes(ax, columns=1)
    last = float(redesign.time[-1])
    # The axis is long enough to see whether the promise is kept and short enough to see how.
    return min(last, max(3 * max(settled), 20 * redesign.loop.dt)) if settled else last
