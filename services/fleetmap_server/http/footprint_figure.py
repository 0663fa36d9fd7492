"""A road from above as an SVG drawing: the way driven, cells, weak stretches, scale and north."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import InputError
from fleetmap.geodesy import UtmGrid
from fleetmap.manifest import CELL_SIZE_M
from fleetmap_server.http.html import Html, element

Array = NDArray[np.float64]

_WIDTH, _MIN_HEIGHT, _MAX_HEIGHT = 960.0, 260.0, 760.0
_MARGIN_M = 60.0
_MAX_CELLS, _MAX_POINTS = 5000, 2000
_BAR_SHARE = 0.25  # of the width, at most

STYLE = """
figure { margin: 1rem 0; } figcaption { color: var(--quiet); font-size: .9rem; }
svg.road { width: 100%; height: auto; border: 1px solid var(--line); border-radius: .4rem;
  background: var(--panel); }
.road .cells { fill: var(--cell); stroke: var(--cell-line); stroke-width: .7; }
.road .way { fill: none; stroke: var(--accent); stroke-width: 3; stroke-linejoin: round; stroke-linecap: round; }
.road .weak { fill: none; stroke: var(--bad); stroke-width: 6; stroke-linejoin: round; stroke-linecap: round; }
.road .end { fill: var(--panel); stroke: var(--accent); stroke-width: 3; }
.road .ink { fill: none; stroke: var(--text); stroke-width: 2; }
.road text { fill: var(--text); font: 15px system-ui, sans-serif; }
"""


@dataclass(frozen=True)
class Road:
    """What is drawn: a way in longitude and latitude, and where it is not to be trusted."""

    name: str
    path_lonlat: Sequence[tuple[float, float]]
    epsg: int | None = None  # of the UTM zone to draw in; None: the one where the way begins
    cells: Iterable[tuple[int, int]] = ()  # floor(easting / 128), floor(northing / 128)
    weak_shares: Sequence[tuple[float, float]] = ()  # from .. to, as shares of the way


def footprint_figure(road: Road) -> Html | None:
    """The drawing with its caption, grid north up; None if the way has no place in UTM."""
    path_m = _in_utm(road)
    if path_m is None:
        return None
    frame = _Frame.around(path_m)
    cells = list(road.cells)[:_MAX_CELLS]
    drawing = element(
        "svg",
        element("title", f"{road.name} from above"),
        element("path", class_="cells", d=_cells_path(cells, frame)) if cells else None,
        element("polyline", class_="way", points=frame.points(_thinned(path_m))),
        [
            element("polyline", class_="weak", points=frame.points(_stretch(path_m, start, end)))
            for start, end in road.weak_shares
        ],
        _ends(path_m, frame),
        _scale_bar(frame),
        _north(),
        class_="road",
        viewBox=f"0 0 {_WIDTH:.0f} {frame.height:.0f}",
        role="img",
    )
    return element("figure", drawing, element("figcaption", _caption(road, path_m, bool(cells))))


@dataclass(frozen=True)
class _Frame:
    """Where a piece of the UTM grid lies in the drawing."""

    west_m: float
    north_m: float
    units_per_m: float
    height: float

    @staticmethod
    def around(path_m: Array) -> _Frame:
        west, south = path_m.min(axis=0) - _MARGIN_M
        east, north = path_m.max(axis=0) + _MARGIN_M
        units_per_m = min(_WIDTH / (east - west), _MAX_HEIGHT / (north - south))
        height = max(units_per_m * (north - south), _MIN_HEIGHT)
        west -= (_WIDTH / units_per_m - (east - west)) / 2.0
        north += (height / units_per_m - (north - south)) / 2.0
        return _Frame(float(west), float(north), float(units_per_m), float(height))

    def place(self, easting_m: float, northing_m: float) -> tuple[float, float]:
        """x to the right and y down."""
        return (easting_m - self.west_m) * self.units_per_m, (self.north_m - northing_m) * self.units_per_m

    def points(self, path_m: Array) -> str:
        return " ".join(f"{x:.1f},{y:.1f}" for x, y in (self.place(*place) for place in path_m))


def _in_utm(road: Road) -> Array | None:
    """Easting and northing (N, 2) in metres."""
    if not road.path_lonlat:
        return None
    lonlat = np.array(road.path_lonlat, dtype=np.float64)
    try:
        grid = UtmGrid(road.epsg) if road.epsg else UtmGrid.at(float(lonlat[0, 1]), float(lonlat[0, 0]))
    except InputError:
        return None
    in_utm = grid.from_geodetic(lonlat[:, 1], lonlat[:, 0], np.zeros(len(lonlat)))[:, :2]
    return np.asarray(in_utm) if np.isfinite(in_utm).all() else None


def _thinned(path_m: Array) -> Array:
    chosen = np.linspace(0, len(path_m) - 1, min(len(path_m), _MAX_POINTS)).round().astype(int)
    return np.asarray(path_m[chosen])


def _stretch(path_m: Array, start: float, end: float) -> Array:
    """The piece of a way between two shares of its length."""
    along_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path_m, axis=0), axis=1))])
    from_m, to_m = np.clip((start, end), 0.0, 1.0) * along_m[-1]
    inside = along_m[(along_m > from_m) & (along_m < to_m)]
    at_m = np.concatenate([[from_m], inside, [to_m]])
    return _thinned(np.stack([np.interp(at_m, along_m, path_m[:, axis]) for axis in (0, 1)], axis=1))


def _cells_path(cells: Iterable[tuple[int, int]], frame: _Frame) -> str:
    side = CELL_SIZE_M * frame.units_per_m
    corners = (frame.place(east * CELL_SIZE_M, (north + 1) * CELL_SIZE_M) for east, north in cells)
    return "".join(f"M{x:.1f} {y:.1f}h{side:.1f}v{side:.1f}h{-side:.1f}z" for x, y in corners)


def _ends(path_m: Array, frame: _Frame) -> list[Html]:
    (x1, y1), (x2, y2) = frame.place(*path_m[0]), frame.place(*path_m[-1])
    first = element("circle", element("title", "start"), class_="end", cx=f"{x1:.1f}", cy=f"{y1:.1f}", r=7)
    last = element(
        "rect", element("title", "end"), class_="end", x=f"{x2 - 6:.1f}", y=f"{y2 - 6:.1f}", width=12, height=12
    )
    return [last, first]


def _scale_bar(frame: _Frame) -> Html:
    """The longest round length that fits."""
    longest_m = _BAR_SHARE * _WIDTH / frame.units_per_m
    decade = 10.0 ** np.floor(np.log10(longest_m))
    length_m = max(step * decade for step in (1.0, 2.0, 5.0) if step * decade <= longest_m)
    label = f"{length_m / 1000:g} km" if length_m >= 1000.0 else f"{length_m:g} m"
    y, end = frame.height - 18.0, 18.0 + length_m * frame.units_per_m
    bar = element("path", class_="ink", d=f"M18 {y - 6:.1f}V{y:.1f}H{end:.1f}V{y - 6:.1f}")
    return element("g", bar, element("text", label, x=18, y=f"{y - 12:.1f}"))


def _north() -> Html:
    x = _WIDTH - 24.0
    arrow = element("path", class_="ink", d=f"M{x:.0f} 62V26M{x - 6:.0f} 36L{x:.0f} 24L{x + 6:.0f} 36")
    return element("g", arrow, element("text", "N", x=f"{x:.0f}", y=18, text_anchor="middle"))


def _caption(road: Road, path_m: Array, has_cells: bool) -> str:
    (west, south), (east, north) = path_m.min(axis=0), path_m.max(axis=0)
    squares = f"Squares are the map's cells of {CELL_SIZE_M} m. " if has_cells else ""
    weak = "Thick red: weak stretches. " if road.weak_shares else ""
    return (
        f"The circle is the start, the square the end. {squares}{weak}Grid north is up; easting {west:.0f} to "
        f"{east:.0f} m, northing {south:.0f} to {north:.0f} m."
    )
