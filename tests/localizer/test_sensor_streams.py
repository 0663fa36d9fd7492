"""Sensors read along with the images: each sample once, and an IMU between any two moments."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from fleetmap.drive import ImuSample, WheelSpeed
from fleetmap_localizer.sensor_streams import ImuStream, SensorStream

MS = 1_000_000


def test_samples_are_taken_once_and_only_when_they_are_due() -> None:
    stream = SensorStream(WheelSpeed(stamp_ns, float(stamp_ns)) for stamp_ns in (1, 3, 4, 9))
    assert stream.take_until(0) is None
    assert stream.take_until(3) == WheelSpeed(1, 1.0)
    assert stream.skip_until(4) == WheelSpeed(4, 4.0)
    assert stream.next == WheelSpeed(9, 9.0)
    assert stream.skip_until(8) is None
    assert stream.take_until(100) == WheelSpeed(9, 9.0)
    assert stream.next is None


def test_an_endless_stream_is_read_one_sample_ahead() -> None:
    read = []

    def endless() -> Iterator[WheelSpeed]:
        for stamp_ns in range(10**9):
            read.append(stamp_ns)
            yield WheelSpeed(stamp_ns, 0.0)

    SensorStream(endless()).skip_until(50)
    assert len(read) == 52


def an_imu(stamps_ms: list[int], longest_pause_s: float = 0.1) -> ImuStream:
    """Turn rate about x and force along z are the time in milliseconds, and ten times that."""
    samples = (ImuSample(t * MS, np.array([t, 0.0, 0.0]), np.array([0.0, 0.0, 10.0 * t])) for t in stamps_ms)
    return ImuStream(samples, longest_pause_s)


def test_pieces_cover_the_time_with_the_means_of_what_was_measured() -> None:
    pieces = list(an_imu([0, 10, 20, 30]).between(4 * MS, 25 * MS))
    found = [(piece[0][0], piece[1][2], piece[2]) for piece in pieces if piece is not None]
    assert np.array(found) == pytest.approx(
        np.array([(7.0, 70.0, 0.006), (15.0, 150.0, 0.010), (22.5, 225.0, 0.005)])
    )


def test_the_next_call_goes_on_where_the_last_one_ended() -> None:
    imu = an_imu([0, 10, 20])
    first, second = (list(imu.between(start * MS, end * MS)) for start, end in ((4, 13), (13, 20)))
    durations_s = [[piece[2] for piece in pieces if piece is not None] for pieces in (first, second)]
    assert durations_s[0] == pytest.approx([0.006, 0.003])
    assert durations_s[1] == pytest.approx([0.007])


def test_after_its_last_sample_it_holds_for_a_moment_only() -> None:
    imu = an_imu([0, 10])
    (first, held) = list(imu.between(5 * MS, 60 * MS))
    assert first is not None
    assert held is not None
    assert (held[0][0], held[2]) == (10.0, pytest.approx(0.050))
    assert list(imu.between(60 * MS, 200 * MS)) == [None]


@pytest.mark.parametrize("start_ms", [-5, 12])
def test_nothing_is_known_before_its_first_sample_and_across_a_pause(start_ms: int) -> None:
    pieces = list(an_imu([0, 10, 200, 210]).between(start_ms * MS, 205 * MS))
    assert pieces == [None]
