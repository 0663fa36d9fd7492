"""The maps around a vehicle, kept ready in the background while it drives."""

from __future__ import annotations

from pathlib import Path
from threading import Condition, Thread

from fleetmap.camera import Camera
from fleetmap_localizer.map_cache import MapCache
from fleetmap_localizer.map_fetching import Fetcher
from fleetmap_localizer.map_preparation import Preparer
from fleetmap_localizer.map_shelf import Shelf
from fleetmap_localizer.map_source import MapFolder, MapServer
from fleetmap_localizer.map_view import MapView
from fleetmap_localizer.map_window import Whereabouts, WindowSettings
from fleetmap_localizer.pose_estimate import NoPose, PoseEstimate
from fleetmap_localizer.settings import LocalizerSettings

_LOOK_EVERY_S = 30.0  # whether what could not be had comes by now


def map_supply_of(
    origin: MapServer | Path,
    camera: Camera,
    settings: LocalizerSettings | None = None,
    *,
    near_lat_lon_deg: tuple[float, float] | None = None,
    cache: Path | None = None,
    window: WindowSettings | None = None,
    in_step: bool = False,
) -> TileSupply:
    """The maps of a server or of a package's folder, around wherever the vehicle is; close it in the end.

    Args:
        origin: the server, or the folder.
        camera: of the vehicle.
        settings: of the localizer that will look into the views.
        near_lat_lon_deg: where the vehicle is at the start; without it, it may be anywhere.
        cache: folder that keeps what was fetched; None for the user's.
        window: what to fetch and keep.
        in_step: ``views`` waits until all is ready that the pose before asks for, so that a drive that is replayed
            faster than it was driven gives the same poses every time. A vehicle does not wait.

    Raises:
        InputError: the place lies outside UTM.
    """
    window = window or WindowSettings()
    where = Whereabouts.near(near_lat_lon_deg, window)
    if isinstance(origin, Path):
        return TileSupply(MapFolder(origin), None, where, camera, settings or LocalizerSettings(), in_step)
    kept = MapCache(cache, window.max_cache_bytes)
    return TileSupply(origin, kept, where, camera, settings or LocalizerSettings(), in_step)


class TileSupply:
    """A MapSupply that follows a vehicle through the maps of one source; made by ``map_supply_of``."""

    def __init__(
        self,
        origin: MapServer | MapFolder,
        cache: MapCache | None,
        where: Whereabouts,
        camera: Camera,
        settings: LocalizerSettings,
        in_step: bool,
    ) -> None:
        self._origin, self._camera, self._settings, self._in_step = origin, camera, settings, in_step
        self._changed = Condition()
        self._followed = self._asked_for = (
            where  # as of the last image; as of the last that asks for something else
        )
        self._news = 0  # counts what may change the views
        self._done_for: tuple[Whereabouts, int] | None = None  # place and news that the views are made for
        self._settled_for: Whereabouts | None = None
        self._views: tuple[MapView, ...] | None = None
        self._error: Exception | None = None
        self._is_closed = False
        shelf = Shelf(None if cache is None else cache.parts)
        self._fetcher = Fetcher(origin, shelf, cache, self._note_news)
        self._preparer = Preparer(origin, shelf, self._fetcher, camera, settings, where.settings)
        self._thread = Thread(target=self._run, name="map-views", daemon=True)
        self._thread.start()

    def views(self) -> tuple[MapView, ...]:
        """What lies around the vehicle; waits until anything does.

        Raises:
            NoPoseError: there is no map here.
            ServerError: the server was not there from the beginning, or refuses.
            MapPackageError: the folder holds no map.
        """
        with self._changed:
            self._changed.wait_for(self._is_ready)
            if self._error is not None:
                raise self._error
            return self._views or ()

    def moved(self, pose: PoseEstimate | NoPose) -> None:
        """Follow the vehicle."""
        self._followed = self._followed.after(pose)
        if not self._followed.is_like(self._asked_for):
            with self._changed:
                self._asked_for = self._followed
                self._changed.notify_all()

    def close(self) -> None:
        """End what goes on in the background."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()
        self._fetcher.close()
        self._thread.join()

    def _is_ready(self) -> bool:
        is_current = self._views is not None and (not self._in_step or self._settled_for is self._asked_for)
        return is_current or self._error is not None or self._is_closed

    def _note_news(self) -> None:
        with self._changed:
            self._news += 1
            self._changed.notify_all()

    def _run(self) -> None:
        try:
            while (task := self._next_task()) is not None:
                where, _ = task
                views, is_settled = self._preparer.prepare(where)
                error = self._preparer.why_nothing(where) if is_settled and not views else None
                with self._changed:
                    self._done_for = task
                    self._take(where, views, is_settled, error)
                    self._changed.notify_all()
        except Exception as error:  # whatever it is, nobody waits for ever, and views() tells
            with self._changed:
                self._error = error
                self._changed.notify_all()

    def _next_task(self) -> tuple[Whereabouts, int] | None:
        """The place and the news to make views for, once either is new; None when it is over."""
        with self._changed:
            self._changed.wait_for(self._is_due, _LOOK_EVERY_S)
            return None if self._is_closed or self._error else (self._asked_for, self._news)

    def _is_due(self) -> bool:
        return self._is_closed or self._done_for != (self._asked_for, self._news)

    def _take(
        self, where: Whereabouts, views: tuple[MapView, ...], is_settled: bool, error: Exception | None
    ) -> None:
        """Swap the views, as a whole; the same tuple stays while nothing has changed."""
        if self._views is None and error is not None:
            self._error = error
        elif (is_settled or self._views is not None) and views != self._views:
            self._views = views
        if is_settled:
            self._settled_for = where
