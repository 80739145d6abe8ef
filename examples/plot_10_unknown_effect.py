r"""
An effect that no catalogue has
===============================

No catalogue contains every effect. If the missing effect is not in it, the diagnosis has to say so,
and not name the most similar one. In this story somebody leans on the table for a moment during the
experiment. The report cannot say what it was, but it says when, and that is enough to write the
missing effect in ten lines.
"""

from dataclasses import dataclass

import control as ct
import matplotlib.pyplot as plt
import numpy as np

import ctrlid as cid

# %%
# The push
# --------
# The effect is a force that rises and falls. A user's own effect is a frozen dataclass with one
# formula. `candidates` gives the values from which a fit may start; the list `WHEN` is filled
# below, once the report has said at which time.

WHEN = [0.0]


@dataclass(frozen=True)
class Push(cid.effects.ForceEffect):
    """Somebody leaned on the table."""

    strength: float = cid.effects.parameter("{y}/s^2", neutral=0.0)
    time: float = cid.effects.parameter("s", instant=True)

    def force(self, m):
        """Return the acceleration."""
        return self.strength * np.exp(-(((m.t - self.time) / 0.2) ** 2))

    @classmethod
    def candidates(cls, loop, record=None):
        """Return where a fit may start."""
        return tuple(cls(0.0, time) for time in WHEN)


# %%
# The record
# ----------
# The record is that of a levitated ball, sampled at 2 ms, with a push of 1.5 m/s^2 after 4.3 s.

plant = cid.plants.maglev(m=0.0213, K=3.34e-6, g=9.81)
at = cid.operating_point(plant, output=0.012)
lead = cid.design_lead(cid.linearize(plant, at), crossover=110, phase_margin=50)
C = ct.sample_system(ct.ss(lead), 0.002, "tustin")
model = cid.Loop(plant, C, dt=0.002, at=at, free=("K",))
rig = model.with_parameters({"K": 1.03 * 3.34e-6}).with_effect(Push(1.5, 4.3))
r = cid.random_binary(5000, amplitude=1e-4, hold=25, around=at.output, seed=1)
record = cid.simulate(rig, r, sensor_noise=5e-6, seed=2)

# %%
# With the catalogue as it is
# ---------------------------
# The search finds the most similar effect, or a large random force. The report does not present
# them as the answer: it says that something is still missing, and that an effect which is named
# "may stand in for an effect that is not in the catalogue". In the upper part of the figure, the
# simulations before and after hardly differ.

first = cid.diagnose(model, record, progress=False)
print(first)
cid.plot.diagnosis(first)
plt.show()

# %%
# With the effect added to the catalogue
# --------------------------------------
# `where` has the one-step errors along each quantity. Along time they are large in one bin.

time = next(place for place in first.where if place.axis == "time")
worst = int(np.argmax(time.before))
print(time.words)
WHEN[:] = np.linspace(time.edges[worst], time.edges[worst + 1], 4)
second = cid.diagnose(model, record, catalogue=[*cid.effects.CATALOGUE, Push], progress=False)
print(second)
cid.plot.diagnosis(second)
plt.show()

# %%
# This story asserts that the verdict without the push in the catalogue is "unknown" or "partly
# explained", and that with it the push alone explains the record.

print(first.verdict, "->", second.verdict)
assert first.verdict in ("unknown", "partly explained")
assert second.gap.after < 0.5 * min(first.gap.before, first.gap.after)
assert time.edges[worst] - 0.3 < 4.3 < time.edges[worst + 1] + 0.3
assert second.verdict == "explained"
assert [finding.name for finding in second.findings] == ["Push"]
assert abs(second.effects[0].time - 4.3) < 0.02
assert abs(second.effects[0].strength - 1.5) < 0.05
