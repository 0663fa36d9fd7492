"""``fleetmap map --refine-calibration`` as a user types it."""

from __future__ import annotations

from pathlib import Path


def test_help_teaches_what_refining_does(fleetmap):
    code, out, _ = fleetmap("map", "--help")
    assert code == 0
    for word in ("--refine-calibration", "--recorded-calibration", "focal length", "straight road"):
        assert word in " ".join(out.split())


def test_refining_without_an_adjustment_is_refused_with_one_line(fleetmap, tmp_path: Path):
    (tmp_path / "drive.mcap").touch()
    code, out, err = fleetmap(
        "map", tmp_path / "drive.mcap", "--output", tmp_path / "map", "--gnss", "mapping", "--refine-calibration"
    )
    assert (code, out) == (2, "")
    assert err.startswith("error: --refine-calibration needs an adjustment")
    assert err.count("\n") == 1
    assert not (tmp_path / "map").exists()
