"""``fleetmap localize``: read a vehicle's UTM pose from its camera, in maps from a server or a folder."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from contextlib import closing
from functools import partial
from pathlib import Path

import click
from tqdm import tqdm

from fleetmap.drive import Drive, Frame
from fleetmap.drives import open_drive
from fleetmap.errors import DriveError
from fleetmap.read_ahead import read_ahead
from fleetmap_cli.demo_processes import interrupted_once
from fleetmap_cli.localization_report import PoseOutputs, finish
from fleetmap_cli.options import LAT_LON, ServerAccess, optional_server_options
from fleetmap_localizer.dead_reckoning import DeadReckoning
from fleetmap_localizer.map_source import MapServer
from fleetmap_localizer.paced import PacedFrames
from fleetmap_localizer.pose_files import require_pose_file_name
from fleetmap_localizer.run import localize_drive
from fleetmap_localizer.settings import LocalizerSettings
from fleetmap_localizer.tile_supply import map_supply_of

_PATH = click.Path(path_type=Path)
_FILE = click.Path(path_type=Path, dir_okay=False)
_IMAGES_AHEAD = 8  # decoded before they are due


@click.command()
@click.argument("recording", type=_PATH)
@optional_server_options("Fetch what is needed of the maps of this server, e.g. tcp/127.0.0.1:7447.")
@click.option("--vehicle-id", metavar="NAME", help="With --server: the vehicle that it sees online meanwhile.")
@click.option(
    "--map", "map_", metavar="ID|FOLDER", help="With --server: the map's id. Without: the folder of a map package."
)
@click.option("--trajectory", type=_FILE, metavar="OUT.tum", help="Write the poses here (TUM text, UTM).")
@click.option(
    "--output",
    "outputs",
    type=_FILE,
    multiple=True,
    metavar="OUT.csv|.geojson|.mcap|.tum",
    help="Write the answers here, as the name's ending says. May be given several times.",
)
@click.option(
    "--covariances",
    type=_FILE,
    metavar="OUT.csv",
    help="Write the covariances of the poses in OUT.tum here: stamp_ns and the upper triangle of [rotation "
    "(rad), translation (m)] in the camera's frame.",
)
@click.option(
    "--with-predicted", is_flag=True, help="Have TUM files hold predicted poses too, which they cannot mark."
)
@click.option(
    "--near",
    type=LAT_LON,
    help="Where the drive begins, to some 300 m. Otherwise it may begin anywhere in the maps.",
)
@click.option(
    "--use-gnss",
    is_flag=True,
    help="Take --near from the recording's first GNSS fix, and let fixes help to carry poses across gaps. "
    "Otherwise GNSS is not read.",
)
@click.option(
    "--independent",
    is_flag=True,
    help="Every image is a query on its own: no tracking, nothing learnt from those before. For measuring, and "
    "for photos that are no drive.",
)
@click.option(
    "--paced",
    is_flag=True,
    help="Replay at recorded speed. Images that are late are dropped, not queued; latencies are told at the end.",
)
@click.option("--image-topic", metavar="TOPIC", help="Which camera, where the recording holds several.")
@click.option("--gnss-topic", metavar="TOPIC", help="Which receiver, where --use-gnss finds several.")
@click.option(
    "--cache", type=_PATH, metavar="DIR", help="Keep fetched map parts here.  [default: the user's cache]"
)
def localize(
    recording: Path,
    server: ServerAccess,
    vehicle_id: str | None,
    map_: str | None,
    trajectory: Path | None,
    outputs: tuple[Path, ...],
    covariances: Path | None,
    with_predicted: bool,
    near: tuple[float, float] | None,
    use_gnss: bool,
    independent: bool,
    paced: bool,
    image_topic: str | None,
    gnss_topic: str | None,
    cache: Path | None,
) -> int | None:
    """Read the UTM pose of every image of RECORDING from the camera alone.

    Maps come from a server (--server) or from a folder (--map). Of a server's maps only the 128 m tiles around
    the vehicle are fetched, ahead of it as it moves, verified, and kept in a cache that works without the server;
    newer versions are taken up as they are announced. Without --near every map is searched for the first pose. No
    pose mixes two maps.

    An image that cannot be localised for sure gets no pose, and a reason. Where the recording has an IMU or wheel
    speeds, poses are carried across such gaps with growing uncertainty, and marked as predicted.

    What is written, whole or not at all, also when the run is interrupted:

    \b
      .tum      the measured poses, for evo and 'fleetmap evaluate'
      .csv      a line an image: measured, predicted or none with the reason; latitude, longitude, height,
                heading, UTM, quaternion, sigmas, map and version, inliers, covariance
      .geojson  the way driven, broken where poses are missing, and a point a pose (RFC 7946)
      .mcap     foxglove.LocationFix (/fleetmap/location, covariance to the true east, north and up) and
                foxglove.PoseInFrame (/fleetmap/pose, frame EPSG:326xx); predicted ones under
                /fleetmap/predicted

    \b
    Examples:
      fleetmap localize second.mcap --server tcp/127.0.0.1:7447 --trajectory second.tum
      fleetmap localize second.mcap --server tcp/127.0.0.1:7447 --near 49.0324,8.3429 --trajectory second.tum
      fleetmap localize second.mcap --map my_map --trajectory second.tum
      fleetmap localize second.mcap --map my_map --output second.csv --output second.geojson --paced
      fleetmap localize photos.mcap --map my_map --output photos.csv --independent
    """
    if not server.is_given and map_ is None:
        raise click.UsageError("where is the map? Give --server ENDPOINT, or --map FOLDER")
    wanted = PoseOutputs(trajectory, covariances, outputs, with_predicted)
    _require_outputs(wanted)
    drive = open_drive(recording, image_topic=image_topic, gnss_topic=gnss_topic)
    camera, settings = drive.camera, LocalizerSettings()
    if use_gnss and near is None:
        near = _first_fix(drive)
    reckoning = None if independent else DeadReckoning.for_drive(drive, use_gnss=use_gnss)
    paced_frames = PacedFrames(read_ahead(drive.frames(), _IMAGES_AHEAD)) if paced else None
    # A vehicle does not wait for what lies ahead; a replay that is not paced would outrun the download.
    origin = _origin(server, vehicle_id, map_)
    supply = map_supply_of(origin, camera, settings, near_lat_lon_deg=near, cache=cache, in_step=not paced)
    with interrupted_once(), closing(supply):
        result = localize_drive(
            _with_bar(paced_frames or drive.frames(), drive.frame_count),
            camera,
            supply,
            settings,
            independent=independent,
            reckoning=reckoning,
            looks_ahead=not paced,
        )
    if paced_frames is not None:
        result = result.with_dropped(paced_frames.dropped_stamps_ns)
    return finish(wanted, result, paced_frames, drive.frame_count)


def _require_outputs(outputs: PoseOutputs) -> None:
    """Refuse a run that would write nothing, or what nobody can write."""
    if outputs.trajectory is None and not outputs.others:
        raise click.UsageError("where to? Give --trajectory OUT.tum, or --output OUT.csv, .geojson, .mcap or .tum")
    for path in outputs.others:
        require_pose_file_name(path)


def _with_bar(frames: Iterable[Frame], count: int) -> Iterable[Frame]:
    # disable=None: no bar where stderr is a file or a pipe
    return tqdm(frames, total=count, unit="image", desc="localize", file=sys.stderr, disable=None)


def _origin(server: ServerAccess, vehicle_id: str | None, map_: str | None) -> MapServer | Path:
    """Where the maps come from: those of a server or one of them, or a folder."""
    if server.is_given:
        return MapServer(server.endpoint, partial(server.connect, vehicle_id=vehicle_id), map_)
    assert map_ is not None
    return Path(map_)


def _first_fix(drive: Drive) -> tuple[float, float]:
    fixes = drive.gnss_fixes()
    if not fixes:
        raise DriveError(
            f"{drive.name} holds no valid GNSS fix, and --use-gnss needs one; give --near LAT,LON instead"
        )
    return fixes[0].lat_deg, fixes[0].lon_deg
