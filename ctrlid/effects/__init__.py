"""The catalogue of effects: what real plants have and models leave out."""

from typing import Any

from .._base.errors import EffectDoesNotApply
from .._base.text import find_near_name
from .base import AbstractEffect
from .catalogue import CATALOGUE
from .context import Moment
from .delays import ActuatorLag, InputBacklash, InputDelay, InputRateLimit
from .equivalence import equivalents
from .force import (
    ConstantForce,
    CubicStiffness,
    FlexibleMode,
    LinearStiffness,
    PeriodicForce,
    PositionRipple,
)
from .friction import (
    AsymmetricCoulombFriction,
    AsymmetricViscousFriction,
    CoulombFriction,
    EddyCurrentDamping,
    QuadraticDrag,
    StribeckFriction,
    ViscousFriction,
)
from .input import (
    InputDeadZone,
    InputNonlinearity,
    InputOffset,
    InputSaturatingGain,
    InputSaturation,
)
from .kinds import ForceEffect, InputEffect, LawEffect, OutputEffect, ReadingEffect
from .law import ForceExponent, PositionOffset
from .output import (
    Quantization,
    SensorDrift,
    SensorGain,
    SensorHum,
    SensorLag,
    SensorNonlinearity,
    SensorOffset,
    SensorSaturation,
)
from .parameters import Parameter, parameter
from .state_limit import StateLimit
from .time_varying import ParameterDrift, ParameterError, ParameterStep

__all__ = [
    "CATALOGUE",
    "AbstractEffect",
    "ActuatorLag",
    "AsymmetricCoulombFriction",
    "AsymmetricViscousFriction",
    "ConstantForce",
    "CoulombFriction",
    "CubicStiffness",
    "EddyCurrentDamping",
    "EffectDoesNotApply",
    "FlexibleMode",
    "ForceEffect",
    "ForceExponent",
    "InputBacklash",
    "InputDeadZone",
    "InputDelay",
    "InputEffect",
    "InputNonlinearity",
    "InputOffset",
    "InputRateLimit",
    "InputSaturatingGain",
    "InputSaturation",
    "LawEffect",
    "LinearStiffness",
    "Moment",
    "OutputEffect",
    "Parameter",
    "ParameterDrift",
    "ParameterError",
    "ParameterStep",
    "PeriodicForce",
    "PositionOffset",
    "PositionRipple",
    "QuadraticDrag",
    "Quantization",
    "ReadingEffect",
    "SensorDrift",
    "SensorGain",
    "SensorHum",
    "SensorLag",
    "SensorNonlinearity",
    "SensorOffset",
    "SensorSaturation",
    "StateLimit",
    "StribeckFriction",
    "ViscousFriction",
    "equivalents",
    "parameter",
]


def __getattr__(name: str) -> Any:
    """Refuse a name that there is not, with the nearest one."""
    near = find_near_name(name, __all__)
    hint = f"did you mean {near}?" if near else "CATALOGUE lists the effects"
    raise AttributeError(f"ctrlid.effects has no {name!r}; {hint}")
