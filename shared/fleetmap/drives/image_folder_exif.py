"""When a photo was taken, as its camera wrote it into the JPEG.

Source: CIPA DC-008 / JEITA CP-3451 "Exif", sections 4.5 and 4.6: an APP1 segment ``Exif`` holds a TIFF structure;
its first directory points to the Exif directory with DateTimeOriginal, SubSecTimeOriginal and OffsetTimeOriginal.
"""

from __future__ import annotations

import re
import struct

from fleetmap.drives.image_folder_times import time_ns

_EXIF_DIRECTORY, _TAKEN, _TAKEN_OFFSET, _TAKEN_FRACTION = 0x8769, 0x9003, 0x9011, 0x9291
_ASCII, _LONG = 2, 4  # types of entries
_DATE_AND_TIME = re.compile(r"\d{4}:\d\d:\d\d \d\d:\d\d:\d\d")
_APP1, _START_OF_SCAN = 0xE1, 0xDA


def time_taken_ns(jpeg: bytes) -> int | None:
    """DateTimeOriginal in ns since 1970 (UTC where the camera wrote no offset); None without or if damaged."""
    tiff = _exif(jpeg)
    if tiff is None or tiff[:4] not in (b"II*\x00", b"MM\x00*"):
        return None
    order = "<" if tiff[:2] == b"II" else ">"
    try:
        first = _entries(tiff, order, struct.unpack_from(order + "I", tiff, 4)[0])
        taken = _entries(tiff, order, int(first[_EXIF_DIRECTORY]))
        fraction, offset = str(taken.get(_TAKEN_FRACTION, "")), str(taken.get(_TAKEN_OFFSET, ""))
        if _DATE_AND_TIME.fullmatch(str(taken[_TAKEN])) is None:
            return None
        return time_ns(str(taken[_TAKEN]) + (f".{fraction}" if fraction else "") + offset)
    except (KeyError, ValueError, struct.error):
        return None


def _exif(jpeg: bytes) -> bytes | None:
    """The TIFF structure among the segments before the image."""
    at = 2
    while at + 4 <= len(jpeg) and jpeg[at] == 0xFF and jpeg[at + 1] != _START_OF_SCAN:
        (length,) = struct.unpack_from(">H", jpeg, at + 2)
        if jpeg[at + 1] == _APP1 and jpeg[at + 4 : at + 10] == b"Exif\x00\x00":
            return jpeg[at + 10 : at + 2 + length]
        at += 2 + length
    return None


def _entries(tiff: bytes, order: str, at: int) -> dict[int, int | str]:
    """A directory's entries that are texts or offsets."""
    (count,) = struct.unpack_from(order + "H", tiff, at)
    entries: dict[int, int | str] = {}
    for index in range(count):
        tag, kind, size, value = struct.unpack_from(order + "HHII", tiff, at + 2 + 12 * index)
        if kind == _LONG:
            entries[tag] = value
        elif kind == _ASCII:
            start = value if size > 4 else at + 2 + 12 * index + 8
            (text,) = struct.unpack_from(f"{size}s", tiff, start)
            entries[tag] = text.split(b"\x00")[0].decode("ascii").strip()
    return entries
