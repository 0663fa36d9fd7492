from __future__ import annotations

import os
from pathlib import Path

import pytest

from fleetmap.errors import OutputExistsError, StorageError
from fleetmap.files import atomic_path, refuse_existing, write_bytes_atomically, write_text_atomically


def fail_while_writing(target: Path, error: BaseException) -> None:
    with atomic_path(target) as draft:
        draft.write_text("half")
        raise error


def test_a_file_appears_whole_and_alone(tmp_path):
    target = tmp_path / "new" / "folder" / "a.txt"
    write_text_atomically(target, "größer")
    assert target.read_bytes() == "größer".encode()
    assert list(target.parent.iterdir()) == [target]


def test_a_file_replaces_the_old_one_only_at_the_end(tmp_path):
    target = tmp_path / "a.txt"
    target.write_text("old")
    with atomic_path(target) as draft:
        draft.write_text("new")
        assert draft.parent == target.parent
        assert target.read_text() == "old"
    assert target.read_text() == "new"
    assert list(tmp_path.iterdir()) == [target]


@pytest.mark.parametrize("error", [ValueError("bad"), KeyboardInterrupt()])
def test_an_error_leaves_the_old_file_and_nothing_else(tmp_path, error):
    target = tmp_path / "a.txt"
    target.write_text("old")
    with pytest.raises(type(error)):
        fail_while_writing(target, error)
    assert target.read_text() == "old"
    assert list(tmp_path.iterdir()) == [target]


def test_a_refusing_disk_is_a_storage_error_with_the_targets_name(tmp_path):
    target = tmp_path / "a.txt"
    with pytest.raises(StorageError, match=r"cannot write .*a\.txt: No space left on device"):
        fail_while_writing(target, OSError(28, os.strerror(28)))
    assert list(tmp_path.iterdir()) == []


def test_a_file_in_the_way_of_a_folder_is_a_storage_error(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(StorageError, match="cannot write"):
        write_bytes_atomically(tmp_path / "file" / "a.txt", b"")


def test_a_file_never_takes_a_folders_place(tmp_path):
    (tmp_path / "results").mkdir()
    (tmp_path / "results" / "a.txt").write_text("precious")
    with pytest.raises(StorageError, match=r"cannot write .*results: "):
        write_bytes_atomically(tmp_path / "results", b"")
    assert (tmp_path / "results" / "a.txt").read_text() == "precious"
    assert [path.name for path in tmp_path.iterdir()] == ["results"]


def test_folders_appear_and_are_replaced_whole(tmp_path):
    target = tmp_path / "map"
    for content in ("first", "second"):
        with atomic_path(target) as draft:
            draft.mkdir()
            (draft / content).write_text(content)
        assert [path.name for path in target.iterdir()] == [content]
    assert list(tmp_path.iterdir()) == [target]


def test_a_folder_half_made_is_removed_and_the_old_one_stays(tmp_path):
    target = tmp_path / "map"
    target.mkdir()
    (target / "kept").touch()

    def fail() -> None:
        with atomic_path(target) as draft:
            draft.mkdir()
            (draft / "half").touch()
            raise ValueError("bad")

    with pytest.raises(ValueError, match="bad"):
        fail()
    assert [path.name for path in target.iterdir()] == ["kept"]
    assert list(tmp_path.iterdir()) == [target]


def test_an_existing_output_is_refused_unless_forced(tmp_path):
    target = tmp_path / "a.txt"
    refuse_existing(target, force=False)
    target.touch()
    refuse_existing(target, force=True)
    with pytest.raises(OutputExistsError, match=r"a\.txt exists already.*--force"):
        refuse_existing(target, force=False)
