"""How exact landmarks are: as their errors really are, across the ray and along it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fleetmap.camera import Camera
from fleetmap.geodesy import UtmAnchor
from fleetmap.geometry import Sim3
from fleetmap.landmark_precision import landmark_sigmas_m, with_precision
from fleetmap.visual_map import Keyframes, Landmarks, Observations, VisualMap

CAMERA = Camera(1200, 400, 700.0, 700.0, 600.0, 200.0)
LOOKING_NORTH = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # map_from_cam
KEYFRAMES = 6


def triangulated(noise_px: float, count: int = 600) -> tuple[VisualMap, np.ndarray]:
    """A drive north past landmarks, each at the optimum of its noisy observations; and where they really are."""
    rng = np.random.default_rng(0)
    centres = np.stack([np.zeros(KEYFRAMES), np.arange(KEYFRAMES) * 1.0, np.full(KEYFRAMES, 1.6)], axis=1)
    truth = rng.uniform((-8.0, 14.0, 0.0), (8.0, 40.0, 6.0), (count, 3))
    in_cam = (truth[None] - centres[:, None]) @ LOOKING_NORTH
    exact = in_cam[..., :2] / in_cam[..., 2:] * 700.0 + [600.0, 200.0]
    octaves = rng.integers(0, 4, (KEYFRAMES, count))
    pixels = exact + rng.normal(size=exact.shape) * noise_px * 1.2 ** octaves[..., None]
    points = np.array([optimum(truth[n], centres, pixels[:, n], 1.2 ** octaves[:, n]) for n in range(count)])
    rays = centres.mean(axis=0) - points
    keyframe, landmark = np.divmod(np.arange(KEYFRAMES * count), count)
    return VisualMap(
        UtmAnchor(32632, 457_000, 5_428_000, 116),
        Sim3.identity(),
        CAMERA,
        Keyframes(np.arange(KEYFRAMES), np.tile(LOOKING_NORTH, (KEYFRAMES, 1, 1)), centres),
        Landmarks(
            points,
            np.zeros((count, 32), np.uint8),
            (rays / np.linalg.norm(rays, axis=1, keepdims=True)).astype(np.float32),
            octaves[0].astype(np.uint8),
            np.linalg.norm(rays, axis=1).astype(np.float32),
        ),
        Observations(
            keyframe.astype(np.int32),
            landmark.astype(np.int32),
            pixels.reshape(-1, 2).astype(np.float32),
            octaves.reshape(-1).astype(np.uint8),
        ),
    ), truth


def optimum(point: np.ndarray, centres: np.ndarray, pixels: np.ndarray, sigmas: np.ndarray) -> np.ndarray:
    """Three steps of Gauss-Newton with numerical derivatives, apart from the code under test."""

    def residuals(at: np.ndarray) -> np.ndarray:
        in_cam = (at - centres) @ LOOKING_NORTH
        return ((in_cam[:, :2] / in_cam[:, 2:] * 700.0 + [600.0, 200.0] - pixels) / sigmas[:, None]).ravel()

    for _ in range(3):
        jacobian = np.stack(
            [(residuals(point + d) - residuals(point - d)) / 2e-4 for d in np.eye(3) * 1e-4], axis=1
        )
        point = point - np.linalg.lstsq(jacobian, residuals(point), rcond=None)[0]
    return point


@pytest.mark.parametrize("noise_px", [0.2, 1.0])
def test_errors_really_made_are_as_large_as_the_sigmas_say(noise_px: float) -> None:
    """The noise is not told; it is measured from the residuals."""
    visual_map, truth = triangulated(noise_px)
    across_m, along_m = landmark_sigmas_m(visual_map).T
    errors = visual_map.landmarks.points_m - truth
    rays = visual_map.landmarks.normals.astype(np.float64)
    along = np.einsum("ni,ni->n", errors, rays)
    across_squared = ((errors - along[:, None] * rays) ** 2).sum(axis=1)
    assert 0.8 < np.median((along / along_m) ** 2) / 0.455 < 1.25  # medians of chi-square with 1 and 2 degrees
    assert 0.8 < np.median(across_squared / across_m**2) / 1.386 < 1.25
    assert np.median(along_m / across_m) > 4.0


def test_a_track_that_errs_more_than_others_is_less_exact() -> None:
    visual_map, _ = triangulated(0.5)
    pixels = visual_map.observations.pixels.copy()
    first = visual_map.observations.landmark_index == 0
    pixels[first] += np.random.default_rng(1).normal(0.0, 5.0, (KEYFRAMES, 2)).astype(np.float32)
    spoilt = replace(visual_map, observations=replace(visual_map.observations, pixels=pixels))
    ratio = landmark_sigmas_m(spoilt) / landmark_sigmas_m(visual_map)
    assert (ratio[0] > 3.0).all()
    assert 0.9 < np.median(ratio[1:]) < 1.1


def test_errors_that_stay_alike_along_a_track_weigh_less() -> None:
    """Twelve observations that err alike are hardly better than one."""
    visual_map, _ = triangulated(0.5)
    rng = np.random.default_rng(2)
    tripled = [np.repeat(column, 3, axis=0) for column in vars(visual_map.observations).values()]
    independent = tripled[2] + rng.normal(0.0, 0.5, tripled[2].shape).astype(np.float32)
    keyframes = Keyframes(*(np.repeat(c, 3, axis=0) for c in list(vars(visual_map.keyframes).values())[:3]))
    keyframes = replace(keyframes, stamps_ns=np.arange(3 * KEYFRAMES))
    tripled[0] = tripled[0] * 3 + np.tile(np.arange(3, dtype=np.int32), len(tripled[0]) // 3)
    order = np.argsort(tripled[0], kind="stable")
    alike = Observations(*(column[order] for column in tripled))
    noisy = replace(alike, pixels=independent[order])
    across = [
        np.median(landmark_sigmas_m(replace(visual_map, keyframes=keyframes, observations=o))[:, 0])
        / np.sqrt(np.mean((o.pixels - alike.pixels) ** 2) + 0.25)
        for o in (alike, noisy)
    ]
    assert across[0] > 1.2 * across[1]


def test_what_nobody_saw_is_hardly_known_and_what_is_known_stays() -> None:
    visual_map, _ = triangulated(0.5, count=60)
    keep = visual_map.observations.landmark_index != 7
    few = Observations(*(column[keep] for column in vars(visual_map.observations).values()))
    known = with_precision(replace(visual_map, observations=few))
    assert known.landmarks.sigmas_m is not None
    np.testing.assert_allclose(known.landmarks.sigmas_m[7], 1000.0, rtol=1e-3)
    assert with_precision(known) is known
