"""How the likelihood depends on a force in every single period: the filter run backwards."""

from typing import Any

import numpy as np

from ..._base.arrays import Array
from ..._base.compilation import compile_loop
from ..._base.interruption import keep_interrupt
from ..._base.statistics import pseudo_inverse
from .kalman_filter import PassArguments, arrange_pass
from .kalman_recursion import filter_pass
from .likelihood import Fit


def compute_force_scores(
    fit: Fit, draws: int = 0, channel: int | None = None, seed: int = 0
) -> list[Array]:
    r"""Return the derivative of the log-likelihood by a force that is held over a single period.

    .. math:: \lambda_k = b_k^T p_{k+1}, \quad
        p_k = c_k^T w_k + (I - K_k c_k)^T A_k^T p_{k+1}, \quad w_k = e_k / s_k

    which is the recursion of the sensitivities of `kalman_recursion.filter_pass` in reverse. A
    force of any shape f then has the score :math:`\sum_k f_k \lambda_k`, at the price of a sum
    where a pass of the filter is needed otherwise. The model's own parameters move along.

    Parameters
    ----------
    fit : Fit
        A fit with the plant along its trajectory.
    draws : int, optional
        Of as many records of the same model the scores are computed as well: the variance of
        :math:`\sum_k f_k \lambda_k` over them is the information on the size of the force.
    channel : int, optional
        Which of several forces; by default one on all of them.
    seed : int, optional
        Seed of the draws.

    Returns
    -------
    list of ndarray, shape (n, 1 + draws)
        For each record, the score of each period; of the record itself in the first column.

    References
    ----------
    de Jong, Journal of the American Statistical Association 84 (1989) 1085-1088; Durbin and
    Koopman, *Time Series Analysis by State Space Methods* (2012), section 4.5.
    """
    weights = _weigh_innovations(fit, draws, seed)
    found = []
    for data, lin, part in zip(fit.data, fit.linearized, weights, strict=True):
        run = _list_updates(arrange_pass(data, lin, fit.noise, 0, np.sqrt(fit.noise.ratios)))
        valid, c = run.valid[:, 0], run.c[:, 0]
        gain = _find_gains(filter_pass(*run), run.restart, valid, run.memory, run.drift)
        b = run.b
        pushed = b.sum(axis=2) if channel is None else np.ascontiguousarray(b[:, :, channel])
        updates = len(b) // len(lin.step)
        if updates > 1:
            part = part * np.sqrt(fit.noise.ratios)[None, :, None]
        scores = _carry_back(run.a, b, pushed, c, gain, valid, run.restart, run.memory,
                             np.ascontiguousarray(part.reshape(len(b), -1)))  # fmt: skip
        found.append(scores[updates - 1 :: updates])
    return found


def _weigh_innovations(fit: Fit, draws: int, seed: int) -> list[Array]:
    """Return innovations over their variances, what the model's parameters explain taken out.

    Those of the records come first, then draws of white innovations, each along the last axis.
    """
    rng = np.random.default_rng(seed)
    p = len(fit.theta)
    information, score = np.zeros((p, p)), np.zeros((p, 1 + draws))
    parts = []
    for out, keep, (e, s) in zip(fit.filtered, fit.counts, fit.working, strict=True):
        weighted = np.zeros((*keep.shape, 1 + draws))
        weighted[keep, 0] = e[keep] / s[keep]
        count = int(np.count_nonzero(keep))
        weighted[keep, 1:] = rng.standard_normal((count, draws)) / np.sqrt(s[keep])[:, None]
        slopes = out.slopes[keep]
        information += (slopes / s[keep, None]).T @ slopes
        score += slopes.T @ weighted[keep]
        parts.append(weighted)
    moved = pseudo_inverse(information) @ score if p else score
    for out, keep, (_, s), weighted in zip(fit.filtered, fit.counts, fit.working, parts,
                                           strict=True):  # fmt: skip
        weighted[keep] -= out.slopes[keep] @ moved / s[keep, None]
    return parts


