"""Whether a logged u is that of a sampled controller, although the stated one is analog."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import control as ct
import numpy as np
from scipy import signal

from .._base.arrays import Array
from .._base.statistics import regress
from .._base.text import write_list, write_percent
from ..data.record import Record
from ..data.validity import find_longest_run
from ..physics.conversions import to_state_matrices
from .controllers import find_input_order

# Shorter stretches do not tell what computed the input.
FEWEST = 20
# So many samples are replayed, which tell enough and take a tenth of a second.
MOST = 2000
# A sampled form replays u if it leaves at most this share of its variance, rounding and dither.
REPLAYED = 1e-3
# It is believed if it leaves less than this share of what the analog law leaves.
CLEARLY = 0.01
# Rounding and printing leave at most this share of u's variance.
EXACT = 1e-6
# Initial states below this share of the largest are not in a regression's data.
DETERMINED = 1e-10
# Rules of `control.sample_system`, with the names that scipy has for them.
RULES = {
    "tustin": "bilinear", "zoh": "zoh", "euler": "euler", "backward_diff": "backward_diff",
}  # fmt: skip


@dataclass(frozen=True)
class SampledForm:
    """A sampled form of an analog controller that replays a logged u, and the analog one does not.

    Parameters
    ----------
    rule : str
        The rule, as `control.sample_system` takes it; empty for a gain, which has no rule.
    left, analog : float
        Shares of the variance of u that the sampled and the analog controller do not explain.
    """

    rule: str
    left: float
    analog: float


def find_sampled_form(controller: Any, record: Record, *outputs: str) -> SampledForm | None:
    """Return the sampled form of an analog controller that computed a logged u.

    Between samples nothing is known of r and y. To a sampled controller this makes no difference,
    so that it replays u down to rounding; of an analog one u is told only as far as straight lines
    between the samples do. A gain is the same at the samples either way: it is taken as sampled
    where the record says that u is held and the replay is exact, as no circuit's log is.

    Parameters
    ----------
    controller : object
        The stated controller of r - y, or of r and y.
    record : Record
        The record.
    *outputs : str
        What the output is called, besides y and its name in the record.

    Returns
    -------
    SampledForm or None
        None where the controller is no linear analog one, or the log does not say that it was
        sampled.
    """
    if isinstance(controller, int | float | np.number):
        controller = ct.tf([float(controller)], [1.0])
    if not isinstance(controller, ct.TransferFunction | ct.StateSpace) or (
        controller.dt not in (0, None) or controller.noutputs != 1 or controller.ninputs > 2
    ):
        return None
    if record.r is None or any(np.ndim(s) != 1 for s in (record.r, record.u, record.y)):
        return None
    names = (*outputs, *record.signals["y"][:1])
    part = record[find_longest_run(record.valid)][:MOST] if record.valid.any() else record[:MOST]
    # What a limit cut off lies at the ends of u, and is no output of a linear law.
    inside = (part.u > part.u.min()) & (part.u < part.u.max())
    if np.count_nonzero(inside) < FEWEST:
        return None
    with np.errstate(all="ignore"):
        analog = min(
            _measure_left(run, part, inside) for run in _run_analog(controller, part, *names)
        )
        if not to_state_matrices(controller)[0].size:
            known = record.hold == "zoh" and analog <= EXACT
            return SampledForm("", analog, analog) if known else None
        sampled = [
            SampledForm(rule, _measure_left(_run(law, part), part, inside), analog)
            for rule, law in _list_sampled(controller, part.dt, *names)
        ]
    best = min(sampled, key=lambda form: form.left)
    return best if best.left <= min(REPLAYED, CLEARLY * analog) else None


def describe_sampled_form(form: SampledForm, record: Record, where: str) -> str:
    """Say that the logged u is that of a sampled controller, what that does, and what to do.

    Parameters
    ----------
    form : SampledForm
        What was found.
    record : Record
        The record.
    where : str
        What should be given the sampled controller, as in "the loop".

    Returns
    -------
    str
        The sentences.
    """
    call = f"ct.sample_system(C, {record.dt:g}, {form.rule or 'zoh'!r})"
    if form.rule:
        why = (
            f"its form {call} leaves {write_percent(form.left, 2)} of the variance of u, the "
            f"analog law {write_percent(form.analog, 2)}"
        )
    else:
        why = "it is that gain times the logged r - y exactly, and the record says hold='zoh'"
    cure = [f"give {where} {call}"]
    if record.hold != "zoh":
        cure.append("the record hold='zoh'")
    if not form.rule:
        cure[0] += ", or for an analog circuit the record hold='foh'"
    return (
        f"THE LOGGED INPUT IS THAT OF A SAMPLED CONTROLLER, but an analog one is stated (a system "
        f"without dt): {why}. A sampled controller holds u over the period, an analog one moves "
        f"it, so that what is fitted or simulated with it is wrong. For a sampled one "
        f"{write_list(cure)}."
    )


def note_sampled_controller(
    controller: Any, records: Sequence[Record], where: str
) -> tuple[str, ...]:
    """Return what to say where a stated analog controller was a sampled one; empty otherwise."""
    for record in records:
        form = find_sampled_form(controller, record)
        if form is not None:
            return (describe_sampled_form(form, record, where),)
    return ()


def read_matrices(controller: Any, *outputs: str) -> tuple[Array, Array, Array, Array]:
    """Return the state matrices of a controller as one with the inputs r and y.

    Besides y the measurement may have the names of outputs.
    """
    a, b, c, d = to_state_matrices(controller)
    if controller.ninputs == 1:
        return a, np.hstack([b, -b]), c, np.hstack([d, -d])
    order = list(find_input_order(controller, *outputs))
    return a, b[:, order], c, d[:, order]


def _discretize(matrices: Any, dt: float, method: Any) -> Any:
    """Return the state matrices of a sampled law by one of scipy's rules."""
    return signal.cont2discrete(matrices, dt, method)[:4]


