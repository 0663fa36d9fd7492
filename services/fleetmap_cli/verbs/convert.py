"""``fleetmap convert``: public data sets' folders, and anybody's images and positions, as MCAP recordings."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from fleetmap.camera_file import read_camera
from fleetmap.drives.conversion import Conversion, SimulatedGnss
from fleetmap.drives.euroc import convert_euroc
from fleetmap.drives.image_folder import ImageClock, convert_image_folder
from fleetmap.drives.image_folder_tables import PositionDefaults
from fleetmap.drives.image_folder_times import time_ns
from fleetmap.drives.kitti_odometry import Origin, convert_kitti_odometry
from fleetmap.drives.kitti_raw import convert_kitti_raw
from fleetmap.drives.local_poses import Site
from fleetmap.drives.tum_rgbd import convert_tum_rgbd
from fleetmap.gnss import GNSS_ERROR_MODELS
from fleetmap_cli.options import XYZ, Gap, Numbers
from fleetmap_cli.progress import StageBar

_FOLDER = click.argument("folder", type=click.Path(path_type=Path))
_OUTPUT = click.argument("output", metavar="OUT.mcap", type=click.Path(path_type=Path, dir_okay=False))
_FILE = click.Path(path_type=Path, dir_okay=False)
_SITE = click.option(
    "--origin",
    type=Numbers("LAT,LON,HEIGHT"),
    help="Where on Earth to take the room's origin to be (ellipsoidal height); its x axis points to grid east.",
)
_FORCE = click.option("--force", is_flag=True, help="Replace an existing OUT.mcap.")


class _Time(click.ParamType[int]):
    """An instant such as ``2024-05-01T12:00:00Z``, as nanoseconds since 1970."""

    name = "TIME"

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> int:
        try:
            return value if isinstance(value, int) else time_ns(str(value))
        except ValueError as error:
            self.fail(str(error), param, ctx)


def _gnss_options(command: Callable[..., None]) -> Callable[..., None]:
    """The options of fixes that are made from a reference."""
    options = [
        click.option(
            "--gnss-error",
            type=click.Choice(list(GNSS_ERROR_MODELS)),
            help="Make GNSS fixes from the reference with this receiver's errors. Without it there are none.",
        ),
        click.option("--gnss-interval-s", type=float, help="Seconds between fixes.  [default: 0.1]"),
        click.option("--gnss-gap", type=Gap(), help="A stretch without fixes, in seconds since the first image."),
        click.option(
            "--gnss-outliers",
            type=float,
            metavar="RATIO",
            help="This share of the fixes is 5 to 50 m off, while their covariance says that they are good.",
        ),
        click.option(
            "--antenna-in-camera",
            type=XYZ,
            help="The antenna in metres right, down, forward of the camera.  [default: the camera centre]",
        ),
        click.option("--seed", default=0, show_default=True, type=click.IntRange(0), help="Of the GNSS errors."),
    ]
    for option in reversed(options):
        command = option(command)
    return command


@click.group()
def convert() -> None:
    """Turn a folder of images and measurements into an MCAP recording (ROS 2 messages).

    JPEG and PNG images are copied as they are. Where the folder holds reference poses, they are written beside the
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
    with StageBar() as bar:
        done = convert_kitti_raw(folder, output, camera=camera, gnss=gnss, force=force, progress=bar)
    _report(done)


