"""Pictures for people. Agg canvases only: no window system, no state shared between figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from fleetmap.errors import InputError
from fleetmap.evaluation import TrajectoryErrors
from fleetmap.files import atomic_path

Array = NDArray[np.float64]

PICTURE_FORMATS = ("png", "pdf", "svg")


@dataclass(frozen=True)
class Track:
    """One list of positions to be drawn from above."""

    name: str
    positions_m: Array  # (N, 3) or (N, 2) float64 easting, northing
    style: str = "-"  # matplotlib's line format, such as "k--" or "."


def plot_evaluation(path: Path, tracks: Sequence[Track], errors: Mapping[str, TrajectoryErrors]) -> None:
    """Trajectories from above on the left, position errors along the way on the right.

    Raises:
        InputError: the file name's ending is no picture format.
        StorageError: the picture cannot be written.
    """
    require_picture_name(path)
    figure = new_figure(width_in=13.0, height_in=6.0)
    from_above, along = figure.subplots(1, 2)
    draw_from_above(from_above, tracks)
    draw_errors(along, errors)
    save_figure(figure, path)


def new_figure(width_in: float, height_in: float) -> Figure:
    """An empty figure on an Agg canvas."""
    figure = Figure(figsize=(width_in, height_in), dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def draw_from_above(axes: Any, tracks: Sequence[Track]) -> None:
    """Easting to the right, northing up, one scale for both; axes count from a round corner of the grid."""
    corner_m = _round_corner([track.positions_m for track in tracks])
    for track in tracks:
        easting_m, northing_m = (track.positions_m[:, :2] - corner_m).T
        axes.plot(easting_m, northing_m, track.style, label=track.name, linewidth=1.2, markersize=3)
    axes.set_xlabel(f"easting - {corner_m[0]:.0f} (m)")
    axes.set_ylabel(f"northing - {corner_m[1]:.0f} (m)")
    axes.set_aspect("equal", adjustable="datalim")
    axes.grid(alpha=0.3)
    axes.legend()


def draw_errors(axes: Any, errors: Mapping[str, TrajectoryErrors]) -> None:
    """Position error over time since the earliest compared pose, one line for each entry."""
    start_ns = min(int(entry.stamps_ns[0]) for entry in errors.values())
    for name, entry in errors.items():
        axes.plot(
            (entry.stamps_ns - start_ns) / 1e9, entry.distances_m, ".-", label=name, linewidth=0.8, markersize=3
        )
    axes.set_xlabel("time since the first compared pose (s)")
    axes.set_ylabel("position error (m)")
    axes.set_ylim(bottom=0.0)
    axes.grid(alpha=0.3)
    axes.legend()


def require_picture_name(path: Path) -> None:
    """Raise InputError unless the name ends like a picture that can be written."""
    if path.suffix.lower().lstrip(".") not in PICTURE_FORMATS:
        raise InputError(f"cannot draw {path}: the name must end in .{', .'.join(PICTURE_FORMATS)}")


def save_figure(figure: Figure, path: Path) -> None:
    """Write the picture whole or not at all."""
    with atomic_path(path) as draft:
        figure.savefig(draft, format=path.suffix.lower().lstrip("."))


def _round_corner(positions_m: Sequence[Array]) -> Array:
    """Lower left corner (2,) of all positions, rounded down to 100 m."""
    corners = [positions[:, :2].min(axis=0) for positions in positions_m if len(positions)]
    return np.asarray(np.floor(np.min(corners, axis=0) / 100.0) * 100.0)
