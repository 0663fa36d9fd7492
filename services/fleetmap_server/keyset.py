"""Pages by keyset: a page ends with a cursor that names its last row, the next page begins behind that place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from fleetmap_server.boxes import Fragment
from fleetmap_server.search import Key, read_cursor, write_cursor


@dataclass(frozen=True)
class Term:
    """One thing to order by; the last of an order must be different in every row."""

    name: str  # of the selected column
    kind: type[Key]
    descending: bool
    sql: str = ""  # where the column is computed

    @property
    def column(self) -> str:
        """The term as SQL."""
        return self.sql or self.name


class Keyset:
    """An order, and the place in it that a cursor names.

    Raises:
        BadRequestError: the cursor is none, or of another order.
    """

    def __init__(self, what: str, terms: Sequence[Term], after: str | None) -> None:
        self._name = f"{what} by {[(term.name, term.descending) for term in terms]}"
        self._terms = terms
        self._kinds = tuple(term.kind for term in terms)
        self.begin = read_cursor(self._name, after, self._kinds) if after is not None else None

    @property
    def sql(self) -> str:
        """What follows ORDER BY."""
        return ", ".join(f"{term.column} {'DESC' if term.descending else 'ASC'}" for term in self._terms)

    def keys(self, row: object) -> tuple[Key, ...]:
        """The place of a row: its attributes of the terms' names."""
        return tuple(getattr(row, term.name) for term in self._terms)

    def cursor(self, row: object) -> str:
        """The name of a row's place."""
        return write_cursor(self._name, self.keys(row))

    def behind(self, keys: tuple[Key, ...] | None) -> Fragment:
        """SQL that holds for rows behind a place; None is the place before the first."""
        if keys is None:
            return "1 = 1", {}
        sql = "1 = 0"
        for number, term in reversed(list(enumerate(self._terms))):
            side = "<" if term.descending else ">"
            sql = f"({term.column} {side} :k{number} OR ({term.column} = :k{number} AND {sql}))"
        bound = (
            f"{self._terms[0].column} {'<=' if self._terms[0].descending else '>='} :k0"  # an index begins there
        )
        return f"{bound} AND {sql}", {f"k{number}": key for number, key in enumerate(keys)}
