"""The whole chain on one page: two drives of a simulated street, a map, its server, a second vehicle's poses.

What a fleet does on several computers happens here on one, but really: each stage is the verb that a user would
type, in a process of its own, and the map travels over Zenoh and HTTP. Only the street is simulated.
"""

from __future__ import annotations

import json
import os
import shutil
import tempfile
import time
import urllib.request
from pathlib import Path

import click
import numpy as np

from fleetmap.camera import Camera
from fleetmap.drive import START_NS
from fleetmap.errors import InputError, OutputExistsError, ServerError, StorageError
from fleetmap.files import atomic_path
from fleetmap.simulation.driving import drive_along
from fleetmap.simulation.look import Look
from fleetmap.simulation.recording import record_drive
from fleetmap.simulation.simulated_drive import simulate_drive
from fleetmap.simulation.street import build_street
from fleetmap_cli.demo_picture import draw_demonstration
from fleetmap_cli.demo_processes import interrupted_once, run_verb, running_map_server
from fleetmap_cli.plotting import require_picture_name

SURVEY_CAMERA = Camera(1024, 384, 600.0, 600.0, 511.5, 191.5)
SECOND_CAMERA = Camera(800, 450, 585.0, 583.5, 405.0, 218.0, (-0.2, 0.06, 5e-4, -3e-4, 0.0))
SECOND_LOOK = Look(exposure=0.75, gamma=1.3, noise_sigma=3.0, blur_sigma_px=0.7)
SURVEY_SPEED_MPS, SECOND_SPEED_MPS = 8.0, 11.0
OTHER_LANE_M = 3.5  # to the left
GNSS_INTERVAL_S = 3.0
FEWEST_INTERVALS = 6  # on a short street fixes come oftener: two or three would not place a map
ONE_DAY_NS = 86_400_000_000_000


def demonstrate(*, seed: int, length_m: float, picture: Path, keep: Path | None = None) -> None:
    """Play the whole chain, print its figures and draw ``picture``; nothing else stays.

    With ``keep``, a folder that is new or empty, recordings, map and trajectories are kept there.

    Raises:
        InputError: the picture cannot have this name, or no such street can be built.
        OutputExistsError: ``keep`` holds something already.
        RunError: a stage failed, or the disk is full or refuses.
    """
    _require_room_for(picture, keep)
    stage = _Stages()
    with interrupted_once(), tempfile.TemporaryDirectory(prefix="fleetmap_demo_") as scratch:
        folder = Path(scratch) / "demo"
        folder.mkdir()
        stage(f"Two vehicles drive {length_m:g} m of a simulated street (seed {seed}), so the truth is known")
        _record_drives(folder, seed, length_m)

        stage("The first drive becomes a map")
        run_verb(["map", "survey.mcap", "--output", "my_map", "--trajectory", "survey.tum"], folder)

        stage("A map server in another process takes the map over Zenoh and lists it over HTTP")
        with running_map_server("store", folder) as server:
            run_verb(["publish", "my_map", "--server", server.zenoh_endpoint], folder)
            _print_catalogue(f"{server.http_url}/collections/maps/items")

            stage("The second vehicle downloads the map and reads its UTM pose from its camera alone")
            second = ["localize", "second.mcap", "--server", server.zenoh_endpoint, "--trajectory", "second.tum"]
            run_verb([*second, "--cache", "cache"], folder)

        stage("The map against the simulated truth; beside it, what its GNSS fixes alone would give")
        survey = ["evaluate", "survey.tum", "survey.reference.tum"]
        run_verb([*survey, "--spline-through", "survey.mcap"], folder)

        stage("The second vehicle, which had no GNSS, against the simulated truth")
        run_verb(["evaluate", "second.tum", "second.reference.tum"], folder)

        stage("The picture")
        draw_demonstration(picture, folder)
        click.echo(f"picture: {picture}")
        if keep is not None:
            _keep(folder, keep)
            click.echo(f"kept:    {keep} (recordings, truth, map and trajectories)")
    stage.finish()


