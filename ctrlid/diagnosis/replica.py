"""Records that a fitted model would have given: what the method finds where nothing is hidden."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from .._base.errors import CtrlidError
from ..data.record import Record
from ..estimation.likelihood.likelihood import Fit, evaluate
from ..estimation.likelihood.maximization import begin, climb
from ..estimation.likelihood.physics_fit import make_problem
from ..loop.simulation import Simulator
from .attempts import attempt_at, refit
from .carrying import carried_over
from .fitted import Model, simulable
from .following import following
from .gap import FEW_STEPS, ROUGH, drive, random_noise
from .omnibus import ALPHA, Omnibus, omnibus
from .trial import Trial

DOUBTFUL = 400.0  # a gain above this is no artefact of the filter, if the model has no effect yet
TWICE = 2.0  # what the replica gains counts this much against a candidate
KINKED = 1e-4  # chance of a false alarm where the filter only nearly follows a kink
BEYOND = 3.0  # logarithms of chance by which a test must fail more than on a replica


def replica(model: Model, seed: int = 0) -> Model | None:
    """Simulate the records with a fitted model and its noise, and fit the model to them.

    Parameters
    ----------
    model : Model
        The fitted model. If it is unstable and its controller not known, one that follows the
        record stands in for that.
    seed : int, optional
        Seed of the noise.

    Returns
    -------
    Model or None
        The model fitted to the simulated records; None where it cannot be simulated.
    """
    loop, fit = model.fitted, model.fit
    try:
        records = [
            _simulated(model, t.record, float(t.table[0, 0]), float(r), seed + 101 * k)
            for k, (t, r) in enumerate(zip(fit.problem.tracks, fit.sensor, strict=True))
        ]
        begins = [float(t.table[0, 0]) for t in fit.problem.tracks]
        problem = make_problem(loop, model.names, records, begins)
        problem = replace(problem, counts=fit.problem.counts, known=fit.problem.known)
        # With other noise a loop may take another path; or the first guess of one may lead astray.
        along = evaluate(problem, fit.theta, fit.noise, [o.trajectory for o in fit.filtered])
        starts = along, begin(problem, fit.theta, fit.noise)
        again = climb(max(starts, key=_likely), rounds=8, exact=False)
    except CtrlidError:
        return None
    return Model(loop, again) if math.isfinite(again.value) else None


def _likely(fit: Fit) -> float:
    return fit.value if math.isfinite(fit.value) else -math.inf


def _simulated(model: Model, record: Record, first: float, sensor: float, seed: int) -> Record:
    follows = not simulable(model)
    loop = following(model.fitted, record) if follows else model.fitted
    if loop is None:
        raise CtrlidError("the record cannot be followed")
    simulator = Simulator(loop, ROUGH, FEW_STEPS)
    y, u = np.array(record.y), np.array(record.u)
    for start, stop in record.segments():
        if stop - start < 10:
            continue
        part = record[start:stop]
        z, r, d = drive(simulator, part, follows)
        noise = random_noise(model.fit, sensor, len(part), seed + start)
        begin = first + float(record.t[start] - record.start)
        y[start:stop], u[start:stop] = simulator.run(z, r, d, noise, begin)
    return replace(record, y=y, u=u)


def kinked(model: Model) -> bool:
    """Whether a model has kinks in its states, such as dry friction."""
    return model.fit.problem.machine.e.kinked


def artefact(copies: Sequence[Model | None], trial: Trial) -> float:
    """Return what a candidate gains on records in which it is known not to be.

    Parameters
    ----------
    copies : sequence of Model or None
        Replicas of the model that the candidate was added to.
    trial : Trial
        The candidate.

    Returns
    -------
    float
        Gain of log-likelihood, zero at least.
    """
    gains = [0.0]
    for copy in copies:
        if copy is None:
            continue
        again = refit(copy, attempt_at(copy, trial.fitted, trial.scan))
        if not again.gain > 0:  # from there dry friction may have led it another way
            again = refit(copy, attempt_at(copy, trial.effect, trial.scan))
        gains.append(again.gain if math.isfinite(again.gain) else 0.0)
    return max(gains)


def more_than_simple(base: Model, best: Trial, simple: Trial) -> float:
    """Return what the further parameters of an effect gain over a simpler one.

    What the further parameters gain on a record simulated with the simpler effect, they gain
    from the approximations of the filter: twice that is taken off.

    Parameters
    ----------
    base : Model
        The model without either.
    best, simple : Trial
        The refitted candidates.

    Returns
    -------
    float
        Gain of log-likelihood; infinite where no record can be simulated.
    """
    copy = replica(simple.model)
    if copy is None:
        return math.inf
    try:
        under = carried_over(copy, base.fitted, base.names)
    except CtrlidError:
        return math.inf
    # Both climb from the same start: where the replica was fitted, the simple one may be stuck.
    without = Model(base.fitted, under)
    again, plain = (refit(without, attempt_at(without, t.fitted)) for t in (best, simple))
    least = max(copy.fit.value, plain.model.fit.value)
    usual = again.model.fit.value - least if math.isfinite(again.gain) else 0.0
    return best.gain - simple.gain - TWICE * max(usual, 0.0)


def forgiven(tests: Omnibus, copies: Sequence[Model | None]) -> Omnibus:
    """Return the tests without alarms that the filter's own approximation raises.

    A test that fails on the record, and on records simulated with the very model, says nothing
    against the model.
    """
    bent = any(copy is not None and copy.loop.effects and kinked(copy) for copy in copies)
    known = [omnibus(copy.fit).p_values for copy in copies if copy is not None]
    if not known:
        return tests
    p = {}
    for name, value in tests.p_values.items():
        usual = min(k.get(name, 1.0) for k in known)
        failed = usual < ALPHA and math.log(max(value, 1e-300)) > BEYOND * math.log(
            max(usual, 1e-300)
        )
        p[name] = max(value, 0.5) if failed else value
    return replace(tests, p_values=p, alpha=KINKED if bent else tests.alpha)
