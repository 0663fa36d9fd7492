"""``fleetmap benchmark mapper``: maps of the real drives, beside what their GNSS fixes alone would give."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from fleetmap_cli.benchmarks.row import Benchmark, Figures, Row
from fleetmap_cli.benchmarks.workbench import Workbench

ODOMETRY = "drives/kitti_odo_00_first300"
RAW = "drives/kitti_raw_20110926_1405"
_CONVERT_ODOMETRY = f"convert kitti-odometry DATA/{ODOMETRY} drive.mcap"
_CONVERT_RAW = f"convert kitti-raw DATA/{RAW} drive.mcap --camera 0"
_NOT_FIT_TO_PUBLISH = 3  # fleetmap map's exit code for a map that is there, but poor


def _plain(convert: str) -> Callable[[Workbench], Figures]:
    """Plain SLAM, placed by one Sim(3): its shape is judged, GNSS gives no more than place and scale."""

    def measure(bench: Workbench) -> Figures:
        bench.fleetmap(convert)
        duration_s = _map(bench, "drive.tum", "--gnss none")
        judged = _evaluate(bench, "drive.tum drive.reference.tum --align sim3")
        return _figures(judged["reference"]) | {"map s": round(duration_s)}

    return measure


def _with_gnss(convert: str, picture: str | None = None) -> Callable[[Workbench], Figures]:
    """A map shaped by its fixes, beside the splines through the same fixes."""

    def measure(bench: Workbench) -> Figures:
        bench.fleetmap(convert)
        duration_s = _map(bench, "drive.tum", "")
        beside = "--spline-through drive.mcap"
        if picture is not None:
            _map(bench, "no_gnss.tum", "--gnss none", folder="no_gnss_map")
            beside += f" --compare no_gnss.tum --landmarks drive_map --plot {picture}"
        judged = _evaluate(bench, f"drive.tum drive.reference.tum {beside}")
        if picture is not None:
            (bench.folder / picture).replace(bench.picture(picture))
        splines: Figures = {
            "smoothing spline mean m": _rounded(judged["smoothing_spline"]["position_m"]["mean"]),
            "cubic spline mean m": _rounded(judged["spline"]["position_m"]["mean"]),
        }
        return _figures(judged["reference"]) | splines | {"map s": round(duration_s)}

    return measure


def _map(bench: Workbench, trajectory: str, options: str, folder: str = "drive_map") -> float:
    command = f"map drive.mcap --output {folder} --trajectory {trajectory} {options}".rstrip()
    return bench.fleetmap(command, accepted_codes=(0, _NOT_FIT_TO_PUBLISH)).duration_s


def _evaluate(bench: Workbench, words: str) -> Any:
    return bench.fleetmap(f"evaluate {words} --json").json()


def _figures(judged: dict[str, Any]) -> Figures:
    windows = judged["windows"] or {}
    return {
        "mean m": _rounded(judged["position_m"]["mean"]),
        "max m": _rounded(judged["position_m"]["max"]),
        "rotation mean deg": _rounded(judged["rotation_deg"]["mean"]),
        "50 m windows mean RMSE m": _rounded(windows.get("mean_rmse_m")),
        "window scale ratio": _rounded(windows.get("scale_ratio"), 4),
        "posed": f"{judged['matched']} of {judged['comparable']}",
    }


def _rounded(value: float | None, digits: int = 3) -> float | None:
    return None if value is None else round(value, digits)


def _odometry(options: str) -> str:
    return f"{_CONVERT_ODOMETRY} {options} --seed 7"


_RTK_5S = _odometry("--gnss-error rtk --gnss-interval-s 5")
_RTK_GAP = _odometry("--gnss-error rtk --gnss-interval-s 1 --gnss-gap 10.5:10")
_RTK_ARM = _odometry("--gnss-error rtk --gnss-interval-s 1 --antenna-in-camera 0,-1.6,0")
_IN_ODOMETRY, _IN_RAW = (ODOMETRY,), (RAW,)

BENCHMARK = Benchmark(
    "mapper",
    "maps of real drives, with each kind of GNSS and without, beside splines through the same fixes",
    (
        Row("odo-slam", "plain SLAM, one Sim(3)", _plain(_RTK_5S), _IN_ODOMETRY),
        Row("raw-slam", "plain SLAM, one Sim(3)", _plain(_CONVERT_RAW), _IN_RAW),
        Row("odo-rtk-5s", "a fix of 5 cm every 5 s", _with_gnss(_RTK_5S, "odo-rtk-5s.png"), _IN_ODOMETRY),
        Row("odo-rtk-gap", "a fix of 5 cm a second, none for 10 s", _with_gnss(_RTK_GAP), _IN_ODOMETRY),
        Row("odo-rtk", "fixes of 5 cm at 10 Hz", _with_gnss(_odometry("--gnss-error rtk")), _IN_ODOMETRY),
        Row("odo-arm", "the antenna 1.6 m above the camera, a fix a second", _with_gnss(_RTK_ARM), _IN_ODOMETRY),
        Row(
            "odo-consumer",
            "a consumer receiver",
            _with_gnss(_odometry("--gnss-error consumer")),
            _IN_ODOMETRY,
        ),
        Row("raw", "the recording's own GNSS", _with_gnss(_CONVERT_RAW, "raw.png"), _IN_RAW),
    ),
    columns=(
        "mean m",
        "max m",
        "smoothing spline mean m",
        "cubic spline mean m",
        "rotation mean deg",
        "50 m windows mean RMSE m",
        "window scale ratio",
        "posed",
        "map s",
    ),
)
