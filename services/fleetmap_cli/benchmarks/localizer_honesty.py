"""Whether poses are as sure as they say, and whether images of elsewhere, or of nothing, are told to be that."""

from __future__ import annotations

import multiprocessing
from collections import Counter
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import FleetmapError
from fleetmap.evaluation.consistency import Nees, normalised_estimation_error_squared
from fleetmap.geometry import Pose, so3_log
from fleetmap.simulation.parallel import usable_cores
from fleetmap_cli.benchmarks.foreign_images import real_queries, simulated_queries
from fleetmap_cli.benchmarks.mapper_drives import ODOMETRY, ODOMETRY_RTK_5S, RAW
from fleetmap_cli.benchmarks.row import Figures, Group, Row
from fleetmap_cli.benchmarks.simulated_draws import STREETS, Draw
from fleetmap_cli.benchmarks.workbench import Workbench
from fleetmap_localizer.localizer import Localizer
from fleetmap_localizer.map_view import MapView
from fleetmap_localizer.pose_estimate import PoseEstimate
from fleetmap_localizer.settings import LocalizerSettings

Array = NDArray[np.float64]

HONESTY = Group(
    "Honesty",
    "*nees*: independent draws of world, day, receiver noise, survey (45 m, RTK every second, 640x240) and second "
    "vehicle (other camera, height, light, lane; images on their own, one pose a draw). NEES is the error in UTM "
    "normalised by the pose's own covariance; its mean should be 6, and 3 for positions. *foreign*: images of "
    "other streets, of rows of houses that look alike, and of nothing, with the settings of all other rows; on "
    "their own, and after images that a track goes on from.",
    ("draws", "poses", "NEES", "inside 95 % ellipsoid", "position NEES", "queries", "posed"),
)
_DRAWS = 260  # some images have no pose, and 200 poses are wanted
_OPEN_DRAWS = 24


@dataclass(frozen=True)
class Judged:
    """One draw's pose: the error as a tangent of the estimate, and its covariance; None where there is no pose."""

    draw: Draw
    error: Array | None = None  # (6,) [rotation (rad), translation (m)] in the estimated camera's frame
    covariance: Array | None = None  # (6, 6)


def _nees(bench: Workbench) -> Figures:
    """Poses of second vehicles in streets, against the truth; wide open places stand beside."""
    bench.shown("fleetmap benchmark localizer --rows nees")
    streets = [Draw(number, STREETS[number % len(STREETS)]) for number in range(_DRAWS)]
    places = [Draw(_DRAWS + number, "open") for number in range(_OPEN_DRAWS)]
    judged = judge_draws([*streets, *places])
    bench.beside("wide open places, where little is near", consistency(judged[len(streets) :]))
    return consistency(judged[: len(streets)])


def judge_draws(draws: Iterable[Draw]) -> list[Judged]:
    """All draws, in order; every core works on one."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(usable_cores(), mp_context=context) as executor:
        return list(executor.map(judge_draw, draws))


def judge_draw(draw: Draw) -> Judged:
    """Map the survey, and localise the second vehicle's images until one has a pose."""
    try:
        source = draw.mapped()
    except FleetmapError:
        return Judged(draw)
    settings = LocalizerSettings()
    for camera, frame, utm_from_cam in draw.images():
        localizer = Localizer(camera, (MapView(source, camera, settings),), settings)
        answer = localizer.localize(frame)
        if isinstance(answer, PoseEstimate):
            return Judged(draw, _tangent(answer.utm_from_cam, utm_from_cam), answer.covariance)
    return Judged(draw)


def consistency(judged: Iterable[Judged]) -> Figures:
    """NEES of those draws that have a pose."""
    drawn = list(judged)
    posed = [(each.error, each.covariance) for each in drawn if each.error is not None]
    errors, covariances = np.array([e for e, _ in posed]), np.array([c for _, c in posed])
    pose = Nees(normalised_estimation_error_squared(errors, covariances), dof=6)
    position = Nees(normalised_estimation_error_squared(errors[:, 3:], covariances[:, 3:, 3:]), dof=3)
    return {
        "draws": len(drawn),
        "poses": len(posed),
        "NEES": round(pose.mean, 2),
        "inside 95 % ellipsoid": f"{100.0 * pose.inside_95:.1f} %",
        "position NEES": round(position.mean, 2),
    }


def _tangent(estimate: Pose, truth: Pose) -> Array:
    """xi (6,) with ``truth = estimate @ exp(xi)``, its translation to first order."""
    difference = estimate.inverse() @ truth
    return np.concatenate([so3_log(difference.rotation), difference.translation_m])


def _foreign(bench: Workbench) -> Figures:
    """Queries that must have no pose, each kind on a line of its own."""
    bench.once(f"convert kitti-raw DATA/{RAW} survey.mcap --camera 0")
    bench.once(f"convert kitti-raw DATA/{RAW} second.mcap --camera 1 --no-gnss")
    ODOMETRY_RTK_5S.make(bench)
    for name in ("survey", ODOMETRY_RTK_5S.name):
        bench.once(f"map {name}.mcap --output {name}-map --trajectory {name}.tum", accepted_codes=(0, 3))
    bench.shown("fleetmap benchmark localizer --rows foreign")
    folder, odometry = bench.folder, ODOMETRY_RTK_5S.name
    asked, posed = Counter[str](), Counter[str]()
    for query in chain(
        real_queries(folder / "survey-map", folder / f"{odometry}.mcap"),
        real_queries(folder / f"{odometry}-map", folder / "second.mcap"),
        simulated_queries(),
    ):
        asked[query.kind] += 1
        posed[query.kind] += query.is_posed
    for kind, count in sorted(asked.items()):
        bench.beside(kind, {"queries": count, "posed": posed[kind]})
    return {"queries": asked.total(), "posed": posed.total()}


ROWS = (
    Row("nees", "poses are as sure as they say", _nees, (), HONESTY, "mean NEES 4 to 9, 90 to 99 % inside"),
    Row("foreign", "images of elsewhere, or of nothing", _foreign, (RAW, ODOMETRY), HONESTY, "posed: 0 of 2,000"),
)
