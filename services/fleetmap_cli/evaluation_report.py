"""The tables and lines of ``fleetmap evaluate``."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from fleetmap.evaluation import ErrorStatistics, Judgement, Nees, TrajectoryErrors, WindowErrors
from fleetmap.yardstick import compare_with_yardstick

_TITLES = {
    "reference": "against the reference",
    "compare": "of the compared trajectory against the reference",
    "against_map": "relative to the map's trajectory",
}
_ROWS = ("max", "mean", "median", "min", "rmse", "sse", "std", "p95")

_YARDSTICKS = {
    "spline": ("spline", "cubic through the GNSS fixes alone, antenna taken as the camera, never aligned"),
    "smoothing_spline": ("smooth", "smoothing spline through the GNSS fixes alone, lever arm off, never aligned"),
}


def report(judged: Mapping[str, Judgement]) -> Iterator[list[str]]:
    """The lines of each printed table; the yardsticks' columns stand beside the reference's."""
    for name in ("reference", "compare", "against_map"):
        if name not in judged:
            continue
        columns = _columns("", judged[name].errors)
        lines = [*_remarks(judged[name])]
        if name == "reference":
            for yardstick in (key for key in _YARDSTICKS if key in judged):
                columns |= _columns(f"{_YARDSTICKS[yardstick][0]} ", judged[yardstick].errors)
                lines += _yardstick_remarks(judged[yardstick], *_YARDSTICKS[yardstick])
        if name != "against_map" and "smoothing_spline" in judged:
            lines += _verdict(judged[name].errors, judged["smoothing_spline"].errors)
        yield [f"Position error {_TITLES[name]} (m; sse in m^2)", *_table(columns), *lines]


def _columns(prefix: str, errors: TrajectoryErrors) -> dict[str, ErrorStatistics]:
    return {f"{prefix}3-D": errors.position_m, f"{prefix}horizontal": errors.horizontal_m}


def _table(columns: dict[str, ErrorStatistics]) -> Iterator[str]:
    yield f"  {'':8}" + "".join(f"{name:>19}" for name in columns)
    for row in _ROWS:
        yield f"  {row:8}" + "".join(f"{getattr(column, row):>19.4f}" for column in columns.values())


def _remarks(judgement: Judgement) -> Iterator[str]:
    errors = judgement.errors
    yield f"  {_coverage(errors)}"
    yield f"  more than 2 m off: {errors.over_2m}"
    if errors.scale is not None:
        yield f"  aligned first, scale {errors.scale:.6f}"
    if errors.rotation is not None:
        yield f"  rotation error (deg): {_triple(errors.rotation.angles_deg)}"
        yield (
            f"  of it constant {errors.rotation.offset_deg:.3f}; left about that: "
            f"{_triple(errors.rotation.spread_deg)}"
        )
    yield f"  {_windows(judgement.windows)}"
    if judgement.consistency is not None:
        yield f"  NEES of {len(judgement.consistency.rows)} poses: {_nees(judgement.consistency.pose)}"
        yield f"  NEES of their positions: {_nees(judgement.consistency.position)}"
    yield from _intervals(judgement)


def _yardstick_remarks(judgement: Judgement, name: str, described: str) -> Iterator[str]:
    yield f"  {name}: {described}"
    yield f"  {name} {_coverage(judgement.errors)}"
    yield f"  {name} {_windows(judgement.windows)}"
    for label, text in _interval_texts(judgement):
        if label.startswith("3-D"):
            yield f"  {name} {label}, 95 % intervals: {text}"


def _verdict(errors: TrajectoryErrors, yardstick: TrajectoryErrors) -> Iterator[str]:
    comparison = compare_with_yardstick(errors, yardstick) if errors.scale is None else None
    if comparison is None:
        return
    spread = "" if comparison.interval is None else f" (95 %: {_range(comparison.interval, signed=True)})"
    verdict = "better than GNSS alone" if comparison.better else "NOT better than GNSS alone, so it proves nothing"
    yield (
        f"  beside smooth, over {comparison.common} poses that both have: mean {comparison.mean_m:.4f} against "
        f"{comparison.yardstick_mean_m:.4f} m, difference {comparison.difference_m:+.4f}{spread}: {verdict}"
    )


def _coverage(errors: TrajectoryErrors) -> str:
    return f"coverage: {errors.matched} of {errors.comparable} poses compared ({100.0 * errors.coverage:.1f} %)"


def _windows(windows: WindowErrors) -> str:
    size = f"{windows.window_m:g} m"
    if windows.count == 0 and windows.left_out == 0:
        return f"windows of {size}: none fits, the compared poses span {windows.length_m:.1f} m of road"
    if windows.count == 0:
        return f"windows of {size}: none of {windows.left_out} has poses enough, and moving ones, to be aligned"
    left_out = f", {windows.left_out} left out" if windows.left_out else ""
    return (
        f"windows of {size}, each with a Sim(3) of its own: {windows.count}{left_out}; RMSE mean "
        f"{windows.rmse_m.mean():.4f}, max {windows.rmse_m.max():.4f} m; scale {windows.scales.min():.4f} to "
        f"{windows.scales.max():.4f}, ratio {windows.scales.max() / windows.scales.min():.4f}, std of its "
        f"logarithm {np.log(windows.scales).std():.4f}"
    )


def _nees(nees: Nees) -> str:
    return (
        f"mean {nees.mean:.3f} (consistent: {nees.dof}; {_range(nees.band_95)} were errors independent), "
        f"{100.0 * nees.inside_95:.1f} % inside their 95 % ellipsoid"
    )


def _intervals(judgement: Judgement) -> Iterator[str]:
    if judgement.segments < 2:
        yield f"  no intervals: {judgement.segment_m:.1f} m of road are one segment only, and it takes two"
        return
    yield f"  95 % intervals, bootstrapped over {judgement.segments} segments of {judgement.segment_m:.1f} m:"
    for label, text in _interval_texts(judgement):
        yield f"    {label}: {text}"


def _interval_texts(judgement: Judgement) -> Iterator[tuple[str, str]]:
    labels = {
        "position_m": "3-D (m)",
        "horizontal_m": "horizontal (m)",
        "rotation_deg": "rotation (deg)",
        "rotation_spread_deg": "rotation about its constant (deg)",
        "windows": "windows (m)",
        "nees": "NEES",
    }
    for group, members in judgement.intervals.items():
        known = {name: interval for name, interval in members.items() if interval is not None}
        if known:
            texts = [f"{name.replace('_', ' ').removesuffix(' m')} {_range(known[name])}" for name in known]
            yield labels[group], ", ".join(texts)
    if judgement.coverage_interval is not None:
        low, high = judgement.coverage_interval
        yield "coverage (%)", f"{100.0 * low:.1f} to {100.0 * high:.1f}"


def _range(interval: tuple[float, float], signed: bool = False) -> str:
    return " to ".join(f"{end:+.4f}" if signed else f"{end:.4f}" for end in interval)


def _triple(angles_deg: NDArray[np.float64]) -> str:
    statistics = ErrorStatistics.of(angles_deg)
    return f"median {statistics.median:.3f}, mean {statistics.mean:.3f}, max {statistics.max:.3f}"
