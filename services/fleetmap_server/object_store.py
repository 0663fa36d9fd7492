"""Where the bytes lie: a local folder, or a bucket of S3, Google Cloud Storage or Azure, behind one interface.

Objects are written whole or not at all, under keys that are never used twice, and never changed. A local one is
written beside its place, flushed to the disk and then linked into it, so that what has a name has its bytes too.
"""

from __future__ import annotations

import os
import re
import shutil
import time
import uuid
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit
from urllib.request import url2pathname

import obstore
from obstore.exceptions import AlreadyExistsError, BaseError
from obstore.store import LocalStore, from_url

from fleetmap.errors import InputError, StorageError
from fleetmap_server.flushed_files import delete_with_empty_folder, link_flushed, write_flushed

STREAM_BYTES = 4 * 1024 * 1024  # what one request of a stream asks for
_MULTIPART_BYTES = 8 * 1024 * 1024  # S3 takes 10,000 of them: objects of up to 80 GB
_DRAFTS = "drafts"  # a local folder's files in the making
_FOLDER_ADVICE = "free some space or check its permissions"
_BUCKET_ADVICE = "check its address, and the credentials in the environment"
_SCHEMES = ("s3", "s3a", "gs", "az", "azure", "abfs", "abfss")


class ObjectMissingError(StorageError):
    """There is no object under a key."""


class ObjectExistsError(StorageError):
    """There is an object under a key already."""


@dataclass(frozen=True)
class ObjectState:
    """What an object is like; ``etag`` changes whenever its bytes do."""

    size_bytes: int
    etag: str


class ObjectStore:
    """A folder (made if it is not there) or ``s3://``, ``gs://``, ``az://`` with a bucket and a prefix.

    Credentials and endpoints come from the environment, as AWS_ACCESS_KEY_ID, AWS_ENDPOINT_URL and their kin.
    Safe to use from several threads. Every method raises StorageError with the store's own words.

    Raises:
        InputError: no such kind of store.
        StorageError: the folder cannot be made.
    """

    def __init__(self, url_or_folder: str) -> None:
        self._folder = _local_folder(url_or_folder)
        self.shown = url_or_folder if self._folder is None else str(self._folder)
        self._advice = _BUCKET_ADVICE if self._folder is None else _FOLDER_ADVICE
        self._store: Any = _remote(url_or_folder) if self._folder is None else self._local(self._folder)

    def check(self) -> None:
        """Raise StorageError within seconds if the store cannot be reached, or a folder not be written."""
        if self._folder is not None:
            draft = self._folder / _DRAFTS / uuid.uuid4().hex
            with self._errors("write"):
                draft.parent.mkdir(exist_ok=True)
                draft.touch()
                draft.unlink()
            return
        with self._errors("reach"):
            next(iter(obstore.list(_remote(self.shown, patience_s=3), "blobs", chunk_size=1)), None)

    def put(self, key: str, data: bytes) -> ObjectState:
        """Write a new object. Raises ObjectExistsError if there is one under the key."""
        if self._folder is not None:
            return self._write_file(key, (data,))
        with self._errors("write", key):
            result = obstore.put(self._store, key, data, mode="create", use_multipart=False)
        return ObjectState(len(data), _etag(result["e_tag"]))

    def put_stream(self, key: str, pieces: Iterable[bytes]) -> ObjectState:
        """Write a new object from its bytes in turn, in bounded memory; what ``pieces`` raises comes through.

        Of two who write one key in a bucket at the same time the later one stays; they had better agree.

        Raises:
            ObjectExistsError: there is one under the key.
        """
        if self._folder is not None:
            return self._write_file(key, pieces)
        if self.head(key) is not None:
            raise ObjectExistsError(f"{self.shown} has {key} already")
        with (
            self._errors("write", key),
            obstore.open_writer(self._store, key, buffer_size=_MULTIPART_BYTES, max_concurrency=2) as writer,
        ):
            for piece in pieces:  # leaving the block by an exception, the writer takes everything back
                writer.write(piece)
        state = self.head(key)
        if state is None:
            raise ObjectMissingError(f"{self.shown}: {key} is gone again")
        return state

    def read(self, key: str, offset: int, length: int) -> bytes:
        """At most ``length`` bytes from ``offset`` on, which lies inside. Raises ObjectMissingError."""
        return self.read_with_state(key, offset, length)[0]

    def read_with_state(self, key: str, offset: int, length: int) -> tuple[bytes, ObjectState]:
        """The same, and the state of the object that the bytes are from."""
        with self._errors("read", key):
            if self._folder is not None:
                return _read_file(self._folder / key, offset, length)
            found = obstore.get(self._store, key, options={"range": (offset, offset + length)})
            return bytes(found.bytes()), ObjectState(found.meta["size"], _etag(found.meta["e_tag"]))

    def stream(self, key: str, offset: int = 0, length: int | None = None) -> Iterator[bytes]:
        """The bytes in turn, at most ``STREAM_BYTES`` at a time. Raises ObjectMissingError."""
        end = self._size_bytes(key) if length is None else offset + length
        while offset < end:
            data, state = self.read_with_state(key, offset, min(STREAM_BYTES, end - offset))
            yield data
            offset, end = offset + len(data), min(end, state.size_bytes)

    def head(self, key: str) -> ObjectState | None:
        """What an object is like, None if there is none."""
        try:
            with self._errors("read", key):
                if self._folder is not None:
                    return _file_state((self._folder / key).stat())
                found = obstore.head(self._store, key)
        except ObjectMissingError:
            return None
        return ObjectState(found["size"], _etag(found["e_tag"]))

    def keys(self, prefix: str) -> Iterator[tuple[str, int]]:
        """Keys below a prefix (whole segments of it) with their sizes in bytes, in no order."""
        with self._errors("list", prefix):
            for page in obstore.list(self._store, prefix, chunk_size=1000):
                for found in page:
                    yield found["path"], found["size"]

    def delete(self, keys: Iterable[str]) -> None:
        """Delete objects; those that are not there are no matter."""
        wanted = list(keys)
        if self._folder is not None:
            with self._errors("delete"):
                for key in wanted:
                    delete_with_empty_folder(self._folder / key)
            return
        for start in range(0, len(wanted), 1000):
            with self._errors("delete"), suppress(FileNotFoundError):
                obstore.delete(self._store, wanted[start : start + 1000])

    def free_bytes(self) -> int | None:
        """Room left on the disk; None where the store does not say."""
        if self._folder is None:
            return None
        with self._errors("read"):
            return shutil.disk_usage(self._folder).free

    def local_path(self, key: str) -> Path | None:
        """The file of an object; None if it is none."""
        return None if self._folder is None else self._folder / key

    def delete_drafts(self, older_than_s: float) -> None:
        """Remove what a process that died left behind while it wrote; a bucket has rules of its own for that."""
        if self._folder is None:
            return
        with self._errors("delete"):
            for draft in (self._folder / _DRAFTS).glob("*"):
                with suppress(FileNotFoundError):
                    if draft.stat().st_mtime < time.time() - older_than_s:
                        draft.unlink()

    def _size_bytes(self, key: str) -> int:
        state = self.head(key)
        if state is None:
            raise ObjectMissingError(f"{self.shown}: {key} is not there")
        return state.size_bytes

    def _local(self, folder: Path) -> LocalStore:
        with self._errors("write"):
            (folder / _DRAFTS).mkdir(parents=True, exist_ok=True)
            return LocalStore(folder)

    def _write_file(self, key: str, pieces: Iterable[bytes]) -> ObjectState:
        assert self._folder is not None
        target, draft = self._folder / key, self._folder / _DRAFTS / uuid.uuid4().hex
        if target.exists():
            raise ObjectExistsError(f"{self.shown} has {key} already")
        try:
            with self._errors("write", key):
                write_flushed(draft, pieces)
                state = self.head(f"{_DRAFTS}/{draft.name}")
                link_flushed(draft, target, self._folder)
        finally:
            with suppress(OSError):
                draft.unlink(missing_ok=True)
        if state is None:
            raise StorageError(f"{self.shown} lost {key} while it was written; {self._advice}")
        return state

    @contextmanager
    def _errors(self, doing: str, key: str = "") -> Iterator[None]:
        where = f"{self.shown}: {key}" if key else self.shown
        try:
            yield
        except (AlreadyExistsError, FileExistsError) as error:
            raise ObjectExistsError(f"{where} is there already") from error
        except (BaseError, OSError) as error:
            if isinstance(error, FileNotFoundError) and doing == "read" and "NoSuchBucket" not in str(error):
                raise ObjectMissingError(f"{where} is not there") from error
            raise StorageError(f"cannot {doing} {where}: {_reason(error)}; {self._advice}") from error


