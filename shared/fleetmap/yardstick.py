"""What the fixes alone would give: a cubic spline through them, judged like a trajectory.

Dense, good fixes make any map look accurate. So the error of the spline is printed beside the error of the map:
only what the map does better than its own fixes is owed to the images. The antenna is taken as the camera.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from fleetmap.drive import GnssFix
from fleetmap.errors import TrajectoryError
from fleetmap.evaluation import TrajectoryErrors
from fleetmap.geodesy import UtmGrid
from fleetmap.trajectory import Trajectory

Array = NDArray[np.float64]


def evaluate_gnss_spline(fixes: Sequence[GnssFix], reference: Trajectory) -> TrajectoryErrors:
    """Position errors of the spline through ``fixes``, at the reference's stamps within the fixes' span.

    Coverage counts the reference's poses. There is no rotation to compare.

    Raises:
        TrajectoryError: fewer than two fixes at different times, or no reference pose between first and last.
    """
    stamps_ns, positions_m = _fixes_in_utm(fixes, reference.epsg)
    inside = (reference.stamps_ns >= stamps_ns[0]) & (reference.stamps_ns <= stamps_ns[-1])
    if not inside.any():
        raise TrajectoryError(
            f"no reference pose between the first and the last GNSS fix ({stamps_ns[0] / 1e9:.3f} to "
            f"{stamps_ns[-1] / 1e9:.3f} s); do recording and reference belong together?"
        )
    at_ns = reference.stamps_ns[inside]
    # Seconds since the first fix, metres since its position: the spline's solver keeps its digits.
    spline = CubicSpline((stamps_ns - stamps_ns[0]) / 1e9, positions_m - positions_m[0])
    spline_m = spline((at_ns - stamps_ns[0]) / 1e9) + positions_m[0]
    return TrajectoryErrors(
        stamps_ns=at_ns,
        true_positions_m=reference.positions_m[inside],
        offsets_m=spline_m - reference.positions_m[inside],
        rotation=None,
        comparable=len(reference),
    )


def _fixes_in_utm(fixes: Sequence[GnssFix], epsg: int) -> tuple[NDArray[np.int64], Array]:
    """Stamps (N,), strictly increasing, and UTM positions (N, 3) of the fixes; of equal stamps the first."""
    stamps_ns, first = np.unique(np.array([fix.stamp_ns for fix in fixes], dtype=np.int64), return_index=True)
    if len(stamps_ns) < 2:
        raise TrajectoryError(f"a spline needs two GNSS fixes or more, the recording holds {len(stamps_ns)}")
    lat_deg, lon_deg, height_m = np.array([(fix.lat_deg, fix.lon_deg, fix.height_m) for fix in fixes])[first].T
    return stamps_ns, UtmGrid(epsg).from_geodetic(lat_deg, lon_deg, height_m)
