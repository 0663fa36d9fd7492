"""The binary part format: what goes in comes out, and nothing a part claims is believed."""

from __future__ import annotations

import json
import struct
import tracemalloc
import zlib
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fleetmap import parts
from fleetmap.errors import MapPackageError
from fleetmap.parts import DTYPES, decode_part, encode_part

Explode = Callable[[bytes], tuple[dict[str, Any], bytes]]
Assemble = Callable[..., bytes]
SHAPES = [(0,), (1,), (7,), (5, 3), (0, 32), (4, 32), (3, 3, 3)]


def some_arrays(seed: int = 0) -> dict[str, np.ndarray[Any, Any]]:
    rng = np.random.default_rng(seed)
    arrays = {}
    for number, dtype in enumerate(DTYPES.values()):
        for shape in SHAPES:
            values = rng.normal(0.0, 50.0, shape)
            arrays[f"a{number}_{'x'.join(map(str, shape))}"] = np.abs(values).astype(dtype)
    return arrays


def one_array() -> bytes:
    return encode_part("cell", {"epsg": 32632}, {"points": np.arange(12, dtype=np.float64).reshape(4, 3)})


def test_every_type_and_shape_comes_back_as_it_was() -> None:
    arrays = some_arrays()
    part = decode_part(encode_part("full", {"epsg": 32632, "cell": [1, -2]}, arrays), "here")
    assert (part.kind, part.attributes) == ("full", {"epsg": 32632, "cell": [1, -2]})
    for name, values in arrays.items():
        read = part.array(name, values.dtype.newbyteorder("<").str, values.shape)
        assert read.dtype == values.dtype
        np.testing.assert_array_equal(read, values)
        assert read.flags.writeable
        assert read.flags.c_contiguous


def test_a_part_of_nothing_comes_back() -> None:
    assert decode_part(encode_part("cell", {}, {}), "here").kind == "cell"


def test_big_endian_and_strided_arrays_are_stored_like_any_other() -> None:
    values = np.arange(24, dtype=np.float64).reshape(4, 6)
    plain = encode_part("cell", {}, {"a": np.ascontiguousarray(values[::2, ::3])})
    assert encode_part("cell", {}, {"a": values[::2, ::3]}) == plain
    assert encode_part("cell", {}, {"a": values[::2, ::3].astype(">f8")}) == plain


def test_the_same_arrays_give_the_same_bytes() -> None:
    assert encode_part("full", {"b": 1, "a": 2}, some_arrays()) == encode_part(
        "full", {"a": 2, "b": 1}, some_arrays()
    )


def test_every_truncation_is_refused() -> None:
    data = one_array()
    for length in range(len(data)):
        with pytest.raises(MapPackageError, match="here"):
            decode_part(data[:length], "here")


def test_bytes_after_the_end_are_refused() -> None:
    with pytest.raises(MapPackageError, match="does not hold the 96 bytes"):
        decode_part(one_array() + b"x", "here")


def test_other_files_are_refused_by_their_first_bytes() -> None:
    with pytest.raises(MapPackageError, match="here is no map part"):
        decode_part(b"\x89PNG\r\n\x1a\n" + bytes(100), "here")


def test_a_copy_made_in_text_mode_is_refused() -> None:
    with pytest.raises(MapPackageError, match="no map part"):
        decode_part(one_array().replace(b"\r\n", b"\n"), "here")


def test_a_newer_major_version_asks_for_an_upgrade(explode: Explode, assemble: Assemble) -> None:
    header, payload = explode(one_array())
    with pytest.raises(MapPackageError, match="part format 3, this fleetmap reads 1 to 2; upgrade fleetmap"):
        decode_part(assemble(header, payload, major=3), "here")


def test_a_part_of_version_1_reads_like_any_other(explode: Explode, assemble: Assemble) -> None:
    header, payload = explode(one_array())
    part = decode_part(assemble(header, payload, major=1), "here")
    np.testing.assert_array_equal(part.array("points", "<f8", (4, 3)), np.arange(12.0).reshape(4, 3))


