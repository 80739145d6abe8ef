"""What a diagnosis found, as values."""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from .._base.arrays import Array, freeze_arrays
from .._base.text import (
    Printed,
    with_unit,
    write_list,
    write_number,
    write_percent,
    write_quantity,
)
from .._base.units import fill_unit
from ..effects import AbstractEffect
from ..effects.base import name_at_place
from ..validation.reproduction import CLOSED_LOOP, OPEN_LOOP, Reproduction
from .thresholds import THRESHOLD

Verdict = Literal["nothing missing", "explained", "partly explained", "unknown"]
GapKind = Literal["simulation", "prediction"]


COMPLETE: tuple[Verdict, ...] = ("explained", "nothing missing")


@dataclass(frozen=True, eq=False, repr=False)
class Gap(Printed):
    """How far the model is from the data, on samples that no parameter was fitted to.

    Parameters
    ----------
    kind : str
        What was compared: ``"simulation"``, which uses no measured output (closed loop it is the
        mean of runs with noise), or ``"prediction"``, which uses those up to `horizon` samples
        before.
    given, before, after : float
        RMS error of the model as handed in, the smaller of that and of the recalibrated model's,
        and with the effects added [output unit], all on the samples of which each model makes
        something; infinite where a model makes nothing of a whole record.
    floor : float
        RMS error that sensor and force noise alone leave through this very loop [output unit].
    unit : str
        Output unit; empty where the record has none.
    time, measured : ndarray, shape (m,)
        The held-out samples [s, output unit].
    simulated_before, simulated_after : ndarray, shape (m,)
        What the model behind `before` and the model with the effects make of them [output unit];
        NaN where there is nothing.
    widest : float
        RMS error of the widest of several simulations with noise [output unit]: far above the
        floor where a loop hunts, which no simulation follows for long.
    horizon : int
        How many samples ahead a prediction looks; 0 for a simulation.
    recalibrated : float
        RMS error after recalibrating the free parameters alone [output unit]; NaN where it is not
        kept, as in files of earlier versions, whose `before` it is.
    closed_loop : bool
        Whether a simulation was closed loop, from the reference.
    trivial : float
        RMS error of the best trivial predictor beside a prediction, on the same samples [output
        unit]: the last value, or a straight line through the last samples; NaN for a simulation.
    samples : int
        How many samples the RMS errors are of, in all records kept back; the curves are those of
        the first. Several outputs together count each of theirs. 0 in files of older versions.
    output : str
        Of several outputs, the name of the one that this is the gap of.
    outputs : tuple of Gap
        Of several outputs, the gap of each. That of all is then in units of the floors: the root of
        the mean square of each error over the floor of its output. Its `floor` is about 1, and its
        curves are those of the output whose gap is the widest in these units.
    force_unit : str
        Unit of a force per unit of mass: that of the position, which an output may show scaled, per
        s^2; by default by the unit of the output.
    reason : str
        Why the gap is that of a prediction and not of a simulation, as a clause; empty for a
        simulation, and in files of earlier versions.
    """

    kind: GapKind
    given: float
    before: float
    after: float
    floor: float
    unit: str
    time: Array
    measured: Array
    simulated_before: Array
    simulated_after: Array
    widest: float = math.nan
    horizon: int = 0
    recalibrated: float = math.nan
    closed_loop: bool = False
    trivial: float = math.nan
    samples: int = 0
    output: str = ""
    outputs: tuple["Gap", ...] = ()
    force_unit: str = ""
    reason: str = ""

    def __post_init__(self) -> None:
        freeze_arrays(self)
        if not (self.force_unit or self.outputs):
            unit = fill_unit("{y}/s^2", {"y": self.unit or "[y]"})
            object.__setattr__(self, "force_unit", unit)

    @property
    def name(self) -> str:
        """The kind in full, such as ``"closed-loop simulation"`` or ``"25-step prediction"``."""
        if self.kind == "prediction":
            return str(Reproduction("prediction", self.horizon))
        return str(CLOSED_LOOP if self.closed_loop else OPEN_LOOP)

    @property
    def trivial_wins(self) -> bool:
        """Whether a trivial predictor errs less than each of the models: the gap says nothing."""
        return self.trivial < min(self.given, self.before, self.after)

    @property
    def fitted(self) -> float:
        """RMS error of the recalibrated model, whether or not it is the smaller [output unit]."""
        return self.before if math.isnan(self.recalibrated) else self.recalibrated

    @property
    def written_sizes(self) -> str:
        """The RMS errors before and with the effects, and that of noise alone, in words."""
        sizes = [write_quantity(size, self.unit) for size in (self.before, self.after, self.floor)]
        return f"{sizes[0]} before, {sizes[1]} with the effects, {sizes[2]} from noise alone"

    def __str__(self) -> str:
        of = f" of {self.output}" if self.output else ""
        text = f"gap of the {self.name}{of}: RMS error {self.written_sizes}"
        return "\n".join([text, *(f"  {one}" for one in self.outputs)])


