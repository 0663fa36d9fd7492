"""Covariances of poses, and their CSV form.

One line per pose: ``stamp_ns``, then the upper triangle, row by row, of the 6 x 6 covariance of the tangent
[rotation (rad), translation (m)] in the camera's frame: the true pose is ``utm_from_cam @ exp(xi)``. The first
line names the columns.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import TrajectoryError
from fleetmap.files import write_text_atomically

Array = NDArray[np.float64]

_AXES = ("rx", "ry", "rz", "tx", "ty", "tz")
_ROWS, _COLUMNS = np.triu_indices(6)
COLUMNS = tuple(f"{_AXES[i]}_{_AXES[j]}" for i, j in zip(_ROWS, _COLUMNS, strict=True))  # of the upper triangle
HEADER = ",".join(["stamp_ns", *COLUMNS])


@dataclass(frozen=True)
class PoseCovariances:
    """Time-ordered covariances of camera poses."""

    stamps_ns: NDArray[np.int64]  # (N,) int64, strictly increasing
    matrices: Array  # (N, 6, 6) float64, positive definite


def write_covariances(path: Path, covariances: PoseCovariances) -> None:
    """Write the CSV, replacing the file atomically."""
    lines = [HEADER]
    for stamp_ns, matrix in zip(covariances.stamps_ns.tolist(), covariances.matrices, strict=True):
        lines.append(f"{stamp_ns}," + ",".join(repr(value) for value in upper_triangle(matrix)))
    write_text_atomically(path, "\n".join(lines) + "\n")


def upper_triangle(covariance: Array) -> list[float]:
    """The 21 entries of a covariance (6, 6) that ``COLUMNS`` names."""
    entries: list[float] = covariance[_ROWS, _COLUMNS].tolist()
    return entries


def read_covariances(path: Path) -> PoseCovariances:
    """Read the CSV.

    Raises:
        TrajectoryError: no such file, a malformed line, stamps that do not increase, or a matrix that is not
            positive definite.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise TrajectoryError(f"cannot read covariances {path}: {error}") from error
    if not lines or lines[0].strip() != HEADER:
        raise TrajectoryError(f"{path} holds no covariances: its first line must be '{HEADER}'")
    stamps_ns: list[int] = []
    matrices: list[Array] = []
    for number, line in enumerate(lines[1:], start=2):
        if not line.strip():
            continue
        try:
            stamp_ns, matrix = _parse_row(line)
        except (ValueError, OverflowError, np.linalg.LinAlgError) as error:
            raise TrajectoryError(f"{path} line {number} is no stamp and covariance: {error}") from error
        if stamps_ns and stamp_ns <= stamps_ns[-1]:
            raise TrajectoryError(f"{path} line {number}: stamps must increase")
        stamps_ns.append(stamp_ns)
        matrices.append(matrix)
    return PoseCovariances(np.array(stamps_ns, dtype=np.int64), np.array(matrices).reshape(-1, 6, 6))


def _parse_row(line: str) -> tuple[int, Array]:
    stamp, *fields = line.split(",")
    if len(fields) != len(_ROWS):
        raise ValueError(f"{1 + len(fields)} fields instead of {1 + len(_ROWS)}")
    matrix = np.empty((6, 6))
    matrix[_ROWS, _COLUMNS] = matrix[_COLUMNS, _ROWS] = [float(field) for field in fields]
    if not np.all(np.isfinite(matrix)):
        raise ValueError("numbers that are not finite")
    np.linalg.cholesky(matrix)
    return int(np.int64(int(stamp))), matrix
