"""``fleetmap store`` over a store that a server filled."""

from __future__ import annotations

from pathlib import Path

import pytest

from fleetmap.transport.protocol import BeginRequest, CommitRequest
from fleetmap_cli.benchmarks.made_map import made_map
from fleetmap_server.library import open_library
from fleetmap_server.settings import ServerSettings


@pytest.fixture
def store(tmp_path) -> Path:
    """One map in two versions, the older one retired."""
    folder = tmp_path / "maps"
    with open_library(ServerSettings(folder)) as library:
        for seed in (1, 2):
            new = made_map("karlsruhe", (5000, 400), seed)
            for sha256, data in ((new.version, new.manifest_bytes), *new.parts.items()):
                library.receive(new.version, sha256, len(data), 0, data)
            status = library.begin(BeginRequest(version=new.version, size_bytes=len(new.manifest_bytes)))
            library.commit(CommitRequest(version=new.version, predecessor=status.latest))
        library.retire("karlsruhe", 1)
    return folder


def test_a_store_is_verified_and_damage_is_exit_code_1(fleetmap, store):
    code, out, _ = fleetmap("store", "verify", "--store", store)
    assert (code, "6 blobs" in out, "all well" in out) == (0, True, True)
    damaged = max((store / "blobs").glob("*/*"), key=lambda path: path.stat().st_size)
    damaged.write_bytes(b"x" * damaged.stat().st_size)
    code, out, _ = fleetmap("store", "verify", "--store", store)
    assert (code, "is damaged" in out, out.rstrip().endswith("problems")) == (1, True, True)


def test_what_is_damaged_is_given_up_and_sent_anew(fleetmap, store):
    new = made_map("karlsruhe", (5000, 400), 2)
    sha256, data = max(new.parts.items(), key=lambda part: len(part[1]))
    (damaged,) = (store / "blobs").glob(f"*/{sha256}*")
    damaged.write_bytes(data[:-1] + b"!" if data[-1:] != b"!" else data[:-1] + b"?")
    code, out, _ = fleetmap("store", "verify", "--store", store, "--give-up")
    assert (code, f"blob {sha256[:12]} is damaged" in out) == (1, True)
    with open_library(ServerSettings(store)) as library:
        status = library.begin(BeginRequest(version=new.version, size_bytes=len(new.manifest_bytes)))
        assert [blob.sha256 for blob in status.missing] == [sha256]
        library.receive(new.version, sha256, len(data), 0, data)
        library.commit(CommitRequest(version=new.version, predecessor=status.latest))
    code, out, _ = fleetmap("store", "verify", "--store", store)
    assert (code, "all well" in out) == (0, True)


def test_what_was_backed_up_is_restored(fleetmap, store, tmp_path):
    code, out, _ = fleetmap("store", "backup", tmp_path / "saved", "--store", store)
    assert (code, out.startswith("backed up 6 blobs")) == (0, True)
    code, out, _ = fleetmap("store", "restore", tmp_path / "saved", "--store", tmp_path / "again")
    assert (code, out.startswith("restored 6 blobs")) == (0, True)
    with open_library(ServerSettings(store)) as before, open_library(ServerSettings(tmp_path / "again")) as after:
        assert after.versions("karlsruhe") == before.versions("karlsruhe")
    code, out, err = fleetmap("store", "restore", tmp_path / "saved", "--store", tmp_path / "again")
    assert (code, out, "holds maps or drives already" in err) == (2, "", True)


def test_what_was_retired_is_collected(fleetmap, store):
    code, out, _ = fleetmap("store", "collect", "--store", store)
    assert (code, out.startswith("deleted 3 objects")) == (0, True)
    assert len(list((store / "blobs").glob("*/*"))) == 3
    assert fleetmap("store", "verify", "--store", store)[0] == 0


def test_a_folder_that_is_no_store_is_told_and_left_alone(fleetmap, tmp_path):
    (tmp_path / "empty").mkdir()
    for command in (("verify",), ("collect",), ("backup", tmp_path / "saved")):
        code, out, err = fleetmap("store", *command, "--store", tmp_path / "empty")
        assert (code, out) == (2, "")
        assert "is no map server's store" in err
    assert list((tmp_path / "empty").iterdir()) == []
    assert fleetmap("store", "restore", tmp_path / "nowhere", "--store", tmp_path / "new")[0] == 2
    assert not (tmp_path / "new").exists()
