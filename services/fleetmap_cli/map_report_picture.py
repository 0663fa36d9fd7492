"""The picture of a map's quality: the road from above, and beside it the figures along the road."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap, LogNorm
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter
from mpl_toolkits.axes_grid1.anchored_artists import AnchoredSizeBar
from numpy.typing import NDArray

from fleetmap_cli.map_report import MapReport
from fleetmap_cli.plotting import SHOWN_BESIDE_M, new_figure, save_figure

Array = NDArray[np.float64]
_WEAK, _GOOD, _LINE, _SECOND, _LANDMARK = "#d7301f", "#1b7837", "#1f5fbf", "#e08214", "#b4b8be"
_SIGMA_COLOURS = LinearSegmentedColormap.from_list("sigma", ["#2166ac", "#67a9cf", "#f1b54a", "#b2182b"])
_LEAST_SIGMA_M, _WEAK_SIGMA_M = 0.01, 1.0  # ends of the colours, the same for every map; the second as limits say
_STRETCHES_NAMED = 6
_HEADROOM = 1.25  # for a panel's legend
_ROUND_M = (5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10_000)


def draw_report(report: MapReport, path: Path) -> None:
    """Draw what is known of the map. Raises StorageError where the picture cannot be written."""
    figure = new_figure(width_in=16.0, height_in=9.0)
    names = list(_PANELS) if report.road is not None else ["nothing"]
    panels = figure.subplot_mosaic([["above", name] for name in names], width_ratios=[1.15, 1.0])
    _draw_from_above(panels["above"], report)
    if report.road is None:
        panels["nothing"].axis("off")
        panels["nothing"].text(0.5, 0.5, _wrapped(report.missing, 60), ha="center", fontsize="large")
    else:
        _draw_along_the_road(panels, report)
    remarks = _remarks(report)
    if remarks:
        figure.supxlabel(remarks, x=0.01, ha="left", fontsize="medium", linespacing=1.4)
    figure.suptitle(_title(report), color=_GOOD if report.manifest.quality.publishable else _WEAK, fontsize=15)
    save_figure(figure, path)


def _title(report: MapReport) -> str:
    quality = report.manifest.quality
    verdict = "fit to publish" if quality.publishable else "NOT fit to publish"
    parts = [f"{report.manifest.map_id}: {verdict}", f"{quality.length_m:.0f} m of road"]
    if quality.position_sigma_m is not None:
        parts.append(f"position uncertain by {quality.position_sigma_m:.2f} m")
    if quality.weak_length_m is not None:
        parts.append(f"{quality.weak_length_m:.0f} m weak" if quality.weak_stretches else "no weak stretch")
    return "   ·   ".join(parts)


def _remarks(report: MapReport) -> str:
    """What speaks against the map, and its first weak stretches with their reasons."""
    quality = report.manifest.quality
    found = [f"Warning: {warning}" for warning in quality.warnings]
    found += [f"Remark: {remark}" for remark in quality.remarks]
    for number, stretch in enumerate(quality.weak_stretches[:_STRETCHES_NAMED], start=1):
        reasons = "; ".join(reason.text for reason in stretch.reasons)
        found.append(f"Weak stretch {number}, {stretch.from_m:.0f} to {stretch.to_m:.0f} m: {reasons}")
    if len(quality.weak_stretches) > _STRETCHES_NAMED:
        found.append(f"and {len(quality.weak_stretches) - _STRETCHES_NAMED} more, listed in the page")
    return _wrapped(found, 200)


def _wrapped(texts: Sequence[str], width: int) -> str:
    return "\n".join(line for text in texts for line in textwrap.wrap(text, width))


# --- from above


def _draw_from_above(axes: Any, report: MapReport) -> None:
    positions_m = report.content.keyframes.positions_m
    along_m = _along_m(report)
    _draw_landmarks(axes, report.content.landmarks.points_m, positions_m)
    for number, stretch in enumerate(report.manifest.quality.weak_stretches, start=1):
        _draw_weak_stretch(axes, number, _between(positions_m, along_m, stretch.from_m, stretch.to_m))
    _draw_road(axes, report, positions_m)
    _draw_milestones(axes, positions_m, along_m)
    axes.plot(*positions_m[0, :2], "o", color="black", markersize=8, zorder=6)
    axes.plot(*positions_m[-1, :2], "s", color="black", markersize=8, zorder=6)
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.06)
    axes.set_xticks([])
    axes.set_yticks([])
    bar_m = _round_m(float(np.ptp(positions_m[:, :2], axis=0).max()) / 6.0)
    axes.add_artist(
        AnchoredSizeBar(
            axes.transData, bar_m, f"{bar_m} m", "lower right", frameon=False, size_vertical=bar_m / 60
        )
    )
    north = {"arrowstyle": "-|>", "color": "black"}
    axes.annotate("N", (0.03, 0.115), (0.03, 0.03), xycoords="axes fraction", ha="center", arrowprops=north)
    axes.legend(handles=_legend(report), loc="best", fontsize="small", framealpha=0.9)
    axes.set_title("The road from above", loc="left")


def _along_m(report: MapReport) -> Array:
    if report.road is not None:
        return report.road.keyframes.along_m
    steps_m = np.linalg.norm(np.diff(report.content.keyframes.positions_m, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps_m)])


def _draw_landmarks(axes: Any, points_m: Array, positions_m: Array) -> None:
    low_m, high_m = positions_m.min(axis=0) - SHOWN_BESIDE_M, positions_m.max(axis=0) + SHOWN_BESIDE_M
    near = np.all((points_m[:, :2] >= low_m[:2]) & (points_m[:, :2] <= high_m[:2]), axis=1)
    axes.plot(*points_m[near, :2].T, ".", color=_LANDMARK, markersize=1.6, markeredgewidth=0, zorder=0)


def _draw_road(axes: Any, report: MapReport, positions_m: Array) -> None:
    """Coloured by the position's sigma; grey where it is unknown, dotted where no image was posed."""
    pieces = np.stack([positions_m[:-1, :2], positions_m[1:, :2]], axis=1)
    is_driven = ~_is_gap(report)
    axes.plot(*positions_m[:, :2].T, color="0.35", linestyle=":", linewidth=1.5, zorder=3)
    axes.add_collection(LineCollection(list(pieces[is_driven]), color="0.35", linewidth=3.5, zorder=3))
    road = report.road
    if road is None or not np.isfinite(road.keyframes.horizontal_sigmas_m).any():
        return
    sigmas_m = road.keyframes.horizontal_sigmas_m
    between_m = np.maximum(sigmas_m[:-1], sigmas_m[1:])
    known = np.isfinite(between_m) & is_driven
    worst_m = max(report.limits.get("weak_position_sigma_m", _WEAK_SIGMA_M), 10.0 * _LEAST_SIGMA_M)
    coloured = LineCollection(
        list(pieces[known]), cmap=_SIGMA_COLOURS, norm=LogNorm(_LEAST_SIGMA_M, worst_m), linewidth=3.5, zorder=4
    )
    coloured.set_array(between_m[known].clip(_LEAST_SIGMA_M, worst_m))
    coloured.set_capstyle("round")
    axes.add_collection(coloured)
    bar = axes.figure.colorbar(
        coloured, ax=axes, location="left", shrink=0.7, aspect=40, pad=0.01, format=FuncFormatter(_metres)
    )
    bar.set_label("position uncertainty (m, horizontal, 1 sigma); the upper end is the limit")