@pytest.mark.parametrize(
    ("header", "complaint"),
    [
        (zlib.compress(b" " * (parts.MAX_HEADER_BYTES + 1)), "truncated or larger than 65536"),
        (zlib.compress(b"{}")[:-1], "truncated or larger than 65536"),
        (zlib.compress(b"{}") + b"!", "truncated or larger than 65536"),
        (b"{}", "cannot be inflated"),
        (zlib.compress(b"{}"), "does not hold at 'kind'"),
    ],
)
def test_a_header_that_does_not_inflate_to_what_it_should_is_refused(header: bytes, complaint: str) -> None:
    data = struct.pack("<8sHHI", parts.PART_MAGIC, 2, 0, len(header)) + header + zlib.compress(b"")
    with pytest.raises(MapPackageError, match=complaint):
        decode_part(data, "here")


def test_a_newer_minor_version_may_bring_unknown_fields_arrays_and_types(
    explode: Explode, assemble: Assemble
) -> None:
    header, payload = explode(one_array())
    header["checksum"] = {"nested": [1, 2.5, None]}
    header["attributes"]["colour"] = "green"
    header["arrays"][0]["unit"] = "m"
    header["arrays"].append({"name": "novel", "dtype": "<c16", "shape": [2], "offset": 96, "length": 32})
    header["payload_bytes"] = 128
    part = decode_part(assemble(header, payload + bytes(32), minor=9), "here")
    assert part.minor == 9
    np.testing.assert_array_equal(part.array("points", "<f8", (None, 3)), np.arange(12.0).reshape(4, 3))
    with pytest.raises(MapPackageError, match="array 'novel' is <c16 2, it must be <f8 any"):
        part.array("novel", "<f8", (None,))


@pytest.mark.parametrize("length", [2**32 - 1, 2**31, 64 * 1024 + 1])
def test_an_absurd_header_length_is_refused(length: int) -> None:
    data = bytearray(one_array())
    struct.pack_into("<I", data, 12, length)
    with pytest.raises(MapPackageError, match=f"header of {length} bytes"):
        decode_part(bytes(data), "here")


def test_a_header_length_beyond_the_end_is_refused() -> None:
    data = bytearray(one_array())
    struct.pack_into("<I", data, 12, 60_000)
    with pytest.raises(MapPackageError, match="truncated inside its header"):
        decode_part(bytes(data), "here")


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (("kind",), "Cell"),
        (("kind",), None),
        (("payload_bytes",), -1),
        (("payload_bytes",), 2**40),
        (("payload_bytes",), 95),
        (("payload_bytes",), 97),
        (("payload_bytes",), 96.5),
        (("payload_bytes",), True),
        (("arrays", 0, "dtype"), "|O"),
        (("arrays", 0, "dtype"), "<i8"),
        (("arrays", 0, "dtype"), "<f4"),
        (("arrays", 0, "shape"), [4, 3, 1]),
        (("arrays", 0, "shape"), [3, 4]),
        (("arrays", 0, "shape"), [-4, -3]),
        (("arrays", 0, "shape"), [2**30, 2**30, 2**30, 2**30]),
        (("arrays", 0, "shape"), [5, 3]),
        (("arrays", 0, "shape"), [1] * 70),
        (("arrays", 0, "offset"), 1),
        (("arrays", 0, "offset"), -8),
        (("arrays", 0, "length"), 88),
        (("arrays", 0, "length"), 2**63),
        (("arrays", 0, "name"), "../../x"),
        (("arrays", 0, "name"), "point"),
        (("arrays",), []),
        (("arrays",), None),
        (("attributes",), []),
    ],
)
def test_a_header_that_lies_is_refused(
    explode: Explode, assemble: Assemble, path: tuple[str | int, ...], value: object
) -> None:
    header, payload = explode(one_array())
    place: Any = header
    for step in path[:-1]:
        place = place[step]
    place[path[-1]] = value
    with pytest.raises(MapPackageError, match="here"):
        decode_part(assemble(header, payload), "here").array("points", "<f8", (4, 3))


