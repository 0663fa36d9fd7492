"""Surfaces as linear functions of the ray that looks at them.

Along a ray d from a centre of projection, a surface has an inverse distance i . d and texture coordinates
(S, T, W) = (s . d, t . d, w . d) up to scale; d hits it where 0 <= S, T <= W and the inverse distance is
positive. So texture, depth and outline of a surface agree to rounding, and nothing behind the camera disturbs.
(Edge functions on homogeneous coordinates: M. Olano, T. Greer, "Triangle Scan Conversion using 2D Homogeneous
Coordinates", Graphics Hardware 1997.)
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from fleetmap.geometry import Pose
from fleetmap.simulation.surfaces import Surfaces

Array = NDArray[np.float64]

S, T, W, INVERSE = 0, 1, 2, 3  # rows of a plane: texture coordinates, their denominator, inverse distance


def surfaces_in_cone(
    surfaces: Surfaces,
    centre_m: Array,
    axis: Array,
    *,
    widest_rad: float,
    smallest_rad: float = 0.0,
    slack_m: float = 0.0,
    farthest_m: float = np.inf,
) -> tuple[NDArray[np.int64], Array]:
    """Indices (M,) of surfaces that may be seen within an angle of an axis, and how near (M,) they are at least.

    Left out: what is further from the axis than ``widest_rad``, further away than ``farthest_m``, and what looks
    smaller than ``smallest_rad``. ``slack_m`` lets the camera move. The nearest come first.
    """
    limits = (float(widest_rad), float(smallest_rad), float(slack_m), float(farthest_m))
    centre, direction = (np.array(a, np.float64, order="C") for a in (centre_m, axis))
    distance = _distances_in_cone(surfaces.corners_in_map, centre, direction, limits)
    found = np.flatnonzero(np.isfinite(distance))
    found = found[np.argsort(distance[found], kind="stable")]
    return found, distance[found]


@njit(cache=True, nogil=True, error_model="numpy")
def _distances_in_cone(corners: Any, centre: Any, axis: Any, limits: Any) -> Any:
    """Distance (Q,) to each surface's bounding sphere; infinite where that is out of the cone."""
    widest, smallest, slack, farthest = limits
    distances = np.full(len(corners), np.inf)
    for q in range(len(corners)):
        x = 0.25 * (corners[q, 0, 0] + corners[q, 1, 0] + corners[q, 2, 0] + corners[q, 3, 0])
        y = 0.25 * (corners[q, 0, 1] + corners[q, 1, 1] + corners[q, 2, 1] + corners[q, 3, 1])
        z = 0.25 * (corners[q, 0, 2] + corners[q, 1, 2] + corners[q, 2, 2] + corners[q, 3, 2])
        square = 0.0
        for i in range(4):
            dx, dy, dz = corners[q, i, 0] - x, corners[q, i, 1] - y, corners[q, i, 2] - z
            square = max(square, dx * dx + dy * dy + dz * dz)
        radius = np.sqrt(square) + slack
        x, y, z = x - centre[0], y - centre[1], z - centre[2]
        distance = np.sqrt(x * x + y * y + z * z)
        if distance > radius:
            if radius < smallest * distance or distance - radius > farthest:
                continue
            cosine = (x * axis[0] + y * axis[1] + z * axis[2]) / distance
            if np.arccos(min(max(cosine, -1.0), 1.0)) > widest + np.arcsin(radius / distance):
                continue
        distances[q] = max(distance - radius, 0.0)
    return distances


def planes_in_cam(
    surfaces: Surfaces, ids: NDArray[np.int64], poses: Sequence[Pose], dtype: type[np.floating[Any]] = np.float32
) -> NDArray[Any]:
    """Planes (P, M, 4, 3): what the surfaces ``ids`` are along rays in a sensor's frame, at each ``map_from_cam``.

    A pose may be mirrored. Surfaces that are turned away or seen from their edge get zeros, which nothing hits.
    """
    corners, two_sided = surfaces.corners_in_map[ids], surfaces.two_sided[ids]
    planes = np.empty((len(poses), len(ids), 4, 3), dtype=dtype)
    for pose, planes_of_pose in zip(poses, planes, strict=True):
        # Of one memory layout, whatever the caller's: each layout would be compiled again.
        rotation, centre = (np.array(a, np.float64, order="C") for a in (pose.rotation, pose.translation_m))
        _fill_planes(corners, two_sided, rotation, centre, planes_of_pose)
    return planes


@njit(cache=True, nogil=True, error_model="numpy")
def _fill_planes(corners: Any, two_sided: Any, map_from_cam: Any, centre: Any, planes: Any) -> None:
    """Of corners (M, 4, 3) at one pose; ``map_from_cam`` (3, 3) turns the rays, ``centre`` (3,) is their start.

    A point of a surface is P + u e1 + v e2 with its first corner P and two of its edges; P. Heckbert,
    "Fundamentals of Texture Mapping and Image Warping", 1989, section 2.2.3, gives the texture from u and v.
    """
    for m in range(len(corners)):
        planes[m] = 0.0
        first = _minus(corners[m, 0], centre)
        right, below = _minus(corners[m, 1], corners[m, 0]), _minus(corners[m, 3], corners[m, 0])
        normal = _cross(below, right)
        height = _dot(normal, first)
        clearly = 1e-9 * np.sqrt(_dot(normal, normal))
        if not (height < -clearly or (two_sided[m] and height > clearly)):
            continue
        along_u, along_v = _cross(below, normal), _cross(normal, right)
        along_u = _times(along_u, 1.0 / _dot(along_u, right))
        along_v = _times(along_v, 1.0 / _dot(along_v, below))
        diagonal = _minus(corners[m, 2], corners[m, 0])
        a, b = _dot(along_u, diagonal), _dot(along_v, diagonal)
        per_u, per_v = (a + b - 1.0) / a, (a + b - 1.0) / b
        inverse = _times(normal, 1.0 / height)
        s, t = _times(along_u, per_u), _times(along_v, per_v)
        w = _plus(_times(along_u, per_u - 1.0), _times(along_v, per_v - 1.0))
        rows = (
            _plus(s, _times(inverse, -_dot(s, first))),
            _plus(t, _times(inverse, -_dot(t, first))),
            _plus(w, _times(inverse, 1.0 - _dot(w, first))),
            inverse,
        )
        for row in range(4):
            for axis in range(3):
                planes[m, row, axis] = _dot(rows[row], map_from_cam[:, axis])


@njit(cache=True, nogil=True, inline="always")
def _dot(a: Any, b: Any) -> Any:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True, nogil=True, inline="always")
def _cross(a: Any, b: Any) -> Any:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@njit(cache=True, nogil=True, inline="always")
def _minus(a: Any, b: Any) -> Any:
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


@njit(cache=True, nogil=True, inline="always")
def _plus(a: Any, b: Any) -> Any:
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


@njit(cache=True, nogil=True, inline="always")
def _times(a: Any, factor: Any) -> Any:
    return (a[0] * factor, a[1] * factor, a[2] * factor)
