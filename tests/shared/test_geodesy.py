from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pyproj import Geod

from fleetmap.errors import InputError
from fleetmap.geodesy import UtmAnchor, UtmGrid, normal_gravity_m_s2, utm_epsg

GEOD = Geod(ellps="WGS84")
latitudes = st.floats(-79.5, 83.5)


@pytest.mark.parametrize(
    ("lat_deg", "lon_deg", "epsg"),
    [
        (49.0, 8.4, 32632),
        (49.0, 11.9999, 32632),
        (49.0, 12.0, 32633),
        (0.0, 0.0, 32631),
        (-33.9, 151.2, 32756),
        (10.0, -180.0, 32601),
        (10.0, 179.999, 32660),
        (10.0, 180.0, 32660),
    ],
)
def test_a_position_lies_in_its_zone(lat_deg, lon_deg, epsg):
    assert utm_epsg(lat_deg, lon_deg) == epsg
    assert UtmGrid.at(lat_deg, lon_deg).epsg == epsg


@pytest.mark.parametrize(
    ("lat_deg", "lon_deg"), [(84.1, 0.0), (-80.1, 0.0), (0.0, 181.0), (float("nan"), 0.0), (0.0, float("nan"))]
)
def test_positions_outside_utm_are_refused(lat_deg, lon_deg):
    with pytest.raises(InputError, match="outside UTM"):
        utm_epsg(lat_deg, lon_deg)


@pytest.mark.parametrize("epsg", [4326, 25832, 32600, 32661, 32700, 32761])
def test_what_is_no_utm_zone_is_refused(epsg):
    with pytest.raises(InputError, match=str(epsg)):
        UtmGrid(epsg)


def test_a_published_position_and_the_origins_of_the_grid():
    """The CN Tower, 43 deg 38' 33.24" N, 79 deg 23' 13.7" W, is published as 17T 630084 E 4833438 N."""
    lat_deg, lon_deg = 43 + 38 / 60 + 33.24 / 3600, -(79 + 23 / 60 + 13.7 / 3600)
    tower = UtmGrid.at(lat_deg, lon_deg).from_geodetic(np.array(lat_deg), np.array(lon_deg), np.array(76.0))
    assert tower == pytest.approx([630_084.0, 4_833_438.0, 76.0], abs=1.0)
    on_meridian = UtmGrid(32632).from_geodetic(np.array(0.0), np.array(9.0), np.array(0.0))
    assert on_meridian == pytest.approx([500_000.0, 0.0, 0.0], abs=1e-6)
    south = UtmGrid(32732).from_geodetic(np.array(-1e-9), np.array(9.0), np.array(0.0))
    assert south[1] == pytest.approx(10_000_000.0, abs=1e-3)


@given(latitudes, st.floats(-179.9, 179.9), st.floats(-400.0, 9000.0))
def test_there_and_back_is_the_same_position(lat_deg, lon_deg, height_m):
    grid = UtmGrid.at(lat_deg, lon_deg)
    point = grid.from_geodetic(*(np.array([value]) for value in (lat_deg, lon_deg, height_m)))
    back = [float(value[0]) for value in grid.to_geodetic(point)]
    assert back == pytest.approx([lat_deg, lon_deg, height_m], abs=1e-8)


@given(latitudes, st.floats(-3.0, 3.0), st.integers(1, 60))
def test_convergence_and_scale_agree_with_a_short_step_north(lat_deg, off_meridian_deg, zone):
    """A metre along true north, on the ellipsoid: grid bearing minus the convergence, length times the scale."""
    grid = UtmGrid((32600 if lat_deg >= 0 else 32700) + zone)
    lon_deg = -183.0 + 6.0 * zone + off_meridian_deg
    lon2, lat2, _ = GEOD.fwd(lon_deg, lat_deg, 0.0, 10.0)
    zero = np.zeros(2)
    first, second = grid.from_geodetic(np.array([lat_deg, lat2]), np.array([lon_deg, lon2]), zero)
    east, north, _ = second - first
    assert np.arctan2(-east, north) == pytest.approx(grid.convergence_rad(lat_deg, lon_deg), abs=2e-5)
    assert np.hypot(east, north) / 10.0 == pytest.approx(grid.point_scale_factor(lat_deg, lon_deg), abs=2e-6)


def test_convergence_is_positive_east_of_the_meridian_in_the_north():
    assert UtmGrid(32632).convergence_rad(48.0, 11.5) == pytest.approx(np.radians(1.858), abs=1e-4)
    assert UtmGrid(32632).convergence_rad(48.0, 6.5) < 0.0
    assert UtmGrid(32732).convergence_rad(-48.0, 11.5) < 0.0


def test_the_scale_is_0_9996_on_the_meridian():
    assert UtmGrid(32632).point_scale_factor(49.0, 9.0) == pytest.approx(0.9996, abs=1e-9)


@pytest.mark.parametrize("azimuth_deg", [0.0, 37.0, 90.0, 200.0])
def test_true_directions_turn_into_grid_directions(azimuth_deg):
    grid, lat_deg, lon_deg = UtmGrid(32632), 48.0, 11.5
    lon2, lat2, _ = GEOD.fwd(lon_deg, lat_deg, azimuth_deg, 10.0)
    first, second = grid.from_geodetic(np.array([lat_deg, lat2]), np.array([lon_deg, lon2]), np.zeros(2))
    azimuth = np.radians(azimuth_deg)
    enu = np.array([10.0 * np.sin(azimuth), 10.0 * np.cos(azimuth), 0.0])
    turned = grid.grid_from_enu(lat_deg, lon_deg) @ enu * grid.point_scale_factor(lat_deg, lon_deg)
    assert turned == pytest.approx(second - first, abs=1e-4)
    assert np.linalg.norm(enu - (second - first)) > 0.3  # taking UTM for ENU would show


def test_gravity_is_what_the_standard_publishes():
    """NIMA TR8350.2, table 3.4: at the equator and at the poles; it wanes by 3.1 um/s2 a metre."""
    assert normal_gravity_m_s2(0.0, 0.0) == pytest.approx(9.7803253359, abs=1e-9)
    assert normal_gravity_m_s2(-90.0, 0.0) == pytest.approx(9.8321849378, abs=1e-8)
    assert normal_gravity_m_s2(45.0, 1000.0) - normal_gravity_m_s2(45.0, 0.0) == pytest.approx(-3.086e-3, abs=2e-5)


def test_an_anchor_is_whole_metres_and_cancels():
    anchor = UtmAnchor(32632, 457_000, 5_428_000, 116)
    points = np.array([[457_012.345678, 5_428_001.5, 120.25], [0.0, 0.0, 0.0]])
    assert anchor.map_from_utm(points)[0] == pytest.approx([12.345678, 1.5, 4.25])
    assert anchor.utm_from_map(anchor.map_from_utm(points)) == pytest.approx(points, abs=1e-9)
