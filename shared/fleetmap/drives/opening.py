"""Finds the recording file that a path means."""

from __future__ import annotations

from pathlib import Path

from fleetmap.errors import DriveError


def find_mcap(path: Path) -> Path:
    """The MCAP file that a path means: itself, or the one in a rosbag2 folder.

    Raises:
        DriveError: nothing there, or a folder that does not hold exactly one MCAP file.
    """
    if not path.exists():
        raise DriveError(f"there is no recording {path}")
    if not path.is_dir():
        return path
    found = sorted(path.glob("*.mcap"))
    if len(found) == 1:
        return found[0]
    if found:
        names = ", ".join(file.name for file in found)
        raise DriveError(f"{path} holds {len(found)} MCAP files ({names}); name one of them")
    if any(path.glob("*.db3")):
        raise DriveError(
            f"{path} is a rosbag2 folder with SQLite storage; turn it into MCAP with 'ros2 bag convert'"
        )
    if any(path.glob("*.mcap.zstd")):
        raise DriveError(f"{path} holds an MCAP compressed as a whole file; unpack it with 'zstd -d' first")
    raise DriveError(f"{path} holds no MCAP file; a KITTI folder becomes one with 'fleetmap convert'")
