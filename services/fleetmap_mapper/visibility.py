"""Which landmarks an image should show, where, and at which octave; compiled."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from fleetmap.geometry import Pose
from fleetmap_mapper.growing_map import SCALE_FACTOR, GrowingMap, Ids

Array = NDArray[np.float64]
_MIN_VIEW_COSINE = 0.5  # a descriptor is not recognised from more than 60 deg off its mean direction
_MAX_DEPTH_RATIO = 8.0  # distances at which a descriptor is looked for, against where it was seen
_MIN_DEPTH = 1e-6


def visible_landmarks(growing: GrowingMap, local: Ids, vis_from_cam: Pose) -> tuple[Ids, Array, NDArray[np.int64]]:
    """The landmarks of ``local`` that a camera should see, their pixels (n, 2) and octaves to look at (n,)."""
    camera = growing.camera
    left, top, right, bottom = camera.ideal_bounds_px
    ids, pixels, octaves = _visible(
        (camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px, left, top, right, bottom),
        np.ascontiguousarray(vis_from_cam.rotation),
        vis_from_cam.translation_m,
        local,
        growing.points,
        growing.normals,
        growing.distances,
        growing.octaves,
    )
    if not camera.has_distortion:
        return ids, pixels, octaves
    seen = camera.is_inside(camera.distort(pixels)) & camera.is_within_reach(pixels)
    return ids[seen], pixels[seen], octaves[seen]


@njit(cache=True, nogil=True, error_model="numpy")
def _visible(camera, rotation, centre, local, points, normals, distances, seen_octaves):  # type: ignore[no-untyped-def]
    fx, fy, cx, cy, left, top, right, bottom = camera
    ids, pixels = np.empty(len(local), np.int32), np.empty((len(local), 2))
    octaves = np.empty(len(local), np.int64)
    count = 0
    for landmark in local:
        x, y, z = points[landmark, 0] - centre[0], points[landmark, 1] - centre[1], points[landmark, 2] - centre[2]
        depth = rotation[0, 2] * x + rotation[1, 2] * y + rotation[2, 2] * z
        if not depth > _MIN_DEPTH:
            continue
        u = fx * (rotation[0, 0] * x + rotation[1, 0] * y + rotation[2, 0] * z) / depth + cx
        v = fy * (rotation[0, 1] * x + rotation[1, 1] * y + rotation[2, 1] * z) / depth + cy
        if not (left <= u <= right and top <= v <= bottom):
            continue
        distance = np.sqrt(x * x + y * y + z * z)
        towards = -(x * normals[landmark, 0] + y * normals[landmark, 1] + z * normals[landmark, 2])
        ratio = distances[landmark] / distance
        if towards > _MIN_VIEW_COSINE * distance and 1.0 / _MAX_DEPTH_RATIO < ratio < _MAX_DEPTH_RATIO:
            ids[count], pixels[count, 0], pixels[count, 1] = landmark, u, v
            octaves[count] = seen_octaves[landmark] + int(np.rint(np.log(ratio) / np.log(SCALE_FACTOR)))
            count += 1
    return ids[:count].copy(), pixels[:count].copy(), octaves[:count].copy()
