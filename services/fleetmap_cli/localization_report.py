"""What ``fleetmap localize`` writes and says when a drive is over, or was ended early."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import click

from fleetmap.covariances import write_covariances
from fleetmap.trajectory import write_trajectory
from fleetmap_localizer.paced import PacedFrames
from fleetmap_localizer.pose_files import write_pose_file
from fleetmap_localizer.run import LocalizedDrive

_INTERRUPTED = 130  # exit code


@dataclass(frozen=True)
class PoseOutputs:
    """Which files to write."""

    trajectory: Path | None
    covariances: Path | None
    others: Sequence[Path]
    with_predicted: bool  # in TUM text

    def write(self, result: LocalizedDrive) -> list[tuple[str, Path]]:
        """Write those that there is something for; what to call each, and where it is.

        Raises:
            StorageError: a file cannot be written.
        """
        written: list[tuple[str, Path]] = []
        if self.trajectory is not None and result.poses:
            write_trajectory(self.trajectory, result.trajectory(with_predicted=self.with_predicted))
            written.append(("trajectory", self.trajectory))
        if self.covariances is not None and result.poses:
            write_covariances(self.covariances, result.covariances(with_predicted=self.with_predicted))
            written.append(("covariances", self.covariances))
        for path in self.others:
            if write_pose_file(path, result.answers, predicted_in_tum=self.with_predicted):
                written.append(("written", path))
        return written


def finish(outputs: PoseOutputs, result: LocalizedDrive, paced: PacedFrames | None, images: int) -> int | None:
    """Write all that there is, say what came of the drive, and then what ended it early; the exit code.

    Args:
        outputs: to write.
        result: of the run.
        paced: what the images came through, if they were paced.
        images: that the recording holds.

    Raises:
        NoPoseError: not one image could be localised.
        RunError: what ended the run early.
        StorageError: a file cannot be written.
    """
    written = outputs.write(result)
    result.require_pose()
    for name, text in [*_lines(result, paced), *((name, str(path)) for name, path in written)]:
        click.echo(f"{name and name + ':':<15} {text}")
    if result.ended_by is None:
        return None
    click.echo(f"stopped after {result.frame_count} of {images} images; what they gave is written", err=True)
    if isinstance(result.ended_by, KeyboardInterrupt):
        return _INTERRUPTED
    raise result.ended_by


def _lines(result: LocalizedDrive, paced: PacedFrames | None) -> Iterator[tuple[str, str]]:
    for map_id, version in result.map_versions:
        yield "map", f"{map_id} (version {version[:12]})"
    yield "frames", str(result.frame_count)
    yield "poses", f"{len(result.poses)} ({100.0 * len(result.poses) / result.frame_count:.1f} %)"
    if result.predicted:
        yield "predicted", str(len(result.predicted))
    for number, (reason, count) in enumerate(result.reasons.most_common()):
        yield "" if number else "no pose", f"{count}: {reason}"
    yield "median inliers", str(result.median_inliers)
    if paced is not None and (latency := paced.latency) is not None:
        yield (
            "latency",
            f"median {1e3 * latency.median_s:.0f} ms, p95 {1e3 * latency.p95_s:.0f} ms, "
            f"max {1e3 * latency.max_s:.0f} ms; {len(paced.dropped_stamps_ns)} images dropped",
        )
