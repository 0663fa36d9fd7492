"""What a GNSS receiver on a simulated vehicle reports."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from fleetmap.drive import GnssFix
from fleetmap.errors import InputError
from fleetmap.geodesy import UtmGrid
from fleetmap.geometry import Pose
from fleetmap.gnss import GNSS_ERROR_MODELS, fix_stamps_ns, fixes_at, in_gap, require_outlier_ratio
from fleetmap.simulation.motion import Motion
from fleetmap.simulation.world import World

Array = NDArray[np.float64]

_PATH_STEP_M, _PORTAL_M = 1.0, 7.0
_LEAST_INTERVAL_S = 0.001


@dataclass(frozen=True)
class Receiver:
    """One receiver and the way it is used."""

    model: str = "rtk"  # a name in fleetmap.gnss.GNSS_ERROR_MODELS
    interval_s: float = 0.1
    gap_s: tuple[float, float] | None = None  # start, since the first image, and length of a stretch without fixes
    clock_offset_s: float = 0.0  # its fixes' stamps are late by this
    outlier_ratio: float = 0.0  # of the fixes, which are 5 to 50 m off and do not know it

    def __post_init__(self) -> None:
        if self.model not in GNSS_ERROR_MODELS:
            raise InputError(
                f"there is no GNSS error model {self.model!r}; choose from {', '.join(GNSS_ERROR_MODELS)}"
            )
        if not self.interval_s >= _LEAST_INTERVAL_S:
            raise InputError(
                f"GNSS interval of {self.interval_s} s makes no sense; give at least {_LEAST_INTERVAL_S} s"
            )
        if not abs(self.clock_offset_s) <= 10.0:
            raise InputError(f"a GNSS clock that is {self.clock_offset_s} s off makes no sense; give at most 10 s")
        require_outlier_ratio(self.outlier_ratio)

    def fixes(
        self, world: World, motion: Motion, image_stamps_ns: NDArray[np.int64], cam_from_antenna: Pose, seed: int
    ) -> list[GnssFix]:
        """The fixes of a drive. Equal seeds give equal errors, also of the fixes around a gap or a tunnel.

        Raises:
            InputError: fewer than two images, or an interval that makes no sense.
        """
        stamps_ns = fix_stamps_ns(image_stamps_ns, self.interval_s)
        truth = motion.trajectory(stamps_ns)
        antennas_m = truth.positions_m + truth.rotations @ cam_from_antenna.translation_m
        grid, model = UtmGrid(truth.epsg), GNSS_ERROR_MODELS[self.model]
        fixes = fixes_at(grid, stamps_ns, antennas_m, model, seed, self.outlier_ratio)
        has_sky = ~_is_in_tunnel(world, world.anchor.map_from_utm(antennas_m))
        if self.gap_s is not None:
            start_ns = int(image_stamps_ns[0])
            has_sky &= [not in_gap(fix.stamp_ns - start_ns, self.gap_s) for fix in fixes]
        late_ns = round(self.clock_offset_s * 1e9)
        return [replace(fixes[i], stamp_ns=fixes[i].stamp_ns + late_ns) for i in np.flatnonzero(has_sky)]


def _is_in_tunnel(world: World, points_in_map: Array) -> NDArray[np.bool_]:
    """Which points (N, 3) on the road have rock above them, or are so near to a portal that it hides the sky."""
    inside = np.zeros(len(points_in_map), dtype=bool)
    for start_m, end_m in world.tunnels_m:
        middle = world.path.at(np.arange(start_m, end_m, _PATH_STEP_M))
        inside |= cKDTree(middle[:, :2]).query(points_in_map[:, :2])[0] < _PORTAL_M
    return inside
