"""Textbook plants with physical parameters, as `control.NonlinearIOSystem` objects.

Each is written as a user would write it: one update function in numpy. Outside its physical domain
a plant is not a number, so that a simulation that leaves the domain cannot go on unnoticed.
"""

from typing import Any

import control as ct
import numpy as np

from .._base.arguments import check_arguments, explain_names, is_number
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


@explain_names
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


@explain_names
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


@explain_names
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


@explain_names
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


def _require_nonnegative(plant: str, **parameters: float) -> None:
    for name, value in parameters.items():
        if not (is_number(value) and np.isfinite(value) and value >= 0):
            raise CtrlidError(f"{plant} needs {name} >= 0 in SI units; given {name}={value!r}")


def _make_mechanism(
    name: str, rates: Any, coordinates: list[str], inputs: list[str], forces: dict[str, str],
    parameters: dict[str, float], units: dict[str, str],
) -> Any:  # fmt: skip
    """Return a mechanism: coordinates q, their velocities, and all coordinates measured.

    ``rates(q, v, u, params)`` are the accelerations, with the driven inputs first in u, then the
    unknown forces and torques. The plant has the driven inputs alone, so that ``ct.lqr`` designs
    for these; `forces` says which of the others works on which velocity, and `mechanism` is the
    plant that has them as inputs too.
    """
    n = len(coordinates)
    others = [force for force in forces.values() if force not in inputs]

    def update(t: float, x: Any, u: Any, params: Any) -> Any:
        return np.array([*x[n:], *rates(x[:n], x[n:], u, params)])

    def undisturbed(t: float, x: Any, u: Any, params: Any) -> Any:
        return np.array([*x[n:], *rates(x[:n], x[n:], [*u, *[0.0] * len(others)], params)])

    systems = [
        ct.nlsys(
            function, lambda t, x, u, params: x[:n], inputs=labels, outputs=coordinates,
            states=[*coordinates, *(f"{q}_dot" for q in coordinates)], name=name,
            params={key: float(value) for key, value in parameters.items()},
        )
        for function, labels in ((undisturbed, inputs), (update, [*inputs, *others]))
    ]  # fmt: skip
    for system in systems:
        system.units, system.forces = units, dict(forces)
    systems[0].mechanism = systems[1]
    return systems[0]


@explain_names
def cart_pole(
    M: float, m: float, length: float, J: float = 0.0, c: float = 0.0, gamma: float = 0.0,
    g: float = 9.81,
) -> Any:  # fmt: skip
    r"""Return a cart that balances a pole: two measured outputs, one force.

    .. math:: (M + m) \ddot x - m l \cos\theta\, \ddot\theta
        &= -c \dot x - m l \sin\theta\, \dot\theta^2 + F \\
        (J + m l^2) \ddot\theta - m l \cos\theta\, \ddot x
        &= -\gamma \dot\theta + m g l \sin\theta

    Parameters
    ----------
    M : float
        Mass of the cart [kg].
    m : float
        Mass of the pole [kg].
    length : float
        Distance l from the pivot to the pole's centre of mass [m].
    J : float, optional
        Moment of inertia of the pole about its centre of mass [kg m^2]; zero is a point mass.
    c : float, optional
        Viscous friction of the cart [N s/m].
    gamma : float, optional
        Viscous friction of the pivot [N m s/rad].
    g : float, optional
        Gravitational acceleration [m/s^2].

    Returns
    -------
    control.NonlinearIOSystem
        States `x` [m], `theta` (from upright, positive towards positive x [rad]), `x_dot` and
        `theta_dot`; input `F` [N]; outputs `x` and `theta`. Its attribute `forces` names the input
        that works on each velocity, ``{"x_dot": "F", "theta_dot": "tau_pivot"}``; the torque at
        the pivot is an input of its attribute `mechanism`.

    Raises
    ------
    CtrlidError
        If a mass, the length or `g` is not positive, or another parameter is negative.

    References
    ----------
    Åström and Murray, *Feedback Systems*, chapter 3, the balance system.

    Examples
    --------
    >>> import control as ct
    >>> import ctrlid as cid
    >>> plant = cid.plants.cart_pole(M=0.5, m=0.2, length=0.3)
    >>> ct.linearize(plant, [0, 0, 0, 0], 0).poles().real.round(2).max()
    np.float64(6.77)
    """
    check_arguments(cart_pole, locals())
    _require_positive("cart_pole", M=M, m=m, length=length, g=g)
    _require_nonnegative("cart_pole", J=J, c=c, gamma=gamma)

    def rates(q: Any, v: Any, u: Any, params: Any) -> Any:
        sin, cos = np.sin(q[1]), np.cos(q[1])
        coupling = params["m"] * params["length"]
        push = u[0] - params["c"] * v[0] - coupling * sin * v[1] ** 2
        turn = u[1] - params["gamma"] * v[1] + coupling * params["g"] * sin
        total = params["M"] + params["m"]
        inertia = params["J"] + coupling * params["length"]
        det = total * inertia - (coupling * cos) ** 2
        return [
            (inertia * push + coupling * cos * turn) / det,
            (total * turn + coupling * cos * push) / det,
        ]

    return _make_mechanism(
        "cart_pole", rates, ["x", "theta"], ["F"], {"x_dot": "F", "theta_dot": "tau_pivot"},
        {"M": M, "m": m, "length": length, "J": J, "c": c, "gamma": gamma, "g": g},
        {"F": "N", "tau_pivot": "N m", "x": "m", "theta": "rad", "x_dot": "m/s",
         "theta_dot": "rad/s"},
    )  # fmt: skip


