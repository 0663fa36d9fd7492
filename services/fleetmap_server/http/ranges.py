"""What part of a content a request asks for: ranges, and conditions on what the client has (RFC 9110)."""

from __future__ import annotations

import re
from dataclasses import dataclass

_ONE_RANGE = re.compile(r"\s*bytes\s*=\s*(\d{0,400})\s*-\s*(\d{0,400})\s*", re.ASCII | re.IGNORECASE)


class UnsatisfiableRangeError(Exception):
    """A range that begins behind the end, or is empty."""


@dataclass(frozen=True)
class ByteRange:
    """Bytes from ``start`` up to, but without, ``end``."""

    start: int
    end: int

    def __len__(self) -> int:
        return self.end - self.start


def requested_range(header: str | None, size_bytes: int) -> ByteRange | None:
    """The one range that is asked for; None for the whole, as also where several are asked for, or in other units.

    Raises:
        UnsatisfiableRangeError: none of its bytes exist.
    """
    found = _ONE_RANGE.fullmatch(header or "")
    if found is None or not (found[1] or found[2]):
        return None
    if not found[1]:
        length = min(int(found[2]), size_bytes)
        wanted = ByteRange(size_bytes - length, size_bytes)
    else:
        start = int(found[1])
        if found[2] and int(found[2]) < start:
            return None  # malformed: to be ignored
        wanted = ByteRange(start, min(int(found[2]) + 1, size_bytes) if found[2] else size_bytes)
    if wanted.start >= wanted.end:
        raise UnsatisfiableRangeError
    return wanted


def has_tag(if_none_match: str | None, tag: str) -> bool:
    """Whether a client already has the content with this entity tag (13.1.2: compared weakly)."""
    if if_none_match is None:
        return False
    tags = [found.strip().removeprefix("W/").strip('"') for found in if_none_match.split(",")]
    return tag in tags or "*" in tags


def range_still_holds(if_range: str | None, tag: str) -> bool:
    """Whether what a client has a part of is still this content (13.1.5: compared strongly; dates never hold)."""
    return if_range is None or if_range.strip() == f'"{tag}"'
