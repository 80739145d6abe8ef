"""What the pictures show, apart from the drawing: units, windows, poles and frequency grids."""

from collections.abc import Mapping, Sequence
from typing import Any

import control as ct
import numpy as np

from . import _text
from .comparison import Comparison
from .errors import CtrlidError
from .physics import Array, timebase

WINDOW = 250  # samples of a comparison that can be told apart on a page


def scale(signals: Sequence[Array], unit: str) -> tuple[float, str]:
    """Return a factor and the unit it leads to: millimetres rather than 0.03 m."""
    if not unit:
        return 1.0, "unit not given"
    return _text.prefix(max(float(np.abs(s).max()) for s in signals), unit)


def telling(comparison: Comparison) -> int:
    """Return the first sample of a lively window with a usual error."""
    whole = comparison.record
    n, width = len(whole), min(WINDOW, len(whole))
    if n == width or not comparison.curves:
        return 0
    curve = comparison.curves[-1].y
    known = whole.valid & np.isfinite(curve)
    starts = np.arange(0, n - width + 1, max(width // 5, 1))

    def means(values: Array) -> Array:
        total = np.concatenate([[0.0], np.cumsum(np.where(known, values, 0.0))])
        mean: Array = (total[starts + width] - total[starts]) / width
        return mean

    y = whole.y - np.mean(whole.y)
    full = means(np.ones(n))
    movement = means(y**2) - means(y) ** 2
    movement[full < 0.95 * full.max()] = -np.inf
    error = means((np.where(known, curve, whole.y) - whole.y) ** 2)
    lively = movement >= np.median(movement[np.isfinite(movement)])
    usual = np.abs(error - np.median(error[lively]))
    return int(starts[np.argmin(np.where(lively, usual, np.inf))])


def checked_models(models: Any, who: str) -> dict[str, Any]:
    """Return models by label, or refuse in the name of a picture."""
    if not isinstance(models, Mapping) or not models:
        raise CtrlidError(f"{who} takes a mapping from labels to models, {{'fitted': G}}, with at "
                          f"least one model; given {type(models).__name__}")  # fmt: skip
    for label, model in models.items():
        if not isinstance(model, ct.TransferFunction | ct.StateSpace):
            raise CtrlidError(f"{who}: {label!r} must be a TransferFunction or StateSpace; given "
                              f"{type(model).__name__}")  # fmt: skip
        if model.ninputs != 1 or model.noutputs != 1:
            raise CtrlidError(f"{who}: {label!r} must have one input and one output")
    return {str(k): m for k, m in models.items()}


def period(models: Mapping[str, Any]) -> float:
    """Return the one sampling period among the models, 0 if all are continuous."""
    periods = {k: timebase(m) for k, m in models.items() if timebase(m)}
    if len({round(p, 12) for p in periods.values()}) > 1:
        listed = ", ".join(f"{k}: {p:g} s" for k, p in periods.items())
        raise CtrlidError(f"poles at different sampling periods do not compare ({listed}); draw "
                          "each period on its own axes")  # fmt: skip
    return next(iter(periods.values()), 0.0)


def places(model: Any, dt: float) -> Any:
    """Return the poles in the z-plane of period dt (in the s-plane for 0), the outermost first."""
    # The fit knows its poles more accurately than the roots of its coefficients.
    estimate = getattr(model, "estimate", None)
    poles = np.asarray(model.poles() if estimate is None else estimate.poles, dtype=complex)
    poles = np.exp(poles * dt) if dt and not timebase(model) else poles
    poles = np.where(np.abs(poles.imag) < 1e-9 * np.maximum(np.abs(poles), 1.0), poles.real, poles)
    return poles[np.lexsort((-poles.imag, -poles.real))]


def frequencies(models: Mapping[str, Any]) -> Any:
    """Return a grid from well below the slowest to well above the fastest pole or zero."""
    corners, limits = [], []
    for model in models.values():
        dt = timebase(model)
        places = np.concatenate([np.atleast_1d(model.poles()), np.atleast_1d(model.zeros())])
        places = places[np.isfinite(places) & (np.abs(places) > 1e-12)].astype(complex)
        if dt:
            places = np.log(places) / dt
            limits.append(np.pi / dt)
        corners += [c for c in np.abs(places) if c > 1e-6 and (not dt or c < np.pi / dt)]
    corners = corners or [min(limits, default=1.0)]
    top = max(limits) if limits else 10 * max(corners)
    return np.geomspace(min(0.1 * min(corners), 0.01 * top), top, 600)
