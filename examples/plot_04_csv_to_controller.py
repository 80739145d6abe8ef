r"""
Tutorial: from a CSV log to a redesigned controller
===================================================

You have a levitation rig that works and a CSV file from its data logger, and you want a faster
controller. This tutorial shows all steps: read the log, check it, write down the model that you
believe, fit, find out that the model lacks something, let `diagnose` name it, redesign the
controller, and see what the new controller achieves with and without the named effect.
"""

import tempfile
from pathlib import Path

import control as ct
import matplotlib.pyplot as plt
import numpy as np

import ctrlid as cid

# %%
# Before we start: making the log
# -------------------------------
# This manual has no rig. So we simulate one and write the file as a data logger would, rounded to
# 0.1 micrometre and a tenth of a millivolt. The rig differs in two ways from its data sheet: its
# magnet is 4 % stronger, and its converter delays the voltage by 2 ms. After this block only the
# file is used. Skip this block if you have a log of your own.

folder = Path(tempfile.mkdtemp())
path = folder / "levitation.csv"
dt = 0.002
DELAY = 0.002
lead_on_the_rig = ct.tf([-4281.0, 4080.0], [1.0, -0.494], dt)  # volts per metre of r - y


def the_rig(controller):
    """Return what nobody has: the rig as it is."""
    papers = cid.plants.maglev(m=0.0213, K=3.34e-6)
    at = cid.operating_point(papers, output=0.012)
    rig = cid.Loop(papers, controller, dt=dt, at=at).with_parameters({"K": 1.04 * 3.34e-6})
    return rig.with_effect(cid.effects.InputDelay(delay=DELAY))


def write_log():
    """Simulate the rig and write what its logger writes."""
    r = cid.random_binary(10_000, amplitude=1e-4, hold=20, around=0.012, seed=1)
    log = cid.simulate(the_rig(lead_on_the_rig), r, sensor_noise=5e-6, seed=2)
    columns = np.column_stack([log.t, log.r, log.u, log.y])
    header = "time [s],setpoint [m],voltage [V],gap [m]"
    np.savetxt(path, columns, fmt=["%.3f", "%.7f", "%.4f", "%.7f"], delimiter=",",
               header=header, comments="")  # fmt: skip


write_log()
print("\n".join(path.read_text().splitlines()[:4]))

# %%
# 1. Read the log
# ---------------
# `Record.from_csv` needs the names of the columns. It finds the sampling period from the time
# column, and would refuse gaps, jitter or a clock that runs backwards. Dates such as
# ``2026-11-27T10:00:00.250`` will do as well as seconds. Units in brackets are kept.

record = cid.Record.from_csv(path, r="setpoint", u="voltage", y="gap", time="time")
print(record)

# %%
# All values are absolute: metres and volts as logged, without removing means. ctrlid needs absolute
# values, because they determine the operating point.
#
# 2. Check the record
# -------------------
# `audit` looks for limits, quantization, repeats, outliers and drift, without assumptions on the
# plant. `check_feedback` tests whether u was computed from y, because then least squares is biased.

print(cid.audit(record))
print(cid.check_feedback(record))
cid.plot.record(record.between(0, 1))
plt.show()

# %%
# The gap stays within a fraction of a millimetre of 12 mm, so a linear model is a fair
# description. And the reference excites the loop all the time. Without that excitation the plant
# could not be identified in closed loop.
#
# 3. Write down the model that you believe
# ----------------------------------------
# The data sheet of the rig gives the mass of the ball and the constant K of the magnet. We are not
# sure of K, so it is `free`. A loop consists of plant, controller, sampling period and operating
# point.

plant = cid.plants.maglev(m=0.0213, K=3.34e-6)
at = cid.operating_point(plant, output=0.012)
believed = cid.Loop(plant, lead_on_the_rig, dt=record.dt, at=at, free=("K",))
pole = float(np.sqrt(2 * 9.81 / record.y.mean()))  # where the ball hung in the mean
print(f"unstable pole {pole:.2f} rad/s, times the sampling period {pole * record.dt:.2f}")

# %%
# To check that this is the controller of the rig, `replay_controller` computes u from the logged r
# and y.

replayed = cid.replay_controller(believed, record)
print(f"replayed u: off by {1e3 * np.abs(replayed - record.u).max():.2f} mV at most")

# %%
# It is, within the rounding of the file.
#
# 4. Fit
# ------
# The first three quarters are for fitting, the rest for validation. It is certain that there is one
# pole at +p and one at -p, which is the constraint `ReciprocalPoles` (see :doc:`/which_one_when`
# for other plants). The reference is in the log, so `fit_iv` can use it as an instrument.

