"""Draw the figure of the README, a diagnosis: ``python docs/readme_figure.py``."""

from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

import ctrlid as cid

# The example of the README: an amplifier that lags, and a model that does not have the lag.
plant = cid.plants.maglev(m=0.0213, K=3.34e-6, g=9.81)
at = cid.operating_point(plant, output=0.012)
lead = cid.design_lead(cid.linearize(plant, at), crossover=100, phase_margin=50)
model = cid.Loop(plant, lead.sample(0.002, "tustin"), dt=0.002, at=at, free=("K",))
rig = model.with_effect(cid.effects.ActuatorLag(tau=0.002))
r = cid.random_binary(5000, amplitude=2e-4, hold=20, around=at.output, seed=1)
record = cid.simulate(rig, r, sensor_noise=5e-6, seed=2)
found = cid.diagnose(model, record, progress=False)
print(found)

gap, finding = found.gap, found.findings[0]
part = slice(100, 350)
time = gap.time[part] - gap.time[part][0]
before, after = gap.simulated_before[part], gap.simulated_after[part]
measured = gap.measured[part]
start = "recalibrated model" if gap.before == gap.fitted else "model as given"
BEFORE, AFTER = "#D55E00", "#0072B2"

mpl.rcParams.update(cid.plot.style())
figure = Figure(figsize=(9.0, 4.2), layout="constrained", dpi=130)
FigureCanvasAgg(figure)
grid = figure.add_gridspec(2, 2, width_ratios=(1.7, 1), height_ratios=(1.25, 1))
output, bars = figure.add_subplot(grid[0, 0]), figure.add_subplot(grid[:, 1])
error = figure.add_subplot(grid[1, 0], sharex=output)
output.tick_params(labelbottom=False)
output.plot(time, 1e3 * measured, color="0.72", linewidth=3.5, linestyle="-", label="measured")
output.plot(time, 1e3 * before, color=BEFORE, linestyle="--", label=f"simulated, {start}")
output.plot(time, 1e3 * after, color=AFTER, linestyle="-", linewidth=1.0,
            label=f"simulated, with {finding.name}")  # fmt: skip
output.set_ylabel("distance [mm]")
low, high = output.get_ylim()
output.set_ylim(low, high + 0.6 * (high - low))
output.legend(loc="upper left", fontsize="small", ncols=1, handlelength=1.8, labelspacing=0.2)
for values, color, line, name, size in (
    (before, BEFORE, "--", "before", gap.before), (after, AFTER, "-", "after", gap.after),
):  # fmt: skip
    error.plot(time, 1e6 * (measured - values), color=color, linestyle=line, linewidth=1.0,
               label=f"{name}: RMS {1e6 * size:.1f} µm")  # fmt: skip
error.axhspan(-2e6 * gap.floor, 2e6 * gap.floor, color="0.85", zorder=0,
              label=f"±2 x noise floor, {1e6 * gap.floor:.1f} µm")  # fmt: skip
reach = 1.05e6 * float(np.max(np.abs(measured - before)))
error.set_ylim(-reach, 2.0 * reach)
error.legend(loc="upper left", fontsize="small", ncols=2, handlelength=1.8, labelspacing=0.2)
error.set_xlabel("time [s], on samples kept back")
error.set_ylabel("error [µm]")

first = [c for c in found.ranking if c.round == 1]
gains = {type(c.effect).__name__: c.gain - c.penalty for c in first if np.isfinite(c.gain)}
names = sorted(gains, key=gains.get)[-6:]
colors = [AFTER if name == finding.name else "0.8" for name in names]
drawn = bars.barh(range(len(names)), [gains[n] for n in names], color=colors, edgecolor="k",
                  linewidth=0.6, height=0.65)  # fmt: skip
bars.bar_label(drawn, [f"{gains[n]:.0f}" for n in names], padding=3, fontsize="small")
bars.set_yticks(range(len(names)), names, fontsize="small")
bars.set_xlim(0, 1.18 * max(gains.values()))
bars.grid(False, axis="y")
bars.set_xlabel("net gain [log-likelihood];\n5 would earn a place")
bars.set_title("What is missing?", fontsize="medium")

path = Path(__file__).parent / "_static" / "readme.png"
figure.savefig(path)
print(path.stat().st_size)
