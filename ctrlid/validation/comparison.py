"""What a comparison found, as a table and in words."""

from dataclasses import dataclass, replace

import numpy as np

from .._base.arrays import Array, freeze_arrays
from .._base.errors import CtrlidError
from .._base.text import Printed, write_count, write_list
from ..data.record import Record
from .residual_tests import Correlation

# A share of the error's variance that follows the signals is reported from here on.
SYSTEMATIC = 0.05
# Beyond this fit in percent the rest is rounding.
EXACT = 100 * (1 - 1e-9)
# If noise explains so much of an error's variance nothing is missing, since its size is known no
# better.
ENOUGH = 0.75
_USELESS = (
    "The mean of y, its last value known or a straight line through the last two is nearer to y"
)


@dataclass(frozen=True, eq=False, repr=False)
class Curve(Printed):
    """One reproduction of the measured output.

    Parameters
    ----------
    label : str
        What it is: a prediction (uses measured outputs) or a simulation (does not).
    y : ndarray, shape (n,)
        Reproduced output [output unit]; NaN where there is none.
    fit : float
        Fit in percent, ``100 (1 - |y - yhat| / |y - mean(y)|)``.
    rms : float
        Root mean square of the error [output unit].
    follows : float
        Share of the error's variance that follows the past of reference and input, as no noise
        does.
    noise_share : float
        Share of the error's variance that noise explains: not more than what follows no signal,
        and not more than noise of the size found in the one-step errors makes of it.
    useless : bool
        Whether the mean of y, its last value or a straight line through its last two is nearer to
        y, so that no share of the error tells anything.
    unit : str
        The unit of the output; empty where it is not known.
    """

    label: str
    y: Array
    fit: float
    rms: float
    follows: float
    noise_share: float
    useless: bool = False
    unit: str = ""

    def __post_init__(self) -> None:
        freeze_arrays(self)

    @property
    def written_share(self) -> str:
        """What noise explains, in percent; a dash where the curve is useless.

        Noise that a model takes for large explains any error.
        """
        return "-" if self.useless else _write_percent(self.noise_share)

    def __str__(self) -> str:
        size = f"{self.rms:.3e} {self.unit}".rstrip()
        if self.useless:
            return f"{self.label}: fit {write_fit(self.fit)}, RMS error {size}. {_USELESS}"
        return (f"{self.label}: fit {write_fit(self.fit)}, RMS error {size}, of which "
                f"noise explains {_write_percent(self.noise_share)} of the variance")  # fmt: skip


