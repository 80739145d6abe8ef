"""The demonstration of a diagnosis: a hidden effect is found in a simulated record."""

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from ..._base import text as _text
from ...data.references import random_binary
from ...design.lead import design_lead
from ...diagnosis import diagnose
from ...diagnosis.result import Diagnosis
from ...diagnosis.wording import write_percent
from ...effects import (
    AbstractEffect,
    ActuatorLag,
    CoulombFriction,
    EddyCurrentDamping,
    InputDelay,
    ViscousFriction,
)
from ...loop.loop import Loop
from ...loop.simulation import simulate
from ...physics.linearization import linearize, operating_point
from ...physics.plants import maglev
from .. import plot
from ..html_page import Section
from ..tables import Table

TITLES = ("Something is hidden", "What is missing", "What it was")
# Mass of the ball [kg] and constant of the magnet [N m^2/V^2], as in the paper.
BALL, MAGNET = 0.0213, 3.34e-6
# Gap at rest and size of the jumps of the reference [m].
GAP, AMPLITUDE = 0.012, 3e-4
# Sampling period [s].
PERIOD = 0.002
# The reference is tossed every so many samples.
HOLD = 50
# Standard deviations of the sensor noise [m] and of the random force [m/s^2].
SENSOR_NOISE, FORCE_NOISE = 1e-5, 0.03
# Demands on the lead: crossover [rad/s] and phase margin [deg].
CROSSOVER, PHASE_MARGIN = 100.0, 50.0
# A record of at most so many samples is diagnosed in seconds.
LONGEST = 10_000
# The magnet's constant is believed with this relative error.
BELIEVED = 0.05
# The sizes are ordinary ones, which a student's apparatus has and a textbook leaves out.
HIDDEN: tuple[tuple[type[AbstractEffect], dict[str, tuple[float, float]]], ...] = (
    (CoulombFriction, {"fc": (0.1, 0.2)}),
    (ViscousFriction, {"c": (3.0, 8.0)}),
    (ActuatorLag, {"tau": (0.001, 0.003)}),
    (InputDelay, {"delay": (0.001, 0.003)}),
    (EddyCurrentDamping, {"ce": (0.3, 0.8)}),
)


def hide_effect(seed: int) -> tuple[AbstractEffect, float]:
    """Draw the hidden effect, and the believed over the true value of the magnet's constant.

    Parameters
    ----------
    seed : int
        Seed of the draw.

    Returns
    -------
    (AbstractEffect, float)
        The effect and the factor.

    Examples
    --------
    >>> hide_effect(3) == hide_effect(3)
    True
    """
    rng = np.random.default_rng([seed, 2])
    kind, ranges = HIDDEN[int(rng.integers(len(HIDDEN)))]
    sizes = {name: float(f"{rng.uniform(*ends):.3g}") for name, ends in ranges.items()}
    return kind(**sizes), 1 + BELIEVED * float(rng.choice([-1, 1]))


