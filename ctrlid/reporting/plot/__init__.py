"""Pictures: a result in, a `Picture` out. The only package that imports matplotlib.

Without ``ax=`` a function makes a figure of pyplot, as python-control does: a notebook shows it,
and ``plt.show()`` and ``plt.savefig(...)`` work after the call. ``ax=`` takes one Axes or as many
as the picture has. `png` turns a picture into bytes. Nothing else that is global is changed.
"""

from .axes import Picture, figure, png, style
from .findings import diagnosis
from .models import bode, poles, trend
from .records import comparison, record, residuals
from .redesigns import step

__all__ = [
    "Picture",
    "bode",
    "comparison",
    "diagnosis",
    "figure",
    "png",
    "poles",
    "record",
    "residuals",
    "step",
    "style",
    "trend",
]


def __dir__() -> list[str]:
    """Return the functions that draw; a notebook completes these names."""
    return __all__
