"""Closed-loop identification and diagnosis of unstable plants, on top of python-control."""

from . import datasets, effects, plants, plot
from .arx import fit_arx
from .audit import Audit, AuditFinding, audit
from .band import ResponseBand, response_band
from .comparison import Comparison, Curve
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
from .continuous import fit_continuous
from .controller_redesign import Performance, Redesign, redesign
from .controllers import PID
from .data import Record
from .diagnosis import (
    Calibrated,
    Candidate,
    Diagnosis,
    Disturbance,
    Finding,
    Gap,
    Place,
    diagnose,
    load_diagnosis,
)
from .each import FitSeries, PoleTrend, fit_each
from .errors import CtrlidError, CtrlidWarning
from .feedback import FeedbackCheck, check_feedback
from .iv import fit_iv
from .lead import design_lead
from .linearization import OperatingPoint, linearize, operating_point
from .loop import Loop
from .loop_estimate import LoopEstimate, LoopFit
from .loop_fit import fit_loop
from .margins import Margins, loop_margins, nu_gap, robust_margin
from .model import Estimate, IdentifiedModel
from .predictor import Prediction, predict
from .replay import replay_controller
from .report import Section, write_report
from .residuals import Correlation
from .sampling import sweep_sampling_period
from .sampling_table import SamplingRow, SamplingSweep
from .signals import multisine, prbs, random_binary, steps
from .simulation import simulate
from .structure import OrderChoice, OrderRow, select_order
from .validation import compare

__version__ = "0.1.0.dev0"

__all__ = [
    "PID",
    "Audit",
    "AuditFinding",
    "Bounds",
    "Calibrated",
    "Candidate",
    "Comparison",
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
    "Integrator",
    "Linear",
    "Loop",
    "LoopEstimate",
    "LoopFit",
    "Margins",
    "Nonlinear",
    "OperatingPoint",
    "OrderChoice",
    "OrderRow",
    "Performance",
    "Place",
    "PoleAt",
    "PoleTrend",
    "Prediction",
    "ReciprocalPoles",
    "Record",
    "Redesign",
    "ResponseBand",
    "SamplingRow",
    "SamplingSweep",
    "Section",
    "StaticGain",
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
    "steps",
    "sweep_sampling_period",
    "write_report",
]
