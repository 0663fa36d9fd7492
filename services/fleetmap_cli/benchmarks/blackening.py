"""``python -m fleetmap_cli.benchmarks.blackening IN.mcap OUT.mcap``: a recording whose camera is blind at times.

Images of the given stretches become black; all others stay what they are, byte for byte. Of the other sensors only
those that are to be kept are taken over, with their mountings.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import click
import numpy as np

from fleetmap.drives.image_codec import encode_image
from fleetmap.drives.mcap_drive import McapDrive
from fleetmap.drives.messages import IMAGES, CompressedPicture
from fleetmap.drives.ros2_writer import DriveWriter
from fleetmap.drives.topic_reading import read_values
from fleetmap.errors import DriveError
from fleetmap.geometry import Pose
from fleetmap.gnss import in_gap

_FILE = click.Path(path_type=Path, dir_okay=False)
_CAMERA, _ANTENNA, _IMU, _VEHICLE = "camera", "gnss", "imu", "base_link"


@dataclass(frozen=True)
class _Message:
    stamp_ns: int
    write: Callable[[], None]


@click.command()
@click.argument("source", metavar="IN.mcap", type=_FILE)
@click.argument("target", metavar="OUT.mcap", type=_FILE)
@click.option("--every-s", type=float, required=True, help="From the start of one stretch to that of the next.")
@click.option(
    "--black-s", type=float, required=True, help="Length of each stretch; the first begins after one interval."
)
@click.option("--keep", default="", help="Other sensors: imu, wheel, gnss, with commas between.")
def blacken(source: Path, target: Path, every_s: float, black_s: float, keep: str) -> None:
    """Write OUT.mcap."""
    drive, sensors = McapDrive(source), keep.split(",")
    with DriveWriter(target, drive.camera, force=True, camera_frame_id=_CAMERA) as writer:
        streams = [_images(drive, writer, black_stretches_s(drive, every_s, black_s))]
        if "imu" in sensors and (imu := drive.imu_mounting()) is not None:
            writer.write_static_transform(_CAMERA, _IMU, imu.cam_from_sensor)
            streams.append(
                _Message(sample.stamp_ns, partial(writer.write_imu, sample, _IMU))
                for sample in drive.imu_samples()
            )
        if "wheel" in sensors and (wheels := drive.wheel_mounting()) is not None:
            writer.write_static_transform(_CAMERA, _VEHICLE, wheels.cam_from_sensor)
            streams.append(
                _Message(speed.stamp_ns, partial(writer.write_wheel_speed, speed, _VEHICLE))
                for speed in drive.wheel_speeds()
            )
        if "gnss" in sensors:
            writer.write_static_transform(_CAMERA, _ANTENNA, Pose(np.eye(3), drive.antenna().position_in_cam_m))
            streams.append(
                _Message(fix.stamp_ns, partial(writer.write_fix, fix, _ANTENNA)) for fix in drive.gnss_fixes()
            )
        for message in heapq.merge(*streams, key=lambda each: each.stamp_ns):
            message.write()


def black_stretches_s(drive: McapDrive, every_s: float, black_s: float) -> list[tuple[float, float]]:
    """Start, since the first image, and length of each stretch; the camera sees again before the drive is over."""
    stamps_ns = drive.frame_stamps_ns()
    lasts_s = (stamps_ns[-1] - stamps_ns[0]) * 1e-9
    return [(float(start_s), black_s) for start_s in np.arange(every_s, lasts_s - black_s, every_s)]


def _images(drive: McapDrive, writer: DriveWriter, stretches_s: list[tuple[float, float]]) -> Iterator[_Message]:
    black = encode_image(np.zeros((drive.camera.height_px, drive.camera.width_px), dtype=np.uint8))
    first_ns = drive.frame_stamps_ns()[0]
    for message in read_values(drive.mcap, IMAGES, drive.image_topic):
        if not (isinstance(message.picture, CompressedPicture) and "jpeg" in message.picture.format):
            raise DriveError(f"{drive.name}: only recordings with JPEG images are blackened")
        is_black = any(in_gap(message.stamp_ns - first_ns, stretch) for stretch in stretches_s)
        jpeg = black if is_black else message.picture.data
        yield _Message(message.stamp_ns, partial(writer.write_jpeg, message.stamp_ns, jpeg))


if __name__ == "__main__":
    blacken()
