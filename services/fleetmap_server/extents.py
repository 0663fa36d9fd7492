"""Where and when all maps, or all drives, are: what a collection says of itself."""

from __future__ import annotations

from dataclasses import dataclass

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from fleetmap_server.boxes import LonLatBox
from fleetmap_server.database import Database


@dataclass(frozen=True)
class Extent:
    """What a collection reaches over; None where nothing has a place or a time."""

    box_lonlat: LonLatBox | None
    start_ns: int | None  # UTC since the epoch
    end_ns: int | None


class Extents:
    """Looks at the catalogue's rows; at those of maps, of which there are many, only when there are others."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self._known_maps: tuple[tuple[int, int], Extent] | None = None

    def maps(self) -> Extent:
        """Of the latest versions of all maps."""
        with self._database.reading() as connection:
            state, known = _state_of_maps(connection), self._known_maps
            if known is not None and known[0] == state:
                return known[1]
            extent = _extent(connection, "versions", "is_latest = 1")
        self._known_maps = (state, extent)
        return extent

    def drives(self) -> Extent:
        """Of all drives."""
        with self._database.reading() as connection:
            return _extent(connection, "drives", "retired_ns IS NULL")


# Boxes whose west is greater than their east cross 180 degrees.
_EXTENT = """
SELECT min(west) AS west, min(south) AS south, max(east) AS east, max(north) AS north,
    sum(CASE WHEN west > east THEN 1 ELSE 0 END) AS crossing, min(start_ns) AS start_ns, max(end_ns) AS end_ns
FROM {table} WHERE {where}
"""


def _state_of_maps(connection: Connection) -> tuple[int, int]:
    """What cannot stay the same when a latest version comes or goes: serials only rise."""
    last = connection.execute(sa.text("SELECT coalesce(max(serial), 0) FROM versions")).scalar_one()
    count = connection.execute(sa.text("SELECT count(*) FROM versions WHERE is_latest = 1")).scalar_one()
    return int(last), int(count)


def _extent(connection: Connection, table: str, where: str) -> Extent:
    row = connection.execute(sa.text(_EXTENT.format(table=table, where=where))).one()
    box = None
    if row.west is not None:
        box = (-180.0, row.south, 180.0, row.north) if row.crossing else (row.west, row.south, row.east, row.north)
    return Extent(box, row.start_ns, row.end_ns)
