"""The figures of N errors, as the printed tables show them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fleetmap.geometry import rotation_angle_rad

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ErrorStatistics:
    """The rows of the printed tables, and the 95th percentile."""

    max: float
    mean: float
    median: float
    min: float
    rmse: float
    sse: float  # sum of squared errors, in the square of the unit
    std: float  # population standard deviation
    p95: float

    @staticmethod
    def of(errors: Array) -> ErrorStatistics:
        """Statistics of non-negative errors (N,), N >= 1."""
        squares = errors**2
        return ErrorStatistics(
            max=float(errors.max()),
            mean=float(errors.mean()),
            median=float(np.median(errors)),
            min=float(errors.min()),
            rmse=float(np.sqrt(squares.mean())),
            sse=float(squares.sum()),
            std=float(errors.std()),
            p95=float(np.percentile(errors, 95.0)),
        )


@dataclass(frozen=True)
class RotationErrors:
    """Rotations ``truth_from_estimate`` of N compared poses, and what is left without their common part."""

    angles_deg: Array  # (N,) the whole angle
    offset_deg: float  # angle of the mean rotation: a mounting, or a constant error such as roll
    spread_deg: Array  # (N,) angle left when the mean rotation is taken off

    @staticmethod
    def of(truth_from_estimate: Array) -> RotationErrors:
        """Errors of relative rotations (N, 3, 3), N >= 1; their mean is the chordal one."""
        mean = mean_rotation(truth_from_estimate)
        return RotationErrors(
            angles_deg=np.degrees(rotation_angle_rad(truth_from_estimate)),
            offset_deg=float(np.degrees(rotation_angle_rad(mean))),
            spread_deg=np.degrees(rotation_angle_rad(mean.T @ truth_from_estimate)),
        )


def mean_rotation(rotations: Array) -> Array:
    """The chordal mean (3, 3) of rotations (N, 3, 3), N >= 1."""
    return np.asarray(Rotation.from_matrix(rotations).mean().as_matrix())
