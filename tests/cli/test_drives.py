"""``fleetmap drives`` as a user types it, of a server in another process."""

from __future__ import annotations

import hashlib
import itertools
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from fleetmap.jobs import DriveFinding, DriveSummary
from fleetmap.transport import MapClient

A_DAY_NS = 86_400_000_000_000
FIRST_FRAME = itertools.count()
NEW_YEAR_NS = 1_767_225_600_000_000_000  # 2026-01-01


@dataclass(frozen=True)
class SentDrive:
    sha256: str
    recording: Path


@pytest.fixture
def send_drive(survey_frames, write_drive, tmp_path, shared_server: str) -> Callable[..., SentDrive]:
    """Sends a small recording that was never sent before, with what its sender says of it."""

    def send(name: str, summary: DriveSummary | None = None, map_id: str | None = None) -> SentDrive:
        first = next(FIRST_FRAME)
        recording = write_drive(tmp_path / f"{name}.mcap", survey_frames[first : first + 3])
        sha256 = hashlib.sha256(recording.read_bytes()).hexdigest()
        with MapClient(shared_server) as client:
            client.upload_drive(recording, sha256, map_id=map_id, summary=summary)
        return SentDrive(sha256, recording)

    return send


@pytest.fixture
def drives(fleetmap, shared_server: str) -> Callable[..., tuple[int, str, str]]:
    def call(verb: str, *arguments: object) -> tuple[int, str, str]:
        return fleetmap("drives", verb, *arguments, "--server", shared_server)

    return call


def said(day: int, lon_deg: float) -> DriveSummary:
    return DriveSummary(
        verdict="yes, with warnings",
        reasons="yes, with warnings: texture",
        findings=(DriveFinding(aspect="texture", severity="poor", text="few corners"),),
        start_ns=NEW_YEAR_NS + day * A_DAY_NS,
        end_ns=NEW_YEAR_NS + day * A_DAY_NS + 60_000_000_000,
        trajectory_lonlat=((lon_deg, 49.0), (lon_deg + 0.001, 49.0)),
        length_m=73.0,
        image_count=3,
    )


def test_drives_are_listed_and_shown_with_what_is_known_of_them(drives, send_drive):
    plain, told = send_drive("plain"), send_drive("told", said(3, 8.4), map_id="told-map")
    rows = {line.split()[0]: line for line in drives("list")[1].splitlines()}
    assert "plain.mcap" in rows[plain.sha256[:12]]
    assert "not looked at" in rows[plain.sha256[:12]]
    assert "2026-01-04 00:00:00  73 m    yes, with warnings (says the sender)" in rows[told.sha256[:12]]

    shown = drives("show", told.sha256[:8])[1]
    assert "\ntexture      poor: few corners\n" in shown
    assert "map 'told-map' queued" in shown
    document = json.loads(drives("show", told.sha256, "--json")[1])
    assert (document["size_bytes"], document["name"]) == (told.recording.stat().st_size, "told.mcap")
    assert [job["map_id"] for job in document["jobs"]] == ["told-map"]


def test_drives_are_found_by_place_and_time(drives, send_drive):
    west, east = send_drive("west", said(40, -120.0)).sha256, send_drive("east", said(50, 120.0)).sha256
    both = {west, east}
    for arguments, expected in (
        ((), both),
        (("--area", "-121,48,-119,50"), {west}),
        (("--area", "119,48,-119,50"), both),  # across the antimeridian
        (("--time", "2026-02-20"), {east}),
        (("--time", "../2026-02-15"), {west}),
        (("--area", "-121,48,-119,50", "--time", "2026-02-20"), set()),
    ):
        code, out, _ = drives("list", *arguments, "--json")
        assert (code, {drive["sha256"] for drive in json.loads(out)} & both) == (0, expected), arguments


def test_a_recording_is_fetched_as_it_was_sent_and_a_cut_fetch_goes_on(drives, send_drive, tmp_path, monkeypatch):
    sent = send_drive("fetched")
    folder = tmp_path / "elsewhere"
    folder.mkdir()
    monkeypatch.chdir(folder)
    code, out, _ = drives("get", sent.sha256[:12])
    assert (code, out.split()[0]) == (0, "fetched.mcap")
    whole = sent.recording.read_bytes()
    assert Path("fetched.mcap").read_bytes() == whole

    code, out, err = drives("get", sent.sha256)
    assert (code, out) == (2, "")
    assert "fetched.mcap exists already" in err
    Path("fetched.mcap").write_text("old")
    assert drives("get", sent.sha256, "--force")[0] == 0
    assert Path("fetched.mcap").read_bytes() == whole

    Path(".again.mcap.part").write_bytes(whole[:1000])
    assert drives("get", sent.sha256, "--output", "again.mcap")[0] == 0
    assert Path("again.mcap").read_bytes() == whole


@pytest.mark.parametrize(
    ("drive", "complaint"), [("0123", "is no drive"), ("0" * 12, "has no drive 000000000000")]
)
def test_a_drive_that_is_not_there_is_one_line(drives, drive, complaint):
    for verb in ("show", "get"):
        code, out, err = drives(verb, drive)
        assert (code, out, err.count("\n")) == (2, "", 1)
        assert complaint in err
