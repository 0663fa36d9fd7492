"""Parts on the vehicle's disk: whole, or fetched again."""

from __future__ import annotations

import hashlib
import logging
from pathlib import Path

import pytest

from fleetmap_localizer.part_cache import PartCache

PART = bytes(range(256)) * 40
SHA256 = hashlib.sha256(PART).hexdigest()


class Server:
    def __init__(self) -> None:
        self.asked = 0

    def download(self) -> bytes:
        self.asked += 1
        return PART


def test_a_part_is_fetched_once(tmp_path: Path) -> None:
    server = Server()
    for _ in range(3):
        assert PartCache(tmp_path / "cache").part(SHA256, len(PART), server.download) == PART
    assert server.asked == 1
    assert [file.name for file in (tmp_path / "cache").iterdir()] == [f"{SHA256}.bin"]


@pytest.mark.parametrize("damage", ["flipped", "shorter", "longer", "empty"])
def test_a_damaged_part_is_fetched_again(tmp_path: Path, damage: str) -> None:
    server, path = Server(), tmp_path / f"{SHA256}.bin"
    damaged = {
        "flipped": bytes([PART[0] ^ 1]) + PART[1:],
        "shorter": PART[:-1],
        "longer": PART + b"x",
        "empty": b"",
    }
    path.write_bytes(damaged[damage])
    assert PartCache(tmp_path).part(SHA256, len(PART), server.download) == PART
    assert server.asked == 1
    assert path.read_bytes() == PART


def test_a_cache_that_cannot_be_written_costs_a_warning_only(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "cache").write_text("a file where the folder should be")
    with caplog.at_level(logging.WARNING):
        assert PartCache(tmp_path / "cache").part(SHA256, len(PART), Server().download) == PART
    assert "the map is not kept for the next time" in caplog.text


def test_a_failed_download_leaves_nothing_behind(tmp_path: Path) -> None:
    def fail() -> bytes:
        raise ConnectionError("cut")

    with pytest.raises(ConnectionError):
        PartCache(tmp_path).part(SHA256, len(PART), fail)
    assert list(tmp_path.iterdir()) == []
