"""``fleetmap convert``: public data sets' folders as MCAP recordings."""

from __future__ import annotations

from pathlib import Path

import click

from fleetmap.drives.conversion import Conversion, SimulatedGnss
from fleetmap.drives.kitti_odometry import Origin, convert_kitti_odometry
from fleetmap.drives.kitti_raw import convert_kitti_raw
from fleetmap.gnss import GNSS_ERROR_MODELS
from fleetmap_cli.options import XYZ, Numbers

_FOLDER = click.argument("folder", type=click.Path(path_type=Path))
_OUTPUT = click.argument("output", metavar="OUT.mcap", type=click.Path(path_type=Path, dir_okay=False))
_FORCE = click.option("--force", is_flag=True, help="Replace an existing OUT.mcap.")


class _Gap(click.ParamType[tuple[float, float]]):
    """A stretch of time such as ``11:10``."""

    name = "START_S:LENGTH_S"

    def convert(
        self, value: object, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, float]:
        if isinstance(value, tuple):
            return value
        try:
            start_s, length_s = (float(field) for field in str(value).split(":"))
        except ValueError:
            start_s = length_s = -1.0
        if not (0.0 <= start_s < float("inf") and 0.0 < length_s < float("inf")):
            self.fail(f"'{value}' is not {self.name}: two numbers of seconds with a colon between", param, ctx)
        return start_s, length_s


@click.group()
def convert() -> None:
    """Turn a public data set's folder into an MCAP recording (ROS 2 messages).

    Images are copied as they are. Where the folder holds reference poses, they are written beside the
    recording as NAME.reference.tum with the images' stamps; they never enter the recording.
    """


@convert.command("kitti-raw")
@_FOLDER
@_OUTPUT
@click.option("--camera", default=0, show_default=True, type=click.IntRange(0, 3), help="Which camera.")
@click.option("--gnss/--no-gnss", default=True, help="Write the OXTS positions as NavSatFix, or leave them out.")
@_FORCE
def kitti_raw(folder: Path, output: Path, camera: int, gnss: bool, force: bool) -> None:
    """KITTI raw: one camera, the OXTS positions, and how both are mounted.

    FOLDER is DATE_drive_NNNN_sync or _extract with the calibration files in the folder above, or a flat
    folder with camN and camN_timestamps.txt. Clock readings count as UTC.

    Example: fleetmap convert kitti-raw 2011_09_26/2011_09_26_drive_0005_sync survey.mcap --camera 0
    """
    _report(convert_kitti_raw(folder, output, camera=camera, gnss=gnss, force=force))


@convert.command("kitti-odometry")
@_FOLDER
@_OUTPUT
@click.option("--camera", default=0, show_default=True, type=click.IntRange(0, 3), help="Which camera.")
@click.option("--sequence", metavar="NN", help="Which sequence, where FOLDER is the data set's root.")
@click.option(
    "--gnss-error",
    type=click.Choice(list(GNSS_ERROR_MODELS)),
    help="Make GNSS fixes from the reference with this receiver's errors. Without it there are none.",
)
@click.option("--gnss-interval-s", type=float, help="Seconds between fixes.  [default: 0.1]")
@click.option("--gnss-gap", type=_Gap(), help="A stretch without fixes, in seconds since the first image.")
@click.option(
    "--antenna-in-camera",
    type=XYZ,
    help="The antenna in metres right, down, forward of the camera.  [default: the camera centre]",
)
@click.option(
    "--origin",
    type=Numbers("LAT,LON,HEIGHT,HEADING_DEG"),
    help="Where to place the sequence: first camera centre (ellipsoidal height), and heading of its optical axis"
    " clockwise from true north.",
)
@click.option("--seed", default=0, show_default=True, type=click.IntRange(0), help="Of the GNSS errors.")
@_FORCE
def kitti_odometry(
    folder: Path,
    output: Path,
    camera: int,
    sequence: str | None,
    gnss_error: str | None,
    gnss_interval_s: float | None,
    gnss_gap: tuple[float, float] | None,
    antenna_in_camera: tuple[float, float, float] | None,
    origin: tuple[float, float, float, float] | None,
    seed: int,
    force: bool,
) -> None:
    """KITTI odometry: one rectified camera, and GNSS fixes made from the reference.

    FOLDER is the data set's root with --sequence NN, a sequences/NN folder, or a flat folder with camN, K.txt
    and times.txt. The recording starts at 2023-11-14T22:13:20Z, because its times are relative.

    Example: fleetmap convert kitti-odometry dataset o00.mcap --sequence 00 --gnss-error rtk
    --gnss-interval-s 5 --origin 48.98,8.39,115,20
    """
    gnss = None
    if gnss_error is not None:
        interval_s = 0.1 if gnss_interval_s is None else gnss_interval_s
        gnss = SimulatedGnss(gnss_error, interval_s, gnss_gap, antenna_in_camera, seed)
    elif any(option is not None for option in (gnss_interval_s, gnss_gap, antenna_in_camera)):
        raise click.UsageError("--gnss-interval-s, --gnss-gap and --antenna-in-camera need --gnss-error")
    _report(
        convert_kitti_odometry(
            folder,
            output,
            camera=camera,
            sequence=sequence,
            gnss=gnss,
            origin=Origin(*origin) if origin is not None else None,
            force=force,
        )
    )


def _report(conversion: Conversion) -> None:
    reference = f"reference in {conversion.reference}" if conversion.reference else "no reference"
    click.echo(
        f"{conversion.recording}: {conversion.frame_count} images, {conversion.fix_count} GNSS fixes, {reference}"
    )
