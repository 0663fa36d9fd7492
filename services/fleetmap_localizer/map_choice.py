"""Which maps to look into where several show the same place."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from fleetmap.catalogue import MapEntry
from fleetmap.cell import CellIndex
from fleetmap.geodesy import UtmGrid
from fleetmap.manifest import CELL_SIZE_M, Manifest, PartRecord

_DIRECTIONS = 4
_WORTH_IT = 0.7  # of the best coverage; with so much, the newer map is taken
_STILL_WORTH_IT = 0.5  # with so much, the map that is in use stays

Way = tuple[int, CellIndex, int]  # zone, cell and direction of travel: what a survey drive has seen of a place


@dataclass(frozen=True)
class MapOffer:
    """One version of a map that could be looked into."""

    entry: MapEntry
    manifest: Manifest

    @property
    def version(self) -> str:
        """SHA-256 of the manifest."""
        return self.entry.version

    @cached_property
    def cells(self) -> tuple[PartRecord, ...]:
        """Records of its cells."""
        return tuple(record for record in self.manifest.parts if record.kind == "cell")

    def ways(self, records: Sequence[PartRecord]) -> dict[Way, float]:
        """What some of its cells show, each with its share of the cell's keyframes."""
        shown: dict[Way, float] = {}
        for record in records:
            assert record.cell is not None
            directions = self._directions.get(record.cell, frozenset({0}))
            for direction in directions:
                shown[self.entry.epsg, record.cell, direction] = record.keyframes / len(directions)
        return shown

    @cached_property
    def _directions(self) -> Mapping[CellIndex, frozenset[int]]:
        """In which directions the survey drove through its cells; a camera mostly looks where it goes."""
        lonlat = np.array(self.manifest.trajectory_lonlat, dtype=np.float64).reshape(-1, 2)
        if len(lonlat) < 2:
            return {}
        path_m = UtmGrid(self.entry.epsg).from_geodetic(lonlat[:, 1], lonlat[:, 0], np.zeros(len(lonlat)))[:, :2]
        steps_m = np.gradient(path_m, axis=0)
        quarters = np.rint(np.arctan2(steps_m[:, 1], steps_m[:, 0]) * _DIRECTIONS / (2.0 * np.pi)).astype(int)
        found: dict[CellIndex, set[int]] = {}
        cells = np.floor(path_m / CELL_SIZE_M).astype(int)
        for (east, north), quarter in zip(cells.tolist(), (quarters % _DIRECTIONS).tolist(), strict=True):
            found.setdefault((east, north), set()).add(quarter)
        return {cell: frozenset(directions) for cell, directions in found.items()}


def choose_maps(
    shown: Sequence[tuple[MapOffer, Mapping[Way, float]]], in_use: AbstractSet[str], max_count: int
) -> list[MapOffer]:
    """The maps that together show all there is, the best first; none that shows what others show already.

    Of maps that show about as much the newest is taken; but one that is in use stays as long as it shows half of
    what the best does. A newer version of a map in use is in use already.

    Args:
        shown: the latest version of each map, and what its cells around the vehicle show.
        in_use: ids of the maps that are looked into now.
        max_count: how many maps to choose at most.
    """
    left = {way for _, ways in shown for way in ways}
    rest, chosen = list(shown), list[MapOffer]()
    while left and len(chosen) < max_count:
        gains = [sum(share for way, share in ways.items() if way in left) for _, ways in rest]
        best = max(range(len(rest)), key=lambda i: _rank(rest[i][0], gains[i], max(gains), in_use))
        offer, ways = rest.pop(best)
        chosen.append(offer)
        left -= ways.keys()
    return chosen


def _rank(offer: MapOffer, gain: float, best_gain: float, in_use: AbstractSet[str]) -> tuple[bool, bool, int, str]:
    stays = offer.entry.map_id in in_use and gain >= _STILL_WORTH_IT * best_gain
    entry = offer.entry
    return stays, gain >= _WORTH_IT * best_gain, entry.end_ns, entry.map_id
