"""Images localised in maps, and how they are judged: what rows of ``fleetmap benchmark localizer`` share."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fleetmap.covariances import PoseCovariances, read_covariances
from fleetmap.drives import open_drive
from fleetmap.evaluation import TrajectoryErrors, evaluate_against_map, evaluate_consistency, evaluate_trajectory
from fleetmap.evaluation.consistency import chi_square_quantile
from fleetmap.geometry import Pose
from fleetmap.map_package import open_package
from fleetmap.trajectory import read_trajectory
from fleetmap_cli.benchmarks.camera_pair import CameraPair
from fleetmap_cli.benchmarks.mapper_runs import rotation_figures, rounded
from fleetmap_cli.benchmarks.row import Figures
from fleetmap_cli.benchmarks.workbench import Run, Workbench

WRONG_M, WRONG_DEG = 2.0, 5.0  # a pose that is off by more is an accident,
_SAID_SO = 0.999  # unless the error lies inside this ellipsoid of the pose's own covariance


@dataclass(frozen=True)
class Queries:
    """The images of NAME.mcap, localised in a map of SURVEY.mcap, which is SURVEY-PACKAGE with SURVEY.tum."""

    name: str
    survey: str
    options: str = "--independent"
    label: str = ""  # where the same images are localised twice
    package: str = "map"

    @property
    def poses(self) -> str:
        """Of POSES.tum, and POSES.csv with the covariances."""
        return self.name + self.label

    def localize(self, bench: Workbench) -> Run:
        """Run ``fleetmap localize``."""
        outputs = f"--trajectory {self.poses}.tum --covariances {self.poses}.csv"
        words = f"localize {self.name}.mcap --map {self.survey}-{self.package} {outputs} {self.options}"
        return bench.once(words.rstrip())

    def pair(self, bench: Workbench, recorded_from_query: Pose) -> CameraPair:
        """The two cameras as the map has the survey's."""
        recorded = open_drive(bench.folder / f"{self.survey}.mcap").camera
        mapped = open_package(bench.folder / f"{self.survey}-{self.package}").manifest.camera.to_camera()
        return CameraPair.of(recorded_from_query, recorded, mapped)

    def images(self, bench: Workbench) -> int:
        """How many there are."""
        return int(bench.once(f"info {self.name}.mcap --quick --json").json()["images"]["count"])

    def covariances(self, folder: Path) -> PoseCovariances:
        """Of the poses."""
        return read_covariances(folder / f"{self.poses}.csv")


def relative_to_map(bench: Workbench, queries: Queries, recorded_from_query: Pose) -> Figures:
    """How images of a vehicle that took part in the survey stand to the survey's own poses."""
    run, pair = queries.localize(bench), queries.pair(bench, recorded_from_query)
    judging = f"--against-map {queries.survey}.tum {pair.options} --covariances {queries.poses}.csv"
    bench.shown(f"fleetmap evaluate {queries.poses}.tum {judging}")
    estimate, survey = (read_trajectory(bench.folder / f"{name}.tum") for name in (queries.poses, queries.survey))
    placed = pair.survey_from_query
    errors = evaluate_against_map(estimate, survey, placed.translation_m, placed.rotation)
    return _figures(bench, queries, errors, run) | {"axes turned deg": rounded(pair.axes_turned_deg, 2)}


def relative_to_truth(bench: Workbench, queries: Queries) -> Figures:
    """How images stand to the truth, where it is known exactly."""
    run = queries.localize(bench)
    reference = f"{queries.name}.reference.tum"
    bench.shown(f"fleetmap evaluate {queries.poses}.tum {reference} --covariances {queries.poses}.csv")
    estimate = read_trajectory(bench.folder / f"{queries.poses}.tum")
    return _figures(bench, queries, evaluate_trajectory(estimate, read_trajectory(bench.folder / reference)), run)


def _figures(bench: Workbench, queries: Queries, errors: TrajectoryErrors, run: Run) -> Figures:
    posed = len(queries.covariances(bench.folder).stamps_ns)
    images = queries.images(bench) - (posed - errors.matched)  # poses beyond the survey's ends nobody can judge
    wrong, unsaid = wrong_poses(errors, queries.covariances(bench.folder))
    found = errors.matched - int(wrong.sum())
    figures: Figures = {
        "success": f"{found} of {images}",
        "success %": round(100.0 * found / images, 1),
        **{f"{name} m": rounded(getattr(errors.position_m, name), 4) for name in ("median", "p95", "max")},
        **rotation_figures(errors.to_json()),
        "wrong": int(wrong.sum()),
        "unsaid": int(unsaid.sum()),
        "ms an image": round(1e3 * run.duration_s / images),
    }
    return figures


def wrong_poses(
    errors: TrajectoryErrors, covariances: PoseCovariances
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which compared poses (N,) are wrong by more than 2 m or 5 deg, and which of those do not say so themselves.

    A pose says so if its error lies inside the 99.9 % ellipsoid of its covariance.
    """
    assert errors.rotation is not None
    wrong = (errors.distances_m > WRONG_M) | (errors.rotation.angles_deg > WRONG_DEG)
    consistency = evaluate_consistency(errors, covariances)
    said = np.zeros(errors.matched, dtype=bool)
    if consistency is not None:
        said[consistency.rows] = consistency.pose.values <= chi_square_quantile(_SAID_SO, consistency.pose.dof)
    return wrong, wrong & ~said


def positions(judgement: dict[str, Any]) -> Figures:
    """The rows of the printed tables, of one entry of ``fleetmap evaluate --json``."""
    names = ("mean", "median", "rmse", "std", "p95", "max")
    return {f"{name} m": rounded(judgement["position_m"][name]) for name in names}
