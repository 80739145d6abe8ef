"""fit_loop(): the physical parameters of a loop's plant, by maximum likelihood."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ..._base.arguments import check_arguments, explain_names, point_at_part
from ..._base.errors import CtrlidError, ModelCannotRun
from ..._base.interruption import hold_interrupt
from ..._base.rounding import keep_numpy_quiet
from ..._base.statistics import pseudo_inverse
from ..._base.text import write_list
from ...data.outliers import describe_outliers, mask_outliers
from ...data.record import Record
from ...data.several_records import (
    VISIBLE_MOTION,
    as_records,
    measure_input_motion,
    order_model_and_data,
)
from ...effects import ReadingEffect
from ...loop.loop import Loop, sharpen_effects
from ...loop.sampled_form import note_sampled_controller
from ...loop.step_check import describe_unstated_steps
from ...loop.unit_check import describe_distance, measure_distance, note_unit_clashes
from ...physics.linearization import compute_state_matrices
from ..whiteness import note_coloured_innovations
from .abrupt_friction import sharpen_friction
from .filter_data import find_noise_units, has_several_noises, name_noise_places
from .likelihood import Fit, find_priors, list_effect_bounds, make_problem
from .maximization import (
    begin_fit,
    choose_noise,
    compute_information,
    maximize,
    refit_noise_size,
    refit_quiet_force,
)
from .noise.force_size import measure_doubt_by_force
from .physics_estimate import LoopEstimate, LoopFit, mark_unseen, note_absurd_values

# A given value is contradicted where the fit is farther from it than three of its standard
# deviations, which chance does in 1 of 370 cases.
CONTRADICTED = 3.0
# An input that counts less than this share of what it did is doubted.
DISCOUNTED = 0.01
# So is one that moves the plant less than the random force does.
OUTDONE = 1.0


@explain_names
@hold_interrupt()
@keep_numpy_quiet
def fit_loop(
    loop: Loop,
    record: Record | Sequence[Record],
    *,
    free: Sequence[str] | Mapping[str, float] | None = None,
    coloured: bool | None = None,
) -> LoopFit:
    r"""Fit the uncertain physical parameters of a loop's plant to one or several records.

    .. math:: \max_{\theta, \eta} \; -\tfrac12 \sum_k \Bigl( \ln 2\pi s_k +
        \frac{e_k^2}{s_k} \Bigr), \quad e_k = y_k - \hat y_{k|k-1}(\theta, \eta)

    The innovations e of an extended Kalman filter on the plant's own equations, with variances s,
    make the likelihood; noise of the sensor and of the force is estimated with the parameters. The
    filter uses the measured input only: feedback does not bias the estimate, and neither reference
    nor controller is needed. Sensitivities are exact derivatives of the traced equations.
    Gross outliers of the sensor are left out, and a note says how many and where. Dry friction is
    made more abrupt, by the `sharpness` of the loop, where that makes the records more probable.

    Parameters
    ----------
    loop : Loop
        Plant with the names of its uncertain parameters in `free`; its values are the start.
        Effects in the loop are fitted with them.
    record : Record or sequence of Record
        The data; several records share the parameters and the force noise.
    free : sequence of str, or mapping of str to float, optional
        Parameters to fit; by default those of `loop.free` and those of the effects. ``{"K": 0.1}``
        also says how well each is known beforehand, as in a `Loop`: then the penalized likelihood
        is maximized, to which a Gaussian prior around the value of the loop is added, and the
        covariance is that of both together.
    coloured : bool, optional
        Whether a coloured (Ornstein-Uhlenbeck) random force takes part; by default if it pays by
        the Bayesian information criterion.

    Returns
    -------
    LoopFit
        The loop with the fitted values, and the estimate with standard errors.

    Raises
    ------
    CtrlidError
        If nothing is free, the records do not fit the loop, or the filter loses them so that the
        likelihood is not finite.

    References
    ----------
    Åström, "Maximum likelihood and prediction error methods", Automatica 16 (1980) 551-574;
    Ljung, *System Identification*, sections 7.4 and 9.

    Examples
    --------
    >>> import ctrlid as cid
    >>> plant = cid.plants.maglev(m=0.0213, K=3.34e-6)
    >>> op = cid.operating_point(plant, output=0.012)
    >>> C = cid.design_lead(cid.linearize(plant, op), crossover=100, phase_margin=50)
    >>> loop = cid.Loop(plant, C.sample(0.001, "tustin"), dt=0.001, at=op, free=("K",))
    >>> r = cid.random_binary(3000, amplitude=1e-4, hold=20, around=op.output, seed=1)
    >>> record = cid.simulate(loop, r, sensor_noise=2e-6, seed=2)
    >>> fitted = cid.fit_loop(loop.with_parameters({"K": 3.1e-6}), record)
    >>> low, high = fitted.estimate.confidence_interval("K", level=0.999)
    >>> low < 3.34e-6 < high
    True
    """
    loop, record = order_model_and_data(loop, record)
    check_arguments(fit_loop, locals(), "loop", "record")
    given = as_records(record)
    names = choose_free_names(loop, free, "fit_loop")
    # A single reading far outside makes any Gaussian likelihood follow it and nothing else.
    masked = [mask_outliers(one) for one in given]
    records = [one for one, _ in masked]
    if coloured and not loop.equations().siso:
        raise CtrlidError(
            "fit_loop fits a coloured random force to a loop with one input and one output; this "
            f"one has outputs ({', '.join(loop.signals['y'])}). Leave out coloured=True: each "
            "velocity has a white force of its own"
        )
    problem = make_problem(loop, names, records)
    _refuse_rest(records)
    if free is not None:
        asked = replace(loop, free=free) if isinstance(free, Mapping) else loop
        problem = replace(problem, priors=find_priors(asked, free))
    fit = refit_quiet_force(refit_noise_size(maximize(begin_fit(problem))))
    fit = sharpen_friction(fit)
    if coloured or coloured is None:
        fit = choose_noise(fit, always=bool(coloured))
    fitted = summarize_fit(loop, fit) if math.isfinite(fit.value) else None
    if fitted is None or _says_nothing(fit, fitted):
        raise ModelCannotRun(
            f"the likelihood of {fit.plant.e.name} on this record is not finite, or says nothing "
            "of any parameter: the model has lost the record. Check units, signs and the operating "
            "point, and exclude with valid= what the sensor cannot have seen"
        )
    left_out = [describe_outliers(one, found)
                for one, (_, found) in zip(given, masked, strict=True) if found.any()]  # fmt: skip
    innovations = [row for one in fit.standardized for row in np.atleast_2d(one.T)]
    told = _TOO_NARROW + (_TELLS_COLOUR if fit.plant.e.siso else _TELLS)
    colour = note_coloured_innovations(innovations, len(fit.theta), told)
    notes = (
        *note_unit_clashes(loop, fit.problem.data[0].record),
        *_note_distance(loop, given[0]),
        *note_sampled_controller(loop.controller, given, "the loop"),
        *left_out,
        *_note_doubtful_input(loop, given, fitted),
        *note_absurd_values(
            fit.plant.names, list_starts(loop), fit.theta, fitted.estimate.standard_errors
        ),
        *fitted.estimate.notes,
        *_note_steps(loop, fit, fitted),
        *colour,
        *_note_contradicted_values(fit),
        *_note_unknown_controller(loop, given),
    )
    return replace(fitted, estimate=replace(fitted.estimate, notes=notes))


def _note_distance(loop: Loop, record: Record) -> list[str]:
    """Return a note where a record is far from the operating point of its loop."""
    ratio = measure_distance(loop, record)
    return [f"LOOK AT THE UNITS: {describe_distance(loop, ratio)}"] if ratio else []


def _note_steps(loop: Loop, fit: Fit, fitted: LoopFit) -> list[str]:
    """Return a note where readings have steps that the loop does not have, of the first record."""
    found = (
        describe_unstated_steps(loop, one.record, noise)
        for one, noise in zip(fit.problem.data, fitted.estimate.sensor_noise, strict=True)
    )
    return [text for text in found if text][:1]


def _says_nothing(fit: Fit, fitted: LoopFit) -> bool:
    """Whether no parameter has any influence, though none is at its limit."""
    theta, problem = fit.theta, fit.problem
    inside = np.all((theta > problem.lower) & (theta < problem.upper))
    return bool(len(theta) and inside and not np.any(fitted.estimate.standard_errors))


def _refuse_rest(records: Sequence[Record]) -> None:
    """Refuse records in which no output moves, of which any parameter is as likely as another."""
    for record in records:
        rows = np.reshape(record.y, (-1, len(record)))
        seen = (row[use] for row, use in zip(rows, record.valid_outputs, strict=True))
        if any(values.size and np.ptp(values) for values in seen):
            return
    names = records[0].signals["y"]
    raise CtrlidError(
        f"{write_list(names)} {'stay' if len(names) > 1 else 'stays'} at one value in all valid "
        "samples, which says nothing of the parameters: record while the plant moves, or look "
        "whether the sensor is stuck"
    )


def _note_contradicted_values(fit: Fit) -> tuple[str, ...]:
    """Return what to say where the record takes a parameter far beyond its stated uncertainty."""
    found = []
    for name, value in zip(fit.plant.names, fit.theta.tolist(), strict=True):
        mean, deviation = fit.problem.priors.get(name, (value, math.inf))
        away = abs(value - mean) / deviation
        if away > CONTRADICTED:
            found.append(
                f"{name} IS FAR FROM ITS GIVEN VALUE, {value:.4g} in place of {mean:.4g}: this is "
                f"{away:.0f} times the uncertainty that free= states for it. Either the given "
                "value is known less well than that, or the model lacks something that the "
                "parameter stands in for: diagnose() tells what"
            )
    return tuple(found)


def _note_doubtful_input(
    loop: Loop, records: Sequence[Record], fitted: LoopFit
) -> tuple[str, ...]:  # fmt: skip
    """Return what to say where the fitted parameters put the input away, or a force its place.

    With the wrong sign of u the best that a plant with positive parameters can do is not to react
    to u at all. Dry friction that is zero is on a bound as well, and no reason to speak.
    """
    estimate, e = fitted.estimate, loop.equations()
    own = [name for name in estimate.active if name not in list_effect_bounds(loop)]
    if not e.siso:
        return ()
    # Without effects: what a lag does with the input is no question of how much it counts.
    bare = [replace(one, effects=(), free=()) for one in (loop, fitted.loop)]
    try:
        given, now = (
            np.abs(compute_state_matrices(one.equations(), one.point)[1][:, 0]) for one in bare
        )
    except ModelCannotRun:
        return ()  # At a corner nobody can say how much the input counts.
    seen = given > 0
    share = float(np.max(now[seen] / given[seen], initial=0.0)) if seen.any() else 1.0
    spread = max(float(np.std(record.u[record.valid])) for record in records)
    push = spread * float(np.max(given[list(bare[0].equations().velocities)], initial=0.0))
    force = math.hypot(float(np.max(estimate.force_noise)), estimate.coloured_force)
    bound = f"{write_list(own)} {'IS ON A BOUND' if len(own) == 1 else 'ARE ON THEIR BOUNDS'}"
    if share < DISCOUNTED:
        why = (f"THE INPUT HARDLY COUNTS in the fitted model, {share:.2g} times what it does in "
               f"the model as given{f', and {bound}' if own else ''}")  # fmt: skip
    elif own and push and force > OUTDONE * push:
        why = f"{bound}, and the random force that was found outdoes the input"
    else:
        return ()
    return (
        f"{why}. CHECK THE SIGN AND THE UNIT of u, and those of y: audit(record, loop) compares "
        "them with the controller of the loop, where it has one",
    )


def _note_unknown_controller(loop: Loop, records: Sequence[Record]) -> tuple[str, ...]:
    """Return what to say where an analog controller that is not known may move u visibly."""
    moves = measure_input_motion(records)
    known = loop.controller is not None or all(record.r is None for record in records)
    if known or moves <= VISIBLE_MOTION:
        return ()
    return (
        f"u MOVES BETWEEN THE SAMPLES, by {100 * moves:.0f} % of its standard deviation from one "
        "to the next, and a straight line is assumed. Where an analog controller moves it "
        "otherwise, the values are biased: give the controller to the loop, or sample faster.",
    )


_TOO_NARROW = (
    "The sensor noise is taken for white here, so that the standard errors are too small, and the "
    "values may be biased: diagnose() "
)
# Of several outputs a diagnosis takes the noise for white as well.
_TELLS = "tells what the model lacks."
_TELLS_COLOUR = "fits coloured noise as well, and tells what else the model lacks."


def list_starts(loop: Loop) -> dict[str, float]:
    """Return the values from which a fit begins; those of effects are no more than guesses."""
    guessed = list_effect_bounds(loop)
    return {name: v for name, v in loop.parameters.items() if name not in guessed}


def choose_free_names(
    loop: Loop, free: Sequence[str] | Mapping[str, float] | None, who: str
) -> tuple[str, ...]:
    """Return the parameters to fit, checked to be those of a loop.

    Parameters
    ----------
    loop : Loop
        The loop.
    free : sequence of str, mapping of str to float, or None
        What the user gave; None for the free parameters of the loop and those of its effects.
    who : str
        The function that asks.

    Raises
    ------
    CtrlidError
        If there is no loop, no name, or one that the loop does not have.
    """
    if not isinstance(loop, Loop):
        raise CtrlidError(f"{who} needs a Loop(plant, ..., dt=...); given "
                          f"{type(loop).__name__}{point_at_part(loop, Loop)}")  # fmt: skip
    known = list(loop.equations(keep=True).parameters)
    if free is None:
        # What becomes of the noisy reading moves no prediction, so that no record can tell of it.
        shown = [label for label, e in loop.labelled.items() if isinstance(e, ReadingEffect)]
        of_effects = [n for n in list_effect_bounds(loop) if n.split(".")[0] not in shown]
        names = tuple(dict.fromkeys([*loop.free, *of_effects]))
    else:
        names = (free,) if isinstance(free, str) else tuple(free)
    unknown = [name for name in names if name not in known]
    if unknown or not names:
        what = f"given {unknown}" if unknown else "none was given"
        raise CtrlidError(f"{who} needs the names of the parameters to fit, {what}. Name them "
                          f"in free= of the loop or of {who}; the loop has "
                          f"{', '.join(known) or 'none'}")  # fmt: skip
    return names


def summarize_fit(loop: Loop, fit: Fit) -> LoopFit:
    """Return a maximum of the likelihood as a loop and an estimate."""
    names, p = fit.plant.names, len(fit.theta)
    matrix, _ = compute_information(fit)
    on_bound = (fit.theta <= fit.problem.lower) | (fit.theta >= fit.problem.upper)
    inside = np.concatenate([~on_bound, np.ones(len(matrix) - p, dtype=bool)])
    covariance = np.zeros((p, p))
    rows = np.flatnonzero(inside & (np.diag(matrix) > 0))
    inverse = pseudo_inverse(matrix[np.ix_(rows, rows)])
    kept = rows[rows < p]
    covariance[np.ix_(kept, kept)] = inverse[: len(kept), : len(kept)]
    # What has no influence at all has none beside another force either.
    seen = np.diag(covariance) > 0
    covariance += np.where(np.outer(seen, seen), measure_doubt_by_force(fit), 0.0)
    covariance, notes = mark_unseen(covariance, matrix, inside, names)
    noise, scale = fit.noise, float(np.mean(fit.sensor))
    e = loop.equations()
    several = has_several_noises(e)
    forces = np.sqrt(scale * np.array(noise.force))
    sensors = np.sqrt(np.outer(fit.sensor, noise.ratios))
    time = -loop.dt / math.log(noise.memory) if noise.drift else math.nan
    estimate = LoopEstimate(
        names, fit.theta, covariance,
        tuple(np.sqrt(fit.sensor).tolist()) if e.siso else tuple(map(tuple, sensors)),
        tuple(forces.tolist()) if several else float(forces[0]),
        math.sqrt(scale * noise.coloured) if noise.drift else 0.0, time, fit.value, fit.size,
        tuple(n for n, b in zip(names, on_bound, strict=True) if b), notes,
        find_noise_units(loop, fit.problem.data[0].record),
        name_noise_places(loop) if several else ((), ()),
    )  # fmt: skip
    sharp = sharpen_effects(loop, fit.plant.loop.sharpness)
    fitted = sharp.with_parameters(dict(zip(names, fit.theta.tolist(), strict=True)))
    return LoopFit(fitted, estimate)
