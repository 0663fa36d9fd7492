"""The demonstration's picture: the street from above, what both cameras saw, and how far off they were."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from mpl_toolkits.axes_grid1.anchored_artists import AnchoredSizeBar
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from fleetmap.drives import open_drive
from fleetmap.evaluation import TrajectoryErrors, evaluate_trajectory
from fleetmap.geodesy import UtmGrid
from fleetmap.map_package import open_package
from fleetmap.trajectory import Trajectory, read_trajectory
from fleetmap.yardstick import evaluate_gnss_spline
from fleetmap_cli.plotting import new_figure, save_figure

Array = NDArray[np.float64]

SHOWN_BESIDE_M = 28.0  # landmarks further from both drives are left out
CLOSE_UP_M = 9.0
_SURVEY, _SECOND, _GNSS, _LANDMARK = "#1f5fbf", "#c8321e", "#f2a900", "#8a8f98"


@dataclass(frozen=True)
class _Vehicle:
    """What one drive came to."""

    poses: Trajectory
    truth: Trajectory
    errors: TrajectoryErrors
    image: NDArray[np.uint8]  # (H, W) from the middle of the drive


@dataclass(frozen=True)
class _Demonstration:
    """All that is drawn; positions in UTM."""

    survey: _Vehicle
    second: _Vehicle
    fixes_m: Array  # (F, 3)
    spline: TrajectoryErrors  # of the fixes alone
    landmarks_m: Array  # (N, 3)


def draw_demonstration(picture: Path, folder: Path) -> None:
    """Draw what the folder's recordings, trajectories and map tell.

    Raises:
        InputError: one of them cannot be read.
        StorageError: the picture cannot be written.
    """
    shown = _read(folder)
    sheet = _Sheet.along(shown.survey.truth.positions_m)
    figure = new_figure(width_in=15.0, height_in=8.4)
    panels = figure.subplot_mosaic(
        [["above", "above", "close up"], ["survey", "second", "errors"]],
        width_ratios=[2.67, 1.78, 2.0],
        height_ratios=[2.0, 1.0],
    )
    _draw_from_above(panels["above"], shown, sheet)
    _draw_close_up(panels["close up"], shown, sheet)
    _draw_image(panels["survey"], shown.survey.image, "Survey vehicle: camera and GNSS", _SURVEY)
    _draw_image(panels["second"], shown.second.image, "Second vehicle, next day: camera alone", _SECOND)
    _draw_errors(panels["errors"], shown)
    _draw_legend(figure)
    save_figure(figure, picture)


def _read(folder: Path) -> _Demonstration:
    survey = _read_vehicle(folder, "survey")
    content = open_package(folder / "my_map").localization_map()
    fixes = open_drive(folder / "survey.mcap").gnss_fixes()
    lat_deg, lon_deg, height_m = np.array([(fix.lat_deg, fix.lon_deg, fix.height_m) for fix in fixes]).T
    return _Demonstration(
        survey=survey,
        second=_read_vehicle(folder, "second"),
        fixes_m=UtmGrid(survey.truth.epsg).from_geodetic(lat_deg, lon_deg, height_m),
        spline=evaluate_gnss_spline(fixes, survey.truth),
        landmarks_m=content.anchor.utm_from_map(content.landmarks.points_m),
    )


def _read_vehicle(folder: Path, name: str) -> _Vehicle:
    poses = read_trajectory(folder / f"{name}.tum")
    truth = read_trajectory(folder / f"{name}.reference.tum")
    frames = open_drive(folder / f"{name}.mcap").frames()
    image = next(islice(frames, len(truth) // 2, None)).image
    return _Vehicle(poses, truth, evaluate_trajectory(poses, truth), image)


@dataclass(frozen=True)
class _Sheet:
    """Seen from above and turned so that the street runs from left to right."""

    centre_m: Array  # (2,) easting, northing
    sheet_from_grid: Array  # (2, 2) rotation

    @staticmethod
    def along(positions_m: Array) -> _Sheet:
        """The sheet of a drive (N, 3): its longest extent lies level, its end to the right."""
        centre_m = positions_m[:, :2].mean(axis=0)
        x, y = np.linalg.svd(positions_m[:, :2] - centre_m, full_matrices=False)[2][0]
        turn = np.array([[x, y], [-y, x]]) * np.sign((positions_m[-1] - positions_m[0])[:2] @ (x, y))
        return _Sheet(centre_m, turn)

    def of(self, points_in_utm: Array) -> Array:
        """Places (2, N) on the sheet, in metres."""
        return np.asarray(self.sheet_from_grid @ (points_in_utm[:, :2] - self.centre_m).T)


def _draw_from_above(axes: Any, shown: _Demonstration, sheet: _Sheet) -> None:
    drives_m = np.vstack([shown.survey.truth.positions_m, shown.second.truth.positions_m])
    near = cKDTree(drives_m[:, :2]).query(shown.landmarks_m[:, :2])[0] <= SHOWN_BESIDE_M
    axes.plot(
        *sheet.of(shown.landmarks_m[near]), ".", color=_LANDMARK, alpha=0.6, markersize=2.4, markeredgewidth=0
    )
    _draw_drives(axes, shown, sheet, line_width=1.2)
    (east, north), size_m = shown.survey.truth.positions_m[0, :2], CLOSE_UP_M
    x, y = sheet.of(_worst_place_m(shown))[:, 0] - size_m / 2
    axes.add_patch(Rectangle((x, y), size_m, size_m, fill=False, linewidth=1.2, zorder=6))
    _without_ticks(axes).set_aspect("equal", adjustable="datalim")
    axes.set_title(
        f"The street from above, starting at {east:.1f} E, {north:.1f} N (EPSG:{shown.survey.truth.epsg})",
        loc="left",
    )
    axes.add_artist(AnchoredSizeBar(axes.transData, 20.0, "20 m", "lower right", frameon=False, size_vertical=0.6))
    axes.annotate(
        "N",
        (0.05, 0.15),
        xycoords="axes fraction",
        xytext=36.0 * sheet.sheet_from_grid[:, 1],
        textcoords="offset points",
        ha="center",
        va="center",
        arrowprops={"arrowstyle": "<-"},
    )


def _draw_close_up(axes: Any, shown: _Demonstration, sheet: _Sheet) -> None:
    """A few metres around the largest error of the spline."""
    _draw_drives(axes, shown, sheet, line_width=2.0)
    (x, y), half_m = sheet.of(_worst_place_m(shown))[:, 0], CLOSE_UP_M / 2
    _without_ticks(axes).set(xlim=(x - half_m, x + half_m), ylim=(y - half_m, y + half_m), aspect="equal")
    axes.set_title(f"The square, {CLOSE_UP_M:.0f} m wide", loc="left")


def _worst_place_m(shown: _Demonstration) -> Array:
    """Where (1, 3) the spline through the fixes errs most."""
    return shown.spline.true_positions_m[[int(np.argmax(shown.spline.distances_m))]]


def _draw_drives(axes: Any, shown: _Demonstration, sheet: _Sheet, line_width: float) -> None:
    def draw(positions_m: Array, style: str, colour: str, width: float, **look: Any) -> None:
        size = width * line_width
        axes.plot(*sheet.of(positions_m), style, color=colour, linewidth=size, markersize=size, **look)

    draw(shown.survey.poses.positions_m, "-", _SURVEY, 3.0)
    draw(shown.second.poses.positions_m, ".", _SECOND, 5.0)
    for vehicle in (shown.survey, shown.second):
        draw(vehicle.truth.positions_m, "-", "black", 0.5)
    draw(shown.spline.positions_m, "--", _GNSS, 1.3)
    draw(shown.fixes_m, "o", _GNSS, 6.0, markeredgecolor="black", markeredgewidth=0.6, zorder=5)


def _draw_legend(figure: Any) -> None:
    entries = [
        Line2D([], [], color=_SURVEY, linewidth=4, label="survey vehicle, mapped"),
        Line2D([], [], color=_SECOND, linestyle="", marker=".", label="second vehicle, localised"),
        Line2D([], [], color="black", linewidth=0.8, label="truth of both"),
        Line2D(
            [],
            [],
            color=_GNSS,
            linestyle="",
            marker="o",
            markeredgecolor="black",
            label="GNSS fixes of the survey",
        ),
        Line2D([], [], color=_GNSS, linestyle="--", label="spline through the fixes"),
        Line2D([], [], color=_LANDMARK, linestyle="", marker=".", markersize=4, label="landmarks of the map"),
    ]
    figure.legend(handles=entries, loc="outside upper center", ncols=len(entries), frameon=False)


def _without_ticks(axes: Any) -> Any:
    axes.set_xticks([])
    axes.set_yticks([])
    return axes


def _draw_image(axes: Any, image: NDArray[np.uint8], title: str, colour: str) -> None:
    _without_ticks(axes).imshow(image, cmap="gray", vmin=0, vmax=255)
    axes.set_title(title, loc="left", color=colour)


def _draw_errors(axes: Any, shown: _Demonstration) -> None:
    """Distance from the truth over the way driven."""
    rows = (
        (shown.spline, ":", _GNSS, "GNSS spline"),
        (shown.survey.errors, "-", _SURVEY, "map"),
        (shown.second.errors, "-", _SECOND, "second vehicle"),
    )
    for errors, style, colour, name in rows:
        steps_m = np.linalg.norm(np.diff(errors.true_positions_m, axis=0), axis=1)
        driven_m = np.concatenate([[0.0], np.cumsum(steps_m)])
        label = f"{name}: mean {errors.position_m.mean:.3f} m"
        axes.plot(driven_m, errors.distances_m, style, color=colour, label=label, linewidth=1.6)
    axes.set_xlabel("way driven (m)")
    axes.set_ylabel("distance from the truth (m)")
    axes.set_ylim(bottom=0.0)
    axes.grid(alpha=0.25)
    axes.legend()
