"""diagnose(): where simulation and data disagree, which effect is missing, and what it closes."""

from .findings import BinnedErrors, Calibrated, Candidate, Disturbance, Finding, Gap, SensorNoise
from .loading import load_diagnosis
from .procedure import diagnose
from .result import Diagnosis

__all__ = [
    "BinnedErrors",
    "Calibrated",
    "Candidate",
    "Diagnosis",
    "Disturbance",
    "Finding",
    "Gap",
    "SensorNoise",
    "diagnose",
    "load_diagnosis",
]
