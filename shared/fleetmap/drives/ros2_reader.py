"""The former place of fleetmap.drives.mcap_drive."""

from __future__ import annotations

from fleetmap.drives.mcap_drive import McapDrive as Ros2Drive
from fleetmap.drives.mcap_drive import read_fixes

__all__ = ["Ros2Drive", "read_fixes"]