@dataclass(frozen=True, eq=False, repr=False)
class Finding(Printed):
    """An effect that was missing.

    Parameters
    ----------
    effect : AbstractEffect
        The effect with its fitted parameters.
    standard_errors : dict of str to float
        Standard errors of the parameters, by name [unit of each].
    alternatives : tuple of AbstractEffect
        Effects that this record cannot tell apart from it, each with its own fitted parameters.
    equivalents : tuple of str
        Effects that no record of u and y can tell apart from it, on this plant.
    evidence : float
        Gain of log-likelihood over the model without it; 10 is strong.
    share : float
        Share of the mean square error above the floor that would return without it.
    experiment : str
        The experiment that would separate the effect from its alternatives; empty without any.
    reference : ndarray or None
        That experiment as a reference signal [output unit], ready to run.
    note : str
        What else should be known, such as the records in which it was present.
    records : tuple of int
        Numbers of the records, from 1, in which it is seen when each of several is fitted alone;
        empty for one record.
    units : dict of str to str, or None
        Units of the parameters, by name; None in files of earlier versions.
    """

    effect: AbstractEffect
    standard_errors: dict[str, float]
    alternatives: tuple[AbstractEffect, ...]
    equivalents: tuple[str, ...]
    evidence: float
    share: float = float("nan")
    experiment: str = ""
    reference: Array | None = None
    note: str = ""
    records: tuple[int, ...] = ()
    units: dict[str, str] | None = None

    def __post_init__(self) -> None:
        freeze_arrays(self)

    @property
    def name(self) -> str:
        """The name of the effect."""
        return type(self.effect).__name__

    @property
    def names(self) -> tuple[str, ...]:
        """The name of the effect and those of its alternatives, with places where there are any."""
        return tuple(name_at_place(e) for e in (self.effect, *self.alternatives))

    @property
    def at(self) -> str:
        """The input, velocity or output at which the effect acts, of a plant with several."""
        return str(self.effect.at)

    @property
    def written_evidence(self) -> str:
        """The evidence, with a decimal where it is not strong."""
        return f"{self.evidence:.{0 if self.evidence >= THRESHOLD.strong else 1}f}"

    def __str__(self) -> str:
        units, errors = {**self.effect.units(), **(self.units or {})}, self.standard_errors
        sizes = [f"{name} = {write_quantity(value, units.get(name, ''), errors.get(name))}"
                 for name, value in self.effect.values().items()]  # fmt: skip
        text = f"{' or '.join(self.names)}: {', '.join(sizes)}, evidence {self.written_evidence}"
        return "; ".join(filter(None, [text, self.note]))


