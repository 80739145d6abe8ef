"""fit_each(): one model per record, and how its poles move from set-point to set-point."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from scipy.stats import chi2

from .._base import text as _text
from .._base.arguments import check_arguments, explain_names, is_iterable
from .._base.arrays import Array, freeze_arrays, read_only
from .._base.errors import CtrlidError
from .._base.jobs import check_jobs, share_out
from ..data.record import Record
from .identified_model import IdentifiedModel


@dataclass(frozen=True, eq=False)
class PoleTrend:
    """A straight line through the rightmost poles of several fits.

    Attributes
    ----------
    level : float
        Mean output of the records [output unit], weighted as the line is.
    pole, pole_error : float
        The line there and its standard error [rad/s].
    slope, slope_error : float
        Change of the pole with the output and its standard error [rad/s per output unit].
    exponent, exponent_error : float
        ``slope level / pole`` [1]: the pole goes as the output to this power, minus one half for a
        ball in a field that falls with the square of the gap. NaN where output or pole change sign.
    p_value : float
        Chance that the standard errors explain the distances from the line; NaN for two records.
    """

    level: float
    pole: float
    pole_error: float
    slope: float
    slope_error: float
    exponent: float
    exponent_error: float
    p_value: float


@dataclass(frozen=True, eq=False, repr=False)
class FitSeries(_text.Printed):
    """Models of several records, as `fit_each` returns them.

    Attributes
    ----------
    models : tuple of IdentifiedModel
        One for each record, in the order given.
    names : tuple of str
        The records' names, or their numbers.
    levels : (n,) array
        Mean output of each record where it counts [output unit].
    unit : str
        Unit of the output, "" if it is not known.
    """

    models: tuple[IdentifiedModel, ...]
    names: tuple[str, ...]
    levels: Array
    unit: str

    def __post_init__(self) -> None:
        freeze_arrays(self)

    @property
    @read_only
    def rates(self) -> Array:
        """Real part of the rightmost pole of each model [rad/s]: that of an unstable plant."""
        return np.array([self._list_poles(k)[0].real for k in range(len(self.models))])

    @property
    @read_only
    def rate_errors(self) -> Array:
        """Standard errors of `rates` [rad/s]."""
        return np.array([self._list_errors(k)[0] for k in range(len(self.models))])

    def _sort_poles(self, k: int) -> Any:
        s = self.models[k].estimate.poles_s
        return np.argsort(-np.where(np.isfinite(s.real), s.real, -np.inf), kind="stable")

    def _list_poles(self, k: int) -> Any:
        return self.models[k].estimate.poles_s[self._sort_poles(k)]

    def _list_errors(self, k: int) -> Array:
        errors: Array = self.models[k].estimate.poles_s_standard_errors[self._sort_poles(k)]
        return errors

    @property
    def trend(self) -> PoleTrend:
        r"""Return the line ``p = pole + slope (y - level)`` through the rightmost poles.

        .. math:: \min \sum_k \frac{(p_k - \bar p - s (y_k - \bar y))^2}{\sigma_k^2}

        Weights are the standard errors of the fits; if these do not explain the distances from the
        line, those of the line are scaled up to the scatter.
        """
        y, p, sigma = self.levels, self.rates, self.rate_errors
        if len(np.unique(y)) < 2:
            raise CtrlidError(
                "a trend needs records at two or more different outputs; given "
                f"{_text.write_count(len(y), 'record')} at "
                f"{', '.join(_text.write_number(v, 4) for v in y)}"
            )
        if not (np.isfinite(sigma).all() and np.isfinite(p).all()):
            raise CtrlidError("a trend needs poles with finite standard errors, and two poles of a "
                              "model coincide. Leave this record out, or fit it with other "
                              "constraints")  # fmt: skip
        exact = not (sigma > 0).all()
        weight = np.ones(len(y)) if exact else sigma**-2
        level = float(weight @ y / weight.sum())
        pole = float(weight @ p / weight.sum())
        width = float(weight @ (y - level) ** 2)
        slope = float(weight @ ((y - level) * (p - pole)) / width)
        square = float(weight @ (p - pole - slope * (y - level)) ** 2)
        degrees = len(y) - 2
        # Poles without errors of their own scatter about a line of three or more, and tell no
        # error of one through two.
        scale = square / degrees if degrees else float("nan") if exact else 1.0
        scale = scale if exact else max(scale, 1.0)
        chance = float(chi2.sf(square, degrees)) if degrees and not exact else float("nan")
        slope_error = float(np.sqrt(scale / width))
        one_sign = bool((y * y[0] > 0).all() and (p * p[0] > 0).all())
        exponent = level / pole if one_sign else float("nan")
        return PoleTrend(
            level, pole, float(np.sqrt(scale / weight.sum())), slope, slope_error,
            slope * exponent, slope_error * abs(exponent), chance,
        )  # fmt: skip

    def __str__(self) -> str:
        unit = f" [{self.unit}]" if self.unit else ""
        width = max(len(name) for name in (*self.names, "record"))
        rows = [f"{'record':<{width}}  {'output' + unit:>12}  poles [rad/s]"]
        for k, (name, level) in enumerate(zip(self.names, self.levels, strict=True)):
            poles = ", ".join(
                _text.with_error(s, e)
                for s, e in zip(self._list_poles(k), self._list_errors(k), strict=True)
            )
            on = f"   ON A BOUND: {', '.join(a)}" if (a := self.models[k].estimate.active) else ""
            rows.append(f"{name:<{width}}  {level:>12.6g}  {poles}{on}")
        if len(np.unique(self.levels)) > 1 and np.isfinite(self.rate_errors).all():
            rows.append(_write_trend(self.trend, self.unit))
        return "\n".join(rows)


def _write_trend(line: PoleTrend, unit: str) -> str:
    text = (
        f"trend of the rightmost pole: {_text.with_error(line.pole, line.pole_error)} rad/s at "
        "an output of "
        f"{line.level:.4g} {unit}".rstrip()
        + f", slope {_text.with_error(line.slope, line.slope_error)} rad/s per {unit or 'unit'}"
    )
    if np.isfinite(line.exponent):
        power = _text.with_error(line.exponent, line.exponent_error)
        text += f", proportional to the output to the power {power}"
    if np.isfinite(line.p_value):
        large = line.p_value < 0.01
        verb = "IS LARGER THAN THE STANDARD ERRORS" if large else "agrees with the standard errors"
        text += f". The scatter about the line {verb} ({_text.write_p_value(line.p_value)})"
    return text + "."


@explain_names
def fit_each(
    fit: Callable[..., IdentifiedModel],
    records: Iterable[Record],
    *,
    jobs: int | None = None,
    **options: Any,
) -> FitSeries:
    """Fit every record on its own: one model per set-point, with the trend of its poles.

    The other way, one model of all records, is ``fit(records, ...)`` itself: the poles are then
    taken as the same at all set-points.

    Parameters
    ----------
    fit : callable
        `fit_iv`, `fit_continuous`, `fit_arx`, or a function of yours from a record and the options
        to an `IdentifiedModel`.
    records : iterable of Record
        One experiment each.
    jobs : int, optional
        Fits at the same time, through joblib (-1: one for each processor); by default one, or what
        ``joblib.parallel_config`` says, which may name a dask cluster.
    **options
        What `fit` takes besides the record.

    Returns
    -------
    FitSeries
        The models and their poles; print it, or draw it with `plot.trend`.

    Raises
    ------
    CtrlidError
        If there is no record, or a fit is refused; the words say which record it was.

    Examples
    --------
    A levitated ball at three gaps. Physics says ``p = sqrt(2 g/x0)``: power minus one half.

    >>> import ctrlid as cid
    >>> plant, records = cid.plants.maglev(m=0.0213, K=3.34e-6), []
    >>> for gap in (0.008, 0.012, 0.018):
    ...     at = cid.operating_point(plant, output=gap)
    ...     C = cid.design_lead(cid.linearize(plant, at), crossover=100, phase_margin=50)
    ...     loop = cid.Loop(plant, C.sample(0.002, "tustin"), dt=0.002, at=at)
    ...     r = cid.random_binary(4000, amplitude=5e-5, hold=10, around=gap, seed=1)
    ...     records.append(cid.simulate(loop, r, sensor_noise=1e-6, seed=2))
    >>> series = cid.fit_each(cid.fit_iv, records, na=2, nb=2, constraints=[cid.ReciprocalPoles()])
    >>> series.rates.round().tolist()
    [50.0, 40.0, 33.0]
    >>> abs(series.trend.exponent + 0.5) < 0.05
    True
    """
    check_arguments(fit_each, locals(), "fit", "jobs", "records")
    if not callable(fit):
        raise CtrlidError(f"fit_each needs a function such as fit_iv; given {type(fit).__name__}")
    records = (records,) if isinstance(records, Record) else records
    if not is_iterable(records):
        raise CtrlidError(f"fit_each needs Records; given {type(records).__name__}")
    done = list(share_out(partial(_fit_one, fit, options), enumerate(records, 1), check_jobs(jobs)))
    if not done:
        raise CtrlidError("fit_each needs at least one record; the list given is empty")
    models, names, levels, units = zip(*done, strict=True)
    return FitSeries(models, names, np.array(levels), units[0])


def _fit_one(
    fit: Callable[..., IdentifiedModel], options: dict[str, Any], item: tuple[int, Record]
) -> tuple[IdentifiedModel, str, float, str]:
    number, record = item
    if not isinstance(record, Record):
        raise CtrlidError(f"fit_each needs Records; number {number} is a {type(record).__name__}")
    try:
        inspect.signature(fit).bind(None, **options)
    except (TypeError, ValueError) as reason:
        raise CtrlidError(f"fit_each calls fit(record, ...) with the options {list(options)}, and "
                          f"this one does not take them: {reason}") from reason  # fmt: skip
    name = record.name or f"record {number}"
    try:
        model = fit(record, **options)
    except CtrlidError as reason:  # Any refusal stays one, with the name of its record.
        raise CtrlidError(f"{name} (number {number}): {reason}") from reason
    if not isinstance(model, IdentifiedModel):
        raise CtrlidError(f"fit_each needs a function that returns an IdentifiedModel, as fit_iv "
                          f"does; given one that returned {type(model).__name__}")  # fmt: skip
    return model, name, float(np.mean(record.y[record.valid])), record.units.get("y", "")
