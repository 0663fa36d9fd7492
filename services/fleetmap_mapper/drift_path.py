"""A camera path that drifts slowly, held against GNSS fixes: how far it may be bent, and how well it is known.

Monocular odometry is locally rigid, but its scale and its heading wander with the way driven. So the motion from
one node of the path to the next is kept up to a local scale s and turn D that perform random walks:

    p_k+1 = p_k + s_k D_k (q_k+1 - q_k) + noise,   D_k+1 = exp(noise) D_k,   log s_k+1 = log s_k + noise

with q the path as vision has it, placed by one Sim(3). The antenna at a fix is p + D a. What remains is a
Gauss-Newton problem whose normal equations are block tridiagonal; one more unknown, the offset of the clocks,
borders them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve_banded, cholesky_banded

from fleetmap.geometry import Pose, Sim3, nearest_rotations, rotation_angle_rad, so3_exp, so3_log
from fleetmap_mapper.georeferencing import MAX_IMAGE_GAP_NS, GnssTrack

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]
Indices = NDArray[np.intp]

STATES = 7  # of a node: shift, turn, log of scale
_MIN_STEP_M = 0.1  # a vehicle that stands does not make the path rigid
_NODE_SPACING_M = 1.0
_MAX_NODES = 5_000
_VELOCITY_BASE_NS = 400_000_000  # long enough for the path's jitter not to look like a change of speed
_CLOCK_PRIOR_S = 0.3  # clocks further apart than some tenths are refused elsewhere
FREE = np.array(
    [1e3] * 3 + [0.05] * 3 + [1.0]
)  # one step of the first node, m, rad, log: roll may be undetermined


@dataclass(frozen=True)
class DriftRates:
    """What monocular odometry loses: 3 % of scale and 0.6 deg in 100 m, and 8 % of scale in a corner.

    Per square root of a metre, and of a radian: where the camera turns, few landmarks carry the scale across.
    """

    scale: float = 3e-3
    scale_per_rad: float = 0.06
    turn_rad: float = 1e-3
    step_m: float = 0.01


@dataclass(frozen=True)
class Chain:
    """Nodes along a path, placed in the map frame by one Sim(3), and the fixes at some of them."""

    stamps_ns: Stamps  # (N,) of the camera's clock
    positions_m: Array  # (N, 3)
    rotations: Array  # (N, 3, 3) map_from_cam
    turned_rad: Array  # (N - 1,) by the camera, from node to node
    fixes: Indices  # (F,) rows of the GnssTrack
    node_of: Indices  # (F,) node of each fix
    velocities_mps: Array  # (F, 3) of the antenna


@dataclass(frozen=True)
class Bend:
    """What has become of a chain: ``positions_m`` = p, and the local turn and scale at every node."""

    positions_m: Array  # (N, 3)
    turns: Array  # (N, 3, 3)
    scales: Array  # (N,)
    clock_s: float = 0.0  # to be added to the stamps of the fixes, beyond what the chain was built with

    @staticmethod
    def none(chain: Chain) -> Bend:
        """The chain as it is."""
        count = len(chain.positions_m)
        return Bend(chain.positions_m.copy(), np.tile(np.eye(3), (count, 1, 1)), np.ones(count))


@dataclass(frozen=True)
class Timed:
    """Camera poses by time, as arrays."""

    stamps_ns: Stamps  # (N,)
    positions: Array  # (N, 3)
    rotations: Array  # (N, 3, 3)

    @staticmethod
    def of(stamps_ns: Stamps, poses: Sequence[Pose]) -> Timed:
        """Poses at stamps in time order."""
        positions = np.array([p.translation_m for p in poses]).reshape(-1, 3)
        return Timed(stamps_ns, positions, np.array([p.rotation for p in poses]).reshape(-1, 3, 3))

    def placed(self, S: Sim3) -> Timed:
        """The same in the target frame of S."""
        return Timed(self.stamps_ns, S.transform(self.positions), S.rotation @ self.rotations)

    def covers(self, stamps_ns: Stamps) -> NDArray[np.bool_]:
        """Which stamps lie between two poses at most 0.5 s apart."""
        if len(self.stamps_ns) < 2:
            return np.zeros(len(stamps_ns), dtype=bool)
        after = np.clip(np.searchsorted(self.stamps_ns, stamps_ns, side="left"), 1, len(self.stamps_ns) - 1)
        inside = (stamps_ns >= self.stamps_ns[0]) & (stamps_ns <= self.stamps_ns[-1])
        near = self.stamps_ns[after] - self.stamps_ns[after - 1] <= MAX_IMAGE_GAP_NS
        return np.asarray(inside & (near | (self.stamps_ns[after] == stamps_ns)))

    def at(self, stamps_ns: Stamps) -> Timed:
        """Between the neighbouring poses; the ends hold beyond the ends."""
        after = np.clip(np.searchsorted(self.stamps_ns, stamps_ns, side="left"), 1, len(self.stamps_ns) - 1)
        before = after - 1
        gap_ns = self.stamps_ns[after] - self.stamps_ns[before]
        share = np.clip((stamps_ns - self.stamps_ns[before]) / gap_ns, 0.0, 1.0)[:, None]
        turn = so3_log(np.swapaxes(self.rotations[before], 1, 2) @ self.rotations[after])
        positions = (1.0 - share) * self.positions[before] + share * self.positions[after]
        return Timed(stamps_ns, positions, self.rotations[before] @ so3_exp(share * turn))


def build_chain(placed: Timed, track: GnssTrack, clock_s: float = 0.0) -> Chain:
    """Nodes at all fixes that lie between images, and about every metre between them.

    Args:
        placed: the camera's path in map.
        track: the fixes.
        clock_s: the camera's stamp minus the receiver's stamp of the same instant.
    """
    fix_stamps_ns = track.stamps_ns + round(clock_s * 1e9)
    fixes = np.flatnonzero(placed.covers(fix_stamps_ns))
    way = np.append(0.0, np.linalg.norm(np.diff(placed.positions, axis=0), axis=1).cumsum())
    spacing = max(_NODE_SPACING_M, float(way[-1]) / _MAX_NODES)
    between = placed.stamps_ns[np.unique(np.searchsorted(way, np.arange(0.0, float(way[-1]), spacing)))]
    stamps_ns = np.union1d(np.append(between, placed.stamps_ns[[0, -1]]), fix_stamps_ns[fixes])
    nodes = placed.at(stamps_ns)
    early, late = (placed.at(fix_stamps_ns[fixes] + sign * _VELOCITY_BASE_NS) for sign in (-1, 1))
    lowest, highest = placed.stamps_ns[0], placed.stamps_ns[-1]
    base_s = np.clip(late.stamps_ns, lowest, highest) - np.clip(early.stamps_ns, lowest, highest)
    arm = track.antenna_in_cam_m
    moved = late.positions + late.rotations @ arm - early.positions - early.rotations @ arm
    return Chain(
        stamps_ns,
        nodes.positions,
        nodes.rotations,
        rotation_angle_rad(np.swapaxes(nodes.rotations[:-1], 1, 2) @ nodes.rotations[1:]),
        fixes,
        np.searchsorted(stamps_ns, fix_stamps_ns[fixes]),
        moved / (np.maximum(base_s, 1) * 1e-9)[:, None],
    )


@dataclass(frozen=True)
class Fit:
    """One Gauss-Newton step's system, solved."""

    bend: Bend
    residuals_m: Array  # (F, 3) fix minus antenna, after the step's start
    clock_sigma_s: float  # infinite where the clock was not asked for
    factor: Array  # banded Cholesky factor
    diagonal: Array  # (N, 7, 7) blocks of the normal equations
    below: Array  # (N - 1, 7, 7) blocks (k + 1, k)
    clock_response: Array  # (N, 7) of the states to one second of clock


