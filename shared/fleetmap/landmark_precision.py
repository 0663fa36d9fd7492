"""How exact each landmark is, given the keyframes that observed it: across its mean viewing ray, and along it.

A landmark's information is the sum of J^T J / sigma^2 over its observations, J the derivative of the pixel by the
point; its inverse is the covariance. Poses count as known: what is uncertain about them stands in the covariances
of the keyframes. Sources: R. Hartley, A. Zisserman, "Multiple View Geometry", 2nd ed., 2004, section 5.2;
B. Triggs et al., "Bundle adjustment - a modern synthesis", 2000, section 6.1.

A corner found on octave n is exact to about scale_factor ** n pixels, times a factor that residuals tell: the
median of all tracks, drawn towards the track's own residuals the more of them there are (as in an empirical Bayes
estimate of variances: G. K. Smyth, "Linear models and empirical Bayes methods", 2004, section 3). Errors along a
track resemble each other and weigh less for it: see fleetmap.track_correlation.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fleetmap.track_correlation import track_correlation, track_lengths, variance_inflation
from fleetmap.visual_map import VisualMap

Array = NDArray[np.float64]

SCALE_FACTOR = 1.2  # between octaves
_MEDIAN_2DOF = 1.386  # of chi-square with 2 degrees of freedom
_MIN_OBSERVATIONS = 100  # fewer residuals tell no noise
_LEAST_FACTOR = 0.05
_FREEDOMS_OF_USUAL = 4.0  # what the median of all tracks weighs against the track's own residuals
_MIN_DEPTH_M = 1e-2
_WEAKEST_M = 1e3  # what is known of a landmark without any observation


def with_precision(visual_map: VisualMap) -> VisualMap:
    """The same map with ``Landmarks.sigmas_m``."""
    landmarks = visual_map.landmarks
    if landmarks.sigmas_m is not None:
        return visual_map
    return replace(visual_map, landmarks=replace(landmarks, sigmas_m=landmark_sigmas_m(visual_map)))


def landmark_sigmas_m(visual_map: VisualMap) -> NDArray[np.float32]:
    """Standard deviations (N, 2) float32 across and along ``normals``; across in the mean of its directions."""
    observations = visual_map.observations
    index = observations.landmark_index
    errors_px, jacobians = _linearised(visual_map)
    sigmas_px = SCALE_FACTOR ** observations.octaves.astype(np.float64)
    errors = errors_px / sigmas_px[:, None]
    correlation = track_correlation(errors / _usual_factor(errors, index), observations.keyframe_index, index)
    sigmas_px *= _factors(errors, index) * np.sqrt(variance_inflation(track_lengths(index), correlation))
    whitened = jacobians / sigmas_px[:, None, None]
    information = np.zeros((len(visual_map.landmarks), 9))
    shares = np.einsum("mri,mrj->mij", whitened, whitened).reshape(-1, 9)
    for entry in range(9):
        information[:, entry] = np.bincount(index, shares[:, entry], len(information))
    covariances = np.linalg.inv(information.reshape(-1, 3, 3) + np.eye(3) / _WEAKEST_M**2)
    rays = visual_map.landmarks.normals.astype(np.float64)
    along = np.einsum("ni,nij,nj->n", rays, covariances, rays)
    across = (np.trace(covariances, axis1=1, axis2=2) - along) / 2.0
    return np.asarray(np.sqrt(np.stack([across, along], axis=1).clip(0.0)), dtype=np.float32)


def _linearised(visual_map: VisualMap) -> tuple[Array, Array]:
    """Reprojection errors (M, 2) and their derivatives (M, 2, 3) by the points, in map; 0 behind the camera."""
    observations, camera = visual_map.observations, visual_map.camera
    cam_from_map = visual_map.keyframes.rotations.transpose(0, 2, 1)[observations.keyframe_index]
    rays_m = (
        visual_map.landmarks.points_m[observations.landmark_index]
        - visual_map.keyframes.positions_m[observations.keyframe_index]
    )
    x, y, z = np.einsum("mij,mj->im", cam_from_map, rays_m)
    in_front = z > _MIN_DEPTH_M
    z = np.where(in_front, z, np.inf)
    focal_px = np.array([camera.fx_px, camera.fy_px])
    in_image = np.stack([x / z, y / z], axis=1)
    errors_px = in_image * focal_px + [camera.cx_px, camera.cy_px] - observations.pixels
    by_point = cam_from_map[:, :2] - in_image[:, :, None] * cam_from_map[:, None, 2]
    by_point *= focal_px[:, None] / z[:, None, None]
    return np.where(in_front[:, None], errors_px, 0.0), by_point


def _factors(errors: Array, landmark_index: NDArray[np.int32]) -> Array:
    """How much larger the errors (M, 2) of an observation's track are than the sigmas they count in, (M,)."""
    usual = _usual_factor(errors, landmark_index)
    squares = np.bincount(landmark_index, (errors**2).sum(axis=1))
    freedoms = np.maximum(2 * np.bincount(landmark_index) - 3, 0)
    variances = (_FREEDOMS_OF_USUAL * usual**2 + squares) / (_FREEDOMS_OF_USUAL + freedoms)
    return np.asarray(np.sqrt(variances)[landmark_index])


def _usual_factor(errors: Array, landmark_index: NDArray[np.int32]) -> float:
    """The same for all of them, by the median. A track's own point takes three of its 2 n residuals."""
    counts = track_lengths(landmark_index)
    usable = counts > 2
    if np.count_nonzero(usable) < _MIN_OBSERVATIONS:
        return 1.0
    chi2 = (errors[usable] ** 2).sum(axis=1) * 2 * counts[usable] / (2 * counts[usable] - 3)
    return max(float(np.sqrt(np.median(chi2) / _MEDIAN_2DOF)), _LEAST_FACTOR)
