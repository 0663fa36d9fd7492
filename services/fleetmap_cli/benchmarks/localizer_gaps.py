"""A camera that is blind for a while: what carries its pose, how far off that is, and whether it says so."""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fleetmap.covariances import PoseCovariances, read_covariances
from fleetmap.drives.mcap_drive import McapDrive
from fleetmap.evaluation import TrajectoryErrors, evaluate_consistency, evaluate_trajectory
from fleetmap.gnss import in_gap
from fleetmap.trajectory import read_trajectory
from fleetmap_cli.benchmarks.blackening import black_stretches_s
from fleetmap_cli.benchmarks.localizer_drives import SimulatedDrives
from fleetmap_cli.benchmarks.mapper_runs import rounded
from fleetmap_cli.benchmarks.row import Figures, Group, Row
from fleetmap_cli.benchmarks.workbench import Workbench

Array = NDArray[np.float64]

GAPS = Group(
    "Gaps",
    "The simulated second vehicle with other sensors on board (a consumer IMU, wheel speeds, a receiver with a "
    "bias of a metre that wanders), whose images are black for a while, again and again. *End*: of the last pose "
    "that is told in a gap; *predicted*: of all black images. *NEES* of predicted poses: 6 if they are as far "
    "off as they say. Constant velocity is what the last half second before each gap, gone on with, comes to.",
    ("gaps", "predicted", "median end error m", "max end error m", "end sigma m", "NEES", "measured in the dark"),
)
_EVERY_S = {2.0: 6.0, 5.0: 9.0, 10.0: 13.0}  # from gap to gap: the camera has time to find itself again
_VELOCITY_IMAGES = 5  # before a gap
_REACH = "mean NEES in [3, 12]; no pose measured in the dark"


@dataclass(frozen=True)
class OnBoard:
    """What carries the pose."""

    name: str
    about: str
    keep: str  # of the recording's sensors
    options: str = ""


_IMU_AND_WHEELS = OnBoard("imu-wheel", "IMU and wheel speed", "imu,wheel")
_OTHERS = (
    OnBoard("imu", "IMU", "imu"),
    OnBoard("wheel", "wheel speed", "wheel"),
    OnBoard("gnss", "coarse GNSS, with `--use-gnss`", "gnss", "--use-gnss"),
    OnBoard("all", "all three, with `--use-gnss`", "imu,wheel,gnss", "--use-gnss"),
)


def gap_rows(drives: SimulatedDrives) -> tuple[Row, ...]:
    """A row per length of the gaps."""
    return tuple(
        Row(
            f"gaps-{length_s:g}s",
            f"{length_s:g} s without sight, with {_IMU_AND_WHEELS.about}",
            _row(drives, length_s),
            (),
            GAPS,
            _REACH,
        )
        for length_s in _EVERY_S
    )


def _row(drives: SimulatedDrives, length_s: float) -> Callable[[Workbench], Figures]:
    def measure(bench: Workbench) -> Figures:
        sensed = drives.make_sensed(bench)
        figures = _carried(bench, sensed, length_s, _IMU_AND_WHEELS)
        bench.beside("constant velocity", _constant_velocity(bench, sensed, length_s))
        for others in _OTHERS:
            bench.beside(f"with {others.about}", _carried(bench, sensed, length_s, others))
        return figures

    return measure


def _carried(bench: Workbench, sensed: str, length_s: float, on_board: OnBoard) -> Figures:
    """Blacken, localise, compare with the truth."""
    name = _name(sensed, length_s, on_board)
    words = f"--every-s {_EVERY_S[length_s]:g} --black-s {length_s:g} --keep {on_board.keep}"
    bench.python_module("fleetmap_cli.benchmarks.blackening", f"{sensed}.mcap {name}.mcap {words}")
    outputs = f"--trajectory {name}.tum --with-predicted --covariances {name}.cov.csv --output {name}.csv"
    bench.fleetmap(f"localize {name}.mcap --map sim-survey-map {outputs} {on_board.options}".rstrip())
    poses, truth = (read_trajectory(bench.folder / f"{stem}.tum") for stem in (name, f"{sensed}.reference"))
    gaps = Gaps.of(bench.folder / f"{name}.mcap", length_s)
    covariances = read_covariances(bench.folder / f"{name}.cov.csv")
    return gaps.kinds(bench.folder / f"{name}.csv") | gaps.errors(evaluate_trajectory(poses, truth), covariances)


