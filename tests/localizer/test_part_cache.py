"""Parts on the vehicle's disk: whole, or not there."""

from __future__ import annotations

import hashlib
import logging
import os
import time
from pathlib import Path

import pytest

from fleetmap_localizer.part_cache import PartCache

PART, OTHER = bytes(range(256)) * 40, b"another part"
PLENTY = 1_000_000


def sha256_of(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def keep(cache: PartCache, data: bytes) -> str:
    cache.keep(sha256_of(data), data)
    return sha256_of(data)


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def test_what_was_kept_is_there_for_the_next_process(tmp_path: Path) -> None:
    sha256 = keep(PartCache(tmp_path / "cache", PLENTY), PART)
    assert PartCache(tmp_path / "cache", PLENTY).get(sha256, len(PART)) == PART
    assert PartCache(tmp_path / "cache", PLENTY).get(sha256_of(OTHER), len(OTHER)) is None
    assert names(tmp_path / "cache") == {f"{sha256}.bin"}


@pytest.mark.parametrize("damage", ["flipped", "shorter", "longer", "empty"])
def test_a_damaged_part_counts_as_missing_and_can_be_replaced(tmp_path: Path, damage: str) -> None:
    cache = PartCache(tmp_path, PLENTY)
    sha256 = keep(cache, PART)
    damaged = {
        "flipped": bytes([PART[0] ^ 1]) + PART[1:],
        "shorter": PART[:-1],
        "longer": PART + b"x",
        "empty": b"",
    }
    (tmp_path / f"{sha256}.bin").write_bytes(damaged[damage])
    assert cache.get(sha256, len(PART)) is None
    keep(cache, PART)
    assert cache.get(sha256, len(PART)) == PART


def test_a_cache_that_cannot_be_written_costs_one_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "cache").write_text("a file where the folder should be")
    cache = PartCache(tmp_path / "cache", PLENTY)
    with caplog.at_level(logging.WARNING):
        keep(cache, PART)
        keep(cache, OTHER)
    assert caplog.text.count("maps are not kept for the next time") == 1
    assert cache.get(sha256_of(PART), len(PART)) is None


def test_what_was_not_used_for_longest_makes_room(tmp_path: Path) -> None:
    cache = PartCache(tmp_path, 1000)
    hashes = []
    for number in range(9):
        hashes.append(keep(cache, bytes([number]) * 100))
        old_s = time.time() - 1000.0 + number
        os.utime(tmp_path / f"{hashes[-1]}.bin", (old_s, old_s))
    assert cache.get(hashes[0], 100) is not None  # used just now
    hashes += [keep(cache, bytes([number]) * 100) for number in range(9, 12)]
    kept = [cache.get(sha256, 100) is not None for sha256 in hashes]
    assert sum(path.stat().st_size for path in tmp_path.iterdir()) <= 1000
    assert kept[0]
    assert not kept[1]
    assert not kept[2]
    assert all(kept[4:])


def test_two_processes_share_a_folder_and_its_limit(tmp_path: Path) -> None:
    first, second = PartCache(tmp_path, 1000), PartCache(tmp_path, 1000)
    hashes = [keep((first, second)[number % 2], bytes([number]) * 100) for number in range(40)]
    used_bytes = sum(path.stat().st_size for path in tmp_path.iterdir())
    assert 500 <= used_bytes <= 2000  # each counts what it writes itself, and all that is there when it is full
    assert first.get(hashes[-1], 100) == second.get(hashes[-1], 100) == bytes([39]) * 100


def test_what_a_killed_process_left_is_cleared_up_but_not_what_is_being_written(tmp_path: Path) -> None:
    (tmp_path / ".dead.part").write_bytes(b"x")
    os.utime(tmp_path / ".dead.part", (0.0, 0.0))
    (tmp_path / ".alive.part").write_bytes(b"x")
    sha256 = keep(PartCache(tmp_path, PLENTY), PART)
    assert names(tmp_path) == {".alive.part", f"{sha256}.bin"}
