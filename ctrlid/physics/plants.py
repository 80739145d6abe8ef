"""Textbook plants with physical parameters, as `control.NonlinearIOSystem` objects.

Each is written as a user would write it: one update function in numpy. Outside its physical domain
a plant is not a number, so that a simulation that leaves the domain cannot go on unnoticed.
"""

from typing import Any

import control as ct
import numpy as np

from .._base.arguments import check_arguments, is_number
from .._base.errors import CtrlidError


def _require_positive(plant: str, **parameters: float) -> None:
    for name, value in parameters.items():
        if not (is_number(value) and np.isfinite(value) and value > 0):
            raise CtrlidError(f"{plant} needs {name} > 0 in SI units; given {name}={value!r}")


def _make_plant(
    name: str, update: Any, inputs: list[str], outputs: list[str], states: list[str],
    parameters: dict[str, float], units: dict[str, str],
) -> Any:  # fmt: skip
    """Return a plant whose output is its first state; simulated records take its units."""
    system = ct.nlsys(
        update, lambda t, x, u, params: x[0], inputs=inputs, outputs=outputs, states=states,
        params={key: float(value) for key, value in parameters.items()}, name=name,
    )  # fmt: skip
    system.units = units
    return system


def maglev(m: float, K: float, g: float = 9.81) -> Any:
    r"""Return a ball that hangs below an electromagnet.

    .. math:: m \ddot x = m g - K V^2 / x^2

    The magnet pulls the ball up with a force that grows with the voltage and falls with the gap;
    the gap is counted from the magnet downwards. Unstable: poles at plus and minus
    ``sqrt(2 g / x0)``.

    Parameters
    ----------
    m : float
        Mass of the ball [kg].
    K : float
        Constant of the magnet circuit [N m^2/V^2].
    g : float, optional
        Gravitational acceleration [m/s^2].

    Returns
    -------
    control.NonlinearIOSystem
        States `x` (gap [m], positive downwards) and `v` [m/s], input `V` [V], output `x`.
        Undefined (NaN) for a gap of zero or less: the ball is at the magnet.

    Raises
    ------
    CtrlidError
        If a parameter is not positive.

    References
    ----------
    "Identification of a class of unstable processes", equation (1).

    Examples
    --------
    >>> import ctrlid as cid
    >>> cid.plants.maglev(m=0.0213, K=3.34e-6).state_labels
    ['x', 'v']
    """
    check_arguments(maglev, locals())
    _require_positive("maglev", m=m, K=K, g=g)

    def update(t: float, x: Any, u: Any, params: Any) -> Any:
        gap, speed = x
        gap = np.where(gap > 0, gap, np.nan)
        pull = params["K"] * u[0] ** 2 / gap**2
        return np.array([speed, params["g"] - pull / params["m"]])

    return _make_plant(
        "maglev",
        update,
        ["V"],
        ["x"],
        ["x", "v"],
        {"m": m, "K": K, "g": g},
        {"V": "V", "x": "m", "v": "m/s", "m": "kg", "K": "N m^2/V^2", "g": "m/s^2"},
    )


def servo(m: float, c: float, k: float) -> Any:
    r"""Return a mass on a drive: a pole at the origin and one from friction.

    .. math:: m \ddot x = k V - c \dot x

    Parameters
    ----------
    m : float
        Moving mass [kg].
    c : float
        Viscous friction [N s/m]; zero is allowed.
    k : float
        Drive force per volt [N/V].

    Returns
    -------
    control.NonlinearIOSystem
        States `x` [m] and `v` [m/s], input `V` [V], output `x`.

    Raises
    ------
    CtrlidError
        If `m` or `k` is not positive, or `c` is negative.

    Examples
    --------
    >>> import ctrlid as cid
    >>> plant = cid.plants.servo(m=95.1, c=203.5, k=35.15)
    >>> cid.linearize(plant, cid.operating_point(plant, output=0.1)).poles().real.round(3)
    array([-2.14,  0.  ])
    """
    check_arguments(servo, locals())
    _require_positive("servo", m=m, k=k)
    if not (np.isfinite(c) and c >= 0):
        raise CtrlidError(f"servo needs c >= 0 [N s/m]; given c={c!r}")

    def update(t: float, x: Any, u: Any, params: Any) -> Any:
        return np.array([x[1], (params["k"] * u[0] - params["c"] * x[1]) / params["m"]])

    return _make_plant(
        "servo",
        update,
        ["V"],
        ["x"],
        ["x", "v"],
        {"m": m, "c": c, "k": k},
        {"V": "V", "x": "m", "v": "m/s", "m": "kg", "c": "N s/m", "k": "N/V"},
    )


