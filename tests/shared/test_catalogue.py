"""Distances and search boxes of the catalogue, against geodesics."""

from __future__ import annotations

import numpy as np
import pytest
from pyproj import Geod

from fleetmap.catalogue import MapEntry, distances_m, search_box_lonlat

GEOD = Geod(ellps="WGS84")


def entry(*path: tuple[float, float], box: tuple[float, float, float, float] | None = None) -> MapEntry:
    lons, lats = [p[0] for p in path], [p[1] for p in path]
    return MapEntry(
        map_id="street",
        version="0" * 64,
        epsg=32632,
        bbox_lonlat=box or (min(lons), min(lats), max(lons), max(lats)),
        trajectory_lonlat=path,
        start_ns=0,
        end_ns=1,
        created_ns=2,
        published_ns=3,
        keyframes=2,
        landmarks=20,
        length_m=100.0,
        size_bytes=1000,
        publishable=True,
        gnss_mode="full",
        gnss_residual_rms_m=None,
        reprojection_rms_px=0.5,
    )


@pytest.mark.parametrize("place", [(8.4, 49.0), (-70.6, -33.4), (25.7, 71.1), (179.999, -16.5), (-179.999, -16.5)])
@pytest.mark.parametrize("distance_m", [0.0, 3.0, 700.0, 5000.0])
def test_distance_is_to_the_nearest_point_of_the_trajectory(place, distance_m):
    lon, lat = place
    east = GEOD.fwd(lon, lat, 90.0, 400.0)[:2]
    west = GEOD.fwd(lon, lat, 270.0, 400.0)[:2]
    seen_lon, seen_lat, _ = GEOD.fwd(lon, lat, 0.0, distance_m)
    beyond_lon, beyond_lat, _ = GEOD.fwd(lon, lat, 90.0, 400.0 + distance_m)
    street = entry(west, east)
    assert street.distance_m(seen_lat, seen_lon) == pytest.approx(distance_m, rel=2e-3, abs=0.1)
    assert street.distance_m(beyond_lat, beyond_lon) == pytest.approx(distance_m, rel=2e-3, abs=0.1)


def test_a_single_position_and_no_position_have_distances_too():
    assert entry((8.4, 49.0)).distance_m(49.0, 8.4) == pytest.approx(0.0, abs=1e-6)
    boxed = entry(box=(8.40, 49.00, 8.41, 49.01))
    assert boxed.distance_m(49.005, 8.40) == pytest.approx(0.0, abs=0.1)
    assert boxed.distance_m(49.02, 8.405) == pytest.approx(GEOD.inv(8.405, 49.01, 8.405, 49.02)[2], rel=2e-3)


@pytest.mark.parametrize("lat", [-84.0, -33.4, 0.0, 49.0, 71.0, 84.0])
@pytest.mark.parametrize("radius_m", [10.0, 1000.0, 50_000.0])
def test_a_search_box_holds_its_circle_and_not_much_more(lat, radius_m):
    west, south, east, north = search_box_lonlat(lat, 8.4, radius_m)
    for bearing in range(0, 360, 5):
        on_circle_lon, on_circle_lat, _ = GEOD.fwd(8.4, lat, bearing, radius_m)
        assert west <= on_circle_lon <= east
        assert south <= on_circle_lat <= north
    height_m = GEOD.inv(8.4, south, 8.4, north)[2]
    assert 2.0 * radius_m <= height_m <= 2.1 * radius_m


def test_a_search_box_across_180_degrees_begins_east_of_its_end():
    west, _, east, _ = search_box_lonlat(-16.5, 179.999, 1000.0)
    assert 179.9 < west < 180.0
    assert -180.0 < east < -179.9


def test_a_search_box_over_a_pole_takes_all_longitudes():
    west, south, east, north = search_box_lonlat(89.999, 8.4, 10_000.0)
    assert (west, east, north) == (-180.0, 180.0, 90.0)
    assert 89.8 < south < 89.95


def test_entries_survive_their_journey_as_json():
    street = entry((8.4, 49.0), (8.5, 49.1))
    assert MapEntry.model_validate_json(street.model_dump_json()) == street


def test_an_entry_of_an_older_server_has_no_history():
    street = entry((8.4, 49.0), (8.5, 49.1))
    written_before = set(MapEntry.model_fields) - {
        name for name, field in MapEntry.model_fields.items() if not field.is_required() and name != "warnings"
    }
    old = MapEntry.model_validate_json(street.model_dump_json(include=written_before))
    assert old == street
    assert (old.number, old.is_latest, old.predecessor, old.retired, old.origin) == (
        1,
        True,
        None,
        False,
        "published",
    )


def test_a_distance_does_not_depend_on_what_else_is_measured():
    rng = np.random.default_rng(3)
    places = np.array([8.4, 49.0]) + rng.normal(0.0, 0.05, (40, 1, 2))
    paths = [place + rng.normal(0.0, 0.01, (1 + number % 7, 2)) for number, place in enumerate(places)]
    together = distances_m(paths, 49.01, 8.43)
    assert together.tolist() == [float(distances_m([path], 49.01, 8.43)[0]) for path in paths]
    assert together[::-1].tolist() == distances_m(paths[::-1], 49.01, 8.43).tolist()
    assert distances_m([], 49.01, 8.43).shape == (0,)
