"""What plain TCP between two processes of this machine carries: the yardstick for everything that uses it.

Run as a module it is the sending process: it prints its port, and sends a file from memory to all who connect.
"""

from __future__ import annotations

import hashlib
import os
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from fleetmap.errors import RunError
from fleetmap.files import flush_folder

_PIECE_BYTES = 1 << 20


@contextmanager
def tcp_sender(file: Path) -> Iterator[int]:
    """A process that sends the bytes of ``file`` over every connection; gives its port."""
    command = [sys.executable, "-P", "-m", "fleetmap_cli.benchmarks.tcp_yardstick", str(file)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    try:
        yield int(process.stdout.readline())
    finally:
        process.kill()
        process.communicate()


def receive(port: int, size_bytes: int) -> None:
    """Take everything, and keep nothing."""
    received, buffer = 0, bytearray(_PIECE_BYTES)
    with socket.create_connection(("127.0.0.1", port)) as connection:
        while count := connection.recv_into(buffer):
            received += count
    if received != size_bytes:
        raise RunError(f"{received} of {size_bytes} bytes arrived over TCP")


def receive_and_store(port: int, sizes_bytes: Mapping[str, int], folder: Path) -> None:
    """Take parts, named by their SHA-256, one behind the other; hash, write, flush to the disk and rename each."""
    with socket.create_connection(("127.0.0.1", port)) as connection:
        for sha256, size_bytes in sizes_bytes.items():
            draft = folder / f".{sha256}"
            with draft.open("wb") as file:
                digest = _copy(connection, size_bytes, file.write)
                file.flush()
                os.fsync(file.fileno())
            if digest != sha256:
                raise RunError("a part arrived damaged over TCP")
            draft.replace(folder / sha256)
            flush_folder(folder)


def _copy(connection: socket.socket, size_bytes: int, write: Callable[[memoryview], object]) -> str:
    digest, buffer = hashlib.sha256(), memoryview(bytearray(_PIECE_BYTES))
    while size_bytes > 0 and (count := connection.recv_into(buffer[: min(size_bytes, _PIECE_BYTES)])):
        digest.update(buffer[:count])
        write(buffer[:count])
        size_bytes -= count
    return digest.hexdigest()


def _send_forever(data: bytes) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        print(listening.getsockname()[1], flush=True)
        while True:
            connection, _ = listening.accept()
            with connection:
                connection.sendall(data)


if __name__ == "__main__":
    _send_forever(Path(sys.argv[1]).read_bytes())
