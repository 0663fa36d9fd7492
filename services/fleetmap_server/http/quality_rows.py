"""What a map says of its own quality, as rows for people."""

from __future__ import annotations

from collections.abc import Iterator

from fleetmap.manifest import CalibrationRecord, CameraRecord, Quality
from fleetmap_server.http.page_layout import length


def quality_rows(quality: Quality) -> Iterator[tuple[str, str]]:
    """Name and figure of everything that was measured."""
    yield "Way driven", length(quality.length_m)
    segments = f", in {quality.segments} segments" if quality.segments > 1 else ""
    yield "Images with a pose", f"{quality.frames_posed} of {quality.frames_total}{segments}"
    yield "Keyframes", f"{quality.keyframes}"
    density = "" if quality.landmarks_per_m is None else f", {quality.landmarks_per_m:.1f} per metre"
    yield "Landmarks", f"{quality.landmarks}{density}"
    yield "Position, 1 sigma", _position(quality)
    if quality.height_sigma_m is not None:
        yield "Height, 1 sigma", f"{quality.height_sigma_m:.3f} m (median of the keyframes)"
    yield "GNSS", f"{quality.gnss_fixes} fixes{_rejected(quality)}, mapped with --gnss {quality.gnss_mode}"
    yield "GNSS residual", _gnss_residual(quality)
    if quality.gnss_sigma_m is not None:
        yield "GNSS as the receiver claims", f"{quality.gnss_sigma_m:.3f} m (horizontal, median of the fixes)"
    if quality.clock_offset_s is not None:
        yield "Clock offset", _clock_offset(quality.clock_offset_s, quality)
    yield "Reprojection", f"{quality.reprojection_rms_px:.2f} px RMS over {quality.observations} observations"
    if quality.weak_length_m is not None:
        yield "Weak stretches", f"{len(quality.weak_stretches)}, together {quality.weak_length_m:.1f} m"
    if quality.calibration is not None:
        yield from _calibration_rows(quality.calibration)


def _position(quality: Quality) -> str:
    if quality.position_sigma_m is None:
        return "unknown"
    worst = quality.position_sigma_p95_m
    most = "" if worst is None else f"; 95 % better than {worst:.3f} m"
    return f"{quality.position_sigma_m:.3f} m (horizontal, median of the keyframes{most})"


def _rejected(quality: Quality) -> str:
    return f", {quality.gnss_fixes_rejected} rejected" if quality.gnss_fixes_rejected else ""


def _gnss_residual(quality: Quality) -> str:
    if quality.gnss_residual_rms_m is None:
        return "unknown: no fix lies between images with a pose"
    sigmas = quality.gnss_residual_sigmas
    in_sigmas = "" if sigmas is None else f", median {sigmas:.1f} sigma"
    return f"{quality.gnss_residual_rms_m:.3f} m RMS{in_sigmas}"


def _clock_offset(offset_s: float, quality: Quality) -> str:
    sigma = quality.clock_offset_sigma_s
    uncertainty = "" if sigma is None else f" ± {1e3 * sigma:.0f} ms"
    done = "removed" if quality.clock_offset_removed else "left as it is"
    return f"{1e3 * offset_s:.0f} ms{uncertainty} (camera minus receiver), {done}"


def _calibration_rows(calibration: CalibrationRecord) -> Iterator[tuple[str, str]]:
    yield "Calibration as recorded", _camera(calibration.recorded)
    used = "used for this map" if calibration.refined else "not used for this map"
    sigma_px = calibration.focal_sigma_px
    yield "Calibration as fitted", f"{_camera(calibration.fitted)}; focal length ± {sigma_px:.1f} px; {used}"


def _camera(camera: CameraRecord) -> str:
    return (
        f"{camera.width_px} x {camera.height_px} px, f {camera.fx_px:.1f}, {camera.fy_px:.1f} px, "
        f"centre {camera.cx_px:.1f}, {camera.cy_px:.1f} px, {camera.distortion_model}"
    )
