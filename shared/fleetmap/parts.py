"""The binary part of a map package: named arrays behind a JSON header, deflated. No pickle.

    offset  size  field (little endian)
    0       8     magic b"FMPART\\r\\n" (the line end reveals copies made in text mode)
    8       2     major version; another one is refused
    10      2     minor version; a newer one may bring arrays and fields that this reader passes over
    12      4     header length in bytes
    16            header, JSON: kind, attributes, payload_bytes, arrays [{name, dtype, shape, offset, length}];
                  deflated since version 2
    ...           payload, one zlib stream; offsets and lengths count in the inflated payload

Inside the payload every array lies as byte planes (all first bytes, all second bytes, ...), which deflate
packs better than whole numbers. The same arrays give the same bytes. Nothing a part declares is believed:
sizes are limited before anything is inflated, and each array is checked when it is taken out.
"""

from __future__ import annotations

import json
import math
import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, StringConstraints, ValidationError

from fleetmap.errors import MapPackageError

PART_MAGIC = b"FMPART\r\n"
PART_MAJOR, PART_MINOR = 2, 0
_OLDEST_MAJOR = 1  # whose header is not deflated
MAX_HEADER_BYTES = 64 * 1024
MAX_PAYLOAD_BYTES = 1024 * 1024 * 1024
MAX_ARRAYS = 256
DTYPES = {name: np.dtype(name) for name in ("<f8", "<f4", "<f2", "<i8", "<i4", "|i1", "<u4", "|u1")}
_PREAMBLE = struct.Struct("<8sHHI")
_DEFLATE_LEVEL = 6

Name = Annotated[str, StringConstraints(pattern=r"^[a-z][a-z0-9_]{0,63}$")]
Count = Annotated[int, Field(ge=0, le=MAX_PAYLOAD_BYTES)]
Shape = tuple[int | None, ...]  # None: any length


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, strict=True, extra="ignore", allow_inf_nan=False)


class _ArrayRecord(_Model):
    name: Name
    dtype: Annotated[str, StringConstraints(max_length=16)]
    shape: Annotated[tuple[Count, ...], Field(max_length=4)]
    offset: Count
    length: Count


class _Header(_Model):
    kind: Name
    attributes: dict[str, Any]
    payload_bytes: Count
    arrays: Annotated[tuple[_ArrayRecord, ...], Field(max_length=MAX_ARRAYS)]


@dataclass(frozen=True)
class Part:
    """A decoded part; its arrays are taken out by name, each with the type and shape the reader expects."""

    kind: str
    attributes: dict[str, Any]
    minor: int
    origin: str
    _records: dict[str, _ArrayRecord]
    _payload: bytes

    def __contains__(self, name: str) -> bool:
        return name in self._records

    def array(self, name: str, dtype: str, shape: Shape) -> NDArray[Any]:
        """A copy of one array; ``shape`` holds None where any length will do.

        Raises:
            MapPackageError: the array is missing, has another type or shape, or a number is not finite.
        """
        record = self._records.get(name)
        if record is None:
            raise MapPackageError(f"{self.origin} lacks the array '{name}'")
        fits = len(record.shape) == len(shape) and all(
            want is None or want == got for want, got in zip(shape, record.shape, strict=True)
        )
        if record.dtype != dtype or not fits:
            raise MapPackageError(
                f"{self.origin}: array '{name}' is {record.dtype} {_spell(record.shape)}, "
                f"it must be {dtype} {_spell(shape)}"
            )
        values = self._values(record)
        if values.dtype.kind == "f" and not np.isfinite(values).all():
            raise MapPackageError(f"{self.origin}: array '{name}' holds numbers that are not finite")
        return values

    def _values(self, record: _ArrayRecord) -> NDArray[Any]:
        dtype = DTYPES[record.dtype]
        stored = np.frombuffer(self._payload[record.offset : record.offset + record.length], np.uint8)
        planes = stored.reshape(dtype.itemsize, -1)
        return np.array(planes.T, order="C").view(dtype).reshape(record.shape)


