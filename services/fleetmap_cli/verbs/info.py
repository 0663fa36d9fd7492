"""``fleetmap info``: what a recording holds and what it lacks, and whether it is good enough to map."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import click

from fleetmap.drives.inspection import DriveInfo, GnssInfo, ImagesInfo, TopicInfo
from fleetmap.inspection.judging import DriveJudgement, judge_drive
from fleetmap_cli.progress import StageBar


@click.command()
@click.argument("recording", type=click.Path(path_type=Path))
@click.option("--image-topic", help="Which images, where the recording holds several topics.")
@click.option("--gnss-topic", help="Which GNSS fixes, where the recording holds several topics.")
@click.option(
    "--quick", is_flag=True, help="Do not look at the images: no blur, exposure, parallax, clock offset."
)
@click.option("--check", is_flag=True, help="Exit with code 1 if the recording is not good enough to map.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON document instead of text.")
def info(
    recording: Path, image_topic: str | None, gnss_topic: str | None, quick: bool, check: bool, as_json: bool
) -> int:
    """Say what a recording holds and what it lacks, and whether it is good enough to map.

    RECORDING is an MCAP file with ROS 2 or Foxglove messages, or a rosbag2 folder that holds one. Each aspect is
    good, poor, bad, or unknown; one bad aspect is enough for a "no". The clocks of camera and GNSS are compared
    by the vehicle's motion, which takes a turn; in JSON, clock_offset_s is the camera's stamp minus the
    receiver's stamp of the same instant.

    A recording that can be read exits with 0, good or not, unless --check is given; one that cannot is an error
    (exit code 2).

    Example: fleetmap info survey.mcap

    Example: fleetmap info survey.mcap --check && fleetmap map survey.mcap --output my_map
    """
    with StageBar() as bar:
        judgement = judge_drive(
            recording, image_topic=image_topic, gnss_topic=gnss_topic, look_at_images=not quick, progress=bar
        )
    click.echo(json.dumps(_document(judgement), indent=1) if as_json else "\n".join(_report(judgement)))
    return 1 if check and judgement.verdict == "no" else 0


def _document(judgement: DriveJudgement) -> dict[str, Any]:
    """What the recording holds on top, the judgement beside it."""
    offset = judgement.clock_offset
    return {
        **asdict(judgement.info),
        "verdict": judgement.verdict,
        "summary": judgement.summary,
        "findings": [asdict(finding) for finding in judgement.findings],
        "clock_offset_s": offset.offset_s,
        "clock_offset_sigma_s": offset.sigma_s,
        "clock_offset_reason": offset.reason,
        "gnss_quality": asdict(judgement.gnss) if judgement.gnss else None,
        "image_quality": asdict(judgement.images) if judgement.images else None,
    }


def _report(judgement: DriveJudgement) -> Iterator[str]:
    yield from _contents(judgement.info)
    width = max((len(finding.aspect) for finding in judgement.findings), default=0)
    for label, finding in zip(_labels("judgement"), judgement.findings, strict=False):
        yield f"{label}{finding.aspect:<{width}}  {finding.severity:<7}  {finding.text}"
    yield f"verdict    good enough to map: {judgement.summary}"


def _contents(found: DriveInfo) -> Iterator[str]:
    yield f"recording  {found.path} ({found.size_bytes / 1e6:.1f} MB)"
    if found.start_ns is not None and found.duration_s is not None:
        start = datetime.fromtimestamp(found.start_ns // 1_000_000_000, UTC)
        yield f"time       {found.duration_s:.1f} s from {start:%Y-%m-%dT%H:%M:%SZ}"
    width = max((len(topic.name) for topic in found.topics), default=0)
    for label, topic in zip(_labels("topics"), found.topics, strict=False):
        yield f"{label}{topic.name:<{width}}  {topic.message_count:>7}  {topic.message_type}{_use(topic)}"
    if found.images is not None:
        yield f"images     {_images_line(found.images)}"
    if (camera := found.camera) is not None:
        distortion = "none"
        if camera.has_distortion:
            distortion = f"{camera.distortion_model} {' '.join(f'{value:g}' for value in camera.distortion)}"
        yield (
            f"camera     {camera.width_px}x{camera.height_px}, fx {camera.fx_px:g} fy {camera.fy_px:g}"
            f" cx {camera.cx_px:g} cy {camera.cy_px:g}, distortion {distortion}"
        )
    if found.gnss is not None:
        yield f"GNSS       {_gnss_line(found.gnss)}"
        if found.gnss.length_m is not None:
            yield f"length     {found.gnss.length_m:.0f} m (from GNSS)"
    if found.antenna is not None:
        x, y, z = found.antenna.position_in_cam_m
        yield f"antenna    x {x:.3f} y {y:.3f} z {z:.3f} m in the camera's frame ({found.antenna.source})"
    for label, line in zip(_labels("missing"), found.missing or ("nothing",), strict=False):
        yield f"{label}{line}"


def _labels(first: str) -> Iterator[str]:
    yield f"{first:<11}"
    while True:
        yield " " * 11


def _use(topic: TopicInfo) -> str:
    if topic.use is None:
        return " (not read)"
    return f" ({topic.use}{f', {topic.rate_hz:.1f} Hz' if topic.rate_hz else ''})"


def _images_line(images: ImagesInfo) -> str:
    size = f"{images.width_px}x{images.height_px} pixels" if images.width_px else "unreadable"
    return f"{images.count} on {images.topic}, {size}{_rhythm(images.rate_hz, images.longest_gap_s)}"


def _gnss_line(gnss: GnssInfo) -> str:
    line = f"{gnss.fix_count} valid fixes of {gnss.message_count} on {gnss.topic}"
    line += _rhythm(gnss.rate_hz, gnss.longest_gap_s)
    if gnss.horizontal_sigma_m is not None and gnss.vertical_sigma_m is not None:
        line += (
            f", reported sigma {gnss.horizontal_sigma_m:.2f} m horizontal, {gnss.vertical_sigma_m:.2f} m vertical"
        )
    return line


def _rhythm(rate_hz: float | None, longest_gap_s: float | None) -> str:
    if rate_hz is None or longest_gap_s is None:
        return ""
    return f", {rate_hz:.2f} Hz, longest gap {longest_gap_s:.2f} s"
