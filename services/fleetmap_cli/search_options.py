"""Where and when to search, as people write it."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

import click

from fleetmap_cli.options import Numbers

AREA = Numbers("WEST,SOUTH,EAST,NORTH")
_OPEN = ("", "..")
_ONE_DAY, _LAST_MOMENT = timedelta(days=1), timedelta(microseconds=1)


@dataclass(frozen=True)
class TimeSpan:
    """Both ends included, UTC since the epoch in nanoseconds; None is open."""

    from_ns: int | None = None
    until_ns: int | None = None


class _TimeSpanType(click.ParamType[TimeSpan]):
    """``FROM/TO`` of ISO 8601 dates or times, either of which may be ``..``; or one day."""

    name = "FROM/TO"

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> TimeSpan:
        """The span, or click's usage error (exit code 2) naming what was expected."""
        if isinstance(value, TimeSpan):
            return value
        first, slash, last = str(value).partition("/")
        try:
            span = TimeSpan(_start_ns(first), _end_ns(last if slash else first))
        except ValueError:
            self.fail(
                f"'{value}' is not FROM/TO; write 2026-03-01/2026-03-31, 2026-03-01T08:00Z/.. or 2026-03-01",
                param,
                ctx,
            )
        if span.from_ns is not None and span.until_ns is not None and span.from_ns > span.until_ns:
            self.fail(f"'{value}' ends before it begins", param, ctx)
        return span


TIME_SPAN = _TimeSpanType()


def _start_ns(text: str) -> int | None:
    return None if text in _OPEN else _ns(_moment(text))


def _end_ns(text: str) -> int | None:
    """The end of what was named: a date means its whole day."""
    if text in _OPEN:
        return None
    moment = _moment(text)
    return _ns(moment if ":" in text or "T" in text else moment + _ONE_DAY - _LAST_MOMENT)


def _moment(text: str) -> datetime:
    moment = datetime.fromisoformat(text)
    return moment if moment.tzinfo is not None else moment.replace(tzinfo=UTC)


def _ns(moment: datetime) -> int:
    return round((moment - datetime(1970, 1, 1, tzinfo=UTC)) / timedelta(microseconds=1)) * 1000
