"""What a map package says about its own quality, gathered for people and for programs."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fleetmap.manifest import Manifest, Quality, WeakStretch
from fleetmap.map_package import open_package
from fleetmap.road_quality import RoadQuality
from fleetmap.visual_map import LocalizationMap

_LABEL_WIDTH = 16


@dataclass(frozen=True)
class MapReport:
    """All that a report is made of."""

    folder: Path
    version: str
    manifest: Manifest
    content: LocalizationMap
    road: RoadQuality | None  # None for a map whose writer did not measure it

    @property
    def limits(self) -> dict[str, float]:
        """The quality settings that the map was judged by, as far as its provenance names them."""
        named = self.manifest.provenance.settings.get("quality")
        items = named.items() if isinstance(named, dict) else ()
        return {str(name): float(value) for name, value in items if isinstance(value, (int, float))}

    @property
    def missing(self) -> list[str]:
        """What this map cannot tell, and how it would."""
        if self.road is None:
            named = self.manifest.format
            return [
                f"a map of format {named.major}.{named.minor} without a quality part: nothing is known from place "
                "to place; map the drive again to get it"
            ]
        if not np.isfinite(self.road.keyframes.horizontal_sigmas_m).any():
            return [
                f"no position uncertainty: with --gnss {self.manifest.quality.gnss_mode} no joint adjustment ties "
                "the keyframes to the fixes"
            ]
        return []


def read_report(folder: Path) -> MapReport:
    """Gather what the package in a folder says.

    Raises:
        MapPackageError: no package there, or one of its parts does not hold.
    """
    package = open_package(folder)
    return MapReport(folder, package.version, package.manifest, package.localization_map(), package.road_quality())


def summary(report: MapReport) -> Iterator[tuple[str, str]]:
    """Label and text of each line."""
    manifest, quality = report.manifest, report.manifest.quality
    yield "map", f"{manifest.map_id}, version {report.version[:12]}, EPSG:{manifest.anchor.epsg}"
    start = datetime.fromtimestamp(manifest.provenance.start_ns // 1_000_000_000, UTC)
    yield "drive", f"{manifest.provenance.drive}, {start:%Y-%m-%d %H:%M} UTC, {quality.length_m:.1f} m"
    yield "verdict", "fit to publish" if quality.publishable else "not fit to publish"
    for warning in quality.warnings:
        yield "warning", warning
    for remark in quality.remarks:
        yield "remark", remark
    segments = f" in {quality.segments} segments" if quality.segments > 1 else ""
    posed = f"{quality.frames_posed} of {quality.frames_total}{segments}"
    yield "images posed", f"{posed}; {quality.keyframes} keyframes"
    yield "position", _position(report)
    yield "GNSS residual", _gnss_residual(report)
    if quality.clock_offset_s is not None:
        yield "clock offset", _clock_offset(quality)
    density = (
        f"{quality.landmarks_per_m:.1f} per metre" if quality.landmarks_per_m is not None else "density unknown"
    )
    yield "landmarks", f"{quality.landmarks}, {density}"
    yield "reprojection", f"{quality.reprojection_rms_px:.2f} px RMS over {quality.observations} observations"
    yield "weak stretches", _weak(report)
    for number, stretch in enumerate(quality.weak_stretches, start=1):
        yield f"  {number}", stretch_text(stretch)
    for text in report.missing:
        yield "missing", text


def stretch_text(stretch: WeakStretch) -> str:
    """Where a stretch lies and why it is weak."""
    (lon_deg, lat_deg), (end_lon_deg, end_lat_deg) = stretch.start_lonlat, stretch.end_lonlat
    reasons = "; ".join(reason.text for reason in stretch.reasons)
    return (
        f"{stretch.from_m:.1f} to {stretch.to_m:.1f} m ({lat_deg:.6f},{lon_deg:.6f} to "
        f"{end_lat_deg:.6f},{end_lon_deg:.6f}): {reasons}"
    )


def lines(report: MapReport) -> list[str]:
    """The summary as text."""
    return [f"{label + ':':<{_LABEL_WIDTH}}{text}" for label, text in summary(report)]


def document(report: MapReport) -> dict[str, Any]:
    """Everything for programs; null stands for what is not known."""
    return {
        "map_id": report.manifest.map_id,
        "version": report.version,
        "quality": report.manifest.quality.model_dump(mode="json"),
        "limits": report.limits,
        "missing": report.missing,
        "along_the_road": None if report.road is None else _along_the_road(report.road),
    }


def _along_the_road(road: RoadQuality) -> dict[str, Any]:
    keyframes, fixes = road.keyframes, road.fixes
    return {
        "keyframes": {
            "stamp_ns": keyframes.stamps_ns.tolist(),
            "along_m": _numbers(keyframes.along_m, 3),
            "horizontal_sigma_m": _numbers(keyframes.horizontal_sigmas_m, 5),
            "vertical_sigma_m": _numbers(keyframes.vertical_sigmas_m, 5),
            "reprojection_rms_px": _numbers(keyframes.reprojection_rms_px, 4),
            "landmarks": keyframes.landmarks.tolist(),
        },
        "fixes": {
            "stamp_ns": fixes.stamps_ns.tolist(),
            "along_m": _numbers(fixes.along_m, 3),
            "residual_m": [_numbers(residual, 5) for residual in fixes.residuals_m],
            "residual_sigmas": _numbers(fixes.sigmas, 4),
            "claimed_sigma_m": _numbers(fixes.claimed_sigmas_m, 5),
        },
        "steps": {"edge_m": _numbers(road.edges_m, 3), "landmarks_per_m": _numbers(road.landmarks_per_m, 3)},
        "gaps": {"stamp_ns": road.gap_stamps_ns.tolist(), "along_m": [_numbers(gap, 3) for gap in road.gaps_m]},
    }


def _numbers(values: NDArray[Any], decimals: int) -> list[float | None]:
    return [round(float(value), decimals) if math.isfinite(value) else None for value in values]


def _position(report: MapReport) -> str:
    quality = report.manifest.quality
    if quality.position_sigma_m is None or quality.position_sigma_p95_m is None:
        return "uncertainty unknown"
    height = "" if quality.height_sigma_m is None else f"; height {quality.height_sigma_m:.3f} m"
    return (
        f"uncertain by {quality.position_sigma_m:.3f} m (horizontal, 1 sigma, median; 95 % of the keyframes "
        f"better than {quality.position_sigma_p95_m:.3f} m){height}"
    )


def _gnss_residual(report: MapReport) -> str:
    quality = report.manifest.quality
    if quality.gnss_residual_rms_m is None:
        return "no fix lies between posed images"
    sigmas = "" if quality.gnss_residual_sigmas is None else f", median {quality.gnss_residual_sigmas:.1f} sigma"
    claimed = "" if quality.gnss_sigma_m is None else f"; the receiver claims {quality.gnss_sigma_m:.3f} m"
    return f"{quality.gnss_residual_rms_m:.3f} m RMS over {quality.gnss_fixes} fixes{sigmas}{claimed}"


def _clock_offset(quality: Quality) -> str:
    sigma = "" if quality.clock_offset_sigma_s is None else f" +- {1e3 * quality.clock_offset_sigma_s:.0f} ms"
    removed = "removed" if quality.clock_offset_removed else "left as it is"
    return f"{1e3 * (quality.clock_offset_s or 0.0):.0f} ms{sigma} (camera minus receiver), {removed}"


def _weak(report: MapReport) -> str:
    quality = report.manifest.quality
    if quality.weak_length_m is None:
        return "unknown"
    if not quality.weak_stretches:
        return "none"
    return f"{len(quality.weak_stretches)}, {quality.weak_length_m:.1f} m of {quality.length_m:.1f} m"
