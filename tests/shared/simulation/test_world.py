"""Worlds of every kind: the same for the same seeds, free lanes, no holes, markers where they say."""

from __future__ import annotations

import functools

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from fleetmap.camera import Camera
from fleetmap.errors import InputError
from fleetmap.geometry import Pose
from fleetmap.simulation.look import Look
from fleetmap.simulation.rendering import render, render_depth
from fleetmap.simulation.world import WORLD_KINDS, World, build_world

Array = NDArray[np.float64]

LENGTH_M = 150.0
CAMERA = Camera(320, 160, 185.0, 185.0, 159.5, 79.5)
CLEAN = Look(noise_sigma=0.0, blur_sigma_px=0.0, vignetting=0.0)
KINDS = [kind for kind in WORLD_KINDS if kind != "street"]


@functools.cache
def _world(kind: str) -> World:
    return build_world(7, kind=kind, length_m=LENGTH_M)


@pytest.fixture(params=KINDS)
def world(request: pytest.FixtureRequest) -> World:
    return _world(request.param)


def _looking_ahead(world: World, s: float, left: float = 0.0, above: float = 1.65, down_rad: float = 0.0) -> Pose:
    heading = float(world.path.heading_rad(s))
    right = np.array([np.sin(heading), -np.cos(heading), 0.0])
    level = np.array([np.cos(heading), np.sin(heading), 0.0])
    forward = np.cos(down_rad) * level - [0.0, 0.0, np.sin(down_rad)]
    return Pose(np.stack([right, np.cross(forward, right), forward], axis=1), world.path.at(s, left, above))


def _fingerprint(world: World, seconds: float = 3.0) -> tuple[bytes, ...]:
    surfaces = world.scene_at(seconds).surfaces
    arrays = (surfaces.corners_in_map, surfaces.brightness, surfaces.texture_indices, world.atlas.pixels)
    return tuple(array.tobytes() for array in arrays)


def test_the_same_seeds_build_the_same_world(world: World, request: pytest.FixtureRequest) -> None:
    kind = request.node.callspec.params["world"]
    assert _fingerprint(build_world(7, kind=kind, length_m=LENGTH_M)) == _fingerprint(world)


def test_a_variant_has_the_same_shape_and_most_of_its_walls_otherwise() -> None:
    base, variant = _world("city"), build_world(7, length_m=LENGTH_M, variant=1)
    walls = slice(0, 200)  # laid before the cars, which are others
    assert np.array_equal(base.surfaces.corners_in_map[walls], variant.surfaces.corners_in_map[walls])
    same = base.surfaces.texture_indices[walls] == variant.surfaces.texture_indices[walls]
    assert not np.all(same)
    views = [render(world, CAMERA, _looking_ahead(world, 20.0), CLEAN).astype(int) for world in (base, variant)]
    changed = np.mean(np.abs(views[0] - views[1]) > 12)
    assert 0.1 < changed < 0.8


def test_a_world_of_one_bend_has_no_variants() -> None:
    with pytest.raises(InputError, match="no variants"):
        build_world(7, kind="street", length_m=LENGTH_M, variant=1)


def test_a_drive_changes_cars_and_sun_and_nothing_else() -> None:
    base = build_world(7, length_m=LENGTH_M, parked_cars_changed=0.0, moving_cars_per_km=0.0)
    other = build_world(7, length_m=LENGTH_M, drive_seed=1, parked_cars_changed=0.0, moving_cars_per_km=20.0)
    assert np.array_equal(base.surfaces.corners_in_map, other.surfaces.corners_in_map)
    assert np.array_equal(base.surfaces.texture_indices, other.surfaces.texture_indices)
    assert np.array_equal(base.atlas.pixels, other.atlas.pixels)
    assert not np.array_equal(base.surfaces.brightness, other.surfaces.brightness)
    assert base.markers[0].map_from_marker.translation_m.tolist() == (
        other.markers[0].map_from_marker.translation_m.tolist()
    )
    assert base.scene_at(5.0) is base.scene
    count = len(other.scene.surfaces)
    moving = other.scene_at(5.0).surfaces
    assert len(moving) == count + 40  # three oncoming cars and one ahead, of ten surfaces each
    assert np.array_equal(moving.corners_in_map[:count], other.surfaces.corners_in_map)


