"""``fleetmap locate``: say where single images were taken."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import click

from fleetmap.camera_file import read_camera
from fleetmap.errors import InputError
from fleetmap.geopose import GeoPose
from fleetmap.localization import MAX_CAMERA_BYTES, MAX_IMAGE_BYTES, Localized, LocalizeRequest
from fleetmap_cli.options import LAT_LON, ServerAccess, optional_server_options
from fleetmap_localizer.map_source import MapServer
from fleetmap_localizer.settings import LocalizerSettings
from fleetmap_localizer.single_images import locate as locate_image
from fleetmap_localizer.tile_supply import map_supply_of

NO_POSE_EXIT_CODE = 4

_PATH = click.Path(path_type=Path)
_Locate = Callable[[bytes, str], Localized]  # an image, and what to call it


@click.command()
@click.argument("images", type=_PATH, nargs=-1, required=True, metavar="IMAGE...")
@click.option(
    "--camera",
    "camera_file",
    type=_PATH,
    required=True,
    metavar="CAMERA.yaml",
    help="Its calibration, as ROS' camera_calibration writes it; for images as the sensor gives them, EXIF "
    "orientation ignored.",
)
@optional_server_options("Look into the maps of this map server, e.g. tcp/127.0.0.1:7447.")
@click.option("--map", "map_", type=_PATH, metavar="FOLDER", help="Look into this map package.")
@click.option(
    "--near", type=LAT_LON, help="Where, off by 300 m at most: only what was mapped around there is fetched."
)
@click.option("--remote", is_flag=True, help="With --server: have its localizer do it; no map is fetched to here.")
@click.option(
    "--json", "as_json", is_flag=True, help="One JSON object a line: image, pose (a GeoPose, or null), reason."
)
@click.option(
    "--cache", type=_PATH, metavar="DIR", help="Keep fetched map parts here.  [default: the user's cache]"
)
def locate(
    images: tuple[Path, ...],
    camera_file: Path,
    server: ServerAccess,
    map_: Path | None,
    near: tuple[float, float] | None,
    remote: bool,
    as_json: bool,
    cache: Path | None,
) -> int:
    """Say where each IMAGE (JPEG or PNG, all of one camera) was taken, one line each, each a query on its own.

    A pose is an OGC GeoPose 1.0 (Basic-Quaternion) and more. Its position is WGS 84 with the height above the
    ellipsoid. Its quaternion turns true east, north, up into the camera's axes: x where it looks, y to its left, z
    up in the image; the identity is a level camera that looks east. The heading that is printed is clockwise from
    true north, not from UTM's grid north. Accuracies are one sigma.

    Exit codes: 0 every image has a pose; 4 one at least has none for sure; 1 and 2 as ever.

    \b
    Examples:
      fleetmap locate street.jpg --camera camera.yaml --server tcp/127.0.0.1:7447 --near 49.0324,8.3429
      fleetmap locate *.png --camera camera.yaml --map my_map --json
    """
    if server.is_given == (map_ is not None) or (remote and not server.is_given):
        raise click.UsageError("where are the maps? Give --server ENDPOINT, or --map FOLDER")
    has_all = True
    with _locating(camera_file, server, map_, near, remote, cache) as locate_one:
        for path in images:
            answer = locate_one(_read(path), str(path))
            click.echo(_json_line(path, answer) if as_json else _line(path, answer))
            has_all &= answer.pose is not None
    return 0 if has_all else NO_POSE_EXIT_CODE


@contextmanager
def _locating(
    camera_file: Path,
    server: ServerAccess,
    map_: Path | None,
    near: tuple[float, float] | None,
    remote: bool,
    cache: Path | None,
) -> Iterator[_Locate]:
    """What answers, while the block runs."""
    camera = read_camera(camera_file)
    if remote:
        lat_deg, lon_deg = near or (None, None)
        question = LocalizeRequest(camera=_camera_text(camera_file), lat_deg=lat_deg, lon_deg=lon_deg)
        with server.connect() as client:
            yield lambda image, name: client.localize_image(_small_enough(image, name), question)
        return
    origin = map_ or MapServer(server.endpoint, server.connect)
    settings = LocalizerSettings()
    with closing(map_supply_of(origin, camera, settings, near_lat_lon_deg=near, cache=cache)) as supply:
        yield lambda image, name: locate_image(image, camera, supply.views(), settings, name=name)


def _line(path: Path, answer: Localized) -> str:
    """An answer for people."""
    if answer.pose is None:
        return f"{path}: no pose: {answer.reason}"
    return f"{path}: {_words(answer.pose)}"


def _words(pose: GeoPose) -> str:
    place, utm, accuracy = pose.position, pose.utm, pose.accuracy
    return (
        f"{place.lat:.8f}, {place.lon:.8f}, {place.h:.2f} m, heading {pose.heading_deg:.2f} deg; "
        f"sigma {accuracy.horizontal_sigma_m:.3f} m, height {accuracy.vertical_sigma_m:.3f} m, "
        f"heading {accuracy.heading_sigma_deg:.3f} deg; "
        f"UTM EPSG:{utm.epsg} {utm.easting_m:.2f} {utm.northing_m:.2f}; "
        f"map {pose.map_id}, version {pose.version[:12]}"
    )


def _json_line(path: Path, answer: Localized) -> str:
    return json.dumps({"image": str(path), **answer.model_dump(mode="json")})


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"cannot read image {path}: {error.strerror or error}") from error


def _small_enough(image: bytes, name: str) -> bytes:
    if len(image) > MAX_IMAGE_BYTES:
        raise InputError(f"{name} has {len(image)} bytes, a localizer takes {MAX_IMAGE_BYTES}; send it as JPEG")
    return image


def _camera_text(camera_file: Path) -> str:
    """A calibration that was read already, as it is sent."""
    text = camera_file.read_text(encoding="utf-8")
    if len(text.encode()) > MAX_CAMERA_BYTES:
        raise InputError(f"{camera_file} has more than {MAX_CAMERA_BYTES} bytes, which a localizer takes")
    return text
