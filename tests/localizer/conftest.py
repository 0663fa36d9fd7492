"""A simulated street, mapped with its true poses and depths, and a second vehicle that drives through it."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from fleetmap.camera import Camera
from fleetmap.drive import Frame
from fleetmap.geometry import Pose, Sim3
from fleetmap.manifest import Manifest, Provenance, Quality
from fleetmap.map_package import open_package, write_package
from fleetmap.simulation.driving import drive_along
from fleetmap.simulation.look import Look
from fleetmap.simulation.rendering import render, true_points
from fleetmap.simulation.street import Street, build_street
from fleetmap.trajectory import Trajectory
from fleetmap.transport import MapClient
from fleetmap.vision.features import FeatureExtractor, Features
from fleetmap.vision.matching import match_by_projection
from fleetmap.vision.upward import upward_deg
from fleetmap.visual_map import Keyframes, Landmarks, LocalizationMap, Observations, VisualMap
from fleetmap_localizer import map_fetching
from fleetmap_localizer.map_source import MapServer
from fleetmap_server.server import running_server
from fleetmap_server.settings import ServerSettings

SURVEY_CAMERA = Camera(640, 400, 430.0, 430.0, 319.5, 199.5)
SECOND_CAMERA = Camera(720, 420, 560.0, 558.0, 352.0, 214.0, (-0.25, 0.08, 1e-3, -5e-4, 0.0))
SECOND_LOOK = Look(exposure=0.6, gamma=1.4, noise_sigma=4.0, blur_sigma_px=0.8, seed=5)
TIME_APART_NS = 86_400_000_000_000


@dataclass(frozen=True)
class SecondDrive:
    """What the second vehicle's camera saw, and where it truly was."""

    camera: Camera
    frames: list[Frame]
    truth: Trajectory

    def position_errors_m(self, poses: list[tuple[int, Pose]]) -> np.ndarray:
        """Distance of each (stamp, utm_from_cam) from the truth."""
        index = {stamp: i for i, stamp in enumerate(self.truth.stamps_ns.tolist())}
        return np.array([np.linalg.norm(p.translation_m - self.truth.positions_m[index[s]]) for s, p in poses])


@dataclass(frozen=True)
class MappedStreet:
    """A street, its map, and the map as a package."""

    street: Street
    content: LocalizationMap
    package: Path
    manifest: Manifest


@pytest.fixture(scope="session")
def street() -> Street:
    return build_street(3, 36.0)


@pytest.fixture(scope="session")
def mapped_street(street: Street, tmp_path_factory: pytest.TempPathFactory) -> MappedStreet:
    survey = drive_along(street, speed_mps=9.0, rate_hz=6.0, seed=1)
    visual_map = map_with_known_truth(street, survey)
    folder = tmp_path_factory.mktemp("maps") / "street"
    manifest = write_package(
        folder, visual_map, map_id="street", quality=_quality(visual_map), provenance=_provenance(survey)
    )
    return MappedStreet(street, open_package(folder).localization_map(), folder, manifest)


@pytest.fixture(scope="session")
def second_drive(street: Street) -> SecondDrive:
    """Another camera and exposure, half a lane to the left, a day later."""
    return drive_through(street, lane_offset_m=1.2, start_m=2.0)


@pytest.fixture(scope="session")
def foreign_drive() -> SecondDrive:
    """A street of the same kind that no map shows."""
    return drive_through(build_street(11, 22.0), lane_offset_m=0.0, start_m=0.0)


def drive_through(street: Street, *, lane_offset_m: float, start_m: float) -> SecondDrive:
    truth = drive_along(street, lane_offset_m=lane_offset_m, speed_mps=10.0, rate_hz=10.0, start_m=start_m, seed=2)
    truth = replace(truth, stamps_ns=truth.stamps_ns + TIME_APART_NS)
    frames = [
        Frame(int(stamp_ns), render(street, SECOND_CAMERA, _in_map(street, truth.pose(i)), SECOND_LOOK))
        for i, stamp_ns in enumerate(truth.stamps_ns)
    ]
    return SecondDrive(SECOND_CAMERA, frames, truth)


def _in_map(street: Street, utm_from_cam: Pose) -> Pose:
    return Pose(utm_from_cam.rotation, street.anchor.map_from_utm(utm_from_cam.translation_m))


