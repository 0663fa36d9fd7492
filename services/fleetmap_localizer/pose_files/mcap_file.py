"""Poses as an MCAP recording with Foxglove's messages, to be looked at beside what the vehicle recorded.

``/fleetmap/location`` (foxglove.LocationFix) and ``/fleetmap/pose`` (foxglove.PoseInFrame) hold what was measured,
``/fleetmap/predicted/location`` and ``/fleetmap/predicted/pose`` what was predicted. A fix lies in the frame
``camera``, which it locates, its covariance points to the true east, north and up; a pose is that of the camera
(x right, y down, z forward) in the UTM grid, whose frame is called by its code, such as ``EPSG:32632``.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mcap.writer import CompressionType
from mcap_protobuf.writer import Writer

from fleetmap.files import atomic_path
from fleetmap.geometry import quat_xyzw_from_rotations
from fleetmap_localizer.geographic import geographic, position_covariance_enu_m2
from fleetmap_localizer.pose_estimate import NoPose, PoseEstimate
from fleetmap_localizer.pose_files.foxglove_schemas import COVARIANCE_KNOWN, message_class

CAMERA_FRAME = "camera"
_PREFIXES = {"measured": "/fleetmap", "predicted": "/fleetmap/predicted"}


def write_mcap(path: Path, answers: Sequence[PoseEstimate | NoPose]) -> None:
    """Write the poses, replacing the file atomically. The maps they refer to are metadata, ``fleetmap maps``."""
    poses = [answer for answer in answers if isinstance(answer, PoseEstimate)]
    with atomic_path(path) as draft, draft.open("wb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD)
        for pose in poses:
            prefix = _PREFIXES[pose.kind]
            for name, message in (("location", _location(pose)), ("pose", _pose(pose))):
                writer.write_message(f"{prefix}/{name}", message, pose.stamp_ns, pose.stamp_ns)
        writer.add_metadata("fleetmap maps", {pose.map_id: pose.version for pose in poses})
        writer.finish()  # type: ignore[no-untyped-call]
        file.flush()
        os.fsync(file.fileno())


def _location(pose: PoseEstimate) -> Any:
    place = geographic(pose)
    return message_class("LocationFix")(
        timestamp=_time(pose.stamp_ns),
        frame_id=CAMERA_FRAME,
        latitude=place.position.lat,
        longitude=place.position.lon,
        altitude=place.position.h,
        position_covariance=position_covariance_enu_m2(place).reshape(9).tolist(),
        position_covariance_type=COVARIANCE_KNOWN,
        heading=math.radians(place.heading_deg),
    )


def _pose(pose: PoseEstimate) -> Any:
    easting_m, northing_m, height_m = pose.utm_from_cam.translation_m.tolist()
    qx, qy, qz, qw = quat_xyzw_from_rotations(pose.utm_from_cam.rotation).tolist()
    return message_class("PoseInFrame")(
        timestamp=_time(pose.stamp_ns),
        frame_id=f"EPSG:{pose.epsg}",
        pose={
            "position": {"x": easting_m, "y": northing_m, "z": height_m},
            "orientation": {"x": qx, "y": qy, "z": qz, "w": qw},
        },
    )


def _time(stamp_ns: int) -> dict[str, int]:
    seconds, nanos = divmod(stamp_ns, 1_000_000_000)
    return {"seconds": seconds, "nanos": nanos}
