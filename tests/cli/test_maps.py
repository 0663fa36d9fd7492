"""``fleetmap maps`` as a user types it, of a server in another process."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from fleetmap.manifest import manifest_version


@pytest.fixture
def publish_version(fleetmap, map_package: Path, shared_server: str) -> Callable[[str, int], str]:
    """Publishes the map under a name, as if it had been made at some time; the version."""

    def publish(map_id: str, created_ns: int) -> str:
        path = map_package / "manifest.json"
        manifest = json.loads(path.read_bytes()) | {"map_id": map_id}
        manifest["provenance"]["created_ns"] = created_ns
        path.write_text(json.dumps(manifest))
        assert fleetmap("publish", map_package, "--server", shared_server)[0] == 0
        return manifest_version(path.read_bytes())

    return publish


@pytest.fixture
def maps(fleetmap, shared_server: str) -> Callable[..., tuple[int, str, str]]:
    def call(verb: str, *arguments: object) -> tuple[int, str, str]:
        return fleetmap("maps", verb, *arguments, "--server", shared_server)

    return call


@pytest.fixture
def listed(maps) -> Callable[..., list[dict[str, Any]]]:
    """The versions of one map that a list holds."""

    def call(map_id: str, *arguments: str) -> list[dict[str, Any]]:
        code, out, _ = maps("list", *arguments, "--json")
        assert code == 0
        return [entry for entry in json.loads(out) if entry["map_id"] == map_id]

    return call


def test_maps_are_listed_as_a_table_and_as_json(fleetmap, map_package, map_server):
    assert fleetmap("maps", "list", "--server", map_server)[:2] == (0, "no maps\n")
    assert fleetmap("maps", "list", "--server", map_server, "--json")[:2] == (0, "[]\n")
    fleetmap("publish", map_package, "--server", map_server)
    manifest = json.loads((map_package / "manifest.json").read_bytes())

    code, out, _ = fleetmap("maps", "list", "--server", map_server)
    heading, row = out.splitlines()
    assert code == 0
    assert heading.split()[:4] == ["map", "version", "number", "EPSG"]
    assert row.split()[0] == manifest["map_id"]
    assert row.split()[2:4] == ["1", str(manifest["anchor"]["epsg"])]

    code, out, _ = fleetmap("maps", "list", "--server", map_server, "--json")
    (entry,) = json.loads(out)
    assert code == 0
    assert entry["map_id"] == manifest["map_id"]
    assert entry["bbox_lonlat"] == manifest["bbox_lonlat"]
    assert entry["keyframes"] == manifest["quality"]["keyframes"]


def test_near_keeps_the_maps_near_a_place(maps, listed, publish_version):
    publish_version("near", 1)
    west, south, _, _ = listed("near")[0]["bbox_lonlat"]
    found = [
        len(listed("near", "--near", place))
        for place in (f"{south},{west}", f"{south + 0.1},{west}", "-33.9,-151.2")
    ]
    assert found == [1, 0, 0]
    assert maps("list", "--near=-33.9,151.2") == (0, "no maps\n", "")
    code, out, err = maps("list", "--near", "91,8")
    assert (code, out) == (2, "")
    assert err == "error: latitude 91.0, longitude 8.0 is no place on the globe\n"


def test_area_and_time_keep_the_maps_of_a_region_and_a_day(listed, publish_version):
    publish_version("region", 1)
    (entry,) = listed("region")
    west, south, east, north = entry["bbox_lonlat"]
    day = datetime.fromtimestamp(entry["start_ns"] // 1_000_000_000, UTC)
    date, year = f"{day:%Y-%m-%d}", day.year
    for arguments, is_there in (
        (("--area", f"{west - 1},{south - 1},{east + 1},{north + 1}"), True),
        (("--area", f"{west},{south + 1},{east},{north + 1}"), False),
        (("--area", f"{west - 1},{south - 1},{west - 3},{north + 1}"), True),  # around the globe
        (("--time", date), True),
        (("--time", f"{date}/.."), True),
        (("--time", f"../{date}"), True),
        (("--time", f"{year + 1}-01-01/.."), False),
        (("--time", f"{year - 1}-01-01/{year - 1}-12-31T23:59Z"), False),
        (("--time", date, "--area", f"{west},{south + 1},{east},{north + 1}"), False),
    ):
        assert len(listed("region", *arguments)) == int(is_there), arguments


def test_an_older_version_becomes_the_latest_again_and_the_history_tells_it(maps, listed, publish_version):
    first, second, third = (publish_version("old", number) for number in (1, 2, 3))
    (entry,) = listed("old")
    assert (entry["version"], entry["number"], entry["predecessor"]) == (third, 3, second)

    assert maps("rollback", "old") == (0, f"map old: number 4 is the latest now, version {second[:12]}\n", "")
    assert maps("rollback", "old", first[:10])[1].startswith("map old: number 5 ")
    assert maps("rollback", "old", "3")[1].startswith("map old: number 6 ")
    code, out, err = maps("rollback", "old", "77")
    assert (code, out) == (1, "")
    assert "has no version 77" in err

    rows = maps("show", "old")[1].split("\n\n")[1].splitlines()[1:]
    versions = [third, first, second, third, second, first]
    assert [row.split()[:2] for row in rows] == [
        [str(number), version[:12]] for number, version in zip(range(6, 0, -1), versions, strict=True)
    ]
    assert ["rollback" in row for row in rows] == [True] * 3 + [False] * 3
    assert ["latest" in row for row in rows] == [True] + [False] * 5
    assert maps("show", "old", "--version", "2")[1].startswith("map        old, number 2\n")
    assert json.loads(maps("show", "old", "--version", first, "--json")[1])["number"] == 5
    assert [entry["number"] for entry in listed("old")] == [6]
    assert [entry["number"] for entry in listed("old", "--all-versions")] == [6, 5, 4, 3, 2, 1]


def test_what_is_retired_is_not_listed_any_more_and_a_whole_map_wants_a_yes(maps, listed, publish_version):
    for number in (1, 2):
        publish_version("gone", number)
    assert maps("retire", "gone", "--version", "1") == (0, "retired map gone, version 1\n", "")
    assert [entry["number"] for entry in listed("gone", "--all-versions")] == [2]
    code, _, err = maps("rollback", "gone")
    assert code == 2
    assert "nothing to go back to" in err
    code, _, err = maps("retire", "gone", "--version", "2")
    assert (code, "is the latest of map" in err) == (1, True)
    code, out, err = maps("retire", "gone")
    assert (code, out) == (2, "")
    assert "retiring the whole map 'gone' needs --yes" in err
    assert maps("retire", "gone", "--yes") == (0, "retired map gone\n", "")
    assert listed("gone") == []
    assert maps("show", "gone")[0] == 1


@pytest.mark.parametrize(
    ("option", "value", "name"),
    [
        ("--near", "49", "LAT,LON"),
        ("--near", "49,8,1", "LAT,LON"),
        ("--near", "a,b", "LAT,LON"),
        ("--near", "nan,8", "LAT,LON"),
        ("--area", "8,49,9", "WEST,SOUTH,EAST,NORTH"),
        ("--time", "yesterday", "FROM/TO"),
        ("--time", "2026-03-01/2026-02-30", "FROM/TO"),
    ],
)
def test_a_place_or_time_that_is_none_is_a_usage_error(fleetmap, option, value, name):
    code, out, err = fleetmap("maps", "list", option, value)
    assert (code, out) == (2, "")
    assert f"'{value}' is not {name}" in err


def test_a_time_that_ends_before_it_begins_is_a_usage_error(fleetmap):
    code, _, err = fleetmap("maps", "list", "--time", "2026-03-02/2026-03-01")
    assert code == 2
    assert "ends before it begins" in err


def test_an_absent_server_is_one_line(fleetmap, absent_server):
    code, out, err = fleetmap("maps", "list", "--server", absent_server)
    assert (code, out) == (1, "")
    remedy = "start one with 'fleetmap serve', or give its endpoint"
    assert err == f"error: no map server answers at {absent_server}; {remedy}\n"


def test_new_versions_are_followed_from_the_ones_that_are_there(publish_version, shared_server):
    first = publish_version("followed", 1_700_000_000_000_000_000)
    command = [sys.executable, "-c", "from fleetmap_cli.main import main; main()", "maps", "follow"]
    process = subprocess.Popen(
        [*command, "--server", shared_server], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    try:
        lines = (line for line in iter(process.stdout.readline, "") if line.startswith("followed "))
        assert next(lines).startswith(f"followed  number 1  version {first[:12]}  20")
        second = publish_version("followed", 1_700_000_001_000_000_000)
        assert next(lines).startswith(f"followed  number 2  version {second[:12]}  20")
    finally:
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=20)
    assert (process.returncode, err.strip()) == (130, "interrupted")
