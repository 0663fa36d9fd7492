"""Where a vehicle may be, and which 128 m cells of a map lie around it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from fleetmap.geodesy import UtmGrid
from fleetmap.manifest import CELL_SIZE_M, PartRecord
from fleetmap_localizer.pose_estimate import NoPose, PoseEstimate

Array = NDArray[np.float64]

_MAX_STEP_S = 2.0  # between poses that tell a velocity
_MAX_SPEED_MPS = 80.0
_SIGMAS = 3.0  # of a predicted pose that the window covers


@dataclass(frozen=True)
class WindowSettings:
    """What of the maps is fetched, and what is kept ready to be looked into."""

    look_m: float = 150.0  # cells so near are ready to be looked into,
    look_ahead_s: float = 4.0  # and those so near to where the vehicle will be by then
    fetch_m: float = 300.0  # cells so near are fetched,
    fetch_ahead_s: float = 20.0  # likewise
    kept_m: float = 96.0  # further away than that, cells are let go
    near_m: float = 300.0  # how far from the truth a place may be that somebody names
    lost_s: float = 3.0  # without a pose for longer, the window grows:
    growth_mps: float = 30.0  # so fast,
    max_growth_m: float = 5000.0  # and so far
    sure_after: int = 3  # poses in a row, and the window shrinks to where they are
    max_views: int = 8  # maps at once around a known place
    max_maps: int = 1000  # searched where no place is known, the newest of a server
    max_bytes: int = 200_000_000  # of cells ready at once
    max_cache_bytes: int = 2_000_000_000  # on disk


@dataclass(frozen=True)
class Area:
    """Circles of one size on the UTM grid; what lies in any of them is in the area."""

    epsg: int
    centres_m: Array  # (P, 2) easting, northing; the first is where the vehicle is taken to be
    radius_m: float

    def in_zone(self, epsg: int) -> Array:
        """The centres (P, 2) on the grid of another zone."""
        if epsg == self.epsg:
            return self.centres_m
        lat_deg, lon_deg = self.lat_lon_deg()
        return UtmGrid(epsg).from_geodetic(lat_deg, lon_deg, np.zeros_like(lat_deg))[:, :2]

    def lat_lon_deg(self) -> tuple[Array, Array]:
        """Latitudes and longitudes (P,) of the centres."""
        with_heights = np.c_[self.centres_m, np.zeros(len(self.centres_m))]
        lat_deg, lon_deg, _ = UtmGrid(self.epsg).to_geodetic(with_heights)
        return lat_deg, lon_deg

    def cells_of(self, records: Iterable[PartRecord], epsg: int, margin_m: float = 0.0) -> list[PartRecord]:
        """Those of a map's cells that lie in the area or within ``margin_m`` of it, the nearest first."""
        cells = [record for record in records if record.cell is not None]
        if not cells:
            return []
        south_west = CELL_SIZE_M * np.array([record.cell for record in cells], dtype=np.float64)[:, None, :]
        centres = self.in_zone(epsg)[None, :, :]
        outside = np.maximum(np.maximum(south_west - centres, centres - south_west - CELL_SIZE_M), 0.0)
        away_m = np.linalg.norm(outside, axis=2).min(axis=1)
        order = np.argsort(away_m, kind="stable")
        return [cells[i] for i in order[away_m[order] <= self.radius_m + margin_m].tolist()]


@dataclass(frozen=True, eq=False)
class _Fixed:
    """A place that the vehicle was at, or near."""

    epsg: int
    position_m: Array  # (2,) easting, northing
    slack_m: float  # how far away it may have been
    stamp_ns: int | None  # None: before the first image
    velocity_mps: Array = field(default_factory=lambda: np.zeros(2))  # (2,)
    is_pose: bool = True  # otherwise somebody named it


