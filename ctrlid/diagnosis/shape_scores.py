"""What errors of a given shape would gain: forces, errors of the reading, parameters that vary."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
from scipy import stats

from .._base.arrays import Array
from .._base.statistics import pseudo_inverse
from ..estimation.likelihood.filter_data import name_noise_places
from ..estimation.likelihood.kalman_filter import run_filter
from ..estimation.likelihood.likelihood import Fit, relinearize_fit
from ..estimation.likelihood.sampled_plant import Linearized, SampledPlant
from .constancy import find_bin_edges, find_bins
from .places import find_force_channel
from .thresholds import THRESHOLD

# How the columns of a shape enter the filter: the derivatives of a record's states and outputs.
Columns = tuple[Array, Array]
# For each record the quantities in whose bins errors are looked at, by name, at all its samples.
Axes = Sequence[Mapping[str, Array]]


def score_shapes(
    fit: Fit, shapes: Sequence[Array], parameter: str | None = None, width: int = 1,
    place: Literal["force", "output"] = "force", at: str = "",
) -> tuple[Array, Array]:  # fmt: skip
    r"""Return what forces of given shapes would gain, with the model's parameters moving along.

    .. math:: \tfrac12 g^T H^{-1} g, \quad g = \sum_k \psi_k e_k / s_k, \quad
        H = \sum_k \psi_k \psi_k^T / s_k

    where psi is what the shape does to the predictions, projected on what the model's own
    parameters cannot do.

    Parameters
    ----------
    fit : Fit
        The fit of a model, with the plant along its trajectory.
    shapes : sequence of ndarray, shape (n, shapes)
        For each record, the shapes over its samples.
    parameter : str, optional
        What is modulated: by default a force, else the named parameter of the model.
    width : int, optional
        Neighbouring shapes that belong together, such as a sine and a cosine.
    place : {"force", "output"}, optional
        Whether the shapes are forces, or are added to the reading.
    at : str, optional
        The velocity or the output, of several.

    Returns
    -------
    gains : ndarray, shape (shapes / width,)
        Gains of log-likelihood.
    sizes : ndarray, shape (shapes / width, width)
        The sizes that the first step gives them.
    """
    plant, count = fit.plant, shapes[0].shape[1]
    samples = max(len(s) for s in shapes)
    step = max(width, THRESHOLD.scan_block // (samples * (plant.size + 1)) // width * width)
    gains, sizes = [], []
    for first in range(0, count, step):
        part = [shape[:, first : first + step] for shape in shapes]
        columns = [
            _place_columns(plant, lin, shape, parameter, place, at)
            for lin, shape in zip(fit.linearized, part, strict=True)
        ]
        score, left, _ = score_columns(fit, columns)
        for k in range(0, len(score), width):
            rows = slice(k, k + width)
            amount = pseudo_inverse(left[rows, rows]) @ score[rows]
            gains.append(0.5 * float(score[rows] @ amount))
            sizes.append(amount)
    return np.array(gains), np.array(sizes)


def score_columns(fit: Fit, columns: Sequence[Columns]) -> tuple[Array, Array, Array]:
    """Return the score of shapes and its covariance, both without what the parameters take up.

    Parameters
    ----------
    fit : Fit
        The fit of a model, with the plant along its trajectory.
    columns : sequence of (ndarray, ndarray)
        For each record what the shapes do to the states of the next sample, (n, states, shapes),
        and to the outputs, (n, shapes) or (n, outputs, shapes).

    Returns
    -------
    score : ndarray, shape (shapes,)
        Derivative of the log-likelihood by the sizes of the shapes.
    left : ndarray, shape (shapes, shapes)
        Information on the sizes.
    alone : ndarray, shape (shapes,)
        Information on each size if nothing else were unknown.
    """
    p, size = len(fit.theta), columns[0][0].shape[-1]
    matrix, score = np.zeros((p + size, p + size)), np.zeros(p + size)
    for data, lin, keep, (e, s), (states, outputs) in zip(
        fit.data, fit.linearized, fit.counts, fit.working, columns, strict=True
    ):
        # The shapes stand behind the parameters of the model.
        wide = replace(
            lin,
            dp=np.concatenate([lin.dp[..., :p], states], axis=-1),
            hp=np.concatenate([lin.hp[..., :p], outputs], axis=-1),
        )
        slopes = run_filter(fit.plant, data, wide, fit.noise, columns=p + size).slopes[keep]
        weighted = slopes / s[keep, None]
        matrix += weighted.T @ slopes
        score += weighted.T @ e[keep]
    believed, information = fit.problem.beliefs
    matrix[range(p), range(p)] += information
    score[:p] -= information * (fit.theta - believed)
    own = pseudo_inverse(matrix[:p, :p]) if p else np.zeros((0, 0))
    through = matrix[p:, :p] @ own
    left = matrix[p:, p:] - through @ matrix[:p, p:]
    return score[p:] - through @ score[:p], left, np.diag(matrix)[p:]


def _place_columns(
    plant: SampledPlant, lin: Linearized, shape: Array, parameter: str | None, place: str, at: str
) -> Columns:
    """Return what shapes do as a force, as an error of the reading, or by a parameter."""
    if place == "output":
        return _add_to_reading(lin, shape, plant.e.outputs.index(at) if at else 0)
    if parameter is not None:
        return _push(lin, lin.dp[:, :, plant.names.index(parameter)], shape)
    if at:
        return _push(lin, lin.b[:, :, find_force_channel(plant.e, at)], shape)
    return _push(lin, lin.b.sum(axis=2), shape)


def _push(lin: Linearized, by: Array, shape: Array) -> Columns:
    """Return what shapes do that move the states by so much in each period, (n, states)."""
    return by[:, :, None] * shape[:, None], np.zeros((*lin.output.shape, shape.shape[1]))


def _add_to_reading(lin: Linearized, shape: Array, output: int) -> Columns:
    """Return what shapes do that are added to the reading of an output."""
    read = np.zeros((*lin.output.shape, shape.shape[1]))
    read[(slice(None), output) if lin.output.ndim == 2 else ...] = shape
    return np.zeros((*lin.dp.shape[:2], shape.shape[1])), read


def run_shape_tests(fit: Fit, axes: Axes, late: Collection[str]) -> dict[str, float]:
    r"""Test that no force, no slope of the input and no error of the reading depends on anything.

    With the score g and the information H of `score_shapes`, of a force that is one in one bin of a
    quantity and zero in all others, for each bin,

    .. math:: g^T H^{-1} g \sim \chi^2

    where there is no force that depends on this quantity in any way. It is the same for a force in
    proportion to the input, and for an error of the reading. What a force leaves in the innovations
    is spread over as many samples as the filter needs to follow it, so that their means in the bins
    themselves say little of a force.

    Parameters
    ----------
    fit : Fit
        The fitted model.
    axes : sequence of mapping of str to ndarray
        For each record, the values of each quantity at all its samples.
    late : collection of str
        Quantities that are given as they were a sample before, such as the input that acted until
        a reading. A force over a period depends on what they are at its beginning.

    Returns
    -------
    dict of str to float
        Probabilities by the name of the test.

    References
    ----------
    Rao, Proceedings of the Cambridge Philosophical Society 44 (1948) 50-57 (the score test).
    """
    if not fit.linearized:
        fit = relinearize_fit(fit)
        if not math.isfinite(fit.value):
            return {}  # The filter lost the record on its way back along it.
    # What counts of any output.
    seen = [keep if keep.ndim == 1 else keep.any(axis=1) for keep in fit.counts]
    p_values = {}
    for name in axes[0]:
        values = [of[name] for of in axes]
        edges = find_bin_edges(
            np.concatenate([v[use] for v, use in zip(values, seen, strict=True)])
        )
        bins = [np.eye(len(edges) - 1)[find_bins(v, edges)] for v in values]
        count = sum(b[use].sum(axis=0) for b, use in zip(bins, seen, strict=True))
        bins = [b[:, count >= THRESHOLD.fewest_in_bin] for b in bins]
        width = bins[0].shape[1]
        if width < 2:
            continue
        # The last period ends behind the last reading.
        acting = [np.append(b[1:], b[-1:], axis=0) for b in bins] if name in late else bins
        kinds = _list_kinds(fit, acting, bins)
        columns = [
            (
                np.concatenate([states for states, _ in parts], axis=-1),
                np.concatenate([outputs for _, outputs in parts], axis=-1),
            )
            for parts in zip(*kinds.values(), strict=True)
        ]
        score, left, alone = score_columns(fit, columns)
        for k, kind in enumerate(kinds):
            rows = slice(k * width, (k + 1) * width)
            p_values[f"{kind} by {name}"] = compute_score_probability(
                score[rows], left[rows, rows], alone[rows]
            )
    return p_values


def _list_kinds(
    fit: Fit, acting: Sequence[Array], bins: Sequence[Array]
) -> dict[str, list[Columns]]:
    """Return what the bins do in each record, by the kind of what depends on the quantity.

    Forces are as those say that act in the period from a sample on, readings as those until it.
    """
    outputs, forces = name_noise_places(fit.plant.loop)
    if fit.plant.channels == 1:
        forces = ("",)  # One force acts on all velocities of a plant with one output.
    inputs = fit.plant.e.inputs
    kinds: dict[str, list[Columns]] = {}
    for data, lin, chosen, before in zip(fit.data, fit.linearized, acting, bins, strict=True):
        u = np.reshape(data.u, (len(data.u), -1))
        away = u - np.mean(u[np.reshape(data.valid, (len(data.valid), -1)).any(axis=1)], axis=0)
        for j, name in enumerate(forces):
            by, place = lin.b[:, :, j], f" at {name}" if len(forces) > 1 else ""
            kinds.setdefault(f"force{place}", []).append(_push(lin, by, chosen))
            for i, entry in enumerate(inputs):
                of, sloped = f" of {entry}" if len(inputs) > 1 else "", chosen * away[:, [i]]
                kinds.setdefault(f"slope{of}{place}", []).append(_push(lin, by, sloped))
        for k, name in enumerate(outputs):
            of = f" of {name}" if len(outputs) > 1 else ""
            kinds.setdefault(f"reading{of}", []).append(_add_to_reading(lin, before, k))
    return kinds


def compute_score_probability(score: Array, information: Array, alone: Array) -> float:
    """Return the probability of so large a score if nothing is there: Rao's test.

    What the parameters of the model do as well counts for nothing.

    Parameters
    ----------
    score : ndarray, shape (shapes,)
        The score.
    information : ndarray, shape (shapes, shapes)
        Its covariance.
    alone : ndarray, shape (shapes,)
        The variances if no parameter were fitted.
    """
    if not (np.isfinite(score).all() and np.isfinite(information).all()):
        return 1.0
    size = np.sqrt(np.maximum(alone, THRESHOLD.tiny))
    values, vectors = np.linalg.eigh(information / np.outer(size, size))
    use = values > THRESHOLD.seen
    if not use.any():
        return 1.0
    along = vectors[:, use].T @ (score / size)
    return float(stats.chi2.sf(float(np.sum(along**2 / values[use])), int(use.sum())))
