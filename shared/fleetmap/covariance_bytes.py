"""Pose covariances as bytes, 21 each, that never claim more precision than there was.

A covariance is D R D with the six sigmas in D and correlations R. Sigmas are rounded up on a logarithmic scale.
Correlations are rounded to 1/127, which changes R by a matrix whose rows sum up to no more than 5/254: by
Gershgorin's theorem, adding that much to the diagonal outweighs it. So what is read minus what was written is
positive semidefinite, and so is what is read.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import MapPackageError
from fleetmap.log_bytes import LogBytes

_SIGMAS = LogBytes(1e-6, 0.085)  # rad, m; 1e-6 to 2.5e3
_UNITS = 127.0  # of a correlation of 1
_ROWS, _COLUMNS = np.triu_indices(6, 1)
_DIAGONAL = 1.0 + 5.0 / (2.0 * _UNITS) + 1e-6
_UNDETERMINED = -128  # in place of all correlations
_LEAST_EIGENVALUE = -1e-4


def covariances_to_bytes(covariances: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Bytes (21, K) of covariances (K, 6, 6), of which some may be NaN: sigmas, then correlations row by row."""
    determined = np.asarray(np.isfinite(covariances).all(axis=(1, 2)))
    known = np.where(determined[:, None, None], covariances, np.eye(6)).astype(np.float64)
    variances = np.diagonal(known, axis1=1, axis2=2).clip(0.0)
    sigma_bytes = _SIGMAS.at_least(np.sqrt(variances))
    sigmas = _SIGMAS.values(sigma_bytes)
    correlations = known[:, _ROWS, _COLUMNS] / (sigmas[:, _ROWS] * sigmas[:, _COLUMNS])
    rounded = np.rint(correlations * _UNITS).clip(-_UNITS, _UNITS)
    rounded[~determined] = _UNDETERMINED
    sigma_bytes[~determined] = 0
    return np.concatenate([sigma_bytes.T, rounded.astype(np.int8).T.view(np.uint8)])


def covariances_from_bytes(stored: NDArray[np.uint8], origin: str) -> NDArray[np.float32]:
    """Covariances (K, 6, 6) float32 of bytes (21, K); NaN where undetermined.

    Raises:
        MapPackageError: correlations that no covariance has; ``origin`` says where they came from.
    """
    sigmas = _SIGMAS.values(stored[:6].T)
    rounded = np.ascontiguousarray(stored[6:].T).view(np.int8)
    undetermined = (rounded == _UNDETERMINED).any(axis=1)
    correlations = np.tile(np.eye(6) * _DIAGONAL, (len(sigmas), 1, 1))
    correlations[:, _ROWS, _COLUMNS] = correlations[:, _COLUMNS, _ROWS] = rounded / _UNITS
    correlations[undetermined] = np.eye(6)
    if len(sigmas) and np.linalg.eigvalsh(correlations).min() < _LEAST_EIGENVALUE:
        raise MapPackageError(f"{origin}: the covariance of a keyframe is none")
    covariances = correlations * sigmas[:, :, None] * sigmas[:, None, :]
    covariances[undetermined] = np.nan
    return covariances.astype(np.float32)
