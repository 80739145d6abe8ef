"""Step 5: dry friction as abrupt as the record has it."""

import contextlib
import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from .._base.errors import ModelCannotRun
from ..estimation.likelihood.likelihood import Fit
from ..estimation.likelihood.maximization import hold_force_quiet, maximize
from ..estimation.likelihood.noise.orders import try_coloured_sensor
from ..loop.loop import sharpen_effects
from .fitted_model import Model, carry_over_fit, compute_criterion, with_linearization
from .noise_tests import measure_colour_promise, run_noise_tests
from .refitting import climb
from .thresholds import THRESHOLD


def sharpen_friction(model: Model) -> Model:
    """Return a model whose friction stops a mass as fast as makes its record more probable.

    A filter begins with friction that takes a quarter of a sampling period, with which it finds
    the parameters from afar. It then loses much of a record in which a mass sticks, to a random
    force or to a second friction that only mends the first. From there the friction becomes twice
    as abrupt again and again, and each model begins where the one before it ended, so that the
    maximum moves little at a time: first with hardly any random force, then with all noise free.

    Parameters
    ----------
    model : Model
        A fitted model.

    Returns
    -------
    Model
        A sharper one if that is more probable by more than the gate, leaves less to random forces
        and passes the tests where the model does; else the model as it is.
    """
    fit = model.fit
    if not fit.plant.e.kinked or fit.known is not None or not math.isfinite(fit.value):
        return model
    quiet = Model(model.fitted, maximize(hold_force_quiet(fit), exact=False))
    held = _double_while_likelier(quiet, lambda start: maximize(start, exact=False))
    begun = [model]
    if held is not quiet:
        freed = replace(held.fit, problem=replace(held.fit.problem, known=None))
        begun += [Model(held.loop, one) for one in _fit_free_noise(freed)]
    best = _double_while_likelier(max(begun, key=compute_criterion), climb)
    if not compute_criterion(best) > compute_criterion(model) + THRESHOLD.gate:
        return model
    # What friction mends was left to a random force. One that grows mends something else.
    if not _measure_force(best.fit) < _measure_force(fit):
        return model
    sharper = with_linearization(Model(sharpen_effects(model.loop, best.loop.sharpness), best.fit))
    # Beside a large random force, a filter errs more with abrupt friction than with blunt.
    worse = run_noise_tests(fit).passed and not run_noise_tests(sharper.fit).passed
    return model if worse else sharper


def _measure_force(fit: Fit) -> float:
    """Return the variance of all random forces, white and coloured [input of the force^2]."""
    return float(np.mean(fit.sensor)) * (sum(fit.noise.force) + fit.noise.coloured)


def _double_while_likelier(model: Model, improve: Callable[[Fit], Fit]) -> Model:
    """Return a model with friction twice as abrupt as often as that gains more than the gate."""
    while 2 * model.loop.sharpness <= THRESHOLD.sharpest:
        with contextlib.suppress(ModelCannotRun):
            loop = sharpen_effects(model.fitted, 2 * model.loop.sharpness)
            sharper = Model(loop, improve(carry_over_fit(model, loop, model.names)))
            if compute_criterion(sharper) > compute_criterion(model) + THRESHOLD.gate:
                model = sharper
                continue
        break
    return model


def _fit_free_noise(held: Fit) -> list[Fit]:
    """Return fits from the best parameters under hardly any force: of its size, and of a colour."""
    free = climb(held)
    if not (held.plant.e.siso and held.noise.sensor_is_white):
        return [free]
    if not held.value + measure_colour_promise(held) > free.value:
        return [free]
    return [free, climb(try_coloured_sensor(held))]
