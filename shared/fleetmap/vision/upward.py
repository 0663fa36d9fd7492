"""Which way is up in an image: what descriptors' orientations are counted from.

A descriptor is taken along an orientation that is measured in the image. In another light, or a pixel aside, the
measure is another one by tens of degrees, and the descriptor a wholly different one. Who knows the pose need not
measure: vehicles roll and pitch, but what stood upright in the survey's image still does.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fleetmap.camera import Camera

Array = NDArray[np.float64]


def upward_deg(camera: Camera, pixels: Array, up_in_cam: Array) -> Array:
    """Direction (N,) of "up" in the image as recorded, from x towards y, at undistorted pixels (N, 2).

    ``up_in_cam`` is a unit vector (3,), or one for each pixel (N, 3). Where it points along the viewing ray, there
    is no such direction and any will do.
    """
    up = np.broadcast_to(up_in_cam, (len(pixels), 3))
    # A point at depth z that is raised by d moves in the image by d / z (up_x - x up_z, up_y - y up_z).
    moved = (up[:, :2] - camera.normalise(pixels) * up[:, 2:]) * [camera.fx_px, camera.fy_px]
    half_a_pixel = 0.5 * moved / np.maximum(np.linalg.norm(moved, axis=1, keepdims=True), 1e-12)
    in_image = camera.distort(pixels + half_a_pixel) - camera.distort(pixels - half_a_pixel)
    return np.asarray(np.degrees(np.arctan2(in_image[:, 1], in_image[:, 0])))
