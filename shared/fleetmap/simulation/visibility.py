"""Which surface each pixel sees: a z-buffer on planes, tile by tile.

Everything is linear: along a viewing ray d from the camera's centre, a surface has an inverse distance w = i . d and
texture coordinates (S, T, W) = (s . d, t . d, w' . d) up to scale, and d hits it where 0 <= S, T <= W and w > 0. So
texture, depth and outline of a surface agree to rounding, nothing needs to be cut at a near plane, and any lens
works: it is only a table of rays. (Edge functions on homogeneous coordinates: M. Olano, T. Greer, "Triangle Scan
Conversion using 2D Homogeneous Coordinates", Graphics Hardware 1997.)
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from fleetmap.simulation.rays import TILE_PIXELS
from fleetmap.simulation.surfaces import Surfaces

Array = NDArray[np.float64]
Plane = Any  # what numba infers

NOTHING = -1  # the index of the sky
S, T, W, INVERSE = 0, 1, 2, 3  # rows of a plane: texture coordinates, their denominator, inverse distance
_SMALLEST_RADIUS_PX = 0.35  # surfaces that look smaller than this are left out
_MIP_BIAS = np.float32(1.0)


def surfaces_in_cone(
    surfaces: Surfaces, centre_m: Array, axis: Array, widest_rad: float, smallest_rad: float, slack_m: float = 0.0
) -> NDArray[np.int64]:
    """Indices (M,) of surfaces that may be seen within an angle of an axis, nearest centre first.

    Left out: what is further from the axis than ``widest_rad``, and what looks smaller than ``smallest_rad``.
    ``slack_m`` lets the camera move.
    """
    distance = _distances_in_cone(
        surfaces.corners_in_map, centre_m, axis, float(widest_rad), float(smallest_rad), float(slack_m)
    )
    found = np.flatnonzero(np.isfinite(distance))
    return found[np.argsort(distance[found], kind="stable")]


def smallest_angle_rad(px_per_rad: float) -> float:
    """The angle below which a surface is smaller than a pixel."""
    return _SMALLEST_RADIUS_PX / px_per_rad


@njit(cache=True, nogil=True, error_model="numpy")
def _distances_in_cone(corners: Array, centre: Array, axis: Array, widest: float, smallest: float, slack: float) -> Any:
    """Distance (Q,) to the middle of each surface; infinite where its bounding sphere is out of the cone."""
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
            if radius < smallest * distance:
                continue
            cosine = (x * axis[0] + y * axis[1] + z * axis[2]) / distance
            if np.arccos(min(max(cosine, -1.0), 1.0)) > widest + np.arcsin(radius / distance):
                continue
        distances[q] = distance
    return distances


@njit(cache=True, nogil=True, error_model="numpy")
def planes_in_cam(corners: Array, two_sided: Any, map_from_cam: Array, centre: Array, planes: Any) -> None:
    """Fill ``planes`` (M, 4, 3) float32: rows S, T, W and inverse distance of surfaces (M, 4, 3) seen from ``centre``.

    A point of the surface is P + u e1 + v e2 with its first corner P and two of its edges; P. Heckbert,
    "Fundamentals of Texture Mapping and Image Warping", 1989, section 2.2.3, gives texture from u, v. Surfaces
    that are turned away or seen from their edge get zeros, which nothing hits.
    """
    for m in range(len(corners)):
        planes[m] = 0.0
        first = corners[m, 0] - centre
        right, below = corners[m, 1] - corners[m, 0], corners[m, 3] - corners[m, 0]
        normal = np.cross(below, right)
        area2 = (normal * normal).sum()
        height = (normal * first).sum()
        if not (height < -1e-9 * np.sqrt(area2) or (two_sided[m] and height > 1e-9 * np.sqrt(area2))):
            continue
        along_u, along_v = np.cross(right, normal) * 0.0, np.cross(normal, right) / area2
        along_u = np.cross(below, normal) / area2
        along_u *= 1.0 / (along_u * right).sum()
        along_v *= 1.0 / (along_v * below).sum()
        diagonal = corners[m, 2] - corners[m, 0]
        a, b = (along_u * diagonal).sum(), (along_v * diagonal).sum()
        s_of_u, t_of_v = (a + b - 1.0) / a, (a + b - 1.0) / b
        inverse = normal / height
        row_s, row_t = along_u * s_of_u, along_v * t_of_v
        row_w = -(1.0 - s_of_u) * along_u - (1.0 - t_of_v) * along_v
        row_s = row_s - (row_s * first).sum() * inverse
        row_t = row_t - (row_t * first).sum() * inverse
        row_w = row_w + (1.0 - (row_w * first).sum()) * inverse
        for axis in range(3):
            column = map_from_cam[:, axis]
            planes[m, S, axis] = (row_s * column).sum()
            planes[m, T, axis] = (row_t * column).sum()
            planes[m, W, axis] = (row_w * column).sum()
            planes[m, INVERSE, axis] = (inverse * column).sum()


@njit(cache=True, nogil=True, error_model="numpy")
def bin_surfaces(planes: Any, low: Any, high: Any, lists: Any, counts: Any) -> None:
    """Sort planes (M, 4, 3) into the tiles of a band: ``lists`` (T, M) and their lengths ``counts`` (T,)."""
    counts[:] = 0
    band_low, band_high = low[0].copy(), high[0].copy()
    for tile in range(1, len(low)):
        band_low, band_high = np.minimum(band_low, low[tile]), np.maximum(band_high, high[tile])
    for m in range(len(planes)):
        if _may_hit(planes[m], band_low, band_high):
            for tile in range(len(low)):
                if _may_hit(planes[m], low[tile], high[tile]):
                    lists[tile, counts[tile]] = m
                    counts[tile] += 1


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _highest(a: Any, b: Any, c: Any, low: Any, high: Any) -> Any:
    """The largest value of (a, b, c) . d in a box of rays."""
    return (
        max(a * low[0], a * high[0]) + max(b * low[1], b * high[1]) + max(c * low[2], c * high[2])
    )


@njit(cache=True, nogil=True, error_model="numpy")
def _may_hit(plane: Any, low: Any, high: Any) -> bool:
    """False only when no ray of a box (components between ``low`` and ``high``) hits the surface."""
    if not _highest(plane[INVERSE, 0], plane[INVERSE, 1], plane[INVERSE, 2], low, high) > 0.0:
        return False
    for row in range(2):
        a, b, c = plane[row, 0], plane[row, 1], plane[row, 2]
        if not _highest(a, b, c, low, high) >= 0.0:
            return False
        if not _highest(plane[W, 0] - a, plane[W, 1] - b, plane[W, 2] - c, low, high) >= 0.0:
            return False
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def see_tile(
    planes: Any, texture_of: Any, members: Any, rays: Any, shifts: Any, low: Any, high: Any, opacity: Any,
    nearest: Any, seen: Any, values: Any,
) -> None:
    """What each sample of a tile sees.

    Args:
        planes: (M, 4, 3) of all surfaces.
        texture_of: (M,) their textures.
        members: (N,) those that may be in this tile, nearest first.
        rays: (3, TILE_PIXELS) of the pixel centres.
        shifts: (K, 3) what a sample's place beside the centre adds to the ray.
        low: (3,) smallest components of the rays.
        high: (3,) largest components.
        opacity: see Opacity in fleetmap.simulation.atlas.
        nearest: (K, TILE_PIXELS) float32, filled with inverse distances.
        seen: (K, TILE_PIXELS) int32, filled with indices of planes, or NOTHING.
        values: (4, TILE_PIXELS) float32, room to work.
    """
    nearest[:] = np.float32(0.0)
    seen[:] = np.int32(NOTHING)
    farthest = np.float32(0.0)
    for member in members:
        plane = planes[member]
        if _highest(plane[INVERSE, 0], plane[INVERSE, 1], plane[INVERSE, 2], low, high) <= farthest:
            continue
        for row in range(4):
            a, b, c = plane[row, 0], plane[row, 1], plane[row, 2]
            for p in range(TILE_PIXELS):
                values[row, p] = a * rays[0, p] + b * rays[1, p] + c * rays[2, p]
        transparent = opacity.level_starts[texture_of[member], 0] >= 0
        for k in range(len(shifts)):
            shift = shifts[k]
            ds = plane[S, 0] * shift[0] + plane[S, 1] * shift[1] + plane[S, 2] * shift[2]
            dt = plane[T, 0] * shift[0] + plane[T, 1] * shift[1] + plane[T, 2] * shift[2]
            dw = plane[W, 0] * shift[0] + plane[W, 1] * shift[1] + plane[W, 2] * shift[2]
            di = plane[INVERSE, 0] * shift[0] + plane[INVERSE, 1] * shift[1] + plane[INVERSE, 2] * shift[2]
            if transparent:
                _cover_opaque_part(member, values, ds, dt, dw, di, texture_of[member], opacity, nearest[k], seen[k])
            else:
                _cover(member, values, ds, dt, dw, di, nearest[k], seen[k])
        farthest = nearest.min()


@njit(cache=True, nogil=True, error_model="numpy")
def _cover(member: Any, values: Any, ds: Any, dt: Any, dw: Any, di: Any, nearest: Any, seen: Any) -> None:
    """Put a surface into the z-buffer; written without branches, so that it compiles to vector instructions."""
    for p in range(TILE_PIXELS):
        s, t = values[S, p] + ds, values[T, p] + dt
        w, inverse = values[W, p] + dw, values[INVERSE, p] + di
        hit = (s >= 0.0) & (t >= 0.0) & (w >= s) & (w >= t) & (inverse > nearest[p])
        nearest[p] = inverse if hit else nearest[p]
        seen[p] = member if hit else seen[p]


@njit(cache=True, nogil=True, error_model="numpy")
def _cover_opaque_part(
    member: Any, values: Any, ds: Any, dt: Any, dw: Any, di: Any, texture: Any, opacity: Any, nearest: Any, seen: Any
) -> None:
    """The same for a see-through surface: only where its texture is solid."""
    level = -1
    for p in range(TILE_PIXELS):
        s, t = values[S, p] + ds, values[T, p] + dt
        w, inverse = values[W, p] + dw, values[INVERSE, p] + di
        if s >= 0.0 and t >= 0.0 and w >= s and w >= t and inverse > nearest[p] and w > 0.0:
            if level < 0:
                q = p + 1 if (p + 1) % 32 else p - 1
                other_t = (values[T, q] + dt) / (values[W, q] + dw)
                other_s = (values[S, q] + ds) / (values[W, q] + dw)
                level = opacity_level(opacity, texture, abs(other_s - s / w), abs(other_t - t / w))
            if is_opaque(opacity, texture, level, s / w, t / w):
                nearest[p] = inverse
                seen[p] = member


@njit(cache=True, nogil=True, error_model="numpy")
def opacity_level(opacity: Any, texture: Any, step_s: Any, step_t: Any) -> int:
    """The level of a see-through texture that fits steps of texture coordinates from pixel to pixel."""
    texels = max(step_s * opacity.level_sizes[texture, 0, 0], step_t * opacity.level_sizes[texture, 0, 1])
    level = 0
    while texels >= 2.0 and level < opacity.level_starts.shape[1] - 1:
        texels *= 0.5
        level += 1
    return level


@njit(cache=True, nogil=True, error_model="numpy")
def is_opaque(opacity: Any, texture: Any, level: Any, s: Any, t: Any) -> bool:
    """Whether a see-through texture is solid at texture coordinates in [0, 1]."""
    width, height = opacity.level_sizes[texture, level, 0], opacity.level_sizes[texture, level, 1]
    x = min(max(s * width - np.float32(0.5), np.float32(0.0)), np.float32(width - 1))
    y = min(max(t * height - np.float32(0.5), np.float32(0.0)), np.float32(height - 1))
    column, row = int(x), int(y)
    right, below = min(column + 1, width - 1), min(row + 1, height - 1)
    start = opacity.level_starts[texture, level]
    fx, fy = x - np.float32(column), y - np.float32(row)
    texels = opacity.texels
    top = texels[start + row * width + column] * (np.float32(1.0) - fx) + texels[start + row * width + right] * fx
    bottom = texels[start + below * width + column] * (np.float32(1.0) - fx) + texels[start + below * width + right] * fx
    return top * (np.float32(1.0) - fy) + bottom * fy > np.float32(127.0)
