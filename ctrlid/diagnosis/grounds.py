"""Step 10: the grounds on which a name does not stand, one function each, and their table."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats
from scipy.signal.windows import dpss

from .._base.text import write_p_value, write_quantity
from ..data.record import Record
from ..effects import AbstractEffect
from ..effects.context import find_motion
from ..loop.loop import Loop
from .candidates import is_same_kind
from .constancy import compare_stretches
from .findings import Gap
from .fitted_model import Model
from .removal import Weighed
from .scans import is_line_of_reference
from .thresholds import THRESHOLD


@dataclass(frozen=True, eq=False)
class Case:
    """What the grounds are judged by: the model as given, the final one, records and errors.

    `errors` are standard errors of the final model's parameters by name, `gap` is that on fresh
    data, and `explained` says whether the tests find noise only in what the final model leaves.
    `gained` is the log-likelihood above that of the recalibrated model, or beside the other effects
    if one of them gains more there, and `finished` says whether the search came to its end, where
    effects are compared and taken back.
    """

    given: Loop
    final: Model
    records: Sequence[Record]
    errors: Mapping[str, float]
    gap: Gap
    explained: bool
    gained: float = math.inf
    finished: bool = True

    def read_effect(self, f: Weighed) -> tuple[str, AbstractEffect]:
        """Return the label of an effect in the final model, and the effect with its values."""
        return list(self.final.fitted.labelled.items())[f.position]


def find_ground(case: Case, f: Weighed) -> str:
    """Say why the name of an effect does not stand; empty if it does.

    Parameters
    ----------
    case : Case
        The end of a diagnosis.
    f : Weighed
        An effect of its final model.
    """
    return next((words for ground in GROUNDS if (words := ground(case, f))), "")


def is_at_a_limit(case: Case, f: Weighed) -> str:
    """Say which parameter went to its limit: beyond it is another model, whatever is named with it.

    A parameter of which the record says so little that the limit is within chance of the given
    value is at no limit.
    """
    given, problem = case.given.parameters, case.final.fit.problem
    label, effect = case.read_effect(f)
    about = {f"{label}.{p.name}": p for p in effect.parameters()}
    # What is at its bound has no standard error in the answer, but one in the fit.
    fitted = case.final.fit.standard_errors
    doubts = dict(zip(case.final.names, fitted.tolist(), strict=True))
    for name, value, low, high in zip(
        case.final.names, case.final.fit.theta, problem.lower, problem.upper, strict=True
    ):
        if value not in (low, high):
            continue
        own = about.get(name)
        # A size may end where its effect begins or vanishes, as in a search.
        ends = own is not None and (own.searched or own.neutral not in (None, low, high))
        moved = abs(value - given.get(name, value))
        doubt = case.errors.get(name) or doubts[name]
        if ends or ("." not in name and moved > _compute_reach_of_chance(doubt)):
            return f"{name} went to its limit, {value:.4g}"
    return ""


def _compute_reach_of_chance(error: float) -> float:
    """Return how far chance takes a value of this standard error."""
    return THRESHOLD.significant * error if math.isfinite(error) else 0.0


def cancels_a_known_force(case: Case, f: Weighed) -> str:
    r"""Say if a constant force takes away most of the one that the model has at rest.

    .. math:: 2 b / a_0 < -1, \quad a_0 = \dot v(x_0, u = 0)

    for the force b, where less than half of the known one is left: it denies what is known, such as
    the weight of a ball, and does not add to it.
    """
    effect = case.read_effect(f)[1]
    if not effect.constant_force:
        return ""
    e, at = case.given.equations(), case.given.point
    motion = find_motion(e, effect.at)
    if motion is None or e.push_units:
        # A force through a mass matrix is in another unit than the rate at rest.
        return ""
    still = 0.0 if e.siso else np.zeros(len(e.inputs))
    known = float(e.evaluate(np.asarray(at.states, dtype=float), still, 0.0)[0][motion[1]])
    bias = effect.values()[effect.constant_force]
    if not (math.isfinite(known) and known * bias < 0 and 2 * abs(bias) > abs(known)):
        return ""
    unit = effect.units(case.given)[effect.constant_force]
    return f"it cancels a known constant force of {write_quantity(known, unit)}"


def differs_between_stretches(case: Case, f: Weighed) -> str:
    """Say if the sizes from stretches that inform about it differ; an event is in one of them.

    A size is how far a parameter is from its neutral value, that of a limit its value, and small
    parts of it do not count.
    """
    if case.final.errors is not None:
        # What was fitted by another criterion has no scores.
        return ""
    label, effect = case.read_effect(f)
    if any(p.instant for p in effect.parameters()):
        return ""
    values = effect.values()
    sizes = {
        f"{label}.{p.name}": abs(values[p.name] - (p.neutral if math.isfinite(p.neutral) else 0.0))
        for p in effect.parameters()
        if p.neutral is not None
    }
    sizes = {name: size for name, size in sizes.items() if name in case.final.names}
    chances = [compare_stretches(case.final.fit, name, THRESHOLD.same_size * size)
               for name, size in sizes.items()]  # fmt: skip
    p = min((p * len(sizes) for p in chances), default=1.0)
    if not p < THRESHOLD.beyond_chance:
        return ""
    return f"its size differs between stretches of the record ({write_p_value(p)})"


def follows_the_reference(case: Case, f: Weighed) -> str:
    """Say if a line keeps its phase to one of the reference in every record.

    Then it may as well be how the loop answers: a wrong law of force or a lag makes such lines.
    """
    effect = case.read_effect(f)[1]
    values = effect.values()
    if "frequency" not in values or "phase" not in values:
        return ""
    frequency = values["frequency"]
    if not all(is_phase_locked(record, frequency) for record in case.records):
        return ""
    line = write_quantity(frequency, "Hz")
    return f"the reference has a line at {line} too, and it keeps its phase to that"


def is_phase_locked(record: Record, frequency: float) -> bool:
    r"""Whether the reference has a line at a frequency, and not only power about it.

    .. math:: F = (K - 1) \frac{|\mu|^2 \sum_k U_k^2}{\sum_k |J_k - \mu U_k|^2}, \quad
        \mu = \frac{\sum_k U_k J_k}{\sum_k U_k^2}

    with the Fourier coefficients :math:`J_k` of the reference through K orthogonal windows of sums
    :math:`U_k`. Of a steady line each has its share; of power without a line they are independent,
    and F has the distribution of Fisher with 2 and 2 K - 2 degrees of freedom. A line that was
    fitted to the whole record has a constant phase itself. Its frequency is known to a part of what
    a record resolves, and the likeliest frequency within that counts.

    References
    ----------
    D. J. Thomson, Spectrum estimation and harmonic analysis, Proc. IEEE 70 (1982) 1055-1096.
    """
    if record.r is None or not is_line_of_reference(record, frequency):
        return False
    if record.r.ndim == 2:
        return any(
            is_phase_locked(record.select(r=name, y=record.signals["y"][0]), frequency)
            for name in record.signals["r"]
        )
    keep = record.valid_samples & np.isfinite(record.r)
    r = np.where(keep, record.r - np.mean(record.r[keep]), 0.0)
    count = THRESHOLD.tapers
    windows = dpss(len(r), (count + 1) / 2, count)
    sums = np.sum(windows, axis=1)
    near = frequency + np.linspace(-0.5, 0.5, count) / (record.dt * len(r))
    waves = np.exp(-2j * np.pi * near * np.asarray(record.t)[:, None])
    parts = (windows * r) @ waves
    line = (sums @ parts) / (sums @ sums)
    left = np.sum(np.abs(parts - np.outer(sums, line)) ** 2, axis=0)
    ratio = (count - 1) * np.abs(line) ** 2 * (sums @ sums) / np.maximum(left, THRESHOLD.tiny)
    p = len(near) * float(np.min(stats.f.sf(ratio, 2, 2 * count - 2)))
    return p < THRESHOLD.beyond_chance


def narrows_no_gap(case: Case, f: Weighed) -> str:
    r"""Say if a model that is still wrong is no nearer to fresh data for its effects.

    .. math:: g_1^2 > (1 - h)\, g_0^2

    for the gaps before and after, and a fair part h. A likelihood is evidence among models of which
    one is right. Where the tests reject the model with all its effects, fresh data alone speak for
    their names. The floor is no measure here, since a random force of the wrong model is in it.
    """
    del f
    gap = case.gap
    if case.explained:
        return ""
    if gap.after**2 < (1 - THRESHOLD.helps) * gap.before**2:
        return ""
    return "something else is missing, and on fresh data the effects do not narrow the gap"


def is_one_of_several(case: Case, f: Weighed) -> str:
    """Say if a model that is still wrong has further effects of the same kind.

    Three ripples are how a search draws the curve of a cause that it does not know, as a sum of
    sines draws any curve.
    """
    if case.explained:
        return ""
    effect = case.read_effect(f)[1]
    given = len(case.given.effects)
    added = [e for k, e in enumerate(case.final.fitted.effects) if k >= given and k != f.position]
    if not any(is_same_kind(e, effect) for e in added):
        return ""
    return "something else is missing, and other effects of the same kind are needed beside it"


def was_not_checked(case: Case, f: Weighed) -> str:
    """Say if a search was stopped before it asked whether a small effect stands in for others.

    What a search that ends keeps of such effects is what helps on fresh data.
    """
    if case.finished or case.explained or not f.trial.gain < THRESHOLD.minor * case.gained:
        return ""
    return (
        "it gains little beside the others, something else is missing, and the search was stopped "
        "before it asked what else would do"
    )


# A name stands if none of these has anything to say.
GROUNDS: tuple[Callable[[Case, Weighed], str], ...] = (
    is_at_a_limit,
    cancels_a_known_force,
    differs_between_stretches,
    follows_the_reference,
    narrows_no_gap,
    is_one_of_several,
    was_not_checked,
)
