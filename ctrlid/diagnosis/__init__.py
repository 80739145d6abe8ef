"""diagnose(): where simulation and data disagree, which effect is missing, and what it closes."""

from .main import diagnose
from .result import (
    Calibrated,
    Candidate,
    Diagnosis,
    Disturbance,
    Finding,
    Gap,
    Place,
)
from .saving import load_diagnosis

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
