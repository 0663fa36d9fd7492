"""The page at ``/``: what there is, what is new, and how to begin."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from fastapi.responses import HTMLResponse

from fleetmap.catalogue import MapEntry
from fleetmap.jobs import JobState
from fleetmap_server.http.html import Child, element
from fleetmap_server.http.map_pages import Asked, map_table, search_form
from fleetmap_server.http.page_layout import page


def front_page(
    newest: Sequence[MapEntry], maps: int, drives: int, jobs: Mapping[JobState, int], zenoh_endpoint: str
) -> HTMLResponse:
    """Counts, the newest maps, and where programs find the same."""
    waiting = jobs.get("queued", 0) + jobs.get("running", 0)
    counts: list[Child] = [
        element("a", _count(maps, "map"), href="/maps"),
        ", ",
        element("a", _count(drives, "survey drive"), href="/drives"),
        ", ",
        element("a", f"{_count(waiting, 'mapping job')} under way", href="/jobs"),
    ]
    return page(
        "Maps of the fleet",
        element("h1", "Maps of the fleet"),
        element("p", "Visual maps anchored in UTM: a vehicle reads its pose from them by its camera alone."),
        element("p", *counts),
        search_form(Asked()),
        element("h2", "Newest maps"),
        map_table(newest) if newest else element("p", "No maps yet."),
        element("h2", "For programs"),
        element("pre", element("code", f"fleetmap maps list --server {zenoh_endpoint}")),
        element("ul", [element("li", element("a", name, href=href)) for name, href in _FOR_PROGRAMS]),
    )


_FOR_PROGRAMS = (
    ("Maps as STAC items", "/collections/maps/items"),
    ("Collections", "/collections"),
    ("This interface in OpenAPI", "/api"),
    ("Metrics for Prometheus", "/metrics"),
    ("Whether the server is ready", "/readyz"),
)


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"
