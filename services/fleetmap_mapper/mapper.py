"""Survey drive in, georeferenced visual map and trajectory out. This is the whole method on one page."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fleetmap.drive import Drive, Frame
from fleetmap.geometry import Pose, Sim3
from fleetmap.manifest import Quality
from fleetmap.road_quality import RoadQuality
from fleetmap.trajectory import Trajectory
from fleetmap.visual_map import VisualMap
from fleetmap_mapper.alignment import GnssAligner
from fleetmap_mapper.drift_path import Timed
from fleetmap_mapper.drive_slam import run_slam
from fleetmap_mapper.fix_screening import screen_fixes, with_screening
from fleetmap_mapper.georeferenced_map import adjust_with_fixes, pose_frames
from fleetmap_mapper.georeferencing import GnssTrack, gnss_track, path_at_fixes
from fleetmap_mapper.image_mask import ImageMask
from fleetmap_mapper.map_building import build_visual_map
from fleetmap_mapper.placed_map import place, without_outliers
from fleetmap_mapper.quality import assess
from fleetmap_mapper.road_quality import measure_road
from fleetmap_mapper.segment_joining import place_segments
from fleetmap_mapper.settings import MapperSettings
from fleetmap_mapper.slam import PosedFrame
from fleetmap_mapper.stage_times import StageTimes
from fleetmap_mapper.straightening import straighten
from fleetmap_mapper.tightening import tighten

_log = logging.getLogger(__name__)

Progress = Callable[[str, int, int], None]  # stage, done, total


@dataclass(frozen=True)
class MappedDrive:
    """What a survey drive became."""

    visual_map: VisualMap
    trajectory: Trajectory  # every posed image
    quality: Quality
    road_quality: RoadQuality


def map_drive(
    drive: Drive,
    settings: MapperSettings,
    progress: Progress = lambda *_: None,
    mask: ImageMask | None = None,
) -> MappedDrive:
    """Turn a survey drive into a map anchored in UTM; what a mask ignores never becomes part of it.

    Raises:
        DriveError: no GNSS, too little of it, or images that cannot be read or tracked.
        CalibrationError: no usable camera model.
    """
    track = gnss_track(drive.gnss_fixes(), drive.antenna().position_in_cam_m)
    aligner = GnssAligner(track, settings) if settings.gnss.mode in ("mapping", "full") else None
    times, start_s = StageTimes(), time.perf_counter()
    segments = run_slam(_counted(drive, progress), drive.camera, settings, aligner, times, mask)
    _report_speed(sum(len(s.posed) for s in segments), time.perf_counter() - start_s, times)

    calibration, times = None, StageTimes()
    if settings.gnss.mode != "mapping":
        tightened = tighten(segments, drive.frames, settings.calibration, times, progress)
        segments, calibration = tightened.segments, tightened.calibration
    progress("placing the map", 0, 1)
    paths = [Timed.of(_stamps(s.posed), [p.vis_from_cam for p in s.posed]) for s in segments]
    screened = screen_fixes(paths, track, settings.gnss, settings.seed)
    track = screened.track
    if settings.gnss.mode in ("final", "full"):
        for segment, consensus in zip(segments, screened.consensus, strict=True):
            if consensus is not None:
                straighten(segment, consensus)
    joined = place_segments(segments, track, settings)
    growing, posed = joined.segment.growing, joined.segment.posed
    placed = place(growing, Sim3.identity())
    if settings.gnss.mode in ("none", "mapping"):
        placed = replace(without_outliers(placed), calibration=calibration)
    else:
        placed = adjust_with_fixes(
            placed,
            growing,
            posed,
            track,
            settings.gnss.level_sigma_deg,
            drive.camera,
            settings.calibration,
            times,
            progress,
        )
    placed = replace(placed, map_from_vis=placed.map_from_vis @ joined.map_from_vis)

    frames = pose_frames(placed, growing, posed)
    trajectory = _trajectory(posed, frames, track)
    path = path_at_fixes(_stamps(posed), frames, track)
    road = measure_road(placed, trajectory, path, track, settings.quality.weak_gap_s)
    quality = assess(placed, road, len(trajectory), drive.frame_count, track.anchor, settings)
    quality = with_screening(quality, screened)
    remarks = (*quality.remarks, *joined.remarks)
    quality = quality.model_copy(update={"segments": joined.count, "remarks": remarks})
    _log.info("afterwards: %s", times)
    return MappedDrive(build_visual_map(placed, growing, track.anchor), trajectory, quality, road)


def _counted(drive: Drive, progress: Progress) -> Iterator[Frame]:
    for index, frame in enumerate(drive.frames()):
        progress("tracking", index, drive.frame_count)
        yield frame


def _report_speed(images: int, seconds: float, times: StageTimes) -> None:
    _log.info(
        "%d images in %.1f s, %.1f images/s before the map is placed: %s", images, seconds, images / seconds, times
    )


def _stamps(posed: list[PosedFrame]) -> NDArray[np.int64]:
    return np.array([p.stamp_ns for p in posed], dtype=np.int64)


def _trajectory(posed: list[PosedFrame], frames: list[Pose], track: GnssTrack) -> Trajectory:
    positions = np.array([f.translation_m for f in frames])
    rotations = np.array([f.rotation for f in frames])
    return Trajectory(track.anchor.epsg, _stamps(posed), track.anchor.utm_from_map(positions), rotations)
