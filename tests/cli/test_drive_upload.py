"""What is done with a recording before it is sent."""

from __future__ import annotations

import hashlib

import pytest

from fleetmap.errors import DriveError
from fleetmap_cli.drive_upload import sha256_of


def test_a_recording_is_hashed_whole_and_its_progress_told(survey):
    size_bytes, told = survey.recording.stat().st_size, []
    found = sha256_of(survey.recording, lambda done, total: told.append((done, total)))
    assert found == hashlib.sha256(survey.recording.read_bytes()).hexdigest()
    assert told[-1] == (size_bytes, size_bytes)
    assert told == sorted(told)


@pytest.mark.parametrize("end", [-1, -100_000, 5])
def test_what_the_server_would_refuse_is_not_sent_first(survey, tmp_path, end):
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(survey.recording.read_bytes()[:end])
    with pytest.raises(DriveError, match=r"cut\.mcap: "):
        sha256_of(cut, lambda done, total: None)
