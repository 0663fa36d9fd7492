"""What a drive's numbers mean for whoever wants to map it, aspect by aspect."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from fleetmap.drive import Antenna
from fleetmap.inspection.clock_offset import ClockOffset
from fleetmap.inspection.gnss_quality import GnssQuality
from fleetmap.inspection.image_quality import ImageQuality
from fleetmap.inspection.rhythm import Rhythm

Severity = Literal["good", "poor", "bad", "unknown"]

_STEP_M = (1.5, 4.0)  # way between images: more is poor, bad
_RATE_HZ = (4.0, 1.5)  # where the speed is not known: less is poor, bad
_MISSING_SHARE = (0.0, 0.2)
_GAP_WAY_M = 10.0  # tracking rarely survives a gap in the images of this length
_BLUR = (0.5, 0.65)  # see ImageLook.blur: about 1.3 and 2 px of optical blur
_BLURRED_SHARE = (0.15, 0.5)
_SATURATED_SHARE, _BLACK_SHARE = (0.3, 0.6), (0.3, 0.6)  # a white sky is nothing bad
_MEAN_GREY = (35.0, 12.0)
_FOLLOWED_CORNERS = (100, 40)
_WEAK_SHARE = (0.1, 0.5)
_PARALLAX_PX_PER_M = (2.0, 0.5)
_SIGMA_M = (0.5, 15.0)
_OVERCONFIDENT = 3.0
_GNSS_GAP_S = 10.0
_COVERED_SHARE = (0.9, 0.5)
_JUMP_SHARE, _JUMP_M = 0.2, (0.0, 1000.0)
_EXTENT_M = (30.0, 5.0)
_STANDING_SHARE = (0.5, 0.95)
_OFFSET_S = (0.02, 0.5)
_OFFSET_SIGMAS = 2.5


@dataclass(frozen=True)
class Finding:
    """One aspect of a drive; "unknown" is neither for nor against it."""

    aspect: str
    severity: Severity
    text: str  # the numbers, and what to do where it is not good
    value: float | None = None  # the number that decided, in the text's unit


def image_rate(rhythm: Rhythm, gnss: GnssQuality | None) -> Finding:
    """Are images close enough to each other for corners to be followed?"""
    text = f"{rhythm.rate_hz:.1f} images/s"
    if gnss is None or gnss.speed_mps == 0.0:
        severity = _low(rhythm.rate_hz, _RATE_HZ)
    else:
        step_m = gnss.speed_mps / rhythm.rate_hz
        severity = _high(step_m, _STEP_M)
        text += f", one every {step_m:.2f} m at {gnss.speed_mps:.1f} m/s"
    return Finding("image rate", severity, text + _advice(severity, "record more images a second"), rhythm.rate_hz)


def image_gaps(rhythm: Rhythm, gnss: GnssQuality | None) -> Finding:
    """Did the recorder lose images?"""
    if rhythm.gap_count == 0:
        return Finding("image gaps", "good", "none", 0.0)
    severity = _high(rhythm.missing_share, _MISSING_SHARE)
    text = (
        f"{rhythm.gap_count}, {100 * rhythm.missing_share:.1f} % of the images are missing,"
        f" the longest gap is {rhythm.longest_gap_s:.2f} s"
    )
    if gnss is not None and rhythm.longest_gap_s * gnss.speed_mps > _GAP_WAY_M:
        text += "; the map may fall into segments there"
    return Finding("image gaps", severity, f"{text}; is the recorder's disk fast enough?", rhythm.missing_share)


def sharpness(images: ImageQuality) -> Finding:
    """Are edges edges?"""
    text = f"blur {images.blur:.2f} (sharp: 0.25), {100 * images.blurred_share:.0f} % of the images blurred"
    severity = _worse(_high(images.blur, _BLUR), _high(images.blurred_share, _BLURRED_SHARE))
    advice = "focus and clean the lens; shorten the exposure"
    return Finding("sharpness", severity, text + _advice(severity, advice), images.blur)


def exposure(images: ImageQuality) -> Finding:
    """Is anything lost in the light or in the dark?"""
    severity = _worse(
        _high(images.saturated_share, _SATURATED_SHARE),
        _worse(_high(images.black_share, _BLACK_SHARE), _low(images.mean_grey, _MEAN_GREY)),
    )
    text = (
        f"mean grey {images.mean_grey:.0f} of 255, {100 * images.saturated_share:.1f} % white,"
        f" {100 * images.black_share:.1f} % black, brightness varies by {100 * images.brightness_change:.0f} %"
    )
    advice = "let the automatic exposure look at the road, not at the sky; by night, use more gain"
    return Finding("exposure", severity, text + _advice(severity, advice), images.mean_grey)


def texture(images: ImageQuality) -> Finding:
    """Is there anything to follow?"""
    severity = _worse(_low(images.followed_corners, _FOLLOWED_CORNERS), _high(images.weak_share, _WEAK_SHARE))
    text = (
        f"{images.followed_corners} corners followed from image to image,"
        f" hardly any in {100 * images.weak_share:.0f} % of the pairs"
    )
    advice = "does the camera see the surroundings, not sky or bonnet? is the lens clean?"
    return Finding("texture", severity, text + _advice(severity, advice), float(images.followed_corners))


def parallax(images: ImageQuality) -> Finding:
    """Does the scene move as the vehicle does, beyond what turning explains?"""
    per_m = images.parallax_px_per_m
    if per_m is None:
        return Finding("parallax", "unknown", "no images with fixes beside them while the vehicle moves")
    severity = _low(per_m, _PARALLAX_PX_PER_M)
    text = f"{per_m:.1f} px per metre driven, rotation taken off"
    return Finding(
        "parallax", severity, text + _advice(severity, "nothing near is seen; lower or turn the camera"), per_m
    )


def gnss_accuracy(gnss: GnssQuality, scatter_m: float | None) -> Finding:
    """Which kind of receiver, and does it keep what it promises?"""
    severity = _high(gnss.reported_sigma_m, _SIGMA_M)
    text = f"{gnss.kind}, reported sigma {gnss.reported_sigma_m:.2f} m"
    if scatter_m is not None:
        text += f", scatter {scatter_m:.2f} m about a smooth drive"
    if severity != "good":
        text += f"; expect the map to lie about {gnss.reported_sigma_m:.1f} m off; use RTK to have it better"
    if scatter_m is not None and scatter_m > _OVERCONFIDENT * max(gnss.reported_sigma_m, 0.01):
        severity = _worse(severity, "poor")
        text += "; the fixes are worse than they say: check the receiver's settings"
    return Finding("GNSS accuracy", severity, text, gnss.reported_sigma_m)


def gnss_jumps(gnss: GnssQuality, fix_count: int) -> Finding:
    """Are there fixes that no vehicle could have reached?"""
    if gnss.jump_count == 0:
        return Finding("GNSS jumps", "good", "none", 0.0)
    severity = _worse(_high(gnss.jump_count / fix_count, (0.0, _JUMP_SHARE)), _high(gnss.largest_jump_m, _JUMP_M))
    text = f"{gnss.jump_count} of {fix_count} fixes lie up to {gnss.largest_jump_m:.1f} m beside the way"
    return Finding("GNSS jumps", severity, f"{text}; reflections? drive where the sky is open", gnss.jump_count)


def gnss_coverage(gnss: GnssQuality, rhythm: Rhythm | None) -> Finding:
    """Are there fixes wherever there are images?"""
    if not gnss.is_same_time:
        text = f"the fixes are from another time: {_another_time(gnss)}; set both clocks to UTC"
        return Finding("GNSS coverage", "bad", text, 0.0)
    severity = _low(gnss.covered_share, _COVERED_SHARE)
    text = f"{100 * gnss.covered_share:.1f} % of the images lie between the first and the last fix"
    text += _advice(severity, "start the receiver before the camera, and stop it later")
    if rhythm is not None and rhythm.longest_gap_s > max(_GNSS_GAP_S, 5.0 / rhythm.rate_hz):
        severity = _worse(severity, "poor")
        text += f"; {rhythm.longest_gap_s:.1f} s without any fix"
    return Finding("GNSS coverage", severity, text, gnss.covered_share)


def _another_time(gnss: GnssQuality) -> str:
    late = gnss.uncovered_start_s > gnss.uncovered_end_s
    apart_s = max(gnss.uncovered_start_s, gnss.uncovered_end_s)
    return (
        f"the first one {apart_s:.1f} s after the first image"
        if late
        else (f"the last one {apart_s:.1f} s before the last image")
    )


def way(gnss: GnssQuality, length_m: float) -> Finding:
    """Has the vehicle gone far enough to fix scale and heading?"""
    severity = _worse(_low(gnss.extent_m, _EXTENT_M), _high(gnss.standing_share, _STANDING_SHARE))
    text = f"{length_m:.0f} m driven, {100 * gnss.standing_share:.0f} % of the time standing"
    return Finding(
        "way", severity, text + _advice(severity, "drive some hundred metres without long stops"), length_m
    )


def antenna_place(antenna: Antenna) -> Finding:
    """Is it known where the antenna is?"""
    if antenna.source == "assumed at the camera":
        text = "nothing says where it is; give --antenna-offset X,Y,Z when mapping, or the map lies off by as much"
        return Finding("antenna", "poor", text)
    return Finding("antenna", "good", f"known ({antenna.source})")


def clocks(offset: ClockOffset, gnss: GnssQuality) -> Finding:
    """Do camera and receiver read the same time at the same instant?"""
    if offset.offset_s is None or offset.sigma_s is None:
        return Finding("clocks", "unknown", f"offset of camera and GNSS unobservable: {offset.reason}")
    found = f"{abs(offset.offset_s):.3f} +- {offset.sigma_s:.3f} s"
    if abs(offset.offset_s) <= max(_OFFSET_S[0], _OFFSET_SIGMAS * offset.sigma_s):
        return Finding("clocks", "good", f"camera and GNSS agree to {found}", offset.offset_s)
    later = "camera's" if offset.offset_s > 0.0 else "receiver's"
    text = (
        f"camera and GNSS clocks differ by {found}: the {later} stamps are later; at {gnss.speed_mps:.0f} m/s the"
        f" map lies {abs(offset.offset_s) * gnss.speed_mps:.2f} m off along the road; synchronise the clocks, or"
        f" add {offset.offset_s:+.3f} s to the stamps of the fixes"
    )
    return Finding("clocks", _worse("poor", _high(abs(offset.offset_s), _OFFSET_S)), text, offset.offset_s)


def of_missing(line: str) -> Iterator[Finding]:
    """A line of what the recording lacks; the antenna has a finding of its own."""
    aspect, _, text = line.partition(": ")
    if aspect != "antenna":
        yield Finding(aspect, "bad", text)


def _high(value: float, limits: tuple[float, float]) -> Severity:
    return "bad" if value > limits[1] else "poor" if value > limits[0] else "good"


def _low(value: float, limits: tuple[float, float]) -> Severity:
    return "bad" if value < limits[1] else "poor" if value < limits[0] else "good"


def _worse(first: Severity, second: Severity) -> Severity:
    order: tuple[Severity, ...] = ("unknown", "good", "poor", "bad")
    return max(first, second, key=order.index)


def _advice(severity: Severity, advice: str) -> str:
    return "" if severity == "good" else f"; {advice}"
