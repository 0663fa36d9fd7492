"""Where was this image taken? Asked over HTTP, answered by a localizer that the server knows."""

from __future__ import annotations

from threading import BoundedSemaphore
from typing import Any

from fastapi import APIRouter, Request
from fastapi.concurrency import run_in_threadpool
from starlette.datastructures import FormData, UploadFile
from starlette.exceptions import HTTPException

from fleetmap.localization import MAX_CAMERA_BYTES, MAX_IMAGE_BYTES, Localized, LocalizeRequest
from fleetmap.transport.localizers import LocalizerPool
from fleetmap_server.access import token_of
from fleetmap_server.http.answers import problems
from fleetmap_server.problems import BadRequestError, BusyError

MAX_LOCALIZE_BYTES = MAX_IMAGE_BYTES + 4 * MAX_CAMERA_BYTES  # of the whole body
_AT_ONCE = 8
_FORM = "multipart/form-data"


def localize_router(localizers: LocalizerPool) -> APIRouter:
    """The route ``/localize``."""
    router = APIRouter(tags=["localization"])
    places = BoundedSemaphore(_AT_ONCE)

    def ask(question: LocalizeRequest, image: bytes, token: str | None) -> Localized:
        if not places.acquire(blocking=False):
            raise BusyError(f"{_AT_ONCE} images are being localised already; ask again")
        try:
            return localizers.localize(question, image, token)
        finally:
            places.release()

    @router.post("/localize", responses=problems(413, 415, 422), openapi_extra=_BODY)
    async def localize(request: Request) -> Localized:
        """Where an image was taken: a GeoPose, or null and the reason why there is none for sure.

        The pose is OGC GeoPose 1.0 (Basic-Quaternion) with more beside it. Position: WGS 84, height above the
        ellipsoid. Quaternion: from the camera's axes (x where it looks, y to its left, z up) to true east, north
        and up; the identity is a level camera that looks east.
        """
        if request.headers.get("content-type", "").partition(";")[0].strip().lower() != _FORM:
            raise HTTPException(415, f"send image and camera as {_FORM}, as 'curl -F' does")
        async with request.form(max_files=2, max_fields=8, max_part_size=MAX_CAMERA_BYTES) as form:
            question = await _question(form)
            image = await _image(form)
        token = token_of(request.headers.get("authorization"))
        return await run_in_threadpool(ask, question, image, token)

    return router


async def _question(form: FormData) -> LocalizeRequest:
    """All but the image; raises BadRequestError or ValidationError."""
    camera = form.get("camera")
    if isinstance(camera, UploadFile):
        try:
            camera = (await camera.read(MAX_CAMERA_BYTES + 1)).decode()
        except UnicodeError as error:
            raise BadRequestError("'camera' is no calibration file in UTF-8") from error
    words: dict[str, Any] = {"camera": camera, "stamp_ns": form.get("stamp_ns")}
    if (near := form.get("near")) is not None:
        lat_deg, comma, lon_deg = str(near).partition(",")
        if not comma:
            raise BadRequestError("'near' is not LAT,LON: two numbers with a comma between")
        words |= {"lat_deg": lat_deg, "lon_deg": lon_deg}
    return LocalizeRequest.model_validate({name: word for name, word in words.items() if word is not None})


async def _image(form: FormData) -> bytes:
    image = form.get("image")
    if not isinstance(image, UploadFile):
        raise BadRequestError("'image' is missing: a JPEG or PNG file")
    data = await image.read(MAX_IMAGE_BYTES + 1)
    if len(data) > MAX_IMAGE_BYTES:
        raise HTTPException(413, f"an image has at most {MAX_IMAGE_BYTES} bytes; send it as JPEG")
    return data


_BODY: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "content": {
            _FORM: {
                "schema": {
                    "type": "object",
                    "required": ["image", "camera"],
                    "properties": {
                        "image": {"type": "string", "format": "binary", "description": "a JPEG or PNG"},
                        "camera": {
                            "type": "string",
                            "description": "its camera's calibration: the YAML of ROS' camera_calibration, or the "
                            "same as JSON",
                        },
                        "near": {
                            "type": "string",
                            "description": "LAT,LON in degrees, off by 300 m at most: only what was mapped around "
                            "there is looked into",
                        },
                        "stamp_ns": {
                            "type": "integer",
                            "description": "when it was taken; comes back in the pose",
                        },
                    },
                }
            }
        },
    }
}
