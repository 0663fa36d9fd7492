"""``fleetmap info``: what a recording holds and what it lacks."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path

import click

from fleetmap.drives.inspection import DriveInfo, GnssInfo, ImagesInfo, inspect_drive


@click.command()
@click.argument("recording", type=click.Path(path_type=Path))
@click.option("--image-topic", help="Which images, where the recording holds several topics.")
@click.option("--gnss-topic", help="Which NavSatFix, where the recording holds several topics.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON document instead of text.")
def info(recording: Path, image_topic: str | None, gnss_topic: str | None, as_json: bool) -> None:
    """Say what a recording holds and what it lacks.

    RECORDING is an MCAP file with ROS 2 messages, or a rosbag2 folder that holds one. A recording with parts
    missing is reported; one that cannot be read is an error.

    Example: fleetmap info survey.mcap
    """
    found = inspect_drive(recording, image_topic=image_topic, gnss_topic=gnss_topic)
    click.echo(json.dumps(asdict(found), indent=1) if as_json else "\n".join(_report(found)))


def _report(found: DriveInfo) -> Iterator[str]:
    yield f"recording  {found.path} ({found.size_bytes / 1e6:.1f} MB)"
    if found.start_ns is not None and found.duration_s is not None:
        start = datetime.fromtimestamp(found.start_ns // 1_000_000_000, UTC)
        yield f"time       {found.duration_s:.1f} s from {start:%Y-%m-%dT%H:%M:%SZ}"
    width = max((len(topic.name) for topic in found.topics), default=0)
    for label, topic in zip(_labels("topics"), found.topics, strict=False):
        yield f"{label}{topic.name:<{width}}  {topic.message_count:>7}  {topic.message_type}"
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
