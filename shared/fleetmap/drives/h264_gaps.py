"""Notices that pictures of an H.264 stream were lost: the decoder itself would make up what they showed.

Reference pictures are numbered (``frame_num``); a number that is skipped is a picture that never arrived.
Source: ITU-T H.264, sections 7.3.2.1.1 (sequence parameter set), 7.3.3 (slice header), 7.4.3 (gaps), 9.1 (codes).
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import pairwise

_START_CODE = re.compile(rb"\x00\x00\x01")
_SLICE, _KEYFRAME_SLICE, _SEQUENCE_PARAMETERS = 1, 5, 7
_HEADER_BYTES = 256  # more than any header up to where it is read
_PROFILES_WITH_CHROMA = frozenset({100, 110, 122, 244, 44, 83, 86, 118, 128, 138, 139, 134, 135})


class LostPictures:
    """Follows one stream."""

    def __init__(self) -> None:
        self._number_bits: int | None = None  # None before the first parameters, and where gaps are allowed
        self._has_colour_planes = False
        self._last_number: int | None = None  # of the last reference picture

    def are_before(self, data: bytes) -> bool:
        """Whether reference pictures are missing between the message before and this one."""
        is_gap = False
        for unit in _units(data):
            kind, is_reference = unit[0] & 31, bool(unit[0] & 0x60)
            bits = _Bits(unit[1:])
            try:
                if kind == _SEQUENCE_PARAMETERS:
                    self._read_parameters(bits)
                elif kind in (_SLICE, _KEYFRAME_SLICE) and self._number_bits is not None:
                    number = self._number_of_slice(bits, self._number_bits)
                    is_gap = is_gap or (kind == _SLICE and self._is_skipped(number))
                    if is_reference:
                        self._last_number = number
            except IndexError:  # too short to be what it says; the decoder will tell
                continue
        return is_gap

    def _is_skipped(self, number: int) -> bool:
        if self._last_number is None or self._number_bits is None:
            return False
        return (number - self._last_number) % (1 << self._number_bits) > 1

    def _number_of_slice(self, bits: _Bits, number_bits: int) -> int:
        for _ in range(3):  # first macroblock, slice type, picture parameter set
            bits.exp_golomb()
        bits.take(2 if self._has_colour_planes else 0)
        return bits.take(number_bits)

    def _read_parameters(self, bits: _Bits) -> None:
        profile = bits.take(8)
        bits.take(16)  # constraints, level
        bits.exp_golomb()  # id
        self._has_colour_planes = False
        if profile in _PROFILES_WITH_CHROMA:
            self._has_colour_planes = _skip_chroma(bits)
        number_bits = bits.exp_golomb() + 4
        order_type = bits.exp_golomb()
        if order_type == 0:
            bits.exp_golomb()
        elif order_type == 1:
            bits.take(1)
            bits.exp_golomb()  # two signed offsets: as long as unsigned codes
            bits.exp_golomb()
            for _ in range(bits.exp_golomb()):
                bits.exp_golomb()
        bits.exp_golomb()  # number of reference frames
        are_gaps_allowed = bits.take(1)
        self._number_bits = None if are_gaps_allowed or number_bits > 16 else number_bits


def _skip_chroma(bits: _Bits) -> bool:
    """From the chroma format to the scaling lists; whether colour planes are coded apart."""
    chroma_format = bits.exp_golomb()
    has_colour_planes = chroma_format == 3 and bool(bits.take(1))
    bits.exp_golomb()  # depth of luma
    bits.exp_golomb()  # depth of chroma
    bits.take(1)
    if bits.take(1):  # scaling matrices
        for index in range(12 if chroma_format == 3 else 8):
            if bits.take(1):
                _skip_scaling_list(bits, 16 if index < 6 else 64)
    return has_colour_planes


def _skip_scaling_list(bits: _Bits, size: int) -> None:
    last = following = 8
    for _ in range(size):
        if following:
            code = bits.exp_golomb()
            delta = (code + 1) // 2 if code % 2 else -(code // 2)
            following = (last + delta) % 256
        last = following or last


def _units(data: bytes) -> Iterator[bytes]:
    """The beginnings of a stream's units in Annex B, without the bytes that keep start codes unique."""
    begins = [found.end() for found in _START_CODE.finditer(data)]
    for begin, end in pairwise([*begins, len(data)]):
        unit = data[begin : min(end, begin + _HEADER_BYTES)].replace(b"\0\0\3", b"\0\0")
        if unit:
            yield unit


class _Bits:
    """Reads bits from the most significant on. Raises IndexError at the end."""

    def __init__(self, data: bytes) -> None:
        self._value, self._left = int.from_bytes(data, "big"), 8 * len(data)

    def take(self, count: int) -> int:
        """An unsigned number of some bits."""
        if count > self._left:
            raise IndexError("no bits left")
        self._left -= count
        return (self._value >> self._left) & ((1 << count) - 1)

    def exp_golomb(self) -> int:
        """An unsigned Exp-Golomb code (section 9.1)."""
        zeros = 0
        while not self.take(1):
            zeros += 1
        return (1 << zeros) - 1 + self.take(zeros)
