"""Maps and drives as STAC items: GeoJSON features with their history as links and their blobs as assets.

Field names are those of the STAC extensions version, projection and file, and ``fleetmap:`` for what only maps
have. The schema that an item declares is this server's own, so that a client on a closed network can check an item
without asking anybody else; ``extension_schema`` is that schema.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from shapely.geometry import mapping

from fleetmap.catalogue import MapEntry
from fleetmap.jobs import DriveEntry
from fleetmap_server.boxes import LonLatBox, outline
from fleetmap_server.catalogue import CataloguePart
from fleetmap_server.http.stac_documents import DRIVES, GEOJSON, JSON, MAPS, STAC_VERSION, link, utc

EXTENSION_PATH = "/stac/fleetmap/v1.0.0/schema.json"
BINARY, PLY, MCAP = "application/octet-stream", "application/x-ply", "application/x-mcap"

_MAP_FIGURES = (
    *("number", "origin", "keyframes", "landmarks", "length_m", "size_bytes", "publishable", "gnss_mode"),
    *("gnss_residual_rms_m", "reprojection_rms_px", "position_sigma_m", "position_sigma_p95_m", "height_sigma_m"),
    *("landmarks_per_m", "weak_length_m", "frames_total", "frames_posed", "segments", "drive", "drive_sha256"),
)


def map_item(entry: MapEntry, parts: Sequence[CataloguePart], base: str) -> dict[str, Any]:
    """A version of a map: its trajectory, what it is good for, its history and where to get it."""
    properties = {
        "title": entry.map_id if entry.is_latest else f"{entry.map_id}, version {entry.number}",
        "datetime": utc(entry.start_ns),
        "start_datetime": utc(entry.start_ns),
        "end_datetime": utc(entry.end_ns),
        "created": utc(entry.created_ns),
        "updated": utc(entry.published_ns),
        "version": entry.version,
        "deprecated": not entry.is_latest,
        "proj:code": f"EPSG:{entry.epsg}",
        **_own({name: getattr(entry, name) for name in _MAP_FIGURES}),
        "fleetmap:warnings": list(entry.warnings),
    }
    place = _place(entry.trajectory_lonlat, entry.bbox_lonlat)
    document = _item(base, MAPS, map_item_id(entry), place, properties)
    document["links"] += _history(entry, f"{base}/collections/{MAPS}/items/{entry.map_id}")
    document["assets"] = _map_assets(entry, parts, base)
    return document


def map_item_id(entry: MapEntry) -> str:
    """The map's own id for its latest version, with the number behind for an older one."""
    return entry.map_id if entry.is_latest else f"{entry.map_id}.v{entry.number}"


def drive_item(entry: DriveEntry, base: str) -> dict[str, Any]:
    """A survey drive: where and when it was driven, as far as anybody knows, and the recording."""
    start_ns = entry.received_ns if entry.start_ns is None else entry.start_ns
    properties: dict[str, Any] = {
        "title": entry.name,
        "datetime": utc(start_ns),
        "created": utc(entry.received_ns),
        "updated": utc(entry.received_ns),
        "fleetmap:size_bytes": entry.size_bytes,
        "fleetmap:state": entry.state,
    }
    if entry.start_ns is not None and entry.end_ns is not None:
        properties |= {"start_datetime": utc(entry.start_ns), "end_datetime": utc(entry.end_ns)}
    if entry.summary is not None:
        figures = entry.summary.model_dump(mode="json", exclude={"start_ns", "end_ns", "trajectory_lonlat"})
        properties |= _own(figures)
    place = None if entry.bbox_lonlat is None else _place(entry.trajectory_lonlat, entry.bbox_lonlat)
    document = _item(base, DRIVES, entry.sha256, place, properties)
    document["assets"]["recording"] = _asset(
        f"{base}/blobs/{entry.sha256}", MCAP, "the recording", "data", entry.size_bytes, entry.sha256
    )
    return document


