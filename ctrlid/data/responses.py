"""Records as python-control's time responses, and back."""

from typing import Any

import control as ct
import numpy as np

from .._base.errors import CtrlidError
from .._base.text import drop_roundoff, split_unit, with_unit

# A law that leaves less than this share of the mean square of the states is exact.
EXACT = 1e-20


def read_response(response: Any, chosen: dict[str, str | None]) -> dict[str, Any]:
    """Return the fields of a record from a response; `chosen` maps r, u, y to labels or None."""
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

    def find_label(key: str) -> str | None:
        given = chosen[key]
        if given is not None:
            return given if given in table else plain.get(given)
        if key in plain or key == "r":
            return plain.get(key)
        # A signal that is the reference or the other one is no candidate.
        taken = {chosen[k] or k for k in ("r", "u", "y") if k != key}
        others = [c for c in (inputs if key == "u" else outputs)
                  if c not in taken and split_unit(c)[0] not in taken]  # fmt: skip
        return others[0] if len(others) == 1 else None

    labels = {key: find_label(key) for key in ("r", "u", "y")}
    for key, wanted in labels.items():
        if wanted is None and (key != "r" or chosen[key] is not None):
            raise CtrlidError(
                f"it is not clear which signal of the response is {key} (given {key}="
                f"{chosen[key]!r}); name one of the inputs {list(inputs)} or of the outputs "
                f"{list(outputs)} with {key}="
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
    found = {key: split_unit(label) for key, label in labels.items() if label is not None}
    return {
        **{key: table[label] for key, label in labels.items() if label is not None},
        "dt": dt, "start": float(stamps[0]),
        **(dict.fromkeys(("hold", "hold_r"), "foh") if _runs_straight(response) else {}),
        "names": {key: name for key, (name, _) in found.items() if name != key},
        "units": {key: unit for key, (_, unit) in found.items() if unit},
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
    names = [record.names.get(key, key) for key in keys]
    labels = [
        with_unit(name if names.count(name) == 1 else key, record.units.get(key, ""))
        for key, name in zip(keys, names, strict=True)
    ]
    return ct.TimeResponseData(
        record.t, np.array(record.y)[None, :],
        inputs=np.array([getattr(record, key) for key in keys[1:]]), output_labels=labels[:1],
        input_labels=labels[1:], sysname=record.name or None,
    )  # fmt: skip


def _list_channels(kind: str, labels: Any, values: Any, n: int) -> dict[str, Any]:
    if values is None:
        return {}
    rows = np.reshape(values, (-1, n))
    names = labels or ([kind] if len(rows) == 1 else [f"{kind}[{k}]" for k in range(len(rows))])
    return dict(zip(names, rows, strict=True))
