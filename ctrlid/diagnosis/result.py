"""The result of a diagnosis."""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from scipy import stats

from .._base.arguments import check_arguments
from .._base.errors import CtrlidError
from .._base.text import Printed
from ..effects import AbstractEffect
from ..loop.loop import Loop
from .findings import (
    BinnedErrors,
    Calibrated,
    Candidate,
    Disturbance,
    Finding,
    Gap,
    SensorNoise,
    Verdict,
)
from .report_text import write_report_text
from .saving import save_diagnosis
from .thresholds import THRESHOLD


@dataclass(frozen=True, eq=False)
class Diagnosis(Printed):
    """What `diagnose` found.

    Parameters
    ----------
    verdict : {"nothing missing", "explained", "partly explained", "unknown"}
        The end of the search.
    sentence : str
        The verdict in words, with what it rests on.
    findings : tuple of Finding
        The effects that were missing, most important first: names that stand.
    loop : Loop
        The model with the effects added and everything refitted.
    gap : Gap
        How far model and data are apart, before and after.
    where : tuple of BinnedErrors
        Where the disagreement sits, before and after; most telling first.
    ranking : tuple of Candidate
        Every candidate's evidence, round by round, best first.
    disturbance : Disturbance
        The random forces.
    calibrated : tuple of Calibrated
        The model's own free parameters.
    sensitivity : dict of str to float
        The size [unit of the parameter] of each effect that 80 of 100 such records would have
        shown, by name of the parameter, such as ``"CoulombFriction.fc"``; see `find_sensitivity`.
    tests : dict of str to float
        Probabilities that the final innovations are noise, by name of the test.
    audit : tuple of str
        What was noticed about the record itself.
    notes : tuple of str
        What else should be known.
    record : str
        What was diagnosed.
    seconds : float
        Run time [s].
    extra : dict of str to object
        What else was computed along.
    noise : SensorNoise or None
        The noise of the sensor, in words and numbers; None in files of earlier versions.
    stand_ins : tuple of Finding
        Effects that only describe part of the record, most important first: the note of each says
        on what ground its name does not stand. `loop`, `gap` and `where` are with them.
    finished : bool
        Whether the search came to its end; not if its budget of seconds was spent before.
    sensitivity_errors : dict of str to float
        Standard errors of these sizes [unit of the parameter]; empty in files of earlier versions.
    """

    verdict: Verdict
    sentence: str
    findings: tuple[Finding, ...]
    loop: Loop
    gap: Gap
    where: tuple[BinnedErrors, ...]
    ranking: tuple[Candidate, ...]
    disturbance: Disturbance
    calibrated: tuple[Calibrated, ...]
    sensitivity: dict[str, float]
    tests: dict[str, float]
    audit: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    record: str = ""
    seconds: float = 0.0
    extra: dict[str, Any] = field(default_factory=dict, repr=False)
    noise: SensorNoise | None = None
    stand_ins: tuple[Finding, ...] = ()
    finished: bool = True
    sensitivity_errors: dict[str, float] = field(default_factory=dict, repr=False)

    @property
    def effects(self) -> tuple[AbstractEffect, ...]:
        """The effects that were found."""
        return tuple(f.effect for f in self.findings)

    @property
    def added(self) -> tuple[Finding, ...]:
        """All that was added to the model: findings, then stand-ins."""
        return (*self.findings, *self.stand_ins)

    def find_sensitivity(self, power: float = THRESHOLD.power) -> dict[str, float]:
        r"""Return the size of each effect that a record like this one shows so often.

        .. math:: s_p = \sigma \bigl(\sqrt{2 (g + c)} + \Phi^{-1}(p)\bigr)

        An effect is named if its estimate is worth more than the gate g and its penalty c. The
        estimate scatters about the true size with the standard error :math:`\sigma`, so that one
        of the size :math:`\sigma \sqrt{2 (g + c)}` is named in half of the records only.

        Parameters
        ----------
        power : float, optional
            The probability p, between 0 and 1.

        Returns
        -------
        dict of str to float
            Sizes [unit of the parameter] by name, as in `sensitivity`.

        Raises
        ------
        CtrlidError
            If the probability is not between 0 and 1, or if the diagnosis was saved by a version
            that kept no standard errors.

        References
        ----------
        Lehmann and Romano, *Testing Statistical Hypotheses*, 2005, chapter 3 (power).
        """
        check_arguments(Diagnosis.find_sensitivity, locals())
        if not 0 < power < 1:
            raise CtrlidError(f"power= needs a probability between 0 and 1; given {power:g}")
        if self.sensitivity and not self.sensitivity_errors:
            raise CtrlidError(
                "this diagnosis was saved without the standard errors of its sensitivity; diagnose "
                "the record again to ask for another power"
            )
        return {
            name: shift_visible_size(size, self.sensitivity_errors[name], THRESHOLD.power, power)
            for name, size in self.sensitivity.items()
        }

    def __str__(self) -> str:
        return write_report_text(self)

    def __repr__(self) -> str:
        names = ": " + ", ".join(f.names[0] for f in self.findings) if self.findings else ""
        if self.stand_ins:
            names += "; stand-ins: " + ", ".join(f.names[0] for f in self.stand_ins)
        g = self.gap
        sizes = f"{g.before:.3g} before, {g.after:.3g} after, floor {g.floor:.3g} {g.unit}"
        return f"Diagnosis({self.verdict}{names}; gap {sizes.strip()})"

    def save(self, path: str | Path) -> Path:
        """Write the diagnosis to a file that a person can read; `load_diagnosis` reads it back.

        Everything is kept but the plant and the controller, which are Python code, and what `extra`
        holds beyond texts, numbers and arrays.

        Parameters
        ----------
        path : str or Path
            The file, in JSON; one that exists is replaced.

        Returns
        -------
        Path
            The file.

        Raises
        ------
        CtrlidError
            If the file cannot be written.
        """
        check_arguments(Diagnosis.save, locals())
        return save_diagnosis(self, path)


def shift_visible_size(size: float, error: float, power: float, other: float) -> float:
    """Return the size that is shown with another power than a size that is shown with one."""
    if math.isinf(error):
        return math.inf
    return size + error * float(stats.norm.ppf(other) - stats.norm.ppf(power))
