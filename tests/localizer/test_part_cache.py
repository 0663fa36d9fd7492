"""Parts on the vehicle's disk: whole, or fetched again."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest

from fleetmap_localizer.part_cache import PartCache

PART, OTHER = bytes(range(256)) * 40, b"another part"
SHA256, OTHER_SHA256 = hashlib.sha256(PART).hexdigest(), hashlib.sha256(OTHER).hexdigest()
SIZES = {SHA256: len(PART)}


class Server:
    def __init__(self) -> None:
        self.asked: list[str] = []

    def download(self, sizes_bytes: Mapping[str, int]) -> Iterator[bytes]:
        for sha256 in sizes_bytes:
            self.asked.append(sha256)
            yield {SHA256: PART, OTHER_SHA256: OTHER}[sha256]


def test_a_part_is_fetched_once(tmp_path: Path) -> None:
    server = Server()
    for _ in range(3):
        assert PartCache(tmp_path / "cache").parts(SIZES, server.download) == [PART]
    assert server.asked == [SHA256]
    assert [file.name for file in (tmp_path / "cache").iterdir()] == [f"{SHA256}.bin"]


def test_only_what_is_missing_is_fetched_and_all_comes_in_order(tmp_path: Path) -> None:
    server = Server()
    PartCache(tmp_path).parts(SIZES, server.download)
    both = {OTHER_SHA256: len(OTHER), SHA256: len(PART)}
    assert PartCache(tmp_path).parts(both, server.download) == [OTHER, PART]
    assert server.asked == [SHA256, OTHER_SHA256]


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
    assert PartCache(tmp_path).parts(SIZES, server.download) == [PART]
    assert server.asked == [SHA256]
    assert path.read_bytes() == PART


def test_a_cache_that_cannot_be_written_costs_a_warning_only(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "cache").write_text("a file where the folder should be")
    with caplog.at_level(logging.WARNING):
        assert PartCache(tmp_path / "cache").parts(SIZES, Server().download) == [PART]
    assert "the map is not kept for the next time" in caplog.text


def test_a_failed_download_leaves_nothing_behind(tmp_path: Path) -> None:
    def fail(sizes_bytes: Mapping[str, int]) -> Iterator[bytes]:
        raise ConnectionError("cut")

    with pytest.raises(ConnectionError):
        PartCache(tmp_path).parts(SIZES, fail)
    assert list(tmp_path.iterdir()) == []
