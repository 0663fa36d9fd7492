"""Bad input through the real command line: one clear line, the exit code, and nothing half-written.

What each kind of bad input is refused with, and where else it is tested:

=============================== ========================= ===================================================
bad input                       here                      elsewhere
=============================== ========================= ===================================================
no GNSS                         map                       tests/mapper/test_mapper
no calibration                  map                       tests/cli/test_localize, tests/shared/drives
two cameras and none chosen     map, localize             tests/shared/drives/test_inspection
an empty MCAP, or one cut short map, localize             tests/shared/drives/test_damaged_recordings
images that cannot be decoded   map, localize             tests/shared/drives/test_bad_recordings
all-black images                map                       tests/cli/test_localize, tests/mapper/test_mapper
frames out of order             map, localize             tests/shared/drives/test_bad_recordings
a server that is not there      map --watch: tests/cli    tests/cli/test_publish, test_maps, test_localize
a server killed in an upload    publish                   tests/server/test_interruptions
a server killed in a download   localize                  tests/server/test_interruptions
a tampered map part             localize from a server    tests/cli/test_publish, test_localize, tests/shared
a full disk                     map, localize, convert    tests/server/test_interruptions, tests/shared
=============================== ========================= ===================================================
"""

from __future__ import annotations

import contextlib
import os
import resource
import shutil
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.records import Message
from mcap.writer import Writer

from fleetmap.map_package import open_package

FLEETMAP = [sys.executable, "-c", "from fleetmap_cli.main import main; main()"]
IMAGES = "/camera/image/compressed"


def fleetmap(*arguments: object, file_limit_bytes: int | None = None, **environment: str) -> Any:
    """Runs the command line in a process of its own, on a disk that takes no larger files than the limit."""

    def limit() -> None:
        if file_limit_bytes is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (file_limit_bytes, file_limit_bytes))

    return subprocess.run(
        [*FLEETMAP, *map(str, arguments)],
        preexec_fn=limit,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )


def assert_refused(run: Any, code: int, *words: str) -> None:
    assert (run.returncode, run.stdout) == (code, ""), run.stderr
    assert run.stderr.startswith("error: ")
    assert run.stderr.count("\n") == 1
    for word in words:
        assert word in run.stderr


def assert_ended_in_one_error(run: Any, *words: str) -> None:
    """After warnings of what was tried to go on without."""
    assert (run.returncode, run.stdout) == (1, ""), run.stderr
    *warnings, error = run.stderr.splitlines()
    assert error.startswith("error: ")
    assert all(line.startswith("WARNING: ") for line in warnings)
    assert all(word in run.stderr for word in words)


