"""How the motion filter's state and covariance go on for a short time: with an IMU, and without.

Source: Solà (see ``filter_state``), section 5.4: eq. 260 (nominal state), eq. 261 (error state), eq. 269
(covariance). Velocities are in metres on the ground; the point scale factor makes them the grid's. What a car's
sensors cannot tell is left out: the Earth's rotation (0.004 deg/s, which the gyroscope's bias takes up) and the
grid's turn against true north along the way (0.01 deg/km).
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]

_P, _V, _T, _G, _A, _M = 0, 3, 6, 9, 12, 15  # where errors start; see filter_state
_KINEMATIC = 9  # errors whose transition is more than a decay


@njit(cache=True, nogil=True)
def inertial_step(
    position_m: Array,
    velocity: Array,
    rotation: Array,
    gyro_bias: Array,
    accel_bias: Array,
    gyro_mixing: Array,
    covariance: Array,
    turn_measured: Array,
    force_measured: Array,
    gravity_m_s2: float,
    grid_scale: float,
    seconds: float,
    decay_rates: Array,
    noise_rates: Array,
) -> tuple[Array, Array, Array, Array]:
    """Position, velocity, rotation and covariance after ``seconds`` in which an IMU measured means.

    Args:
        position_m, velocity, rotation, gyro_bias, accel_bias, gyro_mixing, covariance: of the state.
        turn_measured: (3,) rad/s.
        force_measured: (3,) specific force, m/s2.
        gravity_m_s2: downwards.
        grid_scale: grid metres per metre on the ground.
        seconds: how long.
        decay_rates: (SIZE,) 1/s by which each error wanes, but for the first nine.
        noise_rates: (SIZE,) variance that each error gains in a second.
    """
    turn = turn_measured - gyro_bias - gyro_mixing @ turn_measured
    force = force_measured - accel_bias
    half = rotation_of(0.5 * seconds * turn)
    middle = rotation @ half
    acceleration = middle @ force
    acceleration[2] -= gravity_m_s2
    after = middle @ half
    to_grid = np.array([grid_scale, grid_scale, 1.0]) * seconds
    moved = position_m + to_grid * (velocity + 0.5 * seconds * acceleration)

    A = np.zeros((_KINEMATIC, len(decay_rates)))
    by_tilt = -seconds * (middle @ skew(force)) @ half.T
    turned = (half @ half).T
    for i in range(3):
        A[_P + i, _P + i] = A[_V + i, _V + i] = 1.0
        A[_P + i, _V + i] = to_grid[i]
        A[_T + i, _G + i] = -seconds
        for j in range(3):
            A[_V + i, _T + j] = by_tilt[i, j]
            A[_V + i, _A + j] = -seconds * middle[i, j]
            A[_P + i, _T + j] = 0.5 * to_grid[i] * by_tilt[i, j]
            A[_P + i, _A + j] = -0.5 * to_grid[i] * seconds * middle[i, j]
            A[_T + i, _T + j] = turned[i, j]
            A[_T + i, _M + 3 * i + j] = -seconds * turn_measured[j]
    P = _propagated(covariance, A, np.exp(-seconds * decay_rates), seconds * noise_rates)
    return moved, velocity + seconds * acceleration, after, P


@njit(cache=True, nogil=True)
def turning_step(
    position_m: Array,
    velocity: Array,
    rotation: Array,
    gyro_bias: Array,
    covariance: Array,
    grid_scale: float,
    seconds: float,
    decay_rates: Array,
    noise_rates: Array,
) -> tuple[Array, Array, Array, Array]:
    """The same without an IMU: the base turns on as it did, and its velocity with it (turn rate = -gyro_bias).

    A constant turn rate and velocity in three dimensions; X. R. Li and V. P. Jilkov, "Survey of maneuvering target
    tracking, part I: dynamic models", IEEE TAES 39(4), 2003, section V.
    """
    step = rotation_of(-seconds * gyro_bias)
    after = rotation @ step
    in_base = rotation.T @ velocity
    turned = after @ rotation.T
    new_velocity = turned @ velocity
    to_grid = np.array([grid_scale, grid_scale, 1.0]) * seconds
    moved = position_m + 0.5 * to_grid * (velocity + new_velocity)

    A = np.zeros((_KINEMATIC, len(decay_rates)))
    aside = after @ skew(in_base)
    by_tilt = aside @ (np.eye(3) - step.T)
    for i in range(3):
        A[_P + i, _P + i] = 1.0
        A[_P + i, _V + i] = 0.5 * to_grid[i]
        A[_T + i, _G + i] = -seconds
        for j in range(3):
            A[_V + i, _V + j] = turned[i, j]
            A[_V + i, _T + j] = by_tilt[i, j]
            A[_V + i, _G + j] = seconds * aside[i, j]
            A[_T + i, _T + j] = step[j, i]
        for j in range(_V, _A):
            A[_P + i, j] += 0.5 * to_grid[i] * A[_V + i, j]
    P = _propagated(covariance, A, np.exp(-seconds * decay_rates), seconds * noise_rates)
    return moved, new_velocity, after, P


@njit(cache=True, nogil=True)
def _propagated(covariance: Array, A: Array, decay: Array, noise: Array) -> Array:
    """F P F^T + Q, where F is ``A`` on the first nine errors and a decay on the others."""
    size = len(decay)
    top = A @ covariance
    after: Array = np.empty((size, size))
    after[:_KINEMATIC, :_KINEMATIC] = top @ A.T
    for i in range(_KINEMATIC):
        for j in range(_KINEMATIC, size):
            after[i, j] = after[j, i] = top[i, j] * decay[j]
    for i in range(_KINEMATIC, size):
        for j in range(_KINEMATIC, size):
            after[i, j] = covariance[i, j] * decay[i] * decay[j]
    for i in range(size):
        after[i, i] += noise[i]
    return after


@njit(cache=True, nogil=True)
def rotation_of(rotation_vector: Array) -> Array:
    """The rotation matrix (3, 3) of a rotation vector (3,): Solà, eq. 77; ``so3_exp`` is for many at once."""
    angle = np.sqrt((rotation_vector**2).sum())
    K = skew(rotation_vector)
    if angle < 1e-8:
        return np.eye(3) + K + 0.5 * (K @ K)
    turn: Array = np.eye(3) + np.sin(angle) / angle * K + (1.0 - np.cos(angle)) / angle**2 * (K @ K)
    return turn


@njit("float64[:,::1](float64[:])", cache=True, nogil=True)
def skew(vector: Array) -> Array:
    """The matrix (3, 3) that is the cross product with a vector (3,) from the left."""
    x, y, z = vector
    matrix: Array = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return matrix