def antennas_m(chain: Chain, bend: Bend, arm_in_cam_m: Array) -> tuple[Array, Array]:
    """Antenna (F, 3) at every fix, and its arm (F, 3) from the camera, in map."""
    n = chain.node_of
    arms = (bend.turns[n] @ chain.rotations[n]) @ arm_in_cam_m
    return bend.positions_m[n] + arms + _velocities(chain, bend) * bend.clock_s, arms


def _velocities(chain: Chain, bend: Bend) -> Array:
    n = chain.node_of
    return np.asarray(np.einsum("fij,fj->fi", bend.turns[n], chain.velocities_mps) * bend.scales[n, None])


def gauss_newton_step(
    chain: Chain,
    bend: Bend,
    track: GnssTrack,
    information: Array,
    rates: DriftRates,
    with_clock: bool,
    free: Array = FREE,
) -> Fit:
    """Solve the system about ``bend``.

    ``information`` (F, 3, 3) of the fixes already carries robust weights; ``free`` (7,) are the sigmas of what one
    step may do to the first node, and thereby to all where the fixes do not determine it.
    """
    residuals = track.positions_m[chain.fixes] - antennas_m(chain, bend, track.antenna_in_cam_m)[0]
    jacobian, velocities = antenna_jacobians(chain, bend, track.antenna_in_cam_m)
    diagonal, below, gradient = _path_terms(chain, bend, rates, free)
    weighted = np.swapaxes(jacobian, 1, 2) @ information  # (F, 7, 3)
    np.add.at(diagonal, chain.node_of, weighted @ jacobian)
    np.add.at(gradient, chain.node_of, np.einsum("fij,fj->fi", weighted, residuals))
    factor = cholesky_banded(_banded(diagonal, below), lower=True)
    steps = cho_solve_banded((factor, True), gradient.ravel())
    clock_step, clock_sigma, response = 0.0, np.inf, np.zeros_like(steps)
    if with_clock:
        pull = np.zeros_like(gradient)
        np.add.at(pull, chain.node_of, np.einsum("fij,fj->fi", weighted, velocities))
        response = cho_solve_banded((factor, True), pull.ravel())
        prior = 1.0 / _CLOCK_PRIOR_S**2
        own = float(np.einsum("fi,fij,fj->", velocities, information, velocities)) + prior
        known = own - float(pull.ravel() @ response)
        right = float(np.einsum("fi,fij,fj->", velocities, information, residuals)) - prior * bend.clock_s
        clock_step = (right - float(pull.ravel() @ steps)) / known
        clock_sigma = 1.0 / float(np.sqrt(known))
        steps = steps - response * clock_step
    return Fit(
        _moved(bend, steps.reshape(-1, STATES), clock_step),
        residuals,
        clock_sigma,
        factor,
        diagonal,
        below,
        response.reshape(-1, STATES),
    )


