"""Where along the road a map is not to be trusted like elsewhere, and why."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.geodesy import UtmAnchor, UtmGrid
from fleetmap.manifest import WeakReason, WeakStretch
from fleetmap.road_quality import RoadQuality
from fleetmap_mapper.settings import QualityGroup

Array = NDArray[np.float64]
_MERGED_M = 10.0  # weak places no further apart are one stretch
_STANDING_M = 1.0  # a vehicle that moved less while no image was posed left no road behind
_TIE_REACH = 10  # keyframes: what was seen again later, on another round, ties nothing here
_FIXES_AT_ONCE = 5  # whose median residual is judged: a single fix far off is the receiver's fault


@dataclass(frozen=True)
class _Weakness:
    """One place where one figure is beyond its limit."""

    from_m: float
    to_m: float
    kind: str
    value: float
    limit: float


# kind -> (what people read, whether the worst is the least)
_KINDS = {
    "position": ("position uncertain by {:.2f} m (limit {:g} m)", False),
    "reprojection": ("reprojection errors of {:.2f} px (limit {:g} px)", False),
    "gnss": ("fixes missed by {:.1f} sigma (limit {:g})", False),
    "landmarks": ("{:.1f} landmarks per metre (limit {:g})", True),
    "seen": ("an image sees {:.0f} landmarks (limit {:g})", True),
    "gap": ("no image posed for {:.1f} s (limit {:g} s)", False),
    "ties": ("{:.0f} landmarks tie the road before to the road after (limit {:g})", True),
}


def find_weak_stretches(
    road: RoadQuality, ties: NDArray[np.int64], limits: QualityGroup, anchor: UtmAnchor, *, is_tied_to_fixes: bool
) -> tuple[WeakStretch, ...]:
    """All weak stretches in the order of the road.

    Args:
        road: the figures.
        ties: (K - 1,) those from each keyframe to the next: ``visual_ties``.
        limits: beyond which a place is weak.
        anchor: of the map frame.
        is_tied_to_fixes: whether the map was meant to follow its fixes.
    """
    weak = sorted(
        _weaknesses(road, ties, limits, is_tied_to_fixes), key=lambda found: (found.from_m, found.to_m, found.kind)
    )
    stretches: list[list[_Weakness]] = []
    reached_m = -np.inf
    for found in weak:
        if found.from_m > reached_m + _MERGED_M:
            stretches.append([])
        stretches[-1].append(found)
        reached_m = max(reached_m, found.to_m)
    return tuple(_stretch(found, road, anchor) for found in stretches)


def visual_ties(
    keyframe_index: NDArray[np.int32], point_index: NDArray[np.int32], keyframes: int
) -> NDArray[np.int64]:
    """Landmarks (K - 1,) seen from keyframes both up to each and after it, not more than ten apart."""
    order = np.lexsort((keyframe_index, point_index))
    keyframe, point = keyframe_index[order].astype(np.int64), point_index[order]
    near = (point[1:] == point[:-1]) & (np.diff(keyframe) <= _TIE_REACH)
    starts = np.bincount(keyframe[:-1][near], minlength=keyframes)
    ends = np.bincount(keyframe[1:][near], minlength=keyframes)
    return np.asarray(np.cumsum(starts - ends)[:-1])


def _weaknesses(
    road: RoadQuality, ties: NDArray[np.int64], limits: QualityGroup, is_tied_to_fixes: bool
) -> Iterator[_Weakness]:
    keyframes, fixes = road.keyframes, road.fixes
    edges_m = _reach_of_each_m(keyframes.along_m, road.length_m)
    at_keyframes = edges_m[:-1], edges_m[1:]
    yield from _beyond("position", at_keyframes, keyframes.horizontal_sigmas_m, limits.weak_position_sigma_m)
    yield from _beyond(
        "reprojection", at_keyframes, keyframes.reprojection_rms_px, limits.weak_reprojection_rms_px
    )
    yield from _beyond("seen", at_keyframes, keyframes.landmarks, limits.weak_landmarks_per_image)
    steps = road.edges_m[:-1], road.edges_m[1:]
    yield from _beyond("landmarks", steps, road.landmarks_per_m, limits.weak_landmarks_per_m)
    if is_tied_to_fixes:
        edges_m = _reach_of_each_m(fixes.along_m, road.length_m)
        medians = _running_median(fixes.sigmas)
        yield from _beyond("gnss", (edges_m[:-1], edges_m[1:]), medians, limits.weak_gnss_sigmas)
    between = keyframes.along_m[:-1], keyframes.along_m[1:]
    yield from _beyond("ties", between, ties, limits.weak_ties)
    moved = np.diff(road.gaps_m, axis=1)[:, 0] > _STANDING_M
    waits_s = np.diff(road.gap_stamps_ns, axis=1)[:, 0] * 1e-9
    yield from _beyond("gap", (road.gaps_m[moved, 0], road.gaps_m[moved, 1]), waits_s[moved], limits.weak_gap_s)


def _beyond(
    kind: str, places_m: tuple[Array, Array], values: NDArray[np.number], limit: float
) -> Iterator[_Weakness]:
    """Each place whose value is worse than the limit; an unknown value is not."""
    is_weak = values < limit if _KINDS[kind][1] else values > limit
    for row in np.flatnonzero(is_weak).tolist():
        yield _Weakness(float(places_m[0][row]), float(places_m[1][row]), kind, float(values[row]), limit)


def _reach_of_each_m(along_m: Array, length_m: float) -> Array:
    """Edges (n + 1,) half-way between neighbouring places (n,), and the road's two ends."""
    if len(along_m) == 0:
        return np.zeros(1)
    return np.concatenate([[0.0], (along_m[1:] + along_m[:-1]) / 2.0, [length_m]])


