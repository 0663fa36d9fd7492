"""Maps as GeoJSON features (RFC 7946) with the field names of STAC, so that its tools can read them."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

from fleetmap.catalogue import MapEntry

STAC_VERSION = "1.0.0"
COLLECTION = "maps"
_TITLE = "fleetmap: visual maps anchored in UTM"
_JSON, _GEOJSON = "application/json", "application/geo+json"


def landing_page(base: str) -> dict[str, Any]:
    """Where everything is; ``base`` is the server's own address."""
    return {
        "type": "Catalog",
        "id": "fleetmap",
        "stac_version": STAC_VERSION,
        "title": _TITLE,
        "description": "Every map was built from a survey drive; a vehicle reads its UTM pose from it by camera.",
        "links": [
            _link("self", f"{base}/", _JSON, "this page"),
            _link("root", f"{base}/", _JSON, "this page"),
            _link("data", f"{base}/collections", _JSON, "the collections"),
            _link("child", f"{base}/collections/{COLLECTION}", _JSON, "the maps, as a collection"),
            _link("items", f"{base}/collections/{COLLECTION}/items", _GEOJSON, "the maps, as features"),
            _link("service-desc", f"{base}/api", _JSON, "this interface in OpenAPI"),
            _link("health", f"{base}/healthz", _JSON, "whether the server is well"),
        ],
    }


def collection(base: str) -> dict[str, Any]:
    """The one collection there is."""
    here = f"{base}/collections/{COLLECTION}"
    return {
        "type": "Collection",
        "id": COLLECTION,
        "stac_version": STAC_VERSION,
        "title": _TITLE,
        "description": "The latest version of every map.",
        "license": "other",
        "extent": {
            "spatial": {"bbox": [[-180.0, -90.0, 180.0, 90.0]]},
            "temporal": {"interval": [[None, None]]},
        },
        "links": [
            _link("self", here, _JSON, "this collection"),
            _link("root", f"{base}/", _JSON, "the landing page"),
            _link("items", f"{here}/items", _GEOJSON, "the maps, as features"),
        ],
    }


def feature(entry: MapEntry, base: str) -> dict[str, Any]:
    """One map: its trajectory in longitude and latitude, what it is good for and where to get it."""
    here = f"{base}/collections/{COLLECTION}/items/{entry.map_id}"
    return {
        "type": "Feature",
        "stac_version": STAC_VERSION,
        "stac_extensions": [],
        "id": entry.map_id,
        "collection": COLLECTION,
        "geometry": _geometry(entry),
        "bbox": list(entry.bbox_lonlat),
        "properties": _properties(entry),
        "assets": {
            "manifest": {
                "href": f"{base}/maps/{entry.map_id}/manifest.json",
                "type": _JSON,
                "title": "what the map's parts are",
                "roles": ["metadata"],
            }
        },
        "links": [
            _link("self", here, _GEOJSON, "this map"),
            _link("collection", f"{base}/collections/{COLLECTION}", _JSON, "all maps"),
            _link("root", f"{base}/", _JSON, "the landing page"),
        ],
    }


def _properties(entry: MapEntry) -> dict[str, Any]:
    return {
        "title": entry.map_id,
        "datetime": _utc(entry.start_ns),
        "start_datetime": _utc(entry.start_ns),
        "end_datetime": _utc(entry.end_ns),
        "created": _utc(entry.created_ns),
        "updated": _utc(entry.published_ns),
        "version": entry.version,
        "proj:code": f"EPSG:{entry.epsg}",
        "fleetmap:keyframes": entry.keyframes,
        "fleetmap:landmarks": entry.landmarks,
        "fleetmap:length_m": entry.length_m,
        "fleetmap:size_bytes": entry.size_bytes,
        "fleetmap:publishable": entry.publishable,
        "fleetmap:gnss_mode": entry.gnss_mode,
        "fleetmap:gnss_residual_rms_m": entry.gnss_residual_rms_m,
        "fleetmap:reprojection_rms_px": entry.reprojection_rms_px,
        "fleetmap:warnings": list(entry.warnings),
    }


def _geometry(entry: MapEntry) -> dict[str, Any]:
    """The trajectory; of a map that does not tell it, the middle of its bounding box."""
    west, south, east, north = entry.bbox_lonlat
    path = [list(place) for place in entry.trajectory_lonlat] or [[(west + east) / 2, (south + north) / 2]]
    if len(path) == 1:
        return {"type": "Point", "coordinates": path[0]}
    return {"type": "LineString", "coordinates": path}


def _link(rel: str, href: str, media_type: str, title: str) -> dict[str, str]:
    return {"rel": rel, "href": href, "type": media_type, "title": title}


def _utc(stamp_ns: int) -> str:
    """RFC 3339, to the microsecond."""
    whole_s, rest_ns = divmod(stamp_ns, 1_000_000_000)
    return (
        datetime.fromtimestamp(whole_s, UTC)
        .replace(microsecond=rest_ns // 1000)
        .isoformat()
        .replace("+00:00", "Z")
    )