def _constant_velocity(bench: Workbench, sensed: str, length_s: float) -> Figures:
    """From the last measured poses before each gap straight on to its last image."""
    name = _name(sensed, length_s, _IMU_AND_WHEELS)
    poses, truth = (read_trajectory(bench.folder / f"{stem}.tum") for stem in (name, f"{sensed}.reference"))
    gaps = Gaps.of(bench.folder / f"{name}.mcap", length_s)
    numbers, true_numbers = gaps.numbers(poses.stamps_ns), gaps.numbers(truth.stamps_ns)
    ends_m = []
    for number in range(len(gaps.stretches_s)):
        before = np.flatnonzero(poses.stamps_ns < poses.stamps_ns[numbers == number].min())[-_VELOCITY_IMAGES:]
        end = int(np.flatnonzero(true_numbers == number)[-1])
        seconds = (poses.stamps_ns[before] - truth.stamps_ns[end]) * 1e-9
        line = np.polyfit(seconds, poses.positions_m[before], 1)
        ends_m.append(float(np.linalg.norm(line[1] - truth.positions_m[end])))
    return {"median end error m": rounded(np.median(ends_m)), "max end error m": rounded(np.max(ends_m))}


def _name(sensed: str, length_s: float, on_board: OnBoard) -> str:
    return f"{sensed}-{on_board.name}-{length_s:g}s"


@dataclass(frozen=True)
class Gaps:
    """Where in a recording the camera sees nothing."""

    first_ns: int  # image
    stretches_s: list[tuple[float, float]]  # start, since then, and length

    @staticmethod
    def of(recording: Path, length_s: float) -> Gaps:
        """The gaps of a blackened recording."""
        drive = McapDrive(recording)
        return Gaps(drive.frame_stamps_ns()[0], black_stretches_s(drive, _EVERY_S[length_s], length_s))

    def numbers(self, stamps_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """Which gap (N,) each stamp (N,) lies in; -1 for none."""
        numbers = np.full(len(stamps_ns), -1, dtype=np.int64)
        for number, gap in enumerate(self.stretches_s):
            # Texts keep whole microseconds.
            inside = [in_gap(round(stamp_ns - self.first_ns, -3), gap) for stamp_ns in stamps_ns.tolist()]
            numbers[inside] = number
        return numbers

    def kinds(self, table: Path) -> Figures:
        """How many black images have which kind of pose."""
        with table.open(encoding="utf-8", newline="") as file:
            answers = [(int(row["stamp_ns"]), row["kind"]) for row in csv.DictReader(file)]
        dark = self.numbers(np.array([stamp_ns for stamp_ns, _ in answers])) >= 0
        kinds = [kind for (_, kind), is_dark in zip(answers, dark.tolist(), strict=True) if is_dark]
        return {
            "gaps": len(self.stretches_s),
            "predicted": f"{kinds.count('predicted')} of {len(kinds)}",
            "measured in the dark": kinds.count("measured"),
        }

    def errors(self, errors: TrajectoryErrors, covariances: PoseCovariances) -> Figures:
        """How far off what is told in the dark is, and whether it says so."""
        consistency = evaluate_consistency(errors, covariances)
        numbers = self.numbers(errors.stamps_ns)
        assert consistency is not None
        assert len(consistency.rows) == errors.matched  # every pose has a covariance
        ends = [int(np.flatnonzero(numbers == number)[-1]) for number in np.unique(numbers[numbers >= 0])]
        if not ends:
            return {}
        matrices = covariances.matrices[np.searchsorted(covariances.stamps_ns, errors.stamps_ns[ends] - 1000)]
        sigmas_m = np.sqrt(np.linalg.eigvalsh(matrices[:, 3:, 3:])[:, -1])
        return {
            "median end error m": rounded(np.median(errors.distances_m[ends])),
            "max end error m": rounded(np.max(errors.distances_m[ends])),
            "end sigma m": rounded(np.median(sigmas_m)),
            "NEES": round(float(consistency.pose.values[numbers >= 0].mean()), 1),
        }


ROWS = gap_rows(SimulatedDrives())