@explain_names
def rotary_pendulum(
    m: float, length: float, arm: float, arm_inertia: float, kt: float, R: float, J: float = 0.0,
    km: float | None = None, c: float = 0.0, gamma: float = 0.0, g: float = 9.81,
) -> Any:  # fmt: skip
    r"""Return a pendulum on a motor-driven arm (Furuta's): two measured outputs, one voltage.

    .. math:: (J_a + m r^2 + J_p \sin^2\alpha) \ddot\theta + m r l \cos\alpha\, \ddot\alpha
        + J_p \sin 2\alpha\, \dot\theta \dot\alpha - m r l \sin\alpha\, \dot\alpha^2
        &= \frac{k_t}{R} (V - k_m \dot\theta) - c \dot\theta \\
        J_p \ddot\alpha + m r l \cos\alpha\, \ddot\theta
        - \tfrac12 J_p \sin 2\alpha\, \dot\theta^2 - m g l \sin\alpha &= -\gamma \dot\alpha

    with :math:`J_p = J + m l^2`.

    Parameters
    ----------
    m : float
        Mass of the pendulum [kg].
    length : float
        Distance l from its pivot to its centre of mass [m].
    arm : float
        Radius r of the arm: distance from the motor's axis to the pivot [m].
    arm_inertia : float
        Moment of inertia J_a of the arm with the rotor about the motor's axis [kg m^2].
    kt : float
        Torque per current of the motor [N m/A].
    R : float
        Resistance of the motor [ohm].
    J : float, optional
        Moment of inertia of the pendulum about its centre of mass [kg m^2].
    km : float, optional
        Back-EMF of the motor [V s/rad]; by default `kt`.
    c, gamma : float, optional
        Viscous friction of the arm and of the pendulum's pivot [N m s/rad].
    g : float, optional
        Gravitational acceleration [m/s^2].

    Returns
    -------
    control.NonlinearIOSystem
        States `theta` (arm), `alpha` (pendulum, from upright) [rad], `theta_dot` and `alpha_dot`;
        input `V` [V]; outputs `theta` and `alpha`. Its attribute `forces` names the torque that
        works on each velocity, ``{"theta_dot": "tau_arm", "alpha_dot": "tau_pivot"}``; these are
        inputs of its attribute `mechanism`.

    Raises
    ------
    CtrlidError
        If a parameter has no sense physically.

    References
    ----------
    Cazzolato and Prime, "On the dynamics of the Furuta pendulum", Journal of Control Science and
    Engineering (2011) 528341, with a slender pendulum and the angle counted from upright.

    Examples
    --------
    >>> import ctrlid as cid
    >>> plant = cid.plants.rotary_pendulum(
    ...     m=0.024, length=0.0645, arm=0.085, arm_inertia=5.72e-5, J=3.33e-5, kt=0.042, R=8.4)
    >>> plant.state_labels
    ['theta', 'alpha', 'theta_dot', 'alpha_dot']
    """
    check_arguments(rotary_pendulum, locals())
    km = kt if km is None else km
    _require_positive(
        "rotary_pendulum", m=m, length=length, arm=arm, arm_inertia=arm_inertia, kt=kt, R=R, g=g
    )
    _require_nonnegative("rotary_pendulum", J=J, km=km, c=c, gamma=gamma)

    def rates(q: Any, v: Any, u: Any, params: Any) -> Any:
        sin, cos = np.sin(q[1]), np.cos(q[1])
        coupling = params["m"] * params["arm"] * params["length"]
        inertia = params["J"] + params["m"] * params["length"] ** 2
        total = params["arm_inertia"] + params["m"] * params["arm"] ** 2 + inertia * sin**2
        drive = params["kt"] / params["R"] * (u[0] - params["km"] * v[0])
        first = (
            drive + u[1] - params["c"] * v[0] - 2 * inertia * sin * cos * v[0] * v[1]
            + coupling * sin * v[1] ** 2
        )  # fmt: skip
        second = (
            u[2] - params["gamma"] * v[1] + inertia * sin * cos * v[0] ** 2
            + params["m"] * params["g"] * params["length"] * sin
        )  # fmt: skip
        det = total * inertia - (coupling * cos) ** 2
        return [
            (inertia * first - coupling * cos * second) / det,
            (total * second - coupling * cos * first) / det,
        ]

    return _make_mechanism(
        "rotary_pendulum", rates, ["theta", "alpha"], ["V"],
        {"theta_dot": "tau_arm", "alpha_dot": "tau_pivot"},
        {"m": m, "length": length, "arm": arm, "arm_inertia": arm_inertia, "kt": kt, "R": R,
         "J": J, "km": km, "c": c, "gamma": gamma, "g": g},
        {"V": "V", "tau_arm": "N m", "tau_pivot": "N m", "theta": "rad", "alpha": "rad",
         "theta_dot": "rad/s", "alpha_dot": "rad/s"},
    )  # fmt: skip