def encode_part(
    kind: str,
    attributes: Mapping[str, Any],
    arrays: Mapping[str, NDArray[Any]],
    max_payload_bytes: int = MAX_PAYLOAD_BYTES,
) -> bytes:
    """The bytes of a part; the arrays keep their order.

    Raises:
        MapPackageError: the arrays together exceed ``max_payload_bytes``.
    """
    records, planes, offset = [], [], 0
    for name, values in arrays.items():
        dtype = values.dtype.newbyteorder("<")
        stored = np.frombuffer(values.astype(dtype, copy=False).tobytes(), np.uint8)
        planes.append(stored.reshape(-1, dtype.itemsize).T.tobytes())
        records.append(
            {"name": name, "dtype": dtype.str, "shape": values.shape, "offset": offset, "length": stored.size}
        )
        offset += stored.size
    if offset > max_payload_bytes:
        raise MapPackageError(f"a '{kind}' part of {offset} bytes exceeds {max_payload_bytes}; split the drive")
    header = json.dumps(
        {"kind": kind, "attributes": dict(attributes), "payload_bytes": offset, "arrays": records},
        sort_keys=True,
        separators=(",", ":"),
        allow_nan=False,
    ).encode()
    deflated = zlib.compress(header, _DEFLATE_LEVEL)
    preamble = _PREAMBLE.pack(PART_MAGIC, PART_MAJOR, PART_MINOR, len(deflated))
    return preamble + deflated + zlib.compress(b"".join(planes), _DEFLATE_LEVEL)


def decode_part(data: bytes, origin: str, max_payload_bytes: int = MAX_PAYLOAD_BYTES) -> Part:
    """Read a part that inflates to at most ``max_payload_bytes``; ``origin`` says where it came from.

    Raises:
        MapPackageError: no part, truncated, damaged, larger than it may be, or of another major version.
    """
    major, minor, header_length = _read_preamble(data, origin)
    payload_start = _PREAMBLE.size + header_length
    if payload_start > len(data):
        raise MapPackageError(f"{origin} is truncated inside its header")
    text = data[_PREAMBLE.size : payload_start]
    if major > 1:
        text = _inflate_header(text, origin)
    try:
        header = _Header.model_validate_json(text)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(step) for step in first["loc"])
        raise MapPackageError(f"{origin} has a header that does not hold at '{place}': {first['msg']}") from error
    if header.payload_bytes > max_payload_bytes:
        raise MapPackageError(
            f"{origin} declares {header.payload_bytes} bytes, at most {max_payload_bytes} may be"
        )
    records = {record.name: record for record in header.arrays}
    if len(records) != len(header.arrays):
        raise MapPackageError(f"{origin} names an array twice")
    for record in header.arrays:
        _check_record(record, header.payload_bytes, origin)
    payload = _inflate(memoryview(data)[payload_start:], header.payload_bytes, origin)
    return Part(header.kind, header.attributes, minor, origin, records, payload)


def _read_preamble(data: bytes, origin: str) -> tuple[int, int, int]:
    if len(data) < _PREAMBLE.size:
        raise MapPackageError(f"{origin} is no map part: only {len(data)} bytes long")
    magic, major, minor, header_length = _PREAMBLE.unpack_from(data)
    if magic != PART_MAGIC:
        raise MapPackageError(f"{origin} is no map part: it begins with {magic!r}")
    if not _OLDEST_MAJOR <= major <= PART_MAJOR:
        raise MapPackageError(
            f"{origin} has part format {major}, this fleetmap reads {_OLDEST_MAJOR} to {PART_MAJOR}; "
            "upgrade fleetmap"
        )
    if header_length > MAX_HEADER_BYTES:
        raise MapPackageError(
            f"{origin} declares a header of {header_length} bytes, at most {MAX_HEADER_BYTES} hold"
        )
    return major, minor, header_length


def _check_record(record: _ArrayRecord, payload_bytes: int, origin: str) -> None:
    """Arrays of a type unknown here may come from a newer minor version: only their place is checked."""
    if record.offset + record.length > payload_bytes:
        raise MapPackageError(f"{origin}: array '{record.name}' reaches beyond the payload")
    dtype = DTYPES.get(record.dtype)
    if dtype is not None and math.prod(record.shape) * dtype.itemsize != record.length:
        raise MapPackageError(f"{origin}: array '{record.name}' has a length that its shape does not explain")


def _inflate_header(deflated: bytes, origin: str) -> bytes:
    stream = zlib.decompressobj()
    try:
        text = stream.decompress(deflated, MAX_HEADER_BYTES)
    except zlib.error as error:
        raise MapPackageError(f"{origin} has a header that cannot be inflated: {error}") from error
    if not stream.eof or stream.unused_data:
        raise MapPackageError(f"{origin} has a header that is truncated or larger than {MAX_HEADER_BYTES} bytes")
    return text


def _inflate(deflated: memoryview, size: int, origin: str) -> bytes:
    """Inflate at most one byte more than declared, so that a decompression bomb never goes off."""
    stream = zlib.decompressobj()
    try:
        payload = stream.decompress(deflated, size + 1)
    except zlib.error as error:
        raise MapPackageError(f"{origin} cannot be inflated: {error}") from error
    if len(payload) != size or not stream.eof or stream.unused_data:
        raise MapPackageError(f"{origin} does not hold the {size} bytes that its header declares")
    return payload


def _spell(shape: Shape) -> str:
    return "x".join("any" if length is None else str(length) for length in shape)
