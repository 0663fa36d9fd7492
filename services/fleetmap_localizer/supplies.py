"""Map supplies for many askers: one for each camera and place that is asked about, the least recent let go."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from threading import Lock

from fleetmap.camera import Camera
from fleetmap_localizer.map_supply import MapSupply
from fleetmap_localizer.map_view import MapView

LatLon = tuple[float, float]  # degrees
OpenSupply = Callable[[Camera, LatLon | None], MapSupply]
_Key = tuple[Camera, LatLon | None]

_PLACE_DIGITS = 3  # of a degree: who asks from within some 100 m of another shares his maps
_MAX_SUPPLIES, _MAX_LANDMARKS = 8, 2_000_000


@dataclass
class _Shelved:
    """One supply, opened by whoever needs it first while others wait."""

    lock: Lock = field(default_factory=Lock)
    supply: MapSupply | None = None
    landmarks: int = 0
    is_dropped: bool = False  # who waited for it needs another one


class Supplies:
    """Safe to use from several threads; close it in the end.

    Args:
        open_supply: makes the supply of a camera around a place, or without one of all there is.
        max_supplies: kept at once.
        max_landmarks: of all together; the last one asked for is kept in any case.
    """

    def __init__(
        self,
        open_supply: OpenSupply,
        max_supplies: int = _MAX_SUPPLIES,
        max_landmarks: int = _MAX_LANDMARKS,
    ) -> None:
        self._open = open_supply
        self._max_supplies, self._max_landmarks = max_supplies, max_landmarks
        self._lock = Lock()  # of the next line; never held while something is fetched
        self._shelf: OrderedDict[_Key, _Shelved] = OrderedDict()

    def views(self, camera: Camera, near_lat_lon_deg: LatLon | None) -> tuple[MapView, ...]:
        """What to look into for an image of a camera.

        Raises:
            NoPoseError: there is no map here.
            ServerError: the map server failed, and nothing is at hand.
        """
        key = camera, None if near_lat_lon_deg is None else _rounded(near_lat_lon_deg)
        views: tuple[MapView, ...] | None = None
        while views is None:
            shelved = self._shelved(key)
            try:
                views = self._views_of(shelved, key)
            except BaseException:
                self._drop(key, shelved)
                raise
        self._make_room()
        return views

    def close(self) -> None:
        """Let go of all."""
        with self._lock:
            all_of_them = list(self._shelf.items())
        for key, shelved in all_of_them:
            self._drop(key, shelved)

    def _shelved(self, key: _Key) -> _Shelved:
        with self._lock:
            shelved = self._shelf.setdefault(key, _Shelved())
            self._shelf.move_to_end(key)
            return shelved

    def _views_of(self, shelved: _Shelved, key: _Key) -> tuple[MapView, ...] | None:
        """None if it was dropped before its turn came."""
        with shelved.lock:
            if shelved.is_dropped:
                return None
            if shelved.supply is None:
                shelved.supply = self._open(*key)
            views = shelved.supply.views()
            shelved.landmarks = sum(len(view.content.landmarks) for view in views)
            return views

    def _make_room(self) -> None:
        while True:
            with self._lock:
                landmarks = sum(shelved.landmarks for shelved in self._shelf.values())
                is_full = len(self._shelf) > self._max_supplies or landmarks > self._max_landmarks
                if not is_full or len(self._shelf) == 1:
                    return
                key, shelved = next(iter(self._shelf.items()))
            self._drop(key, shelved)

    def _drop(self, key: _Key, shelved: _Shelved) -> None:
        with self._lock:
            if self._shelf.get(key) is shelved:
                del self._shelf[key]
        with shelved.lock:
            if shelved.supply is not None and not shelved.is_dropped:
                shelved.supply.close()
            shelved.is_dropped = True


def _rounded(lat_lon_deg: LatLon) -> LatLon:
    lat_deg, lon_deg = lat_lon_deg
    return round(lat_deg, _PLACE_DIGITS), round(lon_deg, _PLACE_DIGITS)
