"""Fixtures that every room's tests share."""

from __future__ import annotations

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def data_folder() -> Path:
    """The folder of real recordings; tests that need it are skipped where it is absent."""
    default = Path(__file__).resolve().parents[1] / ".." / "shared" / "data"
    folder = Path(os.environ.get("FLEETMAP_DATA", default)).resolve()
    if not folder.is_dir():
        pytest.skip(f"no real recordings at {folder}; set FLEETMAP_DATA to their folder")
    return folder


@pytest.fixture(scope="session")
def drives_folder(data_folder: Path) -> Path:
    """The folder of real KITTI drives."""
    return data_folder / "drives"