@explain_names
def ball_on_beam(
    m: float, J: float, radius: float, ball_inertia: float | None = None, c: float = 0.0,
    g: float = 9.81,
) -> Any:  # fmt: skip
    r"""Return a ball that rolls along a beam on a pivot: two measured outputs, one torque.

    .. math:: (m + J_b/\rho^2) \ddot r &= m r \dot\theta^2 - m g \sin\theta \\
        (J + J_b + m r^2) \ddot\theta &= \tau - c \dot\theta - 2 m r \dot r \dot\theta
        - m g r \cos\theta

    Parameters
    ----------
    m : float
        Mass of the ball [kg].
    J : float
        Moment of inertia of the beam about its pivot [kg m^2].
    radius : float
        Rolling radius rho of the ball [m].
    ball_inertia : float, optional
        Moment of inertia of the ball [kg m^2]; by default that of a solid sphere,
        ``2/5 m radius^2``.
    c : float, optional
        Viscous friction of the pivot [N m s/rad].
    g : float, optional
        Gravitational acceleration [m/s^2].

    Returns
    -------
    control.NonlinearIOSystem
        States `r` (of the ball from the pivot [m]), `theta` (of the beam, positive where it lifts
        positive r [rad]), `r_dot` and `theta_dot`; input `tau` [N m]; outputs `r` and `theta`. Its
        attribute `forces` is ``{"r_dot": "F_ball", "theta_dot": "tau"}``; the force along the beam
        is an input of its attribute `mechanism`.

    Raises
    ------
    CtrlidError
        If a mass, an inertia, the radius or `g` is not positive, or `c` is negative.

    References
    ----------
    Hauser, Sastry and Kokotović, "Nonlinear control via approximate input-output linearization: the
    ball and beam example", IEEE Transactions on Automatic Control 37 (1992) 392-398.

    Examples
    --------
    >>> import ctrlid as cid
    >>> cid.plants.ball_on_beam(m=0.05, J=0.02, radius=0.01).output_labels
    ['r', 'theta']
    """
    check_arguments(ball_on_beam, locals())
    _require_positive("ball_on_beam", m=m, J=J, radius=radius, g=g)
    ball_inertia = 0.4 * m * radius * radius if ball_inertia is None else ball_inertia
    _require_nonnegative("ball_on_beam", ball_inertia=ball_inertia, c=c)

    def rates(q: Any, v: Any, u: Any, params: Any) -> Any:
        m, g, spin = params["m"], params["g"], params["ball_inertia"]
        along = u[1] + m * q[0] * v[1] ** 2 - m * g * np.sin(q[1])
        turn = u[0] - params["c"] * v[1] - 2 * m * q[0] * v[0] * v[1] - m * g * q[0] * np.cos(q[1])
        return [
            along / (m + spin / params["radius"] / params["radius"]),
            turn / (params["J"] + spin + m * q[0] ** 2),
        ]

    return _make_mechanism(
        "ball_on_beam", rates, ["r", "theta"], ["tau"], {"r_dot": "F_ball", "theta_dot": "tau"},
        {"m": m, "J": J, "radius": radius, "ball_inertia": ball_inertia, "c": c, "g": g},
        {"tau": "N m", "F_ball": "N", "r": "m", "theta": "rad", "r_dot": "m/s",
         "theta_dot": "rad/s"},
    )  # fmt: skip


