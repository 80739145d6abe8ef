"""The catalogue of effects: what real plants have and models leave out."""

from .base import AbstractEffect, Parameter, parameter
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
    ActuatorLag,
    InputBacklash,
    InputDeadZone,
    InputDelay,
    InputNonlinearity,
    InputOffset,
    InputSaturatingGain,
    InputSaturation,
)
from .moment import Moment
from .places import ForceEffect, InputEffect, LawEffect, OutputEffect, ReadingEffect

CATALOGUE: tuple[type[AbstractEffect], ...] = (
    ActuatorLag,
    InputDelay,
    InputSaturation,
    InputDeadZone,
    InputOffset,
    InputBacklash,
    InputNonlinearity,
    InputSaturatingGain,
    ViscousFriction,
    AsymmetricViscousFriction,
    CoulombFriction,
    AsymmetricCoulombFriction,
    StribeckFriction,
    QuadraticDrag,
    EddyCurrentDamping,
)

__all__ = [
    "CATALOGUE",
    "AbstractEffect",
    "ActuatorLag",
    "AsymmetricCoulombFriction",
    "AsymmetricViscousFriction",
    "CoulombFriction",
    "EddyCurrentDamping",
    "ForceEffect",
    "InputBacklash",
    "InputDeadZone",
    "InputDelay",
    "InputEffect",
    "InputNonlinearity",
    "InputOffset",
    "InputSaturatingGain",
    "InputSaturation",
    "LawEffect",
    "Moment",
    "OutputEffect",
    "Parameter",
    "QuadraticDrag",
    "ReadingEffect",
    "StribeckFriction",
    "ViscousFriction",
    "parameter",
]
