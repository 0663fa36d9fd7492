"""``fleetmap evaluate``: judge a trajectory against a reference or against the map it was localised in."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import click
import numpy as np
from click.core import ParameterSource
from numpy.typing import NDArray

from fleetmap.covariances import PoseCovariances, read_covariances
from fleetmap.errors import InputError
from fleetmap.evaluation import Alignment, Judgement, evaluate_against_map, evaluate_trajectory, judge
from fleetmap.geometry import rotations_from_quat_xyzw
from fleetmap.trajectory import Trajectory, read_trajectory
from fleetmap_cli.evaluation_report import report
from fleetmap_cli.options import QUATERNION, XYZ

Array = NDArray[np.float64]

_FILE = click.Path(path_type=Path)
_UNIT_TOLERANCE = 1e-4
_OF_REFERENCE = ("align", "spline_through", "compare")  # options that do nothing without REFERENCE.tum
_OF_RECORDING = ("antenna_offset", "image_topic", "gnss_topic")  # ... without --spline-through


@dataclass(frozen=True)
class _Inputs:
    """What the command line names."""

    estimate: Trajectory
    reference: Trajectory | None
    survey: Trajectory | None
    compare: Trajectory | None
    covariances: PoseCovariances | None


@dataclass(frozen=True)
class _CameraPair:
    """How the estimate's camera sits in the frame of the survey's."""

    offset_m: Array  # (3,)
    survey_from_query: Array | None  # (3, 3) rotation


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
    "--camera-rotation",
    type=QUATERNION,
    help="Rotation of the estimate's camera in the survey camera's frame, as a unit quaternion, so that the "
    "rotation error holds no mounting.  [default: 0,0,0,1]",
)
@click.option(
    "--align",
    type=click.Choice(["none", "se3", "sim3"]),
    default="none",
    show_default=True,
    help="Move the estimate onto the reference before comparing: se3 without, sim3 with a scale.",
)
@click.option(
    "--window-m",
    type=click.FloatRange(min=0.0, min_open=True),
    default=50.0,
    show_default=True,
    help="Length of the windows to each of which a Sim(3) of its own is fitted.",
)
@click.option(
    "--covariances",
    type=_FILE,
    metavar="FILE.csv",
    help="Also judge the covariances of the estimate's poses, as written by 'fleetmap localize --covariances'.",
)
@click.option(
    "--spline-through",
    type=_FILE,
    metavar="RECORDING.mcap",
    help="Print beside the reference errors what this recording's GNSS fixes alone would give: the yardsticks "
    "that a map has to beat.",
)
@click.option(
    "--antenna-offset",
    type=XYZ,
    help="With --spline-through: antenna from the camera centre in metres: forward, left, up; used where the "
    "recording does not say.",
)
@click.option("--image-topic", metavar="TOPIC", help="With --spline-through: which camera, of several.")
@click.option("--gnss-topic", metavar="TOPIC", help="With --spline-through: which receiver, of several.")
@click.option(
    "--compare",
    type=_FILE,
    metavar="OTHER.tum",
    help="Judge, and draw, another trajectory of the same drive likewise, such as the map made without GNSS.",
)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object instead of tables.")
@click.option("--plot", type=_FILE, metavar="OUT.png", help="Draw the trajectories and the errors along the road.")
@click.option(
    "--landmarks", type=_FILE, metavar="MAP_FOLDER", help="With --plot: draw the landmarks of this map from above."
)
def evaluate(
    estimate: Path,
    reference: Path | None,
    against_map: Path | None,
    camera_offset: tuple[float, float, float] | None,
    camera_rotation: tuple[float, float, float, float] | None,
    align: str,
    window_m: float,
    covariances: Path | None,
    spline_through: Path | None,
    compare: Path | None,
    as_json: bool,
    plot: Path | None,
    landmarks: Path | None,
    **recording_options: Any,
) -> None:
    """Judge ESTIMATE.tum against REFERENCE.tum, or --against-map, or both.

    Poses are matched by nearest stamps within 5 ms. Tables show maximum, mean, median, minimum, RMSE, SSE and
    standard deviation of the absolute position error in 3-D and horizontally, the rotation error, and how many
    poses could be compared.

    Windows judge the shape without luck: to every 50 m of the road, starting at the first pose of every metre, a
    Sim(3) of its own is fitted; mean and maximum of their RMSE tell the local error, the ratio of the largest to
    the smallest scale tells the drift. A window must fit whole: a drive shorter than one has none.

    Intervals (95 %) are bootstrapped over segments of the road of 50 m (or a window, if that is longer) or more,
    as neighbouring errors are alike; a drive of less than two segments has none. Errors alike over longer ways,
    such as the slow bias of a consumer receiver, they do not see.

    Yardsticks (--spline-through): a cubic spline through the fixes, the antenna taken as the camera; and a
    smoothing spline that weighs the fixes by their covariance, with the lever arm taken off. A map that does not
    beat them owes nothing to its images.

    NEES (--covariances): of consistent poses its mean is 6 (3 for the position alone); above, the covariances
    promise too much. Against a map the constant rotation between the cameras is taken off first.

    Rotation is told whole, and in two parts: the constant one, which may be a mounting or a calibration, and the
    rest. A map whose camera was calibrated anew (map --refine-calibration) has turned that camera's axis with its
    image centre; --camera-rotation has to hold that turn as well.

    \b
    Examples:
      fleetmap evaluate survey.tum survey.reference.tum --spline-through survey.mcap
      fleetmap evaluate survey.tum survey.reference.tum --compare no_gnss.tum --plot survey.png --landmarks my_map
      fleetmap evaluate second.tum --against-map survey.tum --camera-offset 0.54,0,0 --covariances second.csv

    With --json: {"reference": {...}, "compare": {...}, "spline": {...}, "smoothing_spline": {...}, "against_map":
    {...}}, only those asked for. Each holds

    \b
      position_m, horizontal_m, rotation_deg, rotation_spread_deg
                  each {max, mean, median, min, rmse, sse, std, p95}; splines have no rotation
      rotation_offset_deg, matched, comparable, coverage, over_2m, scale
      windows     {window_m, count, left_out, mean_rmse_m, max_rmse_m, scale_min, scale_max, scale_ratio,
                  log_scale_std}, or null where none could be fitted
      intervals   {confidence, segments, segment_m, position_m, horizontal_m, rotation_deg, rotation_spread_deg:
                  {mean, median, rmse, p95}, windows: {mean_rmse_m}, nees: {pose_mean, position_mean}, coverage};
                  each figure [low, high], or null where there is only one segment
      nees        {count, pose, position: {dof, mean, inside_95, band_95}}, with --covariances
      yardstick   {common, mean_m, yardstick_mean_m, difference_m, interval, better}, with --spline-through and
                  no alignment: against the smoothing spline, over the poses that both have
    """
    _require_sensible_options(click.get_current_context())
    if plot is not None:
        _require_drawable(plot)
    inputs = _Inputs(
        estimate=read_trajectory(estimate),
        reference=read_trajectory(reference) if reference else None,
        survey=read_trajectory(against_map) if against_map else None,
        compare=read_trajectory(compare) if compare else None,
        covariances=read_covariances(covariances) if covariances else None,
    )
    pair = _CameraPair(np.array(camera_offset or (0.0, 0.0, 0.0)), _rotation(camera_rotation))
    judged = _judge(inputs, cast(Alignment, align), window_m, pair)
    if spline_through is not None and inputs.reference is not None:
        judged |= _judge_splines(spline_through, inputs.reference, window_m, recording_options)
    if plot is not None:
        _draw(plot, inputs, judged, landmarks)
    if as_json:
        click.echo(json.dumps(_figures(judged), allow_nan=False, indent=1))
    else:
        click.echo("\n\n".join("\n".join(lines) for lines in report(judged)))


def _judge(inputs: _Inputs, align: Alignment, window_m: float, pair: _CameraPair) -> dict[str, Judgement]:
    """The judgements asked for, under the keys that --json documents."""
    judged: dict[str, Judgement] = {}
    if inputs.reference is not None:
        errors = evaluate_trajectory(inputs.estimate, inputs.reference, align=align)
        judged["reference"] = judge(errors, window_m=window_m, covariances=inputs.covariances)
        if inputs.compare is not None:
            others = evaluate_trajectory(inputs.compare, inputs.reference, align=align)
            judged["compare"] = judge(others, window_m=window_m)
    if inputs.survey is not None:
        errors = evaluate_against_map(inputs.estimate, inputs.survey, pair.offset_m, pair.survey_from_query)
        judged["against_map"] = judge(errors, window_m=window_m, covariances=inputs.covariances)
    return judged


def _rotation(quat_xyzw: tuple[float, float, float, float] | None) -> Array | None:
    if quat_xyzw is None:
        return None
    if abs(float(np.linalg.norm(quat_xyzw)) - 1.0) > _UNIT_TOLERANCE:
        raise click.UsageError(f"--camera-rotation {','.join(map(str, quat_xyzw))} is no unit quaternion")
    return rotations_from_quat_xyzw(np.array(quat_xyzw))


def _judge_splines(
    recording: Path, reference: Trajectory, window_m: float, options: dict[str, Any]
) -> dict[str, Judgement]:
    from fleetmap.drives import open_drive
    from fleetmap.yardstick import evaluate_gnss_spline, evaluate_smoothing_spline

    with _needing("--spline-through", "recordings"):
        drive = open_drive(
            recording,
            image_topic=options["image_topic"],
            gnss_topic=options["gnss_topic"],
            antenna_offset_m=options["antenna_offset"],
        )
        fixes = drive.gnss_fixes()
    cubic = evaluate_gnss_spline(fixes, reference)
    smoothing = evaluate_smoothing_spline(fixes, reference, drive.antenna().position_in_cam_m)
    return {"spline": judge(cubic, window_m=window_m), "smoothing_spline": judge(smoothing, window_m=window_m)}


def _figures(judged: dict[str, Judgement]) -> dict[str, Any]:
    """The JSON form; what is held against the yardstick says how that came out."""
    from fleetmap.yardstick import compare_with_yardstick

    figures = {name: entry.to_json() for name, entry in judged.items()}
    for name in ("reference", "compare"):
        if name in judged and "smoothing_spline" in judged and judged[name].errors.scale is None:
            comparison = compare_with_yardstick(judged[name].errors, judged["smoothing_spline"].errors)
            figures[name]["yardstick"] = None if comparison is None else comparison.to_json()
    return figures


def _require_sensible_options(context: click.Context) -> None:
    """Refuse combinations in which an option would silently do nothing."""

    given = context.params

    def refuse_without(needed: str, described: str, options: tuple[str, ...]) -> None:
        for option in options:
            typed = context.get_parameter_source(option) is not ParameterSource.DEFAULT
            if typed and given[needed] is None and given[option] not in (None, "none"):
                raise click.UsageError(f"--{option.replace('_', '-')} needs {described}, which is not given")

    if given["reference"] is None and given["against_map"] is None:
        raise click.UsageError("nothing to judge against: give REFERENCE.tum, --against-map SURVEY.tum, or both")
    refuse_without("against_map", "--against-map SURVEY.tum", ("camera_offset", "camera_rotation"))
    refuse_without("reference", "REFERENCE.tum to judge against", _OF_REFERENCE)
    refuse_without("spline_through", "--spline-through RECORDING.mcap", _OF_RECORDING)
    refuse_without("plot", "--plot OUT.png to be drawn in", ("landmarks",))


def _require_drawable(plot: Path) -> None:
    with _needing("--plot", "all"):
        from fleetmap_cli.plotting import require_picture_name
    require_picture_name(plot)


# entry -> name and colour in the picture
_LOOKS = {
    "reference": ("estimate", "C0"),
    "compare": ("compared", "C3"),
    "spline": ("GNSS alone, cubic", "C1"),
    "smoothing_spline": ("GNSS alone, smoothing spline", "C4"),
    "against_map": ("estimate relative to the map", "C2"),
}


def _draw(plot: Path, inputs: _Inputs, judged: dict[str, Judgement], landmarks: Path | None) -> None:
    from fleetmap_cli.plotting import ErrorLine, Track, plot_evaluation

    tracks = [] if "reference" in judged else [Track("estimate", inputs.estimate.positions_m, "C0.-")]
    given = {"reference": inputs.estimate, "compare": inputs.compare}
    for name, (label, colour) in _LOOKS.items():
        if name not in judged or name == "against_map":
            continue
        trajectory, errors = given.get(name), judged[name].errors
        if trajectory is None or errors.scale is not None:
            tracks.append(Track(label if trajectory is None else f"{label}, aligned", errors.positions_m, colour))
        else:
            tracks.append(Track(label, trajectory.positions_m, f"{colour}.-"))
    if inputs.survey is not None:
        tracks.append(Track("trajectory of the map", inputs.survey.positions_m, "C2-"))
    if inputs.reference is not None:
        tracks.append(Track("reference", inputs.reference.positions_m, "k--"))
    lines = [ErrorLine(label, judged[name], colour) for name, (label, colour) in _LOOKS.items() if name in judged]
    points_m = None if landmarks is None else _read_landmarks_m(landmarks, inputs.estimate.epsg)
    plot_evaluation(plot, tracks, lines, points_m)


def _read_landmarks_m(folder: Path, epsg: int) -> np.ndarray:
    """UTM positions (N, 3) of a map's landmarks."""
    from fleetmap.map_package import open_package

    content = open_package(folder).localization_map()
    if content.anchor.epsg != epsg:
        raise InputError(
            f"{folder} lies in EPSG:{content.anchor.epsg}, the trajectory in EPSG:{epsg}; "
            "only a map of the same UTM zone can be drawn beside it"
        )
    return content.anchor.utm_from_map(content.landmarks.points_m)


@contextmanager
def _needing(option: str, extra: str) -> Iterator[None]:
    """Name the extra to install when a package is missing that only one option needs."""
    try:
        yield
    except ModuleNotFoundError as error:
        raise click.ClickException(
            f"{option} needs the package '{error.name}': pip install 'fleetmap[{extra}]'"
        ) from error
