from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleetmap.errors import TrajectoryError
from fleetmap.geometry import rotation_angle_rad, so3_exp
from fleetmap.trajectory import Trajectory, read_trajectory, write_trajectory

LINE = "1317045935.706851 451967.976000 5431264.588100 113.040200 0 0 0 1"


def trajectory(stamps_ns: list[int], epsg: int = 32632) -> Trajectory:
    rng = np.random.default_rng(len(stamps_ns))
    count = len(stamps_ns)
    positions = np.array([451_967.0, 5_431_264.0, 113.0]) + rng.normal(0, 100, (count, 3))
    return Trajectory(epsg, np.array(stamps_ns, dtype=np.int64), positions, so3_exp(rng.normal(0, 1, (count, 3))))


def written(path: Path, stamps_ns: list[int]) -> list[str]:
    write_trajectory(path, trajectory(stamps_ns))
    return path.read_text().splitlines()


def test_the_text_is_a_zone_line_and_eight_fields(tmp_path):
    half = np.sqrt(0.5)
    one = Trajectory(
        32632,
        np.array([1_317_045_935_706_851_072]),
        np.array([[451967.976, 5431264.5881, 113.0402]]),
        np.array([[[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]]),
    )
    write_trajectory(tmp_path / "t.tum", one)
    assert (tmp_path / "t.tum").read_text() == (
        "# epsg=32632\n"
        "1317045935.706851 451967.976000 5431264.588100 113.040200"
        f" 0.000000000 0.000000000 {half:.9f} {half:.9f}\n"
    )


@pytest.mark.parametrize(
    ("stamp_ns", "text"),
    [
        (1_700_000_000_000_000_000, "1700000000.000000"),
        (1_700_000_000_000_000_499, "1700000000.000000"),
        (1_700_000_000_000_000_500, "1700000000.000001"),
        (1_700_000_000_999_999_500, "1700000001.000000"),
        (999, "0.000001"),
        (1_700_000_000_000_001_000, "1700000000.000001"),
    ],
)
def test_stamps_are_rounded_to_microseconds(tmp_path, stamp_ns, text):
    assert written(tmp_path / "t.tum", [stamp_ns])[1].split()[0] == text


@given(
    st.lists(st.integers(0, 4 * 10**15), min_size=1, max_size=30, unique=True).map(sorted),
    st.sampled_from([32601, 32632, 32756]),
)
def test_what_is_written_is_read_back(tmp_path_factory, microseconds, epsg):
    path = tmp_path_factory.mktemp("tum") / "t.tum"
    original = trajectory([1000 * value for value in microseconds], epsg)
    write_trajectory(path, original)
    back = read_trajectory(path)
    assert back.epsg == epsg
    assert back.stamps_ns.tolist() == original.stamps_ns.tolist()
    assert np.abs(back.positions_m - original.positions_m).max() <= 5.1e-7
    turned = np.swapaxes(back.rotations, 1, 2) @ original.rotations
    assert rotation_angle_rad(turned).max() < 1e-7


def test_an_empty_trajectory_is_a_zone_line(tmp_path):
    assert written(tmp_path / "t.tum", []) == ["# epsg=32632"]
    back = read_trajectory(tmp_path / "t.tum")
    assert (len(back), back.positions_m.shape, back.rotations.shape) == (0, (0, 3), (0, 3, 3))


def test_a_pose_of_a_trajectory_is_utm_from_cam():
    original = trajectory([1, 2, 3])
    assert np.array_equal(original.pose(1).translation_m, original.positions_m[1])
    assert np.array_equal(original.pose(1).rotation, original.rotations[1])


@pytest.mark.parametrize("first_line", ["# epsg=32632", "#epsg = 32632", "# epsg=32632  "])
def test_other_tools_comments_blank_lines_and_numbers_are_understood(tmp_path, first_line):
    text = f"# made by hand\n{first_line}\n\n  \n1.7e9 1 2 3 0 0 0 1\n1700000000.25 1 2 3 0 0 0 -1\n"
    (tmp_path / "t.tum").write_text(text)
    assert read_trajectory(tmp_path / "t.tum").stamps_ns.tolist() == [
        1_700_000_000 * 10**9,
        1_700_000_000_250_000_000,
    ]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "names no UTM zone"),
        (LINE, "names no UTM zone"),
        ("# epsg=\n" + LINE, "names no UTM zone"),
        ("# epsg=32632\n1 2 3", "line 2 .*3 fields instead of 8"),
        ("# epsg=32632\n" + LINE + " 9", "line 2 .*9 fields instead of 8"),
        ("# epsg=32632\n" + LINE.replace("113", "abc"), "line 2"),
        ("# epsg=32632\n" + LINE.replace("113.040200", "nan"), "line 2 .*not finite"),
        ("# epsg=32632\n" + LINE.replace("0 0 0 1", "0 0 0 2"), "line 2 .*no unit quaternion"),
        ("# epsg=32632\n" + LINE.replace("0 0 0 1", "0 0 0 0"), "line 2 .*no unit quaternion"),
        ("# epsg=32632\nnow 1 2 3 0 0 0 1", "line 2"),
        (f"# epsg=32632\n{LINE}\n{LINE}", "entry 2 is not later"),
        ("# epsg=32632\n2 1 2 3 0 0 0 1\n3 1 2 3 0 0 0 1\n1 1 2 3 0 0 0 1", "entry 3 is not later"),
    ],
)
def test_a_malformed_file_is_refused_with_its_line(tmp_path, text, message):
    (tmp_path / "t.tum").write_text(text)
    with pytest.raises(TrajectoryError, match=message) as refused:
        read_trajectory(tmp_path / "t.tum")
    assert "\n" not in str(refused.value)
    assert str(tmp_path / "t.tum") in str(refused.value)


@pytest.mark.parametrize("stamp", ["nan", "inf", "-inf", "1e400", "1e30", "9" * 20])
def test_a_stamp_that_is_no_time_is_refused(tmp_path, stamp):
    (tmp_path / "t.tum").write_text(f"# epsg=32632\n{stamp} 1 2 3 0 0 0 1\n")
    with pytest.raises(TrajectoryError, match="line 2"):
        read_trajectory(tmp_path / "t.tum")


def test_a_file_that_is_not_there_or_no_text_is_refused(tmp_path):
    with pytest.raises(TrajectoryError, match="cannot read"):
        read_trajectory(tmp_path / "nothing.tum")
    (tmp_path / "binary.tum").write_bytes(b"\xff\xfe\x80")
    with pytest.raises(TrajectoryError, match="cannot read"):
        read_trajectory(tmp_path / "binary.tum")


@pytest.mark.parametrize("epsg", [4326, 99999])
def test_a_zone_that_is_none_is_refused(tmp_path, epsg):
    (tmp_path / "t.tum").write_text(f"# epsg={epsg}\n{LINE}\n")
    with pytest.raises(TrajectoryError, match=str(epsg)):
        read_trajectory(tmp_path / "t.tum")
