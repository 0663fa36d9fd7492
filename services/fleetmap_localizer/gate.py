"""Whether a pose is worth reporting: no pose rather than a wrong one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fleetmap.camera import Camera
from fleetmap.vision.absolute_pose import AbsolutePose
from fleetmap_localizer.settings import GateSettings

_COLUMNS, _ROWS = 8, 4


def is_trustworthy(
    answer: AbsolutePose,
    pixels: NDArray[np.float64],
    landmarks_in_view: int,
    min_inliers: int,
    camera: Camera,
    settings: GateSettings,
) -> bool:
    """Judge a pose by how many landmarks agree, how many should have, where they lie and how firmly they hold it.

    Args:
        answer: the pose fitted to P matches.
        pixels: (P, 2) of the matches.
        landmarks_in_view: how many landmarks the camera should see from this pose.
        min_inliers: the least number to agree.
        camera: whose image it is.
        settings: the other limits.
    """
    inliers = answer.inlier_count
    position_sigma_m = np.sqrt(np.linalg.eigvalsh(answer.covariance[3:, 3:])[-1])
    rotation_sigma_deg = np.degrees(np.sqrt(np.linalg.eigvalsh(answer.covariance[:3, :3])[-1]))
    return bool(
        inliers >= min_inliers
        and inliers >= settings.min_inlier_ratio * len(pixels)
        and inliers >= settings.min_seen_ratio * landmarks_in_view
        and _occupied_cells(pixels[answer.inliers], camera) >= settings.min_occupied_cells
        and position_sigma_m <= settings.max_position_sigma_m
        and rotation_sigma_deg <= settings.max_rotation_sigma_deg
    )


def _occupied_cells(pixels: NDArray[np.float64], camera: Camera) -> int:
    """Cells of a coarse grid over the image that hold a point."""
    column = np.clip(pixels[:, 0] * _COLUMNS / camera.width_px, 0, _COLUMNS - 1).astype(np.int64)
    row = np.clip(pixels[:, 1] * _ROWS / camera.height_px, 0, _ROWS - 1).astype(np.int64)
    return len(np.unique(row * _COLUMNS + column))
