"""Closed-loop identification and diagnosis of unstable plants, on top of python-control."""

from .errors import CtrlidError, CtrlidWarning

__version__ = "0.1.0.dev0"

__all__ = ["CtrlidError", "CtrlidWarning", "__version__"]
