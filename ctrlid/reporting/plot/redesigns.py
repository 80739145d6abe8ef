"""Redesigned controllers: promised against achieved."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..._base.arguments import explain_names
from ..._base.errors import CtrlidError
from ..._base.text import choose_prefix, with_unit
from ...design.controller_trial import ControllerTrial
from ...design.redesigning import Redesign
from ...design.reference_steps import ReferenceStep, StepMotion
from ...loop.loop import Loop
from .axes import MARKERS, Picture, choose_line_style, figure, finish_axes, require_kind, take_axes


@explain_names
def step(redesigns: Any, ax: Any = None) -> Picture:
    """Draw what redesigns promised against what they achieved on the physics.

    Parameters
    ----------
    redesigns : Redesign, mapping of str to Redesign, or ControllerTrial
        From `redesign`: one, or several by a label, each with axes of its own. Of a
        `ControllerTrial` a column for each reference shows all outputs, then all inputs.
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
    if isinstance(redesigns, ControllerTrial):
        return _draw_trial(redesigns, ax)
    several = redesigns if isinstance(redesigns, Mapping) else {"": redesigns}
    if not several:
        raise CtrlidError("plot.step has nothing to draw: the mapping is empty")
    needed = "plot.step draws a Redesign, as redesign() returns, or a mapping of them"
    for redesign in several.values():
        if isinstance(redesign, Loop):
            raise CtrlidError(f"{needed}; a Loop makes no promise: simulate it on a step of r, and "
                              "draw that with plot.record(simulate(loop, r))")  # fmt: skip
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


def _draw_trial(trial: ControllerTrial, ax: Any) -> Picture:
    """Draw all signals after a step of each reference, one reference in each column."""
    signals, units, steps = trial.loop.signals, trial.loop.known_units, trial.steps
    if not steps:
        raise CtrlidError("plot.step has nothing to draw: the controller has no reference")
    rows = [("y", k, name) for k, name in enumerate(signals["y"])]
    rows += [("u", k, name) for k, name in enumerate(signals["u"])]
    if ax is None:
        size = (max(7.2, 4.8 * len(steps)), 1.4 + 1.7 * len(rows))
        ax = figure(len(rows), len(steps), size, sharex="col").axes.ravel()
    axes = take_axes(ax, len(rows) * len(steps)).reshape(len(rows), len(steps))
    for row, (key, k, name) in enumerate(rows):
        # A signal has one unit in all columns.
        sizes = [np.max(np.abs(getattr(motion, key)[k]), initial=0.0)
                 for step in steps for motion in (step.promised, step.achieved)]  # fmt: skip
        factor, unit = choose_prefix(float(np.max(sizes)), units.get(name, ""))
        for column, step in enumerate(steps):
            one = axes[row, column]
            for i, (what, motion) in enumerate(
                (("promised", step.promised), ("achieved", step.achieved))
            ):
                values = factor * getattr(motion, key)[k]
                label = f"{what}: {_describe_motion(motion, step)}" if row == 0 else None
                one.plot(step.time[: len(values)], values, label=label, **choose_line_style(i),
                         marker=MARKERS[i], markevery=max(len(values) // 25, 1),
                         markersize=4)  # fmt: skip
            # Short names stand one above another where columns are narrow.
            one.set_ylabel(with_unit(name, unit))
            finish_axes(one, legend=row == 0, columns=1, size="small")
            one.set_xlabel(f"time after the step of {step.reference} [s]" if row == len(rows) - 1
                           else "")  # fmt: skip
    for column, step in enumerate(steps):
        axes[-1, column].set_xlim(0, _find_end(step))
    return Picture(axes.ravel())


def _describe_motion(motion: StepMotion, step: ReferenceStep) -> str:
    """Return how a response went, in a few words."""
    if motion.failure is not None:
        return "UNSTABLE"
    if np.isnan(motion.settling_time):
        return f"{step.output} returns to rest"
    if not np.isfinite(motion.settling_time):
        return "DOES NOT SETTLE"
    return f"{motion.overshoot:.0f} % overshoot, settling time {motion.settling_time:.2g} s"


def _find_end(step: ReferenceStep) -> float:
    """Return where the axis of time should end."""
    settled = [t for t in (step.promised.settling_time, step.achieved.settling_time)
               if np.isfinite(t)]  # fmt: skip
    last = float(step.time[-1])
    return min(last, 2 * max(settled)) if settled and max(settled) > 0 else last


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
