"""``fleetmap simulate``: a drive through a simulated world as a recording, with the truth beside it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from fleetmap.camera_file import read_camera
from fleetmap.files import refuse_existing
from fleetmap.gnss import GNSS_ERROR_MODELS
from fleetmap.simulation.depth_camera import DepthErrorModel
from fleetmap.simulation.imu import IMU_ERROR_MODELS
from fleetmap.simulation.lidar import LidarModel
from fleetmap.simulation.look import LOOKS
from fleetmap.simulation.recording import record_drive
from fleetmap.simulation.scenario import KITTI_LIKE, Scenario, simulate_scenario
from fleetmap.simulation.simulated_drive import Sensors
from fleetmap.simulation.wheel import WheelErrorModel
from fleetmap.simulation.world import WORLD_KINDS
from fleetmap_cli.options import XYZ, Gap, Numbers

_FILE = click.Path(path_type=Path, dir_okay=False)
_SEED = click.IntRange(0, 2**31 - 1)
_SENSORS = ("imu", "wheel", "depth", "lidar")


class _SensorList(click.ParamType[frozenset[str]]):
    """Names with commas between, such as ``imu,wheel``; or ``all``."""

    name = "LIST"

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> frozenset[str]:
        if isinstance(value, frozenset):
            return value
        names = frozenset(str(value).lower().split(",")) if value else frozenset()
        if names == {"all"}:
            return frozenset(_SENSORS)
        if unknown := sorted(names - set(_SENSORS)):
            self.fail(f"'{unknown[0]}' is no sensor; choose from {', '.join(_SENSORS)}, or all", param, ctx)
        return names


@click.command(short_help="Simulate a drive with the truth known.")
@click.argument("output", metavar="OUT.mcap", type=_FILE)
@click.option("--world", default=1, show_default=True, type=_SEED, metavar="SEED", help="Which world.")
@click.option(
    "--kind",
    default="city",
    show_default=True,
    type=click.Choice(WORLD_KINDS),
    help="city: a circuit around blocks. facades: the same among houses that look alike. open: a circuit on a "
    "wide place. straight: a country road. tunnel: the same through a hill. street: one bend.",
)
@click.option(
    "--world-length-m",
    type=float,
    metavar="L",
    help="Length of the world's road, or of one lap of its circuit. Seed, kind and this length name a world."
    "  [default: a circuit of 600 m, more only for longer drives; an open road as long as the drive]",
)
@click.option(
    "--world-variant",
    default=0,
    show_default=True,
    type=_SEED,
    metavar="N",
    help="Other than 0: a street that could be taken for the world's own. Of the same shape, three quarters of "
    "its walls, roofs, hedges and pieces of road painted otherwise, other trees, cars and hills.",
)
@click.option(
    "--site",
    type=Numbers("LAT,LON,HEIGHT"),
    default="48.77,11.43,420",
    show_default=True,
    help="Where on Earth: degrees, and metres above the ellipsoid.",
)
@click.option(
    "--drive",
    default=1,
    show_default=True,
    type=_SEED,
    metavar="SEED",
    help="Which drive: its day, light, swaying, sensor errors, and which cars park where.",
)
@click.option(
    "--length-m", default=300.0, show_default=True, help="How far to drive. On a circuit, lap after lap."
)
@click.option("--start-m", default=0.0, show_default=True, help="Where along the road to start.")
@click.option(
    "--lane-m", default=0.0, show_default=True, help="To the left of the own lane; 3.5 is the other one."
)
@click.option(
    "--speed-mps", default=8.0, show_default=True, help="Even speed; tight bends are driven more slowly."
)
@click.option("--moving-cars", default=0.0, show_default=True, help="Oncoming cars per kilometre, and one ahead.")
@click.option(
    "--camera",
    type=_FILE,
    metavar="FILE",
    help="YAML in the layout of ROS' camera_calibration: plumb_bob, rational_polynomial or equidistant."
    f"  [default: {KITTI_LIKE.width_px}x{KITTI_LIKE.height_px}, {KITTI_LIKE.fx_px:.0f} px, no distortion]",
)
@click.option("--rate-hz", default=10.0, show_default=True, help="Images per second.")
@click.option("--camera-height-m", default=1.65, show_default=True, help="Above the road.")
@click.option(
    "--look", default="day", show_default=True, type=click.Choice(list(LOOKS)), help="Light and weather."
)
@click.option(
    "--rolling-shutter-ms",
    default=0.0,
    show_default=True,
    help="From the first row to the last; images are stamped with their middle row. 0: a global shutter.",
)
@click.option(
    "--gnss",
    default="rtk",
    show_default=True,
    type=click.Choice([*GNSS_ERROR_MODELS, "none"]),
    help="Receiver: 5 cm, or 1 to 2 m of slow drift. In tunnels there are no fixes.",
)
@click.option("--gnss-interval-s", default=1.0, show_default=True, help="Seconds between fixes.")
@click.option("--gnss-gap", type=Gap(), help="A stretch without fixes, in seconds since the first image.")
@click.option(
    "--gnss-clock-offset-s", default=0.0, show_default=True, help="How late the stamps of the fixes are."
)
@click.option(
    "--gnss-outliers",
    default=0.0,
    show_default=True,
    metavar="RATIO",
    help="This share of the fixes is 5 to 50 m off, while their covariance says that they are good.",
)
@click.option(
    "--antenna-offset",
    type=XYZ,
    default="0,0,0",
    show_default=True,
    help="Antenna from the camera centre in metres: forward, left, up. The recording holds it as a transform.",
)
@click.option(
    "--sensors",
    type=_SensorList(),
    default="",
    help="What else is on board: imu (200 Hz), wheel (50 Hz), depth (with every image, up to 10 m), lidar (10 Hz, "
    "270 degrees, up to 30 m); with commas between, or all.",
)
@click.option(
    "--imu-model",
    default="consumer",
    show_default=True,
    type=click.Choice(list(IMU_ERROR_MODELS)),
    help="How the IMU errs.",
)
@click.option(
    "--images-from",
    type=_FILE,
    metavar="OTHER.mcap",
    help="Take the images over from a recording of the same drive with another receiver, which saves rendering "
    "them; stamps and every 20th image are checked. The bytes are the same with and without.",
)
@click.option("--force", is_flag=True, help="Replace an existing recording.")
def simulate(output: Path, images_from: Path | None, force: bool, **options: Any) -> None:
    """Simulate a drive and write OUT.mcap (ROS 2 messages), and apart from it the truth: OUT.reference.tum.

    Equal options give equal bytes. Where the world has ArUco markers, OUT.markers.json says where they are.

    \b
    A survey drive, and another vehicle in the other lane, on another day, with another camera and no GNSS:
      fleetmap simulate survey.mcap --world 7 --drive 1 --length-m 300
      fleetmap simulate second.mcap --world 7 --drive 2 --length-m 300 --lane-m 3.5 \\
          --speed-mps 11 --camera second.yaml --look overcast --gnss none
    A map from the first, poses for the second from its images alone, and both against the truth:
      fleetmap map survey.mcap --output my_map --trajectory survey.tum
      fleetmap localize second.mcap --map my_map --trajectory second.tum
      fleetmap evaluate survey.tum survey.reference.tum --spline-through survey.mcap
      fleetmap evaluate second.tum second.reference.tum
    """
    refuse_existing(output, force)
    drive = simulate_scenario(_scenario(options))
    recorded = record_drive(drive, output, force=force, progress=True, images_from=images_from)
    circuit = " around a circuit" if drive.world.is_closed else ""
    apart = [f"reference in {recorded.reference}"]
    if recorded.markers is not None:
        apart.append(f"{len(drive.world.markers)} markers in {recorded.markers}")
    click.echo(
        f"{output}: {drive.frame_count} images in {drive.motion.duration_s:.1f} s{circuit},"
        f" {len(drive.fixes)} GNSS fixes; {', '.join(apart)}"
    )


def _scenario(options: dict[str, Any]) -> Scenario:
    forward_m, left_m, up_m = options["antenna_offset"]
    on_board = options["sensors"]
    return Scenario(
        world_seed=options["world"],
        kind=options["kind"],
        world_length_m=options["world_length_m"],
        world_variant=options["world_variant"],
        site=options["site"],
        drive_seed=options["drive"],
        length_m=options["length_m"],
        start_m=options["start_m"],
        lane_m=options["lane_m"],
        speed_mps=options["speed_mps"],
        rate_hz=options["rate_hz"],
        moving_cars_per_km=options["moving_cars"],
        camera=KITTI_LIKE if options["camera"] is None else read_camera(options["camera"]),
        camera_height_m=options["camera_height_m"],
        look=options["look"],
        readout_s=options["rolling_shutter_ms"] * 1e-3,
        gnss=None if options["gnss"] == "none" else options["gnss"],
        gnss_interval_s=options["gnss_interval_s"],
        gnss_gap_s=options["gnss_gap"],
        gnss_clock_offset_s=options["gnss_clock_offset_s"],
        gnss_outlier_ratio=options["gnss_outliers"],
        antenna_in_cam_m=(-left_m + 0.0, -up_m + 0.0, forward_m),
        sensors=Sensors(
            IMU_ERROR_MODELS[options["imu_model"]] if "imu" in on_board else None,
            WheelErrorModel() if "wheel" in on_board else None,
            DepthErrorModel() if "depth" in on_board else None,
            LidarModel() if "lidar" in on_board else None,
        ),
    )
