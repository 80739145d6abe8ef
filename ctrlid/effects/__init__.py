"""The catalogue of effects: what real plants have and models leave out."""

from .base import AbstractEffect
from .catalogue import CATALOGUE
from .change import ParameterDrift, ParameterStep
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
from .law import ForceExponent, PositionOffset
from .moment import Moment
from .output import (
    Quantization,
    SensorLag,
    SensorNonlinearity,
    SensorOffset,
    SensorSaturation,
)
from .overflow import StateLimit
from .parameters import Parameter, parameter
from .places import ForceEffect, InputEffect, LawEffect, OutputEffect, ReadingEffect
from .timing import ActuatorLag, InputBacklash, InputDelay

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
    "FlexibleMode",
    "ForceEffect",
    "ForceExponent",
    "InputBacklash",
    "InputDeadZone",
    "InputDelay",
    "InputEffect",
    "InputNonlinearity",
    "InputOffset",
    "InputSaturatingGain",
    "InputSaturation",
    "LawEffect",
    "LinearStiffness",
    "Moment",
    "OutputEffect",
    "Parameter",
    "ParameterDrift",
    "ParameterStep",
    "PeriodicForce",
    "PositionOffset",
    "PositionRipple",
    "QuadraticDrag",
    "Quantization",
    "ReadingEffect",
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