def test_an_array_named_twice_is_refused(explode: Explode, assemble: Assemble) -> None:
    header, payload = explode(one_array())
    header["arrays"] *= 2
    with pytest.raises(MapPackageError, match="names an array twice"):
        decode_part(assemble(header, payload), "here")


def test_more_arrays_than_allowed_are_refused(explode: Explode, assemble: Assemble) -> None:
    header, payload = explode(one_array())
    header["arrays"] = [{**header["arrays"][0], "name": f"a{number}"} for number in range(257)]
    with pytest.raises(MapPackageError, match="arrays"):
        decode_part(assemble(header, payload), "here")


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("dtype", ["<f8", "<f4", "<f2"])
def test_numbers_that_are_not_finite_are_refused(bad: float, dtype: str) -> None:
    part = decode_part(encode_part("cell", {}, {"a": np.array([1.0, bad]).astype(dtype)}), "here")
    with pytest.raises(MapPackageError, match="here: array 'a' holds numbers that are not finite"):
        part.array("a", dtype, (2,))


def test_a_decompression_bomb_never_goes_off(explode: Explode) -> None:
    """128 kB of deflated zeros hold 128 MB; of a part that declares 96 bytes, 97 are inflated."""
    header, _ = explode(one_array())
    stream = zlib.compressobj(9)
    bomb = b"".join(stream.compress(bytes(1 << 20)) for _ in range(128)) + stream.flush()
    text = json.dumps(header).encode()
    data = struct.pack("<8sHHI", parts.PART_MAGIC, 1, 0, len(text)) + text + bomb
    tracemalloc.start()
    try:
        with pytest.raises(MapPackageError, match="does not hold the 96 bytes"):
            decode_part(data, "here")
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 1_000_000


def test_a_declared_gigabyte_that_is_not_there_is_not_allocated(explode: Explode, assemble: Assemble) -> None:
    header, payload = explode(one_array())
    header["payload_bytes"] = parts.MAX_PAYLOAD_BYTES
    tracemalloc.start()
    try:
        with pytest.raises(MapPackageError, match="does not hold"):
            decode_part(assemble(header, payload), "here")
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 2_000_000


def test_a_payload_beyond_the_limit_is_neither_written_nor_read() -> None:
    arrays = {"points": np.zeros((4, 3))}
    with pytest.raises(MapPackageError, match="96 bytes exceeds 95; split the drive"):
        encode_part("cell", {}, arrays, 95)
    data = encode_part("cell", {}, arrays, 96)
    decode_part(data, "here", 96)
    with pytest.raises(MapPackageError, match="here declares 96 bytes, at most 95 may be"):
        decode_part(data, "here", 95)


@settings(max_examples=300, deadline=None)
@given(st.binary(max_size=300))
def test_random_bytes_never_raise_anything_else(data: bytes) -> None:
    versions = [struct.pack("<8sHH", parts.PART_MAGIC, major, 0) for major in (1, 2)]
    for start in (b"", parts.PART_MAGIC, *versions):
        with pytest.raises(MapPackageError):
            decode_part(start + data, "here")


@settings(max_examples=500, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 10_000), st.integers(0, 255)), min_size=1, max_size=6))
def test_damaged_parts_never_raise_anything_else(changes: list[tuple[int, int]]) -> None:
    data = bytearray(one_array())
    for place, value in changes:
        data[place % len(data)] = value
    try:
        read = decode_part(bytes(data), "here").array("points", "<f8", (4, 3))
    except MapPackageError:
        return
    assert read.shape == (4, 3)
