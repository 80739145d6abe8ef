"""Closed-loop identification and diagnosis of unstable plants, on top of python-control."""

import sys

from . import effects
from ._base.errors import CtrlidError, CtrlidWarning
from .data import datasets
from .data.record import Record
from .data.references import multisine, prbs, random_binary, staircase
from .design.controller_trial import ControllerTrial
from .design.input_margins import LoopPerformance
from .design.lead import design_lead
from .design.margins import Margins, loop_margins, nu_gap, robust_margin
from .design.redesigning import Performance, Redesign, redesign
from .design.reference_steps import ReferenceStep, StepMotion
from .diagnosis import (
    BinnedErrors,
    Calibrated,
    Candidate,
    Diagnosis,
    Disturbance,
    Finding,
    Gap,
    SensorNoise,
    diagnose,
    load_diagnosis,
)
from .estimation.confidence_band import ResponseBand, response_band
from .estimation.constraints import (
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
from .estimation.identified_model import Estimate, IdentifiedModel, IdentifiedSystem
from .estimation.likelihood.physics_estimate import (
    LoopEstimate,
    LoopFit,
    ParameterEstimate,
    SimulationEstimate,
)
from .estimation.likelihood.physics_fit import fit_loop
from .estimation.likelihood.prediction import Prediction, predict
from .estimation.linear.arx import fit_arx
from .estimation.linear.continuous import fit_continuous
from .estimation.linear.iv import fit_iv
from .estimation.series import FitSeries, PoleTrend, fit_each
from .loop.controller_replay import replay_controller
from .loop.controllers import PID
from .loop.loop import Loop
from .loop.simulation import simulate
from .physics import plants
from .physics.linearization import OperatingPoint, linearize, operating_point
from .reporting import plot
from .reporting.html_page import Section, write_report
from .validation.comparing import compare
from .validation.comparison import Comparison, Curve
from .validation.feedback_check import FeedbackCheck, check_feedback
from .validation.order_selection import OrderChoice, OrderRow, select_order
from .validation.record_audit import Audit, AuditFinding, audit
from .validation.residual_tests import Correlation
from .validation.sampling_sweep import sweep_sampling_period
from .validation.sampling_table import SamplingRow, SamplingSweep
from .validation.simulation_fit import fit_simulation

__version__ = "0.1.0.dev0"

__all__ = [
    "PID",
    "Audit",
    "AuditFinding",
    "BinnedErrors",
    "Bounds",
    "Calibrated",
    "Candidate",
    "Comparison",
    "ControllerTrial",
    "Correlation",
    "CtrlidError",
    "CtrlidWarning",
    "Curve",
    "Diagnosis",
    "Disturbance",
    "Equal",
    "Estimate",
    "FeedbackCheck",
    "Finding",
    "FitSeries",
    "Fixed",
    "Gap",
    "IdentifiedModel",
    "IdentifiedSystem",
    "Integrator",
    "Linear",
    "Loop",
    "LoopEstimate",
    "LoopFit",
    "LoopPerformance",
    "Margins",
    "Nonlinear",
    "OperatingPoint",
    "OrderChoice",
    "OrderRow",
    "ParameterEstimate",
    "Performance",
    "PoleAt",
    "PoleTrend",
    "Prediction",
    "ReciprocalPoles",
    "Record",
    "Redesign",
    "ReferenceStep",
    "ResponseBand",
    "SamplingRow",
    "SamplingSweep",
    "Section",
    "SensorNoise",
    "SimulationEstimate",
    "StaticGain",
    "StepMotion",
    "SymmetricPoles",
    "__version__",
    "audit",
    "check_feedback",
    "compare",
    "datasets",
    "design_lead",
    "diagnose",
    "effects",
    "fit_arx",
    "fit_continuous",
    "fit_each",
    "fit_iv",
    "fit_loop",
    "fit_simulation",
    "linearize",
    "load_diagnosis",
    "loop_margins",
    "multisine",
    "nu_gap",
    "operating_point",
    "plants",
    "plot",
    "prbs",
    "predict",
    "random_binary",
    "redesign",
    "replay_controller",
    "response_band",
    "robust_margin",
    "select_order",
    "simulate",
    "staircase",
    "sweep_sampling_period",
    "write_report",
]

# The rooms in which these three live are nobody's business: ``import ctrlid.plot`` and
# ``from ctrlid.plants import maglev`` find them where the names above do.
sys.modules |= {f"{__name__}.{m.__name__.rpartition('.')[2]}": m for m in (datasets, plants, plot)}


def __dir__() -> list[str]:
    """Return the public names, without the rooms behind them."""
    return __all__
