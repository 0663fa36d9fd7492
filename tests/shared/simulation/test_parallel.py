"""Several workers make the same images in the same order, and stop cleanly."""

from __future__ import annotations

import itertools
import threading

import numpy as np
import pytest

from fleetmap.camera import Camera
from fleetmap.errors import InputError
from fleetmap.geometry import Pose
from fleetmap.simulation.look import look_of_drive
from fleetmap.simulation.parallel import render_many
from fleetmap.simulation.rendering import render
from fleetmap.simulation.street import Street

CAMERA = Camera(160, 96, 100.0, 100.0, 79.5, 47.5)


@pytest.mark.parametrize("look", ["day", "dusk", "wet"])
def test_two_workers_give_the_bytes_of_one(street: Street, look: str) -> None:
    north_up = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    poses = [Pose(north_up, street.path.at(s, 0.0, 1.6)) for s in np.linspace(2.0, 30.0, 12)]

    def image(pose: Pose) -> bytes:
        return render(street, CAMERA, pose, look_of_drive(look, 4)).tobytes()

    alone, together = (list(render_many(image, poses, workers)) for workers in (1, 2))
    assert alone == together
    assert len(set(alone)) == len(poses)


def test_few_jobs_are_read_ahead_so_that_they_may_be_endless() -> None:
    read = itertools.count()
    results = render_many(lambda job: job * job, (next(read) for _ in itertools.repeat(None)), workers=3)
    assert list(itertools.islice(results, 10)) == [n * n for n in range(10)]
    assert next(read) <= 10 + 3 + 2


def test_an_error_arrives_at_its_place_and_no_thread_stays_behind() -> None:
    def divide(job: int) -> float:
        return 12.0 / job

    results = render_many(divide, [3, 2, 0, 1, 4], workers=2)
    assert [next(results), next(results)] == [4.0, 6.0]
    with pytest.raises(ZeroDivisionError):
        next(results)
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("render")]


def test_a_caller_who_stops_early_leaves_no_thread_behind() -> None:
    results = render_many(lambda job: job, itertools.count(), workers=2)
    assert next(iter(results)) == 0
    del results
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("render")]


def test_no_worker_at_all_is_refused() -> None:
    with pytest.raises(InputError, match="at least 1 worker, not 0"):
        render_many(lambda job: job, [1], workers=0)
