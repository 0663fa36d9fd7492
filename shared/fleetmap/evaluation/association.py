"""Which pose of one trajectory belongs to which of another."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import so3_exp, so3_log
from fleetmap.trajectory import Trajectory

Stamps = NDArray[np.int64]
Indices = NDArray[np.intp]

MAX_INTERPOLATION_GAP_NS = 500_000_000


def associate(first_ns: Stamps, second_ns: Stamps, max_offset_ns: int) -> tuple[Indices, Indices]:
    """Indices (M,), (M,) of the stamps that are each other's nearest and at most ``max_offset_ns`` apart."""
    if len(first_ns) == 0 or len(second_ns) == 0:
        return np.zeros(0, dtype=np.intp), np.zeros(0, dtype=np.intp)
    nearest_second, nearest_first = _nearest(first_ns, second_ns), _nearest(second_ns, first_ns)
    own = np.arange(len(first_ns))
    mutual = nearest_first[nearest_second] == own
    near = np.abs(first_ns - second_ns[nearest_second]) <= max_offset_ns
    return own[mutual & near], nearest_second[mutual & near]


def interpolate_trajectory(
    trajectory: Trajectory, stamps_ns: Stamps, max_gap_ns: int = MAX_INTERPOLATION_GAP_NS
) -> tuple[NDArray[np.bool_], Trajectory]:
    """The trajectory at other stamps (N,): positions linear, rotations along the geodesic.

    Returns a mask (N,) and the trajectory at the stamps it holds: those on a pose, or between two neighbouring
    poses at most ``max_gap_ns`` apart. Nothing is extrapolated.
    """
    compared, before, after = _neighbours(trajectory.stamps_ns, stamps_ns, max_gap_ns)
    gap_ns = trajectory.stamps_ns[after] - trajectory.stamps_ns[before]
    elapsed_ns = stamps_ns[compared] - trajectory.stamps_ns[before]
    fraction = (elapsed_ns / np.maximum(gap_ns, 1))[:, None]
    first_m, second_m = trajectory.positions_m[before], trajectory.positions_m[after]
    rotations = trajectory.rotations[before]
    if len(rotations):
        turns = so3_log(rotations.transpose(0, 2, 1) @ trajectory.rotations[after])
        rotations = np.asarray(rotations @ so3_exp(fraction * turns))
    positions_m = first_m + fraction * (second_m - first_m)
    return compared, Trajectory(trajectory.epsg, stamps_ns[compared], positions_m, rotations)


def _neighbours(own_ns: Stamps, stamps_ns: Stamps, max_gap_ns: int) -> tuple[NDArray[np.bool_], Indices, Indices]:
    """Which stamps (N,) have close neighbours among ``own_ns``, and the neighbours' indices (M,), (M,).

    A stamp on a pose has that pose for both neighbours.
    """
    after = np.searchsorted(own_ns, stamps_ns, side="left")
    before = np.searchsorted(own_ns, stamps_ns, side="right") - 1
    has_both = (before >= 0) & (after < len(own_ns))
    close = own_ns[after[has_both]] - own_ns[before[has_both]] <= max_gap_ns
    has_both[has_both] = close
    return has_both, before[has_both], after[has_both]


def _nearest(stamps_ns: Stamps, others_ns: Stamps) -> Indices:
    """Index (N,) of the nearest of the sorted ``others_ns``; the earlier one of two equally near."""
    after = np.clip(np.searchsorted(others_ns, stamps_ns), 0, len(others_ns) - 1)
    before = np.maximum(after - 1, 0)
    return np.where(np.abs(stamps_ns - others_ns[before]) <= np.abs(others_ns[after] - stamps_ns), before, after)
