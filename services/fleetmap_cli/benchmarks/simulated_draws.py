"""Survey and query drives drawn at random: another world, day, receiver noise, camera, lane and light every time.

One draw is a short survey, mapped by the real mapper and read back from its package as a localizer would, and a
second vehicle that takes images of the same stretch.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from fleetmap.camera import Camera
from fleetmap.drive import Frame
from fleetmap.geometry import Pose
from fleetmap.landmark_choice import localizable_part
from fleetmap.manifest import Provenance
from fleetmap.map_package import write_package
from fleetmap.simulation.scenario import Scenario, simulate_scenario
from fleetmap.simulation.simulated_drive import SimulatedDrive
from fleetmap_localizer.map_source import read_map
from fleetmap_localizer.map_view import LocalizableMap
from fleetmap_mapper.mapper import MappedDrive, map_drive
from fleetmap_mapper.settings import FeatureGroup, MapperSettings

STREETS = ("city", "street", "straight", "facades")
_SURVEY_CAMERA = Camera(640, 240, 400.0, 400.0, 319.5, 119.5)
_SECOND_CAMERA = Camera(720, 300, 470.0, 469.0, 356.0, 152.0, (-0.22, 0.07, 1e-3, -5e-4, 0.0))
_LOOKS = ("day", "overcast", "dusk")
_LANES_M = (0.0, 1.2, 3.5)
_SURVEY_M, _QUERY_M, _MARGIN_M = 45.0, 24.0, 10.0
_CIRCUIT_M, _OPEN_ROAD_M = 600.0, 140.0  # of the worlds
_SETTINGS = MapperSettings(features=FeatureGroup(count=2500))


@dataclass(frozen=True)
class Draw:
    """One survey and one second vehicle, by number."""

    number: int
    kind: str  # of world
    variant: int = 0  # other than 0: the second vehicle is in a street that could be taken for the survey's

    @property
    def has_twin(self) -> bool:
        """Whether such streets can be built."""
        return self.kind != "street"

    def survey(self) -> Scenario:
        """A fix of 5 cm every second."""
        is_circuit = self.kind in ("city", "facades", "open")
        return Scenario(
            world_seed=10_000 + self.number,
            kind=self.kind,
            world_length_m=_CIRCUIT_M if is_circuit else _OPEN_ROAD_M,
            drive_seed=2 * self.number + 1,
            length_m=_SURVEY_M,
            start_m=float(self._rng().uniform(0.0, _CIRCUIT_M - _SURVEY_M)) if is_circuit else 0.0,
            speed_mps=9.0,
            rate_hz=5.0,
            camera=_SURVEY_CAMERA,
            gnss="rtk",
        )

    def query(self, rate_hz: float = 1.5) -> Scenario:
        """Another day, camera, height, light and lane."""
        survey, rng = self.survey(), self._rng()
        rng.random()
        return replace(
            survey,
            drive_seed=2 * self.number + 2,
            length_m=_QUERY_M,
            start_m=survey.start_m + _MARGIN_M,
            rate_hz=rate_hz,
            world_variant=self.variant,
            camera=_SECOND_CAMERA,
            gnss=None,
            lane_m=float(rng.choice(_LANES_M)),
            camera_height_m=float(rng.uniform(1.3, 1.8)),
            look=str(rng.choice(_LOOKS)),
        )

    def mapped(self) -> LocalizableMap:
        """The survey's map as a localizer reads it.

        Raises:
            DriveError: the survey could not be mapped.
        """
        drive = simulate_scenario(self.survey())
        with tempfile.TemporaryDirectory(prefix="fleetmap-draw-") as folder:
            return _packed(map_drive(drive, _SETTINGS), drive, Path(folder) / f"draw-{self.number}")

    def images(self, rate_hz: float = 1.5) -> Iterator[tuple[Camera, Frame, Pose]]:
        """The second vehicle's images in time order, with the true ``utm_from_cam``."""
        drive = simulate_scenario(self.query(rate_hz))
        for index in range(drive.frame_count):
            yield drive.camera, drive.frame(index), drive.trajectory.pose(index)

    def _rng(self) -> np.random.Generator:
        return np.random.default_rng(self.number)


def _packed(made: MappedDrive, drive: SimulatedDrive, folder: Path) -> LocalizableMap:
    stamps_ns = drive.trajectory.stamps_ns
    provenance = Provenance(
        drive=drive.name,
        fleetmap_version="0",
        settings={},
        start_ns=int(stamps_ns[0]),
        end_ns=int(stamps_ns[-1]),
        created_ns=int(stamps_ns[-1]),
    )
    write_package(
        folder,
        made.visual_map,
        map_id=folder.name,
        quality=made.quality,
        provenance=provenance,
        localizable=localizable_part(made.visual_map, _SETTINGS.cells.budget_mb_per_km),
    )
    return read_map(folder)
