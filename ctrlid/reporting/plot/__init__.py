"""Pictures: a result and Axes in, the Axes out. The only package that imports matplotlib.

Without Axes a function makes its own figure. A script or notebook that has imported pyplot gets it
through pyplot, so that ``plt.show()`` shows it; otherwise it is outside pyplot's list of open
figures. Save it with ``axes.figure.savefig(...)`` or turn it into bytes with `png`. Nothing else
that is global is changed.
"""

from .axes import figure, png, style
from .findings import diagnosis
from .models import bode, poles, trend
from .records import comparison, record, residuals
from .redesigns import step

__all__ = [
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