def inventory(folder: Path) -> dict[str, bytes]:
    """Every file below a folder, hidden ones too, with its content."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


# --- recordings


@pytest.fixture(scope="module")
def drive(survey_frames, write_drive, tmp_path_factory) -> Path:
    """Thirty-two sound images of the survey drive."""
    path: Path = write_drive(tmp_path_factory.mktemp("drive") / "drive.mcap", survey_frames[:32])
    return path


def rewritten(source: Path, target: Path, edit: Callable[[int, str, Message], list[tuple[str, Message]]]) -> Path:
    """A recording message by message: ``edit`` gets the number within the topic and says what is written."""
    with source.open("rb") as old, target.open("wb") as new:
        writer = Writer(new)
        writer.start("ros2")
        channels: dict[str, int] = {}
        counts: dict[str, int] = {}
        for schema, channel, message in make_reader(old).iter_messages():
            assert schema is not None
            number = counts.get(channel.topic, 0)
            counts[channel.topic] = number + 1
            for topic, edited in edit(number, channel.topic, message):
                if topic not in channels:
                    schema_id = writer.register_schema(schema.name, schema.encoding, schema.data)
                    channels[topic] = writer.register_channel(topic, channel.message_encoding, schema_id)
                writer.add_message(channels[topic], edited.log_time, edited.data, edited.publish_time)
        writer.finish()
    return target


def second_camera(number: int, topic: str, message: Message) -> list[tuple[str, Message]]:
    return (
        [(topic, message), (topic.replace("/camera/", "/rear/"), message)]
        if "/camera/" in topic
        else [(topic, message)]
    )


def cut_image_9(number: int, topic: str, message: Message) -> list[tuple[str, Message]]:
    if topic == IMAGES and number == 9:
        half = len(message.data) // 2
        message = replace(message, data=message.data[:half] + bytes(len(message.data) - half))
    return [(topic, message)]


def image_9_late(number: int, topic: str, message: Message) -> list[tuple[str, Message]]:
    late_ns = 250_000_000 if topic == IMAGES and number == 9 else 0
    return [(topic, replace(message, log_time=message.log_time + late_ns))]


BAD_RECORDINGS: dict[str, tuple[Callable[[Path, Path], object], tuple[str, ...]]] = {
    "empty": (lambda good, bad: bad.touch(), ("is empty", "record or convert it again")),
    "truncated": (
        lambda good, bad: bad.write_bytes(good.read_bytes()[:100]),
        ("is truncated", "no message in it can be read", "copy it again"),
    ),
    "without_whole_images": (
        lambda good, bad: bad.write_bytes(good.read_bytes()[:6000]),
        ("holds no ROS 2 images",),
    ),
    "two_cameras": (
        lambda good, bad: rewritten(good, bad, second_camera),
        (f"2 image topics: {IMAGES}, /rear/image/compressed", "choose one with --image-topic"),
    ),
    "undecodable": (
        lambda good, bad: rewritten(good, bad, cut_image_9),
        (f"image 9 of {IMAGES}", "cannot be decoded"),
    ),
    "out_of_order": (
        lambda good, bad: rewritten(good, bad, image_9_late),
        (f"frames out of order: image 11 of {IMAGES}", "sort the recording by header stamp"),
    ),
}


@pytest.mark.parametrize("name", BAD_RECORDINGS)
@pytest.mark.parametrize("verb", ["map", "localize"])
def test_a_bad_recording_is_refused_with_one_line_and_writes_nothing(drive, mapped_survey, tmp_path, verb, name):
    spoil, words = BAD_RECORDINGS[name]
    bad = tmp_path / f"{name}.mcap"
    spoil(drive, bad)
    before = inventory(tmp_path)
    options = ["--output", tmp_path / "m"] if verb == "map" else ["--map", mapped_survey.package]
    run = fleetmap(verb, bad, *options, "--trajectory", tmp_path / "out.tum")
    assert_refused(run, 2, str(bad), *words)
    assert inventory(tmp_path) == before
    assert not (tmp_path / "m").exists()


@pytest.mark.parametrize(
    ("options", "images", "words"),
    [
        ({"fixes": ()}, "as they are", ("no usable GNSS fix", "a map needs them for place and scale")),
        (
            {"calibrated": False},
            "as they are",
            ("no calibration: no CameraInfo", "record its camera_info topic too"),
        ),
        ({}, "black", ("no map could be started", "too little texture", "look at them")),
    ],
    ids=["no GNSS", "no calibration", "all-black images"],
)
def test_a_drive_that_cannot_be_mapped_is_refused_with_one_line_and_writes_nothing(
    survey_frames, write_drive, tmp_path, options, images, words
):
    frames = survey_frames[20:30]
    if images == "black":
        frames = [replace(frame, image=np.zeros_like(frame.image)) for frame in frames]
    path = write_drive(tmp_path / "drive.mcap", frames, **options)
    before = inventory(tmp_path)
    run = fleetmap("map", path, "--output", tmp_path / "m", "--trajectory", tmp_path / "out.tum")
    assert_refused(run, 2, *words)
    assert inventory(tmp_path) == before
    assert not (tmp_path / "m").exists()


# --- full disks


def test_a_full_disk_while_mapping_leaves_the_old_map_and_nothing_half_written(mapped_survey, drive, tmp_path):
    output, trajectory = tmp_path / "my_map", tmp_path / "survey.tum"
    shutil.copytree(mapped_survey.package, output)
    shutil.copy(mapped_survey.trajectory, trajectory)
    before = inventory(tmp_path)
    arguments = ["map", drive, "--output", output, "--trajectory", trajectory, "--force"]
    run = fleetmap(*arguments, file_limit_bytes=20_000)
    assert_refused(run, 1, f"cannot write {output}", "File too large")
    assert inventory(tmp_path) == before


def test_a_full_disk_while_localizing_leaves_no_trajectory(mapped_survey, drive, tmp_path):
    arguments = ["localize", drive, "--map", mapped_survey.package, "--trajectory", tmp_path / "out.tum"]
    sound = fleetmap(*arguments)
    assert (sound.returncode, sound.stderr) == (0, "")
    before = inventory(tmp_path)
    run = fleetmap(*arguments, file_limit_bytes=500)
    assert_refused(run, 1, f"cannot write {tmp_path / 'out.tum'}", "File too large")
    assert inventory(tmp_path) == before


def test_a_full_disk_while_converting_leaves_no_recording(tmp_path):
    folder = tmp_path / "sequence"
    (folder / "cam0").mkdir(parents=True)
    noise = np.random.default_rng(0).integers(0, 256, (5, 200, 320), dtype=np.uint8)
    for i, image in enumerate(noise):
        cv2.imwrite(str(folder / "cam0" / f"{i:06d}.png"), image)
    (folder / "times.txt").write_text("".join(f"{0.1 * i:.6f}\n" for i in range(5)))
    (folder / "K.txt").write_text("250 0 159.5\n0 250 99.5\n0 0 1\n")
    out = tmp_path / "out"
    out.mkdir()
    arguments = ["convert", "kitti-odometry", folder, out / "drive.mcap"]
    run = fleetmap(*arguments, file_limit_bytes=100_000)
    assert_refused(run, 1, f"cannot write {out / 'drive.mcap'}", "File too large")
    assert list(out.iterdir()) == []
    assert fleetmap(*arguments).returncode == 0


def test_a_disk_too_full_for_compiled_code_is_told_in_one_line_too(drive, tmp_path):
    run = fleetmap(
        "map", drive, "--output", tmp_path / "m", file_limit_bytes=1000, NUMBA_CACHE_DIR=str(tmp_path / "cache")
    )
    assert_refused(run, 1, "File too large", "is there room on the disk")
    assert not (tmp_path / "m").exists()


# --- servers that die, and maps that rot


class Server:
    """``fleetmap serve`` in a process of its own."""

    def __init__(self, store: Path) -> None:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port = int(probe.getsockname()[1])
        self.endpoint = f"tcp/127.0.0.1:{self.port}"
        arguments = ["serve", "--store", str(store), "--zenoh", self.endpoint, "--http", "127.0.0.1:0"]
        self.process = subprocess.Popen(
            [*FLEETMAP, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        assert self.process.stdout is not None
        self.announcement = self.process.stdout.readline()

    def kill(self) -> None:
        """Death without any last words."""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGKILL)
        self.process.communicate(timeout=20)


@pytest.fixture
def serve() -> Iterator[Callable[[Path], Server]]:
    servers: list[Server] = []

    def start(store: Path) -> Server:
        servers.append(Server(store))
        assert servers[-1].announcement.startswith("serving ")
        return servers[-1]

    yield start
    for server in servers:
        server.kill()


class DeadlyProxy:
    """Carries connections to a server, and kills it once so many bytes have gone one way."""

    def __init__(self, server: Server, limit_bytes: int, counts: str) -> None:
        self._server, self._left_bytes, self._counts = server, limit_bytes, counts
        self._listening = socket.create_server(("127.0.0.1", 0))
        self.endpoint = f"tcp/127.0.0.1:{self._listening.getsockname()[1]}"
        self._connections: list[socket.socket] = []
        threading.Thread(target=self._accept, daemon=True).start()

    @property
    def has_killed(self) -> bool:
        return self._left_bytes <= 0

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                client, _ = self._listening.accept()
                try:
                    server = socket.create_connection(("127.0.0.1", self._server.port))
                except OSError:
                    client.close()
                    continue
                self._connections += [client, server]
                for source, sink, way in ((client, server, "up"), (server, client, "down")):
                    threading.Thread(target=self._carry, args=(source, sink, way), daemon=True).start()

    def _carry(self, source: socket.socket, sink: socket.socket, way: str) -> None:
        with contextlib.suppress(OSError):
            while data := source.recv(16_384):
                if way == self._counts:
                    self._left_bytes -= len(data)
                    if self.has_killed:
                        self._server.kill()
                        break
                sink.sendall(data)
        for connection in (source, sink):
            with contextlib.suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        self._listening.close()
        for connection in self._connections:
            connection.close()


def test_a_server_killed_during_an_upload_is_one_line_and_the_map_is_not_in_the_catalogue(
    mapped_survey, serve, tmp_path
):
    server = serve(tmp_path / "store")
    proxy = DeadlyProxy(server, 200_000, "up")
    run = fleetmap("publish", mapped_survey.package, "--server", proxy.endpoint, "--patience-s", 2)
    assert proxy.has_killed
    proxy.close()
    assert_refused(run, 1, "upload of map 'my_map' ended at ", proxy.endpoint, " again")

    server = serve(tmp_path / "store")
    assert server.announcement.startswith("serving 0 maps")
    assert fleetmap("maps", "list", "--server", server.endpoint).stdout == "no maps\n"
    assert fleetmap("publish", mapped_survey.package, "--server", server.endpoint).returncode == 0
    assert "my_map" in fleetmap("maps", "list", "--server", server.endpoint).stdout


def test_a_server_killed_during_a_download_is_one_line_and_leaves_nothing(mapped_survey, drive, serve, tmp_path):
    server = serve(tmp_path / "store")
    assert fleetmap("publish", mapped_survey.package, "--server", server.endpoint).returncode == 0
    proxy = DeadlyProxy(server, 60_000, "down")
    out, cache = tmp_path / "out", tmp_path / "cache"
    out.mkdir()
    run = fleetmap(
        "localize",
        drive,
        "--server",
        proxy.endpoint,
        "--cache",
        cache,
        "--trajectory",
        out / "second.tum",
        FLEETMAP_PATIENCE_S="2",
    )
    assert proxy.has_killed
    proxy.close()
    assert_ended_in_one_error(run, proxy.endpoint)
    assert list(out.iterdir()) == []
    assert not list(tmp_path.rglob("*.part"))


def test_a_part_tampered_with_in_the_store_is_one_line_and_gives_no_poses(mapped_survey, drive, serve, tmp_path):
    server = serve(tmp_path / "store")
    assert fleetmap("publish", mapped_survey.package, "--server", server.endpoint).returncode == 0
    records = open_package(mapped_survey.package).manifest.parts
    cells = [record.sha256 for record in records if record.kind == "cell"]
    blobs = [path for path in (tmp_path / "store").rglob("*") if any(sha256 in path.name for sha256 in cells)]
    assert len(blobs) == len(cells)
    for blob in blobs:
        data = bytearray(blob.read_bytes())
        data[len(data) // 2] ^= 1
        blob.chmod(0o644)
        blob.write_bytes(data)
    out, cache = tmp_path / "out", tmp_path / "cache"
    out.mkdir()
    run = fleetmap(
        "localize", drive, "--server", server.endpoint, "--cache", cache, "--trajectory", out / "second.tum"
    )
    assert_ended_in_one_error(run, server.endpoint, "damaged")
    assert list(out.iterdir()) == []
    assert not any(path.stem in cells for path in cache.rglob("*"))