fitting, validation = record.split(0.75)
G = cid.fit_iv(fitting, na=2, nb=2, constraints=[cid.ReciprocalPoles()])
print(G.estimate)

# %%
# A good report has a pole outside the unit circle, no active bound, and poles that agree with
# physics. Here they nearly agree, but physics gives 41.1 rad/s from the gap alone, and the
# difference is many standard errors. (The line in capitals says that the levitation is visibly
# nonlinear even within a tenth of a millimetre, and that the fit allowed for it.)
#
# 5. Validate
# -----------
# `compare` predicts, simulates the closed loop from the reference, and tests the residuals. We
# first compare the physics of the data sheet, with K fitted to the log:

fit = cid.fit_loop(believed, fitting)
print(fit)
calibrated = fit.loop
comparison = cid.compare(validation, calibrated)
print(comparison)
cid.plot.comparison(comparison)
plt.show()

# %%
# A fit above 80 % may look good. But noise explains only a small part of the error of the
# simulation, and the one-step errors depend on the past of u and r. So the model lacks something,
# but the tests do not say what.
#
# 6. Diagnose
# -----------
# `diagnose` recalibrates the free parameters, tries its catalogue of effects, and names those for
# which the record has strong evidence.

found = cid.diagnose(believed, record, progress=False)
print(found)

# %%
# The missing effect is a delay of the input. The report gives its size, and with the delay the
# estimate of K is right as well. The figure shows the gap before and after, where the errors were,
# and the candidates:

cid.plot.diagnosis(found)
plt.show()

# %%
# The same diagnosis on the command line, with the controller in a file ``rig.py``:
#
# .. code-block:: bash
#
#    python -m ctrlid diagnose levitation.csv --columns r=setpoint,u=voltage,y=gap \
#        --model maglev --param m=0.0213 K=3.34e-6 --free K --at-output 0.012 \
#        --controller rig.py:lead_on_the_rig --save found
#
# 7. Redesign
# -----------
# `found.loop` is the completed model. `redesign` designs a lead on a linear model (a digital lead
# if the model is sampled) and tries it on the physics of a loop. The old controller has these
# margins:


def sampled(loop):
    """Return the linear model of a loop at its sampling period."""
    return ct.sample_system(loop.linearize(), loop.dt)


old = cid.loop_margins(lead_on_the_rig * sampled(found.loop))
print(f"phase margin {old.phase_margin:.1f} deg at {old.crossover:.1f} rad/s")

# %%
# We want a faster loop that is as well damped as the old one: 130 rad/s and 45 degrees. One design
# uses the model without the delay, the other the model with it. Both are tried on the completed
# model, which is the best that we have:

without = cid.redesign(sampled(calibrated), found.loop, crossover=130, phase_margin=45)
result = cid.redesign(sampled(found.loop), found.loop, crossover=130, phase_margin=45)
print("without the delay:", without.verdict)
print("with the delay:", result.verdict)

cid.plot.step({"lead designed without the delay": without, "lead designed with the delay": result})
plt.show()

# %%
# 8. Keep the evidence
# --------------------
# `write_report` puts all tables and figures on one page, to be sent to a colleague:

page = cid.write_report([record, G, comparison, found, result], folder / "report.html")
print(f"{page.name}: {page.stat().st_size / 1e6:.1f} MB")

# %%
# 9. On the rig
# -------------
# Only now the controllers go to the rig. Here the rig is simulated, so both can be tried without
# damage:

on_rig = {}
for name, loop in (("without the delay", calibrated), ("with the delay", found.loop)):
    on_rig[name] = cid.redesign(sampled(loop), the_rig(None), crossover=130, phase_margin=45)
    print(f"{name}: {on_rig[name].verdict}")

# %%
# This story asserts that the delay and nothing else is named, that its size is right within three
# standard errors, and that the gap decreases to the noise floor. On the rig, the promised phase
# margin is achieved to within a degree with the delay, and missed by more than ten degrees without
# it.

delay = found.findings[0]
assert [finding.names for finding in found.findings] == [("InputDelay",)]
assert abs(delay.effect.delay - DELAY) < 3 * delay.standard_errors["delay"]
assert found.gap.after < 1.1 * found.gap.floor
assert abs(on_rig["with the delay"].achieved.phase_margin - 45) < 1
assert on_rig["without the delay"].achieved.phase_margin < 35
