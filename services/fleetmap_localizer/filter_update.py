"""The motion filter's correction by a measurement.

Source: J. Solà (see ``filter_state``), sections 6.1 (gain, eq. 274 to 276) and 6.3 (reset, eq. 285 to 287).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fleetmap_localizer.filter_process import skew
from fleetmap_localizer.filter_state import ROTATION, SIZE

Array = NDArray[np.float64]


def innovation_distance(P: Array, H: Array, residual: Array, covariance: Array) -> float:
    """Squared Mahalanobis distance of a residual (M,) from what a state of covariance P leads one to expect."""
    return float(residual @ np.linalg.solve(H @ P @ H.T + covariance, residual))


def corrected(P: Array, H: Array, residual: Array, covariance: Array) -> tuple[Array, Array]:
    """The error state (SIZE,) that a residual (M,) shows, and its covariance (SIZE, SIZE) after the reset.

    The covariance is updated in Joseph's form (eq. 276 and its footnote), which keeps it positive.
    """
    PHt = P @ H.T
    K = np.linalg.solve(H @ PHt + covariance, PHt.T).T
    error = K @ residual
    kept = np.eye(SIZE) - K @ H
    after = kept @ P @ kept.T + K @ covariance @ K.T
    reset = np.eye(3) - skew(0.5 * error[ROTATION])  # eq. 287
    after[ROTATION] = reset @ after[ROTATION]
    after[:, ROTATION] = after[:, ROTATION] @ reset.T
    return error, 0.5 * (after + after.T)