class _Stages:
    """Numbers the stages and says how long each took."""

    def __init__(self) -> None:
        self._began_s: list[float] = []

    def __call__(self, title: str) -> None:
        """Begin a stage; the one before is over."""
        self._began_s.append(time.monotonic())
        gap = "\n" if len(self._began_s) > 1 else ""
        click.echo(click.style(f"{gap}{len(self._began_s)}. {title}", bold=True))

    def finish(self) -> None:
        """Say what took how long."""
        seconds = np.diff([*self._began_s, time.monotonic()])
        shares = ", ".join(f"{number}: {share:.0f}" for number, share in enumerate(seconds, start=1))
        click.echo(f"seconds: {seconds.sum():.0f} (stage {shares})")


def _require_room_for(picture: Path, keep: Path | None) -> None:
    """What would fail at the end fails at once."""
    require_picture_name(picture)
    if picture.is_dir():
        raise InputError(f"cannot draw {picture}: it is a folder; name a file in it")
    _require_writable_parent(picture)
    if keep is not None:
        if keep.is_file() or (keep.is_dir() and any(keep.iterdir())):
            raise OutputExistsError(f"{keep} exists already and is no empty folder; give another name to --keep")
        _require_writable_parent(keep)


def _require_writable_parent(path: Path) -> None:
    if not os.access(path.absolute().parent, os.W_OK):
        raise StorageError(f"cannot write {path}: its folder is not there, or cannot be written")


def _record_drives(folder: Path, seed: int, length_m: float) -> None:
    """``survey.mcap``, and a day later ``second.mcap`` in the other lane; each with its truth beside it."""
    street = build_street(seed, length_m)
    survey = drive_along(street, speed_mps=SURVEY_SPEED_MPS, seed=seed)
    drive_s = float(survey.stamps_ns[-1] - survey.stamps_ns[0]) * 1e-9
    interval_s = min(GNSS_INTERVAL_S, drive_s / FEWEST_INTERVALS)
    click.echo(f"survey.mcap: {_described(SURVEY_CAMERA)}; one RTK fix every {interval_s:.1f} s, 5 cm noise")
    record_drive(
        simulate_drive(street, camera=SURVEY_CAMERA, trajectory=survey, gnss_interval_s=interval_s, seed=seed),
        folder / "survey.mcap",
        progress=True,
    )
    second = drive_along(
        street,
        lane_offset_m=OTHER_LANE_M,
        speed_mps=SECOND_SPEED_MPS,
        seed=seed + 1,
        start_ns=START_NS + ONE_DAY_NS,
    )
    click.echo(
        f"second.mcap: {_described(SECOND_CAMERA)}, another lens, darker and noisier; the other lane, "
        "another day, no GNSS"
    )
    record_drive(
        simulate_drive(street, camera=SECOND_CAMERA, trajectory=second, look=SECOND_LOOK, gnss=None, seed=seed),
        folder / "second.mcap",
        progress=True,
    )


def _described(camera: Camera) -> str:
    return f"{camera.width_px} x {camera.height_px} pixels"


def _print_catalogue(url: str) -> None:
    """Ask the server's HTTP face for its maps, as a browser would.

    Raises:
        ServerError: it gave no catalogue.
    """
    click.echo(f"$ curl {url}")
    direct = urllib.request.build_opener(urllib.request.ProxyHandler({}))  # no proxy knows this machine's ports
    try:
        with direct.open(url, timeout=10.0) as answer:
            features = json.load(answer)["features"]
        for feature in features:
            figures, (west, south, east, north) = feature["properties"], feature["bbox"]
            click.echo(
                f"{feature['id']}: {figures['proj:code']}, {south:.5f} to {north:.5f} N, "
                f"{west:.5f} to {east:.5f} E, {figures['fleetmap:length_m']:.0f} m, "
                f"{figures['fleetmap:landmarks']} landmarks, {figures['fleetmap:size_bytes'] / 1e6:.2f} MB"
            )
    except (OSError, ValueError, KeyError) as error:
        raise ServerError(f"{url} gave no catalogue of maps: {error}") from error


def _keep(folder: Path, target: Path) -> None:
    """Copy all but the server's store and the localizer's cache, each item whole or not at all."""
    for item in sorted(folder.iterdir()):
        if item.name not in ("store", "cache"):
            with atomic_path(target / item.name) as draft:
                copy = shutil.copytree if item.is_dir() else shutil.copyfile
                copy(item, draft)
