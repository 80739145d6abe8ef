"""Arrays of real and of complex numbers, as the annotations call them."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
