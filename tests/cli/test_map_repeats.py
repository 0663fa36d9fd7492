"""The same drive, settings and machine give the same map, to the last byte, in every process."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

FLEETMAP = [sys.executable, "-c", "from fleetmap_cli.main import main; main()"]


def start_mapping(drive: Path, folder: Path, **environment: str) -> subprocess.Popen[str]:
    arguments = ["map", str(drive), "--output", str(folder / "map"), "--trajectory", str(folder / "drive.tum")]
    return subprocess.Popen(
        [*FLEETMAP, *arguments, "--set", "features.count=1200"],
        env={**os.environ, **environment},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def contents(folder: Path) -> tuple[list[str], bytes]:
    """The content hashes of the map's parts, and the trajectory's bytes."""
    manifest = json.loads((folder / "map" / "manifest.json").read_text())
    return [part["sha256"] for part in manifest["parts"]], (folder / "drive.tum").read_bytes()


def test_neither_the_order_of_sets_nor_who_runs_beside_changes_a_map(survey_frames, write_drive, tmp_path):
    """Two processes with other hash seeds, at the same time, so that their threads take turns in other ways."""
    drive = write_drive(tmp_path / "short.mcap", survey_frames[:40])
    folders = [tmp_path / name for name in ("first", "second")]
    runs = [start_mapping(drive, folder, PYTHONHASHSEED=str(n)) for n, folder in enumerate(folders, 1)]
    said = [run.communicate(timeout=300)[0] for run in runs]
    assert [run.returncode for run in runs] == [0, 0], said
    first, second = map(contents, folders)
    assert len(first[0]) >= 2
    assert first == second
