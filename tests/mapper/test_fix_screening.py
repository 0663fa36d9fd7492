"""Fixes are judged along a path that drifts: gross errors go, good fixes stay, and the clocks' offset is found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fleetmap.geodesy import UtmAnchor
from fleetmap.geometry import Sim3, so3_exp
from fleetmap_mapper.drift_path import Timed, bent
from fleetmap_mapper.fix_screening import ScreenedFixes, screen_fixes
from fleetmap_mapper.georeferencing import GnssTrack
from fleetmap_mapper.settings import GnssGroup

Array = np.ndarray
VIS_FROM_MAP = Sim3(0.21, so3_exp(np.array([1.1, -0.7, 0.4])), np.array([3.0, -2.0, 7.0]))
ARM = np.array([0.4, -1.1, -0.9])
T0_NS = 1_700_000_000_000_000_000
TURNS = ((100.0, 20.0, 90.0), (220.0, 25.0, -80.0), (380.0, 20.0, 90.0), (480.0, 15.0, 90.0))  # at m, radius, deg
SETTINGS = GnssGroup()


def course(length_m: float, turns: tuple[tuple[float, float, float], ...] = TURNS, wavering: float = 1.0) -> Timed:
    """The true path of a level camera at 9 m/s, ten poses a second."""
    seconds = np.arange(int(length_m / 0.9)) * 0.1
    speed = 9.0 + wavering * np.sin(2.0 * np.pi * seconds / 17.0)
    way = np.cumsum(speed) * 0.1
    curvature = np.zeros(len(way))
    for at, radius, angle in turns:
        curvature[(way > at) & (way < at + abs(np.radians(angle)) * radius)] = np.sign(angle) / radius
    heading = 0.4 + np.cumsum(np.convolve(curvature, np.ones(9) / 9.0, "same") * speed * 0.1)
    cos, sin, zero = np.cos(heading), np.sin(heading), np.zeros(len(way))
    positions = np.stack([np.cumsum(speed * 0.1 * cos), np.cumsum(speed * 0.1 * sin), zero], axis=1)
    axes = [np.stack([sin, -cos, zero], 1), np.stack([zero, zero, zero - 1.0], 1), np.stack([cos, sin, zero], 1)]
    return Timed((T0_NS + seconds * 1e9).astype(np.int64), positions, np.stack(axes, axis=2))


def as_slam_has_it(true: Timed, seed: int = 0, loss_per_rad: float = 0.015) -> Timed:
    """Scale and heading wander, scale is lost in turns, positions jitter by 1 cm; in a frame of its own."""
    rng = np.random.default_rng(seed)
    moves = np.diff(true.positions, axis=0)
    length = np.linalg.norm(moves, axis=1)
    turned = np.arccos(np.clip((moves[1:] * moves[:-1]).sum(axis=1) / (length[1:] * length[:-1]), -1.0, 1.0))
    scale = rng.normal(0.0, 2e-3, len(moves)) * np.sqrt(length) - loss_per_rad * np.append(0.0, turned)
    turns = so3_exp(np.cumsum(rng.normal(0.0, 7e-4, (len(moves), 3)) * np.sqrt(length)[:, None], axis=0))
    moves = np.einsum("nij,nj->ni", turns, moves) * np.exp(np.cumsum(scale))[:, None]
    positions = np.vstack([np.zeros(3), np.cumsum(moves, axis=0)]) + rng.normal(0.0, 0.01, true.positions.shape)
    rotations = np.concatenate([turns[:1], turns]) @ true.rotations
    return Timed(true.stamps_ns, positions, rotations).placed(VIS_FROM_MAP)


def fixes_along(true: Timed, interval_s: float, late_s: float = 0.0, seed: int = 0) -> GnssTrack:
    """RTK fixes of 5 cm; their stamps late by so much."""
    first, last = int(true.stamps_ns[0]) + 37_000_000, int(true.stamps_ns[-1]) - 1_000_000
    stamps_ns = np.append(np.arange(first, last, int(interval_s * 1e9)), last)
    at = true.at(stamps_ns)
    noise = np.random.default_rng(seed + 100).normal(0.0, 0.05, at.positions.shape)
    return GnssTrack(
        UtmAnchor(32632, 678_000, 5_404_000, 420),
        stamps_ns + round(late_s * 1e9),
        at.positions + at.rotations @ ARM + noise,
        np.tile(np.eye(3) * 0.05**2, (len(stamps_ns), 1, 1)),
        ARM,
    )


def spoilt(track: GnssTrack, where: str, seed: int = 0) -> tuple[GnssTrack, Array]:
    """A fifth of the fixes off by 5 to 50 m: one by one, in runs of 5 s, or from the first one on."""
    rng = np.random.default_rng(seed + 7)
    count, bad = len(track), np.zeros(len(track), dtype=bool)
    run = max(1, round(5e9 / float(np.median(np.diff(track.stamps_ns)))))
    wanted, positions = round(0.2 * count), track.positions_m.copy()

    def off() -> Array:
        away = rng.normal(size=3) * np.array([1.0, 1.0, 0.5])
        return np.asarray(away / np.linalg.norm(away) * rng.uniform(5.0, 50.0))

    starts = {"alone": [], "in runs": rng.permutation(count // run) * run, "at the start": [0]}[where]
    for start in list(starts)[: max(1, wanted // run)]:
        bad[start : start + run] = True
        positions[start : start + run] += off()
    free = np.flatnonzero(~bad)
    for row in rng.choice(free, max(wanted - int(bad.sum()), 0), replace=False):
        bad[row] = True
        positions[row] += off()
    return replace(track, positions_m=positions), bad


def mean_error_m(screened: ScreenedFixes, path: Timed, true: Timed) -> float:
    """Of the drifting path, bent to the fixes that are believed."""
    consensus = screened.consensus[0]
    assert consensus is not None
    placed, _ = bent(path.placed(consensus.map_from_vis), consensus.chain, consensus.bend)
    return float(np.linalg.norm(placed.positions - true.positions, axis=1).mean())


@pytest.mark.parametrize(("interval_s", "length_m"), [(0.1, 250.0), (1.0, 400.0), (5.0, 700.0)])
@pytest.mark.parametrize("where", ["alone", "in runs", "at the start"])
def test_fixes_that_are_far_off_are_found_and_the_others_kept(interval_s, length_m, where):
    true = course(length_m)
    path, track = as_slam_has_it(true), fixes_along(true, interval_s)
    spoiled, bad = spoilt(track, where)
    screened = screen_fixes([path], spoiled, SETTINGS)
    kept = np.isin(spoiled.stamps_ns, screened.track.stamps_ns)
    assert not (kept & bad).any()
    assert (~kept & ~bad).sum() <= 0.02 * len(track)
    assert screened.rejected == len(track) - len(screened.track)
    honest = replace(
        track,
        stamps_ns=track.stamps_ns[~bad],
        positions_m=track.positions_m[~bad],
        covariances_m2=track.covariances_m2[~bad],
    )
    known_m = mean_error_m(screen_fixes([path], honest, SETTINGS), path, true)  # as if one knew which are bad
    assert 0.01 < mean_error_m(screened, path, true) < 1.15 * known_m


@pytest.mark.parametrize("loss_per_rad", [0.0, 0.04, 0.08])
@pytest.mark.parametrize("interval_s", [0.1, 1.0, 5.0])
def test_no_good_fix_is_thrown_away_because_the_path_drifts(interval_s, loss_per_rad):
    """Eight per cent of scale a radian: one Sim(3) then leaves residuals of tens of metres at perfect fixes."""
    true = course(500.0)
    path, track = as_slam_has_it(true, 3, loss_per_rad), fixes_along(true, interval_s)
    screened = screen_fixes([path], track, SETTINGS)
    assert screened.rejected <= 0.01 * len(track)
    assert 0.01 < mean_error_m(screened, path, true) < 0.45


def test_sigmas_that_claim_three_times_too_much_do_not_cost_fixes():
    true = course(300.0)
    path, track = as_slam_has_it(true), fixes_along(true, 1.0)
    noise = np.random.default_rng(9).normal(0.0, 0.15, track.positions_m.shape)
    screened = screen_fixes([path], replace(track, positions_m=track.positions_m + noise), SETTINGS)
    assert screened.rejected <= 1
    assert screened.consensus[0].noise_factor > 1.3


def test_rejecting_can_be_switched_off():
    true = course(250.0)
    spoiled, bad = spoilt(fixes_along(true, 1.0), "alone")
    settings = GnssGroup(reject_outliers=False)
    screened = screen_fixes([as_slam_has_it(true)], spoiled, settings)
    assert bad.sum() > 0
    assert screened.rejected == 0
    assert len(screened.track) == len(spoiled)


def test_too_few_fixes_to_outvote_one_another_are_all_believed():
    true = course(150.0)
    track = fixes_along(true, 5.0)
    assert len(track) < 6
    screened = screen_fixes([as_slam_has_it(true)], track, SETTINGS)
    assert (screened.rejected, screened.clock, len(screened.track)) == (0, None, len(track))


def test_a_drive_without_a_posed_image_at_its_fixes_keeps_them():
    true = course(150.0)
    later = replace(fixes_along(true, 1.0), stamps_ns=fixes_along(true, 1.0).stamps_ns + 10**12)
    screened = screen_fixes([as_slam_has_it(true)], later, SETTINGS)
    assert (screened.rejected, len(screened.track)) == (0, len(later))


# --- the clocks


@pytest.mark.parametrize("interval_s", [0.1, 1.0])
@pytest.mark.parametrize("late_s", [-0.08, 0.08])
def test_clocks_80_ms_apart_are_found_to_20_ms_and_brought_together(interval_s, late_s):
    """The receiver's stamps are late: the camera's minus the receiver's is the negative of it."""
    true = course(400.0)
    path, track = as_slam_has_it(true), fixes_along(true, interval_s, late_s)
    screened = screen_fixes([path], track, SETTINGS)
    assert screened.clock.offset_s == pytest.approx(-late_s, abs=0.02)
    assert abs(screened.clock.offset_s + late_s) < 3.0 * screened.clock.sigma_s
    assert 0.002 < screened.clock.sigma_s < 0.02
    assert screened.clock.is_clear
    moved_s = (screened.track.stamps_ns - track.stamps_ns[np.arange(len(screened.track))]) * 1e-9
    np.testing.assert_allclose(np.median(moved_s), screened.clock.offset_s, atol=1e-6)
    at_once = screen_fixes([path], fixes_along(true, interval_s), SETTINGS)
    assert mean_error_m(screened, path, true) < 1.3 * mean_error_m(at_once, path, true) + 0.02


