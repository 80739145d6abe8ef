"""Closed-loop identification and diagnosis of unstable plants, on top of python-control."""

from . import plants
from .controllers import PID
from .errors import CtrlidError, CtrlidWarning
from .lead import design_lead
from .linearization import OperatingPoint, linearize, operating_point
from .loop import Loop
from .margins import Margins, loop_margins, nu_gap, robust_margin
from .signals import multisine, prbs, random_binary, steps

__version__ = "0.1.0.dev0"

__all__ = [
    "CtrlidError",
    "CtrlidWarning",
    "Loop",
    "Margins",
    "OperatingPoint",
    "PID",
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
