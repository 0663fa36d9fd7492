"""What a camera sees of a street: images, and the truth behind each pixel.

Smooth outlines come from deciding visibility at four places of each pixel and mixing what they see; inside an
outline the pixel's one texel is right already ("multisampling"; K. Akeley, RealityEngine Graphics, SIGGRAPH 1993).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fleetmap.camera import Camera
from fleetmap.geometry import Pose
from fleetmap.simulation.look import Look
from fleetmap.simulation.shading import shade
from fleetmap.simulation.street import Street
from fleetmap.simulation.visibility import (
    NOTHING,
    Grid,
    Ids,
    View,
    boxes_in_view,
    boxes_seen,
    sampling_grid,
    view_of,
    visible_surfaces,
)

Array = NDArray[np.float64]
FloatImage = NDArray[np.float32]

_SAMPLES_PX = ((-0.125, -0.375), (0.375, -0.125), (-0.375, 0.125), (0.125, 0.375))  # (x, y), a rotated grid
_STRIP_ROWS = 32  # shaded at once: what stays in the processor's cache


def render(street: Street, camera: Camera, map_from_cam: Pose, look: Look) -> NDArray[np.uint8]:
    """The image (H, W) that a camera takes; pixel (0, 0) is the centre of the top-left pixel."""
    view = view_of(street.surfaces, map_from_cam)
    samples = _see(street, view, [sampling_grid(camera, shift_px) for shift_px in _SAMPLES_PX])
    shader = shade(street.surfaces, street.atlas, view, camera)
    centres = sampling_grid(camera, (0.0, 0.0))
    strips = [slice(top, top + _STRIP_ROWS) for top in range(0, camera.height_px, _STRIP_ROWS)]
    light = np.concatenate(
        [shader(samples[0][rows], centres.pixel_x[rows], centres.pixel_y[rows]) for rows in strips]
    )
    outline = np.logical_or.reduce([ids != samples[0] for ids in samples[1:]])
    mixed = np.zeros(np.count_nonzero(outline), dtype=np.float32)
    for ids, shift_px in zip(samples, _SAMPLES_PX, strict=True):
        grid = sampling_grid(camera, shift_px)
        mixed += shader(ids[outline], grid.pixel_x[outline], grid.pixel_y[outline])
    light[outline] = mixed / np.float32(len(samples))
    return look.apply(light, map_from_cam)


def render_depth(street: Street, camera: Camera, map_from_cam: Pose) -> FloatImage:
    """Depth (H, W) along the optical axis in metres at the pixel centres; infinite where the sky is."""
    view, grid = view_of(street.surfaces, map_from_cam), sampling_grid(camera, (0.0, 0.0))
    (ids,) = _see(street, view, [grid])
    a, b, c = (np.take(np.append(column, 0.0), ids) for column in view.inverse_depth.T)
    with np.errstate(divide="ignore"):
        return np.asarray(1.0 / (a * grid.pixel_x + b * grid.pixel_y + c), dtype=np.float32)


def true_points(street: Street, camera: Camera, map_from_cam: Pose, pixels: Array) -> Array:
    """Where the viewing rays of distorted pixels (N, 2) meet the street: map points (N, 3).

    NaN for the sky and for pixels outside the image. A pixel within half a pixel of an outline may be given to
    either side of it.
    """
    view = view_of(street.surfaces, map_from_cam)
    (ids,) = _see(street, view, [sampling_grid(camera, (0.0, 0.0))])
    inside = camera.is_inside(pixels, -0.5)
    column, row = np.rint(np.where(inside[:, None], pixels, 0.0)).astype(np.int64).T
    hit = ids[row.clip(0, camera.height_px - 1), column.clip(0, camera.width_px - 1)]
    rays = camera.unproject(pixels)
    inverse_depth = np.einsum("ni,ni->n", view.inverse_depth[hit], rays)
    inverse_depth[~inside | (hit == NOTHING)] = np.nan
    return map_from_cam.transform(rays / inverse_depth[:, None])


def _see(street: Street, view: View, grids: list[Grid]) -> list[Ids]:
    """Ids (H, W) of the surfaces seen on each of several grids less than a pixel apart."""
    boxes = boxes_in_view(view, grids[0])
    seen: list[Ids] = []
    for grid in grids:
        ids = visible_surfaces(street.surfaces, street.atlas, view, boxes, grid)
        boxes = boxes if seen else boxes_seen(ids, len(street.surfaces))
        seen.append(grid.at_pixels(ids))
    return seen
