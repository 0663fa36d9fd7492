"""Which fixes to believe: those that agree with one another along the visual path.

A receiver under trees or between houses reports positions that are metres off and claims centimetres. The images
know better over short ways: the path is locally rigid. So the fixes are held against the path of
fleetmap_mapper.drift_path, which may bend as monocular odometry drifts and no more:

1. one Sim(3) by sampling, judged by the sum of distances, which outliers enter linearly and drift does not spoil;
2. the drifting path under Huber's loss, which is convex;
3. the gate: a fix is rejected if it misses the path that all *other* fixes give by more than both its own
   uncertainty and the path's. Rejected fixes are judged again each round and may come back.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats.distributions import chi2

from fleetmap.errors import InputError
from fleetmap.geometry import Sim3, umeyama_alignment
from fleetmap_mapper.drift_path import (
    STATES,
    Bend,
    Chain,
    DriftRates,
    Fit,
    Timed,
    antennas_m,
    build_chain,
    gauss_newton_step,
    path_cost,
)
from fleetmap_mapper.fix_sequence import consistent_sequence, follow_drift, step_chi2
from fleetmap_mapper.georeferencing import HUBER_SIGMAS, GnssTrack, levelled
from fleetmap_mapper.leave_out import Antennas

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

MIN_FIXES = 6  # fewer do not outvote one another
_SAMPLES = 300
_POLISHINGS = 10  # reweightings of the sampled Sim(3)
_UPRIGHT = 2.0  # an upright world may fit so much worse than one that is not
_UNBENT_SHARE = 0.05  # of a step, by which one Sim(3) of a path that drifts may miss it
_ROUNDS, _STEPS = 20, 4
_NOTHING = 1e-12  # the weight of a fix that is not believed
_CHANCES = 2  # a fix that has been thrown out so often stays out
_CONFIDENCE = 0.999
_PRICE = float(chi2.ppf(_CONFIDENCE, 3))  # of a fix thrown out, in chi-squares
_MEDIAN = float(chi2.ppf(0.5, 3))
_BLOCK_LENGTHS = (1, 2, 3, 4, 6, 8, 12, 16, 24)
_MAX_BLOCK = 24
_MAX_SHARE = 0.3  # of all fixes, that one run of outliers may make up
_APART = 2  # fixes beside a block thrown out that are not judged in the same round


@dataclass(frozen=True)
class Consensus:
    """What the fixes agree on."""

    chain: Chain
    bend: Bend
    fit: Fit  # of the last step
    believed: Mask  # (F,) of the chain's fixes
    noise_factor: float  # by which the fixes' sigmas understate their scatter, at least 1
    map_from_vis: Sim3  # the Sim(3) that the chain was placed with
    unit_weight: float  # sqrt of chi-square over degrees of freedom, of fixes and drift together; about 1
    correlation_factor: float  # by which correlated errors of successive fixes widen a sigma, at least 1

    @property
    def clock_sigma_s(self) -> float:
        """Of the clocks' offset, with what the residuals say about the noise."""
        return self.fit.clock_sigma_s * max(self.unit_weight, 1.0) * self.correlation_factor


def find_consensus(
    timed: Timed,
    track: GnssTrack,
    clock_s: float = 0.0,
    with_clock: bool = True,
    seed: int = 0,
    start: Sim3 | None = None,
) -> Consensus | None:
    """Hold all fixes against a camera path in a free-scale frame; None where there are too few of them.

    Args:
        timed: the camera's path in vis.
        track: the fixes.
        clock_s: what is known of the camera's stamp minus the receiver's stamp of the same instant.
        with_clock: whether what is left of that offset is estimated too, so that it is not taken for outliers.
        seed: of the sampling.
        start: where the path is known to lie by and large; found by sampling if not.
    """
    S = start or sample_similarity(timed, track, clock_s, seed)
    if S is None:
        return None
    chain = build_chain(timed.placed(S), track, clock_s)
    if len(chain.fixes) < MIN_FIXES:
        return None
    return _judged(chain, track, S, with_clock)


