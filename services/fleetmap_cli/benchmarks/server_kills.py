"""``fleetmap benchmark server --kills N``: SIGKILL a map server at any instant of what changes its store.

Each round takes one of the operations, kills the server (for a collection the collecting process) at a random
instant of it, and starts a new server on the same store. Then everything listed is fetched and hashed, what was
acknowledged before must be there, and the same operation must go on and come to its end.
"""

from __future__ import annotations

import contextlib
import hashlib
import multiprocessing
import random
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerProcess
from pathlib import Path

from fleetmap.catalogue import MapEntry
from fleetmap.errors import FleetmapError, RunError
from fleetmap.manifest import parse_manifest
from fleetmap.transport import MapClient
from fleetmap_cli.benchmarks.made_map import MadeMap, made_map
from fleetmap_cli.demo_processes import free_port
from fleetmap_server.collection import collect
from fleetmap_server.server import run_server
from fleetmap_server.settings import ServerSettings
from fleetmap_server.storage import open_storage
from fleetmap_server.verification import verify

_MAP_IDS = ("north", "south")
_PART_SIZES = (700_000, 900_000, 30_000, 2_000, 1)
_START_S, _PATIENCE_S = 60.0, 0.2
_VERIFY_EVERY = 25  # kills, besides at the end
_FIRST_GUESS_S = 0.3  # how long an operation takes, until one has been seen
_KEPT_VERSIONS = 4

Tell = Callable[[str], None]


@dataclass
class KillReport:
    """What the kills did."""

    kills: int = 0
    lost: int = 0  # acknowledged maps, versions or bytes that were not there any more
    half_visible: int = 0  # listed versions that could not be fetched whole
    by_operation: dict[str, int] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        return f"{self.kills} kills: {self.lost} lost, {self.half_visible} half-visible maps"


def kill_servers(kills: int, folder: Path, tell: Tell, seed: int = 0) -> KillReport:
    """Kill a server so often, in a store made in ``folder``; the same seed draws the same operations and instants.

    Raises:
        RunError: a server does not start on the store any more.
    """
    report = KillReport()
    with _Site(folder / "store", random.Random(seed), report) as site:
        while report.kills < kills:
            site.round()
            if report.kills % _VERIFY_EVERY == 0:
                site.verify()
                tell(str(report))
        site.verify()
    return report


