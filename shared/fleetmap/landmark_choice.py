"""What of a map goes into its cells, so that other vehicles localise well in few bytes.

Landmarks are chosen one by one, always the one that helps most for its bytes. A landmark helps every keyframe
that saw it, the more the less is known of its position from those chosen already, and the fewer of them lie in
that part of its image: a view full of landmarks needs no more of them, a bare one takes what there is. It helps
less where it is inexact, or easily taken for another. Were all returns diminishing (submodular), the greedy choice
would be within 1 - 1/e of the best one; see fleetmap.greedy_choice.

Sources: M. Dymczyk et al., "The gist of maps - summarizing experience for lifelong localization", ICRA 2015, and
S. Lynen et al., "Get out of my lab", RSS 2015, section IV (landmarks that many keyframes saw, every keyframe with
enough of them); G. Nemhauser, L. Wolsey, M. Fisher, "An analysis of approximations for maximizing submodular set
functions", 1978; M. Minoux, "Accelerated greedy algorithms", 1978.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fleetmap.cells import cells_of_keyframes, whole_map
from fleetmap.errors import MapPackageError
from fleetmap.greedy_choice import Views, order_of_use
from fleetmap.keyframe_thinning import thinned_keyframes
from fleetmap.landmark_chances import landmark_chances
from fleetmap.landmark_precision import SCALE_FACTOR, with_precision
from fleetmap.manifest import Manifest
from fleetmap.map_package import MapPackage, write_package
from fleetmap.package_encoding import cell_parts
from fleetmap.visual_map import LocalizationMap, VisualMap, taken

Array = NDArray[np.float64]
Ids = NDArray[np.int64]

BYTES_PER_MB = 1e6
_COLUMNS, _ROWS = 8, 4
_MIN_DEPTH_M = 0.1
_USUAL_BYTES = 42.0  # per landmark and cell
_CLOSE_ENOUGH = 0.98  # of the budget
_MAX_TRIALS = 8
_LEAST_LENGTH_KM = 0.1
_GAP = 4  # keyframes


def choose_for_localizing(visual_map: VisualMap, budget_mb_per_km: float) -> LocalizationMap:
    """The keyframes and landmarks whose cells take at most so many megabytes per kilometre of keyframes' way.

    A landmark in two cells counts twice; of ways below 100 m, 100 m count. Landmarks are numbered anew, by where
    they come into view.

    Raises:
        MapPackageError: the keyframes alone take more.
    """
    limit_bytes = budget_mb_per_km * BYTES_PER_MB * max(_length_km(visual_map), _LEAST_LENGTH_KM)
    thin = thinned_keyframes(with_precision(visual_map))
    order = _in_order_of_use(thin)
    count, low, high = min(int(limit_bytes / _USUAL_BYTES), len(order)), 0, len(order)
    best: LocalizationMap | None = None
    for _ in range(_MAX_TRIALS):
        trial = only_landmarks(thin, order[:count])
        size_bytes = sum(len(data) for data, _ in cell_parts(trial).values())
        if size_bytes <= limit_bytes:
            best, low = trial, count
            if size_bytes >= _CLOSE_ENOUGH * limit_bytes or count == high:
                break
        else:
            high = count - 1
        missing = int((0.995 * limit_bytes - size_bytes) / _USUAL_BYTES)
        count = int(np.clip(count + missing, low, high))
    if best is None:
        raise MapPackageError(
            f"{budget_mb_per_km:g} MB/km are too few for the map's keyframes; allow more, or 0 for no limit"
        )
    return best


def localizable_part(visual_map: VisualMap, budget_mb_per_km: float) -> LocalizationMap:
    """What goes into the cells: ``choose_for_localizing``, or the whole map where the budget is 0.

    Raises:
        MapPackageError: the keyframes alone take more.
    """
    if budget_mb_per_km > 0.0:
        return choose_for_localizing(visual_map, budget_mb_per_km)
    return whole_map(with_precision(visual_map))


def choose_again(package: MapPackage, folder: Path, budget_mb_per_km: float, *, force: bool = False) -> Manifest:
    """Write a package anew with another budget for its cells; the map is not made again.

    Raises:
        OutputExistsError: the folder exists and ``force`` is not given, or what exists is not a map package.
        MapPackageError: the package has no full part or is damaged, or the keyframes alone take more.
        StorageError: the disk is full or refuses.
    """
    manifest, visual_map = package.manifest, package.visual_map()
    return write_package(
        folder,
        visual_map,
        map_id=manifest.map_id,
        quality=manifest.quality,
        provenance=manifest.provenance,
        road_quality=package.road_quality(),
        localizable=localizable_part(visual_map, budget_mb_per_km),
        force=force,
    )


def only_landmarks(visual_map: VisualMap, kept: Ids) -> LocalizationMap:
    """These landmarks only, numbered by the first and the last keyframe that saw them.

    A landmark that was overlooked by a few keyframes between others counts as seen by them as well.
    """
    number = np.full(len(visual_map.landmarks), -1, np.int64)
    number[kept] = np.arange(len(kept))
    landmark = number[visual_map.observations.landmark_index]
    is_kept = landmark >= 0
    landmark, keyframe = _bridged(landmark[is_kept], visual_map.observations.keyframe_index[is_kept])
    first, last = np.full(len(kept), len(visual_map.keyframes)), np.full(len(kept), -1)
    np.minimum.at(first, landmark, keyframe)
    np.maximum.at(last, landmark, keyframe)
    order = np.lexsort((kept, last, first))
    number[order] = np.arange(len(kept))
    pairs = np.sort(keyframe << 32 | number[landmark])
    return LocalizationMap(
        visual_map.anchor,
        visual_map.keyframes,
        taken(visual_map.landmarks, kept[order]),
        (pairs >> 32).astype(np.int32),
        (pairs & 0xFFFFFFFF).astype(np.int32),
    )


def _bridged(landmark: Ids, keyframe: NDArray[np.int32]) -> tuple[Ids, Ids]:
    """Pairs (M,) and those that fill gaps of at most _GAP keyframes between a landmark's."""
    pairs = np.unique(landmark << 32 | keyframe)
    steps = np.diff(pairs, append=pairs[-1:])
    missing = np.where((steps > 1) & (steps <= _GAP + 1), steps - 1, 0)  # steps between landmarks are larger
    ends = np.cumsum(missing)
    within = np.arange(missing.sum()) - np.repeat(ends - missing, missing) + 1
    pairs = np.concatenate([pairs, np.repeat(pairs, missing) + within])
    return pairs >> 32, pairs & 0xFFFFFFFF