@dataclass(frozen=True, eq=False)
class Whereabouts:
    """What is known of where a vehicle is; followed from image to image by their stamps alone."""

    settings: WindowSettings
    fixed: _Fixed | None = None  # None: it may be anywhere
    now_ns: int | None = None
    measured_ns: int | None = None  # of the last image that showed the place, or of the first that did not
    in_a_row: int = 0  # measured poses

    @staticmethod
    def near(lat_lon_deg: tuple[float, float] | None, settings: WindowSettings) -> Whereabouts:
        """At the start: near a place, or anywhere.

        Raises:
            InputError: the place lies outside UTM.
        """
        if lat_lon_deg is None:
            return Whereabouts(settings)
        grid = UtmGrid.at(*lat_lon_deg)
        lat_deg, lon_deg = np.array(lat_lon_deg)
        position_m = grid.from_geodetic(lat_deg, lon_deg, np.zeros(()))[:2]
        return Whereabouts(settings, _Fixed(grid.epsg, position_m, settings.near_m, None, is_pose=False))

    def after(self, answer: PoseEstimate | NoPose) -> Whereabouts:
        """What is known after an image. A place is believed once several images in a row say so."""
        fixed = self.fixed
        if fixed is not None and fixed.stamp_ns is None:
            fixed = replace(fixed, stamp_ns=answer.stamp_ns)
        is_measured = isinstance(answer, PoseEstimate) and answer.kind == "measured"
        measured_ns = answer.stamp_ns if is_measured or self.measured_ns is None else self.measured_ns
        now = replace(self, fixed=fixed, now_ns=answer.stamp_ns, measured_ns=measured_ns)
        if isinstance(answer, NoPose):
            return replace(now, in_a_row=0)
        now = replace(now, in_a_row=self.in_a_row + is_measured)
        if now.in_a_row >= self.settings.sure_after or not now.is_searching:
            return replace(now, fixed=_fixed_by(answer, fixed))
        return now

    @property
    def is_searching(self) -> bool:
        """Whether there is no recent pose to go on from."""
        return self.fixed is None or not self.fixed.is_pose or self._unknown_s > 0.0

    @property
    def is_lost(self) -> bool:
        """Whether images have not shown for long where it is, though other sensors may tell."""
        return self.fixed is not None and self._later_s(self.measured_ns) > 0.0

    def look_area(self) -> Area | None:
        """What is to be ready; None for everything."""
        return self._area(self.settings.look_m, self.settings.look_ahead_s)

    def fetch_area(self) -> Area | None:
        """What is to be fetched; None for everything."""
        return self._area(self.settings.fetch_m, self.settings.fetch_ahead_s)

    def is_like(self, other: Whereabouts) -> bool:
        """Whether both ask for much the same."""
        if self.fixed is None or other.fixed is None:
            return self.fixed is other.fixed
        mine, theirs = self.fetch_area(), other.fetch_area()
        if mine is None or theirs is None or mine.epsg != theirs.epsg or self.is_searching != other.is_searching:
            return False
        if self.is_lost != other.is_lost:
            return False
        step_m = 0.1 * self.settings.look_m
        return bool(
            np.linalg.norm(mine.centres_m[0] - theirs.centres_m[0]) <= step_m
            and np.linalg.norm(mine.centres_m[-1] - theirs.centres_m[-1]) <= 4.0 * step_m
            and abs(mine.radius_m - theirs.radius_m) <= 0.2 * min(mine.radius_m, theirs.radius_m)
        )

    @property
    def _unknown_s(self) -> float:
        """How much longer than ``lost_s`` there has been no pose of any kind."""
        return 0.0 if self.fixed is None else self._later_s(self.fixed.stamp_ns)

    def _later_s(self, stamp_ns: int | None) -> float:
        """How much longer ago than ``lost_s`` something was."""
        if stamp_ns is None or self.now_ns is None:
            return 0.0
        return max(abs(self.now_ns - stamp_ns) * 1e-9 - self.settings.lost_s, 0.0)

    def _area(self, reach_m: float, ahead_s: float) -> Area | None:
        if self.fixed is None:
            return None
        growth_m = min(self.settings.growth_mps * self._unknown_s, self.settings.max_growth_m)
        way_m = ahead_s * float(np.linalg.norm(self.fixed.velocity_mps))
        times_s = np.linspace(0.0, ahead_s, 2 + int(way_m / reach_m)) if way_m > 0.0 else np.zeros(1)
        centres_m = self.fixed.position_m + times_s[:, None] * self.fixed.velocity_mps
        return Area(self.fixed.epsg, centres_m, reach_m + self.fixed.slack_m + growth_m)


def _fixed_by(pose: PoseEstimate, before: _Fixed | None) -> _Fixed:
    """The place of a pose, with the velocity that the pose before tells."""
    position_m = pose.utm_from_cam.translation_m[:2].copy()
    slack_m = _SIGMAS * float(np.sqrt(np.linalg.eigvalsh(pose.covariance[3:, 3:])[-1]))
    fixed = _Fixed(pose.epsg, position_m, slack_m, pose.stamp_ns)
    if before is None or not before.is_pose or before.stamp_ns is None or before.epsg != pose.epsg:
        return fixed
    elapsed_s = (pose.stamp_ns - before.stamp_ns) * 1e-9
    if not 0.0 < elapsed_s <= _MAX_STEP_S:
        return fixed
    velocity_mps = 0.5 * (before.velocity_mps + (position_m - before.position_m) / elapsed_s)
    speed_mps = float(np.linalg.norm(velocity_mps))
    return replace(fixed, velocity_mps=velocity_mps * min(1.0, _MAX_SPEED_MPS / max(speed_mps, 1e-9)))
