"""
Two real levitated balls
========================

The constrained fit is applied to two public records of magnetic levitation in closed loop: the
INTECO rig (a steel ball, a PID on a PC) and the MagnetoShield R3 (a permanent magnet, a PID on a
microcontroller with dither). The records are not part of ctrlid. They are downloaded once, or read
from the folder that the environment variable CTRLID_DATA_DIR names. Run the script with ``python
examples/real_levitations.py``.

If ``m x" = m g - K V^2/x^2`` held, the poles would be at plus and minus p = ``sqrt(2 g/x0)``, so
that ``p^2 x0/g`` would be 2.
"""

from dataclasses import replace

import numpy as np

import ctrlid as cid


def rates(model):
    """Return the poles in rad/s that lie inside the band of the samples, largest first."""
    z = model.poles().astype(complex)
    s = np.log(z[np.abs(z) > 1e-6]) / model.dt
    slow = s[np.abs(s.imag) < 0.5 * np.pi / model.dt]
    return slow[np.argsort(-slow.real)][:2]


def show(poles):
    """Return poles as text, complex ones with their imaginary part."""
    return ", ".join(
        f"{p.real:+.1f}" + (f"{p.imag:+.1f}j" if abs(p.imag) > 1e-6 else "") for p in poles
    )


def line(label, record, na=2, nk=1):
    """Fit freely and with a reciprocal pair; print one line and return the pair's rate."""
    free = cid.fit_arx(record, na=na, nb=na, nk=nk)
    tied = cid.fit_arx(record, na=na, nb=na, nk=nk, constraints=[cid.ReciprocalPoles()])
    gap = float(np.mean(record.y))
    bound = "   ON THE BOUND" if tied.estimate.active else ""
    pair = float(rates(tied)[0].real)
    exponent = pair**2 * gap / 9.81
    print(f"  {label:<44}{1e3 * gap:8.2f}{np.sqrt(2 * 9.81 / gap):9.1f}    {show(rates(free)):<26}"
          f"+-{pair:<8.1f}{exponent:6.2f}{bound}")  # fmt: skip
    return pair


HEADER = (f"  {'record':<44}{'x0 [mm]':>8}{'physics':>9}    {'free fit [rad/s]':<26}"
          f"{'pair':<10}{'p^2 x0/g':>8}")  # fmt: skip


def inteco():
    """Fit the two transients after the steps of the reference, by duty and by coil current."""
    record = cid.datasets.load("inteco_pid_step")
    print("INTECO: steady stretches carry no excitation, the swings after a step do\n" + HEADER)
    found = {}
    for what, first, last in (
        ("step up, 12 mm", 10_552, 12_000),
        ("step down, 8 mm", 18_152, 20_000),
    ):
        # The swing is masked in the record because it is large; here it is the experiment.
        swing = replace(record[first:last], valid=None)
        for signal in ("duty", "current"):
            part = swing if signal == "duty" else swing.with_input("current")
            slow = replace(part.decimate(10), valid=None)
            found[what, signal] = line(f"{what}, {signal}, T = 10 ms", slow)
    steady = record[12_000:18_000].with_input("current").decimate(10)
    found["steady"] = line("steady at 12 mm, current, T = 10 ms", steady)
    return found


def magnetoshield():
    """Fit the five set-points, as logged, with second and fourth order."""
    print("\nMagnetoShield R3: T = 3.25 ms, as logged\n" + HEADER)
    found = {}
    for record in cid.datasets.load("magnetoshield_r3"):
        title = record.name.removeprefix("magnetoshield_r3 ")
        found[title, 2] = line(f"{title}: second order, nk = 1", record)
        found[title, 4] = line(f"{title}: fourth order, nk = 2", record, na=4, nk=2)
    return found


def set_points():
    """Fit a continuous pair to each set-point, one sample late; print how it moves with the gap."""
    records = cid.datasets.load("magnetoshield_r3")
    series = cid.fit_each(cid.fit_continuous, records, poles=2, delay=records[0].dt,
                          constraints=[cid.SymmetricPoles()])  # fmt: skip
    print("\nMagnetoShield R3: s^2 - p^2 behind a delay of one sample, free of the bias of "
          f"least squares\n{series}")  # fmt: skip
    one = cid.fit_continuous(records, poles=2, delay=records[0].dt,
                             constraints=[cid.SymmetricPoles()]).estimate  # fmt: skip
    print(f"one model of all five: p = {one.poles.real.max():.1f} ± "
          f"{one.poles_standard_errors[0]:.1f} rad/s")  # fmt: skip
    return series


def main():
    """Print the tables and what explains them; draw the pair against the gap."""
    swings = inteco()
    print(
        """\
  The duty drives the coil, whose current lags by about 25 ms: a second-order model from
  duty to gap has no room for the lag, and the constraint ends on its bound. With the measured
  current the pair is real and reciprocal, but slower than sqrt(2 g/x0). For a force that falls
  as 1/x^n, p^2 x0/g is n: over the swing it falls less steeply than 1/x^2."""
    )
    shield = magnetoshield()
    print(
        """\
  The input takes one sample more to act, and the coil adds a lag: with nk = 2 and two more
  poles for them, the pair is near 50 rad/s at all five set-points. It is faster than
  sqrt(2 g/x0), because the levitated body is a permanent magnet: the iron core draws it
  even without current, a negative stiffness that the law of equation (1) does not have."""
    )
    # What the words above say, in numbers [rad/s].
    assert 30 < swings["step up, 12 mm", "current"] < 34
    assert 40 < swings["step down, 8 mm", "current"] < 44
    assert all(47 < pair < 53 for (_, order), pair in shield.items() if order == 4)


if __name__ == "__main__":
    main()
