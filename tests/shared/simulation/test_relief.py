"""Hills: smooth, as steep as asked for, and made of flat pieces that fit."""

from __future__ import annotations

import numpy as np

from fleetmap.simulation.relief import Profile, Terrain, shape_profile

_BANDS_M = np.array([[-8.0, 8.0], [52.0, 68.0], [132.0, 148.0]])


def _profile(seed: int) -> Profile:
    return shape_profile(np.random.default_rng(seed), _BANDS_M, 0.04, 0.08, 60.0)


def test_a_profile_is_even_in_its_bands_and_steep_between_them() -> None:
    steepest = []
    for seed in range(20):
        profile = _profile(seed)
        for low, high in _BANDS_M.tolist():
            assert np.ptp(profile.slope(np.linspace(low, high, 9))) < 1e-12
        everywhere = profile.slope(np.linspace(-70.0, 210.0, 999))
        assert np.abs(everywhere).max() <= 0.0801
        steepest.append(np.abs(everywhere).max())
        assert np.ptp(profile.height_m(np.linspace(-70.0, 210.0, 999))) < 12.0
    assert np.median(steepest) > 0.03


def test_heights_are_the_integral_of_slopes() -> None:
    profile = _profile(3)
    x = np.linspace(-80.0, 220.0, 400)
    rise = (profile.height_m(x + 1e-4) - profile.height_m(x - 1e-4)) / 2e-4
    np.testing.assert_allclose(rise, profile.slope(x), atol=2e-6)


def test_pieces_between_any_cuts_are_flat_and_normals_stand_on_them() -> None:
    terrain = Terrain(0.7, np.array([5.0, -3.0, 1.0]), _profile(1), _profile(2))
    u, v = np.array([2.0, 7.0, 7.0, 2.0]), np.array([60.0, 60.0, 55.0, 55.0])
    corners = terrain.at(u, v, 0.5)
    normal = np.cross(corners[1] - corners[0], corners[3] - corners[0])
    assert abs((corners[2] - corners[0]) @ normal) < 1e-9 * np.linalg.norm(normal)
    up = terrain.up(3.0, 57.0)
    ahead = [terrain.at(3.0 + du, 57.0 + dv) - terrain.at(3.0, 57.0) for du, dv in ((1e-4, 0.0), (0.0, 1e-4))]
    assert max(abs(step @ up) for step in ahead) < 1e-8
    assert up[2] > 0.99
