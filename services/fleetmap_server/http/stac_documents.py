"""The catalogue as STAC documents: the landing page, the collections and what they say of themselves.

Nothing in here asks anybody: values come in, documents go out. ``base`` is the server's own address, without a
slash at its end.
"""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

from fleetmap_server.extents import Extent

STAC_VERSION = "1.1.0"
MAPS, DRIVES = "maps", "drives"
JSON, GEOJSON, HTML = "application/json", "application/geo+json", "text/html"
OPENAPI = "application/vnd.oai.openapi+json;version=3.1"
CONFORMS_TO = (
    "https://api.stacspec.org/v1.0.0/core",
    "https://api.stacspec.org/v1.0.0/collections",
    "https://api.stacspec.org/v1.0.0/ogcapi-features",
    "https://api.stacspec.org/v1.0.0/ogcapi-features#sort",
    "https://api.stacspec.org/v1.0.0/item-search",
    "https://api.stacspec.org/v1.0.0/item-search#sort",
    "http://www.opengis.net/spec/ogcapi-features-1/1.0/conf/core",
    "http://www.opengis.net/spec/ogcapi-features-1/1.0/conf/geojson",
)

_TITLE = "fleetmap: visual maps anchored in UTM"
_COLLECTIONS = {
    MAPS: (
        "Maps",
        "The latest version of every map: a vehicle reads its UTM pose from it by camera. Older versions of a map "
        "are items too, reached by the links predecessor-version and latest-version.",
    ),
    DRIVES: ("Survey drives", "The recordings that maps are made of."),
}
COLLECTIONS = tuple(_COLLECTIONS)


def landing_page(base: str) -> dict[str, Any]:
    """Where everything is."""
    return {
        "type": "Catalog",
        "id": "fleetmap",
        "stac_version": STAC_VERSION,
        "title": _TITLE,
        "description": "Every map was built from a survey drive; a vehicle reads its UTM pose from it by camera.",
        "conformsTo": list(CONFORMS_TO),
        "links": [
            link("self", f"{base}/", JSON, "this page"),
            link("root", f"{base}/", JSON, "this page"),
            link("conformance", f"{base}/conformance", JSON, "what this interface conforms to"),
            link("service-desc", f"{base}/api", OPENAPI, "this interface in OpenAPI"),
            link("data", f"{base}/collections", JSON, "the collections"),
            *(link("child", f"{base}/collections/{name}", JSON, _COLLECTIONS[name][0]) for name in COLLECTIONS),
            *(
                link("items", f"{base}/collections/{name}/items", GEOJSON, f"{_COLLECTIONS[name][0]}, as features")
                for name in COLLECTIONS
            ),
            link("search", f"{base}/search", GEOJSON, "search in all collections") | {"method": "GET"},
            link("search", f"{base}/search", GEOJSON, "search in all collections") | {"method": "POST"},
            link("alternate", f"{base}/", HTML, "the catalogue to look at"),
            link("health", f"{base}/healthz", JSON, "whether the server is well"),
        ],
    }


def collections_page(base: str, extents: dict[str, Extent]) -> dict[str, Any]:
    """All collections; ``extents`` has one for each."""
    return {
        "collections": [collection(base, name, extents[name]) for name in COLLECTIONS],
        "links": [
            link("self", f"{base}/collections", JSON, "the collections"),
            link("root", f"{base}/", JSON, "the landing page"),
        ],
    }


def collection(base: str, name: str, extent: Extent) -> dict[str, Any]:
    """One collection, and where and when its items are."""
    here = f"{base}/collections/{name}"
    title, description = _COLLECTIONS[name]
    return {
        "type": "Collection",
        "id": name,
        "stac_version": STAC_VERSION,
        "title": title,
        "description": description,
        "license": "other",
        "extent": {
            "spatial": {"bbox": [list(extent.box_lonlat or (-180.0, -90.0, 180.0, 90.0))]},
            "temporal": {"interval": [[utc_or_none(extent.start_ns), utc_or_none(extent.end_ns)]]},
        },
        "links": [
            link("self", here, JSON, "this collection"),
            link("root", f"{base}/", JSON, "the landing page"),
            link("parent", f"{base}/", JSON, "the landing page"),
            link("items", f"{here}/items", GEOJSON, "its items"),
        ],
    }


def link(rel: str, href: str, media_type: str, title: str) -> dict[str, Any]:
    """A link, as STAC has them."""
    return {"rel": rel, "href": href, "type": media_type, "title": title}


def utc(stamp_ns: int) -> str:
    """RFC 3339, cut off to the microsecond."""
    whole_s, rest_ns = divmod(stamp_ns, 1_000_000_000)
    stamp = datetime.fromtimestamp(whole_s, UTC).replace(microsecond=rest_ns // 1000)
    return stamp.isoformat().replace("+00:00", "Z")


def utc_or_none(stamp_ns: int | None) -> str | None:
    """``utc``, where there is a time."""
    return None if stamp_ns is None else utc(stamp_ns)
