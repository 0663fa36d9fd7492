"""From a recorded calibration to the camera that took the recorded images.

Source: the comments of sensor_msgs/CameraInfo. Rectified images have P's camera without distortion. A calibration
is of the whole sensor; images may be a region of it, binned.
"""

from __future__ import annotations

from fleetmap.camera import Camera
from fleetmap.camera_file import camera_of_model
from fleetmap.drives.messages import CalibrationMessage, Region
from fleetmap.errors import CalibrationError
from fleetmap.geometry import Array


def camera_of(calibration: CalibrationMessage, topic: str, *, rectified: bool) -> Camera:
    """The camera of images that a calibration on some topic belongs to.

    Raises:
        CalibrationError: an uncalibrated camera, an unknown distortion model, or a region outside the sensor.
    """
    K, model, coefficients = calibration.K, calibration.distortion_model, calibration.coefficients
    if (rectified or _is_of_rectified_images(calibration)) and calibration.P[0, 0] > 0.0:
        K, model, coefficients = calibration.P[:, :3], "", ()
    try:
        width, height, K = _of_recorded_part(calibration, K)
        return camera_of_model(width, height, K, model, coefficients)
    except CalibrationError as error:
        raise CalibrationError(f"{topic}: {error}") from error


def is_rectified(image_topic: str) -> bool:
    """ROS' image_proc publishes rectified images as .../image_rect or .../image_rect_color; or .../rect/image."""
    parts = image_topic.split("/")
    return any(part == "rect" or part.startswith(("image_rect", "rectified")) for part in parts)


def _is_of_rectified_images(calibration: CalibrationMessage) -> bool:
    """A calibration that gives no coefficients at all, not even zeros, and no K other than P's.

    Zeros are left alone: they are a distortion too where the model is equidistant, and none where it is not.
    """
    P = calibration.P[:, :3]
    return not calibration.coefficients and bool((calibration.K == P).all() or not calibration.K.any())


def _of_recorded_part(calibration: CalibrationMessage, K: Array) -> tuple[int, int, Array]:
    """Size and K of the recorded images; a superpixel's centre is that of the pixels it combines."""
    width, height = calibration.width_px, calibration.height_px
    region = calibration.region
    if not (region.width_px and region.height_px):
        region = Region(0, 0, width, height)
    if region.x_px + region.width_px > width or region.y_px + region.height_px > height:
        raise CalibrationError(
            f"its region of {region.width_px}x{region.height_px} pixels from ({region.x_px}, {region.y_px})"
            f" is not inside {width}x{height}"
        )
    K = K.copy()
    for axis, (begin, binning) in enumerate(zip((region.x_px, region.y_px), calibration.binning, strict=True)):
        K[axis, axis] /= binning
        K[axis, 2] = (K[axis, 2] - begin + 0.5) / binning - 0.5
    return region.width_px // calibration.binning[0], region.height_px // calibration.binning[1], K