@dataclass(frozen=True, eq=False, repr=False)
class Comparison(Printed):
    """What `compare` found.

    Parameters
    ----------
    what : str
        The model or loop that was compared.
    record : Record
        The data.
    curves : tuple of Curve
        Predictions and simulations.
    residuals : ndarray, shape (n,)
        One-step prediction errors [output unit]; NaN where there are none.
    tests : tuple of Correlation
        Residuals with their own past, with past u and with past r.
    notes : tuple of str
        What could not be computed, and why.
    outputs : tuple of Comparison
        Of several outputs, a comparison of each, called `what` it is; the curves and tests above
        are all of theirs. Empty for one output.
    rejection : str
        Why the stated law of the controller is not that of the record; empty where it stands.
    steps : str
        What to do about steps of the readings that the loop does not have; empty without them.
    """

    what: str
    record: Record
    curves: tuple[Curve, ...]
    residuals: Array
    tests: tuple[Correlation, ...]
    notes: tuple[str, ...] = ()
    outputs: tuple["Comparison", ...] = ()
    rejection: str = ""
    steps: str = ""

    def __post_init__(self) -> None:
        freeze_arrays(self)

    def __getitem__(self, label: str) -> Curve:
        for curve in self.curves:
            if label in curve.label:
                return curve
        raise CtrlidError(f"no curve is called {label!r}; there are "
                          f"{', '.join(c.label for c in self.curves)}")  # fmt: skip

    @property
    def fit(self) -> dict[str, float]:
        """Fit in percent by curve label."""
        return {curve.label: curve.fit for curve in self.curves}

    @property
    def verdict(self) -> str:
        """The comparison in words: gross errors, the last curve, the one-step errors.

        Of several outputs the curve and the errors of each.
        """
        if self.rejection:
            plain = replace(self, rejection="").verdict
            return f"CHECK THE CONTROLLER AND THE LOG FIRST: {self.rejection} {plain}"
        if self.steps:
            return f"{replace(self, steps='').verdict} {self.steps}"
        if self.outputs:
            return " ".join(f"{one.what}: {one.verdict}" for one in self.outputs)
        last = self.curves[-1]
        text = f"The fit of the {last.label} is {write_fit(last.fit)}"
        if last.fit <= 0:
            text = (f"The fit of the {last.label} is negative: its error is "
                    f"{write_times(last.fit)} the variation of y")  # fmt: skip
        if last.fit > EXACT:
            return text + ": the model explains the whole record."
        failed = [t for t in self.tests if not t.passed]
        large = [t for t in failed if t.share >= SYSTEMATIC]
        if last.follows >= SYSTEMATIC:
            text += (f". SOMETHING IS MISSING in the model: {_write_percent(last.follows)} of the "
                     "variance of the error depends on the reference or the input, and noise "
                     "depends on neither.")  # fmt: skip
        elif last.noise_share < ENOUGH:
            text += (
                ". SOMETHING IS MISSING in the model: noise of the size of the one-step "
                f"errors explains only {_write_percent(last.noise_share)} of the variance of the "
                "error. The cause may be an offset, a drift or a nonlinearity."
            )
        elif large:
            text += ". SOMETHING IS MISSING in the model, or its noise is not white."
        elif last.useless:
            text += f". {_USELESS}, so that this curve tells nothing of the model."
        else:
            text += (f". Noise explains {_write_percent(last.noise_share)} of the variance of its "
                     "error.")  # fmt: skip
        if large:
            return text + (" The one-step errors are NOT NOISE ALONE: they are correlated "
                           f"{_write_shares(large)}.")  # fmt: skip
        if failed:
            return text + (" The one-step errors are nearly noise: they are correlated "
                           f"{_write_shares(failed)}, which is significant but small.")  # fmt: skip
        if self.tests:
            text += " The one-step errors are white and independent of the past signals."
        return text

    def __str__(self) -> str:
        # Of several outputs, each error stands with its own unit.
        unit = "" if self.outputs else self.record.units.get("y", "")
        own = [f" {c.unit}".rstrip() if self.outputs else "" for c in self.curves]
        rows = [
            f"Comparison of {self.what} with the record {self.record.name}".rstrip()
            + f" ({write_count(len(self.record), 'sample')}, "
            f"{np.count_nonzero(self.record.valid)} valid)"
        ]
        size = f"RMS error [{unit}]" if unit else "RMS error"
        rows.append(f"  {'curve':<34}{'fit':>10}{size:>18}{'noise explains':>18}")
        rows += [
            f"  {c.label:<34}{write_fit(c.fit):>10}{f'{c.rms:.3e}{each}':>18}{c.written_share:>18}"
            for c, each in zip(self.curves, own, strict=True)
        ]
        if any(c.useless for c in self.curves):
            rows.append(f"  -: {_USELESS[0].lower()}{_USELESS[1:]}")
        if self.tests:
            rows.append(f"  {'correlation of one-step errors':<34}{'passed?':>10}{'largest':>18}"
                        f"{'variance share':>18}")  # fmt: skip
        for t in self.tests:
            worst = int(np.argmax(np.abs(t.values)))
            largest = f"{t.values[worst]:+.3f} at lag {t.lags[worst]}"
            share = "" if t.passed else _write_percent(t.share)
            rows.append(f"  {t.name:<34}{'yes' if t.passed else 'NO':>10}{largest:>18}{share:>18}")
        rows += [f"  note: {note}" for note in self.notes]
        return "\n".join(line.rstrip() for line in [*rows, "  " + self.verdict])


def _write_percent(share: float) -> str:
    """Write a share with the digits that say something: 0.3 %, 12 %, 99.7 %."""
    value = 100 * share
    if 99 < value < 99.95:
        return f"{value:.1f} %"
    return f"{value:.0f} %" if value >= 9.5 or value < 1e-3 else f"{value:.1g} %"


def write_times(fit: float) -> str:
    """Say how many times the variation of y an error is, by a fit that is not positive.

    Examples
    --------
    >>> write_times(-58994.0)
    '590 times'
    """
    times = 1 - fit / 100
    return f"{float(f'{times:.2g}'):g} times" if times >= 1.05 else "as large as"


def write_fit(fit: float, places: int = 2) -> str:
    """Write a fit in percent; one far below zero only says so, since its size tells nothing.

    Examples
    --------
    >>> write_fit(87.654), write_fit(-58994.0)
    ('87.65 %', 'below 0 %')
    """
    if fit > EXACT:
        return "100 %"
    if fit < -100:
        return "below 0 %"
    return f"{fit:.{places}f} %" if fit < 99.9 else f"{fit:.{places + 2}f} %"


def _write_shares(tests: list[Correlation]) -> str:
    """Say how much of the variance each failed test stands for."""
    return write_list([f"{t.name} ({_write_percent(t.share)} of the variance)" for t in tests])
