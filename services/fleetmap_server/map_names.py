"""Maps found by a part of their names."""

from __future__ import annotations

import sqlalchemy as sa

from fleetmap_server.database import Database

MAX_NAMES = 1000


def map_ids_with(database: Database, text: str) -> tuple[str, ...]:
    """Ids of the maps whose ids have a text in them, in alphabetical order and at most MAX_NAMES."""
    escaped = "".join(f"!{character}" if character in "!%_" else character for character in text.lower())
    with database.reading() as connection:
        found = connection.execute(
            sa.text(
                "SELECT map_id FROM versions WHERE is_latest = 1 AND map_id LIKE :pattern ESCAPE '!'"
                " ORDER BY map_id LIMIT :limit"
            ),
            {"pattern": f"%{escaped}%", "limit": MAX_NAMES},
        )
        return tuple(found.scalars())