@dataclass(frozen=True, eq=False)
class Candidate:
    """One effect that was tried.

    Parameters
    ----------
    round : int
        In which round of the search, from 1.
    effect : AbstractEffect
        The effect with the parameters it was tried or fitted with.
    score : float
        Gain of log-likelihood that its first step expects, with the free parameters of the model
        moving along.
    gain : float
        Gain of log-likelihood after refitting; NaN if it was not refitted.
    penalty : float
        Half of the Bayesian penalty for its parameters and for what was scanned.
    remark : str
        Why it is out, or what else was seen; empty if nothing.
    taken : bool
        Whether its round took it into the model. It need not be in the answer: a later step may
        have dropped it, or put another in its place. False in files of earlier versions.
    record : int
        Of several records that were diagnosed alone, the number of the one whose search this was,
        from 1; else 0.
    """

    round: int
    effect: AbstractEffect
    score: float
    gain: float
    penalty: float
    remark: str = ""
    taken: bool = False
    record: int = 0

    @property
    def round_name(self) -> str:
        """The round in words, such as ``"round 1"`` or ``"record 2, round 1"``."""
        return f"record {self.record}, round {self.round}" if self.record else f"round {self.round}"


@dataclass(frozen=True, eq=False, repr=False)
class BinnedErrors(Printed):
    """Where along one quantity the innovations are not noise.

    Parameters
    ----------
    axis : str
        ``"time"``, ``"frequency"``, ``"position"``, ``"velocity"``, ``"input"`` or
        ``"reference"``.
    unit : str
        Unit of the axis.
    edges : ndarray, shape (bins + 1,)
        Bins of the axis [`unit`].
    before, after : ndarray, shape (bins,)
        Mean square of the innovations in each bin, in units of their expected variance: 1 is
        noise. Before and after the effects were added.
    p_before, p_after : float
        Probability that noise alone looks like this or worse.
    words : str
        Where it sits, in words.
    output : str
        Of several outputs, that whose innovations they are.
    told : int
        The bin that `words` speak of; -1 where that is not known.
    """

    axis: str
    unit: str
    edges: Array
    before: Array
    after: Array
    p_before: float
    p_after: float
    words: str
    output: str = ""
    told: int = -1

    def __post_init__(self) -> None:
        freeze_arrays(self)

    def __str__(self) -> str:
        of = f" of {self.output}" if self.output else ""
        text = (f"errors{of} along {with_unit(self.axis, self.unit)}: p = {self.p_before:.2g} that "
                f"they are noise before, {self.p_after:.2g} with the effects")  # fmt: skip
        return "; ".join(filter(None, [text, self.words]))


@dataclass(frozen=True)
class Disturbance:
    """The random forces that were fitted along.

    Parameters
    ----------
    white, coloured : float
        Standard deviations of the white force, held over each period, and of the coloured force
        [output unit/s^2]; zero where there is none. Of several forces `white` is NaN.
    time_constant : float
        Time constant of the coloured force [s]; NaN without one.
    share : float
        Share of the floor's variance that these forces make; the rest is sensor noise.
    forces : tuple of (str, float, str)
        Of a plant with several signals, each white force: the velocity that it works on, its
        standard deviation and the unit.
    """

    white: float
    coloured: float
    time_constant: float
    share: float
    forces: tuple[tuple[str, float, str], ...] = ()

    @property
    def large(self) -> bool:
        """Whether they make more than half of the floor's variance, and may hide something."""
        return self.share > THRESHOLD.large_disturbance