@explain_names
def quadrotor_planar(
    m: float, J: float, arm: float, c: float = 0.0, g: float = 9.81
) -> Any:  # fmt: skip
    r"""Return a quadrotor that flies in a vertical plane: three measured outputs, two thrusts.

    .. math:: m \ddot x = -(F_1 + F_2) \sin\theta - c \dot x, \quad
        m \ddot z = (F_1 + F_2) \cos\theta - m g - c \dot z, \quad
        J \ddot\theta = a (F_1 - F_2)

    Parameters
    ----------
    m : float
        Mass [kg].
    J : float
        Moment of inertia about the centre of mass [kg m^2].
    arm : float
        Distance a from the centre of mass to each rotor [m].
    c : float, optional
        Drag of the air [N s/m].
    g : float, optional
        Gravitational acceleration [m/s^2].

    Returns
    -------
    control.NonlinearIOSystem
        States `x`, `z` [m], `theta` (positive where it tilts the thrust towards negative x [rad])
        and their rates; inputs `F1` and `F2` [N], the thrust of the rotors at positive and at
        negative x; outputs `x`, `z` and `theta`. Its attribute `forces` is ``{"x_dot": "F_x",
        "z_dot": "F_z", "theta_dot": "tau"}``; these are inputs of its attribute `mechanism`.

    Raises
    ------
    CtrlidError
        If `m`, `J`, `arm` or `g` is not positive, or `c` is negative.

    References
    ----------
    Tedrake, *Underactuated Robotics*, chapter 3, the planar quadrotor.

    Examples
    --------
    >>> import ctrlid as cid
    >>> plant = cid.plants.quadrotor_planar(m=0.5, J=2e-3, arm=0.15)
    >>> plant.ninputs, plant.noutputs
    (2, 3)
    """
    check_arguments(quadrotor_planar, locals())
    _require_positive("quadrotor_planar", m=m, J=J, arm=arm, g=g)
    _require_nonnegative("quadrotor_planar", c=c)

    def rates(q: Any, v: Any, u: Any, params: Any) -> Any:
        thrust = u[0] + u[1]
        return [
            (u[2] - thrust * np.sin(q[2]) - params["c"] * v[0]) / params["m"],
            (u[3] + thrust * np.cos(q[2]) - params["c"] * v[1]) / params["m"] - params["g"],
            (u[4] + params["arm"] * (u[0] - u[1])) / params["J"],
        ]

    return _make_mechanism(
        "quadrotor_planar", rates, ["x", "z", "theta"], ["F1", "F2"],
        {"x_dot": "F_x", "z_dot": "F_z", "theta_dot": "tau"},
        {"m": m, "J": J, "arm": arm, "c": c, "g": g},
        {"F1": "N", "F2": "N", "F_x": "N", "F_z": "N", "tau": "N m", "x": "m", "z": "m",
         "theta": "rad", "x_dot": "m/s", "z_dot": "m/s", "theta_dot": "rad/s"},
    )  # fmt: skip