def sample_similarity(timed: Timed, track: GnssTrack, clock_s: float = 0.0, seed: int = 0) -> Sim3 | None:
    """A Sim(3) ``map_from_vis`` near the least sum of distances; None with too few fixes or no motion."""
    stamps_ns = track.stamps_ns + round(clock_s * 1e9)
    fixes = np.flatnonzero(timed.covers(stamps_ns))
    if len(fixes) < MIN_FIXES:
        return None
    path = timed.at(stamps_ns[fixes])
    targets, arm = track.positions_m[fixes], track.antenna_in_cam_m
    generator = np.random.default_rng(seed)

    def antennas(S: Sim3) -> Array:
        return np.asarray(S.transform(path.positions) + (S.rotation @ path.rotations) @ arm)

    def distances(S: Sim3) -> Array:
        return np.asarray(np.linalg.norm(antennas(S) - targets, axis=1))

    samples = (generator.choice(len(fixes), 3, replace=False) for _ in range(_SAMPLES))
    candidates = [S for rows in samples if (S := _aligned(path, targets, arm, rows)) is not None]
    if not candidates:
        return None
    best = min(candidates, key=lambda S: float(distances(S).sum()))
    for _ in range(_POLISHINGS):
        near = np.flatnonzero(distances(best) <= 2.5 * np.median(distances(best)))
        better = _aligned(path, targets, arm, near)
        if better is None or distances(better).sum() >= distances(best).sum():
            break
        best = better
    upright = levelled(best, path.positions, path.rotations)
    shift = np.median(targets - antennas(upright), axis=0)  # turning has moved the antenna
    upright = Sim3(upright.scale, upright.rotation, upright.translation_m + shift)
    return upright if distances(upright).sum() < _UPRIGHT * distances(best).sum() + len(fixes) else best


def _aligned(path: Timed, targets: Array, arm: Array, rows: NDArray[np.intp]) -> Sim3 | None:
    positions, rotations = path.positions[rows], path.rotations[rows]
    try:
        S = umeyama_alignment(positions, targets[rows])
        return umeyama_alignment(positions, targets[rows] - (S.rotation @ rotations) @ arm)
    except InputError:
        return None


def _judged(chain: Chain, track: GnssTrack, S: Sim3, with_clock: bool) -> Consensus:
    covariances = track.covariances_m2[chain.fixes]
    bend = Bend.none(chain)
    believed, factor = _stepping_along(chain, bend, track)
    departures = np.zeros(len(believed), dtype=int)
    for _ in range(_ROUNDS):
        for _ in range(_STEPS):
            errors = np.sqrt(_chi2(_residuals(chain, bend, track), covariances)) / factor
            weights = np.where(believed, np.minimum(1.0, HUBER_SIGMAS / np.maximum(errors, 1e-9)), _NOTHING)
            information = np.linalg.inv(covariances) * (weights / factor**2)[:, None, None]
            fit = gauss_newton_step(chain, bend, track, information, DriftRates(), with_clock)
            bend = fit.bend
        verdict, factor = _verdict(chain, fit, track, covariances, weights, believed, factor)
        verdict &= departures < _CHANCES
        departures += believed & ~verdict
        if np.array_equal(verdict, believed) or verdict.sum() < MIN_FIXES:
            break
        believed = verdict
    squares = _chi2(_residuals(chain, bend, track), covariances)[believed].sum() / factor**2
    freedom = max(3 * int(believed.sum()) - STATES - 1, 1)
    unit_weight = float(np.sqrt((squares + path_cost(chain, bend, DriftRates())) / freedom))
    correlation = _correlation_factor(_residuals(chain, bend, track)[believed])
    return Consensus(chain, bend, fit, believed, factor, S, unit_weight, correlation)


def _stepping_along(chain: Chain, bend: Bend, track: GnssTrack) -> tuple[Mask, float]:
    """A first guess of which fixes to believe, and by what factor their sigmas understate their steps' scatter."""
    antennas, _ = antennas_m(chain, bend, track.antenna_in_cam_m)
    positions = track.positions_m[chain.fixes]
    variances = np.trace(track.covariances_m2[chain.fixes], axis1=1, axis2=2) / 3.0
    followed = follow_drift(antennas, positions, variances)
    factor = max(
        1.0, float(np.sqrt(np.median(step_chi2(followed, positions, variances, _UNBENT_SHARE)) / _MEDIAN))
    )
    return consistent_sequence(followed, positions, variances * factor**2, _UNBENT_SHARE), factor


