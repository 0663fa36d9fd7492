"""How far fixes, one by one and in runs, lie from the path that the *others* give.

For a block b of fixes with residuals r and covariance S that took part in a least-squares fit, the antennas having
covariance P after it, the residuals without it are S (S - P)^-1 r with covariance S (S - P)^-1 S (leave-one-out
residuals; Cook and Weisberg, "Residuals and Influence in Regression", 1982, section 2.2). Covariances between
fixes of a block follow from the gains of the block tridiagonal factorisation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap_mapper.drift_path import STATES, Chain, Fit, antenna_jacobians, marginal_covariances
from fleetmap_mapper.georeferencing import GnssTrack

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

DRIFT_ALLOWANCE = 0.02  # of the way to the next fix believed: twice what odometry loses over tens of metres
_NEARLY = 1.0 - 1e-6  # a fix that alone determines the path has no leave-one-out residual
_WHITE_SHARE = 0.1  # of the drift's variance that fixes of one block do not share


@dataclass(frozen=True)
class Antennas:
    """The antennas at some fixes of a chain, after a fit."""

    rows: Indices  # (B,) of the chain's fixes
    residuals_m: Array  # (B, 3)
    noise_m2: Array  # (B, 3, 3) covariances of the fixes
    leverage: Array  # (B, 3, 3) covariances of the antennas
    jacobians: Array  # (B, 3, 7)
    states: Array  # (B, 7, 7) covariances of the nodes
    transitions: Array  # (B - 1, 7, 7) cov(node i, x) = transition_i cov(node i + 1, x) for every later x
    clock: Array  # (B, 3) response to one sigma of the clocks' offset

    @staticmethod
    def of(
        chain: Chain, fit: Fit, track: GnssTrack, rows: Indices, residuals_m: Array, noise_m2: Array
    ) -> Antennas:
        """Those of some fixes of a chain."""
        states, gains = marginal_covariances(fit)
        jacobians, velocities = antenna_jacobians(chain, fit.bend, track.antenna_in_cam_m)
        nodes, jacobians = chain.node_of[rows], jacobians[rows]
        transitions = np.empty((max(len(rows) - 1, 0), STATES, STATES))
        for i in range(len(transitions)):
            product = np.eye(STATES)
            for k in range(nodes[i], nodes[i + 1]):
                product = product @ gains[k]
            transitions[i] = product
        clock = np.zeros((len(rows), 3))
        if np.isfinite(fit.clock_sigma_s):
            steady = np.einsum("bij,bj->bi", jacobians, fit.clock_response[nodes])
            clock = (velocities[rows] - steady) * fit.clock_sigma_s
        here = jacobians @ states[nodes] @ np.swapaxes(jacobians, 1, 2) + clock[:, :, None] * clock[:, None, :]
        return Antennas(rows, residuals_m, noise_m2, here, jacobians, states[nodes], transitions, clock)

    def outside_chi2(self, way_m: Array) -> Array:
        """Squared distances (B,) of fixes that took no part in the fit, ``way_m`` (B,) from the next that did."""
        drift = (DRIFT_ALLOWANCE * way_m)[:, None, None] ** 2 * np.eye(3)
        return _chi2(self.residuals_m, self.noise_m2 + self.leverage + drift)

    def left_out_chi2(self, length: int, way_m: Array) -> Array:
        """Squared distances (B - length + 1,) of all blocks of so many successive fixes from the others' path.

        ``way_m`` (B - length + 1, length) is how far each fix of a block is from the next fix outside it.
        """
        blocks = len(self.rows) - length + 1
        members = np.arange(blocks)[:, None] + np.arange(length)
        between = self._block_covariances(length)
        noise = np.zeros_like(between)
        drift = np.zeros_like(between)
        away = DRIFT_ALLOWANCE * way_m
        for a in range(length):
            here = slice(3 * a, 3 * a + 3)
            noise[:, here, here] = self.noise_m2[members[:, a]]
            for b in range(length):
                share = 1.0 if a == b else 1.0 - _WHITE_SHARE
                there = slice(3 * b, 3 * b + 3)
                drift[:, here, there] = (share * away[:, a] * away[:, b])[:, None, None] * np.eye(3)
        gain = noise @ np.linalg.inv(noise - _NEARLY * between)
        residuals = np.einsum("bij,bj->bi", gain, self.residuals_m[members].reshape(blocks, -1))
        return _chi2(residuals, gain @ noise + drift)

    def _block_covariances(self, length: int) -> Array:
        """Joint covariances (blocks, 3 length, 3 length) of the antennas of all blocks."""
        count = len(self.rows)
        blocks = count - length + 1
        joint = np.empty((blocks, 3 * length, 3 * length))
        apart = self.states
        for distance in range(length):
            if distance:
                apart = self.transitions[: count - distance] @ apart[1:]
            pairs = self.jacobians[: count - distance] @ apart @ np.swapaxes(self.jacobians[distance:], 1, 2)
            pairs += self.clock[: count - distance, :, None] * self.clock[distance:, None, :]
            for a in range(length - distance):
                b = a + distance
                chosen = pairs[a : a + blocks]
                joint[:, 3 * a : 3 * a + 3, 3 * b : 3 * b + 3] = chosen
                joint[:, 3 * b : 3 * b + 3, 3 * a : 3 * a + 3] = np.swapaxes(chosen, 1, 2)
        return joint


def _chi2(errors: Array, covariances: Array) -> Array:
    return np.asarray(np.einsum("bi,bi->b", errors, np.linalg.solve(covariances, errors[:, :, None])[:, :, 0]))
