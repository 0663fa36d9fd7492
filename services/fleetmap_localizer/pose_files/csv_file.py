"""One line an image, for spreadsheets and scripts: the pose and how sure it is, or why there is none.

``kind`` is measured, predicted or none; ``reason`` is filled where it is none, all else where it is not.
Positions are the camera centre's, heights above the ellipsoid. ``q`` is the rotation ``utm_from_cam`` (camera: x
right, y down, z forward); ``heading_deg`` where the camera looks, clockwise from true north. Sigmas of the
position are to the true east, north, and up, in metres on the ground; those of the rotation about the vertical
(heading) and about the worse of the level axes (tilt). The last 21 columns are the upper triangle of the 6 x 6
covariance as in fleetmap.covariances, in the camera's frame.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fleetmap.covariances import COLUMNS as COVARIANCE_COLUMNS
from fleetmap.covariances import upper_triangle
from fleetmap.files import write_text_atomically
from fleetmap.geometry import quat_xyzw_from_rotations
from fleetmap_localizer.geographic import geographic, position_covariance_enu_m2
from fleetmap_localizer.pose_estimate import NoPose, PoseEstimate

COLUMNS = (
    *("stamp_ns", "kind", "reason", "lat_deg", "lon_deg", "height_m", "heading_deg"),
    *("epsg", "easting_m", "northing_m", "qx", "qy", "qz", "qw"),
    *("sigma_east_m", "sigma_north_m", "sigma_up_m", "sigma_heading_deg", "sigma_tilt_deg"),
    *("map_id", "version", "inliers"),
    *COVARIANCE_COLUMNS,
)


def write_csv(path: Path, answers: Sequence[PoseEstimate | NoPose]) -> None:
    """Write the table, replacing the file atomically."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for answer in answers:
        writer.writerow(_row(answer) if isinstance(answer, PoseEstimate) else _reason_row(answer))
    write_text_atomically(path, text.getvalue())


def _row(pose: PoseEstimate) -> list[object]:
    place = geographic(pose)
    at, accuracy = place.position, place.accuracy
    sigmas_m = np.sqrt(np.diag(position_covariance_enu_m2(place)))
    return [
        *(pose.stamp_ns, pose.kind, ""),
        *(f"{at.lat:.9f}", f"{at.lon:.9f}", f"{at.h:.4f}", f"{place.heading_deg:.5f}"),
        *(pose.epsg, f"{place.utm.easting_m:.4f}", f"{place.utm.northing_m:.4f}"),
        *(f"{value:.9f}" for value in quat_xyzw_from_rotations(pose.utm_from_cam.rotation)),
        *(f"{sigma_m:.4f}" for sigma_m in sigmas_m),
        *(f"{accuracy.heading_sigma_deg:.5f}", f"{accuracy.tilt_sigma_deg:.5f}"),
        *(pose.map_id, pose.version, pose.inlier_count),
        *(repr(value) for value in upper_triangle(pose.covariance)),
    ]


def _reason_row(answer: NoPose) -> list[object]:
    return [answer.stamp_ns, "none", answer.reason, *[""] * (len(COLUMNS) - 3)]
