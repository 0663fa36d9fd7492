"""Maps of the circuit when the receiver is bad: each is held against the map of the same drive with a good one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.drive import GnssFix
from fleetmap.drives import open_drive
from fleetmap.errors import RunError
from fleetmap.evaluation import TrajectoryErrors
from fleetmap.yardstick import evaluate_smoothing_spline
from fleetmap_cli.benchmarks.mapper_drives import RTK_1HZ, Circuit
from fleetmap_cli.benchmarks.mapper_runs import MapRun, beside_splines, mapped, position_figures, rounded
from fleetmap_cli.benchmarks.row import Figures, Group, Row
from fleetmap_cli.benchmarks.workbench import Workbench

Mask = NDArray[np.bool_]

_OUTLIER_RATIO = 0.2
_CLOCK_OFFSET_S = 0.08

STRESS = Group(
    "Bad fixes",
    "RTK 1 Hz on the simulated circuit, `--gnss full`, against the exact truth. *Ratio*: the mean over that of "
    "the clean run, the same drive with nothing wrong.",
    ("mean m", "p95 m", "max m", "clean run's mean m", "ratio", "smoothing spline m"),
)
TUNNEL = Group(
    "Without fixes",
    "The same drive without fixes in its middle. *Inside*: between the last fix before and the first one after. "
    "*Ratio*: the mean outside over that of the clean run at the same images.",
    (
        "without fixes m",
        "inside: mean m",
        "max m",
        "max, % of the way",
        "smoothing spline's max m",
        "outside: mean m",
        "clean run's m",
        "ratio",
    ),
)


def stress_rows(circuit: Circuit) -> tuple[Row, ...]:
    """Outliers, a clock that is late, a tunnel."""
    return (_outliers(circuit), _late_clock(circuit), _tunnel(circuit))


def _outliers(circuit: Circuit) -> Row:
    recording = circuit.with_receiver("circuit-outliers", f"{RTK_1HZ} --gnss-outliers {_OUTLIER_RATIO:g}")

    def measure(bench: Workbench) -> Figures:
        return _beside_clean_run(bench, circuit, mapped(bench, recording))

    about = f"{100 * _OUTLIER_RATIO:g} % of the fixes off by 5 to 50 m"
    return Row(recording.name, about, measure, group=STRESS, reach="ratio <= 1.5")


def _late_clock(circuit: Circuit) -> Row:
    recording = circuit.with_receiver("circuit-clock", f"{RTK_1HZ} --gnss-clock-offset-s {_CLOCK_OFFSET_S:g}")

    def measure(bench: Workbench) -> Figures:
        made = mapped(bench, recording)
        quality = made.quality
        offset_s, sigma_s = quality.get("clock_offset_s"), quality.get("clock_offset_sigma_s")
        return _beside_clean_run(bench, circuit, made) | {
            "true ms": round(-1e3 * _CLOCK_OFFSET_S),  # the camera's stamps minus the receiver's, as maps count it
            "estimated ms": "none" if offset_s is None else round(1e3 * offset_s, 1),
            "sigma ms": "none" if sigma_s is None else round(1e3 * sigma_s, 1),
            "removed": "yes" if quality.get("clock_offset_removed") else "no",
        }

    about = f"fixes stamped {1e3 * _CLOCK_OFFSET_S:g} ms late"
    return Row(recording.name, about, measure, group=STRESS, reach="estimated to 20 ms, ratio <= 1.3")


def _tunnel(circuit: Circuit) -> Row:
    gap = f"--gnss-gap {circuit.in_mid_drive(circuit.tunnel_s)}"
    recording = circuit.with_receiver("circuit-tunnel", f"{RTK_1HZ} {gap}")

    def measure(bench: Workbench) -> Figures:
        made, clean = mapped(bench, recording), mapped(bench, circuit.clean)
        bench.shown(f"fleetmap benchmark mapper --rows {recording.name}")
        drive = open_drive(bench.folder / f"{recording.name}.mcap")
        tunnel_ns = longest_gap(drive.gnss_fixes())
        errors, undisturbed = (TunnelErrors.of(run.errors, tunnel_ns) for run in (made, clean))
        spline = TunnelErrors.of(evaluate_smoothing_spline(drive.gnss_fixes(), made.reference), tunnel_ns)
        return {
            "without fixes m": round(errors.length_m),
            "inside: mean m": rounded(errors.mean_m),
            "max m": rounded(errors.max_m),
            "max, % of the way": rounded(100 * errors.max_m / errors.length_m, 2),
            "smoothing spline's max m": rounded(spline.max_m),
            "outside: mean m": rounded(errors.outside_mean_m),
            "clean run's m": rounded(undisturbed.outside_mean_m),
            "ratio": rounded(errors.outside_mean_m / undisturbed.outside_mean_m, 2),
        }

    about = f"no fixes for {circuit.tunnel_s:g} s"
    reach = "inside <= 0.5 % of the way without fixes, ratio <= 1.2"
    return Row(recording.name, about, measure, group=TUNNEL, reach=reach)


def _beside_clean_run(bench: Workbench, circuit: Circuit, made: MapRun) -> Figures:
    judgements = beside_splines(bench, made)
    clean = beside_splines(bench, mapped(bench, circuit.clean))["reference"]["position_m"]["mean"]
    bench.shown(f"fleetmap benchmark mapper --rows {made.recording.name}")
    return position_figures(judgements["reference"]) | {
        "clean run's mean m": rounded(clean),
        "ratio": rounded(judgements["reference"]["position_m"]["mean"] / clean, 2),
        "smoothing spline m": rounded(judgements["smoothing_spline"]["position_m"]["mean"]),
    }


@dataclass(frozen=True)
class TunnelErrors:
    """Position errors inside and outside a stretch of the drive."""

    length_m: float  # driven inside
    mean_m: float
    max_m: float
    outside_mean_m: float

    @staticmethod
    def of(errors: TrajectoryErrors, tunnel_ns: tuple[int, int]) -> TunnelErrors:
        """Those between two stamps, and the others.

        Raises:
            RunError: not one image was posed inside, or not one outside.
        """
        inside = (errors.stamps_ns > tunnel_ns[0]) & (errors.stamps_ns < tunnel_ns[1])
        if inside.all() or not inside.any():
            raise RunError("no image was posed inside the stretch without fixes, or none outside it")
        distances_m = errors.distances_m
        return TunnelErrors(
            length_m=float(np.ptp(errors.driven_m[inside])),
            mean_m=float(distances_m[inside].mean()),
            max_m=float(distances_m[inside].max()),
            outside_mean_m=float(distances_m[~inside].mean()),
        )


def longest_gap(fixes: list[GnssFix]) -> tuple[int, int]:
    """Stamps (ns) of the last fix before, and the first after, the longest time without any."""
    stamps_ns = np.array([fix.stamp_ns for fix in fixes])
    before = int(np.argmax(np.diff(stamps_ns)))
    return int(stamps_ns[before]), int(stamps_ns[before + 1])
