"""A camera's pose as GeoPose: true north, the camera's axes as a body, and back."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError
from pyproj import Geod
from scipy.spatial.transform import Rotation

from fleetmap.geodesy import UtmGrid, utm_epsg
from fleetmap.geometry import CAM_FROM_BODY, Pose, so3_exp
from fleetmap.geopose import GeoPose, GeoQuaternion, geo_pose

GEOD = Geod(ellps="WGS84")
VERSION = "ab" * 32
PLACES = [(48.0, 11.5), (48.0, 8.0), (-33.9, 18.4), (-33.9, 151.2), (59.0, 5.9), (0.0, 9.0)]


def pose_of(epsg: int, utm_from_cam: Pose, covariance: np.ndarray | None = None) -> GeoPose:
    covariance = np.diag([1e-6] * 3 + [1e-4] * 3) if covariance is None else covariance
    return geo_pose(epsg, utm_from_cam, covariance, map_id="street", version=VERSION, stamp_ns=7)


def looking(azimuth_deg: float, lat_deg: float, lon_deg: float) -> tuple[int, Pose]:
    """A level camera that looks along a true azimuth, made with nothing but geodesics: two points on its axis."""
    epsg = utm_epsg(lat_deg, lon_deg)
    ahead_lon, ahead_lat, _ = GEOD.fwd(lon_deg, lat_deg, azimuth_deg, 5.0)
    here, ahead = UtmGrid(epsg).from_geodetic(
        np.array([lat_deg, ahead_lat]), np.array([lon_deg, ahead_lon]), np.array([120.0, 120.0])
    )
    forward = (ahead - here) / np.linalg.norm(ahead - here)
    down = np.array([0.0, 0.0, -1.0])
    return epsg, Pose(np.stack([np.cross(down, forward), down, forward], axis=1), here)


@pytest.mark.parametrize(("lat_deg", "lon_deg"), PLACES)
@pytest.mark.parametrize("azimuth_deg", [0.0, 77.0, 90.0, 290.0])
def test_the_heading_is_the_true_one_on_either_side_of_the_meridian_and_the_equator(lat_deg, lon_deg, azimuth_deg):
    epsg, utm_from_cam = looking(azimuth_deg, lat_deg, lon_deg)
    pose = pose_of(epsg, utm_from_cam)
    assert (pose.position.lat, pose.position.lon, pose.position.h) == pytest.approx((lat_deg, lon_deg, 120.0))
    assert (pose.heading_deg - azimuth_deg + 180.0) % 360.0 - 180.0 == pytest.approx(0.0, abs=2e-3)


def test_the_grid_is_turned_where_the_standard_has_true_north():
    """At 11.5 E in zone 32 grid north lies 1.86 degrees east of true north."""
    forward, down = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, -1.0])
    along_grid_north = np.stack([np.cross(down, forward), down, forward], axis=1)
    here = UtmGrid(32632).from_geodetic(np.float64(48.0), np.float64(11.5), np.float64(500.0))
    assert pose_of(32632, Pose(along_grid_north, here)).heading_deg == pytest.approx(1.858, abs=0.01)


def test_a_level_camera_that_looks_east_is_the_identity():
    epsg, utm_from_cam = looking(90.0, 48.0, 11.5)
    turn = pose_of(epsg, utm_from_cam).quaternion
    assert (turn.x, turn.y, turn.z, turn.w) == pytest.approx((0.0, 0.0, 0.0, 1.0), abs=2e-5)


def test_yaw_pitch_and_roll_are_those_of_the_standard():
    """Yaw turns x from east to north, then pitch lowers x, then roll raises y: intrinsic z, y, x."""
    epsg, level = looking(90.0 - 30.0, 48.0, 11.5)
    tilt = CAM_FROM_BODY @ Rotation.from_euler("YX", [20, 10], degrees=True).as_matrix() @ CAM_FROM_BODY.T
    turn = pose_of(epsg, Pose(level.rotation @ tilt, level.translation_m)).quaternion
    angles_deg = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_euler("ZYX", degrees=True)
    assert angles_deg == pytest.approx([30.0, 20.0, 10.0], abs=2e-3)


@pytest.mark.parametrize(("lat_deg", "lon_deg"), PLACES)
def test_from_utm_to_geopose_and_back_nothing_is_lost(lat_deg, lon_deg):
    rng = np.random.default_rng(5)
    epsg, level = looking(200.0, lat_deg, lon_deg)
    utm_from_cam = Pose(level.rotation @ so3_exp(rng.normal(0.0, 0.7, 3)), level.translation_m)
    pose = GeoPose.model_validate_json(pose_of(epsg, utm_from_cam).model_dump_json())
    back = pose.utm_from_cam()
    assert back.rotation == pytest.approx(utm_from_cam.rotation, abs=1e-9)
    assert back.translation_m == pytest.approx(utm_from_cam.translation_m, abs=1e-9)
    place = pose.position
    on_grid = UtmGrid(epsg).from_geodetic(*(np.float64(value) for value in (place.lat, place.lon, place.h)))
    assert on_grid == pytest.approx(utm_from_cam.translation_m, abs=1e-6)


def test_accuracy_is_turned_into_east_north_and_up():
    """A camera that looks north, far less sure along its axis than across it and of its yaw than of its roll."""
    epsg, utm_from_cam = looking(0.0, 48.0, 11.5)
    sigmas = np.array([np.radians(0.1), np.radians(0.5), np.radians(0.2), 0.02, 0.05, 0.30])
    accuracy = pose_of(epsg, utm_from_cam, np.diag(sigmas**2)).accuracy
    covariance = np.array(accuracy.covariance).reshape(6, 6)
    scale = UtmGrid(epsg).point_scale_factor(48.0, 11.5)
    expected = [0.02 / scale, 0.30 / scale, 0.05, *np.radians([0.1, 0.2, 0.5])]
    assert np.sqrt(np.diag(covariance)) == pytest.approx(expected, rel=1e-4)
    assert covariance == pytest.approx(covariance.T)
    assert accuracy.horizontal_sigma_m == pytest.approx(0.30 / scale, rel=1e-6)
    assert accuracy.vertical_sigma_m == pytest.approx(0.05, rel=1e-6)
    assert accuracy.heading_sigma_deg == pytest.approx(0.5, rel=1e-6)
    assert accuracy.tilt_sigma_deg == pytest.approx(0.2, rel=1e-6)


def test_the_covariance_is_that_of_poses_drawn_from_it():
    """4,000 poses off by the localizer's tangent in the camera's frame, told as GeoPoses."""
    rng = np.random.default_rng(3)
    epsg, utm_from_cam = looking(130.0, 48.0, 11.5)
    root = rng.normal(0.0, 1e-2, (6, 6))
    pose = pose_of(epsg, utm_from_cam, root @ root.T)
    grid_from_enu = UtmGrid(epsg).grid_from_enu(48.0, 11.5)
    true_enu_from_cam = grid_from_enu.T @ utm_from_cam.rotation
    xi = rng.normal(size=(4000, 6)) @ root.T
    moved = xi[:, 3:] @ true_enu_from_cam.T
    turned = Rotation.from_matrix(true_enu_from_cam @ so3_exp(xi[:, :3]) @ true_enu_from_cam.T).as_rotvec()
    drawn = np.cov(np.hstack([moved, turned]).T)
    told = np.array(pose.accuracy.covariance).reshape(6, 6)
    assert np.linalg.norm(drawn - told) / np.linalg.norm(told) < 0.1


def test_a_quaternion_that_is_no_rotation_is_refused():
    with pytest.raises(ValidationError, match=r"length is 1\.41421"):
        GeoQuaternion(x=0.0, y=1.0, z=0.0, w=1.0)


def test_what_the_standard_needs_is_there_under_its_names():
    epsg, utm_from_cam = looking(10.0, 48.0, 11.5)
    told = pose_of(epsg, utm_from_cam).model_dump()
    assert set(told["position"]) == {"lat", "lon", "h"}
    assert set(told["quaternion"]) == {"x", "y", "z", "w"}
    assert (told["map_id"], told["version"], told["stamp_ns"]) == ("street", VERSION, 7)