class _Site:
    """A store, the server on it, and what it has acknowledged."""

    def __init__(self, store: Path, chance: random.Random, report: KillReport) -> None:
        store.mkdir(parents=True)
        self._settings = ServerSettings(store, f"tcp/127.0.0.1:{free_port()}", http_port=0)
        self._chance, self._report = chance, report
        self._processes = multiprocessing.get_context("forkserver")
        self._processes.set_forkserver_preload([__name__])
        self._server: ForkServerProcess | None = None
        self._history: dict[str, dict[int, str]] = {map_id: {} for map_id in _MAP_IDS}  # number -> version
        self._durations_s: dict[str, float] = {}
        self._seed = 0

    def __enter__(self) -> _Site:
        self._start()
        for map_id in _MAP_IDS:
            self._publish(self._next_map(map_id))
        return self

    def __exit__(self, *error: object) -> None:
        self._kill()

    def round(self) -> None:
        """One operation, one kill in it, and all that must hold afterwards."""
        operations = (self._upload, self._upload, self._commit, self._roll_back, self._retire, self._collect)
        operation = self._chance.choice(operations)
        name = operation.__name__.strip("_").replace("_", " ")
        operation()
        self._report.by_operation[name] = self._report.by_operation.get(name, 0) + 1

    def verify(self) -> None:
        """Every blob and manifest anew, as ``fleetmap store verify`` does it."""
        with open_storage(self._settings) as storage:
            for problem in verify(storage).problems:
                self._half_visible(problem)

    # The operations. Each is killed at a random instant and then done to its end.

    def _upload(self) -> None:
        new = self._next_map(self._chance.choice(_MAP_IDS))
        acknowledged = _Progress()
        self._killed_in("upload", lambda client: client.publish(new.manifest_bytes, new.part, acknowledged.note))
        self._go_on(new, acknowledged.done_bytes)

    def _commit(self) -> None:
        """As an upload, killed about the moment when everything has been sent."""
        new = self._next_map(self._chance.choice(_MAP_IDS))
        acknowledged = _Progress(self._chance.choice(range(new.size_bytes - 2_000, new.size_bytes + 1)))
        with self._client() as client, contextlib.suppress(FleetmapError):
            killer = threading.Thread(
                target=self._kill_after, args=(acknowledged.reached, self._instant("commit"))
            )
            killer.start()
            client.publish(new.manifest_bytes, new.part, acknowledged.note)
        acknowledged.reached.set()
        killer.join()
        self._start_anew()
        self._go_on(new, acknowledged.done_bytes)

    def _roll_back(self) -> None:
        map_id = self._chance.choice(_MAP_IDS)
        number, version = self._chance.choice(list(self._history[map_id].items()))
        self._killed_in("roll_back", lambda client: client.rollback(map_id, str(number)))
        with self._client() as client:
            entry = client.rollback(map_id, str(number))
        if entry.version != version:
            self._lose(f"'{map_id}' cannot go back to version {number}")
        self._history[map_id][entry.number] = entry.version

    def _retire(self) -> None:
        map_id = self._chance.choice(_MAP_IDS)
        *older, _ = sorted(self._history[map_id])
        if not older:
            return self._upload()
        number = self._chance.choice(older)
        del self._history[map_id][number]  # from here on it may be there or not
        self._killed_in("retire", lambda client: client.retire(map_id, str(number)))
        with self._client() as client:
            client.retire(map_id, str(number))
        return None

    def _collect(self) -> None:
        """Collect while a map is being uploaded, and kill the collector."""
        new = self._next_map(self._chance.choice(_MAP_IDS))
        self._tidy()
        collector = self._processes.Process(target=_collect_forever, args=(self._settings,), daemon=True)
        collector.start()
        begun_s = time.monotonic()
        killer = threading.Timer(self._instant("collect"), collector.kill)
        killer.start()
        self._publish(new)
        self._durations_s["collect"] = time.monotonic() - begun_s
        killer.cancel()
        collector.kill()
        collector.join()
        self._report.kills += 1
        self._check()

    # What they are made of.

    def _killed_in(self, name: str, operation: Callable[[MapClient], object]) -> None:
        """Begin an operation, kill the server at some instant of it, start another and look at everything."""
        killer = threading.Timer(self._instant(name), self._kill)
        with self._client() as client, contextlib.suppress(FleetmapError):
            begun_s = time.monotonic()
            killer.start()
            operation(client)
            self._durations_s[name] = time.monotonic() - begun_s  # it was done before the kill
        killer.join()
        self._start_anew()

    def _instant(self, name: str) -> float:
        """Seconds from an operation's beginning, anywhere until a little behind its end."""
        return self._chance.uniform(0.0, 1.1 * self._durations_s.get(name, _FIRST_GUESS_S))

    def _kill_after(self, reached: threading.Event, delay_s: float) -> None:
        reached.wait(_START_S)
        threading.Event().wait(min(delay_s, 0.02))
        self._kill()

    def _start_anew(self) -> None:
        self._report.kills += 1
        self._start()
        self._check()

    def _go_on(self, new: MadeMap, acknowledged_bytes: int) -> None:
        """The same upload comes to its end, and sends no acknowledged byte again."""
        again = _Progress()
        self._publish(new, again)
        if (again.first_bytes or 0) < acknowledged_bytes:
            self._lose(
                f"upload of '{new.map_id}' had {acknowledged_bytes} bytes and goes on at {again.first_bytes}"
            )

    def _publish(self, new: MadeMap, progress: _Progress | None = None) -> None:
        with self._client(patience_s=_START_S) as client:
            entry = client.publish(new.manifest_bytes, new.part, progress.note if progress else None)
        self._history[new.map_id][entry.number] = entry.version

    def _tidy(self) -> None:
        """Retire what lies far behind, so that there is something to collect and the store stays small."""
        with self._client() as client:
            for map_id, history in self._history.items():
                for number in sorted(history)[:-_KEPT_VERSIONS]:
                    client.retire(map_id, str(number))
                    del history[number]

    def _check(self) -> None:
        """What is listed is whole, and what was acknowledged is listed."""
        with self._client() as client:
            for map_id, history in self._history.items():
                versions = {entry.number: entry for entry in client.versions(map_id)}
                for entry in {entry.version: entry for entry in versions.values()}.values():
                    self._fetch(client, entry)
                for number, version in history.items():
                    if number not in versions or versions[number].version != version:
                        self._lose(f"version {number} of '{map_id}' is not there any more")
                history.update({n: entry.version for n, entry in versions.items() if n > max(history)})

    def _fetch(self, client: MapClient, entry: MapEntry) -> None:
        try:
            manifest = parse_manifest(client.manifest(entry.map_id, entry.version), entry.map_id)
            for part in manifest.parts:
                data = client.part(entry.map_id, entry.version, part.sha256, part.size_bytes)
                if hashlib.sha256(data).hexdigest() != part.sha256:
                    raise RunError(f"part {part.sha256[:12]} has other bytes")
        except FleetmapError as error:
            self._half_visible(f"version {entry.number} of '{entry.map_id}': {error}")

    def _next_map(self, map_id: str) -> MadeMap:
        self._seed += 1
        return made_map(map_id, _PART_SIZES, self._seed)

    def _lose(self, note: str) -> None:
        self._report.lost += 1
        self._report.notes.append(note)

    def _half_visible(self, note: str) -> None:
        self._report.half_visible += 1
        self._report.notes.append(note)

    @contextmanager
    def _client(self, patience_s: float = _PATIENCE_S) -> Iterator[MapClient]:
        with MapClient(self._settings.zenoh_endpoint, patience_s=patience_s) as client:
            yield client

    def _start(self) -> None:
        here, there = self._processes.Pipe(duplex=False)
        self._server = self._processes.Process(target=_serve, args=(self._settings, there), daemon=True)
        self._server.start()
        there.close()
        if not here.poll(_START_S) or not here.recv().startswith("serving"):
            raise RunError(f"no server starts on {self._settings.store} any more, after {self._report}")

    def _kill(self) -> None:
        if self._server is not None:
            self._server.kill()
            self._server.join()


class _Progress:
    """How many bytes of an upload were acknowledged, at first and at last."""

    def __init__(self, mark_bytes: int | None = None) -> None:
        self.first_bytes: int | None = None
        self.done_bytes = 0
        self.reached = threading.Event()
        self._mark_bytes = mark_bytes

    def note(self, done_bytes: int, total_bytes: int) -> None:
        if self.first_bytes is None:
            self.first_bytes = done_bytes
        self.done_bytes = done_bytes
        if self._mark_bytes is not None and done_bytes >= self._mark_bytes:
            self.reached.set()


def _serve(settings: ServerSettings, ready: Connection) -> None:
    """A server's process; what it says first tells that it is ready."""
    with contextlib.suppress(EOFError, OSError):
        run_server(settings, announce=ready.send)


def _collect_forever(settings: ServerSettings) -> None:
    with open_storage(settings) as storage:
        while True:
            collect(storage.database, storage.objects)
