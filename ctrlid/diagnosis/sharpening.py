"""Step 5: dry friction as abrupt as the record has it."""

from ..estimation.likelihood.abrupt_friction import sharpen_friction
from ..estimation.likelihood.likelihood import Fit
from ..estimation.likelihood.noise.orders import try_coloured_sensor
from ..loop.loop import sharpen_effects
from .fitted_model import Model, with_linearization
from .noise_tests import measure_colour_promise, run_noise_tests
from .refitting import climb


def sharpen_model(model: Model) -> Model:
    """Return a model whose friction stops a mass as fast as makes its record more probable.

    What a filter with blunt friction loses of a record goes to a random force or to a second
    friction that only mends the first.

    Parameters
    ----------
    model : Model
        A fitted model.

    Returns
    -------
    Model
        A sharper one where `abrupt_friction.sharpen_friction` finds one that passes the tests where
        the model does; else the model as it is.
    """
    best = sharpen_friction(model.fit, climb, _free_noise)
    if best is model.fit:
        return model
    loop = sharpen_effects(model.loop, best.plant.loop.sharpness)
    sharper = with_linearization(Model(loop, best))
    # Beside a large random force, a filter errs more with abrupt friction than with blunt.
    worse = run_noise_tests(model.fit).passed and not run_noise_tests(sharper.fit).passed
    return model if worse else sharper


def _free_noise(held: Fit) -> list[Fit]:
    """Return fits from the best parameters under hardly any force: of its size, and of a colour."""
    free = climb(held)
    if not (held.plant.e.siso and held.noise.sensor_is_white):
        return [free]
    if not held.value + measure_colour_promise(held) > free.value:
        return [free]
    return [free, climb(try_coloured_sensor(held))]
