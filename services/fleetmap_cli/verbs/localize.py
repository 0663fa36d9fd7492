"""``fleetmap localize``: read a vehicle's UTM pose from its camera, in a map from a server or a folder."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import click
from tqdm import tqdm

from fleetmap.covariances import write_covariances
from fleetmap.drive import Drive
from fleetmap.drives import open_drive
from fleetmap.errors import DriveError
from fleetmap.trajectory import write_trajectory
from fleetmap_cli.options import LAT_LON, ServerAccess, optional_server_options
from fleetmap_localizer.map_source import fetch_candidates, fetch_map, read_map
from fleetmap_localizer.map_supply import WholeMaps
from fleetmap_localizer.map_view import LocalizableMap
from fleetmap_localizer.part_cache import PartCache
from fleetmap_localizer.run import localize_drive
from fleetmap_localizer.settings import LocalizerSettings

_PATH = click.Path(path_type=Path)
_FILE = click.Path(path_type=Path, dir_okay=False)


@click.command()
@click.argument("recording", type=_PATH)
@optional_server_options("Fetch the map from this map server, e.g. tcp/127.0.0.1:7447.")
@click.option("--vehicle-id", metavar="NAME", help="With --server: the vehicle that it sees online meanwhile.")
@click.option(
    "--map", "map_", metavar="ID|FOLDER", help="With --server: the map's id. Without: the folder of a map package."
)
@click.option(
    "--trajectory", type=_FILE, required=True, metavar="OUT.tum", help="Write the poses here (TUM text, UTM)."
)
@click.option(
    "--covariances",
    type=_FILE,
    metavar="OUT.csv",
    help="Write the poses' covariances, relative to the map, here: stamp_ns and the upper triangle of [rotation "
    "(rad), translation (m)] in the camera's frame.",
)
@click.option(
    "--near", type=LAT_LON, help="With --server: choose among the maps within 1 km of here, nearest first."
)
@click.option(
    "--use-gnss", is_flag=True, help="Take --near from the recording's first GNSS fix. Otherwise GNSS is not read."
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
    trajectory: Path,
    covariances: Path | None,
    near: tuple[float, float] | None,
    use_gnss: bool,
    image_topic: str | None,
    gnss_topic: str | None,
    cache: Path | None,
) -> None:
    """Read the UTM pose of every image of RECORDING from the camera alone.

    The map comes from a server (--server; verified and kept in a cache) or from a folder (--map). Without --map
    and --near every map of the server is tried, newest first, and the first that knows the place is kept.
    Images that cannot be localised for sure get no line in the trajectory.

    \b
    Examples:
      fleetmap localize second.mcap --server tcp/127.0.0.1:7447 --trajectory second.tum
      fleetmap localize second.mcap --server tcp/127.0.0.1:7447 --near 49.0324,8.3429 --trajectory second.tum
      fleetmap localize second.mcap --map my_map --trajectory second.tum
    """
    if not server.is_given and map_ is None:
        raise click.UsageError("where is the map? Give --server ENDPOINT, or --map FOLDER")
    drive = open_drive(recording, image_topic=image_topic, gnss_topic=gnss_topic)
    camera = drive.camera
    if use_gnss and map_ is None and near is None:
        near = _first_fix(drive)
    with _maps(server, vehicle_id, map_, near, cache) as maps:
        # disable=None: no bar where stderr is a file or a pipe
        frames = tqdm(
            drive.frames(), total=drive.frame_count, unit="image", desc="localize", file=sys.stderr, disable=None
        )
        settings = LocalizerSettings()
        result = localize_drive(frames, camera, WholeMaps(maps, camera, settings), settings)
    write_trajectory(trajectory, result.trajectory())
    if covariances is not None:
        write_covariances(covariances, result.covariances())
    for map_id, version in result.map_versions:
        click.echo(f"map:            {map_id} (version {version[:12]})")
    click.echo(f"frames:         {result.frame_count}")
    click.echo(f"poses:          {len(result.poses)} ({100.0 * len(result.poses) / result.frame_count:.1f} %)")
    click.echo(f"median inliers: {result.median_inliers}")
    click.echo(f"trajectory:     {trajectory}")
    if covariances is not None:
        click.echo(f"covariances:    {covariances}")


@contextmanager
def _maps(
    server: ServerAccess,
    vehicle_id: str | None,
    map_: str | None,
    near: tuple[float, float] | None,
    cache: Path | None,
) -> Iterator[Iterable[LocalizableMap]]:
    if not server.is_given:
        assert map_ is not None
        yield [read_map(Path(map_))]
        return
    with server.connect(vehicle_id=vehicle_id) as client:
        parts = PartCache(cache)
        if map_ is not None:
            yield [fetch_map(client, map_, None, parts)]
        else:
            yield fetch_candidates(client, near, parts)


def _first_fix(drive: Drive) -> tuple[float, float]:
    fixes = drive.gnss_fixes()
    if not fixes:
        raise DriveError(
            f"{drive.name} holds no valid GNSS fix, and --use-gnss needs one; give --near LAT,LON instead"
        )
    return fixes[0].lat_deg, fixes[0].lon_deg