def _local_folder(url_or_folder: str) -> Path | None:
    """The folder that is meant, None for a bucket."""
    scheme, separator, _ = url_or_folder.partition("://")
    if not separator:
        return Path(url_or_folder).absolute()
    if scheme == "file":
        return Path(url2pathname(urlsplit(url_or_folder).path))
    if scheme not in _SCHEMES:
        raise InputError(
            f"'{url_or_folder}' is no store; give a folder, or s3://BUCKET/PREFIX, gs://BUCKET/PREFIX, "
            "az://CONTAINER/PREFIX"
        )
    return None


def _remote(url: str, patience_s: int = 60) -> Any:
    """A bucket; one request is given up after ``patience_s``, and a failed one repeated for 10 s."""
    plain_http = os.environ.get("AWS_ENDPOINT_URL", "").startswith("http://")
    try:
        return from_url(
            url,
            client_options={"allow_http": plain_http, "connect_timeout": "3s", "timeout": f"{patience_s}s"},
            retry_config={
                "max_retries": 3,
                "retry_timeout": timedelta(seconds=10),
                "backoff": {"init_backoff": timedelta(milliseconds=100), "max_backoff": timedelta(seconds=1)},
            },
        )
    except (BaseError, ValueError) as error:
        raise InputError(f"'{url}' cannot be used as a store: {_reason(error)}") from error


def _read_file(path: Path, offset: int, length: int) -> tuple[bytes, ObjectState]:
    """Bytes of a file and its state; ten times as fast as by obstore, which asks a thread of its own."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        return os.pread(descriptor, length, offset), _file_state(os.fstat(descriptor))
    finally:
        os.close(descriptor)


def _file_state(status: os.stat_result) -> ObjectState:
    return ObjectState(status.st_size, f"{status.st_ino:x}-{status.st_mtime_ns:x}-{status.st_size:x}")


def _etag(told: str | None) -> str:
    return told or ""


def _reason(error: Exception) -> str:
    """The store's own words, in one line."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    text, _, details = str(error).partition("Debug source")
    if answer := re.search(r"<Code>(.*?)</Code>.*?<Message>(.*?)</Message>", text, re.DOTALL):
        return f"{answer[1]}: {answer[2]}"
    cause = re.search(r'message: "(.*?)"', details)
    said = re.sub(r" in [\d.]+[mµ]?s\b(, after .*? retry_timeout: \w+)?", "", " ".join(text.split()))
    return f"{said}: {cause[1]}" if cause and cause[1] not in said else said
