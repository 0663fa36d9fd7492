"""How sure a pose is: what the image leaves open relative to the map, and what the map itself leaves open."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fleetmap_localizer.relocalization import Located

Array = NDArray[np.float64]

_UNKNOWN = np.diag([1.0] * 3 + [300.0**2] * 3)  # rad^2 and m^2: of a map that no fix places


def pose_covariance(located: Located) -> Array:
    """Covariance (6, 6) of the tangent [rotation (rad), translation (m)] in the camera's frame, in UTM.

    The two parts are independent: the first comes of this image, the second of the survey. A map whose writer did
    not say how sure it is counts as true; its poses are as sure as they are relative to it.
    """
    return located.fit.answer.covariance + map_covariance(located)


def map_covariance(located: Located) -> Array:
    """What the map's own pose here may be off, (6, 6) in the query camera's frame.

    Near a keyframe the map moves as one with it. The keyframe nearest to the pose among those that saw the
    landmarks stands for it: T_q exp(xi_q) = T_k exp(xi_k) T_k^-1 T_q, so xi_q = Ad(T_q^-1 T_k) xi_k.
    """
    content, fit = located.view.content, located.fit
    keyframes, pose = content.keyframes, fit.answer.map_from_cam
    if keyframes.covariances is None:
        return np.zeros((6, 6))
    is_inlier = np.zeros(len(content.landmarks), np.bool_)
    is_inlier[fit.landmarks[fit.answer.inliers]] = True
    observers = np.unique(content.seen_by_keyframe[is_inlier[content.seen_landmark]])
    known = observers[np.isfinite(keyframes.covariances[observers, 0, 0])]
    if len(known) == 0:
        return _UNKNOWN
    away_m = np.linalg.norm(keyframes.positions_m[known] - pose.translation_m, axis=1)
    nearest = int(known[np.argmin(away_m)])
    adjoint = (pose.inverse() @ keyframes.pose(nearest)).adjoint()
    return np.asarray(adjoint @ keyframes.covariances[nearest].astype(np.float64) @ adjoint.T)
