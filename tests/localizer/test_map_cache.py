"""What a vehicle remembers of its servers."""

from __future__ import annotations

from pathlib import Path

import pytest

from fleetmap.catalogue import MapEntry
from fleetmap_localizer.map_cache import MapCache

PLENTY = 1_000_000
HERE, THERE = "tcp/127.0.0.1:7447", "tcp/10.0.0.1:7447"


@pytest.fixture
def entry(mapped_street) -> MapEntry:
    return MapEntry.from_manifest(mapped_street.manifest, "0" * 64, 1000, 7)


def test_the_catalogue_of_each_server_is_remembered_as_it_was_last(tmp_path: Path, entry: MapEntry) -> None:
    MapCache(tmp_path, PLENTY).keep_catalogue(HERE, [])
    MapCache(tmp_path, PLENTY).keep_catalogue(HERE, [entry])
    assert MapCache(tmp_path, PLENTY).catalogue(HERE) == [entry]
    assert MapCache(tmp_path, PLENTY).catalogue(THERE) == []


def test_a_catalogue_that_cannot_be_read_is_none(tmp_path: Path, entry: MapEntry) -> None:
    cache = MapCache(tmp_path, PLENTY)
    cache.keep_catalogue(HERE, [entry])
    (file,) = (tmp_path / "catalogues").iterdir()
    file.write_bytes(file.read_bytes()[:-9])
    assert cache.catalogue(HERE) == []


def test_where_nothing_can_be_written_nothing_is_remembered(tmp_path: Path, entry: MapEntry) -> None:
    (tmp_path / "cache").write_text("a file where the folder should be")
    cache = MapCache(tmp_path / "cache", PLENTY)
    cache.keep_catalogue(HERE, [entry])
    assert cache.catalogue(HERE) == []
