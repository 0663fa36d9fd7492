"""A map server's localizers: who is asked, and what becomes of an image whose localizer is lost."""

from __future__ import annotations

import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing

import pytest

from fleetmap.errors import InputError, ServerRefusedError
from fleetmap.localization import Localized, LocalizeRequest
from fleetmap.transport import MapClient, protocol
from fleetmap.transport.localizers import LocalizerPool, NoLocalizerError
from fleetmap.transport.problems import problem_document
from fleetmap.transport.service import Request, RequestService
from fleetmap.transport.session import ProblemError

QUESTION = LocalizeRequest(camera="a calibration: ü", lat_deg=49.0, lon_deg=8.0, stamp_ns=5)
IMAGE = b"\xff\xd8 what a localizer would refuse"

# Answers hello as a localizer, and dies of the first image.
MORTAL = """
import os, sys
from fleetmap.transport import protocol
from fleetmap.transport.service import RequestService
def hello(request):
    told = protocol.Hello(service=protocol.LOCALIZER, protocol=1, server_id=request.server_id)
    return told.model_dump_json().encode()
def die(request):
    os._exit(1)
service = RequestService(sys.argv[1], {"hello": hello, "localize": die}, lambda error: None)
print("ready", flush=True)
sys.stdin.read()
"""

Answer = Callable[[Request], Localized]


class BusyError(Exception):
    pass


@pytest.fixture
def listen() -> Iterator[Callable[..., str]]:
    """Has something say hello as a localizer, and answer images; its endpoint."""
    with ExitStack() as stack:

        def listen(answer: Answer, service: str = protocol.LOCALIZER) -> str:
            def hello(request: Request) -> bytes:
                told = protocol.Hello(service=service, protocol=1, server_id=request.server_id)
                return told.model_dump_json().encode()

            handlers = {
                "hello": hello,
                "localize": lambda request: answer(request).model_dump_json().encode(),
            }
            endpoint = free_endpoint()
            stack.enter_context(RequestService(endpoint, handlers, explain))
            return endpoint

        yield listen


def explain(error: Exception) -> protocol.Problem:
    rows = ((BusyError, 503, "busy", "Busy"), (ValueError, 422, "unacceptable", "Not an image"))
    return problem_document(error, rows, "localizer")


def free_endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def saying(reason: str) -> Answer:
    return lambda request: Localized(reason=reason)


def failing(error: Exception) -> Answer:
    def answer(request: Request) -> Localized:
        raise error

    return answer


def test_a_question_arrives_as_it_was_asked_with_the_askers_token(listen):
    heard: list[Request] = []

    def answer(request: Request) -> Localized:
        heard.append(request)
        return Localized(reason="black")

    with closing(LocalizerPool([listen(answer)])) as pool:
        assert pool.localize(QUESTION, IMAGE, "secret") == Localized(reason="black")
        assert pool.localize(QUESTION, IMAGE, None) == Localized(reason="black")
    first, second = heard
    assert LocalizeRequest.model_validate(dict(first.parameters)) == QUESTION
    assert (first.payload, first.token, second.token) == (IMAGE, "secret", None)


def test_one_that_is_away_or_busy_or_no_localizer_is_passed_over(listen):
    endpoints = [
        free_endpoint(),
        listen(failing(BusyError("full"))),
        listen(saying("it is a map server"), protocol.MAP_SERVER),
        listen(saying("black")),
    ]
    with closing(LocalizerPool(endpoints)) as pool:
        assert pool.localize(QUESTION, IMAGE, None).reason == "black"


def test_an_image_that_one_refuses_is_not_tried_on_the_next(listen):
    with closing(LocalizerPool([listen(failing(ValueError("no JPEG"))), listen(saying("black"))])) as pool:
        with pytest.raises(ProblemError, match="no JPEG") as refused:
            pool.localize(QUESTION, IMAGE, None)
        assert refused.value.problem.status == 422


def test_without_any_that_answers_it_says_so(listen):
    with closing(LocalizerPool([])) as pool, pytest.raises(NoLocalizerError, match="give it --localizer"):
        pool.localize(QUESTION, IMAGE, None)
    absent = free_endpoint()
    with (
        closing(LocalizerPool([absent])) as pool,
        pytest.raises(NoLocalizerError, match="no localizer answers at"),
    ):
        pool.localize(QUESTION, IMAGE, None)
    busy = listen(failing(BusyError("full")))
    with closing(LocalizerPool([busy])) as pool, pytest.raises(NoLocalizerError, match="full"):
        pool.localize(QUESTION, IMAGE, None)
    with pytest.raises(InputError, match="is no Zenoh endpoint"):
        LocalizerPool(["http://elsewhere"])


def test_the_idlest_is_asked(listen):
    begun, go_on = threading.Event(), threading.Event()

    def wait(request: Request) -> Localized:
        begun.set()
        assert go_on.wait(20.0)
        return Localized(reason="slow")

    with closing(LocalizerPool([listen(wait), listen(saying("idle"))])) as pool:
        told: list[Localized] = []
        first = threading.Thread(target=lambda: told.append(pool.localize(QUESTION, IMAGE, None)))
        first.start()
        assert begun.wait(20.0)
        assert pool.localize(QUESTION, IMAGE, None).reason == "idle"
        go_on.set()
        first.join(20.0)
        assert told == [Localized(reason="slow")]


def test_an_image_that_kills_its_localizer_is_not_handed_to_the_next(listen):
    endpoint = free_endpoint()
    command = [sys.executable, "-c", MORTAL, endpoint]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as mortal:
        assert mortal.stdout is not None
        assert mortal.stdout.readline() == "ready\n"
        handed: list[Request] = []

        def answer(request: Request) -> Localized:
            handed.append(request)
            return Localized(reason="black")

        with closing(LocalizerPool([endpoint, listen(answer)])) as pool:
            with pytest.raises(NoLocalizerError, match=f"{endpoint} was lost with this image"):
                pool.localize(QUESTION, IMAGE, None)
            assert mortal.wait(20.0) == 1
            assert handed == []
            assert pool.localize(QUESTION, IMAGE, None).reason == "black"  # the next image finds the other


def test_an_answer_that_takes_too_long_is_not_waited_for(listen):
    go_on = threading.Event()

    def wait(request: Request) -> Localized:
        assert go_on.wait(20.0)
        return Localized(reason="slow")

    with closing(LocalizerPool([listen(wait)], answer_s=0.2)) as pool:
        with pytest.raises(NoLocalizerError, match=r"took longer than 0\.2 s"):
            pool.localize(QUESTION, IMAGE, None)
        go_on.set()


def test_a_vehicle_does_not_take_a_localizer_for_a_map_server(listen):
    endpoint = listen(saying("black"))
    with pytest.raises(ServerRefusedError, match=f"a fleetmap-localizer answers at {endpoint}"):
        MapClient(endpoint)
