"""POST /localize: what the server itself refuses, and what it says when no localizer answers."""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Iterator

import httpx
import pytest

from fleetmap.localization import MAX_CAMERA_BYTES, MAX_IMAGE_BYTES
from fleetmap.transport.localizers import LocalizerPool
from fleetmap_server.access import Access, Caller
from fleetmap_server.http.app import create_app
from fleetmap_server.library import MapLibrary, open_library
from fleetmap_server.settings import ServerSettings

FORM = {"image": b"\xff\xd8", "camera": b"image_width: 640"}


@pytest.fixture(scope="module")
def library(tmp_path_factory) -> Iterator[MapLibrary]:
    with open_library(ServerSettings(store=tmp_path_factory.mktemp("store"))) as library:
        yield library


@pytest.fixture(scope="module")
def web(library, serving) -> Iterator[httpx.Client]:
    """A server that was started without any localizer."""
    with serving(create_app(library)) as address, httpx.Client(base_url=address, timeout=30.0) as client:
        yield client


def problem(answer: httpx.Response) -> tuple[int, str, str]:
    assert answer.headers["content-type"] == "application/problem+json"
    told = answer.json()
    assert told["status"] == answer.status_code
    return told["status"], told.get("type", "").rpartition(":")[2], told["detail"]


def test_without_a_localizer_it_says_what_the_operator_can_do(web):
    answer = web.post("/localize", files=FORM, data={"near": "49.0,8.4"})
    assert problem(answer)[:2] == (503, "no-localizer")
    assert "--localizer" in answer.json()["detail"]
    assert answer.headers["retry-after"] == "5"


def test_a_localizer_that_is_away_is_told_by_its_endpoint(library, serving, endpoint):
    with (
        contextlib.closing(LocalizerPool([endpoint])) as pool,
        serving(create_app(library, localizers=pool)) as address,
    ):
        status, name, detail = problem(httpx.post(f"{address}/localize", files=FORM, timeout=30.0))
    assert (status, name) == (503, "no-localizer")
    assert endpoint in detail


@pytest.mark.parametrize(
    ("files", "fields", "status", "reason"),
    [
        ({"camera": b"x: 1"}, {}, 400, "'image' is missing"),
        ({"image": b"\xff\xd8"}, {}, 400, "'camera' does not hold"),
        ({**FORM, "camera": b"\xff\xfe"}, {}, 400, "no calibration file in UTF-8"),
        ({**FORM, "camera": b"x" * (MAX_CAMERA_BYTES + 1)}, {}, 400, "at most 16384"),
        (FORM, {"near": "here"}, 400, "LAT,LON"),
        (FORM, {"near": "91,0"}, 400, "'lat_deg' does not hold"),
        (FORM, {"near": "49,nan"}, 400, "'lon_deg' does not hold"),
        (FORM, {"stamp_ns": "yesterday"}, 400, "'stamp_ns' does not hold"),
        ({**FORM, "image": b"\xff" * (MAX_IMAGE_BYTES + 1)}, {}, 413, "send it as JPEG"),
        ({**FORM, "image": b"\xff" * (MAX_IMAGE_BYTES + 99_000)}, {}, 413, "send less"),
    ],
)
def test_what_a_question_lacks_is_named(web, files, fields, status, reason):
    told, _, detail = problem(web.post("/localize", files=files, data=fields))
    assert (told, reason in detail) == (status, True), detail


def test_only_a_form_is_taken(web):
    assert problem(web.post("/localize", content=b"\xff\xd8", headers={"content-type": "image/jpeg"}))[0] == 415
    broken = web.post("/localize", content=b"--x", headers={"content-type": "multipart/form-data"})
    assert problem(broken)[0] == 400
    assert problem(web.get("/localize"))[0] == 405


def test_a_camera_may_be_a_field_like_any_other(web):
    answer = web.post("/localize", files={"image": b"\xff\xd8"}, data={"camera": "image_width: 640"})
    assert problem(answer)[:2] == (503, "no-localizer")


def test_it_takes_the_right_to_read(library, serving):
    holders = {hashlib.sha256(role.encode()).hexdigest(): Caller(role, role) for role in ("none", "read")}
    with serving(create_app(library, Access("none", holders))) as address:
        for token, status in ((None, 401), ("none", 403), ("guessed", 401), ("read", 503)):
            headers = {} if token is None else {"Authorization": f"Bearer {token}"}
            answer = httpx.post(f"{address}/localize", files=FORM, headers=headers, timeout=30.0)
            assert problem(answer)[0] == status
