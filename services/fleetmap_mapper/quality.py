"""How good a map is, by its own lights, and whether it should be published."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fleetmap.geodesy import UtmAnchor
from fleetmap.manifest import Quality
from fleetmap.road_quality import RoadQuality
from fleetmap_mapper.calibration_check import calibration_record, calibration_remarks
from fleetmap_mapper.placed_map import PlacedMap, reprojection_errors_px
from fleetmap_mapper.settings import MapperSettings, QualityGroup
from fleetmap_mapper.weak_stretches import find_weak_stretches, visual_ties


def assess(
    placed: PlacedMap,
    road: RoadQuality,
    frames_posed: int,
    frames_total: int,
    anchor: UtmAnchor,
    settings: MapperSettings,
) -> Quality:
    """Figures about a placed map, and a warning for every one of them that speaks against publishing it."""
    ties = visual_ties(placed.keyframe_index, placed.point_index, len(placed.poses))
    weak = find_weak_stretches(road, ties, settings.quality, anchor, is_tied_to_fixes=_is_tied_to_fixes(settings))
    squares_m2 = (road.fixes.residuals_m.astype(np.float64) ** 2).sum(axis=1)
    horizontal_m, vertical_m = road.keyframes.horizontal_sigmas_m, road.keyframes.vertical_sigmas_m
    quality = Quality(
        keyframes=len(placed.poses),
        landmarks=len(placed.points_m),
        observations=len(placed.pixels),
        length_m=road.length_m,
        frames_total=frames_total,
        frames_posed=frames_posed,
        reprojection_rms_px=_reprojection_rms_px(placed),
        gnss_fixes=len(road.fixes),
        gnss_residual_rms_m=float(np.sqrt(squares_m2.mean())) if len(road.fixes) else None,
        gnss_mode=settings.gnss.mode,
        publishable=True,
        position_sigma_m=_percentile(horizontal_m, 50.0),
        position_sigma_p95_m=_percentile(horizontal_m, 95.0),
        height_sigma_m=_percentile(vertical_m, 50.0),
        gnss_residual_sigmas=_percentile(road.fixes.sigmas, 50.0),
        gnss_sigma_m=_percentile(road.fixes.claimed_sigmas_m, 50.0),
        landmarks_per_m=round(len(placed.points_m) / road.length_m, 3),
        weak_length_m=round(sum(stretch.to_m - stretch.from_m for stretch in weak), 3),
        weak_stretches=weak,
        calibration=calibration_record(placed.calibration, placed.camera),
        remarks=tuple(calibration_remarks(placed.calibration, placed.camera, settings.calibration)),
    )
    warnings = tuple(_warnings(quality, road, settings)) or tuple(_weakness(quality, settings.quality))
    return quality.model_copy(update={"warnings": warnings, "publishable": not warnings})


def _is_tied_to_fixes(settings: MapperSettings) -> bool:
    """Plain SLAM that one Sim(3) places at the end is not to be judged by its fixes."""
    return settings.gnss.mode in ("final", "full")


def _warnings(quality: Quality, road: RoadQuality, settings: MapperSettings) -> Iterator[str]:
    limits = settings.quality
    if quality.frames_posed < limits.min_posed_ratio * quality.frames_total:
        yield f"only {quality.frames_posed} of {quality.frames_total} images could be posed"
    gap_s = float(np.diff(road.gap_stamps_ns, axis=1).max(initial=0)) * 1e-9
    if gap_s > limits.max_unposed_gap_s:
        yield f"no image is posed for {gap_s:.1f} s in mid-drive (limit {limits.max_unposed_gap_s:g} s)"
    if quality.reprojection_rms_px > limits.max_reprojection_rms_px:
        yield (
            f"reprojection errors of {quality.reprojection_rms_px:.2f} px "
            f"(limit {limits.max_reprojection_rms_px:g} px)"
        )
    sigmas = quality.gnss_residual_sigmas
    if _is_tied_to_fixes(settings) and sigmas is not None and sigmas > limits.max_gnss_residual_sigmas:
        yield f"the map misses its GNSS fixes by {sigmas:.1f} sigma (limit {limits.max_gnss_residual_sigmas:g})"
    sigma_m = quality.position_sigma_p95_m
    if sigma_m is not None and sigma_m > limits.max_position_sigma_m:
        yield (
            f"its position is uncertain: 5 % of the keyframes by more than {sigma_m:.2f} m "
            f"(1 sigma, horizontal; limit {limits.max_position_sigma_m:g} m)"
        )
    if quality.landmarks_per_m is not None and quality.landmarks_per_m < limits.min_landmarks_per_m:
        yield f"only {quality.landmarks_per_m:.1f} landmarks per metre (limit {limits.min_landmarks_per_m:g})"


def _weakness(quality: Quality, limits: QualityGroup) -> Iterator[str]:
    """Said of a map that is sound on the whole: it may be weak in many places."""
    weak_m = quality.weak_length_m or 0.0
    if weak_m > limits.max_weak_ratio * quality.length_m:
        yield (
            f"{weak_m:.0f} m of {quality.length_m:.0f} m are weak, in {len(quality.weak_stretches)} stretches "
            f"(limit {100.0 * limits.max_weak_ratio:g} %)"
        )


def _reprojection_rms_px(placed: PlacedMap) -> float:
    errors = reprojection_errors_px(placed) / placed.corner_sigmas_px[:, None]
    return float(np.sqrt(np.nanmean((errors**2).sum(axis=1))))


def _percentile(values: NDArray[Any], percent: float) -> float | None:
    known = values[np.isfinite(values)]
    return round(float(np.percentile(known, percent)), 6) if len(known) else None
