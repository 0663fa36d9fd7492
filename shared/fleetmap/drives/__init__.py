"""One module a recording format, each giving a fleetmap.drive.Drive."""

from __future__ import annotations

from pathlib import Path

from fleetmap.drive import Drive


def open_drive(
    path: Path,
    *,
    image_topic: str | None = None,
    gnss_topic: str | None = None,
    antenna_offset_m: tuple[float, float, float] | None = None,
) -> Drive:
    """Open a recorded drive: an MCAP file, or a rosbag2 folder that holds one.

    Messages may be ROS 2's in CDR, ROS 1's, and Foxglove's in protobuf, also side by side in one file.

    Args:
        path: the recording.
        image_topic: needed where the recording holds the images of several cameras.
        gnss_topic: needed where the recording holds several GNSS topics and GNSS is read.
        antenna_offset_m: the GNSS antenna from the camera centre along body axes (x forward, y left, z up, the
            camera taken as level and looking forward); used where no static transform says better.

    Raises:
        DriveError: not a recording, no images, or topics that have to be chosen.
    """
    from fleetmap.drives.mcap_drive import McapDrive  # mcap, rosbags and OpenCV only when a recording is read
    from fleetmap.drives.opening import find_mcap

    return McapDrive(
        find_mcap(path), image_topic=image_topic, gnss_topic=gnss_topic, antenna_offset_m=antenna_offset_m
    )
