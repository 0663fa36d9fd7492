"""A recording's judgement as the map server keeps it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from fleetmap.drive import GnssFix
from fleetmap.drives.inspection import look_through
from fleetmap.footprint import thinned
from fleetmap.inspection.gnss_quality import GnssTrack
from fleetmap.inspection.judging import DriveJudgement, judge_contents
from fleetmap.jobs import DriveFinding, DriveSummary

_MAX_PLACES = 2000
_MAX_TEXT = 500
_FAR_OUT = 4.0  # a fix so many times farther from the middle than nearly all others is a wild one


def summarise_drive(recording: Path, progress: Callable[[str, int, int], None]) -> DriveSummary:
    """Judge a recording by the rules of ``fleetmap info``.

    Raises:
        DriveError: it cannot be read at all.
    """
    contents = look_through(recording)
    judgement = judge_contents(contents, progress=progress)
    return summary_of(judgement, contents.fixes)


def summary_of(judgement: DriveJudgement, fixes: Sequence[GnssFix]) -> DriveSummary:
    """What is worth keeping of a judgement, and the way driven."""
    info = judgement.info
    end_ns = None
    if info.start_ns is not None and info.duration_s is not None:
        end_ns = info.start_ns + round(1e9 * info.duration_s)
    return DriveSummary(
        verdict=judgement.verdict,
        reasons=_short(judgement.summary),
        findings=tuple(
            DriveFinding(aspect=finding.aspect, severity=finding.severity, text=_short(finding.text))
            for finding in judgement.findings
        ),
        start_ns=info.start_ns,
        end_ns=end_ns,
        trajectory_lonlat=_way_lonlat(fixes),
        length_m=info.gnss.length_m if info.gnss else None,
        image_count=info.images.count if info.images else 0,
        image_rate_hz=info.images.rate_hz if info.images else None,
        camera_width_px=info.camera.width_px if info.camera else None,
        camera_height_px=info.camera.height_px if info.camera else None,
    )


def reasons_against(summary: DriveSummary) -> str:
    """What makes a drive unfit to be mapped, in one line."""
    bad = [f"{finding.aspect}: {finding.text}" for finding in summary.findings if finding.severity == "bad"]
    return "; ".join(bad) or summary.reasons


def _way_lonlat(fixes: Sequence[GnssFix]) -> tuple[tuple[float, float], ...]:
    """Longitude and latitude about every 10 m, without wild fixes; at most 2000 places."""
    if not fixes:
        return ()
    positions_m = GnssTrack.of(fixes).positions_m
    out_m = np.linalg.norm(positions_m - np.median(positions_m, axis=0), axis=1)
    near = np.flatnonzero(out_m <= _FAR_OUT * np.quantile(out_m, 0.9))
    kept = near[thinned(positions_m[near])]
    if len(kept) > _MAX_PLACES:
        kept = kept[np.linspace(0, len(kept) - 1, _MAX_PLACES).round().astype(np.int64)]
    return tuple((round(fixes[row].lon_deg, 7), round(fixes[row].lat_deg, 7)) for row in kept)


def _short(text: str) -> str:
    return text if len(text) <= _MAX_TEXT else text[: _MAX_TEXT - 1] + "…"
