"""From a place to the views of the maps around it: what is missing is wished for, what is there is decoded."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from fleetmap.camera import Camera
from fleetmap.errors import FleetmapError, MapPackageError, NoPoseError
from fleetmap.manifest import PartRecord
from fleetmap.map_package import decode_cells
from fleetmap.visual_map import LocalizationMap
from fleetmap_localizer.map_choice import MapOffer, choose_maps
from fleetmap_localizer.map_fetching import CatalogueWish, Fetcher, ManifestWish, PartsWish, Wish
from fleetmap_localizer.map_shelf import Shelf
from fleetmap_localizer.map_source import Circle, MapFolder, MapServer
from fleetmap_localizer.map_view import LocalizableMap, MapView
from fleetmap_localizer.map_window import Area, Whereabouts, WindowSettings
from fleetmap_localizer.settings import LocalizerSettings

_log = logging.getLogger(__name__)

_CATALOGUE_MARGIN_M = 2000.0  # asked for around what is needed, so that it is seldom asked

_GRID_METRES = 1.002  # at most so many metres on the ground are one on the grid

_Records = dict[str, PartRecord]  # by hash
_Choice = tuple[MapOffer, list[PartRecord]]  # a map, and its cells that matter


@dataclass(frozen=True)
class _Piece:
    """A view that is ready, and what it was made of."""

    offer: MapOffer
    cells: _Records
    view: MapView


class Preparer:
    """Keeps the views of the maps around a vehicle; one thread at a time."""

    def __init__(
        self,
        origin: MapServer | MapFolder,
        shelf: Shelf,
        fetcher: Fetcher,
        camera: Camera,
        settings: LocalizerSettings,
        window: WindowSettings,
    ) -> None:
        self._origin, self._shelf, self._fetcher = origin, shelf, fetcher
        self._camera, self._settings, self._window = camera, settings, window
        self._pieces: dict[str, _Piece] = {}  # by map id
        self._offers: dict[str, MapOffer] = {}  # by version
        self._unreadable: set[str] = set()  # hashes of cells
        self._is_cut_short = False

    def prepare(self, where: Whereabouts) -> tuple[tuple[MapView, ...], bool]:
        """The views for a place as far as they can be made now, and whether nothing more is about to come.

        While the place is searched for, the views before stay until all is there: of two streets that look alike
        the one that came first would be believed.
        """
        if self._fetcher.error is not None:
            raise self._fetcher.error
        look = where.look_area()
        urgent: list[Wish] = []
        offers = self._offered(where, urgent)
        chosen = self._chosen(offers, look, where)
        stand_ins = [self._ready_version(offer, records, look) for offer, records in chosen]
        urgent += self._missing(chosen) + self._missing(each for each in stand_ins if each not in chosen)
        fetch = where.fetch_area()
        ahead = [] if fetch is None else self._chosen(offers, fetch, where)
        self._fetcher.wish([*urgent, *self._missing(ahead)])
        is_settled = not urgent or self._fetcher.is_away
        if is_settled or not where.is_searching:
            pieces = [self._newest_piece(offer, records, look) for offer, records in chosen]
            self._pieces = {piece.offer.entry.map_id: piece for piece in pieces if piece is not None}
            wanted = {record.sha256 for _, records in (*chosen, *ahead) for record in records}
            self._shelf.keep_only(wanted.union(*(piece.cells for piece in self._pieces.values())))
        return tuple(piece.view for piece in self._pieces.values()), is_settled

    def why_nothing(self, where: Whereabouts) -> FleetmapError | None:
        """Why there can be no view, when there is none at the start; None if one may come on the way."""
        if self._fetcher.is_away:
            return self._fetcher.why_away
        if self._shelf.entries() and self._offers:
            return None
        around = _circle_around(where.fetch_area())
        place = "" if around is None else f" near {around.lat_deg:.6f},{around.lon_deg:.6f}"
        hint = ""
        if isinstance(self._origin, MapServer):
            hint = f"; 'fleetmap maps list --server {self._origin.endpoint}' shows what it has"
        readable = " that can be read" if self._shelf.entries() and around is None else ""
        return NoPoseError(f"{self._origin} has no map{readable}{place}{hint}")

    def _offered(self, where: Whereabouts, urgent: list[Wish]) -> list[MapOffer]:
        """The latest versions of the maps around; until one has come, the version in use stands in for it."""
        around = _circle_around(where.fetch_area())
        if not self._shelf.knows(around):
            wider = None if around is None else around.widened(_CATALOGUE_MARGIN_M)
            urgent.append(CatalogueWish(wider, self._window.max_maps))
        offers = list[MapOffer]()
        for entry in self._shelf.entries():
            if around is not None and not around.holds(entry):
                continue
            manifest = self._shelf.manifest(entry.map_id, entry.version)
            if manifest is not None:
                offers.append(self._offers.get(entry.version) or MapOffer(entry, manifest))
                continue
            if not self._shelf.is_given_up(entry.version):
                urgent.append(ManifestWish(entry.map_id, entry.version))
            if entry.map_id in self._pieces:
                offers.append(self._pieces[entry.map_id].offer)
        self._offers = {offer.version: offer for offer in offers}
        return offers

    def _chosen(self, offers: Sequence[MapOffer], area: Area | None, where: Whereabouts) -> list[_Choice]:
        """The maps to look into, with their cells in the area; where none is to be had, those that are in use."""
        around = {offer.version: _cells_in(area, offer) for offer in offers}
        shown = [(offer, offer.ways(around[offer.version])) for offer in offers if around[offer.version]]
        max_count = self._window.max_maps if area is None else self._window.max_views
        chosen = choose_maps(shown, self._pieces.keys(), max_count)
        if where.is_lost:  # what covers the place best does not help
            chosen += [offer for offer, _ in shown if offer not in chosen][: max_count - len(chosen)]
        if not chosen:
            chosen = [piece.offer for piece in self._pieces.values()]
        return self._cut_short([(offer, _cells_in(area, offer)) for offer in chosen])

    def _ready_version(self, offer: MapOffer, records: list[PartRecord], look: Area | None) -> _Choice:
        """The version in use until all of the next one's cells around are there."""
        piece = self._pieces.get(offer.entry.map_id)
        if piece is None or piece.offer.version == offer.version or all(map(self._is_readable, records)):
            return offer, records
        return piece.offer, _cells_in(look, piece.offer)

    def _cut_short(self, chosen: Iterable[_Choice]) -> list[_Choice]:
        """As much as may be ready at once."""
        kept, left_bytes = list[_Choice](), self._window.max_bytes
        for offer, records in chosen:
            left_bytes -= sum(record.size_bytes for record in records)
            if left_bytes < 0 and kept:
                self._tell_that_it_is_cut_short(len(kept))
                break
            kept.append((offer, records))
        return kept

    def _tell_that_it_is_cut_short(self, count: int) -> None:
        if not self._is_cut_short:
            _log.warning(
                "%s has more maps than can be searched at once: only %d are; say --near where the vehicle is",
                self._origin,
                count,
            )
        self._is_cut_short = True

    def _missing(self, chosen: Iterable[_Choice]) -> list[Wish]:
        """What is to be fetched for some cells of maps."""
        wishes = list[Wish]()
        for offer, records in chosen:
            sizes_bytes = {
                record.sha256: record.size_bytes
                for record in records
                if self._shelf.part(record.sha256, record.size_bytes) is None
                and not self._shelf.is_given_up(record.sha256)
            }
            if sizes_bytes:
                wishes.append(PartsWish(offer.entry.map_id, offer.version, sizes_bytes))
        return wishes

    def _is_readable(self, record: PartRecord) -> bool:
        is_here = self._shelf.part(record.sha256, record.size_bytes) is not None
        return is_here and record.sha256 not in self._unreadable

    def _newest_piece(self, offer: MapOffer, records: list[PartRecord], look: Area | None) -> _Piece | None:
        """The piece of the newest version that is whole."""
        version = self._ready_version(offer, records, look)
        piece = self._piece(*version, look)
        again = self._ready_version(offer, records, look)  # by now it is known what cannot be read
        return piece if again[0] is version[0] else self._piece(*again, look)

    def _piece(self, offer: MapOffer, records: Sequence[PartRecord], look: Area | None) -> _Piece | None:
        """The view of what can be read of some cells: the one before if it shows them, and not much more."""
        cells = {record.sha256: record for record in records if self._is_readable(record)}
        before = self._pieces.get(offer.entry.map_id)
        if before is not None and before.offer.version == offer.version:
            near = {record.sha256 for record in _cells_in(look, offer, self._window.kept_m)}
            if cells.keys() <= before.cells.keys() <= near:
                return before
            still = {sha256: record for sha256, record in before.cells.items() if sha256 in near}
            cells |= {sha256: record for sha256, record in still.items() if self._is_readable(record)}
        content, read = self._decoded(offer, cells)
        if content is None or len(content.landmarks) == 0:
            return before
        camera = offer.manifest.camera.to_camera()
        source = LocalizableMap(offer.entry.map_id, offer.version, camera, content)
        return _Piece(offer, read, MapView(source, self._camera, self._settings))

    def _decoded(self, offer: MapOffer, cells: _Records) -> tuple[LocalizationMap | None, _Records]:
        """The cells that can be read, merged; those that cannot are left out for good."""
        parts = {sha256: self._shelf.part(sha256, record.size_bytes) for sha256, record in cells.items()}
        try:
            return decode_cells(offer.manifest, [data for data in parts.values() if data is not None]), cells
        except MapPackageError:
            _log.debug("map '%s': one cell after the other", offer.entry.map_id)
        content, read = None, dict[str, bytes]()
        for sha256, data in parts.items():
            try:
                content = decode_cells(offer.manifest, [*read.values(), data or b""])
                read[sha256] = data or b""
            except MapPackageError as error:
                self._unreadable.add(sha256)
                _log.warning("a tile of map '%s' is left out: %s", offer.entry.map_id, error)
        return content, {sha256: cells[sha256] for sha256 in read}


def _cells_in(area: Area | None, offer: MapOffer, margin_m: float = 0.0) -> list[PartRecord]:
    return list(offer.cells) if area is None else area.cells_of(offer.cells, offer.entry.epsg, margin_m)


def _circle_around(area: Area | None) -> Circle | None:
    """A circle on the globe that holds an area; None for everything."""
    if area is None:
        return None
    lat_deg, lon_deg = area.lat_lon_deg()
    reach_m = np.linalg.norm(area.centres_m - area.centres_m[0], axis=1).max()
    return Circle(float(lat_deg[0]), float(lon_deg[0]), _GRID_METRES * float(reach_m + area.radius_m))
