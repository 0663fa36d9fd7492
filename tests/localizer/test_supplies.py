"""Maps for many askers: shared by those who ask for the same, let go by need."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from threading import Barrier

import pytest

from fleetmap.camera import Camera
from fleetmap.errors import NoPoseError
from fleetmap_localizer.map_source import read_map
from fleetmap_localizer.map_view import LocalizableMap, MapView
from fleetmap_localizer.pose_estimate import NoPose, PoseEstimate
from fleetmap_localizer.settings import LocalizerSettings
from fleetmap_localizer.supplies import LatLon, Supplies

CAMERA, OTHER_CAMERA = Camera(64, 48, 50.0, 50.0, 31.5, 23.5), Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
HERE = (49.00001, 8.40001)


class NotedMaps:
    """The street's map as a whole, and a note in the log when it is closed."""

    def __init__(self, log: list[str], name: str, content: LocalizableMap | None, camera: Camera) -> None:
        self._views = () if content is None else (MapView(content, camera, LocalizerSettings()),)
        self._log, self._name = log, name
        log.append(f"open {name}")

    def views(self) -> tuple[MapView, ...]:
        if not self._views:
            raise NoPoseError("no map here")
        return self._views

    def moved(self, pose: PoseEstimate | NoPose) -> None:
        pass

    def close(self) -> None:
        self._log.append(f"close {self._name}")


@pytest.fixture(scope="module")
def content(mapped_street) -> LocalizableMap:
    return read_map(mapped_street.package)


def supplies_of(log: list[str], content: LocalizableMap | None, **limits: int) -> Supplies:
    def open_supply(camera: Camera, near: LatLon | None) -> NotedMaps:
        return NotedMaps(log, f"{camera.fx_px:g} {near}", content, camera)

    return Supplies(open_supply, **limits)


def test_who_asks_for_the_same_camera_and_neighbourhood_shares_the_maps(content):
    log: list[str] = []
    supplies = supplies_of(log, content)
    first = supplies.views(CAMERA, HERE)
    assert supplies.views(CAMERA, (49.0001, 8.3999)) is first
    assert log == ["open 50 (49.0, 8.4)"]
    assert supplies.views(OTHER_CAMERA, HERE) is not first
    assert supplies.views(CAMERA, None) is not first
    assert log[1:] == ["open 60 (49.0, 8.4)", "open 50 None"]
    supplies.close()
    assert sorted(log[3:]) == ["close 50 (49.0, 8.4)", "close 50 None", "close 60 (49.0, 8.4)"]


def test_the_least_recently_asked_for_is_let_go(content):
    log: list[str] = []
    supplies = supplies_of(log, content, max_supplies=2)
    for lat_deg in (1.0, 2.0, 1.0, 3.0):
        supplies.views(CAMERA, (lat_deg, 0.0))
    assert log == ["open 50 (1.0, 0.0)", "open 50 (2.0, 0.0)", "open 50 (3.0, 0.0)", "close 50 (2.0, 0.0)"]


def test_landmarks_are_limited_but_for_those_asked_for_last(content):
    log: list[str] = []
    supplies = supplies_of(log, content, max_landmarks=len(content.content.landmarks) - 1)
    assert supplies.views(CAMERA, (1.0, 0.0))
    assert supplies.views(CAMERA, (2.0, 0.0))
    assert log == ["open 50 (1.0, 0.0)", "open 50 (2.0, 0.0)", "close 50 (1.0, 0.0)"]


def test_a_place_without_maps_is_asked_about_again_the_next_time():
    log: list[str] = []
    supplies = supplies_of(log, None)
    for _ in range(2):
        with pytest.raises(NoPoseError, match="no map here"):
            supplies.views(CAMERA, HERE)
    assert log == ["open 50 (49.0, 8.4)", "close 50 (49.0, 8.4)"] * 2


def test_many_who_ask_at_once_are_served_by_one(content):
    log: list[str] = []
    supplies, together = supplies_of(log, content), Barrier(8)

    def ask(_: int) -> tuple[MapView, ...]:
        together.wait(20.0)
        return supplies.views(CAMERA, HERE)

    with ThreadPoolExecutor(8) as pool:
        found = list(pool.map(ask, range(8)))
    assert all(views is found[0] for views in found)
    assert log == ["open 50 (49.0, 8.4)"]


def test_whatever_was_opened_is_closed_once_however_many_ask_for_more_than_there_is_room(content):
    log: list[str] = []
    supplies, together = supplies_of(log, content, max_supplies=1), Barrier(6)

    def ask(number: int) -> None:
        together.wait(20.0)
        for turn in range(10):
            assert supplies.views(CAMERA, (float((number + turn) % 3), 0.0))

    with ThreadPoolExecutor(6) as pool:
        list(pool.map(ask, range(6)))
    supplies.close()
    opened, closed = (
        [line.split(" ", 1)[1] for line in log if line.startswith(word)] for word in ("open", "close")
    )
    assert len(opened) >= 3
    assert sorted(opened) == sorted(closed)
