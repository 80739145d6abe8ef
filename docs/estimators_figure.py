"""Draw the figure of the page on what was measured: ``python docs/estimators_figure.py``."""

from pathlib import Path

import control as ct
import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

import ctrlid as cid

PERIOD = 0.005

plant = cid.plants.maglev(m=0.0213, K=3.34e-6)
at = cid.operating_point(plant, output=0.012)
P = cid.linearize(plant, at)
sampled = ct.sample_system(ct.ss(P), PERIOD)
C = cid.design_lead(sampled, crossover=85, phase_margin=45)
loop = cid.Loop(plant, C, dt=PERIOD, at=at)
r = cid.random_binary(45_000, amplitude=1e-4, hold=4, around=at.output, seed=1)

noises = np.array([0.02, 0.05, 0.1, 0.2, 0.3])
fits = {
    "plain least squares": lambda d: cid.fit_arx(d, na=2, nb=2),
    "constrained least squares": lambda d: cid.fit_arx(
        d, na=2, nb=2, constraints=[cid.ReciprocalPoles()]
    ),
    "constrained instruments": lambda d: cid.fit_iv(
        d, na=2, nb=2, constraints=[cid.ReciprocalPoles()]
    ),
    "constrained, continuous time": lambda d: cid.fit_continuous(
        d, poles=2, constraints=[cid.SymmetricPoles()]
    ),
}
rates = {name: [] for name in fits}
for noise in noises:
    record = cid.simulate(loop, r, sensor_noise=noise * 1e-4, seed=2)
    for name, fit in fits.items():
        rates[name].append(float(np.max(fit(record).estimate.poles_s.real)))

mpl.rcParams.update(cid.plot.style())
figure = Figure(figsize=(7.2, 4.0), layout="constrained", dpi=160)
FigureCanvasAgg(figure)
axes = figure.add_subplot()
truth = float(np.max(P.poles().real))
axes.axhline(truth, color="black", linewidth=1)
axes.text(25, truth + 0.8, "physics", ha="center")
styles = (
    ("o", ":", "#D55E00"),
    ("s", "--", "#0072B2"),
    ("^", "-", "#009E73"),
    ("x", "-", "#CC79A7"),
)
for (name, values), (marker, line, color) in zip(rates.items(), styles, strict=True):
    axes.plot(100 * noises, values, marker=marker, linestyle=line, color=color, label=name,
              markerfacecolor="none")  # fmt: skip
    print(f"{name:<30}" + "".join(f"{v:8.2f}" for v in values))
axes.axhline(0, color="0.6", linewidth=0.8)
axes.text(100 * noises[0], -0.8, "stable below", va="top", color="0.4")
axes.set_ylim(top=1.15 * truth)
axes.set_xlabel("sensor noise [% of the reference's amplitude]")
axes.set_ylabel("unstable pole found [rad/s]")
axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2)
figure.savefig(Path(__file__).parent / "_static" / "estimators.png")
