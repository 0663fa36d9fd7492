"""Wet ground: darker, and a blurred mirror of what stands above it.

The mirrored scene is what a camera sees from below the road, at the mirror image of its place, through the same
pixels; the ground itself is turned away from there. The mirror is flat: the road under and before the camera.
How much is mirrored grows towards grazing angles (C. Schlick, "An Inexpensive BRDF Model for Physically-based
Rendering", Eurographics 1994, eq. 15), and differs from damp patches to puddles, which have a place in the world.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from fleetmap.camera import Camera
from fleetmap.geometry import Pose
from fleetmap.simulation.rays import BAND_ROWS, TILE_COLUMNS, TILE_PIXELS
from fleetmap.simulation.surfaces import Surfaces
from fleetmap.simulation.view import View

Array = NDArray[np.float64]
FloatImage = NDArray[np.float32]
Plane = tuple[Array, float]  # unit normal n (3,) upwards and offset: n . x = offset

_COARSER = 3  # pixels of the image for each one of the mirror's, which is blurred anyway
_BLUR_PX = (0.5, 1.8)  # of the mirror, across and down: ripples and rough asphalt stretch mirror images downwards
_STEEPEST_ROAD = 0.2
_GROUND_COSINE = 0.94
_GROUND_HEIGHT_M, _GROUND_RISE = 0.4, 0.05  # what lies higher than this above the mirror is no ground: car roofs
_LOOK_AHEAD = ((0.0, 0.0, -1.0), (0.25, 0.0, -1.0), (0.0, 1.0, -0.3), (-0.3, 1.0, -0.3), (0.3, 1.0, -0.3))

_HALF, _ONE, _ZERO = np.float32(0.5), np.float32(1.0), np.float32(0.0)
_F0 = np.float32(0.02)  # what water mirrors of light from straight above
_SOAKED = np.float32(0.45)  # share of its own light that soaked ground loses
_DAMP = np.float32(0.45)  # share of a puddle's mirroring that damp ground has
_PUDDLE_M = 2.5


def road_plane(cast: Callable[[Array], Array], map_from_cam: Pose) -> Plane | None:
    """The plane of the road under and before a camera, or None where there is none.

    ``cast`` gives the distances (N,) to what stands along unit rays (N, 3) in the map frame.
    """
    forward = map_from_cam.rotation[:, 2] * [1.0, 1.0, 0.0]
    norm = float(np.linalg.norm(forward))
    if norm < 1e-3:
        return None
    forward /= norm
    basis = np.stack([np.cross(forward, [0.0, 0.0, 1.0]), forward, [0.0, 0.0, 1.0]])  # right, ahead, up
    rays = np.array(_LOOK_AHEAD) @ basis
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    distances = cast(rays)
    if not np.isfinite(distances[0]):
        return None
    below = map_from_cam.translation_m + rays[0] * distances[0]
    points = map_from_cam.translation_m + rays * np.where(np.isfinite(distances), distances, 0.0)[:, None]
    rise = points[:, 2] - below[2]
    run = np.linalg.norm((points - below)[:, :2], axis=1)
    on_road = np.isfinite(distances) & (np.abs(rise) <= _STEEPEST_ROAD * run)
    offsets = (points - below)[on_road]
    slope = np.linalg.lstsq(offsets[:, :2], offsets[:, 2], rcond=1e-6)[0] if len(offsets) > 2 else np.zeros(2)
    normal = np.append(-slope, 1.0)
    normal /= np.linalg.norm(normal)
    return normal, float(normal @ below)


def mirrored_camera(camera: Camera, map_from_cam: Pose, plane: Plane) -> tuple[Camera, Pose]:
    """A coarser camera on the other side of a plane, and its mirrored (left-handed) axes as a pose."""
    normal, offset = plane
    mirror = np.eye(3) - 2.0 * np.outer(normal, normal)
    position = map_from_cam.translation_m - 2.0 * (normal @ map_from_cam.translation_m - offset) * normal
    coarse = replace(
        camera,
        width_px=math.ceil(camera.width_px / _COARSER),
        height_px=math.ceil(camera.height_px / _COARSER),
        fx_px=camera.fx_px / _COARSER,
        fy_px=camera.fy_px / _COARSER,
        cx_px=(camera.cx_px + 0.5) / _COARSER - 0.5,
        cy_px=(camera.cy_px + 0.5) / _COARSER - 0.5,
    )
    return coarse, Pose(mirror @ map_from_cam.rotation, position)


def wet_the_ground(
    light: FloatImage,
    mirror: FloatImage,
    wetness: float,
    surfaces: Surfaces,
    view: View,
    map_from_cam: Pose,
    plane: Plane,
) -> None:
    """Change the light (H, W) of the ground near a plane to what it is when wet.

    ``mirror`` is the light that ``mirrored_camera`` sees, ``wetness`` between 0 and 1.
    """
    blurred = np.asarray(cv2.GaussianBlur(mirror, (0, 0), sigmaX=_BLUR_PX[0], sigmaY=_BLUR_PX[1]), np.float32)
    is_ground, heights_m = _ground(surfaces, view.ids, map_from_cam.translation_m, plane)
    # One pose serves the puddles' places also while a shutter rolls: they are off by centimetres.
    pose = tuple(np.array(a, np.float64, order="C") for a in (map_from_cam.rotation, map_from_cam.translation_m))
    _mirror_in_ground(
        light, blurred, np.float32(wetness), is_ground, heights_m, view.seen, view.nearest, view.table.rays, pose
    )


def _ground(
    surfaces: Surfaces, ids: NDArray[np.int64], centre_m: Array, plane: Plane
) -> tuple[NDArray[np.bool_], FloatImage]:
    """Which surfaces (M,) are ground, and how far (M,) the camera's centre is from the plane of each."""
    corners, (normal, offset) = surfaces.corners_in_map[ids], plane
    normals = np.cross(corners[:, 3] - corners[:, 0], corners[:, 1] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    heights_m = np.abs(np.einsum("mi,mi->m", normals, corners[:, 0] - centre_m))
    above_m = (corners @ normal - offset).min(axis=1)
    away_m = np.linalg.norm(corners - centre_m, axis=2).min(axis=1)
    level = (normals @ normal > _GROUND_COSINE) & ~surfaces.two_sided[ids]
    return level & (np.abs(above_m) < _GROUND_HEIGHT_M + _GROUND_RISE * away_m), heights_m.astype(np.float32)


@njit(cache=True, nogil=True, error_model="numpy")
def _mirror_in_ground(
    light: Any,
    mirror: Any,
    wetness: Any,
    is_ground: Any,
    heights_m: Any,
    seen: Any,
    nearest: Any,
    rays: Any,
    pose: Any,
) -> None:
    rotation, centre = pose
    samples = seen.shape[2]
    for band in range(seen.shape[0]):
        for tile in range(seen.shape[1]):
            for p in range(TILE_PIXELS):
                row, column = band * BAND_ROWS + p // TILE_COLUMNS, tile * TILE_COLUMNS + p % TILE_COLUMNS
                if row >= light.shape[0] or column >= light.shape[1]:
                    continue
                wet, m = 0, -1
                for k in range(samples):
                    if seen[band, tile, k, p] >= 0 and is_ground[seen[band, tile, k, p]]:
                        wet, m = wet + 1, seen[band, tile, k, p]
                        inverse = nearest[band, tile, k, p]
                if wet == 0:
                    continue
                x, y, z = rays[band, tile, 0, p], rays[band, tile, 1, p], rays[band, tile, 2, p]
                east = centre[0] + (rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z) / inverse
                north = centre[1] + (rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z) / inverse
                grazing = _ONE - min(inverse * heights_m[m], _ONE)
                fresnel = _F0 + (_ONE - _F0) * grazing * grazing * grazing * grazing * grazing
                share = wetness * np.float32(wet) / np.float32(samples)
                mirrored = share * fresnel * (_DAMP + (_ONE - _DAMP) * _puddle(east, north))
                own = light[row, column] * (_ONE - _SOAKED * share)
                light[row, column] = own * (_ONE - mirrored) + mirrored * _read(mirror, row, column)


@njit(cache=True, nogil=True, error_model="numpy")
def _read(mirror: Any, row: Any, column: Any) -> Any:
    """The mirror's light at a pixel of the image, between its own coarser pixels."""
    x = min(max((column + 0.5) / _COARSER - 0.5, 0.0), mirror.shape[1] - 1.0)
    y = min(max((row + 0.5) / _COARSER - 0.5, 0.0), mirror.shape[0] - 1.0)
    left, top = int(x), int(y)
    right, below = min(left + 1, mirror.shape[1] - 1), min(top + 1, mirror.shape[0] - 1)
    fx, fy = np.float32(x - left), np.float32(y - top)
    upper = mirror[top, left] * (_ONE - fx) + mirror[top, right] * fx
    lower = mirror[below, left] * (_ONE - fx) + mirror[below, right] * fx
    return upper * (_ONE - fy) + lower * fy


@njit(cache=True, nogil=True, error_model="numpy")
def _puddle(east: Any, north: Any) -> Any:
    """0 on damp ground, 1 in a puddle: noise with soft thresholds, the same at the same place of the map."""
    noise = 0.7 * _value_noise(east / _PUDDLE_M, north / _PUDDLE_M)
    noise += 0.3 * _value_noise(4.0 * east / _PUDDLE_M, 4.0 * north / _PUDDLE_M)
    return np.float32(min(max((noise - 0.5) * 8.0, 0.0), 1.0))


@njit(cache=True, nogil=True, error_model="numpy")
def _value_noise(x: Any, y: Any) -> Any:
    """Smooth noise between 0 and 1 with random values at whole numbers."""
    column, row = math.floor(x), math.floor(y)
    fx, fy = x - column, y - row
    fx, fy = fx * fx * (3.0 - 2.0 * fx), fy * fy * (3.0 - 2.0 * fy)
    top = _random(column, row) * (1.0 - fx) + _random(column + 1, row) * fx
    bottom = _random(column, row + 1) * (1.0 - fx) + _random(column + 1, row + 1) * fx
    return top * (1.0 - fy) + bottom * fy


@njit(cache=True, nogil=True, error_model="numpy")
def _random(column: Any, row: Any) -> Any:
    """A number between 0 and 1 for each cell: multiply, shift and mix, in 32 bits."""
    h = np.uint32(column) * np.uint32(0x9E3779B1) ^ np.uint32(row) * np.uint32(0x85EBCA77)
    h = (h ^ (h >> np.uint32(15))) * np.uint32(0xC2B2AE3D)
    h = h ^ (h >> np.uint32(13))
    return np.float64(h & np.uint32(0xFFFF)) / 65535.0
