"""SE(3) and Sim(3) values, rotations as 3x3 matrices, and Umeyama's alignment.

Transforms are named ``target_from_source`` and chain by matching inner names:
``map_from_cam = map_from_body @ body_from_cam``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import InputError

Array = NDArray[np.float64]

# A level camera that looks forward: body x forward, y left, z up; cam x right, y down, z forward.
CAM_FROM_BODY = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])

_SMALL_RAD = 1e-3  # below it, two terms of the series are exact to rounding


@dataclass(frozen=True)
class Pose:
    """A rigid transform ``target_from_source``: x_target = rotation @ x_source + translation_m."""

    rotation: Array  # (3, 3) float64
    translation_m: Array  # (3,) float64

    @staticmethod
    def identity() -> Pose:
        """The transform that changes nothing."""
        return Pose(np.eye(3), np.zeros(3))

    def __matmul__(self, other: Pose) -> Pose:
        return Pose(self.rotation @ other.rotation, self.rotation @ other.translation_m + self.translation_m)

    def inverse(self) -> Pose:
        """``source_from_target``."""
        return Pose(self.rotation.T, -self.rotation.T @ self.translation_m)

    def transform(self, points: Array) -> Array:
        """Points (..., 3) of the source frame, in the target frame."""
        return points @ self.rotation.T + self.translation_m

    def adjoint(self) -> Array:
        """Ad (6, 6): ``self @ exp(xi) == exp(Ad xi) @ self`` for tangents xi = [rotation, translation].

        Source: T. Barfoot, "State Estimation for Robotics", 2017, section 7.1.4.
        """
        x, y, z = self.translation_m
        crossed = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]) @ self.rotation
        return np.block([[self.rotation, np.zeros((3, 3))], [crossed, self.rotation]])


@dataclass(frozen=True)
class Sim3:
    """A similarity ``target_from_source``: x_target = scale * rotation @ x_source + translation_m."""

    scale: float
    rotation: Array  # (3, 3) float64
    translation_m: Array  # (3,) float64

    @staticmethod
    def identity() -> Sim3:
        """The transform that changes nothing."""
        return Sim3(1.0, np.eye(3), np.zeros(3))

    def __matmul__(self, other: Sim3) -> Sim3:
        return Sim3(
            self.scale * other.scale,
            self.rotation @ other.rotation,
            self.scale * self.rotation @ other.translation_m + self.translation_m,
        )

    def inverse(self) -> Sim3:
        """``source_from_target``."""
        return Sim3(1.0 / self.scale, self.rotation.T, -self.rotation.T @ self.translation_m / self.scale)

    def transform(self, points: Array) -> Array:
        """Points (..., 3) of the source frame, in the target frame."""
        return self.scale * points @ self.rotation.T + self.translation_m

    def transform_pose(self, pose: Pose) -> Pose:
        """A camera pose of the source frame, in the target frame; cameras keep their own unit scale."""
        return Pose(self.rotation @ pose.rotation, self.transform(pose.translation_m))


def umeyama_alignment(source: Array, target: Array, with_scale: bool = True) -> Sim3:
    """The Sim(3) that maps ``source`` (N, 3) onto ``target`` (N, 3) with least squared error.

    Source: S. Umeyama, "Least-squares estimation of transformation parameters between two point
    patterns", PAMI 13(4), 1991, eq. 38-43.

    Raises:
        InputError: fewer than three points, or all of them on one spot.
    """
    if source.shape != target.shape or source.ndim != 2 or source.shape[1] != 3 or len(source) < 3:
        raise InputError(f"alignment needs two lists of at least 3 points, got {source.shape}, {target.shape}")
    source_mean, target_mean = source.mean(axis=0), target.mean(axis=0)
    source_centred, target_centred = source - source_mean, target - target_mean
    source_variance = float((source_centred**2).sum() / len(source))
    if source_variance < 1e-18:
        raise InputError("alignment needs points that move; all source points lie on one spot")
    U, singular, Vt = np.linalg.svd(target_centred.T @ source_centred / len(source))  # eq. 38
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(U) * np.linalg.det(Vt))])  # eq. 39, 43
    rotation = U @ np.diag(signs) @ Vt  # eq. 40
    scale = float(singular @ signs / source_variance) if with_scale else 1.0  # eq. 42
    return Sim3(scale, rotation, target_mean - scale * rotation @ source_mean)  # eq. 41


def nearest_rotations(matrices: Array) -> Array:
    """The rotation matrices (..., 3, 3) nearest to almost-rotations; long products drift off SO(3) and grow."""
    U, _, Vt = np.linalg.svd(matrices)
    return np.asarray(U @ Vt)


def so3_exp(rotation_vectors_rad: Array) -> Array:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3)."""
    vectors = np.asarray(rotation_vectors_rad, dtype=np.float64)
    angles = np.sqrt((vectors * vectors).sum(axis=-1, keepdims=True))
    is_small = angles < _SMALL_RAD
    per_rad = np.where(is_small, 0.5 - angles**2 / 48.0, np.sin(angles / 2.0) / np.where(is_small, 1.0, angles))
    return rotations_from_quat_xyzw(np.concatenate([per_rad * vectors, np.cos(angles / 2.0)], axis=-1))


