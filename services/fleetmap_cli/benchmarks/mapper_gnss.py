"""Maps shaped by their fixes, beside splines through the same fixes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fleetmap.drives import open_drive
from fleetmap.gnss import CONSUMER
from fleetmap.yardstick import evaluate_smoothing_spline
from fleetmap_cli.benchmarks import mapper_drives
from fleetmap_cli.benchmarks.mapper_drives import Circuit, Recording
from fleetmap_cli.benchmarks.mapper_runs import (
    beside_splines,
    judged,
    mapped,
    posed,
    position_figures,
    rotation_figures,
    rounded,
    run_of,
    spline_figures,
)
from fleetmap_cli.benchmarks.row import Figures, Group, Row
from fleetmap_cli.benchmarks.workbench import Workbench

Array = NDArray[np.float64]

WITH_GNSS = Group(
    "Maps with good GNSS",
    "`--gnss full`, all images, never aligned before comparing. RTK: simulated fixes with 5 cm of white noise per "
    "axis. The splines' means are of splines through the same fixes: only what the map does better is owed to the "
    "images. *Rotation*: the median error; its constant part, and the median of the rest. The simulated truth is "
    "exact; KITTI's references carry decimetres, and 0.2 to 0.5 deg against the images.",
    (
        "mean m",
        "p95 m",
        "max m",
        "smoothing spline m",
        "cubic spline m",
        "rotation deg",
        "constant deg",
        "rest deg",
        "posed",
        "map s",
    ),
)
CONSUMER_GNSS = Group(
    "Maps with consumer GNSS",
    "A bias of 1 m (1.5 m in height) that wanders over 100 s, which one traverse cannot see: only the shape can "
    "be right. *Shape*: what is left of the mean error when one translation is removed; of the map, of the "
    "smoothing spline through the fixes, and of the bias itself that was injected.",
    (
        "mean m",
        "shape: map m",
        "bias curve's m",
        "smoothing spline's m",
        "rotation deg",
        "constant deg",
        "rest deg",
        "posed",
    ),
)
_5S = "mean <= 0.10 m, p95 <= 0.20 m"
_GAP = "mean <= 0.15 m"
_DENSE = "mean <= 0.04 m, and 0.01 m above the smoothing spline's"
_ROTATION = "the rest's rotation <= 0.3 deg"
_TRUE_ROTATION = "rotation <= 0.15 deg"
_SHAPE = "shape <= the bias curve's + 0.05 m"


def gnss_rows(circuit: Circuit) -> tuple[Row, ...]:
    """RTK in every density, on the real drive and on the circuit."""
    gap = f"{mapper_drives.RTK_1HZ} --gnss-gap {circuit.in_mid_drive(circuit.gap_s)}"
    around = [
        (circuit.with_receiver("circuit-rtk-5s", "--gnss rtk --gnss-interval-s 5"), "RTK every 5 s", _5S),
        (circuit.with_receiver("circuit-rtk-gap", gap), f"RTK 1 Hz, {circuit.gap_s:g} s removed", _GAP),
        (circuit.with_receiver("circuit-rtk", "--gnss rtk --gnss-interval-s 0.1"), "RTK 10 Hz", _DENSE),
        (circuit.clean, "RTK 1 Hz", ""),
    ]
    return (
        _rtk(mapper_drives.ODOMETRY_RTK_5S, "RTK every 5 s", f"{_5S}, {_ROTATION}", picture=True),
        _rtk(mapper_drives.ODOMETRY_RTK_GAP, "RTK 1 Hz, 10 s removed", f"{_GAP}, {_ROTATION}"),
        _rtk(mapper_drives.ODOMETRY_RTK, "RTK 10 Hz", f"{_DENSE}, {_ROTATION}"),
        _rtk(mapper_drives.ODOMETRY_ARM, "RTK 1 Hz, antenna 1.6 m away", f"mean <= 0.06 m, {_ROTATION}"),
        _rtk(mapper_drives.KITTI_RAW, "its own receiver, which also made the reference", _ROTATION, picture=True),
        *(
            _rtk(recording, about, ", ".join(filter(None, [reach, _TRUE_ROTATION])))
            for recording, about, reach in around
        ),
    )


def consumer_rows(circuit: Circuit) -> tuple[Row, ...]:
    """A consumer receiver on the real drive and on the circuit."""
    around = circuit.with_receiver("circuit-consumer", "--gnss consumer --gnss-interval-s 0.1")
    return (
        _consumer(mapper_drives.ODOMETRY_CONSUMER, mapper_drives.ODOMETRY_SEED, f"{_SHAPE}, {_ROTATION}"),
        _consumer(around, circuit.drive_seed, _SHAPE),
    )


def _rtk(recording: Recording, about: str, reach: str, *, picture: bool = False) -> Row:
    def measure(bench: Workbench) -> Figures:
        made = mapped(bench, recording)
        options = ""
        if picture:
            plain = mapped(bench, recording, "none")
            options = f"--compare {plain.name}.tum --landmarks {made.name}-map --plot {recording.name}.png"
        judgements = beside_splines(bench, made, options)
        if picture:
            (bench.folder / f"{recording.name}.png").replace(bench.picture(f"{recording.name}.png"))
        judgement = judgements["reference"]
        figures = position_figures(judgement) | spline_figures(judgements) | rotation_figures(judgement)
        return figures | {"posed": posed(judgement), "map s": round(run_of(bench, made).duration_s)}

    return Row(recording.name, about, measure, recording.needs, WITH_GNSS, reach)


def _consumer(recording: Recording, gnss_seed: int, reach: str) -> Row:
    def measure(bench: Workbench) -> Figures:
        made = mapped(bench, recording)
        judgement = judged(bench, made)["reference"]
        bench.shown(f"fleetmap benchmark mapper --rows {recording.name}")
        fixes, reference = open_drive(bench.folder / f"{recording.name}.mcap").gnss_fixes(), made.reference
        spline = evaluate_smoothing_spline(fixes, reference)
        bias_m = injected_bias_m(np.array([fix.stamp_ns for fix in fixes]), gnss_seed)
        return {
            "mean m": rounded(judgement["position_m"]["mean"]),
            "shape: map m": rounded(shape_error_m(made.errors.offsets_m)),
            "bias curve's m": rounded(shape_error_m(bias_m)),
            "smoothing spline's m": rounded(shape_error_m(spline.offsets_m)),
            **rotation_figures(judgement),
            "posed": posed(judgement),
        }

    return Row(recording.name, "consumer GNSS 10 Hz", measure, recording.needs, CONSUMER_GNSS, reach)


def shape_error_m(offsets_m: Array) -> float:
    """Mean of what is left of errors (N, 3) when their mean is taken off."""
    return float(np.linalg.norm(offsets_m - offsets_m.mean(axis=0), axis=1).mean())


def injected_bias_m(fix_stamps_ns: NDArray[np.int64], gnss_seed: int) -> Array:
    """The bias (N, 3) in east, north, up that consumer fixes of this seed carry beside their white noise."""
    return replace(CONSUMER, white_sigma_m=0.0).sample_errors_enu_m(
        fix_stamps_ns, np.random.default_rng(gnss_seed)
    )
