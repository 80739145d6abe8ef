"""diagnose(): where simulation and data disagree, which effect is missing, and what it closes."""

from .findings import Calibrated, Candidate, Disturbance, Finding, Gap, Place
from .loading import load_diagnosis
from .procedure import diagnose
from .result import Diagnosis

__all__ = [
    "Calibrated",
    "Candidate",
    "Diagnosis",
    "Disturbance",
    "Finding",
    "Gap",
    "Place",
    "diagnose",
    "load_diagnosis",
]