def so3_log(rotations: Array) -> Array:
    """Rotation vectors (..., 3) in rad of rotation matrices (..., 3, 3)."""
    quat_xyzw = quat_xyzw_from_rotations(rotations)
    sines = np.sqrt((quat_xyzw[..., :3] ** 2).sum(axis=-1, keepdims=True))
    is_small = sines < _SMALL_RAD
    angles = 2.0 * np.arctan2(sines, quat_xyzw[..., 3:])
    rad_per = np.where(is_small, 2.0 + sines**2 / 3.0, angles / np.where(is_small, 1.0, sines))
    return np.asarray(rad_per * quat_xyzw[..., :3])


def rotation_angle_rad(rotations: Array) -> Array:
    """Rotation angle (...,) in [0, pi] of rotation matrices (..., 3, 3)."""
    return np.asarray(np.linalg.norm(so3_log(rotations), axis=-1))


def rotations_from_quat_xyzw(quat_xyzw: Array) -> Array:
    """Rotation matrices (..., 3, 3) of quaternions (..., 4) in the order x, y, z, w, of any length but zero.

    Raises:
        InputError: one has no length.
    """
    quat = np.asarray(quat_xyzw, dtype=np.float64)
    lengths = np.sqrt((quat * quat).sum(axis=-1, keepdims=True))
    if not np.all(lengths > 0.0):
        raise InputError("a quaternion of length zero turns nothing anywhere")
    quat = quat / lengths
    products = (quat[..., :, None] * quat[..., None, :]).reshape(*quat.shape[:-1], 16)
    return np.asarray((products @ _QUATERNION_PRODUCTS.T).reshape(*quat.shape[:-1], 3, 3))


def quat_xyzw_from_rotations(rotations: Array) -> Array:
    """Quaternions (..., 4) in the order x, y, z, w with w >= 0, of rotation matrices (..., 3, 3).

    4 q q^T follows from the matrix without a root; its row with the largest square has the least rounding error.
    Source: S. W. Shepperd, "Quaternion from rotation matrix", J. Guidance and Control 1(3), 1978.
    """
    R = np.asarray(rotations, dtype=np.float64)
    products = np.eye(4) + (R.reshape(*R.shape[:-2], 9) @ _QUATERNION_PRODUCTS).reshape(*R.shape[:-2], 4, 4)
    largest = np.argmax(np.diagonal(products, axis1=-2, axis2=-1), axis=-1)
    quat = np.take_along_axis(products, largest[..., None, None], axis=-2)[..., 0, :]
    quat = quat / np.sqrt((quat * quat).sum(axis=-1, keepdims=True))
    return np.asarray(np.where(quat[..., 3:] < 0.0, -quat, quat))


def interpolate_pose(first: Pose, second: Pose, fraction: float) -> Pose:
    """The pose at ``fraction`` in [0, 1] of the way: translation linear, rotation along the geodesic."""
    turn = so3_exp(fraction * so3_log(first.rotation.T @ second.rotation))
    translation_m = (1.0 - fraction) * first.translation_m + fraction * second.translation_m
    return Pose(first.rotation @ turn, translation_m)


def _quaternion_products() -> Array:
    """C (9, 16): the elements of R are C vec(q q^T), and vec(4 q q^T) = vec(I) + C^T vec(R)."""
    w = 3
    C = np.zeros((3, 3, 4, 4))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        C[i, i] = np.diag([1.0 if a in (i, w) else -1.0 for a in range(4)])
        C[i, j, [i, j], [j, i]] = C[j, i, [i, j], [j, i]] = 1.0
        C[i, j, [k, w], [w, k]], C[j, i, [k, w], [w, k]] = -1.0, 1.0
    return C.reshape(9, 16)


_QUATERNION_PRODUCTS = _quaternion_products()
