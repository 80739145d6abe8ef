r"""
MagnetoShield: a magnet that iron attracts, and the benefit in a redesign
=========================================================================

The data are public records of a small levitation rig: a permanent magnet hangs below a solenoid,
and a digital controller holds it at five set-points and adds noise to the voltage. The given model
is that of a ball of iron, ``m x" = m g - K V^2/x^2``. It lacks two effects here: the iron core
attracts the magnet even without current, and the voltage acts one sample late. `diagnose` is told
neither.

The records are not part of ctrlid. They are downloaded once, or read from the folder that the
environment variable CTRLID_DATA_DIR names.
"""

from dataclasses import replace

import control as ct
import matplotlib.pyplot as plt

import ctrlid as cid

# %%
# What is missing?
# ----------------
# The reference was not logged, so the gap is that of a prediction eight samples ahead. The
# parameters are fitted at 14 mm, and the gap is measured at 15 mm, a set-point that was not used
# for the fit.

records = cid.datasets.load("magnetoshield_r3")
plant = cid.plants.maglev(m=0.000945, K=0.000945 * 9.81 * 0.014**2 / 5.0**2)
at = cid.operating_point(plant, output=0.014)
model = cid.Loop(plant, None, dt=records[0].dt, at=at, free=("K",))
found = cid.diagnose(model, records[0], validation=records[3], progress=False)
print(found)

cid.plot.diagnosis(found)
plt.show()

# %%
# The voltage at rest
# -------------------
# For a ball of iron, the equilibrium voltage is proportional to the distance. The table compares
# the measured voltages with those of the model as given and of the completed model, which was
# fitted at 14 mm only.

given = cid.Loop(plant, None, dt=records[0].dt, at=at)
physics = given.with_parameters({"K": found.loop.parameters["K"]})
for finding in found.findings:
    physics = physics.with_effect(finding.effect)
errors = []
print("set-point   measured   as given   completed [V]")
for record in sorted(records, key=lambda r: r.y.mean()):
    x = float(record.y.mean())
    volts = [cid.operating_point(loop.system(), output=x).input for loop in (given, physics)]
    print(f"{1e3 * x:6.1f} mm{record.u.mean():11.2f}{volts[0]:11.2f}{volts[1]:11.2f}")
    errors.append(abs(volts[1] - record.u.mean()))

# %%
# What the names are worth
# ------------------------
# A lead is designed on the model as given and another one on the completed model. Both are tried on
# the completed physics.

rest = cid.operating_point(physics.system(), output=0.014).input
physics = replace(physics, at=cid.OperatingPoint((0.014, 0.0), rest, 0.014))
outcomes = {}
for name, loop in {"as given": given, "completed": physics}.items():
    G = ct.tf(ct.sample_system(ct.ss(loop.linearize()), loop.dt, "zoh"))
    outcomes[name] = cid.redesign(G, physics, crossover=80, phase_margin=30)
    print(f"designed on the model {name}: {outcomes[name].verdict}")

cid.plot.step({f"designed on the model {name}": o for name, o in outcomes.items()})
plt.show()

delay = next(f for f in found.findings if "InputDelay" in f.names)
assert found.verdict == "partly explained"
assert abs(next(e.delay for e in (delay.effect, *delay.alternatives)
                if type(e).__name__ == "InputDelay") / records[0].dt - 1) < 0.1  # fmt: skip
# On this rig a straight line predicts better than any model, so the floor is what counts. A version
# that took equal readings of the converter in a row for new ones left 0.10 mm at a floor of 0.077.
assert found.gap.after < 1.3 * found.gap.floor
assert not any("PositionRipple" in f.names for f in (*found.findings, *found.stand_ins))
assert outcomes["completed"].achieved.phase_margin > 29
assert not outcomes["as given"].achieved.stable
assert max(errors) < 0.5
