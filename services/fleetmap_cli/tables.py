"""Tables as the listing verbs print them."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime


def table(headings: Sequence[str], rows: Sequence[Sequence[str]], when_empty: str) -> str:
    """Columns as wide as their widest cell, or a line that says that there is nothing."""
    if not rows:
        return when_empty
    lines = [headings, *rows]
    widths = [max(len(line[column]) for line in lines) for column in range(len(headings))]
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip() for line in lines
    )


def utc_text(stamp_ns: int | None) -> str:
    """A time to the second, such as ``2026-03-01 12:00:00``; empty for None."""
    return (
        "" if stamp_ns is None else f"{datetime.fromtimestamp(stamp_ns // 1_000_000_000, UTC):%Y-%m-%d %H:%M:%S}"
    )


def megabytes(size_bytes: int) -> str:
    """A size such as ``12.34 MB``."""
    return f"{size_bytes / 1e6:.2f} MB"


def rows_of_text(*rows: tuple[str, str]) -> str:
    """One line for each pair of a label and what there is to say."""
    width = max(len(label) for label, _ in rows)
    return "\n".join(f"{label:<{width}}  {text}".rstrip() for label, text in rows)