def _length_km(visual_map: VisualMap) -> float:
    steps_m = np.linalg.norm(np.diff(visual_map.keyframes.positions_m, axis=0), axis=1)
    return float(steps_m.sum()) / 1000.0


def _in_order_of_use(visual_map: VisualMap) -> Ids:
    """Landmarks (n,), the one that helps most first; those that nobody sees are left out."""
    cells = _cells_of_landmarks(visual_map)
    chances = np.where(cells > 0, landmark_chances(visual_map), 0.0)
    return order_of_use(chances, np.maximum(cells, 1.0), _views(visual_map))[: np.count_nonzero(cells)]


def _views(visual_map: VisualMap) -> Views:
    observations, landmarks, camera = visual_map.observations, visual_map.landmarks, visual_map.camera
    order = np.argsort(observations.landmark_index, kind="stable")
    index, keyframe = observations.landmark_index[order], observations.keyframe_index[order].astype(np.int64)
    cam_from_map = visual_map.keyframes.rotations.transpose(0, 2, 1)[keyframe]
    in_cam = np.einsum(
        "mij,mj->mi", cam_from_map, landmarks.points_m[index] - visual_map.keyframes.positions_m[keyframe]
    )
    pixels = camera.project_ideal(in_cam)
    column = np.nan_to_num(pixels[:, 0] * _COLUMNS / camera.width_px).clip(0, _COLUMNS - 1).astype(np.int64)
    row = np.nan_to_num(pixels[:, 1] * _ROWS / camera.height_px).clip(0, _ROWS - 1).astype(np.int64)
    return Views(
        np.searchsorted(index, np.arange(len(landmarks) + 1)),
        keyframe,
        (keyframe * _ROWS + row) * _COLUMNS + column,
        len(visual_map.keyframes) * _ROWS * _COLUMNS,
        len(visual_map.keyframes),
        _jacobians(visual_map, in_cam, index),
    )


def _jacobians(visual_map: VisualMap, in_cam: Array, index: NDArray[np.int32]) -> NDArray[np.float32]:
    """Derivatives (M, 2, 6) of the pixels, in sigmas, of points (M, 3) by the pose; 0 behind the camera.

    p_cam becomes p_cam - w x p_cam - v under map_from_cam exp([w, v]).
    """
    camera, landmarks = visual_map.camera, visual_map.landmarks
    x, y, z = in_cam[:, 0], in_cam[:, 1], np.where(in_cam[:, 2] > _MIN_DEPTH_M, in_cam[:, 2], np.inf)
    zero = np.zeros_like(x)
    by_point = np.stack(
        [
            np.stack([camera.fx_px / z, zero, -camera.fx_px * x / z**2], axis=1),
            np.stack([zero, camera.fy_px / z, -camera.fy_px * y / z**2], axis=1),
        ],
        axis=1,
    )
    z = in_cam[:, 2]
    by_rotation = np.stack(
        [np.stack([zero, -z, y], axis=1), np.stack([z, zero, -x], axis=1), np.stack([-y, x, zero], axis=1)], axis=1
    )  # of p_cam: the matrix of p_cam x
    jacobians = np.concatenate([by_point @ by_rotation, -by_point], axis=2)
    feature_px = SCALE_FACTOR ** landmarks.octaves.astype(np.float64)
    return np.asarray(jacobians / feature_px[index][:, None, None], dtype=np.float32)


def _cells_of_landmarks(visual_map: VisualMap) -> Ids:
    """In how many cells (N,) a landmark will be stored."""
    _, cell_of_keyframe = cells_of_keyframes(visual_map)
    observations = visual_map.observations
    cells = cell_of_keyframe[observations.keyframe_index].astype(np.int64)
    pairs = np.unique(observations.landmark_index.astype(np.int64) << 32 | cells)
    return np.bincount(pairs >> 32, minlength=len(visual_map.landmarks))
