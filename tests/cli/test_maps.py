"""``fleetmap maps list`` as a user types it, of a server in another process."""

from __future__ import annotations

import json

import pytest


def test_maps_are_listed_as_a_table_and_as_json(fleetmap, map_package, map_server):
    assert fleetmap("maps", "list", "--server", map_server)[:2] == (0, "no maps\n")
    assert fleetmap("maps", "list", "--server", map_server, "--json")[:2] == (0, "[]\n")
    fleetmap("publish", map_package, "--server", map_server)
    manifest = json.loads((map_package / "manifest.json").read_bytes())

    code, out, _ = fleetmap("maps", "list", "--server", map_server)
    heading, row = out.splitlines()
    assert code == 0
    assert heading.split()[:3] == ["map", "version", "EPSG"]
    assert row.split()[0] == manifest["map_id"]
    assert row.split()[2] == str(manifest["anchor"]["epsg"])

    code, out, _ = fleetmap("maps", "list", "--server", map_server, "--json")
    (entry,) = json.loads(out)
    assert code == 0
    assert entry["map_id"] == manifest["map_id"]
    assert entry["bbox_lonlat"] == manifest["bbox_lonlat"]
    assert entry["keyframes"] == manifest["quality"]["keyframes"]


def test_near_keeps_the_maps_near_a_place(fleetmap, map_package, map_server):
    fleetmap("publish", map_package, "--server", map_server)
    west, south, _, _ = json.loads((map_package / "manifest.json").read_bytes())["bbox_lonlat"]
    listed = [
        fleetmap("maps", "list", "--server", map_server, "--near", place)[1].count("\n")
        for place in (f"{south},{west}", f"{south + 0.1},{west}", "-33.9,-151.2")
    ]
    assert listed == [2, 1, 1]
    assert fleetmap("maps", "list", "--server", map_server, "--near=-33.9,151.2")[:2] == (0, "no maps\n")
    code, out, err = fleetmap("maps", "list", "--server", map_server, "--near", "91,8")
    assert (code, out) == (2, "")
    assert err == "error: latitude 91.0, longitude 8.0 is no place on the globe\n"


@pytest.mark.parametrize("place", ["49", "49,8,1", "a,b", "nan,8"])
def test_a_place_that_is_none_is_a_usage_error(fleetmap, place):
    code, out, err = fleetmap("maps", "list", "--near", place)
    assert (code, out) == (2, "")
    assert f"'{place}' is not LAT,LON" in err


def test_an_absent_server_is_one_line(fleetmap, absent_server):
    code, out, err = fleetmap("maps", "list", "--server", absent_server)
    assert (code, out) == (1, "")
    remedy = "start one with 'fleetmap serve', or give its endpoint"
    assert err == f"error: no map server answers at {absent_server}; {remedy}\n"
