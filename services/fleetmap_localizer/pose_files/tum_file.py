"""Poses as TUM text, for evo and ``fleetmap evaluate``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fleetmap.trajectory import Trajectory, write_trajectory
from fleetmap_localizer.geographic import in_zone
from fleetmap_localizer.pose_estimate import NoPose, PoseEstimate


def write_tum(path: Path, answers: Sequence[PoseEstimate | NoPose]) -> None:
    """Write the poses, one at least; see fleetmap.trajectory."""
    write_trajectory(path, trajectory_of([answer for answer in answers if isinstance(answer, PoseEstimate)]))


def trajectory_of(poses: Sequence[PoseEstimate]) -> Trajectory:
    """Poses, one at least, as a trajectory in the UTM zone of the first."""
    epsg = poses[0].epsg
    in_one_zone = [in_zone(pose, epsg).utm_from_cam for pose in poses]
    return Trajectory(
        epsg=epsg,
        stamps_ns=np.array([pose.stamp_ns for pose in poses], dtype=np.int64),
        positions_m=np.array([pose.translation_m for pose in in_one_zone]),
        rotations=np.array([pose.rotation for pose in in_one_zone]),
    )