def tell_diagnosis(
    *, samples: int = LONGEST, seed: int = 1, progress: bool = False
) -> Iterator[Section]:
    """Hide an effect in a record, diagnose the record, and reveal what was hidden.

    Parameters
    ----------
    samples : int, optional
        Length of the record, at most 10 000.
    seed : int, optional
        Seed of what is hidden, the reference and the noise.
    progress : bool, optional
        Whether the diagnosis shows its progress.

    Yields
    ------
    Section
        One for each of `TITLES`.
    """
    effect, factor = hide_effect(seed)
    toss, hiss = (int(s) for s in np.random.SeedSequence([seed, 3]).generate_state(2))
    plant = maglev(m=BALL, K=MAGNET)
    at = operating_point(plant, output=GAP)
    lead = design_lead(linearize(plant, at), crossover=CROSSOVER, phase_margin=PHASE_MARGIN)
    loop = Loop(plant, lead.sample(PERIOD, "tustin"), dt=PERIOD, at=at, free=("K",))
    r = random_binary(min(samples, LONGEST), amplitude=AMPLITUDE, hold=HOLD, around=GAP, seed=toss)
    record = simulate(loop.with_effect(effect), r, sensor_noise=SENSOR_NOISE,
                      force_noise=FORCE_NOISE, seed=hiss)  # fmt: skip
    model = loop.with_parameters({"K": factor * MAGNET})
    axes = plot.record(record[: min(len(record), 16 * HOLD)])
    text = (
        f"The same ball hangs at a gap of {1e3 * GAP:g} mm, and the reference jumps by "
        f"{2e3 * AMPLITUDE:g} mm, which is enough for nonlinear effects to show. This rig has an "
        "effect that the equation m x'' = m g - K V^2/x^2 lacks. The seed has drawn it from five, "
        f"and its size. The model does not contain it, and its K is {100 * abs(factor - 1):.0f} % "
        f"too {'large' if factor > 1 else 'small'}. The record has {len(record)} samples, one "
        f"every {1e3 * PERIOD:g} ms, with sensor noise of {1e6 * SENSOR_NOISE:g} um and a random "
        f"force of {FORCE_NOISE:g} m/s^2.\n\n"
        "diagnose() gets the model and the record. It is not told which effect was hidden."
    )
    yield Section(TITLES[0], text, None, {"The beginning of the record.": axes})
    found = diagnose(model, record, progress=progress)
    yield Section(TITLES[1], "", found)
    yield Section(
        TITLES[2], reveal_effect(found, effect, loop), _make_size_table(found, effect), {}
    )


def reveal_effect(found: Diagnosis, effect: AbstractEffect, loop: Loop) -> str:
    """Return in words what was hidden and whether it was found.

    Parameters
    ----------
    found : Diagnosis
        What was found.
    effect : AbstractEffect
        What was hidden.
    loop : Loop
        The loop, for the units.

    Returns
    -------
    str
        The words.
    """
    name = type(effect).__name__
    named = {n for f in found.findings for n in (*f.names, *f.equivalents)}
    first = found.findings[0] if found.findings else None
    if first is not None and first.name == name and len(found.findings) == 1:
        verdict = "It was found, and "
        verdict += ("no alternative was named." if len(first.names) == 1 else
                    "effects that resemble it were named beside it.")  # fmt: skip
    elif name in named:
        verdict = "It is among the effects that were named."
    else:
        verdict = f"IT WAS NOT NAMED: the verdict is {found.verdict!r}."
    gap = found.gap
    text = f"The hidden effect was {effect.text(loop)}. {verdict}"
    if math.isfinite(gap.before) and gap.before > 0 and found.findings:
        before, after, floor = (
            _text.write_quantity(v, gap.unit) for v in (gap.before, gap.after, gap.floor)
        )
        closed = f"by {write_percent(1 - gap.after / gap.before)}"
        changed = f"decreased from {before} to {after}, {closed}"
        if gap.after >= gap.before:
            changed = f"DID NOT DECREASE: it was {before} and is {after}"
        text += (f" On samples that were not used for the fit, the RMS error of the {gap.name} "
                 f"{changed}; the noise floor is {floor}.")  # fmt: skip
    return text


def _make_size_table(found: Diagnosis, effect: AbstractEffect) -> Any:
    """Return the true values beside the fitted ones."""
    own = next((f for f in found.findings if type(f.effect) is type(effect)), None)
    rows = [(c.name, f"{MAGNET:.5g}", f"{c.given:.5g}", _text.with_error(c.after, c.standard_error))
            for c in found.calibrated if c.name == "K"]  # fmt: skip
    for name, value in effect.values().items():
        fitted = "not found" if own is None else _text.with_error(
            own.effect.values()[name], own.standard_errors.get(name, math.nan))  # fmt: skip
        rows.append((f"{type(effect).__name__}.{name}", f"{value:.5g}", "none", fitted))
    return Table(("", "true", "model", "fitted"), tuple(rows))