def _item(
    base: str,
    collection: str,
    item_id: str,
    place: tuple[dict[str, Any], list[float]] | None,
    properties: dict[str, Any],
) -> dict[str, Any]:
    """What all items have; ``place`` is geometry and bbox."""
    here = f"{base}/collections/{collection}"
    document: dict[str, Any] = {
        "type": "Feature",
        "stac_version": STAC_VERSION,
        "stac_extensions": [f"{base}{EXTENSION_PATH}"],
        "id": item_id,
        "collection": collection,
        "geometry": None if place is None else place[0],
    }
    if place is not None:
        document["bbox"] = place[1]
    return document | {
        "properties": properties,
        "assets": {},
        "links": [
            link("self", f"{here}/items/{item_id}", GEOJSON, "this item"),
            link("collection", here, JSON, "its collection"),
            link("parent", here, JSON, "its collection"),
            link("root", f"{base}/", JSON, "the landing page"),
        ],
    }


def _own(figures: Mapping[str, Any]) -> dict[str, Any]:
    """Fields of fleetmap's own, as far as they are known."""
    return {f"fleetmap:{name}": value for name, value in figures.items() if value is not None}


def _place(path_lonlat: Sequence[tuple[float, float]], box: LonLatBox) -> tuple[dict[str, Any], list[float]]:
    """The trajectory, cut where it crosses 180 degrees (RFC 7946, 3.1.9); without one the box."""
    return dict(mapping(outline(path_lonlat, box))), list(box)


def _history(entry: MapEntry, latest_href: str) -> list[dict[str, Any]]:
    """Links to the versions before and after, and to the latest."""
    links = []
    for rel, number in (
        ("predecessor-version", entry.predecessor_number),
        ("successor-version", entry.successor_number),
    ):
        if number is not None:
            links.append(link(rel, f"{latest_href}.v{number}", GEOJSON, f"version {number}"))
    if not entry.is_latest:
        links.append(link("latest-version", latest_href, GEOJSON, "the latest version"))
    return links


def _map_assets(entry: MapEntry, parts: Sequence[CataloguePart], base: str) -> dict[str, Any]:
    """Everything a map consists of, and what can be seen of it; each names this very version."""
    here = f"{base}/maps/{entry.map_id}"
    manifest_bytes = entry.size_bytes - sum(part.size_bytes for part in parts)
    assets = {
        "manifest": _asset(
            f"{here}/manifest.json?version={entry.version}",
            JSON,
            "what the parts are",
            "metadata",
            manifest_bytes,
            entry.version,
        ),
        "trajectory": _asset(
            f"{here}/trajectory.geojson?version={entry.version}", GEOJSON, "where it was driven", "metadata"
        ),
        "preview": _asset(
            f"{here}/preview.ply?version={entry.version}", PLY, "some of the landmarks, in UTM", "overview"
        ),
    }
    for part in parts:
        name = part.kind if part.cell is None else f"cell_{part.cell[0]}_{part.cell[1]}"
        name = f"{name}_{part.sha256[:8]}" if name in assets else name
        assets[name] = _asset(
            f"{here}/parts/{part.sha256}", BINARY, _part_title(part), "data", part.size_bytes, part.sha256
        )
    return assets


def _part_title(part: CataloguePart) -> str:
    if part.cell is None:
        return f"the {part.kind} part"
    return f"the 128 m cell with number {part.cell[0]} to the east, {part.cell[1]} to the north"


def _asset(
    href: str, media_type: str, title: str, role: str, size_bytes: int | None = None, sha256: str | None = None
) -> dict[str, Any]:
    asset: dict[str, Any] = {"href": href, "type": media_type, "title": title, "roles": [role]}
    if size_bytes is not None and sha256 is not None:
        asset |= {"file:size": size_bytes, "file:checksum": f"1220{sha256}"}  # multihash: SHA-256, 32 bytes
    return asset
