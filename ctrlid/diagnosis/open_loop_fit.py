"""A stable plant fitted by the error of its open-loop simulation, with exact sensitivities."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import optimize

from .._base.arrays import Array
from .._base.errors import CtrlidError, ModelCannotRun
from .._base.interruption import check_budget
from .._base.statistics import autocorrelation_time, pseudo_inverse
from ..data.record import Record
from ..estimation.likelihood.kalman_filter import Noise
from ..estimation.likelihood.likelihood import Fit, Known, evaluate_likelihood, make_problem
from ..estimation.likelihood.sampled_plant import Trajectory
from ..loop.loop import Loop
from .thresholds import THRESHOLD


@dataclass(frozen=True, eq=False)
class Simulated:
    """A loop fitted to what an open-loop simulation makes of records.

    `task` is what was simulated, `theta` its parameters; `starts` are the states at the first
    sample of each record, by name; `errors` and `slopes` the errors at the samples that count,
    records one after the other, and their derivatives by parameters and initial states.
    """

    task: Simulation
    theta: Array
    starts: tuple[Mapping[str, float], ...]
    errors: Array
    slopes: Array
    states: tuple[Array, ...]

    @property
    def loop(self) -> Loop:
        """The loop with the values that the search began at."""
        return self.task.loop

    @property
    def names(self) -> tuple[str, ...]:
        """The parameters that were fitted."""
        return self.task.names

    @property
    def square(self) -> float:
        """Mean square of the errors."""
        return float(np.mean(self.errors**2))

    @property
    def fitted(self) -> Loop:
        """The loop with the fitted values."""
        return self.loop.with_parameters(dict(zip(self.names, self.theta.tolist(), strict=True)))

    @property
    def standard_errors(self) -> dict[str, float]:
        """Standard errors of the parameters, for as many samples as are independent."""
        matrix = self.slopes.T @ self.slopes / (self.square * self.correlated)
        variance = np.diag(pseudo_inverse(matrix))[: len(self.names)]
        seen = np.diag(matrix)[: len(self.names)] > 0
        sizes = np.where(seen, np.sqrt(np.maximum(variance, 0.0)), np.inf)
        return dict(zip(self.names, sizes.tolist(), strict=True))

    @property
    def correlated(self) -> float:
        """How many neighbouring errors say no more than one that is independent."""
        return autocorrelation_time(self.errors)


class Simulation:
    """Records simulated open loop by a plant, with sensitivities to parameters and initial states.

    Parameters
    ----------
    loop : Loop
        The plant with its effects; no controller takes part.
    names : sequence of str
        The free parameters.
    records : sequence of Record
        The data, of one sampling period and hold.
    start_times : sequence of float
        Times of their first samples since the start of the experiment [s].
    """

    def __init__(
        self,
        loop: Loop,
        names: Sequence[str],
        records: Sequence[Record],
        start_times: Sequence[float],
    ) -> None:
        self.loop, self.names = loop, tuple(names)
        self.records, self.start_times = tuple(records), tuple(start_times)
        # The error of a simulation is no likelihood that a belief could be weighed against.
        self.problem = replace(make_problem(loop, self.names, records, start_times), priors={})
        plant = self.plant = self.problem.plant
        step = plant.build_sensitivity_map()
        self.runs = [step.mapaccum("run", len(data.record)) for data in self.problem.data]

    def with_loop(self, loop: Loop, names: Sequence[str]) -> Simulation:
        """Return the same records, simulated by another loop."""
        return Simulation(loop, names, self.records, self.start_times)

    def make_initial_states(self, starts: Sequence[Mapping[str, float]]) -> Array:
        """Return initial states, shape (records, states); what is not known begins at rest."""
        plant = self.plant
        rest = [plant.pad_controller_states(data.start.copy()) for data in self.problem.data]
        for x, known in zip(rest, starts, strict=True):
            for k, name in enumerate(plant.e.states):
                x[k] = known.get(name, x[k])
        return np.array(rest)

    def run(self, theta: Array, x0: Array) -> tuple[Array, Array, tuple[Array, ...]]:
        """Return errors, their derivatives and the states, for all records."""
        plant, p = self.plant, len(self.names)
        n, count = plant.plan.size, len(self.runs)
        values, errors, slopes, states = plant.insert_free_values(theta), [], [], []
        for k, (data, run) in enumerate(zip(self.problem.data, self.runs, strict=True)):
            check_budget(len(data.record))
            z = np.concatenate([x0[k], np.zeros(n * p), np.eye(n).ravel()])
            after, seen = (np.asarray(out, float) for out in
                           run(z, plant.stack_inputs(data, theta), values))  # fmt: skip
            states.append(np.vstack([x0[k], after[:n, :-1].T]))
            y, keep = data.y, data.valid
            error = y - seen[0]
            wide = np.zeros((len(y), p + n * count))
            wide[:, :p] = -seen[1 : p + 1].T
            wide[:, p + n * k : p + n * (k + 1)] = -seen[p + 1 :].T
            lost = ~(np.isfinite(error) & np.isfinite(wide).all(axis=1))
            error[lost], wide[lost] = THRESHOLD.lost_simulation * float(np.std(y)), 0.0
            errors.append(error[keep])
            slopes.append(wide[keep])
        return np.concatenate(errors), np.vstack(slopes), tuple(states)

    def at(self, theta: Array, x0: Array) -> Simulated:
        """Return the simulation of given values."""
        errors, slopes, states = self.run(theta, x0)
        names = self.plant.e.states
        starts = tuple(dict(zip(names, x.tolist(), strict=False)) for x in x0)
        return Simulated(self, theta, starts, errors, slopes, states)

    def fit(self, theta: Array, x0: Array, evaluations: int | None = None) -> Simulated:
        """Return the values and initial states with the smallest error nearby."""
        p, shape = len(theta), x0.shape
        free = np.full(x0.size, np.inf)
        lower = np.concatenate([self.problem.lower, -free])
        upper = np.concatenate([self.problem.upper, free])
        start = np.concatenate([theta, x0.ravel()])
        inside = THRESHOLD.rounding * (1.0 + np.abs(start))
        start = np.clip(start, lower + inside, upper - inside)
        last: dict[bytes, tuple[Array, Array]] = {}

        def both(v: Array) -> tuple[Array, Array]:
            if v.tobytes() not in last:
                last.clear()
                last[v.tobytes()] = self.run(v[:p], v[p:].reshape(shape))[:2]
            return last[v.tobytes()]

        def error(v: Array) -> Array:
            return both(v)[0]

        def slope(v: Array) -> Array:
            return both(v)[1]

        most = evaluations or THRESHOLD.open_loop_evaluations
        try:
            found = optimize.least_squares(
                error, start, slope, bounds=(lower, upper), x_scale="jac", max_nfev=most
            )
        except ValueError as reason:
            if isinstance(reason, CtrlidError):
                raise
            # SciPy's own: a start that is no number, a decomposition that does not converge.
            raise ModelCannotRun(str(reason)) from reason
        return self.at(found.x[:p], found.x[p:].reshape(shape))


def make_fit(found: Simulated, sensor: Array) -> Fit:
    """Return a simulation as a point of the likelihood that knows no random force.

    Parameters
    ----------
    found : Simulated
        The simulation.
    sensor : ndarray, shape (records,)
        Variances of the sensor noise [output unit^2].

    Returns
    -------
    Fit
        Its innovations are the errors of the simulation.
    """
    task = found.task
    silent = Noise((0.0,) * task.plant.channels)
    problem = replace(
        task.problem,
        known=Known(silent, sensor),
        data=tuple(
            replace(
                data,
                start=x[0],
                spread=np.zeros_like(data.spread),
                input_variance=np.zeros(len(x)),
                restart=np.arange(len(x)) == 0,
            )
            for data, x in zip(task.problem.data, found.states, strict=True)
        ),
        counts=tuple(data.valid for data in task.problem.data),
    )
    # The simulation begins in the middle of any backlash.
    p = task.plant.insert_free_values(found.theta)
    at = []
    for data, x in zip(problem.data, found.states, strict=True):
        first = task.plant.extend_start(data, x[0], data.spread, p)[0]
        whole = np.hstack([x, np.tile(first[x.shape[1] :], (len(x), 1))])
        at.append(Trajectory(whole, whole.copy(), np.zeros_like(whole)))
    return evaluate_likelihood(problem, found.theta, silent, at)
