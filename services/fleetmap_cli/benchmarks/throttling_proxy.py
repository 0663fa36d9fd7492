"""A slow and unreliable link in front of a server: TCP with a rate, stalls and cut connections."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from types import TracebackType
from typing import Self

_SLICE_S = 0.02  # the link carries about so much at once
_SMALLEST_BYTES, _LARGEST_BYTES = 1024, 64 * 1024
_BUFFER_BYTES = 32 * 1024  # of sockets: a radio link holds little back


@dataclass(frozen=True)
class Fault:
    """What happens to the link once it has carried so many bytes, in both directions together."""

    at_bytes: int
    stall_s: float | None = None  # nothing is carried for so long; None: all connections are cut


class ThrottlingProxy:
    """A link to a server on this machine; close it, or use it in a ``with`` statement.

    All connections share the rate, each direction for itself, as over one radio.

    Args:
        port: of the server.
        bytes_per_s: what the link carries in each direction; None: as much as the machine does.
        faults: stalls and cuts, in the order of their places.
        on_fault: called as soon as one has happened.
    """

    def __init__(
        self,
        port: int,
        bytes_per_s: float | None = None,
        faults: Sequence[Fault] = (),
        on_fault: Callable[[Fault], object] = lambda fault: None,
    ) -> None:
        self._target = ("127.0.0.1", port)
        self._bytes_per_s = bytes_per_s
        self._faults, self._on_fault = list(faults), on_fault
        self._lock = threading.Lock()
        self._closed = threading.Event()
        self._free_s = {False: 0.0, True: 0.0}  # when each direction may carry again; True: from the server
        self._stalled_until_s = 0.0
        self._sockets: list[socket.socket] = []
        self.carried_bytes = 0
        self.stalled_s = 0.0
        self.connections = 0
        self._listening = socket.create_server(("127.0.0.1", 0))
        self.endpoint = f"tcp/127.0.0.1:{self._listening.getsockname()[1]}"
        self._threads = [threading.Thread(target=self._accept, daemon=True)]
        self._threads[0].start()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def faults_left(self) -> int:
        """How many faults are still to come."""
        return len(self._faults)

    def close(self) -> None:
        """Carry nothing more; returns when all threads have ended."""
        self._closed.set()
        _shut(self._listening)
        self.cut()
        for thread in list(self._threads):
            thread.join()

    def cut(self) -> None:
        """End all connections, as a lost network does for those who notice; new ones are welcome."""
        with self._lock:
            ended, self._sockets = self._sockets, []
        for one in ended:
            _shut(one)

    def stall(self, duration_s: float) -> None:
        """Carry nothing for so long, without ending anything."""
        with self._lock:
            self._stalled_until_s = time.monotonic() + duration_s
            self.stalled_s += duration_s

    def _accept(self) -> None:
        while not self._closed.is_set():
            try:
                client, _ = self._listening.accept()
            except OSError:
                return
            self._join(client)

    def _join(self, client: socket.socket) -> None:
        """Connect a client to the server; if there is none the client is turned away."""
        server = socket.socket()
        if self._bytes_per_s is not None:
            for one in (client, server):
                one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)
                one.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER_BYTES)
        try:
            server.connect(self._target)
        except OSError:
            _shut(client, server)
            return
        with self._lock:
            self._sockets += [client, server]
            self.connections += 1
        for source, sink, is_down in ((client, server, False), (server, client, True)):
            self._threads.append(threading.Thread(target=self._carry, args=(source, sink, is_down), daemon=True))
            self._threads[-1].start()

    def _carry(self, source: socket.socket, sink: socket.socket, is_down: bool) -> None:
        rate = self._bytes_per_s
        size = _LARGEST_BYTES if rate is None else int(max(_SMALLEST_BYTES, min(_LARGEST_BYTES, rate * _SLICE_S)))
        with suppress(OSError):
            while data := source.recv(size):
                if not self._wait_for_turn(len(data), is_down):
                    break
                sink.sendall(data)
                self._count(len(data))
        _shut(source, sink)

    def _wait_for_turn(self, size_bytes: int, is_down: bool) -> bool:
        """Wait until the link has carried so many bytes more; False when it is closed."""
        with self._lock:
            duration_s = 0.0 if self._bytes_per_s is None else size_bytes / self._bytes_per_s
            done_s = self._free_s[is_down] = self._free_from_s(is_down) + duration_s
        while (left_s := max(done_s, self._stalled_until_s) - time.monotonic()) > 0.0:
            if self._closed.wait(min(left_s, _SLICE_S)):  # in slices: a stall may begin meanwhile
                return False
        return not self._closed.is_set()

    def _free_from_s(self, is_down: bool) -> float:
        return max(time.monotonic(), self._free_s[is_down], self._stalled_until_s)

    def _count(self, size_bytes: int) -> None:
        with self._lock:
            self.carried_bytes += size_bytes
            is_due = bool(self._faults) and self.carried_bytes >= self._faults[0].at_bytes
            fault = self._faults.pop(0) if is_due else None
        if fault is None:
            return
        if fault.stall_s is None:
            self.cut()
        else:
            self.stall(fault.stall_s)
        self._on_fault(fault)


def _shut(*sockets: socket.socket) -> None:
    for one in sockets:
        with suppress(OSError):
            one.shutdown(socket.SHUT_RDWR)
        one.close()