def test_nine_fixes_may_suspect_an_offset_but_do_not_prove_it():
    """Scale that is lost in corners looks much like it when the next fix is forty metres away."""
    true = course(400.0)
    screened = screen_fixes([as_slam_has_it(true)], fixes_along(true, 5.0, -0.08), SETTINGS)
    assert screened.clock.offset_s == pytest.approx(0.08, abs=0.02)
    assert not screened.clock.is_clear


@pytest.mark.parametrize("interval_s", [0.1, 1.0, 5.0])
def test_clocks_that_agree_are_left_alone(interval_s):
    for seed in range(3):
        true = course(400.0)
        screened = screen_fixes([as_slam_has_it(true, seed)], fixes_along(true, interval_s, seed=seed), SETTINGS)
        assert abs(screened.clock.offset_s) < 3.0 * screened.clock.sigma_s
        assert not screened.clock.is_clear


@pytest.mark.parametrize("interval_s", [0.1, 1.0])
def test_on_a_straight_road_at_constant_speed_no_offset_can_be_seen_and_none_is_removed(interval_s):
    """There an offset is a shift along the road."""
    true = course(300.0, turns=(), wavering=0.0)
    track = fixes_along(true, interval_s, -0.08)
    screened = screen_fixes([as_slam_has_it(true)], track, SETTINGS)
    assert screened.clock.sigma_s > 0.05
    assert not screened.clock.is_clear
    np.testing.assert_array_equal(screened.track.stamps_ns, track.stamps_ns)


def test_the_offset_is_not_asked_for_when_the_settings_say_so():
    true = course(300.0)
    track = fixes_along(true, 1.0, -0.08)
    screened = screen_fixes([as_slam_has_it(true)], track, GnssGroup(estimate_clock_offset=False))
    assert screened.clock is None
    assert np.isin(screened.track.stamps_ns, track.stamps_ns).all()


def test_segments_share_one_clock_and_are_judged_each_by_its_own_path():
    true = course(700.0)
    path = as_slam_has_it(true)
    half = len(path.stamps_ns) // 2
    parts = [
        Timed(path.stamps_ns[rows], path.positions[rows], path.rotations[rows])
        for rows in (slice(0, half), slice(half, None))
    ]
    other = Sim3(2.0, so3_exp(np.array([0.3, 0.2, -0.9])), np.array([1.0, 2.0, 3.0]))
    spoiled, bad = spoilt(fixes_along(true, 1.0, -0.08), "alone")
    screened = screen_fixes([parts[0], parts[1].placed(other)], spoiled, SETTINGS)
    assert screened.clock.offset_s == pytest.approx(0.08, abs=0.02)
    assert abs(screened.rejected - int(bad.sum())) <= 2
