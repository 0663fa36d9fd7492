"""How far a trajectory is from a reference, or from the trajectory of the map it was localised in.

The figures are those of the printed tables: maximum, mean, median, minimum, RMSE, SSE and standard deviation
of the absolute position error. Nothing is aligned unless it is asked for: in UTM the pose itself is judged.
Beside them stand the error of shape in windows, the consistency of covariances, and bootstrap intervals.
"""

from fleetmap.evaluation.association import associate, interpolate_trajectory
from fleetmap.evaluation.bootstrap import Interval, SegmentBootstrap
from fleetmap.evaluation.consistency import (
    Consistency,
    Nees,
    evaluate_consistency,
    normalised_estimation_error_squared,
)
from fleetmap.evaluation.judgement import Judgement, judge
from fleetmap.evaluation.statistics import ErrorStatistics, RotationErrors
from fleetmap.evaluation.trajectory_errors import (
    Alignment,
    TrajectoryErrors,
    evaluate_against_map,
    evaluate_trajectory,
    way_driven_m,
)
from fleetmap.evaluation.windows import WindowErrors, fit_windows

__all__ = [
    "Alignment",
    "Consistency",
    "ErrorStatistics",
    "Interval",
    "Judgement",
    "Nees",
    "RotationErrors",
    "SegmentBootstrap",
    "TrajectoryErrors",
    "WindowErrors",
    "associate",
    "evaluate_against_map",
    "evaluate_consistency",
    "evaluate_trajectory",
    "fit_windows",
    "interpolate_trajectory",
    "judge",
    "normalised_estimation_error_squared",
    "way_driven_m",
]