def _list_sampled(controller: Any, dt: float, *outputs: str) -> Iterator[tuple[str, Any]]:
    """Yield the rules of sampling and the state matrices that they make."""
    matrices = read_matrices(controller, *outputs)
    for rule, method in RULES.items():
        try:
            yield rule, _discretize(matrices, dt, method)
        except np.linalg.LinAlgError:
            continue  # A pole at 2/dt or 1/dt has no form by this rule.
    if controller.ninputs == 1:
        gain = controller(0)
        # The rule matches the gain at rest, which an integral or a zero there does not have.
        if np.isfinite(gain) and gain != 0:
            matched = ct.sample_system(ct.tf(controller), dt, "matched")
            yield "matched", read_matrices(matched)


def _run_analog(controller: Any, record: Record, *outputs: str) -> Iterator[Array]:
    """Yield what the analog law makes of a straight y, and of an r that is held or straight."""
    matrices = read_matrices(controller, *outputs)
    if not matrices[0].size:
        yield _run(matrices, record)
        return
    held, straight = (
        _run(_discretize(matrices, record.dt, rule), record) for rule in ("zoh", "foh")
    )
    yield straight
    mixed = straight.copy()
    mixed[:, 0] = held[:, 0]
    yield mixed


def _run(matrices: Sequence[Any], record: Record) -> Array:
    """Return what a law makes of r and of y from rest, and of each state at the first sample."""
    a, b, c, d = matrices
    n = len(a)
    # Constants that are common to r and y only carry digits.
    w = np.column_stack([record.r, record.y]) - record.y[0]
    columns = np.zeros((record.n, 2 + n))
    columns[:, :2] = w * d
    state = np.hstack([np.zeros((n, 2)), np.eye(n)])
    for k in range(record.n if n else 0):
        columns[k] += (c @ state)[0]
        state = a @ state
        state[:, :2] += b * w[k]
    return columns


def _measure_left(columns: Array, record: Record, inside: Any) -> float:
    """Return the share of u's variance that a law leaves from its best state and a constant."""
    if not np.isfinite(columns).all():
        return np.inf
    goal = (record.u - columns[:, :2].sum(axis=1))[inside]
    table = np.column_stack([np.ones(record.n), columns[:, 2:]])[inside]
    left = goal - table @ regress(table, goal, DETERMINED)
    return float(np.mean(left**2)) / max(float(np.var(record.u[inside])), 1e-300)
