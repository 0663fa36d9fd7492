"""What the images of a drive are worth: sharpness, exposure, texture and parallax, from a part of them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.camera import Camera
from fleetmap.drive import Frame
from fleetmap.inspection.gnss_quality import GnssTrack
from fleetmap.inspection.sampling import Pair
from fleetmap.inspection.visual_course import TimedMotion
from fleetmap.vision.frame_motion import FrameFollower
from fleetmap.vision.image_look import ImageLook, look_at

Array = NDArray[np.float64]

_MAX_LOOKS = 80
BLURRED = 0.55  # of ImageLook.blur: an optical blur of 1.5 px, or 6 px of motion
_BLUR_BEYOND_BEST = 0.2
_FEW_TRACKS = 60
_MIN_STEP_M = 0.1


@dataclass(frozen=True)
class Seen:
    """What one pass over some images found."""

    looks: tuple[ImageLook, ...]
    motions: tuple[TimedMotion, ...]


@dataclass(frozen=True)
class ImageQuality:
    """Shares are of the images looked at."""

    looked_at: int
    blur: float  # median of ImageLook.blur
    blurred_share: float
    mean_grey: float
    saturated_share: float  # of the pixels, in the median image
    black_share: float
    brightness_change: float  # standard deviation of the images' mean grey over its mean
    followed_corners: int  # median between successive images
    weak_share: float  # of the image pairs between which hardly any corner could be followed
    parallax_px: float | None  # median between successive images; None where no motion could be measured
    parallax_px_per_m: float | None  # None without fixes, or where the vehicle stands


def watch(
    frames: Iterable[Frame],
    pairs: list[Pair],
    stamps_ns: NDArray[np.int64],
    camera: Camera,
    progress: Callable[[str, int, int], None],
) -> Seen:
    """Look at the frames that begin and end ``pairs`` of indices into ``stamps_ns``, in order of time."""
    wanted = {int(stamps_ns[index]): index for pair in pairs for index in pair}
    starts = {second: first for first, second in pairs}
    every = max(1, len(wanted) // _MAX_LOOKS)
    follower = FrameFollower(camera)
    looks, motions = [], []
    before_index, before = -1, None
    for done, frame in enumerate(frames):
        index = wanted[frame.stamp_ns]
        reduced = follower.reduced(frame.image)
        if done % every == 0:
            looks.append(look_at(frame.image))
        if before is not None and starts.get(index) == before_index:
            motion = follower.motion(before, reduced)
            motions.append(TimedMotion(int(stamps_ns[before_index]), frame.stamp_ns, motion))
        before_index, before = index, reduced
        progress("look at images", done + 1, len(wanted))
    return Seen(tuple(looks), tuple(motions))


def measure_images(seen: Seen, track: GnssTrack | None) -> ImageQuality | None:
    """The numbers of what was seen; None where there was nothing."""
    if not seen.looks:
        return None
    blur = np.array([look.blur for look in seen.looks])
    grey = np.array([look.mean_grey for look in seen.looks])
    corners = np.array([timed.motion.track_count if timed.motion else 0 for timed in seen.motions])
    parallax = np.array([timed.motion.parallax_px for timed in seen.motions if timed.motion])
    return ImageQuality(
        looked_at=len(seen.looks),
        blur=float(np.median(blur)),
        blurred_share=float(np.mean((blur > BLURRED) | (blur > np.percentile(blur, 10) + _BLUR_BEYOND_BEST))),
        mean_grey=float(np.median(grey)),
        saturated_share=float(np.median([look.saturated_share for look in seen.looks])),
        black_share=float(np.median([look.black_share for look in seen.looks])),
        brightness_change=float(np.std(grey) / max(float(np.mean(grey)), 1.0)),
        followed_corners=int(np.median(corners)) if len(corners) else 0,
        weak_share=float(np.mean(corners < _FEW_TRACKS)) if len(corners) else 0.0,
        parallax_px=float(np.median(parallax)) if len(parallax) else None,
        parallax_px_per_m=_parallax_px_per_m(seen.motions, track),
    )


def _parallax_px_per_m(motions: tuple[TimedMotion, ...], track: GnssTrack | None) -> float | None:
    """The median flow that rotation does not explain, per metre driven."""
    measured = [timed for timed in motions if timed.motion is not None]
    if track is None or len(track.stamps_ns) < 2 or not measured:
        return None
    stamps_ns = np.array([(timed.first_ns, timed.second_ns) for timed in measured])
    metres = np.diff(track.way_m(stamps_ns), axis=1).ravel()
    inside = (stamps_ns[:, 0] >= track.stamps_ns[0]) & (stamps_ns[:, 1] <= track.stamps_ns[-1])
    moving = inside & (metres > _MIN_STEP_M)
    if np.count_nonzero(moving) < 3:
        return None
    parallax = np.array([timed.motion.parallax_px for timed in measured if timed.motion])
    return float(np.median(parallax[moving] / metres[moving]))