def _correlation_factor(residuals_m: Array) -> float:
    """Sigmas of what is estimated from successive errors grow by sqrt((1 + r) / (1 - r)), r their correlation.

    Source: first-order autoregression; G. Box et al., "Time Series Analysis", 2008, section 2.1.3 and A2.
    """
    centred = residuals_m - residuals_m.mean(axis=0)
    r = float((centred[1:] * centred[:-1]).sum() / max((centred**2).sum(), 1e-12))
    r = min(max(r - 2.0 / np.sqrt(centred.size), 0.0), 0.999)  # only what is clear
    return float(np.sqrt((1.0 + r) / (1.0 - r)))


def _verdict(
    chain: Chain, fit: Fit, track: GnssTrack, covariances: Array, weights: Array, believed: Mask, factor: float
) -> tuple[Mask, float]:
    """Which fixes to believe next, and by what factor their sigmas understate them."""
    residuals = _residuals(chain, fit.bend, track)
    way = np.append(0.0, np.linalg.norm(np.diff(chain.positions_m, axis=0), axis=1).cumsum())[chain.node_of]
    inside, outside = np.flatnonzero(believed), np.flatnonzero(~believed)
    noise = covariances[inside] * (factor**2 / weights[inside])[:, None, None]
    antennas = Antennas.of(chain, fit, track, inside, residuals[inside], noise)
    singles = antennas.left_out_chi2(1, np.zeros((len(inside), 1)))
    factor *= float(np.sqrt(np.clip(np.median(singles) / _MEDIAN, 1.0 / factor**2, None)))
    verdict = believed.copy()
    verdict[inside[_worst_blocks(antennas, way[inside], len(believed))]] = False
    if len(outside):
        noise = covariances[outside] * factor**2
        others = Antennas.of(chain, fit, track, outside, residuals[outside], noise)
        nearest = np.abs(way[outside][:, None] - way[inside]).min(axis=1)
        verdict[outside] = others.outside_chi2(nearest) < chi2.ppf(_CONFIDENCE, 3)
    return verdict, factor


def _worst_blocks(antennas: Antennas, way_m: Array, fixes: int) -> NDArray[np.intp]:
    """Rows of the blocks that miss the others' path beyond doubt, worst first and none beside another."""
    count = len(way_m)
    dense = max(2, round(float(way_m[-1] - way_m[0]) / count))  # the sequence has found runs of fixes this near
    longest = min(int(_MAX_SHARE * fixes), count - MIN_FIXES, _MAX_BLOCK, dense)
    found = []
    for length in (n for n in _BLOCK_LENGTHS if n <= longest):
        distances = antennas.left_out_chi2(length, _way_out(way_m, length))
        beyond = np.flatnonzero(distances > chi2.ppf(_CONFIDENCE, 3 * length))
        found += [(float(distances[row]) - _PRICE * length, int(row), length) for row in beyond]
    taken, free = [], np.ones(count, dtype=bool)
    for _, row, length in sorted(found, reverse=True):
        if free[row : row + length].all():
            taken.append(np.arange(row, row + length))
            free[max(row - _APART, 0) : row + length + _APART] = False
    return np.concatenate(taken) if taken else np.zeros(0, dtype=np.intp)


def _way_out(way_m: Array, length: int) -> Array:
    """Metres (B - length + 1, length) from each fix of every block to the nearest fix outside the block."""
    blocks = np.lib.stride_tricks.sliding_window_view(way_m, length)
    before = np.append(-np.inf, way_m[: len(blocks) - 1])[:, None]
    after = np.append(way_m[length:], np.inf)[:, None]
    return np.asarray(np.minimum(blocks - before, after - blocks))


def _residuals(chain: Chain, bend: Bend, track: GnssTrack) -> Array:
    return np.asarray(track.positions_m[chain.fixes] - antennas_m(chain, bend, track.antenna_in_cam_m)[0])


def _chi2(errors: Array, covariances: Array) -> Array:
    return np.asarray(np.einsum("fi,fij,fj->f", errors, np.linalg.inv(covariances), errors))
