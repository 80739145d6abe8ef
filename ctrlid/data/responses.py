"""Records as python-control's time responses, and back."""

from typing import Any

import control as ct
import numpy as np

from .._base.errors import CtrlidError
from .._base.text import drop_roundoff, split_unit, with_unit

# A law that leaves less than this share of the mean square of the states is exact.
EXACT = 1e-20


def read_response(response: Any, chosen: dict[str, Any]) -> dict[str, Any]:
    """Return the fields of a record from a response; `chosen` maps r, u, y to labels or None."""
    given = {k: (v,) if isinstance(v, str) else v for k, v in chosen.items()}
    if not isinstance(response, ct.TimeResponseData):
        raise CtrlidError(
            "from_response takes a control.TimeResponseData, as forced_response and "
            f"input_output_response return; given {type(response).__name__}"
        )
    if response.ntraces > 1:
        raise CtrlidError(f"a record is one experiment; the response has {response.ntraces} "
                          "traces. Compute it for one input at a time")  # fmt: skip
    n = len(response.time)
    inputs = _list_channels("u", response.input_labels, response.u, n)
    outputs = _list_channels("y", response.output_labels, response.y, n)
    for label in inputs.keys() & outputs.keys():
        if not np.array_equal(inputs[label], outputs[label]):
            raise CtrlidError(f"the response has an input and an output called {label!r} that "
                              "differ; rename one of them in the system")  # fmt: skip
    table = {**inputs, **outputs}
    plain = {split_unit(label)[0]: label for label in table}

    def find_labels(key: str) -> list[str]:
        if given[key] is not None:
            known = [label if label in table else plain.get(label) for label in given[key]]
            return [] if None in known else [str(label) for label in known]
        if key in plain or key == "r":
            return [plain[key]] if key in plain else []
        # A signal that is the reference or the other one is no candidate.
        taken = {name for k in ("r", "u", "y") if k != key for name in given[k] or (k,)}
        return [c for c in (inputs if key == "u" else outputs)
                if c not in taken and split_unit(c)[0] not in taken]  # fmt: skip

    labels = {key: find_labels(key) for key in ("r", "u", "y")}
    for key, wanted in labels.items():
        if not wanted and (key != "r" or chosen[key] is not None):
            raise CtrlidError(
                f"it is not clear which signal of the response is {key} (given {key}="
                f"{chosen[key]!r}); name one of the inputs {list(inputs)} or of the outputs "
                f"{list(outputs)} with {key}=, or several as a list"
            )
    stamps = np.asarray(response.time, dtype=float)
    if len(stamps) < 2:
        raise CtrlidError(f"a record needs at least 2 samples; the response has {len(stamps)}")
    steps = np.diff(stamps)
    mean = float(stamps[-1] - stamps[0]) / len(steps)
    dt = drop_roundoff(mean, 4 * float(np.spacing(np.abs(stamps).max())))
    if np.any(np.abs(steps - dt) > 1e-6 * dt):
        raise CtrlidError(
            f"a record is sampled uniformly, but the times of the response are {steps.min():.4g} "
            f"to {steps.max():.4g} s apart. Compute it at np.arange(n) * dt"
        )
    found = {key: [split_unit(label) for label in each] for key, each in labels.items() if each}
    names = {key: tuple(name for name, _ in each) for key, each in found.items()}
    units = {key: tuple(unit for _, unit in each) for key, each in found.items()}
    return {
        **{key: np.array([table[label] for label in each]) for key, each in labels.items() if each},
        "dt": dt, "start": float(stamps[0]),
        **(dict.fromkeys(("hold", "hold_r"), "foh") if _runs_straight(response) else {}),
        "names": {key: each for key, each in names.items() if each != (key,)},
        "units": {key: each for key, each in units.items() if any(each)},
    }  # fmt: skip


def _runs_straight(response: Any) -> bool:
    """Return whether the states depend on the inputs of the sample they belong to.

    In continuous time python-control interpolates its inputs, so that the next input takes part in
    the step to it. A linear law with the next inputs then leaves less than half of what one
    without them leaves; in discrete time it takes nothing off.
    """
    if response.x is None or response.u is None:
        return False
    n = len(response.time)
    x, u = (np.reshape(v, (-1, n)).T for v in (response.x, response.u))
    known = np.column_stack([np.ones(n - 1), x[:-1], u[:-1]])
    if not x.size or n < 3 * (known.shape[1] + u.shape[1]):
        return False
    size = np.ptp(x, axis=0)
    goal = x[1:, size > 0] / size[size > 0]
    left = [
        float(np.sum((goal - table @ np.linalg.lstsq(table, goal, rcond=1e-12)[0]) ** 2))
        for table in (known, np.column_stack([known, u[1:]]))
    ]
    return left[0] > EXACT * goal.size and left[1] < left[0] / 2


def write_response(record: Any) -> Any:
    """Return a record as a response with output y and inputs u and, if any, r."""
    keys = [key for key in ("y", "u", "r") if getattr(record, key) is not None]
    signals = record.signals
    names = [name for key in keys for name in signals[key]]
    labels, rows = [], []
    for key in keys:
        given = record.units.get(key, "")
        several = len(signals[key]) > 1
        units = (given,) * len(signals[key]) if isinstance(given, str) else given
        for name, unit in zip(signals[key], units, strict=True):
            own = f"{key} {name}" if several else key
            labels.append(with_unit(name if names.count(name) == 1 else own, unit))
        rows += list(np.reshape(getattr(record, key), (len(signals[key]), -1)))
    p = len(signals["y"])
    return ct.TimeResponseData(
        record.t, np.array(rows[:p]), inputs=np.array(rows[p:]), output_labels=labels[:p],
        input_labels=labels[p:], sysname=record.name or None,
    )  # fmt: skip


def _list_channels(kind: str, labels: Any, values: Any, n: int) -> dict[str, Any]:
    if values is None:
        return {}
    rows = np.reshape(values, (-1, n))
    names = labels or ([kind] if len(rows) == 1 else [f"{kind}[{k}]" for k in range(len(rows))])
    return dict(zip(names, rows, strict=True))
