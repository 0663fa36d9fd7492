"""The pages about maps: the list of them, and one map with its footprint, quality, versions and parts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from urllib.parse import urlencode

from fastapi.responses import HTMLResponse

from fleetmap.catalogue import MapEntry
from fleetmap.manifest import Manifest, Quality, WeakStretch
from fleetmap_server.catalogue import CataloguePart
from fleetmap_server.http.footprint_figure import Road, footprint_figure
from fleetmap_server.http.html import Child, Html, element
from fleetmap_server.http.page_layout import facts, length, next_page, page, short_hash, size, table, utc, verdict
from fleetmap_server.http.quality_rows import quality_rows
from fleetmap_server.http.stac_items import map_item_id

_SHOWN = 300  # rows of one table


@dataclass(frozen=True)
class Asked:
    """What somebody looks for, in his own words."""

    name: str = ""
    place: str = ""
    radius_km: str = ""

    def words(self) -> dict[str, str]:
        """What was said, as the query of an address has it."""
        named = {"name": self.name, "place": self.place, "radius_km": self.radius_km}
        return {key: value for key, value in named.items() if value}


def maps_page(entries: Sequence[MapEntry], after: str | None, asked: Asked, further: bool) -> HTMLResponse:
    """A page of the list; ``after`` is the cursor of the next one, ``further`` whether this is not the first."""
    found = map_table(entries) if entries else element("p", "No such map." if asked.words() else "No maps yet.")
    return page(
        "Maps",
        element("h1", "Maps"),
        search_form(asked),
        found,
        element("p", element("a", "First page", href=f"/maps?{urlencode(asked.words())}")) if further else None,
        next_page("/maps", after, asked.words()),
        here="/maps",
    )


def map_table(entries: Sequence[MapEntry]) -> Html:
    """One row for each map."""
    rows: list[list[Child]] = [
        [
            element("a", entry.map_id, href=f"/maps/{entry.map_id}", class_="keep"),
            utc(entry.published_ns),
            entry.number,
            length(entry.length_m),
            entry.landmarks,
            "unknown" if entry.position_sigma_m is None else f"{entry.position_sigma_m:.3f} m",
            size(entry.size_bytes),
            verdict(entry.publishable),
        ]
        for entry in entries
    ]
    headings = ("Map", "Published", "#Version", "#Length", "#Landmarks", "#Position σ", "#Size", "Quality")
    return table(headings, rows)


def search_form(asked: Asked) -> Html:
    """Asks for a name, a place or both."""
    return element(
        "form",
        _field("name", "Name, or a part of it", asked.name),
        _field("place", "Near latitude, longitude (degrees)", asked.place, placeholder="49.011, 8.417"),
        _field("radius_km", "within km", asked.radius_km or "1", size=5),
        element("button", "Search", type="submit"),
        action="/maps",
        method="get",
        role="search",
    )


def map_page(
    entry: MapEntry,
    versions: Sequence[MapEntry],
    parts: Sequence[CataloguePart],
    manifest: Manifest,
    zenoh_endpoint: str,
    http_url: str,
) -> HTMLResponse:
    """All about one version of a map; the addresses are those that the reader reaches the server by."""
    quality = manifest.quality
    title = f"Map {entry.map_id}" + ("" if entry.is_latest else f", version {entry.number}")
    return page(
        title,
        element("h1", title),
        element("p", verdict(entry.publishable), " · ", _published(entry)),
        _older(entry),
        _listed("Warnings", quality.warnings, "warnings"),
        _listed("Remarks", quality.remarks, "quiet"),
        element("h2", "Footprint"),
        footprint_figure(_road(entry, quality, parts)) or element("p", "The way lies outside UTM."),
        element("h2", "Quality"),
        facts(list(quality_rows(quality))),
        _weak_stretches(quality.weak_stretches),
        element("h2", "How to get it"),
        _how_to_get(entry, zenoh_endpoint, http_url),
        element("h2", "Versions"),
        _versions(entry, versions),
        element("h2", "Parts"),
        _parts(entry, parts),
        element("h2", "Origin"),
        facts(_origin(entry, manifest)),
        here="/maps",
    )


def _field(name: str, label: str, value: str, **attributes: str | int) -> Html:
    field = element("input", id=name, name=name, value=value, **attributes)
    return element("div", element("label", label, for_=name), field)


def _published(entry: MapEntry) -> list[Child]:
    how = "rolled back to" if entry.origin == "rollback" else "published"
    return [f"version {entry.number}, ", short_hash(entry.version), f", {how} ", utc(entry.published_ns)]


def _older(entry: MapEntry) -> Html | None:
    if entry.is_latest:
        return None
    latest = element("a", "the latest version", href=f"/maps/{entry.map_id}")
    return element("p", "This is an older version; there is ", latest, ".")


def _listed(heading: str, texts: Sequence[str], kind: str) -> Html | None:
    if not texts:
        return None
    listed = element("ul", [element("li", text) for text in texts])
    return element("div", element("strong", heading), listed, class_=kind)


def _road(entry: MapEntry, quality: Quality, parts: Sequence[CataloguePart]) -> Road:
    way_m = max(quality.length_m, 1e-6)
    return Road(
        f"Map {entry.map_id}",
        entry.trajectory_lonlat,
        entry.epsg,
        [part.cell for part in parts if part.cell is not None],
        [(stretch.from_m / way_m, stretch.to_m / way_m) for stretch in quality.weak_stretches[:_SHOWN]],
    )


def _weak_stretches(stretches: Sequence[WeakStretch]) -> list[Child]:
    if not stretches:
        return []
    rows: list[list[Child]] = [
        [
            f"{stretch.from_m:.1f}",
            f"{stretch.to_m:.1f}",
            element("span", f"{stretch.start_lonlat[1]:.6f}, {stretch.start_lonlat[0]:.6f}", class_="keep"),
            "; ".join(reason.text for reason in stretch.reasons),
        ]
        for stretch in stretches[:_SHOWN]
    ]
    headings = ("#From (m)", "#To (m)", "Begins at (latitude, longitude)", "Why")
    return [table(headings, rows, "Weak stretches"), _more(len(stretches) - len(rows))]


def _how_to_get(entry: MapEntry, zenoh_endpoint: str, http_url: str) -> list[Child]:
    localize = (
        f"fleetmap localize DRIVE.mcap --server {zenoh_endpoint} --map {entry.map_id} --trajectory poses.tum\n"
        f"fleetmap maps show {entry.map_id} --server {zenoh_endpoint}"
    )
    here, asked = f"/maps/{entry.map_id}", f"?version={entry.version}"
    links = (
        ("manifest", f"{here}/manifest.json{asked}"),
        ("trajectory as GeoJSON", f"{here}/trajectory.geojson{asked}"),
        ("preview of the landmarks as PLY", f"{here}/preview.ply{asked}"),
        ("STAC item", f"/collections/maps/items/{map_item_id(entry)}"),
    )
    return [
        element("p", "A vehicle takes what it needs of it by itself:"),
        element("pre", element("code", localize)),
        element("p", "Over HTTP:"),
        element("pre", element("code", f"curl -O {http_url}{here}/manifest.json")),
        element("ul", [element("li", element("a", name, href=href)) for name, href in links]),
    ]


def _versions(shown: MapEntry, versions: Sequence[MapEntry]) -> Html:
    rows: list[list[Child]] = [
        [
            element(
                "a",
                version.number,
                href=f"/maps/{version.map_id}" + ("" if version.is_latest else f"?version={version.number}"),
                aria_current="page" if version.number == shown.number else None,
            ),
            short_hash(version.version),
            utc(version.published_ns),
            "rollback" if version.origin == "rollback" else "published",
            size(version.size_bytes),
            verdict(version.publishable),
            "latest" if version.is_latest else "",
        ]
        for version in reversed(versions[-_SHOWN:])
    ]
    return table(("#Version", "Hash", "When", "How", "#Size", "Quality", ""), rows)


def _parts(entry: MapEntry, parts: Sequence[CataloguePart]) -> list[Child]:
    total = sum(part.size_bytes for part in parts)
    rows: list[list[Child]] = [
        [
            element("a", short_hash(part.sha256), href=f"/maps/{entry.map_id}/parts/{part.sha256}"),
            part.kind,
            "" if part.cell is None else f"{part.cell[0]}, {part.cell[1]}",
            size(part.size_bytes),
        ]
        for part in parts[:_SHOWN]
    ]
    return [
        element("p", f"{len(parts)} parts, together {size(total)}."),
        table(("SHA-256", "Kind", "Cell (east, north)", "#Size"), rows),
        _more(len(parts) - len(rows)),
    ]


def _more(count: int) -> Html | None:
    return element("p", f"And {count} more; the manifest has them all.") if count else None


def _origin(entry: MapEntry, manifest: Manifest) -> list[tuple[str, Child]]:
    made = manifest.provenance
    west, south, east, north = entry.bbox_lonlat
    drive: Child = made.drive
    if made.drive_sha256 is not None:
        drive = [made.drive, " ", short_hash(made.drive_sha256)]
    return [
        ("Survey drive", drive),
        ("Driven", [utc(entry.start_ns), " to ", utc(entry.end_ns)]),
        ("Mapped", [utc(entry.created_ns), f", by fleetmap {made.fleetmap_version}"]),
        ("Camera", f"{manifest.camera.width_px} x {manifest.camera.height_px} px"),
        ("Grid", f"EPSG:{entry.epsg}"),
        ("Bounds", f"{south:.6f} to {north:.6f} latitude, {west:.6f} to {east:.6f} longitude"),
        ("SHA-256 of the manifest", element("span", entry.version, class_="hash")),
    ]
