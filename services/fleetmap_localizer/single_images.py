"""One image on its own: where was it taken?"""

from __future__ import annotations

from collections.abc import Sequence

from fleetmap.camera import Camera
from fleetmap.drive import Frame
from fleetmap.drives.image_codec import Image, decode_compressed
from fleetmap.errors import CalibrationError, InputError
from fleetmap.localization import Localized
from fleetmap_localizer.geographic import geographic
from fleetmap_localizer.localizer import Localizer
from fleetmap_localizer.map_view import MapView
from fleetmap_localizer.pose_estimate import NoPose
from fleetmap_localizer.settings import LocalizerSettings

MAX_IMAGE_PIXELS = 32_000_000
_JPEG_AND_PNG = (b"\xff\xd8", b"\x89PNG")


class UnreadableImageError(InputError):
    """The bytes are no whole JPEG or PNG."""


def locate(
    image: bytes,
    camera: Camera,
    views: Sequence[MapView],
    settings: LocalizerSettings | None = None,
    *,
    stamp_ns: int | None = None,
    name: str = "the image",
) -> Localized:
    """Where an image was taken, searched for in all views.

    Args:
        image: a JPEG or PNG, grey or colour, as the sensor saw it: EXIF orientation is ignored.
        camera: calibrated for images of this size.
        views: made for this camera.
        settings: of the search.
        stamp_ns: when it was taken; comes back in the answer.
        name: of the image, for errors.

    Raises:
        UnreadableImageError: it is neither, or damaged.
        CalibrationError: it has another size than the calibration.
    """
    frame = Frame(stamp_ns or 0, _decoded(image, camera, name))
    answer = Localizer(camera, views, settings).localize(frame)
    if isinstance(answer, NoPose):
        return Localized(reason=answer.reason)
    return Localized(pose=geographic(answer).model_copy(update={"stamp_ns": stamp_ns}))


def _decoded(image: bytes, camera: Camera, name: str) -> Image:
    if not image.startswith(_JPEG_AND_PNG):
        raise UnreadableImageError(f"{name} is neither JPEG nor PNG")
    try:
        pixels = decode_compressed(image, "JPEG or PNG", MAX_IMAGE_PIXELS)
    except ValueError as error:
        raise UnreadableImageError(f"{name} cannot be read: {error}") from error
    height_px, width_px = pixels.shape
    if (width_px, height_px) != (camera.width_px, camera.height_px):
        is_turned = (height_px, width_px) == (camera.width_px, camera.height_px)
        hint = "; it is for the image as the sensor gives it, EXIF orientation not applied" if is_turned else ""
        raise CalibrationError(
            f"{name} has {width_px}x{height_px} pixels, the camera file is for "
            f"{camera.width_px}x{camera.height_px}{hint}"
        )
    return pixels
