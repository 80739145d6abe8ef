"""Closed-loop identification and diagnosis of unstable plants, on top of python-control."""

from . import plants
from .constraints import (
    Bounds,
    Equal,
    Fixed,
    Integrator,
    Linear,
    Nonlinear,
    PoleAt,
    ReciprocalPoles,
    StaticGain,
    SymmetricPoles,
)
from .controllers import PID
from .errors import CtrlidError, CtrlidWarning
from .lead import design_lead
from .linearization import OperatingPoint, linearize, operating_point
from .loop import Loop
from .margins import Margins, loop_margins, nu_gap, robust_margin
from .model import Estimate, IdentifiedModel
from .signals import multisine, prbs, random_binary, steps

__version__ = "0.1.0.dev0"

__all__ = [
    "PID",
    "Bounds",
    "CtrlidError",
    "CtrlidWarning",
    "Equal",
    "Estimate",
    "Fixed",
    "IdentifiedModel",
    "Integrator",
    "Linear",
    "Loop",
    "Margins",
    "Nonlinear",
    "OperatingPoint",
    "PoleAt",
    "ReciprocalPoles",
    "StaticGain",
    "SymmetricPoles",
    "__version__",
    "design_lead",
    "linearize",
    "loop_margins",
    "multisine",
    "nu_gap",
    "operating_point",
    "plants",
    "prbs",
    "random_binary",
    "robust_margin",
    "steps",
]