def _list_updates(run: PassArguments) -> PassArguments:
    r"""Return a pass over several outputs as one over updates, each with a sample of its own.

    Only the last update of a sample moves the state. Between them it stands still, and a coloured
    force forgets so little that it has its memory over a whole period, :math:`\rho^{1/q}` in each
    of q updates.
    """
    size, q = run.output.shape
    if q == 1:
        return run
    states, memory = run.step.shape[1], run.memory ** (1 / q)

    def spread_out(values: Array, still: Any) -> Array:
        """Return what stands still at all outputs of a sample but the last."""
        out = np.empty((size, q, *values.shape[1:]), values.dtype)
        out[:] = still
        out[:, -1] = values
        return out.reshape(size * q, *values.shape[1:])

    before = run.predicted[:, None]
    restart = np.zeros((size, q), dtype=bool)
    restart[:, 0] = run.restart
    drift = run.drift / (1 - run.memory**2) * (1 - memory**2)
    return run._replace(
        step=spread_out(run.step, before), a=spread_out(run.a, np.eye(states)),
        b=spread_out(run.b, 0.0), du=spread_out(run.du, 0.0), dp=spread_out(run.dp, 0.0),
        output=run.output.reshape(-1, 1), c=run.c.reshape(-1, 1, states),
        hp=run.hp.reshape(size * q, 1, -1), predicted=np.repeat(run.predicted, q, axis=0),
        filtered=spread_out(run.filtered, before), y=run.y.reshape(-1, 1),
        valid=run.valid.reshape(-1, 1), restart=restart.ravel(),
        input_variance=spread_out(run.input_variance, 0.0), sensor=run.sensor.reshape(-1, 1),
        memory=memory, drift=drift, outputs=np.empty(1),
    )  # fmt: skip


def _find_gains(out: Any, restart: Any, valid: Any, memory: float, drift: float) -> Array:
    """Return the gain of each update, by which it moved the states for its innovation."""
    error, _, before, after, _, _, disturbance = out
    error = error[:, 0]
    moved = after - before
    if drift > 0.0:
        last = np.concatenate([[0.0], disturbance[:-1]])
        expected = np.where(restart, 0.0, memory * last)
        moved = np.column_stack([moved, disturbance - expected])
    # An innovation that is exactly zero moves nothing, and tells nothing of the gain.
    known = valid & (error != 0.0)
    return np.asarray(np.where(known[:, None], moved, 0.0) / np.where(known, error, 1.0)[:, None])


@keep_interrupt
@compile_loop(nogil=True, error_model="numpy")
def _carry_back(
    a: Any, b: Any, pushed: Any, c: Any, gain: Any, valid: Any, restart: Any, memory: Any,
    weights: Any,
) -> Any:  # fmt: skip  # pragma: no cover - compiled
    """Return the scores of `compute_force_scores`, from the matrices of a pass and its gains.

    A filter has a state more than the plant where there is a coloured force.
    """
    size, n = c.shape
    w, columns = gain.shape[1], weights.shape[1]
    scores = np.zeros((size, columns))
    after, before = np.zeros((w, columns)), np.zeros((w, columns))
    for k in range(size - 1, -1, -1):
        for q in range(columns):
            total = 0.0
            for i in range(n):
                total += pushed[k, i] * after[i, q]
            scores[k, q] = total
        for j in range(n):
            for q in range(columns):
                total = 0.0
                for i in range(n):
                    total += a[k, i, j] * after[i, q]
                before[j, q] = total
        for j in range(n, w):
            for q in range(columns):
                total = memory * after[j, q]
                for i in range(n):
                    push = 0.0
                    for m in range(b.shape[2]):
                        push += b[k, i, m]
                    total += push * after[i, q]
                before[j, q] = total
        for q in range(columns):
            seen = weights[k, q]
            if valid[k]:
                for i in range(w):
                    seen -= gain[k, i] * before[i, q]
            for i in range(n):
                before[i, q] += c[k, i] * seen
        after, before = before, after
        if restart[k]:
            after[:] = 0.0
    return scores
