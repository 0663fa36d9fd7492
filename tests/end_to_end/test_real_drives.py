"""The real drives through the command line, as far as a test has time; skipped where there are no recordings."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

FLEETMAP = [sys.executable, "-c", "from fleetmap_cli.main import main; main()"]
STRETCH_S = 15.5  # 150 images at 9.7 Hz: the turn and the first 100 m of the straight


def fleetmap(*arguments: object) -> str:
    run = subprocess.run(
        [*FLEETMAP, *map(str, arguments)], capture_output=True, text=True, timeout=400, check=False
    )
    assert run.returncode == 0, run.stderr
    return run.stdout


def cut(recording: Path, target: Path, until_ns: int) -> Path:
    """The beginning of a recording, message by message."""
    with recording.open("rb") as old, target.open("wb") as new:
        writer = Writer(new)
        writer.start("ros2")
        channels: dict[int, int] = {}
        for schema, channel, message in make_reader(old).iter_messages():
            assert schema is not None
            if channel.id not in channels:
                schema_id = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, schema_id)
            if message.log_time <= until_ns:
                writer.add_message(channels[channel.id], message.log_time, message.data, message.publish_time)
        writer.finish()
    return target


def first_image_ns(recording: Path) -> int:
    with recording.open("rb") as file:
        times = (m.log_time for _, c, m in make_reader(file).iter_messages() if "image" in c.topic)
        return next(times)


def second_camera_in_first(calibration: Path) -> str:
    """Centre of camera 1 in camera 0's frame, from x_1 = R_01 x_0 + T_01."""
    fields = dict(line.split(":", 1) for line in calibration.read_text().splitlines() if ":" in line)
    R = np.array(fields["R_01"].split(), dtype=float).reshape(3, 3)
    T = np.array(fields["T_01"].split(), dtype=float)
    return ",".join(f"{value:.6f}" for value in -R.T @ T)


def test_a_second_camera_is_localised_in_the_map_of_the_first(drives_folder, tmp_path):
    source = drives_folder / "kitti_raw_20110926_1405"
    if not source.is_dir():
        pytest.skip(f"no {source.name} among the real drives")
    for name, options in (("survey", ["--camera", "0"]), ("second", ["--camera", "1", "--no-gnss"])):
        fleetmap("convert", "kitti-raw", source, tmp_path / f"{name}.whole.mcap", *options)
    until_ns = first_image_ns(tmp_path / "survey.whole.mcap") + int(STRETCH_S * 1e9)
    survey, second = (
        cut(tmp_path / f"{n}.whole.mcap", tmp_path / f"{n}.mcap", until_ns) for n in ("survey", "second")
    )
    trajectories = tmp_path / "survey.tum", tmp_path / "second.tum"
    out = fleetmap("map", survey, "--output", tmp_path / "my_map", "--trajectory", trajectories[0])
    posed, total = (int(n) for n in re.findall(r"images posed:  (\d+) of (\d+)", out)[0])
    assert posed == total >= 145
    out = fleetmap("localize", second, "--map", tmp_path / "my_map", "--trajectory", trajectories[1])
    images, poses = (int(re.findall(rf"{word}: +(\d+)", out)[0]) for word in ("frames", "poses"))
    assert images >= 70
    assert poses >= 0.95 * images
    offset = second_camera_in_first(source / "calib_cam_to_cam.txt")
    relative = json.loads(
        fleetmap(
            "evaluate", trajectories[1], "--against-map", trajectories[0], "--camera-offset", offset, "--json"
        )
    )["against_map"]
    assert relative["coverage"] >= 0.95
    assert 0.005 < relative["position_m"]["median"] <= 0.10
    assert relative["over_2m"] == 0
    assert relative["rotation_deg"]["median"] < 3.0  # the two cameras are not mounted quite alike


def test_a_fix_every_five_seconds_is_enough_for_two_decimetres(drives_folder, tmp_path):
    source = drives_folder / "kitti_odo_00_first300"
    if not source.is_dir():
        pytest.skip(f"no {source.name} among the real drives")
    options = ["--gnss-error", "rtk", "--gnss-interval-s", "5", "--seed", "7"]
    recording, trajectory = tmp_path / "o00.mcap", tmp_path / "o00.tum"
    fleetmap("convert", "kitti-odometry", source, recording, *options)
    out = fleetmap("map", recording, "--output", tmp_path / "o00", "--trajectory", trajectory)
    assert "images posed:  300 of 300" in out
    reference = tmp_path / "o00.reference.tum"
    errors = json.loads(fleetmap("evaluate", trajectory, reference, "--spline-through", recording, "--json"))
    assert 0.01 < errors["reference"]["position_m"]["mean"] <= 0.20
    assert errors["spline"]["position_m"]["mean"] > 0.6  # what the fixes alone would give
    assert errors["reference"]["rotation_deg"]["mean"] < 1.5