def marginal_covariances(fit: Fit) -> tuple[Array, Array]:
    """Covariances (N, 7, 7) of the nodes' shift, turn and log scale with the clock known, and gains (N - 1, 7, 7).

    They are the diagonal blocks of the inverse, by the recurrences of the block tridiagonal Cholesky
    factorisation, forwards, then backwards. Between nodes cov(k, l) = gain_k cov(k + 1, l) for k < l.
    """
    inverses = np.empty_like(fit.diagonal)
    gains = np.empty_like(fit.below)
    inverses[0] = np.linalg.inv(fit.diagonal[0])
    for k, below in enumerate(fit.below):
        gains[k] = -inverses[k] @ below.T
        inverses[k + 1] = np.linalg.inv(fit.diagonal[k + 1] + below @ gains[k])
    covariances = inverses
    for k in range(len(gains) - 1, -1, -1):
        covariances[k] += gains[k] @ covariances[k + 1] @ gains[k].T
    return covariances, gains


def antenna_jacobians(chain: Chain, bend: Bend, arm_in_cam_m: Array) -> tuple[Array, Array]:
    """What one step of a node's states (F, 3, 7), and one second of clock (F, 3), does to the antenna at a fix."""
    _, arms = antennas_m(chain, bend, arm_in_cam_m)
    jacobians = np.zeros((len(arms), 3, STATES))
    jacobians[:, :, :3] = np.eye(3)
    jacobians[:, :, 3:6] = -_cross(arms)
    return jacobians, _velocities(chain, bend)


def path_cost(chain: Chain, bend: Bend, rates: DriftRates) -> float:
    """What the bend costs: chi-square of all steps of the random walks."""
    _, errors, variances = _walks(chain, bend, rates)
    return float((errors**2 / variances).sum())


