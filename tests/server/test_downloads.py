"""Blobs into files: whole or not at all, from where the last attempt stopped, and never two into one file."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from fleetmap.errors import RunError, ServerRefusedError, StorageError, TransferError
from fleetmap.transport import MapClient
from fleetmap.transport.download import Blob, download_to
from fleetmap.transport.link import ServerLink
from fleetmap_server.server import running_server
from fleetmap_server.settings import ServerSettings

SIZE_BYTES = 3_000_000


@pytest.fixture(scope="module")
def published(tmp_path_factory, module_endpoint, make_map) -> Iterator[tuple[str, Blob, bytes]]:
    """A server's endpoint, a part of a map that it has, and the part's bytes."""
    one = make_map(part_sizes=(SIZE_BYTES,))
    ((sha256, data),) = one.parts.items()
    settings = ServerSettings(str(tmp_path_factory.mktemp("store")), module_endpoint, http_port=0)
    with running_server(settings):
        with MapClient(module_endpoint) as client:
            client.publish(one.manifest_bytes, one.parts.__getitem__)
        yield module_endpoint, Blob(sha256, SIZE_BYTES, one.version, f"part {sha256[:12]}"), data


@pytest.fixture
def link(published) -> Iterator[ServerLink]:
    link = ServerLink(published[0], timeout_s=10.0, patience_s=1.0)
    yield link
    link.close()


def draft_of(path: Path) -> Path:
    return path.with_name(f".{path.name}.part")


def test_a_blob_becomes_a_file_and_leaves_nothing_beside_it(published, link, tmp_path):
    _, blob, data = published
    seen: list[int] = []
    target = tmp_path / "new" / "part.bin"
    download_to(target, link, blob, lambda done_bytes, total_bytes: seen.append(done_bytes))
    assert target.read_bytes() == data
    assert [path.name for path in target.parent.iterdir()] == ["part.bin"]
    assert (seen[0], seen[-1]) == (0, SIZE_BYTES)
    assert seen == sorted(set(seen))


def test_a_download_goes_on_where_it_was_cut(published, link, tmp_path):
    _, blob, data = published
    target = tmp_path / "part.bin"

    def cut(done_bytes: int, total_bytes: int) -> None:
        if done_bytes > SIZE_BYTES // 2:
            raise InterruptedByTestError

    with pytest.raises(InterruptedByTestError):
        download_to(target, link, blob, cut)
    assert not target.exists()
    kept_bytes = draft_of(target).stat().st_size
    seen: list[int] = []
    download_to(target, link, blob, lambda done_bytes, total_bytes: seen.append(done_bytes))
    assert seen[0] == kept_bytes > SIZE_BYTES // 2
    assert target.read_bytes() == data


class InterruptedByTestError(Exception):
    pass


@pytest.mark.parametrize("left_over", [b"other bytes", bytes(SIZE_BYTES), bytes(SIZE_BYTES + 1)])
def test_what_lies_there_and_is_not_the_blob_is_fetched_anew(published, link, tmp_path, left_over):
    _, blob, data = published
    target = tmp_path / "part.bin"
    draft_of(target).write_bytes(left_over)
    download_to(target, link, blob)
    assert target.read_bytes() == data
    assert not draft_of(target).exists()


def test_a_whole_draft_is_taken_without_asking_for_anything(published, link, tmp_path):
    _, blob, data = published
    target = tmp_path / "part.bin"
    draft_of(target).write_bytes(data)
    link.close()
    download_to(target, link, blob)
    assert target.read_bytes() == data


def test_a_blob_with_other_bytes_than_its_name_says_becomes_no_file(published, link, tmp_path):
    _, blob, _ = published
    target = tmp_path / "part.bin"
    short = Blob(blob.sha256, SIZE_BYTES - 1, blob.version, "the part")
    with pytest.raises(TransferError, match=r"the part arrived damaged from tcp/"):
        download_to(target, link, short)
    assert list(tmp_path.iterdir()) == []


def test_an_older_file_stays_when_the_server_has_no_such_blob(published, link, tmp_path):
    target = tmp_path / "part.bin"
    target.write_bytes(b"older")
    with pytest.raises(ServerRefusedError, match="has no data"):
        download_to(target, link, Blob("0" * 64, 10, published[1].version, "a part"))
    assert target.read_bytes() == b"older"


def test_two_downloads_do_not_fill_one_file(published, link, tmp_path):
    endpoint, blob, data = published
    target = tmp_path / "part.bin"
    first_is_at_it, second_was_refused = threading.Event(), threading.Event()

    def wait(done_bytes: int, total_bytes: int) -> None:
        first_is_at_it.set()
        assert second_was_refused.wait(30.0)

    first = threading.Thread(target=download_to, args=(target, link, blob, wait))
    first.start()
    assert first_is_at_it.wait(30.0)
    other = ServerLink(endpoint, timeout_s=10.0, patience_s=1.0)
    with pytest.raises(RunError, match=r"another download is writing .*part\.bin; wait for it"):
        download_to(target, other, blob)
    other.close()
    second_was_refused.set()
    first.join(30.0)
    assert target.read_bytes() == data


def test_a_folder_that_cannot_be_written_is_told(published, link, tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(StorageError, match=r"cannot write .*part\.bin: "):
        download_to(tmp_path / "file" / "part.bin", link, published[1])
