"""The motion filter's correction by a measurement.

Source: J. Solà (see ``filter_state``), sections 6.1 (gain, eq. 274 to 276) and 6.3 (reset, eq. 285 to 287).
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from fleetmap_localizer.filter_process import skew

Array = NDArray[np.float64]

_T = 6  # where the angular error starts; see filter_state


@njit(cache=True, nogil=True)
def innovation_distance(P: Array, H: Array, residual: Array, covariance: Array) -> float:
    """Squared Mahalanobis distance of a residual (M,) from what a state of covariance P leads one to expect."""
    expected = H @ P @ H.T + covariance
    return float(residual @ np.linalg.solve(expected, residual))


@njit(cache=True, nogil=True)
def corrected(P: Array, H: Array, residual: Array, covariance: Array) -> tuple[Array, Array]:
    """The error state (SIZE,) that a residual (M,) shows, and its covariance (SIZE, SIZE) after the reset.

    The covariance is updated in Joseph's form (eq. 276 and its footnote), which keeps it positive.
    """
    PHt = P @ H.T
    K = np.ascontiguousarray(np.linalg.solve(H @ PHt + covariance, np.ascontiguousarray(PHt.T)).T)
    error = K @ residual
    kept = np.eye(len(P)) - K @ H
    after = kept @ P @ kept.T + K @ covariance @ K.T
    reset = np.eye(3) - skew(0.5 * error[_T : _T + 3])  # eq. 287
    after[_T : _T + 3] = reset @ np.ascontiguousarray(after[_T : _T + 3])
    after[:, _T : _T + 3] = np.ascontiguousarray(after[:, _T : _T + 3]) @ reset.T
    return error, 0.5 * (after + after.T)