def map_with_known_truth(street: Street, survey: Trajectory) -> VisualMap:
    """A map without a mapper: poses and depths are known, only who sees what is found by matching."""
    extractor = FeatureExtractor(SURVEY_CAMERA)
    poses = [_in_map(street, survey.pose(i)) for i in range(len(survey))]
    features = [extractor.extract(render(street, SURVEY_CAMERA, pose, Look(seed=1))) for pose in poses]
    points, descriptors, octaves, angles, distances, normals = (np.zeros((0, n)) for n in (3, 32, 1, 1, 1, 3))
    sightings: list[tuple[int, int, np.ndarray, int]] = []  # keyframe, landmark, pixel, octave
    for k, (pose, seen) in enumerate(zip(poses, features, strict=True)):
        found = _find(points, descriptors.astype(np.uint8), pose, seen)
        new = np.setdiff1d(np.arange(len(seen)), found[found >= 0])
        new_points = true_points(street, SURVEY_CAMERA, pose, seen.pixels[new])
        new, new_points = new[np.isfinite(new_points[:, 0])], new_points[np.isfinite(new_points[:, 0])]
        sightings += [(k, int(i), seen.pixels[f], int(seen.octaves[f])) for i, f in enumerate(found) if f >= 0]
        sightings += [
            (k, len(points) + i, seen.pixels[f], int(seen.octaves[f])) for i, f in enumerate(new.tolist())
        ]
        back = pose.translation_m - new_points
        points = np.vstack([points, new_points])
        descriptors = np.vstack([descriptors, seen.descriptors[new]])
        octaves = np.vstack([octaves, seen.octaves[new][:, None]])
        upward = upward_deg(SURVEY_CAMERA, seen.pixels[new], pose.rotation[2])
        angles = np.vstack([angles, (seen.angles_deg[new] - upward)[:, None]])
        distances = np.vstack([distances, np.linalg.norm(back, axis=1, keepdims=True)])
        normals = np.vstack([normals, back / np.linalg.norm(back, axis=1, keepdims=True)])
    counts = np.bincount([landmark for _, landmark, _, _ in sightings], minlength=len(points))
    kept = counts >= 3
    new_index = np.cumsum(kept) - 1
    sightings = [(k, int(new_index[i]), pixel, octave) for k, i, pixel, octave in sightings if kept[i]]
    return VisualMap(
        anchor=street.anchor,
        map_from_vis=Sim3(1.0, np.eye(3), np.zeros(3)),
        camera=SURVEY_CAMERA,
        keyframes=Keyframes(survey.stamps_ns, survey.rotations, np.array([pose.translation_m for pose in poses])),
        landmarks=Landmarks(
            points[kept],
            descriptors[kept].astype(np.uint8),
            normals[kept].astype(np.float32),
            octaves[kept, 0].astype(np.uint8),
            distances[kept, 0].astype(np.float32),
            angles_deg=angles[kept, 0].astype(np.float32) % 360.0,
        ),
        observations=Observations(
            np.array([s[0] for s in sightings], dtype=np.int32),
            np.array([s[1] for s in sightings], dtype=np.int32),
            np.array([s[2] for s in sightings], dtype=np.float32),
            np.array([s[3] for s in sightings], dtype=np.uint8),
        ),
    )


def _find(points: np.ndarray, descriptors: np.ndarray, pose: Pose, seen: Features) -> np.ndarray:
    if len(points) == 0:
        return np.full(0, -1)
    predicted = SURVEY_CAMERA.project_ideal(pose.inverse().transform(points))
    every = np.zeros(len(points), dtype=np.int64)
    return match_by_projection(
        predicted, np.full(len(points), 3.0), every, every + 7, descriptors, seen, max_distance=50, ratio=0.9
    )


def _quality(visual_map: VisualMap) -> Quality:
    return Quality(
        keyframes=len(visual_map.keyframes),
        landmarks=len(visual_map.landmarks),
        observations=len(visual_map.observations),
        length_m=36.0,
        frames_total=len(visual_map.keyframes),
        frames_posed=len(visual_map.keyframes),
        reprojection_rms_px=0.5,
        gnss_fixes=0,
        gnss_residual_rms_m=None,
        gnss_mode="none",
        publishable=True,
    )


def _provenance(survey: Trajectory) -> Provenance:
    return Provenance(
        drive="survey.mcap",
        fleetmap_version="0.1.0",
        settings={},
        start_ns=int(survey.stamps_ns[0]),
        end_ns=int(survey.stamps_ns[-1]),
        created_ns=int(survey.stamps_ns[-1]),
    )


class Site:
    """A map server that can leave and come back."""

    def __init__(self, folder: Path) -> None:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
        self.store = folder / "store"
        self._running = ExitStack()
        self.start()

    def start(self) -> None:
        """Begin, or come back."""
        settings = ServerSettings(self.store, self.endpoint, http_port=0, drain_s=0.0)
        self._running.enter_context(running_server(settings))

    def leave(self) -> None:
        self._running.close()

    def publish(self, folder: Path) -> str:
        """Publish a package; its version."""
        package = open_package(folder)
        with MapClient(self.endpoint) as client:
            return client.publish(package.manifest_bytes, package.part_bytes).version

    def origin(self, map_id: str | None = None) -> MapServer:
        return MapServer(self.endpoint, lambda **how: MapClient(self.endpoint, **how), map_id, patience_s=0.1)


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Site]:
    monkeypatch.setattr(map_fetching, "_FIRST_PAUSE_S", 0.05)
    monkeypatch.setattr(map_fetching, "_LONGEST_PAUSE_S", 0.05)
    site = Site(tmp_path)
    yield site
    site.leave()
