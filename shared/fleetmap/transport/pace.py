"""How much to ask for or to send at once: what a link carries in a moment, and no more than fits a transmit queue.

A server's transmit queue holds 1 MiB for a client. What is asked for at once fits into it, so that a client that
falls silent never makes the server wait. Only on a link that has just carried 150 MB/s three chunks of 1 MiB are
under way: there the socket's own buffer has grown to what the queue lacks, and more and smaller requests would
cost a third of the rate.
"""

from __future__ import annotations

from fleetmap.transport.protocol import CHUNK_BYTES, MAX_CHUNK_BYTES, UPLOAD_CHUNK_BYTES, WINDOW_CHUNKS

_CHUNK_S = 0.5  # what a chunk may occupy the link for: small requests wait behind it, and a cut loses it
_MIN_CHUNK_BYTES, _FIRST_CHUNK_BYTES = 16 * 1024, 64 * 1024
_FAST_BYTES_PER_S = 150e6
_FAST_WINDOW_CHUNKS = 3
_NEWEST_SHARE = 0.5  # of the newest chunk in the mean


class Pace:
    """The rate at which a link has lately carried chunks in one direction."""

    def __init__(self) -> None:
        self._s_per_byte = _SLOW_START_S_PER_BYTE
        self._last_answer_s = 0.0

    def note_answer(self, size_bytes: int, asked_s: float, answered_s: float) -> None:
        """A chunk has come, asked for and answered at these times of one clock."""
        begun_s = max(asked_s, self._last_answer_s)  # before, the link carried the chunk before
        self._last_answer_s = answered_s
        newest_s_per_byte = max(answered_s - begun_s, 0.0) / max(size_bytes, 1)
        self._s_per_byte += _NEWEST_SHARE * (newest_s_per_byte - self._s_per_byte)

    def note_loss(self) -> None:
        """A chunk has not come: the link is a new one now, or slower than was thought."""
        self._s_per_byte = max(2.0 * self._s_per_byte, _SLOW_START_S_PER_BYTE)

    @property
    def download_chunk_bytes(self) -> int:
        """How much to ask for next."""
        return MAX_CHUNK_BYTES if self._is_fast else self._bytes_within(_CHUNK_S, CHUNK_BYTES)

    @property
    def download_window_chunks(self) -> int:
        """How many answers may be waited for at once."""
        return _FAST_WINDOW_CHUNKS if self._is_fast else WINDOW_CHUNKS

    @property
    def upload_chunk_bytes(self) -> int:
        """How much to send next."""
        return self._bytes_within(_CHUNK_S, UPLOAD_CHUNK_BYTES)

    @property
    def _is_fast(self) -> bool:
        return self._s_per_byte * _FAST_BYTES_PER_S <= 1.0

    def _bytes_within(self, duration_s: float, limit_bytes: int) -> int:
        if self._s_per_byte * limit_bytes <= duration_s:
            return limit_bytes
        return max(_MIN_CHUNK_BYTES, int(duration_s / self._s_per_byte))


_SLOW_START_S_PER_BYTE = _CHUNK_S / _FIRST_CHUNK_BYTES
