"""Every effect that a diagnosis tries, as an explicit tuple of classes."""

from .base import AbstractEffect
from .delays import ActuatorLag, InputBacklash, InputDelay, InputRateLimit
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
from .state_limit import StateLimit
from .time_varying import ParameterDrift, ParameterError, ParameterStep

CATALOGUE: tuple[type[AbstractEffect], ...] = (
    ActuatorLag,
    InputDelay,
    InputSaturation,
    InputDeadZone,
    InputOffset,
    InputBacklash,
    InputRateLimit,
    InputNonlinearity,
    InputSaturatingGain,
    ViscousFriction,
    AsymmetricViscousFriction,
    CoulombFriction,
    AsymmetricCoulombFriction,
    StribeckFriction,
    QuadraticDrag,
    EddyCurrentDamping,
    LinearStiffness,
    CubicStiffness,
    ConstantForce,
    PeriodicForce,
    PositionRipple,
    FlexibleMode,
    PositionOffset,
    ForceExponent,
    ParameterError,
    ParameterDrift,
    ParameterStep,
    StateLimit,
    SensorLag,
    SensorNonlinearity,
    SensorOffset,
    SensorGain,
    SensorDrift,
    SensorHum,
    SensorSaturation,
    Quantization,
)
