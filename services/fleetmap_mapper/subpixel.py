"""Every observation of a landmark aligned with one view of it, before the map is adjusted as a whole.

A landmark's patch is taken from the middle one of its views and looked for in all others, bent by what the map
knows of their geometry: the patch is taken to face the camera it comes from. What aligns is several times more
exact than the corner that a descriptor was found at; what does not (an occlusion, a reflection, an edge) keeps its
corner, which says little. The observations carry sigmas accordingly; the adjustment estimates them anew.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fleetmap.camera import Camera
from fleetmap.drive import Frame
from fleetmap.read_ahead import read_ahead
from fleetmap.vision.patch_alignment import PATCH_PX, Patches, align_patches, sample_patches
from fleetmap.vision.pyramid import image_pyramid
from fleetmap_mapper.growing_map import SCALE_FACTOR
from fleetmap_mapper.placed_map import PlacedMap

Array = NDArray[np.float64]

_LEVELS = 8
_IMAGES_AHEAD = 2
_MAX_SHIFT_SIGMAS = 2.5  # of the corner's own sigma
_ALIGNED_NOISE = 0.25  # against a corner's sigma; a first guess
_WARP_BASELINE_PX = 2.0  # finite difference, in pixels of the patch's level


def align_observations(
    placed: PlacedMap, octaves: NDArray[np.uint8], frames: Callable[[], Iterator[Frame]]
) -> PlacedMap:
    """The map with the pixels and sigmas of its observations aligned to a fraction of a pixel.

    Args:
        placed: near its optimum: the warps of patches come from its poses and points.
        octaves: (M,) pyramid level of each observation.
        frames: reads the drive's images from the start; called twice.
    """
    reference = _middle_observations(placed)
    recorded = placed.camera.distort(placed.pixels)
    patches = _reference_patches(placed, octaves, recorded, reference, frames)
    warps = _warps(placed, octaves, recorded, reference)
    refined = recorded.copy()
    aligned: NDArray[np.bool_] = np.zeros(len(recorded), np.bool_)
    is_reference = np.zeros(len(recorded), np.bool_)
    is_reference[reference] = True
    recorded_sigmas_px = SCALE_FACTOR ** octaves.astype(np.float64)
    for keyframe, pyramid in _keyframe_pyramids(placed, frames):
        own = placed.observations_of(keyframe)
        rows = own.start + np.flatnonzero(~is_reference[own])
        refined[rows], aligned[rows] = align_patches(
            pyramid,
            SCALE_FACTOR,
            patches[placed.point_index[rows]],
            warps[rows],
            recorded[rows],
            _MAX_SHIFT_SIGMAS * recorded_sigmas_px[rows],
        )
    # The reference's own corner is the landmark, wherever it was found, if anything agrees with it.
    followed = np.bincount(placed.point_index[aligned], minlength=len(placed.points_m)) > 0
    aligned[reference] = followed
    pixels = placed.camera.undistort(refined)
    aligned &= np.isfinite(pixels).all(axis=1)
    return replace(
        placed,
        pixels=np.where(aligned[:, None], pixels, placed.pixels),
        noise=np.where(aligned, _ALIGNED_NOISE, 1.0),
        is_aligned=aligned,
    )


def _middle_observations(placed: PlacedMap) -> NDArray[np.int64]:
    """For each point (P,) the one of its observations that stands in the middle of the drive's order."""
    order = np.argsort(placed.point_index, kind="stable")
    starts = np.searchsorted(placed.point_index[order], np.arange(len(placed.points_m) + 1))
    return np.asarray(order[(starts[:-1] + starts[1:]) // 2])


def _reference_patches(
    placed: PlacedMap,
    octaves: NDArray[np.uint8],
    recorded: Array,
    reference: NDArray[np.int64],
    frames: Callable[[], Iterator[Frame]],
) -> Patches:
    patches = np.full((len(reference), PATCH_PX, PATCH_PX), np.nan, np.float32)
    for keyframe, pyramid in _keyframe_pyramids(placed, frames):
        points = np.flatnonzero(placed.keyframe_index[reference] == keyframe)
        rows = reference[points]
        patches[points] = sample_patches(pyramid, recorded[rows], octaves[rows])
    return patches


def _keyframe_pyramids(
    placed: PlacedMap, frames: Callable[[], Iterator[Frame]]
) -> Iterator[tuple[int, list[NDArray[np.uint8]]]]:
    """Every keyframe's index and image pyramid, in time order."""
    keyframes_at = defaultdict(list)  # two segments may share an image
    for index, stamp_ns in enumerate(placed.keyframe_stamps_ns.tolist()):
        keyframes_at[stamp_ns].append(index)
    images = (f for f in frames() if f.stamp_ns in keyframes_at)
    pyramids = ((f.stamp_ns, image_pyramid(f.image, _LEVELS, SCALE_FACTOR)) for f in images)
    for stamp_ns, pyramid in read_ahead(pyramids, _IMAGES_AHEAD):
        for index in keyframes_at[stamp_ns]:
            yield index, pyramid


def _warps(placed: PlacedMap, octaves: NDArray[np.uint8], recorded: Array, reference: NDArray[np.int64]) -> Array:
    """Pixels (M, 2, 2) of each observation's image per pixel of its landmark's patch."""
    camera = placed.camera
    rotations = np.array([p.rotation for p in placed.poses])
    centres = np.array([p.translation_m for p in placed.poses])
    k_ref = placed.keyframe_index[reference]
    depths_m = ((placed.points_m - centres[k_ref])[:, None] @ rotations[k_ref])[:, 0, 2]
    spacing_px = SCALE_FACTOR ** octaves[reference].astype(np.float64)
    step_px = _WARP_BASELINE_PX * spacing_px

    def seen(shift: Array) -> Array:
        """Where all observations see the place that stands ``shift`` pixels beside its landmark."""
        in_reference = _at_depth(camera, recorded[reference] + shift * step_px[:, None], depths_m)
        in_map = (rotations[k_ref] @ in_reference[:, :, None])[:, :, 0] + centres[k_ref]
        k = placed.keyframe_index
        in_cam = ((in_map[placed.point_index] - centres[k])[:, None] @ rotations[k])[:, 0]
        return camera.project(in_cam)

    middle = seen(np.zeros(2))
    columns = [seen(np.array(axis)) - middle for axis in ((1.0, 0.0), (0.0, 1.0))]
    return np.stack(columns, axis=2) / _WARP_BASELINE_PX


def _at_depth(camera: Camera, recorded: Array, depths_m: Array) -> Array:
    """Points (N, 3) in the camera at recorded pixels (N, 2) and depths (N,)."""
    normalised = camera.normalise(camera.undistort(recorded))
    return np.column_stack([normalised, np.ones(len(normalised))]) * depths_m[:, None]