@dataclass(frozen=True, repr=False)
class SensorNoise(Printed):
    r"""The noise of the sensor as the diagnosis takes it; its text is a sentence.

    .. math:: n_k = a_1 n_{k-1} + \dots + w_k + b_1 w_{k-1} + \dots

    Parameters
    ----------
    size : float
        RMS value of the noise n [output unit].
    unit : str
        Output unit; empty where the record has none.
    ar, ma : tuple of float
        Coefficients a and b of coloured noise; both empty: it is white.
    freedom : float
        Degrees of freedom of Student's law where w has heavy tails; infinite: it has another law.
    share, ratio : float
        Share of wild readings, and how many times as large as the others these are; zero and one:
        there are none.
    outputs : tuple of (str, float, str)
        Of several outputs, the name of each, its noise and the unit; `size` is then that of the
        first.
    tails : tuple of (float, float, float)
        Of several outputs, `freedom`, `share` and `ratio` of each; empty: all are Gaussian.

    Examples
    --------
    >>> import ctrlid as cid
    >>> print(cid.SensorNoise(1e-4, "m"))
    The sensor noise is white, of 0.1 mm RMS.
    >>> print(cid.SensorNoise(1e-4, "m", ar=(0.999,), ma=(-0.97,)))
    The sensor noise is coloured, ARMA(1, 1), of 0.1 mm RMS: the reading errs alike over about 1000
    samples, as that of a sensor that wanders or warms up.
    >>> print(cid.SensorNoise(1e-4, "m", share=0.01, ratio=10.0))
    The sensor noise is heavy-tailed, of 0.1 mm RMS: 1 % of the readings err 10 times as much as ...
    """

    size: float
    unit: str = ""
    ar: tuple[float, ...] = ()
    ma: tuple[float, ...] = ()
    freedom: float = math.inf
    share: float = 0.0
    ratio: float = 1.0
    outputs: tuple[tuple[str, float, str], ...] = ()
    tails: tuple[tuple[float, float, float], ...] = ()

    @property
    def kind(self) -> str:
        """What it is: ``"white"``, ``"coloured"``, ``"heavy-tailed"`` or the two last together."""
        kinds = ["coloured"] if self.ar or self.ma else []
        laws = [(self.freedom, self.share), *((law[0], law[1]) for law in self.tails)]
        if any(math.isfinite(freedom) or share for freedom, share in laws):
            kinds.append("heavy-tailed")
        return " and ".join(kinds) or "white"

    @property
    def words(self) -> str:
        """What it is, with its order and size, as the end of a sentence."""
        if self.outputs:
            laws = self.tails or ((math.inf, 0.0, 1.0),) * len(self.outputs)
            sizes = []
            for (name, size, unit), law in zip(self.outputs, laws, strict=True):
                text = f"{write_quantity(size, unit or f'[{name}]')} RMS at {name}"
                sizes.append(text + "".join(f" ({told})" for told in _describe_tails(*law)))
            return f"{self.kind}, of {write_list(sizes)}"
        order = f", ARMA({len(self.ar)}, {len(self.ma)})" if self.ar or self.ma else ""
        text = f"{self.kind}{order}, of {write_quantity(self.size, self.unit or '[y]')} RMS"
        told = [self._describe_colour()] if order else []
        told += _describe_tails(self.freedom, self.share, self.ratio)
        return text + (f": {' and '.join(told)}" if told else "")

    def _describe_colour(self) -> str:
        """Say over how many samples the reading errs alike: over many, the sensor wanders."""
        roots = np.roots([1.0, *(-a for a in self.ar)])
        slow = [z.real for z in roots if z.real > abs(z.imag)]
        samples = 1 / max(1 - max(slow, default=0.0), THRESHOLD.tiny)
        if samples < THRESHOLD.lags:
            return "the reading errs alike in successive samples"
        return (f"the reading errs alike over about {samples:.0f} samples, as that of a sensor "
                "that wanders or warms up")  # fmt: skip

    def __str__(self) -> str:
        return f"The sensor noise is {self.words}."


def _describe_tails(freedom: float, share: float, ratio: float) -> list[str]:
    """Say how frequent large errors are, where they are more frequent than Gaussian ones."""
    told = []
    if math.isfinite(freedom):
        told.append("large errors are as frequent as by Student's law with "
                    f"{write_number(freedom, 2)} degrees of freedom")  # fmt: skip
    if share:
        told.append(f"{write_percent(share)} of the readings err "
                    f"{write_number(ratio, 2)} times as much as the others")  # fmt: skip
    return told


@dataclass(frozen=True)
class Calibrated:
    """A free parameter of the model before and after.

    Parameters
    ----------
    name : str
        The parameter.
    given, before, after : float
        Its value as handed in, recalibrated alone, and with the effects [its unit].
    standard_error : float
        Standard error of the last [its unit].
    at_limit : bool
        Whether recalibrated alone it ended at a limit: the model has no good value there.
    """

    name: str
    given: float
    before: float
    after: float
    standard_error: float
    at_limit: bool = False
