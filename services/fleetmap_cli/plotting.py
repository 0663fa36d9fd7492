"""Pictures for people. Agg canvases only: no window system, no state shared between figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from fleetmap.errors import InputError
from fleetmap.evaluation import Judgement
from fleetmap.files import atomic_path

Array = NDArray[np.float64]

PICTURE_FORMATS = ("png", "pdf", "svg")
SHOWN_BESIDE_M = 30.0


@dataclass(frozen=True)
class Track:
    """One list of positions to be drawn from above."""

    name: str
    positions_m: Array  # (N, 3) or (N, 2) float64 easting, northing
    style: str = "-"  # matplotlib's line format, such as "k--" or "."


@dataclass(frozen=True)
class ErrorLine:
    """One trajectory's errors, to be drawn along the road."""

    name: str
    judgement: Judgement
    colour: str


def plot_evaluation(
    path: Path,
    tracks: Sequence[Track],
    lines: Sequence[ErrorLine],
    landmarks_m: Array | None = None,
) -> None:
    """Trajectories and landmarks (N, 3) from above; beside them, along the road, the errors and the windows.

    Raises:
        InputError: the file name's ending is no picture format.
        StorageError: the picture cannot be written.
    """
    require_picture_name(path)
    figure = new_figure(width_in=13.0, height_in=6.0)
    windowed = any(line.judgement.windows.count for line in lines)
    rows = ["errors", "residuals", "scales"] if windowed else ["errors"]
    panels = figure.subplot_mosaic([["above", row] for row in rows], height_ratios=[2.0, 1.0, 1.0][: len(rows)])
    draw_from_above(panels["above"], tracks, landmarks_m)
    draw_errors(panels["errors"], lines)
    if windowed:
        draw_windows(panels["residuals"], panels["scales"], lines)
        for name in rows[1:]:
            panels[name].sharex(panels["errors"])
        for name in rows[:-1]:
            panels[name].tick_params(labelbottom=False)
    panels[rows[-1]].set_xlabel("way driven along the reference (m)")
    save_figure(figure, path)


@dataclass(frozen=True)
class Sheet:
    """One drive as several runs of it saw it."""

    title: str
    tracks: Sequence[Track]
    lines: Sequence[ErrorLine]


def plot_sheets(path: Path, sheets: Sequence[Sheet]) -> None:
    """A column a drive: the trajectories from above, and below, on a scale of powers, their errors along the road.

    Raises:
        InputError: the file name's ending is no picture format.
        StorageError: the picture cannot be written.
    """
    require_picture_name(path)
    figure = new_figure(width_in=6.0 * len(sheets), height_in=9.0)
    axes = figure.subplots(2, len(sheets), squeeze=False, height_ratios=[1.2, 1.0])
    for (above, errors), sheet in zip(axes.T, sheets, strict=True):
        draw_from_above(above, sheet.tracks)
        above.set_title(sheet.title)
        draw_errors(errors, sheet.lines)
        smallest_m = min(float(line.judgement.errors.distances_m.min()) for line in sheet.lines)
        errors.set_ylim(bottom=max(smallest_m, 1e-3))
        errors.set_yscale("log")
        errors.set_xlabel("way driven along the reference (m)")
    save_figure(figure, path)


def new_figure(width_in: float, height_in: float) -> Figure:
    """An empty figure on an Agg canvas."""
    figure = Figure(figsize=(width_in, height_in), dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def draw_from_above(axes: Any, tracks: Sequence[Track], landmarks_m: Array | None = None) -> None:
    """Easting to the right, northing up, one scale for both; axes count from a round corner of the grid."""
    corner_m = _round_corner([track.positions_m for track in tracks])
    if landmarks_m is not None:
        points_m = _beside(landmarks_m, tracks)[:, :2] - corner_m
        look = {"color": "0.55", "markersize": 2.2, "markeredgewidth": 0, "zorder": 0}
        axes.plot(*points_m.T, ".", label="landmarks", **look)
    for track in tracks:
        easting_m, northing_m = (track.positions_m[:, :2] - corner_m).T
        axes.plot(easting_m, northing_m, track.style, label=track.name, linewidth=1.2, markersize=3)
    axes.set_xlabel(f"easting - {corner_m[0]:.0f} (m)")
    axes.set_ylabel(f"northing - {corner_m[1]:.0f} (m)")
    axes.set_aspect("equal", adjustable="datalim")
    axes.grid(alpha=0.3)
    axes.legend()


def draw_errors(axes: Any, lines: Sequence[ErrorLine]) -> None:
    """Position error along the road, one line for each entry."""
    for line in lines:
        errors = line.judgement.errors
        label = f"{line.name}: mean {errors.position_m.mean:.3f} m"
        look = {"color": line.colour, "linewidth": 0.8, "markersize": 3}
        axes.plot(errors.driven_m, errors.distances_m, ".-", label=label, **look)
    axes.set_ylabel("position error (m)")
    axes.set_ylim(bottom=0.0)
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small")


def draw_windows(residuals: Any, scales: Any, lines: Sequence[ErrorLine]) -> None:
    """RMSE and scale of each window at its middle, in the colours of draw_errors."""
    window_m = lines[0].judgement.windows.window_m
    for line in lines:
        windows = line.judgement.windows
        residuals.plot(windows.centres_m, windows.rmse_m, color=line.colour, linewidth=1.2)
        scales.plot(windows.centres_m, windows.scales, color=line.colour, linewidth=1.2)
    residuals.set_ylabel("RMSE (m)")
    residuals.set_title(f"windows of {window_m:g} m, each aligned by a Sim(3) of its own", fontsize="small")
    residuals.set_ylim(bottom=0.0)
    scales.set_ylabel("scale")
    scales.ticklabel_format(useOffset=False)
    for axes in (residuals, scales):
        axes.grid(alpha=0.3)


def require_picture_name(path: Path) -> None:
    """Raise InputError unless the name ends like a picture that can be written."""
    if path.suffix.lower().lstrip(".") not in PICTURE_FORMATS:
        raise InputError(f"cannot draw {path}: the name must end in .{', .'.join(PICTURE_FORMATS)}")


def save_figure(figure: Figure, path: Path) -> None:
    """Write the picture whole or not at all."""
    with atomic_path(path) as draft:
        figure.savefig(draft, format=path.suffix.lower().lstrip("."))


def _beside(points_m: Array, tracks: Sequence[Track]) -> Array:
    """Those of the points (N, 3) that would not widen the picture of the tracks much: single ones lie far away."""
    ends_m = np.vstack([track.positions_m[:, :2] for track in tracks])
    low_m, high_m = ends_m.min(axis=0) - SHOWN_BESIDE_M, ends_m.max(axis=0) + SHOWN_BESIDE_M
    inside = np.all((points_m[:, :2] >= low_m) & (points_m[:, :2] <= high_m), axis=1)
    return points_m[inside]


def _round_corner(positions_m: Sequence[Array]) -> Array:
    """Lower left corner (2,) of all positions, rounded down to 100 m."""
    corners = [positions[:, :2].min(axis=0) for positions in positions_m if len(positions)]
    return np.asarray(np.floor(np.min(corners, axis=0) / 100.0) * 100.0)
