"""The rows of honesty: NEES of draws that are as honest as made, and draws that differ."""

from __future__ import annotations

import numpy as np
import pytest

from fleetmap_cli.benchmarks.foreign_images import SPOILERS
from fleetmap_cli.benchmarks.localizer_honesty import Judged, consistency
from fleetmap_cli.benchmarks.simulated_draws import STREETS, Draw


@pytest.mark.parametrize(("boast", "low", "high"), [(1.0, 5.0, 7.0), (2.0, 20.0, 28.0), (0.5, 1.2, 1.8)])
def test_sigmas_that_are_told_too_small_raise_nees_by_their_square(boast: float, low: float, high: float) -> None:
    rng = np.random.default_rng(0)
    covariance = np.diag([1e-6, 2e-6, 1e-5, 1e-4, 4e-4, 9e-4])
    drawn = [rng.multivariate_normal(np.zeros(6), covariance) for _ in range(300)]
    judged = [Judged(Draw(n, "city"), error, covariance / boast**2) for n, error in enumerate(drawn)]
    figures = consistency([*judged, Judged(Draw(300, "city"))])
    assert (figures["draws"], figures["poses"]) == (301, 300)
    assert low < float(figures["NEES"] or 0.0) < high
    inside = float(str(figures["inside 95 % ellipsoid"]).removesuffix(" %"))
    assert (92.0 < inside < 98.0) == (boast == 1.0)


def test_draws_repeat_and_differ_in_everything_that_may_deceive() -> None:
    draws = [Draw(number, STREETS[number % len(STREETS)]) for number in range(12)]
    assert [draw.survey() for draw in draws] == [draw.survey() for draw in draws]
    for draw in draws:
        survey, query = draw.survey(), draw.query()
        assert survey.world_seed == query.world_seed
        assert survey.length_of_world_m() == query.length_of_world_m()
        assert survey.drive_seed != query.drive_seed
        assert survey.camera != query.camera
        assert survey.start_m < query.start_m
        assert query.start_m + query.length_m < survey.start_m + survey.length_m
    assert len({draw.survey().world_seed for draw in draws}) == len(draws)
    assert len({(draw.query().look, draw.query().lane_m) for draw in draws}) > 4


def test_spoilt_images_keep_next_to_nothing_of_what_was_seen() -> None:
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, (240, 640), dtype=np.uint8)
    for kind, spoil in SPOILERS.items():
        spoilt = spoil(image, np.random.default_rng(1))
        assert spoilt.dtype == np.uint8
        assert spoilt.shape == image.shape
        assert np.mean(np.abs(spoilt.astype(int) - image) <= 1) < 0.1, kind
