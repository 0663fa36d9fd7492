"""A survey drive goes in by ``fleetmap upload``, and its map comes out, though one worker after the other fails.

Server, uploader and workers are processes of their own. One worker is asked to stop, one freezes, one is killed.
The next one publishes, though the server is killed meanwhile; the frozen one, when it wakes up, publishes nothing.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from fleetmap.transport import MapClient

FLEETMAP = [sys.executable, "-c", "from fleetmap_cli.main import main; main()"]
LEASE_S = 3.0


def fleetmap(*arguments: object) -> str:
    """What a verb prints that ends well."""
    run = subprocess.run(
        [*FLEETMAP, *map(str, arguments)], capture_output=True, text=True, timeout=120, check=False
    )
    assert (run.returncode, run.stderr) == (0, "")
    return run.stdout


@pytest.fixture
def start() -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Starts verbs that run on; what still runs in the end is killed."""
    started: list[subprocess.Popen[str]] = []

    def run(*arguments: object) -> subprocess.Popen[str]:
        command = [*FLEETMAP, *map(str, arguments)]
        process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, process_group=0
        )
        started.append(process)
        return process

    yield run
    for process in started:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate(timeout=10)


@pytest.fixture
def start_server(start, tmp_path: Path) -> Callable[[str], subprocess.Popen[str]]:
    def run(endpoint: str) -> subprocess.Popen[str]:
        store = ["--store", tmp_path / "store", "--lease-s", LEASE_S]
        process: subprocess.Popen[str] = start("serve", *store, "--zenoh", endpoint, "--http", "127.0.0.1:0")
        assert process.stdout is not None
        assert process.stdout.readline().startswith("serving 0 maps ")
        return process

    return run


def wait_for(is_so: Callable[[dict[str, Any]], bool], server: str) -> dict[str, Any]:
    """The only job, once something is true of it."""
    end_s = time.monotonic() + 120.0
    with MapClient(server) as client:
        while True:
            (job,) = client.jobs()
            if is_so(job.model_dump()):
                return job.model_dump()
            assert time.monotonic() < end_s, f"it stays so: {job}"
            time.sleep(0.05)


def is_under_way(attempt: int, stage: str | None = None) -> Callable[[dict[str, Any]], bool]:
    """Whether this attempt is at some stage."""
    return lambda job: job["attempts"] == attempt and (job["stage"] == stage if stage else job["stage"] != "")


def test_a_drive_becomes_one_map_though_one_worker_after_the_other_fails(survey, start, start_server, tmp_path):
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        server = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    serving = start_server(server)

    def start_worker(name: str, *arguments: str) -> subprocess.Popen[str]:
        return start("worker", "--server", server, "--folder", tmp_path / name, *arguments)

    waiting = start("upload", survey.recording, "--map-id", "karlsruhe", "--wait", "--server", server)
    drive, job = waiting.stdout.readline().split(), waiting.stdout.readline().split()
    assert (drive[0], job[0], job[2:]) == ("drive", "job", ["map", "karlsruhe,", "queued"])

    polite = start_worker("polite")
    wait_for(is_under_way(1), server)
    polite.send_signal(signal.SIGTERM)
    assert polite.wait(20) == 0
    assert wait_for(lambda job: True, server)["attempts"] == 0  # given back, at once

    frozen = start_worker("frozen", "--once")
    wait_for(is_under_way(1), server)
    os.killpg(frozen.pid, signal.SIGSTOP)
    killed = start_worker("killed")
    wait_for(is_under_way(2, "tracking"), server)
    killed.kill()
    last = start_worker("last")
    wait_for(is_under_way(3, "tracking"), server)
    serving.kill()
    serving.wait(10)
    start_server(server)
    ended = wait_for(lambda job: job["state"] in ("done", "failed"), server)
    last.send_signal(signal.SIGTERM)
    assert last.wait(20) == 0
    os.killpg(frozen.pid, signal.SIGCONT)
    assert frozen.wait(60) == 0
    assert frozen.stderr.read().splitlines()[-1].endswith("lost: another worker has it, or it is over")

    out, err = waiting.communicate(timeout=30)
    assert waiting.returncode == 0, err
    assert err == "" or err.endswith("the map server answers again\n")
    (entry,) = json.loads(fleetmap("maps", "list", "--all-versions", "--json", "--server", server))
    assert out == f"map   karlsruhe  version {entry['version'][:12]}\n"
    assert (entry["number"], entry["drive"], entry["drive_sha256"]) == (1, "survey.mcap", drive[1])
    assert (ended["job_id"], ended["attempts"], ended["version"]) == (job[1], 3, entry["version"])
    assert not [path for path in tmp_path.glob("*/drives/*") if path.parts[-3] in ("last", "frozen")]
