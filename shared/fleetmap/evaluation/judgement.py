"""Everything that is said about one trajectory, each figure with the interval it is known to."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from fleetmap.covariances import PoseCovariances
from fleetmap.evaluation.bootstrap import CONFIDENCE, SEGMENT_M, Interval, SegmentBootstrap
from fleetmap.evaluation.consistency import Consistency, evaluate_consistency
from fleetmap.evaluation.trajectory_errors import TrajectoryErrors
from fleetmap.evaluation.windows import WINDOW_M, WindowErrors, fit_windows

Intervals = dict[str, Interval | None]


@dataclass(frozen=True)
class Judgement:
    """The errors of one trajectory and what follows from them."""

    errors: TrajectoryErrors
    windows: WindowErrors
    consistency: Consistency | None  # None without covariances
    segments: int  # of the road, that the intervals are drawn from
    segment_m: float  # length of each
    intervals: dict[str, Intervals]  # [group][figure], as in the JSON form; None where one segment holds all
    coverage_interval: Interval | None

    def to_json(self) -> dict[str, Any]:
        """All figures as plain values: those of TrajectoryErrors, then windows, intervals and, if asked, nees."""
        figures = self.errors.to_json()
        figures["windows"] = self.windows.to_json()
        if self.consistency is not None:
            figures["nees"] = self.consistency.to_json()
        figures["intervals"] = {
            "confidence": CONFIDENCE,
            "segments": self.segments,
            "segment_m": self.segment_m,
            **{
                group: {name: None if interval is None else list(interval) for name, interval in members.items()}
                for group, members in self.intervals.items()
            },
            "coverage": None if self.coverage_interval is None else list(self.coverage_interval),
        }
        return figures


def judge(
    errors: TrajectoryErrors, *, window_m: float = WINDOW_M, covariances: PoseCovariances | None = None
) -> Judgement:
    """Windows, consistency and bootstrap intervals of a trajectory's errors.

    Segments are at least as long as a window, and a window counts for the segment that holds its middle.

    Raises:
        InputError: a window that is not positive.
        TrajectoryError: covariances of which none belongs to a compared pose.
    """
    windows = fit_windows(errors, window_m)
    consistency = None if covariances is None else evaluate_consistency(errors, covariances)
    bootstrap = SegmentBootstrap.along(errors.road_m, max(SEGMENT_M, window_m))
    segment_of = bootstrap.segment_of[errors.compared]
    intervals: dict[str, Intervals] = {
        "position_m": bootstrap.statistics(errors.distances_m, segment_of),
        "horizontal_m": bootstrap.statistics(errors.horizontal_distances_m, segment_of),
    }
    if errors.rotation is not None:
        intervals["rotation_deg"] = bootstrap.statistics(errors.rotation.angles_deg, segment_of)
        intervals["rotation_spread_deg"] = bootstrap.statistics(errors.rotation.spread_deg, segment_of)
    middles = np.searchsorted(errors.road_m, windows.centres_m).clip(max=errors.comparable - 1)
    intervals["windows"] = {"mean_rmse_m": bootstrap.mean(windows.rmse_m, bootstrap.segment_of[middles])}
    if consistency is not None:
        rows = segment_of[consistency.rows]
        intervals["nees"] = {
            "pose_mean": bootstrap.mean(consistency.pose.values, rows),
            "position_mean": bootstrap.mean(consistency.position.values, rows),
        }
    was_compared = np.zeros(errors.comparable)
    was_compared[errors.compared] = 1.0
    return Judgement(
        errors=errors,
        windows=windows,
        consistency=consistency,
        segments=bootstrap.segments,
        segment_m=bootstrap.segment_m,
        intervals=intervals,
        coverage_interval=bootstrap.mean(was_compared, bootstrap.segment_of),
    )