def test_another_seed_is_another_world_and_the_sun_stands_where_told() -> None:
    """In the evening walls that look west are brighter than those that look east."""
    surfaces = build_world(8, length_m=LENGTH_M, sun_deg=(270.0, 20.0), moving_cars_per_km=0.0).surfaces
    assert len(surfaces) != len(_world("city").surfaces)
    corners = surfaces.corners_in_map
    normals = np.cross(corners[:, 3] - corners[:, 0], corners[:, 1] - corners[:, 0])
    west = -normals[:, 0] / np.linalg.norm(normals, axis=1)
    assert np.median(surfaces.brightness[west > 0.7]) > 1.5 * np.median(surfaces.brightness[west < -0.7])


def test_nothing_stands_in_either_lane(world: World) -> None:
    """From 0.3 to 3 m above the road, on 1.2 m to either side of each lane's centre."""
    t = np.linspace(0.0, 1.0, 9)
    across, down = (part.ravel()[:, None, None] for part in np.meshgrid(t, t))
    corners = world.surfaces.corners_in_map
    low, high = (1.0 - down) * corners[:, 0] + down * corners[:, 3], (1.0 - down[..., 0:1]) * corners[:, 1]
    points = ((1.0 - across) * low + across * (high + down * corners[:, 2])).reshape(-1, 3)
    s = np.arange(0.0, world.length_m, 0.5)
    line, heading = world.path.at(s), world.path.heading_rad(s)
    near = (np.abs(points[:, None, :2] - line[None, ::20, :2]).max(axis=2) < 12.0).any(axis=1)
    for point in points[near]:
        aside = point - line
        ahead = aside[:, 0] * np.cos(heading) + aside[:, 1] * np.sin(heading)
        left = aside[:, 1] * np.cos(heading) - aside[:, 0] * np.sin(heading)
        in_lanes = (np.abs(ahead) < 0.3) & (left > -1.2) & (left < 4.7)
        above = aside[in_lanes, 2]
        assert not ((above > 0.3) & (above < 3.0)).any(), f"something stands at {point}"


def test_the_road_has_no_hole_and_lies_where_the_path_says(world: World) -> None:
    rays = CAMERA.unproject(np.stack(np.meshgrid(np.arange(320.0), np.arange(160.0)), axis=-1).reshape(-1, 2))
    for s, left in ((5.0, 0.0), (0.4 * LENGTH_M, 3.5), (0.75 * LENGTH_M, 0.0)):
        pose = _looking_ahead(world, s, left, down_rad=0.1)
        depth = render_depth(world.scene, CAMERA, pose).ravel()
        points = pose.transform(rays * np.where(np.isfinite(depth), depth, 1.0)[:, None])
        falls = (rays @ pose.rotation.T)[:, 2] / np.linalg.norm(rays, axis=1)
        assert np.isfinite(depth[falls < -0.02]).all()
        assert depth[falls < -0.25].max() < 25.0
        ahead_s = np.arange(s + 4.0, s + 10.0, 0.5)
        for place in world.path.at(ahead_s, np.array([0.0]), 0.0):
            pixel = CAMERA.project(pose.inverse().transform(place[None]))[0]
            if CAMERA.is_inside(pixel[None], 1.0)[0]:
                seen = points[round(pixel[1]) * 320 + round(pixel[0])]
                assert abs(seen[2] - place[2]) < 0.06