def _running_median(values: NDArray[np.float32]) -> Array:
    half = _FIXES_AT_ONCE // 2
    padded = np.concatenate([np.full(half, np.nan), values, np.full(half, np.nan)])
    windows = np.lib.stride_tricks.sliding_window_view(padded, _FIXES_AT_ONCE) if len(values) else np.empty((0, 1))
    return np.asarray(np.nanmedian(windows, axis=1))


def _stretch(found: list[_Weakness], road: RoadQuality, anchor: UtmAnchor) -> WeakStretch:
    from_m, to_m = min(f.from_m for f in found), max(f.to_m for f in found)
    reasons = []
    for kind, (text, worst_is_least) in _KINDS.items():
        alike = [f for f in found if f.kind == kind]
        if alike:
            worst = (min if worst_is_least else max)(found.value for found in alike)
            limit = alike[0].limit
            reasons.append(
                WeakReason(kind=kind, worst=round(worst, 6), limit=limit, text=text.format(worst, limit))
            )
    (start_ns, start_lonlat), (end_ns, end_lonlat) = (_place(at_m, road, anchor) for at_m in (from_m, to_m))
    return WeakStretch(
        from_m=round(from_m, 3),
        to_m=round(to_m, 3),
        start_ns=start_ns,
        end_ns=end_ns,
        start_lonlat=start_lonlat,
        end_lonlat=end_lonlat,
        reasons=tuple(reasons),
    )


def _place(at_m: float, road: RoadQuality, anchor: UtmAnchor) -> tuple[int, tuple[float, float]]:
    """When the vehicle was there, and longitude and latitude, between the keyframes about."""
    keyframes = road.keyframes
    first_ns = keyframes.stamps_ns[0]
    after_ns = float(np.interp(at_m, keyframes.along_m, (keyframes.stamps_ns - first_ns).astype(np.float64)))
    in_map = np.array([np.interp(at_m, keyframes.along_m, column) for column in keyframes.positions_m.T])
    lat_deg, lon_deg, _ = UtmGrid(anchor.epsg).to_geodetic(anchor.utm_from_map(in_map))
    return int(first_ns) + round(after_ns), (round(float(lon_deg), 7), round(float(lat_deg), 7))
