from __future__ import annotations

import json
import os
import signal
import threading
from pathlib import Path
from typing import Any

import pytest
from mcap.writer import Writer

from fleetmap.errors import (
    DriveError,
    InputError,
    NoPoseError,
    ServerRefusedError,
    ServerUnreachableError,
    StorageError,
    TransferError,
)
from fleetmap_cli.watching import (
    LONGEST_PAUSE_S,
    DriveWatcher,
    UnfitMapError,
    stop_on_signals,
    watch_folder,
)


def write_recording(path: Path, text: str = "a drive") -> Path:
    """A small, complete MCAP."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        writer.add_attachment(0, 0, "note.txt", "text/plain", text.encode())
        writer.finish()
    return path


class Mapper:
    """Stands where mapping and publishing stand: notes the drives, and ends each as told."""

    def __init__(self, **ends: BaseException) -> None:
        self.ends = ends
        self.drives: list[str] = []

    def __call__(self, drive: Path) -> None:
        self.drives.append(drive.name)
        if end := self.ends.get(drive.stem):
            raise end


def look_twice(folder: Path, mapper: Mapper, stop: threading.Event | None = None) -> bool:
    watcher = DriveWatcher(folder, mapper, stop or threading.Event())
    watcher.scan_once()
    return watcher.scan_once()


def record(folder: Path, name: str) -> dict[str, Any]:
    loaded: dict[str, Any] = json.loads((folder / ".fleetmap" / f"{name}.json").read_text())
    return loaded


def test_a_drive_is_handled_once_and_remembered_over_a_restart(tmp_path: Path) -> None:
    write_recording(tmp_path / "a.mcap")
    mapper = Mapper()
    watcher = DriveWatcher(tmp_path, mapper, threading.Event())
    assert [watcher.scan_once() for _ in range(4)] == [True] * 4
    assert look_twice(tmp_path, mapper)
    assert mapper.drives == ["a.mcap"]
    done = record(tmp_path, "a.mcap")
    assert (done["status"], done["reason"]) == ("done", None)
    assert len(done["sha256"]) == 64


def test_a_drive_still_being_copied_is_waited_for(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    whole = write_recording(tmp_path / "whole").read_bytes()
    mapper = Mapper()
    watcher = DriveWatcher(tmp_path, mapper, threading.Event())
    drive = tmp_path / "a.mcap"
    for size in (0, 5, 40, len(whole) - 1):
        drive.write_bytes(whole[:size])
        for _ in range(3):
            watcher.scan_once()
    assert mapper.drives == []
    assert capsys.readouterr().err.count("the end of the recording is missing") == 4
    drive.write_bytes(whole)
    watcher.scan_once()
    assert mapper.drives == []  # it may still grow: unchanged is only known at the next look
    watcher.scan_once()
    assert mapper.drives == ["a.mcap"]


def test_a_drive_that_changes_between_two_looks_is_left_alone(tmp_path: Path) -> None:
    mapper = Mapper()
    watcher = DriveWatcher(tmp_path, mapper, threading.Event())
    for number in range(4):
        write_recording(tmp_path / "a.mcap", "x" * (10 + number))
        watcher.scan_once()
    assert mapper.drives == []


@pytest.mark.parametrize(
    ("end", "status", "reason"),
    [
        (DriveError("b.mcap has no images"), "failed", "b.mcap has no images"),
        (NoPoseError("not enough motion"), "failed", "not enough motion"),
        (ServerRefusedError("this vehicle may not publish"), "failed", "this vehicle may not publish"),
        (ZeroDivisionError("float division by zero"), "failed", "ZeroDivisionError: float division by zero"),
        (UnfitMapError("GNSS residuals of 4 m"), "unfit", "GNSS residuals of 4 m"),
    ],
)
def test_a_drive_that_fails_is_recorded_with_its_reason_and_stops_nobody(
    tmp_path: Path, end: Exception, status: str, reason: str
) -> None:
    for name in "abc":
        write_recording(tmp_path / f"{name}.mcap", name)
    mapper = Mapper(b=end)
    assert look_twice(tmp_path, mapper)
    assert look_twice(tmp_path, mapper)
    assert mapper.drives == ["a.mcap", "b.mcap", "c.mcap"]
    assert [record(tmp_path, f"{name}.mcap")["status"] for name in "abc"] == ["done", status, "done"]
    assert record(tmp_path, "b.mcap")["reason"] == reason


def test_while_the_server_is_away_nothing_is_marked_and_no_other_drive_is_begun(tmp_path: Path) -> None:
    for name in "ab":
        write_recording(tmp_path / f"{name}.mcap", name)
    mapper = Mapper(a=ServerUnreachableError("no map server answered at tcp/127.0.0.1:1"))
    watcher = DriveWatcher(tmp_path, mapper, threading.Event())
    assert [watcher.scan_once() for _ in range(3)] == [True, False, False]
    assert mapper.drives == ["a.mcap", "a.mcap"]
    assert not list((tmp_path / ".fleetmap").iterdir())
    mapper.ends.clear()
    assert watcher.scan_once()
    assert mapper.drives == ["a.mcap", "a.mcap", "a.mcap", "b.mcap"]
    assert record(tmp_path, "a.mcap")["status"] == "done"


@pytest.mark.parametrize("end", [TransferError("connection lost"), StorageError("disk full")])
def test_a_broken_transfer_or_a_full_disk_is_tried_again_after_the_others(tmp_path: Path, end: Exception) -> None:
    for name in "ab":
        write_recording(tmp_path / f"{name}.mcap", name)
    mapper = Mapper(a=end)
    watcher = DriveWatcher(tmp_path, mapper, threading.Event())
    assert [watcher.scan_once() for _ in range(3)] == [True, False, False]
    assert mapper.drives == ["a.mcap", "b.mcap", "a.mcap"]
    assert not (tmp_path / ".fleetmap" / "a.mcap.json").exists()


def test_a_drive_cut_off_in_the_middle_is_done_again_after_a_restart(tmp_path: Path) -> None:
    write_recording(tmp_path / "a.mcap")
    interrupted = Mapper(a=KeyboardInterrupt())
    watcher = DriveWatcher(tmp_path, interrupted, threading.Event())
    watcher.scan_once()
    with pytest.raises(KeyboardInterrupt):
        watcher.scan_once()
    mapper = Mapper()
    assert look_twice(tmp_path, mapper)
    assert mapper.drives == ["a.mcap"]


def test_a_replaced_drive_is_done_again_but_a_touched_one_is_not(tmp_path: Path) -> None:
    drive = write_recording(tmp_path / "a.mcap", "monday")
    mapper = Mapper()
    look_twice(tmp_path, mapper)
    first = record(tmp_path, "a.mcap")
    os.utime(drive, ns=(1, 1))
    look_twice(tmp_path, mapper)
    touched = record(tmp_path, "a.mcap")
    assert touched["sha256"] == first["sha256"]
    assert touched["files"] == [["a.mcap", drive.stat().st_size, 1]]
    assert mapper.drives == ["a.mcap"]
    write_recording(drive, "friday")
    look_twice(tmp_path, mapper)
    assert mapper.drives == ["a.mcap", "a.mcap"]
    assert record(tmp_path, "a.mcap")["sha256"] != first["sha256"]


@pytest.mark.parametrize("damage", ["", "{}", "[1]", '{"status": "done"}', "\udcff"])
def test_a_damaged_record_means_the_drive_is_done_again(tmp_path: Path, damage: str) -> None:
    write_recording(tmp_path / "a.mcap")
    look_twice(tmp_path, Mapper())
    (tmp_path / ".fleetmap" / "a.mcap.json").write_bytes(damage.encode(errors="surrogateescape"))
    mapper = Mapper()
    assert look_twice(tmp_path, mapper)
    assert mapper.drives == ["a.mcap"]
    assert record(tmp_path, "a.mcap")["status"] == "done"


def test_a_rosbag2_folder_is_a_drive_and_what_is_none_is_passed_over(tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    bag.mkdir()
    write_recording(bag / "bag_0.mcap")
    (bag / "metadata.yaml").write_text("rosbag2_bagfile_information: {}\n")
    (tmp_path / "empty").mkdir()
    (tmp_path / "notes.txt").write_text("not a drive")
    write_recording(tmp_path / ".half_copied.mcap")
    mapper = Mapper()
    assert look_twice(tmp_path, mapper)
    assert mapper.drives == ["bag"]
    assert record(tmp_path, "bag")["files"][0][0] == "bag_0.mcap"


def test_a_stop_is_heard_between_two_drives(tmp_path: Path) -> None:
    for name in "ab":
        write_recording(tmp_path / f"{name}.mcap", name)
    stop = threading.Event()
    mapped: list[str] = []

    def map_and_stop(drive: Path) -> None:
        mapped.append(drive.name)
        stop.set()

    watch_folder(tmp_path, map_and_stop, poll_s=0.0, stop=stop)
    assert mapped == ["a.mcap"]
    assert record(tmp_path, "a.mcap")["status"] == "done"


class CountedPauses(threading.Event):
    """Keeps the pauses that are asked for instead of waiting, and is set after some of them."""

    def __init__(self, count: int) -> None:
        super().__init__()
        self.count = count
        self.pauses_s: list[float | None] = []

    def wait(self, timeout: float | None = None) -> bool:
        self.pauses_s.append(timeout)
        if len(self.pauses_s) == self.count:
            self.set()
        return self.is_set()


def test_pauses_grow_while_the_server_is_away_and_shrink_when_it_is_back(tmp_path: Path) -> None:
    write_recording(tmp_path / "a.mcap")
    away = Mapper(a=ServerUnreachableError("no answer"))
    stop = CountedPauses(12)
    watch_folder(tmp_path, away, poll_s=2.0, stop=stop)
    expected = [2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0, 256.0, LONGEST_PAUSE_S]
    assert stop.pauses_s[:9] == expected
    assert set(stop.pauses_s[9:]) == {LONGEST_PAUSE_S}

    def back_after_three(drive: Path) -> None:
        away.drives.append(drive.name)
        if len(stop.pauses_s) < 4:
            raise ServerUnreachableError("no answer")

    stop = CountedPauses(6)
    watch_folder(tmp_path, back_after_three, poll_s=2.0, stop=stop)
    assert stop.pauses_s == [2.0, 4.0, 8.0, 16.0, 2.0, 2.0]


def test_a_folder_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such folder"):
        watch_folder(tmp_path / "absent", Mapper(), poll_s=1.0, stop=threading.Event())


def test_a_folder_that_takes_no_records_is_refused_before_any_work(tmp_path: Path) -> None:
    (tmp_path / ".fleetmap").write_text("in the way")
    with pytest.raises(StorageError, match="cannot keep records"):
        watch_folder(tmp_path, Mapper(), poll_s=1.0, stop=threading.Event())


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_first_signal_asks_to_stop_and_a_second_one_interrupts(number: signal.Signals) -> None:
    before = signal.getsignal(number)
    with stop_on_signals() as stop:
        os.kill(os.getpid(), number)
        assert stop.wait(10.0)
        with pytest.raises(KeyboardInterrupt):
            _send_to_self(number)
    assert signal.getsignal(number) is before


def _send_to_self(number: signal.Signals) -> None:
    os.kill(os.getpid(), number)
    threading.Event().wait(10.0)  # the handler runs here at the latest
