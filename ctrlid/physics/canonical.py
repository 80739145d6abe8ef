"""Transfer functions as state equations whose coefficients are named parameters."""

from collections.abc import Mapping, Sequence
from typing import Any

import control as ct
import numpy as np


def list_coefficients(system: Any) -> dict[str, float]:
    """Return the coefficients of a transfer function with a monic denominator.

    ``a1 ... an`` follow the leading one in falling powers; ``b1, b2, ...`` are those of the
    numerator from its first non-zero one on.

    Parameters
    ----------
    system : control.TransferFunction
        With one input and one output.

    Returns
    -------
    dict of str to float
        The coefficients by name.

    Examples
    --------
    >>> list_coefficients(ct.tf([6.0], [2.0, 4.0, 0.0]))
    {'a1': 2.0, 'a2': 0.0, 'b1': 3.0}
    """
    num, den = (np.trim_zeros(np.asarray(c[0][0], float), "f") for c in (system.num, system.den))
    num = num if num.size else np.zeros(1)
    lead = den[0]
    return {
        **{f"a{k}": float(v) for k, v in enumerate(den[1:] / lead, 1)},
        **{f"b{k}": float(v) for k, v in enumerate(num / lead, 1)},
    }


def count_poles(names: Sequence[str]) -> int:
    """Return the number of poles behind the names of the coefficients."""
    return sum(name.startswith("a") for name in names)


def make_state_equations(
    values: Mapping[str, Any], x: Sequence[Any], u: Any, continuous: bool
) -> tuple[list[Any], Any]:
    r"""Return the rates (or next values) of the states, and the output.

    .. math:: \dot x_1 = x_2, \; \dots, \; \dot x_n = b_1 u - a_n x_1 - \dots - a_1 x_n, \; y = x_1

    in continuous time for a constant numerator: the states are the output and its derivatives.
    Otherwise the observer's canonical form, :math:`\dot x_k = x_{k+1} - a_k y + b_k u`.

    Parameters
    ----------
    values : mapping of str to expression
        The coefficients by name.
    x : sequence of expressions
        The states.
    u : expression
        The input.
    continuous : bool
        Whether time is continuous.

    Returns
    -------
    rates : list of expressions
        One for each state.
    output : expression
        The output.
    """
    n = len(x)
    a = [values[f"a{k}"] for k in range(1, n + 1)]
    b = [value for name, value in values.items() if name.startswith("b")]
    if continuous and n and len(b) == 1:
        last = b[0] * u
        for k in range(n):
            last = last - a[n - 1 - k] * x[k]
        return [*x[1:], last], x[0]
    # The numerator is aligned with the powers of the denominator, the direct term first.
    b = [0.0] * (n + 1 - len(b)) + b
    y = (x[0] if n else 0.0) + b[0] * u
    after = [*x[1:], 0.0]
    return [after[k] - a[k] * y + b[k + 1] * u for k in range(n)], y


def replace_coefficients(system: Any, values: Mapping[str, float]) -> Any:
    """Return a transfer function with other coefficients.

    Parameters
    ----------
    system : control.TransferFunction
        The transfer function, which stays as it is.
    values : mapping of str to float
        New coefficients by name.

    Returns
    -------
    control.TransferFunction
        With a monic denominator, and the names and sampling period of the original.
    """
    new = {**list_coefficients(system), **values}
    a = [value for name, value in new.items() if name.startswith("a")]
    b = [value for name, value in new.items() if name.startswith("b")]
    return ct.tf(b, [1.0, *a], system.dt, name=system.name, inputs=system.input_labels,
                 outputs=system.output_labels)  # fmt: skip
