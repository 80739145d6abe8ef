"""Closed-loop identification and diagnosis of unstable plants, on top of python-control."""

from . import datasets, effects, plants, plot
from .arx import fit_arx
from .audit import Audit, AuditFinding, audit
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
from .errors import CtrlidError, CtrlidWarning
from .feedback import FeedbackCheck, check_feedback
from .iv import fit_iv
from .lead import design_lead
from .linearization import OperatingPoint, linearize, operating_point
from .loop import Loop
from .loop_fit import LoopEstimate, LoopFit, fit_loop
from .margins import Margins, loop_margins, nu_gap, robust_margin
from .model import Estimate, IdentifiedModel
from .predictor import Prediction, predict
from .replay import replay_controller
from .report import Section, write_report
from .residuals import Correlation
from .sampling import SamplingRow, SamplingSweep, sweep_sampling_period
from .signals import multisine, prbs, random_binary, steps
from .simulation import simulate
from .validation import compare

__version__ = "0.1.0.dev0"

__all__ = [
    "PID",
    "Audit",
    "AuditFinding",
    "Bounds",
    "Comparison",
    "Correlation",
    "CtrlidError",
    "CtrlidWarning",
    "Curve",
    "Equal",
    "Estimate",
    "FeedbackCheck",
    "Fixed",
    "IdentifiedModel",
    "Integrator",
    "Linear",
    "Loop",
    "LoopEstimate",
    "LoopFit",
    "Margins",
    "Nonlinear",
    "OperatingPoint",
    "Performance",
    "PoleAt",
    "Prediction",
    "ReciprocalPoles",
    "Record",
    "Redesign",
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
    "effects",
    "fit_arx",
    "fit_continuous",
    "fit_iv",
    "fit_loop",
    "linearize",
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
    "robust_margin",
    "simulate",
    "steps",
    "sweep_sampling_period",
    "write_report",
]
