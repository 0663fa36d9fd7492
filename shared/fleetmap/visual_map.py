"""The map in memory: keyframes, landmarks and who saw what, as arrays.

Frame ``map``: UTM grid east, grid north, ellipsoidal height in metres minus the anchor.
All arrays are parallel within their group and treated as frozen.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from fleetmap.camera import Camera
from fleetmap.geodesy import UtmAnchor
from fleetmap.geometry import Pose, Sim3

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Keyframes:
    """Selected images of the survey drive, in time order."""

    stamps_ns: NDArray[np.int64]  # (K,) int64
    rotations: Array  # (K, 3, 3) float64 map_from_cam
    positions_m: Array  # (K, 3) float64 camera centres in map
    # (K, 6, 6) float32 of the tangent [rotation (rad), translation (m)] in the camera's frame: the true pose is
    # map_from_cam @ exp(xi). NaN where no fix determines it; None where the map's writer did not say.
    covariances: NDArray[np.float32] | None = None

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def pose(self, index: int) -> Pose:
        """``map_from_cam`` of one keyframe."""
        return Pose(self.rotations[index], self.positions_m[index])


@dataclass(frozen=True)
class Landmarks:
    """Triangulated points with the descriptor they are recognised by."""

    points_m: Array  # (N, 3) float64 in map
    descriptors: NDArray[np.uint8]  # (N, 32) uint8, ORB; the medoid of the track's descriptors
    normals: NDArray[np.float32]  # (N, 3) float32 mean unit vector from the landmark to its observers
    octaves: NDArray[np.uint8]  # (N,) uint8 pyramid level of the descriptor
    distances_m: NDArray[np.float32]  # (N,) float32 distance at which the descriptor was seen
    # (N, 2) float32 standard deviation across and along ``normals``; None where the map's writer did not say.
    sigmas_m: NDArray[np.float32] | None = None
    # (N,) float32 orientation of the descriptor in its image as recorded, from the direction of "up" there (see
    # fleetmap.vision.upward); None where the map's writer did not say.
    angles_deg: NDArray[np.float32] | None = None

    def __len__(self) -> int:
        return len(self.points_m)


@dataclass(frozen=True)
class Observations:
    """Keyframe ``keyframe_index[m]`` saw landmark ``landmark_index[m]`` at ``pixels[m]``; sorted by keyframe."""

    keyframe_index: NDArray[np.int32]  # (M,) int32
    landmark_index: NDArray[np.int32]  # (M,) int32
    pixels: NDArray[np.float32]  # (M, 2) float32 undistorted pixels (Camera.project_ideal)
    octaves: NDArray[np.uint8]  # (M,) uint8

    def __len__(self) -> int:
        return len(self.keyframe_index)


@dataclass(frozen=True)
class VisualMap:
    """A georeferenced keyframe map. It is never changed after the mapper has made it."""

    anchor: UtmAnchor
    map_from_vis: Sim3  # the Sim(3) S that placed the survey's free-scale frame
    camera: Camera  # of the survey vehicle
    keyframes: Keyframes
    landmarks: Landmarks
    observations: Observations


@dataclass(frozen=True)
class LocalizationMap:
    """What a localizer needs of one or several neighbouring 128 m cells; see fleetmap.map_package."""

    anchor: UtmAnchor
    keyframes: Keyframes
    landmarks: Landmarks
    seen_by_keyframe: NDArray[np.int32]  # (M,) int32 sorted; keyframe seen_by_keyframe[m] ...
    seen_landmark: NDArray[np.int32]  # (M,) int32 ... saw landmark seen_landmark[m]


Group = TypeVar("Group", Keyframes, Landmarks, Observations)


def taken(group: Group, rows: NDArray[np.int64]) -> Group:
    """Some rows of a group, in their order; what the group does not know stays unknown."""
    columns: dict[str, Any] = {}
    for field in fields(group):
        column = getattr(group, field.name)
        columns[field.name] = None if column is None else column[rows]
    return type(group)(**columns)
