from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fleetmap.covariances import HEADER, PoseCovariances, read_covariances, write_covariances
from fleetmap.errors import TrajectoryError

START_NS = 1_700_000_000_123_456_789


def some_covariances(count: int = 5) -> PoseCovariances:
    roots = np.random.default_rng(0).normal(0.0, 1e-3, (count, 6, 8))
    stamps_ns = START_NS + np.arange(count, dtype=np.int64) * 100_000_000
    return PoseCovariances(stamps_ns, roots @ roots.transpose(0, 2, 1))


@pytest.mark.parametrize("count", [0, 5])
def test_covariances_come_back_as_they_were_written(count: int, tmp_path: Path) -> None:
    written = some_covariances(count)
    write_covariances(tmp_path / "poses.csv", written)
    read = read_covariances(tmp_path / "poses.csv")
    np.testing.assert_array_equal(read.stamps_ns, written.stamps_ns)
    # Only the upper triangle travels; a product's two halves may differ in the last digit.
    np.testing.assert_allclose(read.matrices, written.matrices, rtol=1e-12)
    np.testing.assert_array_equal(read.matrices, read.matrices.transpose(0, 2, 1))


def test_the_columns_are_named_rotation_first(tmp_path: Path) -> None:
    matrix = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    matrix[0, 5] = matrix[5, 0] = 0.25
    write_covariances(tmp_path / "poses.csv", PoseCovariances(np.array([START_NS]), matrix[None]))
    header, line = (tmp_path / "poses.csv").read_text().splitlines()
    columns = dict(zip(header.split(","), line.split(","), strict=True))
    assert len(columns) == 22
    assert columns["stamp_ns"] == str(START_NS)
    assert (columns["rx_rx"], columns["rz_rz"], columns["tx_tx"], columns["tz_tz"]) == ("1.0", "3.0", "4.0", "6.0")
    assert columns["rx_tz"] == "0.25"


def line(stamp: str = "1", **changed: str) -> str:
    names = HEADER.split(",")[1:]
    values = {name: "1.0" if name.split("_")[0] == name.split("_")[1] else "0.0" for name in names} | changed
    return ",".join([stamp, *values.values()])


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("", "first line"),
        ("1,2,3\n", "first line"),
        (f"{HEADER}\n1,2,3\n", "line 2.*3 fields instead of 22"),
        (f"{HEADER}\n{line('now')}\n", "line 2"),
        (f"{HEADER}\n{line('99999999999999999999')}\n", "line 2"),
        (f"{HEADER}\n{line(rx_rx='nan')}\n", "line 2.*not finite"),
        (f"{HEADER}\n{line(rx_ry='x')}\n", "line 2"),
        (f"{HEADER}\n{line()}\n{line('2', tx_tx='-1.0')}\n", "line 3.*definite"),
        (f"{HEADER}\n{line('2', rx_ry='3.0')}\n", "line 2.*definite"),
        (f"{HEADER}\n{line('2')}\n\n{line('2')}\n", "line 4.*increase"),
    ],
)
def test_a_malformed_file_is_refused_with_the_line_that_is_wrong(
    text: str, complaint: str, tmp_path: Path
) -> None:
    (tmp_path / "poses.csv").write_text(text)
    with pytest.raises(TrajectoryError, match=complaint) as refusal:
        read_covariances(tmp_path / "poses.csv")
    assert "\n" not in str(refusal.value)


def test_a_missing_or_binary_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(TrajectoryError, match=r"absent\.csv"):
        read_covariances(tmp_path / "absent.csv")
    (tmp_path / "binary.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(TrajectoryError, match=r"binary\.csv"):
        read_covariances(tmp_path / "binary.csv")
