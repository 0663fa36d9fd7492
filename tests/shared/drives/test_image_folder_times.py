"""Times in cells, in names of files and in EXIF."""

from __future__ import annotations

import struct

import pytest

from fleetmap.drive import START_NS
from fleetmap.drives.image_folder_exif import time_taken_ns
from fleetmap.drives.image_folder_times import clock_text, time_in_name_ns, time_ns

NOON_NS = 1_714_564_800_000_000_000  # 2024-05-01T12:00:00Z


@pytest.mark.parametrize(
    ("text", "unit", "since_noon_ns"),
    [
        ("2024-05-01T12:00:00Z", None, 0),
        ("2024-05-01T12:00:00.25", None, 250_000_000),
        ("2024-05-01 12:00:00,000000001", None, 1),
        ("2024-05-01T14:00:00+02:00", None, 0),
        ("2024-05-01T06:30:00.5-0530", None, 500_000_000),
        ("2024:05:01 12:00:01", None, 1_000_000_000),
        ("20240501T120000Z", None, 0),
        ("20240501120000", None, 0),
        (" 1714564800 ", None, 0),
        ("1714564800.123456789", None, 123_456_789),
        ("1714564800123", None, 123_000_000),
        ("1714564800123456", None, 123_456_000),
        ("1714564800123456789", None, 123_456_789),
        ("1.714564800123e9", None, 123_000_000),
        ("1714564800123.5", "ms", 123_500_000),
        ("1714564800.5", "s", 500_000_000),
    ],
)
def test_absolute_times(text, unit, since_noon_ns):
    assert time_ns(text, unit) == NOON_NS + since_noon_ns


@pytest.mark.parametrize(
    ("text", "unit", "since_start_ns"),
    [
        ("0", None, 0),
        ("12.5", None, 12_500_000_000),
        ("50735.964", None, 50_735_964_000_000),
        ("1500", "ms", 1.5e9),
    ],
)
def test_small_numbers_count_from_the_recordings_start(text, unit, since_start_ns):
    assert time_ns(text, unit) == START_NS + since_start_ns


@pytest.mark.parametrize(
    "text",
    ["", "noon", "2024-13-01T12:00:00", "2024-05-01", "-3", "nan", "inf", "5000000000", "1e30", "01/05/2024"],
)
def test_what_is_no_time_is_refused(text):
    with pytest.raises(ValueError, match=r"no time|no date and time"):
        time_ns(text)


@pytest.mark.parametrize(
    ("stem", "since_noon_ns"),
    [
        ("IMG_20240501_120000", 0),
        ("PXL_20240501_120000123", 123_000_000),
        ("20240501_120000_123", 123_000_000),
        ("2024-05-01T12-00-00.5", 500_000_000),
        ("20240501120000-0007", 0),
        ("1714564800123", 123_000_000),
        ("frame_1714564800.5", 500_000_000),
        ("cam0-1714564800_250000000-left", 250_000_000),
        ("1714564800123456789", 123_456_789),
    ],
)
def test_times_in_names(stem, since_noon_ns):
    assert time_in_name_ns(stem) == NOON_NS + since_noon_ns


@pytest.mark.parametrize(
    "stem", ["000123", "frame_12", "DSC04711", "IMG_20241350_120000", "123456789", "0000000042"]
)
def test_counters_are_no_times(stem):
    assert time_in_name_ns(stem) is None


def test_a_stamp_is_written_as_a_clock_shows_it():
    assert clock_text(NOON_NS + 250_000_000) == "2024-05-01T12:00:00.250Z"
    assert time_ns(clock_text(NOON_NS + 250_000_000)) == NOON_NS + 250_000_000


def exif_jpeg(order: str, taken: str, fraction: str = "", offset: str = "") -> bytes:
    """The start of a JPEG as a camera writes it: APP0, then APP1 with one directory that points to another."""
    texts = {0x9003: taken, 0x9291: fraction, 0x9011: offset}
    entries, data = b"", b""
    held = [(tag, text.encode() + b"\0") for tag, text in sorted(texts.items()) if text]
    data_at = 26 + 2 + 12 * len(held) + 4
    for tag, text in held:
        value = text.ljust(4, b"\0") if len(text) <= 4 else struct.pack(order + "I", data_at + len(data))
        entries += struct.pack(order + "HHI", tag, 2, len(text)) + value
        data += text if len(text) > 4 else b""
    magic = b"II*\0" if order == "<" else b"MM\0*"
    first = struct.pack(order + "IHHHIII", 8, 1, 0x8769, 4, 1, 26, 0)
    directory = struct.pack(order + "H", len(held)) + entries + struct.pack(order + "I", 0)
    exif = b"Exif\0\0" + magic + first + directory + data
    app0 = b"\xff\xe0" + struct.pack(">H", 16) + b"JFIF\0" + bytes(9)
    return b"\xff\xd8" + app0 + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + b"\xff\xda"


@pytest.mark.parametrize("order", ["<", ">"])
def test_exif_in_both_byte_orders(order):
    assert time_taken_ns(exif_jpeg(order, "2024:05:01 12:00:00")) == NOON_NS
    assert time_taken_ns(exif_jpeg(order, "2024:05:01 12:00:00", "123")) == NOON_NS + 123_000_000
    assert time_taken_ns(exif_jpeg(order, "2024:05:01 14:00:00", "12345", "+02:00")) == NOON_NS + 123_450_000


def test_damaged_exif_is_none_and_never_an_accident():
    whole = exif_jpeg("<", "2024:05:01 12:00:00", "123", "+00:00")
    assert time_taken_ns(b"\xff\xd8\xff\xda") is None
    assert time_taken_ns(exif_jpeg("<", "0000:00:00 00:00:00")) is None
    for length in range(2, len(whole) - 2):
        assert time_taken_ns(whole[:length]) in (None, NOON_NS, NOON_NS + 123_000_000)
    for at in range(2, len(whole)):
        time_taken_ns(whole[:at] + bytes([whole[at] ^ 0xFF]) + whole[at + 1 :])