def tank(area: float, outlet: float, k: float, g: float = 9.81) -> Any:
    r"""Return a tank that is filled by a pump and drained through a hole.

    .. math:: A \dot h = k V - a \sqrt{2 g h}

    Parameters
    ----------
    area : float
        Cross section A of the tank [m^2].
    outlet : float
        Cross section a of the outlet [m^2].
    k : float
        Pump flow per volt [m^3/(s V)].
    g : float, optional
        Gravitational acceleration [m/s^2].

    Returns
    -------
    control.NonlinearIOSystem
        State `h` (level [m]), input `V` [V], output `h`. An empty tank drains no further.

    Raises
    ------
    CtrlidError
        If a parameter is not positive.

    Examples
    --------
    >>> import ctrlid as cid
    >>> plant = cid.plants.tank(area=0.01, outlet=1e-5, k=1e-5)
    >>> round(cid.operating_point(plant, output=0.2).input, 4)
    1.9809
    """
    check_arguments(tank, locals())
    _require_positive("tank", area=area, outlet=outlet, k=k, g=g)

    def update(t: float, x: Any, u: Any, params: Any) -> Any:
        level = np.maximum(x[0], 0.0)
        drain = params["outlet"] * np.sqrt(2 * params["g"] * level)
        return np.array([(params["k"] * u[0] - drain) / params["area"]])

    parameters = {"area": area, "outlet": outlet, "k": k, "g": g}
    units = {"V": "V", "h": "m", "area": "m^2", "outlet": "m^2", "k": "m^3/(s V)", "g": "m/s^2"}
    return _make_plant("tank", update, ["V"], ["h"], ["h"], parameters, units)


def pendulum(m: float, length: float, c: float = 0.0, g: float = 9.81) -> Any:
    r"""Return an inverted pendulum driven by a torque at its pivot.

    .. math:: m l^2 \ddot\theta = m g l \sin\theta - c \dot\theta + \tau

    Parameters
    ----------
    m : float
        Mass at the end of the rod [kg].
    length : float
        Length l of the rod [m].
    c : float, optional
        Friction of the pivot [N m s/rad].
    g : float, optional
        Gravitational acceleration [m/s^2].

    Returns
    -------
    control.NonlinearIOSystem
        States `theta` (angle from upright [rad]) and `omega` [rad/s], input `tau` [N m], output
        `theta`. Unstable upright, with poles near plus and minus ``sqrt(g/l)``.

    Raises
    ------
    CtrlidError
        If `m`, `length` or `g` is not positive, or `c` is negative.

    Examples
    --------
    >>> import ctrlid as cid
    >>> plant = cid.plants.pendulum(m=0.2, length=0.5)
    >>> cid.operating_point(plant, output=0.0).input
    0.0
    """
    check_arguments(pendulum, locals())
    _require_positive("pendulum", m=m, length=length, g=g)
    if not (np.isfinite(c) and c >= 0):
        raise CtrlidError(f"pendulum needs c >= 0 [N m s/rad]; given c={c!r}")

    def update(t: float, x: Any, u: Any, params: Any) -> Any:
        inertia = params["m"] * params["length"] ** 2
        weight = params["m"] * params["g"] * params["length"] * np.sin(x[0])
        return np.array([x[1], (weight - params["c"] * x[1] + u[0]) / inertia])

    parameters = {"m": m, "length": length, "c": c, "g": g}
    units = {"tau": "N m", "theta": "rad", "omega": "rad/s", "m": "kg", "length": "m",
             "c": "N m s/rad", "g": "m/s^2"}  # fmt: skip
    return _make_plant(
        "pendulum", update, ["tau"], ["theta"], ["theta", "omega"], parameters, units
    )
