"""A depth camera errs with the square of the distance, and sees only so far."""

from __future__ import annotations

import numpy as np

from fleetmap.simulation.depth_camera import DepthErrorModel

_STAMP_NS = 1_700_000_000_000_000_000


def test_noise_grows_with_the_square_of_the_depth() -> None:
    model = DepthErrorModel()
    for depth_m, sigma_m in ((1.0, 0.0012 + 0.0019 * 0.36), (4.0, 0.0258), (9.0, 0.142)):
        depths = np.full((100, 100), depth_m, dtype=np.float32)
        errors = model.measured(depths, _STAMP_NS, seed=1) - depth_m
        assert 0.96 * sigma_m < errors.std() < 1.04 * sigma_m
        assert abs(errors.mean()) < 0.05 * sigma_m


def test_what_is_too_near_too_far_or_sky_has_no_depth() -> None:
    depths = np.array([[0.2, 0.5, 9.9, 10.5, np.inf]], dtype=np.float32)
    measured = DepthErrorModel().measured(depths, _STAMP_NS, seed=1)
    np.testing.assert_array_equal(np.isnan(measured), [[True, False, False, True, True]])


def test_each_image_has_its_own_noise_and_the_same_seed_the_same() -> None:
    depths, model = np.full((20, 20), 5.0, dtype=np.float32), DepthErrorModel()
    first = model.measured(depths, _STAMP_NS, seed=1)
    np.testing.assert_array_equal(first, model.measured(depths, _STAMP_NS, seed=1))
    assert np.abs(first - model.measured(depths, _STAMP_NS + 1, seed=1)).max() > 0.01
    assert np.abs(first - model.measured(depths, _STAMP_NS, seed=2)).max() > 0.01
