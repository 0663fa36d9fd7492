"""SE(3) and Sim(3) values, rotations as 3x3 matrices, and Umeyama's alignment.

Transforms are named ``target_from_source`` and chain by matching inner names:
``map_from_cam = map_from_body @ body_from_cam``.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import InputError

Array = NDArray[np.float64]

# A level camera that looks forward: body x forward, y left, z up; cam x right, y down, z forward.
CAM_FROM_BODY = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])

_SMALL_RAD = 1e-3  # up to it, three terms of the series are exact to rounding
_SLACK = 1e-12 + 1e-5 * np.eye(3)  # how far R R^T may be off the identity and still be taken as it is


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
    angles = _length(vectors)
    squares, is_small = angles * angles, angles <= _SMALL_RAD
    series = 0.5 - squares / 48.0 + squares * squares / 3840.0
    per_rad = np.where(is_small, series, _each(math.sin, angles / 2.0) / np.where(is_small, 1.0, angles))
    return _rotations_from_unit(
        np.concatenate([per_rad[..., None] * vectors, _each(math.cos, angles / 2.0)[..., None]], axis=-1)
    )


def so3_log(rotations: Array) -> Array:
    """Rotation vectors (..., 3) in rad of rotation matrices (..., 3, 3)."""
    quat = quat_xyzw_from_rotations(rotations)
    angles = 2.0 * _each(math.atan2, _length(quat[..., :3]), quat[..., 3])
    squares, is_small = angles * angles, angles <= _SMALL_RAD
    series = 2.0 + squares / 12.0 + 7.0 * squares * squares / 2880.0
    rad_per = np.where(is_small, series, angles / np.where(is_small, 1.0, _each(math.sin, angles / 2.0)))
    return np.asarray(rad_per[..., None] * quat[..., :3])


def rotation_angle_rad(rotations: Array) -> Array:
    """Rotation angle (...,) in [0, pi] of rotation matrices (..., 3, 3)."""
    return np.asarray(np.linalg.norm(so3_log(rotations), axis=-1))


def rotations_from_quat_xyzw(quat_xyzw: Array) -> Array:
    """Rotation matrices (..., 3, 3) of quaternions (..., 4) in the order x, y, z, w, of any length but zero.

    Raises:
        InputError: one has no length.
    """
    quat = np.asarray(quat_xyzw, dtype=np.float64)
    lengths = _length(quat)
    if not np.all(lengths > 0.0):
        raise InputError("a quaternion of length zero turns nothing anywhere")
    return _rotations_from_unit(quat / lengths[..., None])


def quat_xyzw_from_rotations(rotations: Array) -> Array:
    """Quaternions (..., 4) in the order x, y, z, w with w >= 0, of rotation matrices (..., 3, 3).

    4 q q^T follows from the matrix without a root; its row with the largest square has the least rounding error.
    Source: S. W. Shepperd, "Quaternion from rotation matrix", J. Guidance and Control 1(3), 1978.
    """
    R = np.asarray(rotations, dtype=np.float64)
    is_off = np.any(np.abs(R @ np.swapaxes(R, -1, -2) - np.eye(3)) > _SLACK, axis=(-2, -1))
    if np.any(is_off):
        R = np.where(is_off[..., None, None], nearest_rotations(R), R)
    xx, yy, zz = R[..., 0, 0], R[..., 1, 1], R[..., 2, 2]
    xy, xz, yz = R[..., 1, 0] + R[..., 0, 1], R[..., 0, 2] + R[..., 2, 0], R[..., 2, 1] + R[..., 1, 2]
    xw, yw, zw = R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]
    trace = xx + yy + zz
    elements = [
        *(1.0 - trace + 2.0 * xx, xy, xz, xw),
        *(xy, 1.0 - trace + 2.0 * yy, yz, yw),
        *(xz, yz, 1.0 - trace + 2.0 * zz, zw),
        *(xw, yw, zw, 1.0 + trace),
    ]
    rows = np.stack(elements, axis=-1).reshape(*R.shape[:-2], 4, 4)
    largest = np.argmax(np.stack([xx, yy, zz, trace], axis=-1), axis=-1)
    quat = np.take_along_axis(rows, largest[..., None, None], axis=-2)[..., 0, :]
    quat = quat / _length(quat)[..., None]
    return np.asarray(np.where(quat[..., 3:] < 0.0, -quat, quat))


def interpolate_pose(first: Pose, second: Pose, fraction: float) -> Pose:
    """The pose at ``fraction`` in [0, 1] of the way: translation linear, rotation along the geodesic."""
    turn = so3_exp(fraction * so3_log(first.rotation.T @ second.rotation))
    translation_m = (1.0 - fraction) * first.translation_m + fraction * second.translation_m
    return Pose(first.rotation @ turn, translation_m)


def _rotations_from_unit(quat_xyzw: Array) -> Array:
    """Rotation matrices (..., 3, 3) of quaternions (..., 4) of length one."""
    x, y, z, w = (quat_xyzw[..., k] for k in range(4))
    xx, yy, zz, ww = x * x, y * y, z * z, w * w
    xy, xz, yz, xw, yw, zw = x * y, x * z, y * z, x * w, y * w, z * w
    elements = [
        *(xx - yy - zz + ww, 2.0 * (xy - zw), 2.0 * (xz + yw)),
        *(2.0 * (xy + zw), -xx + yy - zz + ww, 2.0 * (yz - xw)),
        *(2.0 * (xz - yw), 2.0 * (yz + xw), -xx - yy + zz + ww),
    ]
    return np.stack(elements, axis=-1).reshape(*quat_xyzw.shape[:-1], 3, 3)


def _length(vectors: Array) -> Array:
    """Of vectors (..., N), each (...,); summed one after the other, as SciPy does it."""
    squares = vectors[..., 0] * vectors[..., 0]
    for k in range(1, vectors.shape[-1]):
        squares = squares + vectors[..., k] * vectors[..., k]
    return np.asarray(np.sqrt(squares))


def _each(function: Callable[..., float], *values: Array) -> Array:
    """The C library's own sine and the like: numpy's of many at once may differ in the last bit."""
    flat = (value.ravel().tolist() for value in values)
    return np.array([function(*each) for each in zip(*flat, strict=True)]).reshape(values[0].shape)
