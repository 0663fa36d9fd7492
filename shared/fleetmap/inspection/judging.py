"""Judges whether a recording is good enough to map, before anyone waits for the mapper."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from fleetmap.drives.inspection import DriveContents, DriveInfo, look_through
from fleetmap.errors import InputError
from fleetmap.inspection import findings
from fleetmap.inspection.clock_offset import ClockOffset, estimate_clock_offset
from fleetmap.inspection.findings import Finding
from fleetmap.inspection.gnss_quality import GnssQuality, GnssTrack, measure_gnss
from fleetmap.inspection.image_quality import ImageQuality, measure_images, watch
from fleetmap.inspection.rhythm import rhythm_of
from fleetmap.inspection.sampling import pairs_to_follow

Verdict = Literal["yes", "yes, with warnings", "no"]
Progress = Callable[[str, int, int], None]

_IMAGE_FAULTS = {"readable images", "calibration for the images' size", "images in time order"}


@dataclass(frozen=True)
class DriveJudgement:
    """What a recording holds, and what that is worth."""

    info: DriveInfo
    verdict: Verdict  # is it good enough to map?
    summary: str  # the verdict with its reasons, in one line
    findings: tuple[Finding, ...]
    gnss: GnssQuality | None
    images: ImageQuality | None  # None where they were not, or could not be looked at
    clock_offset: ClockOffset


def judge_drive(
    path: Path,
    *,
    image_topic: str | None = None,
    gnss_topic: str | None = None,
    look_at_images: bool = True,
    progress: Progress = lambda stage, done, total: None,
) -> DriveJudgement:
    """Look through a recording and judge it, aspect by aspect.

    Without ``look_at_images`` nothing is decoded but the first image: quick, and blind for blur, exposure,
    parallax and the clocks' offset.

    Raises:
        DriveError: it cannot be read at all, or a topic that was asked for is not there.
    """
    contents = look_through(path, image_topic=image_topic, gnss_topic=gnss_topic)
    return judge_contents(contents, look_at_images=look_at_images, progress=progress)


def judge_contents(
    contents: DriveContents,
    *,
    look_at_images: bool = True,
    progress: Progress = lambda stage, done, total: None,
) -> DriveJudgement:
    """The same for a recording that has been looked through already."""
    track = GnssTrack.of(contents.fixes) if contents.fixes else None
    gnss = measure_gnss(track, np.array(contents.stamps_ns, dtype=np.int64)) if track is not None else None
    images, offset = None, ClockOffset(None, None, "the images were not looked at", None)
    found = [finding for line in contents.info.missing for finding in findings.of_missing(line)]
    if look_at_images and contents.info.camera is not None:
        try:
            images, offset = _look_at_images(contents, track, progress)
        except InputError as error:
            if not _IMAGE_FAULTS & {finding.aspect for finding in found}:
                found.append(Finding("readable images", "bad", str(error)))
    found += _findings(contents, gnss, images, offset)
    verdict, summary = _verdict(found)
    return DriveJudgement(contents.info, verdict, summary, tuple(found), gnss, images, offset)


def _look_at_images(
    contents: DriveContents, track: GnssTrack | None, progress: Progress
) -> tuple[ImageQuality | None, ClockOffset]:
    drive = contents.drive
    assert drive is not None  # it has a camera
    stamps_ns = np.array(contents.stamps_ns, dtype=np.int64)
    pairs = pairs_to_follow(stamps_ns, track)
    wanted_ns = frozenset(int(stamps_ns[index]) for pair in pairs for index in pair)
    seen = watch(drive.frames_at(wanted_ns), pairs, stamps_ns, drive.camera, progress)
    images = measure_images(seen, track)
    if track is None or contents.antenna is None:
        return images, ClockOffset(None, None, "there are no GNSS fixes", None)
    return images, estimate_clock_offset(seen.motions, track, contents.antenna)


def _findings(
    contents: DriveContents, gnss: GnssQuality | None, images: ImageQuality | None, offset: ClockOffset
) -> Iterator[Finding]:
    rhythm = rhythm_of(contents.stamps_ns) if contents.info.images is not None else None
    if rhythm is not None:
        yield findings.image_rate(rhythm, gnss)
        yield findings.image_gaps(rhythm, gnss)
    if images is not None:
        yield findings.sharpness(images)
        yield findings.exposure(images)
        yield findings.texture(images)
        yield findings.parallax(images)
    if gnss is None:
        return
    scatter_m = max((sigma for sigma in (gnss.scatter_m, offset.scatter_m) if sigma is not None), default=None)
    yield findings.gnss_accuracy(gnss, scatter_m)
    yield findings.gnss_jumps(gnss, len(contents.fixes))
    yield findings.gnss_coverage(gnss, rhythm_of([fix.stamp_ns for fix in contents.fixes]))
    yield findings.way(gnss, contents.info.gnss.length_m or 0.0 if contents.info.gnss else 0.0)
    if contents.antenna is not None:
        yield findings.antenna_place(contents.antenna)
    yield findings.clocks(offset, gnss)


def _verdict(found: list[Finding]) -> tuple[Verdict, str]:
    bad = [finding for finding in found if finding.severity == "bad"]
    poor = [finding for finding in found if finding.severity == "poor"]
    if bad:
        return "no", "no, because of " + ", ".join(finding.aspect for finding in bad)
    if poor:
        return "yes, with warnings", "yes, with warnings: " + ", ".join(finding.aspect for finding in poor)
    return "yes", "yes"