def _walks(chain: Chain, bend: Bend, rates: DriftRates) -> tuple[Array, Array, Array]:
    """Motions (N - 1, 3) as expected, errors (N - 1, 7) of the walks' steps, and variances (N - 1, 7) of them."""
    motions = np.einsum("nij,nj->ni", bend.turns[:-1], np.diff(chain.positions_m, axis=0)) * bend.scales[:-1, None]
    length = np.maximum(np.linalg.norm(motions, axis=1), _MIN_STEP_M)
    errors = np.concatenate(
        [
            np.diff(bend.positions_m, axis=0) - motions,
            so3_log(bend.turns[1:] @ np.swapaxes(bend.turns[:-1], 1, 2)),
            np.diff(np.log(bend.scales))[:, None],
        ],
        axis=1,
    )
    within = (rates.scale**2 + rates.turn_rad**2) * length**3 / 3.0  # what wanders inside one step
    variances = np.empty((len(length), STATES))
    variances[:, :3] = (rates.step_m**2 * length + within)[:, None]
    variances[:, 3:6] = (rates.turn_rad**2 * length)[:, None]
    variances[:, 6] = rates.scale**2 * length + rates.scale_per_rad**2 * chain.turned_rad
    return motions, errors, variances


def _path_terms(chain: Chain, bend: Bend, rates: DriftRates, free: Array) -> tuple[Array, Array, Array]:
    """Normal equations of the random walks: diagonal blocks, blocks below them, right side (N, 7)."""
    motions, errors, variances = _walks(chain, bend, rates)
    weights = 1.0 / variances
    from_here = np.tile(-np.eye(STATES), (len(motions), 1, 1))
    from_here[:, :3, 3:6] = _cross(motions)
    from_here[:, :3, 6] = -motions
    below = weights[:, :, None] * from_here
    count = len(chain.positions_m)
    diagonal, gradient = np.zeros((count, STATES, STATES)), np.zeros((count, STATES))
    diagonal[0] = np.diag(1.0 / free**2)
    diagonal[:-1] += np.swapaxes(from_here, 1, 2) @ below
    diagonal[1:] += weights[:, :, None] * np.eye(STATES)
    gradient[:-1] -= np.einsum("nji,nj->ni", below, errors)
    gradient[1:] -= weights * errors
    return diagonal, below, gradient


def _moved(bend: Bend, steps: Array, clock_step_s: float) -> Bend:
    turns = nearest_rotations(so3_exp(steps[:, 3:6]) @ bend.turns)
    scales = bend.scales * np.exp(np.clip(steps[:, 6], -0.7, 0.7))
    return replace(
        bend,
        positions_m=bend.positions_m + steps[:, :3],
        turns=turns,
        scales=scales,
        clock_s=bend.clock_s + clock_step_s,
    )


def bent(timed: Timed, chain: Chain, bend: Bend) -> tuple[Timed, Array]:
    """Poses of the chain's own path as they lie on the bent one, and the local scale (n,) there."""
    after = np.clip(np.searchsorted(chain.stamps_ns, timed.stamps_ns, side="left"), 1, len(chain.stamps_ns) - 1)
    before = after - 1
    gap_ns = chain.stamps_ns[after] - chain.stamps_ns[before]
    share = np.clip((timed.stamps_ns - chain.stamps_ns[before]) / gap_ns, 0.0, 1.0)

    def carried(k: Indices) -> Array:
        motion = np.einsum("nij,nj->ni", bend.turns[k], timed.positions - chain.positions_m[k])
        return np.asarray(bend.positions_m[k] + bend.scales[k, None] * motion)

    positions = (1.0 - share)[:, None] * carried(before) + share[:, None] * carried(after)
    step = so3_log(bend.turns[after] @ np.swapaxes(bend.turns[before], 1, 2))
    turns = so3_exp(share[:, None] * step) @ bend.turns[before]
    scales = bend.scales[before] ** (1.0 - share) * bend.scales[after] ** share
    return Timed(timed.stamps_ns, positions, turns @ timed.rotations), scales


def _cross(vectors: Array) -> Array:
    """Matrices (n, 3, 3) with cross(v) @ x = v x x."""
    matrices = np.zeros((len(vectors), 3, 3))
    matrices[:, [2, 0, 1], [1, 2, 0]] = vectors
    matrices[:, [1, 2, 0], [2, 0, 1]] = -vectors
    return matrices


def _banded(diagonal: Array, below: Array) -> Array:
    """Lower banded form (14, 7 N) of a symmetric block tridiagonal matrix."""
    count = len(diagonal)
    banded = np.zeros((2 * STATES, count * STATES))
    for row in range(STATES):
        for column in range(STATES):
            if row >= column:
                banded[row - column, column::STATES] = diagonal[:, row, column]
            banded[STATES + row - column, column : (count - 1) * STATES : STATES] = below[:, row, column]
    return banded
