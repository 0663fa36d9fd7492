"""What is left when a run of ``fleetmap localize`` ends early."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fleetmap.errors import NoPoseError, ServerError
from fleetmap.geometry import Pose
from fleetmap.trajectory import read_trajectory
from fleetmap_cli.localization_report import PoseOutputs, finish
from fleetmap_localizer.pose_estimate import NoPose, PoseEstimate
from fleetmap_localizer.run import LocalizedDrive

T0_NS = 1_700_000_000_000_000_000
AT = Pose(np.eye(3), np.array([678_000.0, 5_404_000.0, 400.0]))
POSES = (
    PoseEstimate(T0_NS, 32632, AT, np.eye(6), "street", "ab" * 32, 50),
    NoPose(T0_NS + 1_000_000, "too dark (level 3)"),
    NoPose(T0_NS + 2_000_000, "too dark (level 2)"),
    PoseEstimate(T0_NS + 3_000_000, 32632, AT, np.eye(6), "street", "ab" * 32, 0, "predicted"),
)


@pytest.fixture
def outputs(tmp_path: Path) -> PoseOutputs:
    return PoseOutputs(tmp_path / "out.tum", tmp_path / "cov.csv", [tmp_path / "out.csv"], with_predicted=False)


def test_ctrl_c_leaves_what_there_is_and_says_so(outputs, tmp_path, capsys) -> None:
    code = finish(outputs, LocalizedDrive(POSES, ("street",), KeyboardInterrupt()), None, images=9)
    assert code == 130
    out, err = capsys.readouterr()
    assert err == "stopped after 4 of 9 images; what they gave is written\n"
    assert len(read_trajectory(tmp_path / "out.tum")) == 1
    assert len((tmp_path / "out.csv").read_text().splitlines()) == 5
    for line in ("poses:          1 (25.0 %)", "predicted:      1", "no pose:        2: too dark"):
        assert line in out.splitlines()


def test_a_server_that_fails_in_mid_drive_leaves_what_there_is(outputs, tmp_path) -> None:
    with pytest.raises(ServerError, match="gone"):
        finish(outputs, LocalizedDrive(POSES, ("street",), ServerError("gone")), None, images=9)
    assert len(read_trajectory(tmp_path / "out.tum")) == 1


def test_a_drive_without_a_pose_leaves_the_reasons_only(outputs, tmp_path) -> None:
    with pytest.raises(NoPoseError, match=r"not one of 2 images .* \(too dark\)"):
        finish(outputs, LocalizedDrive(POSES[1:3], ("street",)), None, images=2)
    assert [path.name for path in tmp_path.iterdir()] == ["out.csv"]
