"""The localizer as a service: its Zenoh queryable says where images were taken."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable
from threading import Lock

from pydantic import ValidationError

from fleetmap import __version__
from fleetmap.camera import Camera
from fleetmap.camera_file import parse_camera
from fleetmap.errors import (
    AccessDeniedError,
    CalibrationError,
    FleetmapError,
    InputError,
    NoPoseError,
    ServerError,
)
from fleetmap.localization import MAX_IMAGE_BYTES, Localized, LocalizeRequest
from fleetmap.transport import MapClient, protocol
from fleetmap.transport.problems import ProblemRow, problem_document
from fleetmap.transport.service import Request, RequestService
from fleetmap_localizer.settings import LocalizerSettings
from fleetmap_localizer.single_images import MAX_IMAGE_PIXELS, UnreadableImageError, locate
from fleetmap_localizer.supplies import Supplies

_ADMITTED_S = 60.0  # after which the map server is asked again
_MAX_ADMITTED = 1000
_MAX_CAMERA_NUMBER = 1e6  # pixels, or a coefficient of the distortion

_PROBLEMS: tuple[ProblemRow, ...] = (  # the first row that fits counts
    (AccessDeniedError, 401, "unauthorized", "Token needed"),
    (UnreadableImageError, 422, "unacceptable", "Not an acceptable image"),
    (CalibrationError, 422, "unacceptable", "Not an acceptable camera"),
    (InputError, 400, "bad-request", "Bad request"),
    (ValidationError, 400, "bad-request", "Bad request"),
    (ServerError, 503, "busy", "The map server is away"),
    (FleetmapError, 500, "failed", "Localizer error"),
)


class PoseService:
    """Answers while it stands; close it in the end.

    Args:
        endpoint: ``tcp/HOST:PORT`` to listen on.
        connect: a connection to the map server with somebody's token: who may read there may ask here.
        supplies: what to look into.
        settings: of the search.

    Raises:
        InputError: the endpoint is malformed.
        RunError: the endpoint cannot be listened on.
    """

    def __init__(
        self,
        endpoint: str,
        connect: Callable[[str | None], MapClient],
        supplies: Supplies,
        settings: LocalizerSettings | None = None,
    ) -> None:
        self._admission, self._supplies, self._settings = Admission(connect), supplies, settings
        handlers = {protocol.HELLO: self._hello, protocol.LOCALIZE: self._localize}
        self._service = RequestService(endpoint, handlers, problem_of)

    def close(self) -> None:
        """Answer what has been asked, take no more, and hang up."""
        self._service.close()

    def _hello(self, request: Request) -> bytes:
        hello = protocol.Hello(
            service=protocol.LOCALIZER,
            protocol=protocol.PROTOCOL_VERSION,
            fleetmap_version=__version__,
            server_id=request.server_id,
            may_write=False,
        )
        return hello.model_dump_json().encode()

    def _localize(self, request: Request) -> bytes:
        self._admission.check(request.token)
        question = LocalizeRequest.model_validate(dict(request.parameters))
        return self._answer(question, request.payload).model_dump_json().encode()

    def _answer(self, question: LocalizeRequest, image: bytes) -> Localized:
        if len(image) > MAX_IMAGE_BYTES:
            raise InputError(f"an image has at most {MAX_IMAGE_BYTES} bytes, not {len(image)}; send it as JPEG")
        camera = parse_camera(question.camera, "the camera file")
        _check_plausible(camera)
        try:
            views = self._supplies.views(camera, question.near_lat_lon_deg)
        except NoPoseError as error:
            return Localized(reason=str(error))
        return locate(image, camera, views, self._settings, stamp_ns=question.stamp_ns)


def _check_plausible(camera: Camera) -> None:
    """Raise CalibrationError for a camera that nobody can build, on which only the arithmetic would fail."""
    if camera.width_px * camera.height_px > MAX_IMAGE_PIXELS:
        raise CalibrationError(f"images of more than {MAX_IMAGE_PIXELS:,} pixels are not looked at")
    numbers = (camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px, *camera.distortion)
    if min(camera.fx_px, camera.fy_px) < 1.0 or max(map(abs, numbers)) > _MAX_CAMERA_NUMBER:
        raise CalibrationError(f"no camera is like that: fx {camera.fx_px:g}, fy {camera.fy_px:g} and the others")


class Admission:
    """Whether somebody may ask: whoever may read on the map server. Safe to use from several threads.

    Args:
        connect: a connection to it with a token, or an error of those that MapClient raises.
    """

    def __init__(self, connect: Callable[[str | None], MapClient]) -> None:
        self._connect = connect
        self._lock = Lock()
        self._until_s: dict[str, float] = {}  # by the token's SHA-256

    def check(self, token: str | None) -> None:
        """Return if he may.

        Raises:
            AccessDeniedError: he may not.
            ServerError: the map server cannot be asked.
        """
        name = "" if token is None else hashlib.sha256(token.encode(errors="replace")).hexdigest()
        with self._lock:
            if self._until_s.get(name, 0.0) > time.monotonic():
                return
        self._connect(token).close()
        with self._lock:
            if len(self._until_s) >= _MAX_ADMITTED:
                self._until_s.clear()
            self._until_s[name] = time.monotonic() + _ADMITTED_S


def problem_of(error: Exception) -> protocol.Problem:
    """The problem document for whatever a question raised; what nobody foresaw is logged and told as 500."""
    return problem_document(error, _PROBLEMS, "localizer")