@convert.command("kitti-odometry")
@_FOLDER
@_OUTPUT
@click.option("--camera", default=0, show_default=True, type=click.IntRange(0, 3), help="Which camera.")
@click.option("--sequence", metavar="NN", help="Which sequence, where FOLDER is the data set's root.")
@_gnss_options
@click.option(
    "--origin",
    type=Numbers("LAT,LON,HEIGHT,HEADING_DEG"),
    help="Where to place the sequence: first camera centre (ellipsoidal height), and heading of its optical axis"
    " clockwise from true north.",
)
@_FORCE
def kitti_odometry(
    folder: Path,
    output: Path,
    camera: int,
    sequence: str | None,
    origin: tuple[float, float, float, float] | None,
    force: bool,
    **gnss_options: Any,
) -> None:
    """KITTI odometry: one rectified camera, and GNSS fixes made from the reference.

    FOLDER is the data set's root with --sequence NN, a sequences/NN folder, or a flat folder with camN, K.txt
    and times.txt. The recording starts at 2023-11-14T22:13:20Z, because its times are relative.

    Example: fleetmap convert kitti-odometry dataset o00.mcap --sequence 00 --gnss-error rtk
    --gnss-interval-s 5 --origin 48.98,8.39,115,20
    """
    gnss = _simulated_gnss(**gnss_options)
    place = Origin(*origin) if origin is not None else None
    with StageBar() as bar:
        done = convert_kitti_odometry(
            folder,
            output,
            camera=camera,
            sequence=sequence,
            gnss=gnss,
            origin=place,
            force=force,
            progress=bar,
        )
    _report(done)


@convert.command("euroc")
@_FOLDER
@_OUTPUT
@click.option("--camera", default=0, show_default=True, type=click.IntRange(0, 9), help="Which camera.")
@click.option(
    "--calibration",
    type=_FILE,
    help="The camera as YAML of ROS' camera_calibration, in the place of sensor.yaml's intrinsics.",
)
@_SITE
@_gnss_options
@_FORCE
def euroc(
    folder: Path,
    output: Path,
    camera: int,
    calibration: Path | None,
    origin: tuple[float, float, float] | None,
    force: bool,
    **gnss_options: Any,
) -> None:
    """EuRoC and other folders in the ASL layout: one camera, the IMU, and how both are mounted.

    FOLDER holds mav0/camN (data.csv, sensor.yaml, data/*.png) and mav0/imu0. The truth of such folders is in
    the frame of a room; it becomes a reference, and GNSS can be made from it, with --origin only.

    Example: fleetmap convert euroc V1_01_easy survey.mcap --origin 47.3769,8.5417,450 --gnss-error rtk
    """
    gnss = _simulated_gnss(**gnss_options)
    known = read_camera(calibration) if calibration is not None else None
    site = Site(*origin) if origin is not None else None
    with StageBar() as bar:
        done = convert_euroc(
            folder,
            output,
            camera=camera,
            calibration=known,
            site=site,
            gnss=gnss,
            force=force,
            progress=bar,
        )
    _report(done)


@convert.command("tum-rgbd")
@_FOLDER
@_OUTPUT
@click.option(
    "--camera",
    "calibration",
    type=_FILE,
    help="The colour camera as YAML of ROS' camera_calibration.  [default: as published for freiburg1, 2 or 3,"
    " by the folder's name]",
)
@_SITE
@_gnss_options
@_FORCE
def tum_rgbd(
    folder: Path,
    output: Path,
    calibration: Path | None,
    origin: tuple[float, float, float] | None,
    force: bool,
    **gnss_options: Any,
) -> None:
    """TUM RGB-D: colour images, depth images in millimetres, and the truth.

    FOLDER holds rgb.txt, depth.txt, groundtruth.txt, rgb/ and depth/. The truth is in the frame of a room; it
    becomes a reference, and GNSS can be made from it, with --origin only.

    Example: fleetmap convert tum-rgbd rgbd_dataset_freiburg1_rpy rpy.mcap
    """
    gnss = _simulated_gnss(**gnss_options)
    known = read_camera(calibration) if calibration is not None else None
    site = Site(*origin) if origin is not None else None
    with StageBar() as bar:
        done = convert_tum_rgbd(folder, output, calibration=known, site=site, gnss=gnss, force=force, progress=bar)
    _report(done)