def test_markers_are_found_where_they_say(world: World) -> None:
    """By OpenCV's own detector, from a few metres, to a pixel."""
    assert 2 <= len(world.markers) <= 6
    camera = Camera(640, 480, 700.0, 700.0, 319.5, 239.5)
    marker = world.markers[1]
    out, middle = marker.map_from_marker.rotation[:, 2], marker.map_from_marker.translation_m
    up = np.array([0.0, 0.0, 1.0])
    refined = cv2.aruco.DetectorParameters()
    refined.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    for distance_m, sideways in ((2.5, 0.3), (4.0, -0.6)):
        eye = middle + distance_m * out + sideways * marker.map_from_marker.rotation[:, 0] - 0.5 * up
        forward = (middle - eye) / np.linalg.norm(middle - eye)
        right = np.cross(forward, up) / np.linalg.norm(np.cross(forward, up))
        pose = Pose(np.stack([right, np.cross(forward, right), forward], axis=1), eye)
        image = render(world.scene, camera, pose, CLEAN)
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, marker.dictionary))
        corners, numbers, _ = cv2.aruco.ArucoDetector(dictionary, refined).detectMarkers(image)
        assert numbers is not None
        found = np.asarray(corners[numbers.ravel().tolist().index(marker.number)]).reshape(4, 2)
        truth = camera.project(pose.inverse().transform(marker.corners_in_map))
        assert np.abs(found - truth).max() < 0.7


def test_dense_traffic_covers_a_third_of_the_view() -> None:
    world = build_world(7, length_m=300.0, moving_cars_per_km=120.0)
    covered = []
    for seconds in (2.0, 9.0, 16.0, 23.0):
        pose = _looking_ahead(world, 8.0 * seconds)
        still, moving = (render(scene, CAMERA, pose, CLEAN) for scene in (world.scene, world.scene_at(seconds)))
        covered.append(float((still != moving).mean()))
    assert 0.2 < np.mean(covered) < 0.5


def test_only_the_tunnel_has_a_roof_and_it_is_dark() -> None:
    for kind in KINDS:
        world = _world(kind)
        assert len(world.tunnels_m) == (1 if kind == "tunnel" else 0)
    ((start, end),) = _world("tunnel").tunnels_m
    assert 50.0 < end - start < 150.0
    for s, has_sky in ((start - 12.0, True), ((start + end) / 2.0, False), (end + 12.0, True)):
        pose = _looking_ahead(_world("tunnel"), s, down_rad=-0.9)
        image, depth = (draw(_world("tunnel").scene, CAMERA, pose, *look) for draw, look in _DRAWINGS)
        assert bool(np.isinf(depth).mean() > 0.1) == has_sky
        assert has_sky == bool(image.mean() > 70.0)


_DRAWINGS = ((render, (CLEAN,)), (render_depth, ()))


def test_open_places_are_wider_than_streets() -> None:
    """Half as much again of a level view is far away or sky."""
    far = {}
    for kind in ("open", "city"):
        world = _world(kind)
        depths = [render_depth(world.scene, CAMERA, _looking_ahead(world, s)) for s in (5.0, 45.0, 80.0, 120.0)]
        far[kind] = np.mean(np.stack(depths) > 30.0)
    assert 0.9 > far["open"] > 1.5 * far["city"] > 0.1


def test_long_worlds_stay_small() -> None:
    world = build_world(3, kind="city", length_m=1500.0)
    assert world.is_closed
    assert world.length_m == pytest.approx(1500.0)
    assert world.atlas.pixels.nbytes < 400e6
    assert 10_000 < len(world.surfaces) < 60_000


def test_a_street_is_a_world_too() -> None:
    world = build_world(3, kind="street", length_m=40.0)
    assert not world.is_closed
    assert world.scene_at(1.0) is world.scene
    assert len(world.surfaces) > 500


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"kind": "moon"}, "moon"),
        ({"length_m": 20.0}, "20"),
        ({"length_m": float("nan")}, "nan"),
        ({"length_m": 1e6}, "1000000"),
        ({"parked_cars_changed": 1.5}, "1.5"),
        ({"moving_cars_per_km": -1.0}, "-1"),
        ({"lat_deg": 89.0}, "UTM"),
    ],
)
def test_what_cannot_be_built_is_refused(arguments: dict[str, float], words: str) -> None:
    with pytest.raises(InputError, match=words):
        build_world(1, **arguments)  # type: ignore[arg-type]
