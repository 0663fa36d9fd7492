"""The server's face to vehicles, mappers and workers: the operations of the Zenoh protocol over a library.

Who asks must be allowed to, parameters are checked by the protocol's models, and whatever is raised here becomes a
problem document.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from threading import Event
from types import TracebackType
from typing import Any, Self

from pydantic import BaseModel

from fleetmap import __version__
from fleetmap.jobs import MAX_SUMMARY_BYTES, DriveSummary
from fleetmap.localization import LocalizeRequest
from fleetmap.transport import protocol
from fleetmap.transport.localizers import LocalizerPool
from fleetmap.transport.operations import OPERATIONS
from fleetmap.transport.service import Handler, Observe, Request, RequestService
from fleetmap_server.access import Access
from fleetmap_server.announcer import Announcer, announcements_after
from fleetmap_server.drive_search import DriveSearch
from fleetmap_server.library import MapLibrary
from fleetmap_server.logs import begin_request, name_caller
from fleetmap_server.problems import BadRequestError, problem_of

_DRIVES_PER_PAGE, _PAGE_BYTES = 50, 512 * 1024

Serve = Callable[[Any, Request], BaseModel | bytes]  # message of the operation's kind, and all of the request


class ZenohFace:
    """Answers the protocol's requests while it stands; use it in a ``with`` statement, or close it.

    Args:
        library: what it serves.
        endpoint: ``tcp/HOST:PORT`` to listen on.
        peers: endpoints of other servers to form a mesh with; they need not be there yet.
        access: who may do what.
        observe: see RequestService.
        localizers: what images are handed on to; None: there is nobody.

    Raises:
        InputError: an endpoint is malformed.
        RunError: the endpoint cannot be listened on.
    """

    def __init__(
        self,
        library: MapLibrary,
        endpoint: str,
        peers: Sequence[str] = (),
        access: Access | None = None,
        observe: Observe | None = None,
        localizers: LocalizerPool | None = None,
    ) -> None:
        self._library, self._access = library, access or Access()
        self._localizers = localizers or LocalizerPool(())
        self._announcer = Announcer(library.catalogue, lambda announcement: self._service.announce(announcement))
        try:
            self._service = RequestService(endpoint, self._handlers(), problem_of, peers, observe)
        except BaseException:
            self._announcer.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def server_id(self) -> str:
        """The identity of this process among the servers of a mesh."""
        return self._service.server_id

    def vehicles_online(self) -> int:
        """How many vehicles are connected, to this server or another of its mesh."""
        return len(self._service.vehicles.now)

    def drain(self, timeout_s: float, hurry: Event | None = None) -> bool:
        """Let transfers under way come to their ends; see RequestService.drain."""
        return self._service.drain(timeout_s, hurry)

    def close(self) -> None:
        """Finish what has been taken, take no more, and hang up."""
        self._announcer.close()
        self._service.close()

    def _handlers(self) -> Mapping[str, Handler]:
        maps: dict[str, Serve] = {
            protocol.HELLO: self._hello,
            protocol.MAPS: lambda message, request: self._library.page(message),
            protocol.MAPS_ROLLBACK: self._rollback,
            protocol.MAPS_RETIRE: self._retire,
            protocol.ANNOUNCEMENTS: self._announcements,
            protocol.MANIFEST: lambda message, request: self._library.manifest_ticket(
                message.map_id, message.version
            ),
            protocol.CHUNK: self._chunk,
            protocol.LOCALIZE: self._localize,
            protocol.UPLOAD_BEGIN: lambda message, request: self._library.begin(message),
            protocol.UPLOAD_CHUNK: self._receive,
            protocol.UPLOAD_COMMIT: self._commit,
        }
        operations = maps | _drives_and_jobs(self._library)
        return {name: self._handler(name, serve) for name, serve in operations.items()}

    def _handler(self, operation: str, serve: Serve) -> Handler:
        """A function of checked parameters, for those who may, as one of words and bytes."""
        kind, right = OPERATIONS[operation].request, OPERATIONS[operation].right

        def handle(request: Request) -> bytes:
            begin_request()
            name_caller(self._access.require(request.token, right).name)
            answer = serve(kind.model_validate(dict(request.parameters)), request)
            return answer if isinstance(answer, bytes) else answer.model_dump_json().encode()

        return handle

    def _hello(self, message: protocol.HelloRequest, request: Request) -> BaseModel:
        caller = self._access.caller(request.token)
        return protocol.Hello(
            service=protocol.MAP_SERVER,
            protocol=protocol.PROTOCOL_VERSION,
            fleetmap_version=__version__,
            server_id=request.server_id,
            catalogue_id=self._library.catalogue.identity(),
            may_read=caller.may("read"),
            may_write=caller.may("write"),
        )

    def _announcements(self, message: protocol.AnnouncementsRequest, request: Request) -> BaseModel:
        return announcements_after(self._library.catalogue, message.after)

    def _chunk(self, message: protocol.ChunkRequest, request: Request) -> bytes:
        return self._library.chunk(message.version, message.sha256, message.offset, message.length_bytes)

    def _localize(self, message: LocalizeRequest, request: Request) -> BaseModel:
        return self._localizers.localize(message, request.payload, request.token)

    def _receive(self, message: protocol.UploadChunkRequest, request: Request) -> BaseModel:
        data = request.payload
        if not 0 < len(data) <= protocol.UPLOAD_CHUNK_BYTES:
            raise BadRequestError(f"a chunk has 1 to {protocol.UPLOAD_CHUNK_BYTES} bytes, not {len(data)}")
        sha256, size_bytes, offset = message.sha256, message.size_bytes, message.offset
        if message.version is None:
            received_bytes = self._library.reception.receive(sha256, size_bytes, offset, data)
        else:
            received_bytes = self._library.receive(message.version, sha256, size_bytes, offset, data)
        return protocol.Received(received_bytes=received_bytes)

    def _commit(self, message: protocol.CommitRequest, request: Request) -> BaseModel:
        entry = self._library.commit(message)
        self._announcer.look()
        return entry

    def _rollback(self, message: protocol.RollbackRequest, request: Request) -> BaseModel:
        entry = self._library.rollback(message.map_id, message.version, message.latest)
        self._announcer.look()
        return entry

    def _retire(self, message: protocol.RetireRequest, request: Request) -> BaseModel:
        retired = self._library.retire(message.map_id, message.version)
        return protocol.Retired(map_id=message.map_id, version=message.version, retired=retired)


def _drives_and_jobs(library: MapLibrary) -> dict[str, Serve]:
    """Survey drives, and what workers make of them."""
    reception, jobs = library.reception, library.jobs

    def drives_list(message: protocol.DrivesRequest, request: Request) -> BaseModel:
        page = library.drives.search(
            DriveSearch(
                box=message.area_lonlat,
                start_ns=message.from_ns,
                end_ns=message.until_ns,
                prefix=message.drive,
                limit=_DRIVES_PER_PAGE,
                max_bytes=_PAGE_BYTES,
                after=message.after,
            )
        )
        return protocol.DrivePage(drives=page.entries, next_after=page.after)

    def jobs_list(message: protocol.JobsRequest, request: Request) -> BaseModel:
        if message.job_id is not None:
            return protocol.JobPage(jobs=(jobs.get(message.job_id),))
        page = jobs.page(state=message.state, drive=message.drive, after=message.after)
        return protocol.JobPage(jobs=page.jobs, next_after=page.next_after)

    def finish(message: protocol.FinishRequest, request: Request) -> BaseModel:
        return jobs.finish(message.job_id, message.fence, message.reason, message.give_back)

    return {
        protocol.DRIVES_LIST: drives_list,
        protocol.DRIVES_BEGIN: lambda message, request: reception.begin(message),
        protocol.DRIVES_COMMIT: lambda message, request: reception.commit(message, _summary(request.payload)),
        protocol.JOBS_LIST: jobs_list,
        protocol.JOBS_TAKE: lambda message, request: protocol.TakenJob(job=jobs.take(message.worker)),
        protocol.JOBS_REPORT: lambda message, request: reception.report(message, _summary(request.payload)),
        protocol.JOBS_FINISH: finish,
        protocol.JOBS_CANCEL: lambda message, request: jobs.cancel(message.job_id),
        protocol.JOBS_RETRY: lambda message, request: jobs.retry(message.job_id),
    }


def _summary(payload: bytes) -> DriveSummary | None:
    if len(payload) > MAX_SUMMARY_BYTES:
        raise BadRequestError(f"a summary has at most {MAX_SUMMARY_BYTES} bytes, not {len(payload)}")
    return DriveSummary.model_validate_json(payload) if payload else None