@convert.command("folder")
@click.argument("images", type=click.Path(path_type=Path))
@click.argument("positions", metavar="POSITIONS.csv", type=_FILE)
@_OUTPUT
@click.option("--camera", "calibration", required=True, type=_FILE, help="YAML of ROS' camera_calibration.")
@click.option("--image-times", type=_FILE, help="CSV with the columns name and time of each image.")
@click.option("--rate-hz", type=float, help="Images come at this rate in the order of their names; with --start.")
@click.option("--start", type=_Time(), help="Time of the first image: ISO 8601, or seconds since 1970.")
@click.option(
    "--image-clock-offset-s",
    default=0.0,
    show_default=True,
    help="Added to every image's time; -7200 for a camera whose clock was set to UTC+2.",
)
@click.option("--epsg", type=int, help="UTM zone of the columns easting and northing, such as 32632.")
@click.option(
    "--height-m", type=float, help="Height above the ellipsoid where POSITIONS.csv has none.  [default: 0]"
)
@click.option(
    "--accuracy-m",
    default=1.5,
    show_default=True,
    type=click.FloatRange(0.0, min_open=True),
    help="One sigma of the positions, where POSITIONS.csv has no accuracy.",
)
@click.option(
    "--antenna-in-camera",
    type=XYZ,
    help="The antenna in metres right, down, forward of the camera.  [default: the camera centre]",
)
@_FORCE
def folder(
    images: Path,
    positions: Path,
    output: Path,
    calibration: Path,
    image_times: Path | None,
    rate_hz: float | None,
    start: int | None,
    image_clock_offset_s: float,
    epsg: int | None,
    height_m: float | None,
    accuracy_m: float,
    antenna_in_camera: tuple[float, float, float] | None,
    force: bool,
) -> None:
    """A folder of images and a CSV of times and positions, for phones and dash cams.

    The first line of POSITIONS.csv names its columns: time (ISO 8601, or a number of s, ms, us or ns since 1970),
    lat and lon (or easting and northing with --epsg), height above the ellipsoid, and accuracy in metres if known.

    The images' times are, the first that applies: --image-times; --rate-hz with --start; a column image in
    POSITIONS.csv; times in the files' names (IMG_20240501_120000123.jpg, 1714564800250.png); EXIF.
    Times that name no zone are UTC.

    \b
    Examples:
      fleetmap convert folder frames track.csv survey.mcap --camera phone.yaml
      fleetmap convert folder frames track.csv survey.mcap --camera dashcam.yaml \\
          --rate-hz 10 --start 2024-05-01T12:00:00Z --accuracy-m 3
    """
    if image_times is not None and rate_hz is not None:
        raise click.UsageError("--image-times and --rate-hz are two ways to say the same; give one of them")
    if (rate_hz is None) != (start is None):
        raise click.UsageError("--rate-hz and --start go together")
    with StageBar() as bar:
        done = convert_image_folder(
            images,
            positions,
            output,
            camera=read_camera(calibration),
            clock=ImageClock(image_times, rate_hz, start, image_clock_offset_s),
            defaults=PositionDefaults(epsg, height_m, accuracy_m),
            antenna_in_camera_m=antenna_in_camera,
            force=force,
            progress=bar,
        )
    _report(done)


def _simulated_gnss(
    gnss_error: str | None,
    gnss_interval_s: float | None,
    gnss_gap: tuple[float, float] | None,
    gnss_outliers: float | None,
    antenna_in_camera: tuple[float, float, float] | None,
    seed: int,
) -> SimulatedGnss | None:
    if gnss_error is not None:
        interval_s = 0.1 if gnss_interval_s is None else gnss_interval_s
        return SimulatedGnss(gnss_error, interval_s, gnss_gap, antenna_in_camera, seed, gnss_outliers or 0.0)
    if any(option is not None for option in (gnss_interval_s, gnss_gap, gnss_outliers, antenna_in_camera)):
        raise click.UsageError(
            "--gnss-interval-s, --gnss-gap, --gnss-outliers and --antenna-in-camera need --gnss-error"
        )
    return None


def _report(done: Conversion) -> None:
    for remark in done.remarks:
        click.echo(f"note: {remark}", err=True)
    parts = [f"{done.frame_count} images", f"{done.fix_count} GNSS fixes"]
    parts += [f"{done.imu_count} IMU measurements"] if done.imu_count else []
    parts += [f"{done.depth_count} depth images"] if done.depth_count else []
    parts += [f"reference in {done.reference}" if done.reference else "no reference"]
    click.echo(f"{done.recording}: {', '.join(parts)}")
