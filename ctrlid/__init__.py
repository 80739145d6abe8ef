"""Closed-loop identification and diagnosis of unstable plants, on top of python-control."""

from .errors import CtrlidError, CtrlidWarning
from .lead import design_lead
from .margins import Margins, loop_margins, nu_gap, robust_margin
from .signals import multisine, prbs, random_binary, steps

__version__ = "0.1.0.dev0"

__all__ = [
    "CtrlidError",
    "CtrlidWarning",
    "Margins",
    "__version__",
    "design_lead",
    "loop_margins",
    "multisine",
    "nu_gap",
    "prbs",
    "random_binary",
    "robust_margin",
    "steps",
]
