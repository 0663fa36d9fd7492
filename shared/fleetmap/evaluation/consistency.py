"""Whether poses are as good as their covariances claim: the normalised estimation error squared (NEES).

Source: Y. Bar-Shalom, X. R. Li, T. Kirubarajan, "Estimation with Applications to Tracking and Navigation", 2001,
section 5.4.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaincinv

from fleetmap.covariances import PoseCovariances
from fleetmap.errors import InputError, TrajectoryError
from fleetmap.evaluation.association import associate
from fleetmap.evaluation.trajectory_errors import TrajectoryErrors

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

_SAME_STAMP_NS = 1_000  # TUM text keeps microseconds
_TRANSLATION = slice(3, 6)  # of the tangent [rotation, translation]


@dataclass(frozen=True)
class Nees:
    """NEES of N poses. A consistent estimator's mean is ``dof``; above it, the covariances promise too much."""

    values: Array  # (N,)
    dof: int

    @property
    def mean(self) -> float:
        """The mean, to be held against ``dof`` and ``band_95``."""
        return float(self.values.mean())

    @property
    def inside_95(self) -> float:
        """The share of poses whose truth lies inside their own 95 % ellipsoid."""
        return float((self.values <= chi_square_quantile(0.95, self.dof)).mean())

    @property
    def band_95(self) -> tuple[float, float]:
        """Where the mean of N independent consistent poses would lie 95 times in 100 (eq. 5.4.2-7).

        Errors of neighbouring poses are alike, so the true band is wider; the bootstrap interval sees that.
        """
        low, high = (chi_square_quantile(share, self.dof * len(self.values)) for share in (0.025, 0.975))
        return low / len(self.values), high / len(self.values)

    def to_json(self) -> dict[str, Any]:
        """The figures as plain values."""
        return {"dof": self.dof, "mean": self.mean, "inside_95": self.inside_95, "band_95": list(self.band_95)}


@dataclass(frozen=True)
class Consistency:
    """NEES of the compared poses that have a covariance."""

    rows: Indices  # (K,) which of the compared poses those are
    pose: Nees  # rotation and translation, 6 degrees of freedom
    position: Nees  # translation alone, 3 degrees of freedom

    def to_json(self) -> dict[str, Any]:
        """The figures as plain values."""
        return {"count": len(self.rows), "pose": self.pose.to_json(), "position": self.position.to_json()}


def evaluate_consistency(errors: TrajectoryErrors, covariances: PoseCovariances) -> Consistency | None:
    """NEES of compared poses with the covariance of the same stamp; None where only positions were compared.

    An alignment with scale also scales the covariances' translations.

    Raises:
        TrajectoryError: no compared pose has a covariance.
    """
    if errors.tangents is None:
        return None
    rows, of_covariances = associate(errors.stamps_ns, covariances.stamps_ns, _SAME_STAMP_NS)
    if len(rows) == 0:
        raise TrajectoryError(
            f"none of {len(covariances.stamps_ns)} covariances has the stamp of a compared pose; "
            "do they belong to this trajectory?"
        )
    units = np.ones(6)
    units[_TRANSLATION] = 1.0 if errors.scale is None else errors.scale
    matrices = covariances.matrices[of_covariances] * np.outer(units, units)
    tangents = errors.tangents[rows]
    positions, position_matrices = tangents[:, _TRANSLATION], matrices[:, _TRANSLATION, _TRANSLATION]
    return Consistency(
        rows=rows,
        pose=Nees(normalised_estimation_error_squared(tangents, matrices), dof=6),
        position=Nees(normalised_estimation_error_squared(positions, position_matrices), dof=3),
    )


def normalised_estimation_error_squared(errors: Array, covariances: Array) -> Array:
    """e^T P^-1 e (N,) of errors (N, D) and their covariances (N, D, D) (eq. 5.4.2-1).

    For poses D is 6 and the order is that of the localizer's covariance, [rotation (rad), translation (m)] in
    the estimated camera's frame, as in TrajectoryErrors.tangents; for positions alone, its last three.

    Raises:
        InputError: a covariance that is not positive definite.
    """
    try:
        np.linalg.cholesky(covariances)
    except np.linalg.LinAlgError as error:
        raise InputError("a covariance is not positive definite, so nothing can be normalised by it") from error
    return np.asarray(np.einsum("nd,nd->n", errors, np.linalg.solve(covariances, errors[..., None])[..., 0]))


def chi_square_quantile(share: float, dof: int) -> float:
    """The value that chi-square with ``dof`` degrees of freedom stays below with probability ``share``."""
    return float(2.0 * gammaincinv(0.5 * dof, share))
