"""Statistics that several rooms need."""

import numpy as np

from .arrays import Array

SINGULAR = 1e-10  # A direction with a smaller relative eigenvalue is not in the data.


def pseudo_inverse(matrix: Array) -> Array:
    """Invert an information matrix, leaving out directions that are not in the data."""
    size = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    values, vectors = np.linalg.eigh(matrix / np.outer(size, size))
    keep = values > SINGULAR * values.max()
    inverse = (vectors[:, keep] / values[keep]) @ vectors[:, keep].T
    return np.asarray(inverse / np.outer(size, size), dtype=float)
