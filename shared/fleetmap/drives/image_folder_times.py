"""Times as phones, dash cams and people write them, in cells of tables and in names of files."""

from __future__ import annotations

import calendar
import re
from datetime import UTC, datetime
from decimal import Decimal, InvalidOperation

from fleetmap.drive import START_NS

NS_PER_UNIT = {"ns": 1, "us": 1_000, "ms": 1_000_000, "s": 1_000_000_000}

_YEAR_1990_S, _YEAR_2038_S = 631_152_000, 2_147_483_647  # a plain number's unit is told by falling between these
_CLOCK = re.compile(
    r"(?P<date>\d{4}[-:/.]?\d\d[-:/.]?\d\d)[T _-]?(?P<time>\d\d[-:]?\d\d[-:]?\d\d)"
    r"(?:[.,](?P<fraction>\d{1,9})|_?(?P<glued>\d{3}|\d{6}|\d{9}))?"
    r"\s*(?P<zone>Z|UTC|[+-]\d\d:?\d\d)?",
    re.IGNORECASE,
)
_LONG_NUMBER = re.compile(r"(?<![\d.])\d{9,19}(?:[._]\d{1,9})?(?!\d)")


def time_ns(text: str, unit: str | None = None) -> int:
    """A time in nanoseconds: ISO 8601 or EXIF's date (UTC where it names no zone), or a number.

    Args:
        text: such as ``2024-05-01T12:00:00.25Z``, ``2024:05:01 12:00:00``, ``1714564800.25``, ``12.5``.
        unit: of a number ("s", "ms", "us", "ns"); None: told by its size, small ones are seconds.

    Times of 1990 and later count since 1970; earlier ones are seconds of the recording's own clock, which is set
    to START_NS at 0.

    Raises:
        ValueError: none of these.
    """
    stripped = text.strip()
    clock = _CLOCK.fullmatch(stripped)
    if clock is not None and (unit is None or not stripped.isdecimal()):
        return _clock_ns(clock, clock["zone"])
    try:
        number = Decimal(stripped)
    except InvalidOperation as error:
        raise ValueError(f"'{stripped}' is no time: neither ISO 8601 nor a number") from error
    if not number.is_finite() or number < 0:
        raise ValueError(f"'{stripped}' is no time")
    ns_per_unit = _ns_per_unit(number) if unit is None else NS_PER_UNIT[unit]
    if ns_per_unit is None:
        raise ValueError(f"'{stripped}' is no time between 1990 and 2038 in s, ms, us or ns")
    stamp_ns = int((number * ns_per_unit).to_integral_value())
    return stamp_ns if stamp_ns >= _YEAR_1990_S * NS_PER_UNIT["s"] else START_NS + stamp_ns


def time_in_name_ns(stem: str) -> int | None:
    """The time that a file's name holds, such as ``IMG_20240501_120000123`` or ``1714564800250``; None without.

    Counters are no times: a number has to lie between 1990 and 2038.
    """
    for number in _LONG_NUMBER.finditer(stem):
        value = Decimal(number[0].replace("_", "."))
        ns_per_unit = _ns_per_unit(value)
        if ns_per_unit is not None and value >= _YEAR_1990_S:
            return int((value * ns_per_unit).to_integral_value())
    for clock in _CLOCK.finditer(stem):
        try:
            return _clock_ns(clock, zone=None)  # what follows a time in a name is a counter rather than a zone
        except ValueError:
            continue
    return None


def clock_text(stamp_ns: int) -> str:
    """A stamp for people: ``2024-05-01T12:00:00.250Z``."""
    whole_s, rest_ns = divmod(stamp_ns, NS_PER_UNIT["s"])
    return f"{datetime.fromtimestamp(whole_s, UTC):%Y-%m-%dT%H:%M:%S}.{rest_ns // 1_000_000:03d}Z"


def _ns_per_unit(number: Decimal) -> int | None:
    if number < _YEAR_1990_S:
        return NS_PER_UNIT["s"]
    for ns_per_unit in (NS_PER_UNIT[unit] for unit in ("s", "ms", "us", "ns")):
        if _YEAR_1990_S <= number * ns_per_unit / NS_PER_UNIT["s"] <= _YEAR_2038_S:
            return ns_per_unit
    return None


def _clock_ns(clock: re.Match[str], zone: str | None) -> int:
    digits = re.sub(r"\D", "", clock["date"] + clock["time"])
    try:
        moment = datetime.strptime(digits, "%Y%m%d%H%M%S")
    except ValueError as error:
        raise ValueError(f"'{clock[0]}' is no date and time") from error
    fraction_ns = int(((clock["fraction"] or clock["glued"] or "") + "0" * 9)[:9])
    seconds = calendar.timegm(moment.timetuple()) - _zone_s(zone)
    if seconds < _YEAR_1990_S:
        raise ValueError(f"'{clock[0]}' lies before 1990")
    return seconds * NS_PER_UNIT["s"] + fraction_ns


def _zone_s(zone: str | None) -> int:
    if zone is None or zone.upper() in ("Z", "UTC"):
        return 0
    sign, digits = (-1 if zone[0] == "-" else 1), zone[1:].replace(":", "")
    return sign * (int(digits[:2]) * 3600 + int(digits[2:]) * 60)
