"""``fleetmap evaluate``: judge a trajectory against a reference or against the map it was localised in."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import click
import numpy as np

from fleetmap.evaluation import (
    Alignment,
    ErrorStatistics,
    TrajectoryErrors,
    evaluate_against_map,
    evaluate_trajectory,
)
from fleetmap.trajectory import Trajectory, read_trajectory
from fleetmap_cli.options import XYZ

ROWS = ("max", "mean", "median", "min", "rmse", "sse", "std", "p95")

_FILE = click.Path(path_type=Path)


@dataclass(frozen=True)
class _Inputs:
    """The trajectories that the command line names."""

    estimate: Trajectory
    reference: Trajectory | None
    survey: Trajectory | None


@click.command()
@click.argument("estimate", type=_FILE, metavar="ESTIMATE.tum")
@click.argument("reference", type=_FILE, required=False, metavar="[REFERENCE.tum]")
@click.option(
    "--against-map",
    type=_FILE,
    metavar="SURVEY.tum",
    help="Also judge the estimate relative to the trajectory of the map it was localised in.",
)
@click.option(
    "--camera-offset",
    type=XYZ,
    help="Centre of the estimate's camera in the survey camera's frame (x right, y down, z forward), in metres; "
    "for two cameras of one vehicle.  [default: 0,0,0]",
)
@click.option(
    "--align",
    type=click.Choice(["none", "se3", "sim3"]),
    default="none",
    show_default=True,
    help="Move the estimate onto the reference before comparing: se3 without, sim3 with a scale.",
)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object instead of tables.")
@click.option("--plot", type=_FILE, metavar="OUT.png", help="Draw the trajectories and the error along the way.")
@click.option(
    "--spline-through",
    type=_FILE,
    metavar="RECORDING.mcap",
    help="Print beside the reference errors what a cubic spline through this recording's GNSS fixes alone would "
    "give: the yardstick a map has to beat.",
)
def evaluate(
    estimate: Path,
    reference: Path | None,
    against_map: Path | None,
    camera_offset: tuple[float, float, float] | None,
    align: str,
    as_json: bool,
    plot: Path | None,
    spline_through: Path | None,
) -> None:
    """Judge ESTIMATE.tum against REFERENCE.tum, or --against-map, or both.

    Poses are matched by nearest stamps within 5 ms. Tables show maximum, mean, median, minimum, RMSE, SSE and
    standard deviation of the absolute position error in 3-D and horizontally, the rotation error, and how many
    poses could be compared.

    \b
    Examples:
      fleetmap evaluate survey.tum survey.reference.tum
      fleetmap evaluate second.tum --against-map survey.tum --camera-offset 0.54,0,0 --plot second.png

    With --json: {"reference": {...}, "against_map": {...}, "spline": {...}}, only those asked for, each with
    position_m, horizontal_m, rotation_deg, rotation_spread_deg (each max, mean, median, min, rmse, sse, std,
    p95), rotation_offset_deg, matched, comparable, coverage, over_2m and scale.
    """
    _require_sensible_options(reference, against_map, camera_offset, align, spline_through)
    if plot is not None:
        _require_drawable(plot)
    inputs = _Inputs(
        estimate=read_trajectory(estimate),
        reference=read_trajectory(reference) if reference else None,
        survey=read_trajectory(against_map) if against_map else None,
    )
    errors = _judge(inputs, cast(Alignment, align), camera_offset or (0.0, 0.0, 0.0), spline_through)
    if plot is not None:
        _draw(plot, inputs, errors)
    if as_json:
        figures = {name: entry.to_json() for name, entry in errors.items()}
        click.echo(json.dumps(figures, allow_nan=False, indent=1))
    else:
        click.echo("\n\n".join("\n".join(lines) for lines in _report(errors)))


def _judge(
    inputs: _Inputs, align: Alignment, camera_offset: tuple[float, float, float], spline_through: Path | None
) -> dict[str, TrajectoryErrors]:
    """The errors asked for, under the keys that --json documents."""
    errors: dict[str, TrajectoryErrors] = {}
    if inputs.reference is not None:
        errors["reference"] = evaluate_trajectory(inputs.estimate, inputs.reference, align=align)
        if spline_through is not None:
            errors["spline"] = _judge_spline(spline_through, inputs.reference)
    if inputs.survey is not None:
        errors["against_map"] = evaluate_against_map(inputs.estimate, inputs.survey, np.array(camera_offset))
    return errors


def _require_sensible_options(
    reference: Path | None,
    against_map: Path | None,
    camera_offset: tuple[float, float, float] | None,
    align: str,
    spline_through: Path | None,
) -> None:
    """Refuse combinations in which an option would silently do nothing."""
    if reference is None and against_map is None:
        raise click.UsageError("nothing to judge against: give REFERENCE.tum, --against-map SURVEY.tum, or both")
    if camera_offset is not None and against_map is None:
        raise click.UsageError("--camera-offset belongs to --against-map SURVEY.tum, which is not given")
    if reference is None and align != "none":
        raise click.UsageError(f"--align {align} needs REFERENCE.tum to align with")
    if reference is None and spline_through is not None:
        raise click.UsageError("--spline-through needs REFERENCE.tum to judge the spline against")


def _judge_spline(recording: Path, reference: Trajectory) -> TrajectoryErrors:
    from fleetmap.drives import open_drive
    from fleetmap.yardstick import evaluate_gnss_spline

    with _needing("--spline-through", "recordings"):
        fixes = open_drive(recording).gnss_fixes()
    return evaluate_gnss_spline(fixes, reference)


def _require_drawable(plot: Path) -> None:
    with _needing("--plot", "all"):
        from fleetmap_cli.plotting import require_picture_name
    require_picture_name(plot)


def _draw(plot: Path, inputs: _Inputs, errors: dict[str, TrajectoryErrors]) -> None:
    from fleetmap_cli.plotting import Track, plot_evaluation

    aligned = "reference" in errors and errors["reference"].scale is not None
    estimate_m = errors["reference"].positions_m if aligned else inputs.estimate.positions_m
    tracks = [Track("estimate, aligned" if aligned else "estimate", estimate_m, "C0.-")]
    if inputs.survey is not None:
        tracks.append(Track("trajectory of the map", inputs.survey.positions_m, "C2-"))
    if "spline" in errors:
        tracks.append(Track("GNSS spline", errors["spline"].positions_m, "C1-"))
    if inputs.reference is not None:
        tracks.append(Track("reference", inputs.reference.positions_m, "k--"))
    plot_evaluation(plot, tracks, {_TITLES[name]: entry for name, entry in errors.items()})


@contextmanager
def _needing(option: str, extra: str) -> Iterator[None]:
    """Name the extra to install when a package is missing that only one option needs."""
    try:
        yield
    except ModuleNotFoundError as error:
        raise click.ClickException(
            f"{option} needs the package '{error.name}': pip install 'fleetmap[{extra}]'"
        ) from error


_TITLES = {
    "reference": "against the reference",
    "spline": "GNSS spline against the reference",
    "against_map": "relative to the map's trajectory",
}


def _report(errors: dict[str, TrajectoryErrors]) -> Iterator[list[str]]:
    """The lines of each printed table; the yardstick's columns stand beside the reference's."""
    for name in ("reference", "against_map"):
        if name not in errors:
            continue
        columns, yardstick = _columns("", errors[name]), []
        if name == "reference" and "spline" in errors:
            columns |= _columns("spline ", errors["spline"])
            yardstick = [
                "  spline: cubic through the GNSS fixes alone, antenna taken as the camera, never aligned",
                f"  spline {_coverage(errors['spline'])}",
            ]
        heading = f"Position error {_TITLES[name]} (m; sse in m^2)"
        yield [heading, *_table(columns), *_remarks(errors[name]), *yardstick]


def _columns(prefix: str, errors: TrajectoryErrors) -> dict[str, ErrorStatistics]:
    return {f"{prefix}3-D": errors.position_m, f"{prefix}horizontal": errors.horizontal_m}


def _table(columns: dict[str, ErrorStatistics]) -> Iterator[str]:
    yield f"  {'':8}" + "".join(f"{name:>19}" for name in columns)
    for row in ROWS:
        yield f"  {row:8}" + "".join(f"{getattr(column, row):>19.4f}" for column in columns.values())


def _remarks(errors: TrajectoryErrors) -> Iterator[str]:
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


def _coverage(errors: TrajectoryErrors) -> str:
    return f"coverage: {errors.matched} of {errors.comparable} poses compared ({100.0 * errors.coverage:.1f} %)"


def _triple(angles_deg: np.ndarray) -> str:
    statistics = ErrorStatistics.of(angles_deg)
    return f"median {statistics.median:.3f}, mean {statistics.mean:.3f}, max {statistics.max:.3f}"