def _is_gap(report: MapReport) -> NDArray[np.bool_]:
    """Which ways (K - 1,) from keyframe to keyframe hold a time without posed images."""
    along_m = _along_m(report)
    found = np.zeros(len(along_m) - 1, np.bool_)
    for from_m, to_m in () if report.road is None else report.road.gaps_m:
        found |= (along_m[:-1] <= from_m) & (along_m[1:] >= to_m)
    return found


def _draw_weak_stretch(axes: Any, number: int, places_m: Array) -> None:
    axes.plot(
        *places_m[:, :2].T, color=_WEAK, alpha=0.35, linewidth=15, solid_capstyle="round", zorder=2, marker="o",
        markersize=15, markeredgewidth=0,
    )  # fmt: skip
    axes.annotate(
        str(number),
        places_m[len(places_m) // 2, :2],
        (-20, 16),
        textcoords="offset points",
        color="white",
        fontweight="bold",
        ha="center",
        va="center",
        bbox={"boxstyle": "circle", "color": _WEAK},
        arrowprops={"arrowstyle": "-", "color": _WEAK},
        zorder=8,
    )


def _draw_milestones(axes: Any, positions_m: Array, along_m: Array) -> None:
    """Metres of way driven, to be found again in the figures beside."""
    apart_m = _round_m(float(along_m[-1]) / 6.0)
    for at_m in np.arange(apart_m, along_m[-1], apart_m):
        place_m = [np.interp(at_m, along_m, column) for column in positions_m[:, :2].T]
        axes.plot(*place_m, "o", color="white", markeredgecolor="black", markersize=5, zorder=5)
        axes.annotate(f"{at_m:.0f} m", place_m, (6, -11), textcoords="offset points", fontsize="small", zorder=7)


def _between(positions_m: Array, along_m: Array, from_m: float, to_m: float) -> Array:
    """The road from one place to another (n, 3)."""
    inside_m = along_m[(along_m > from_m) & (along_m < to_m)]
    places_m = np.concatenate([[from_m], inside_m, [to_m]])
    return np.stack([np.interp(places_m, along_m, column) for column in positions_m.T], axis=1)


def _legend(report: MapReport) -> list[Any]:
    entries: list[Any] = [
        Line2D([], [], marker="o", linestyle="", color="black", label="start"),
        Line2D([], [], marker="s", linestyle="", color="black", label="end"),
        Line2D([], [], marker=".", linestyle="", color=_LANDMARK, label="landmarks"),
    ]
    if report.road is None or not np.isfinite(report.road.keyframes.horizontal_sigmas_m).any():
        entries.append(Line2D([], [], color="0.35", linewidth=3.5, label="road, uncertainty unknown"))
    if report.manifest.quality.weak_stretches:
        entries.append(Patch(color=_WEAK, alpha=0.35, label="weak stretch"))
    return entries


# --- along the road


def _draw_along_the_road(panels: dict[str, Any], report: MapReport) -> None:
    for name, draw in _PANELS.items():
        axes = panels[name]
        draw(axes, report)
        axes.set_title(name, loc="left", fontsize="medium", pad=18 if name == next(iter(_PANELS)) else 5)
        axes.set_ylim(0.0, _HEADROOM * axes.get_ylim()[1])
        axes.grid(alpha=0.25)
        axes.sharex(panels[next(iter(_PANELS))])
        axes.tick_params(labelbottom=name == next(reversed(_PANELS)))
        for stretch in report.manifest.quality.weak_stretches:
            axes.axvspan(stretch.from_m, stretch.to_m, color=_WEAK, alpha=0.15, linewidth=0)
            axes.axvline((stretch.from_m + stretch.to_m) / 2.0, color=_WEAK, alpha=0.15, linewidth=2)
    first, last = panels[next(iter(_PANELS))], panels[next(reversed(_PANELS))]
    for number, stretch in enumerate(report.manifest.quality.weak_stretches, start=1):
        first.annotate(
            str(number),
            ((stretch.from_m + stretch.to_m) / 2.0, 1.0),
            (0, 5),
            xycoords=("data", "axes fraction"),
            textcoords="offset points",
            color=_WEAK,
            fontweight="bold",
            ha="center",
        )
    last.set_xlabel("way driven (m)")
    last.set_xlim(0.0, _road(report).length_m)


def _draw_position(axes: Any, report: MapReport) -> None:
    keyframes = _road(report).keyframes
    if not np.isfinite(keyframes.horizontal_sigmas_m).any():
        axes.text(0.5, 0.5, "unknown", transform=axes.transAxes, ha="center", color="0.4")
        return
    _draw_figure(axes, report, keyframes.horizontal_sigmas_m, _LINE, "horizontal")
    _draw_figure(axes, report, keyframes.vertical_sigmas_m, _SECOND, "height")
    _draw_limit(axes, report, "weak_position_sigma_m", keyframes.horizontal_sigmas_m)
    axes.legend(fontsize="small", loc="upper right", ncols=3)


def _draw_fixes(axes: Any, report: MapReport) -> None:
    fixes = _road(report).fixes
    horizontal_m = np.hypot(fixes.residuals_m[:, 0], fixes.residuals_m[:, 1])
    size = 5.0 if len(fixes) < 100 else 2.5
    axes.plot(fixes.along_m, horizontal_m, "o", color=_LINE, markersize=size, label="horizontal")
    axes.plot(fixes.along_m, np.abs(fixes.residuals_m[:, 2]), "^", color=_SECOND, markersize=size, label="height")
    limit = report.limits.get("weak_gnss_sigmas")
    if limit is not None and (far := fixes.sigmas > limit).any():
        look = {"color": _WEAK, "markerfacecolor": "none", "markersize": size + 4.0}
        axes.plot(fixes.along_m[far], horizontal_m[far], "o", label=f"beyond {limit:g} sigma", **look)
    if len(fixes):
        axes.legend(fontsize="small", loc="upper right", ncols=3)


def _draw_density(axes: Any, report: MapReport) -> None:
    road = _road(report)
    axes.stairs(road.landmarks_per_m, road.edges_m, fill=True, color=_LINE, alpha=0.6)
    _draw_limit(axes, report, "weak_landmarks_per_m", road.landmarks_per_m)


def _draw_seen(axes: Any, report: MapReport) -> None:
    keyframes = _road(report).keyframes
    _draw_figure(axes, report, keyframes.landmarks, _LINE)
    _draw_limit(axes, report, "weak_landmarks_per_image", keyframes.landmarks)


def _draw_reprojection(axes: Any, report: MapReport) -> None:
    keyframes = _road(report).keyframes
    _draw_figure(axes, report, keyframes.reprojection_rms_px, _LINE)
    _draw_limit(axes, report, "weak_reprojection_rms_px", keyframes.reprojection_rms_px)


def _draw_figure(
    axes: Any, report: MapReport, values: NDArray[Any], colour: str, label: str | None = None
) -> None:
    """A line through the values at the keyframes, broken where no image was posed."""
    along_m, gaps = _along_m(report), np.flatnonzero(_is_gap(report)) + 1
    broken = np.insert(values.astype(np.float64), gaps, np.nan)
    axes.plot(np.insert(along_m, gaps, along_m[gaps]), broken, color=colour, label=label)


def _draw_limit(axes: Any, report: MapReport, name: str, values: NDArray[Any]) -> None:
    """A dashed line, where it would not press the figures flat."""
    limit = report.limits.get(name)
    if limit is not None and limit < 4.0 * float(np.nanmax(values, initial=0.0)):
        axes.axhline(limit, color=_WEAK, linestyle="--", linewidth=1.0, label="limit")


def _road(report: MapReport) -> Any:
    return report.road


_PANELS = {
    "Position uncertainty (m, 1 sigma)": _draw_position,
    "Distance of the map from its GNSS fixes (m)": _draw_fixes,
    "Landmarks per metre of road": _draw_density,
    "Landmarks seen by a keyframe": _draw_seen,
    "Reprojection error (px, RMS of a keyframe)": _draw_reprojection,
}


def _round_m(wanted_m: float) -> int:
    """The largest round length that is not longer."""
    return max((length for length in _ROUND_M if length <= wanted_m), default=_ROUND_M[0])


def _metres(value: float, _: int) -> str:
    return f"{value:g}"
