"""Camera trajectories in UTM, and their TUM text form.

One comment line ``# epsg=32632``, then ``stamp_s x y z qx qy qz qw``: UTC seconds since the epoch with six
decimals; easting, northing, ellipsoidal height of the camera centre; rotation ``utm_from_cam``.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import TrajectoryError
from fleetmap.files import write_text_atomically
from fleetmap.geometry import Pose, quat_xyzw_from_rotations, rotations_from_quat_xyzw

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Trajectory:
    """Time-ordered camera poses in one UTM zone. Frames without a pose are simply not in it."""

    epsg: int
    stamps_ns: NDArray[np.int64]  # (N,) int64, strictly increasing
    positions_m: Array  # (N, 3) float64 easting, northing, ellipsoidal height
    rotations: Array  # (N, 3, 3) float64 utm_from_cam

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def pose(self, index: int) -> Pose:
        """``utm_from_cam`` of one entry."""
        return Pose(self.rotations[index], self.positions_m[index])


def write_trajectory(path: Path, trajectory: Trajectory) -> None:
    """Write TUM text, replacing the file atomically."""
    quats = quat_xyzw_from_rotations(trajectory.rotations) if len(trajectory) else np.zeros((0, 4))
    lines = [f"# epsg={trajectory.epsg}"]
    for stamp_ns, position, quat in zip(trajectory.stamps_ns.tolist(), trajectory.positions_m, quats, strict=True):
        microseconds = (stamp_ns + 500) // 1000
        numbers = " ".join(f"{v:.6f}" for v in position) + " " + " ".join(f"{v:.9f}" for v in quat)
        lines.append(f"{microseconds // 1_000_000}.{microseconds % 1_000_000:06d} {numbers}")
    write_text_atomically(path, "\n".join(lines) + "\n")


def read_trajectory(path: Path) -> Trajectory:
    """Read TUM text.

    Raises:
        TrajectoryError: no such file, no ``# epsg=`` line of a UTM zone, a malformed line, or stamps that do
            not increase.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise TrajectoryError(f"cannot read trajectory {path}: {error}") from error
    epsg = next((int(m[1]) for line in lines if (m := re.match(r"#\s*epsg\s*=\s*(\d+)\s*$", line))), None)
    if epsg is None:
        raise TrajectoryError(f"{path} names no UTM zone: its first line must read like '# epsg=32632'")
    if not (32601 <= epsg <= 32660 or 32701 <= epsg <= 32760):
        raise TrajectoryError(f"{path}: EPSG:{epsg} is no UTM zone on WGS84 (326xx north, 327xx south)")
    rows = [
        _parse_row(path, number, line)
        for number, line in enumerate(lines, start=1)
        if line.strip() and not line.startswith("#")
    ]
    stamps_ns = np.array([row[0] for row in rows], dtype=np.int64)
    values = np.array([row[1] for row in rows], dtype=np.float64).reshape(-1, 7)
    if np.any(np.diff(stamps_ns) <= 0):
        bad = int(np.argmax(np.diff(stamps_ns) <= 0)) + 1
        raise TrajectoryError(f"{path}: stamps must increase; entry {bad + 1} is not later than the one before")
    rotations = rotations_from_quat_xyzw(values[:, 3:]) if len(rows) else np.zeros((0, 3, 3))
    return Trajectory(epsg, stamps_ns, values[:, :3], rotations)


def _parse_row(path: Path, number: int, line: str) -> tuple[int, list[float]]:
    fields = line.split()
    try:
        if len(fields) != 8:
            raise ValueError(f"{len(fields)} fields instead of 8")
        values = [float(field) for field in fields[1:]]
        if not np.all(np.isfinite(values)) or abs(np.linalg.norm(values[3:]) - 1.0) > 1e-3:
            raise ValueError("numbers that are not finite, or no unit quaternion")
        return int(np.int64(_stamp_ns(fields[0]))), values
    except (ValueError, OverflowError) as error:
        raise TrajectoryError(f"{path} line {number} is not 'stamp_s x y z qx qy qz qw': {error}") from error


def _stamp_ns(text: str) -> int:
    """Decimal seconds as integer nanoseconds; a float has only 0.2 us left at today's epoch seconds."""
    whole, _, fraction = text.partition(".")
    if not whole.isdigit() or (fraction and not fraction.isdigit()):
        return round(float(text) * 1e9)
    return int(whole) * 1_000_000_000 + int((fraction + "0" * 9)[:9])
