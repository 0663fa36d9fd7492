"""Maps and judgements that rows share: each is made once a benchmark run, by the first row that asks for it."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fleetmap.evaluation import TrajectoryErrors, evaluate_trajectory
from fleetmap.trajectory import Trajectory, read_trajectory
from fleetmap_cli.benchmarks.mapper_drives import Recording
from fleetmap_cli.benchmarks.row import Figures
from fleetmap_cli.benchmarks.workbench import Run, Workbench

_NOT_FIT_TO_PUBLISH = 3  # fleetmap map's exit code for a map that is there, but poor


@dataclass(frozen=True)
class MapRun:
    """A recording and its map in one mode of --gnss."""

    recording: Recording
    mode: str
    seed: int
    folder: Path

    @property
    def name(self) -> str:
        """Of NAME.tum; the map is in NAME-map."""
        mode = "" if self.mode == "full" else f"-{self.mode}"
        return self.recording.name + mode + (f"-seed-{self.seed}" if self.seed else "")

    @property
    def command(self) -> str:
        """What makes it."""
        options = f"--gnss {self.mode}" + (f" --seed {self.seed}" if self.seed else "")
        outputs = f"--output {self.name}-map --trajectory {self.name}.tum"
        return f"map {self.recording.name}.mcap {outputs} {options} -v"

    @property
    def trajectory(self) -> Path:
        """Where the pose of every image is."""
        return self.folder / f"{self.name}.tum"

    @property
    def quality(self) -> dict[str, Any]:
        """What the map says of itself."""
        manifest = json.loads((self.folder / f"{self.name}-map" / "manifest.json").read_text())
        quality: dict[str, Any] = manifest["quality"]
        return quality

    @property
    def reference(self) -> Trajectory:
        """The true poses of the images."""
        return read_trajectory(self.folder / f"{self.recording.name}.reference.tum")

    @property
    def errors(self) -> TrajectoryErrors:
        """Against the reference, never aligned."""
        return evaluate_trajectory(read_trajectory(self.trajectory), self.reference)


def mapped(bench: Workbench, recording: Recording, mode: str = "full", seed: int = 0) -> MapRun:
    """The recording, mapped."""
    recording.make(bench)
    made = MapRun(recording, mode, seed, bench.folder)
    run_of(bench, made)
    return made


def run_of(bench: Workbench, made: MapRun) -> Run:
    """What ``fleetmap map`` said, and how long it took."""
    return bench.once(made.command, accepted_codes=(0, _NOT_FIT_TO_PUBLISH))


def judged(bench: Workbench, made: MapRun, options: str = "") -> dict[str, Any]:
    """What ``fleetmap evaluate`` says of its trajectory; see there for the keys."""
    words = f"evaluate {made.name}.tum {made.recording.name}.reference.tum {options}".rstrip()
    figures: dict[str, Any] = bench.once(f"{words} --json").json()
    return figures


def beside_splines(bench: Workbench, made: MapRun, options: str = "") -> dict[str, Any]:
    """The same, with splines through the fixes of its recording as yardsticks."""
    return judged(bench, made, f"--spline-through {made.recording.name}.mcap {options}".rstrip())


def position_figures(judgement: dict[str, Any]) -> Figures:
    """Of one of the entries that ``fleetmap evaluate`` makes."""
    return {f"{name} m": rounded(judgement["position_m"][name]) for name in ("mean", "p95", "max")}


def rotation_figures(judgement: dict[str, Any]) -> Figures:
    """Likewise: as it is, and in two parts, of which the constant one may be the reference's."""
    return {
        "rotation deg": rounded(judgement["rotation_deg"]["median"]),
        "constant deg": rounded(judgement["rotation_offset_deg"]),
        "rest deg": rounded(judgement["rotation_spread_deg"]["median"]),
    }


def spline_figures(judgements: dict[str, Any]) -> Figures:
    """The yardsticks: what the fixes alone would give."""
    return {
        "smoothing spline m": rounded(judgements["smoothing_spline"]["position_m"]["mean"]),
        "cubic spline m": rounded(judgements["spline"]["position_m"]["mean"]),
    }


def posed(judgement: dict[str, Any]) -> str:
    """How many of the images have a pose."""
    return f"{judgement['matched']} of {judgement['comparable']}"


def rounded(value: float | None, digits: int = 3) -> float | None:
    """As it is to be shown."""
    return None if value is None else round(value, digits)
