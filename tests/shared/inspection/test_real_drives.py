"""A real drive through two turns, with fixes made from its reference: the clocks agree, and the drive is good."""

from __future__ import annotations

import pytest

from fleetmap.drives.kitti_odometry import SimulatedGnss, convert_kitti_odometry
from fleetmap.inspection.judging import judge_drive


def test_a_real_drive_is_good_and_its_clocks_agree(drives_folder, tmp_path):
    gnss = SimulatedGnss("rtk", 1.0)
    convert_kitti_odometry(drives_folder / "kitti_odo_00_first300", tmp_path / "odo.mcap", gnss=gnss)
    judgement = judge_drive(tmp_path / "odo.mcap")
    assert {finding.severity for finding in judgement.findings} == {"good"}
    assert judgement.clock_offset.offset_s == pytest.approx(0.0, abs=0.02)
    assert judgement.images is not None
    assert judgement.images.followed_corners > 200
    assert 0.2 < judgement.images.blur < 0.35
