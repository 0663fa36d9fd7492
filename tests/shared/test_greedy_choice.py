"""The order of use against a greedy choice that looks at every gain again, in plain numpy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from fleetmap.greedy_choice import Views, order_of_use

Array = NDArray[np.float64]

_KEYFRAMES, _LANDMARKS, _CHOSEN = 6, 80, 15
_F_PX = 400.0


@pytest.fixture(scope="module")
def views() -> Views:
    """Every keyframe sees all landmarks, 4 to 150 m before it, and each in a part of the image of its own."""
    rng = np.random.default_rng(0)
    z = np.exp(rng.uniform(np.log(4.0), np.log(150.0), _LANDMARKS))
    points_m = np.stack(
        [rng.uniform(-0.8, 0.8, _LANDMARKS) * z, rng.uniform(-0.3, 0.3, _LANDMARKS) * z, z], axis=1
    )
    in_cam = np.repeat(points_m, _KEYFRAMES, axis=0) + np.tile(
        np.arange(_KEYFRAMES)[:, None] * [0.0, 0.0, 1.0], (_LANDMARKS, 1)
    )
    x, y, z = in_cam.T
    zero, scale = np.zeros_like(z), _F_PX / z
    by_point = np.stack([scale, zero, -scale * x / z, zero, scale, -scale * y / z], axis=1).reshape(-1, 2, 3)
    by_turn = np.cross(by_point, in_cam[:, None, :])
    count = len(in_cam)
    return Views(
        np.arange(_LANDMARKS + 1) * _KEYFRAMES,
        np.tile(np.arange(_KEYFRAMES), _LANDMARKS),
        np.arange(count),
        count,
        _KEYFRAMES,
        np.concatenate([by_turn, -by_point], axis=2).astype(np.float32),
    )


def log_det_of_positions(views: Views, chosen: NDArray[np.int64]) -> float:
    """Of the covariances, summed over keyframes; 0.1 rad and 1 m are known before."""
    jacobians = views.jacobians.astype(np.float64).reshape(_LANDMARKS, _KEYFRAMES, 2, 6)[chosen]
    information = np.einsum("lkai,lkaj->kij", jacobians, jacobians) + np.diag([1e2] * 3 + [1.0] * 3)
    return float(np.linalg.slogdet(np.linalg.inv(information)[:, 3:, 3:])[1].sum())


def plain_greedy(views: Views) -> NDArray[np.int64]:
    chosen: list[int] = []
    for _ in range(_CHOSEN):
        left = [n for n in range(_LANDMARKS) if n not in chosen]
        chosen.append(min(left, key=lambda n: log_det_of_positions(views, np.array([*chosen, n]))))
    return np.array(chosen)


def test_positions_are_as_well_known_as_by_a_greedy_choice_that_takes_no_short_cuts(views: Views) -> None:
    ones = np.ones(_LANDMARKS)
    lazy, plain = order_of_use(ones, ones, views)[:_CHOSEN], plain_greedy(views)
    at_random = np.random.default_rng(1).permutation(_LANDMARKS)[:_CHOSEN]
    gained = [log_det_of_positions(views, chosen) for chosen in (lazy, plain, at_random)]
    known_before = log_det_of_positions(views, np.empty(0, np.int64))
    by_lazy, by_plain, by_chance = (known_before - each for each in gained)
    assert 0.99 < by_lazy / by_plain < 1.01
    assert by_chance < 0.9 * by_plain


def test_of_landmarks_alike_the_likelier_and_the_cheaper_come_first(views: Views) -> None:
    """Three times the same landmarks."""
    starts = np.arange(3 * _LANDMARKS + 1) * _KEYFRAMES
    thrice = Views(
        starts,
        np.tile(views.keyframes, 3),
        np.arange(starts[-1]),
        int(starts[-1]),
        _KEYFRAMES,
        np.tile(views.jacobians, (3, 1, 1)),
    )
    chances = np.repeat([0.5, 1.0, 0.5], _LANDMARKS)
    costs = np.repeat([2.0, 2.0, 1.0], _LANDMARKS)
    rank = np.argsort(order_of_use(chances, costs, thrice)).reshape(3, _LANDMARKS)
    assert np.mean(rank[1] < rank[0]) > 0.95
    assert np.mean(rank[2] < rank[0]) > 0.95


def test_everything_is_ordered_and_what_has_no_chance_comes_last(views: Views) -> None:
    chances = np.ones(_LANDMARKS)
    chances[::4] = 0.0
    order = order_of_use(chances, np.ones(_LANDMARKS), views)
    assert sorted(order) == list(range(_LANDMARKS))
    assert set(order[-_LANDMARKS // 4 :]) == set(range(0, _LANDMARKS, 4))


def test_what_almost_touches_the_lens_does_not_upset_the_order(views: Views) -> None:
    """Two landmarks, centimetres before it."""
    jacobians = views.jacobians.copy()
    jacobians[: 2 * _KEYFRAMES, :, 3:] *= 100.0  # derivatives by the position grow as the distance falls
    ones = np.ones(_LANDMARKS)
    order = order_of_use(ones, ones, replace(views, jacobians=jacobians))
    assert sorted(order) == list(range(_LANDMARKS))
    others, at_random = order[order >= 2][:_CHOSEN], np.random.default_rng(1).permutation(_LANDMARKS)[:_CHOSEN]
    assert log_det_of_positions(views, others) < log_det_of_positions(views, at_random) - 1.0
