"""Driving along a street: where the camera is at every image."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import InputError
from fleetmap.geometry import so3_exp
from fleetmap.simulation.street import Street
from fleetmap.trajectory import Trajectory

Array = NDArray[np.float64]

START_NS = 1_700_000_000_000_000_000  # 2023-11-14T22:13:20Z

# Body motion of a car on its springs: amplitude and slowest, fastest frequency of three sines per axis.
_WOBBLE_RAD = np.radians([0.25, 0.12, 0.3])  # about the camera's x (pitch), y (yaw), z (roll)
_BOUNCE_M = 0.008
_WEAVE_M = 0.06
_FREQUENCIES_HZ = (0.25, 1.6)


def drive_along(
    street: Street,
    *,
    lane_offset_m: float = 0.0,
    speed_mps: float = 8.0,
    rate_hz: float = 10.0,
    camera_height_m: float = 1.65,
    start_m: float = 0.0,
    end_m: float | None = None,
    seed: int = 0,
    start_ns: int = START_NS,
) -> Trajectory:
    """Camera poses ``utm_from_cam`` of a car that drives along a street at an even speed.

    ``lane_offset_m`` is to the left of the right-hand lane's centre (3.5: the other lane); ``start_m`` and
    ``end_m`` count along the street's path, to its end by default. The camera looks along the path, x right,
    y down, z forward, and sways a little as a car does. Metres are those of the UTM grid.

    Raises:
        InputError: a speed or rate that is not positive, or a stretch that ends before it starts.
    """
    stop_m = street.length_m if end_m is None else end_m
    if not (speed_mps > 0.0 and rate_hz > 0.0 and start_m < stop_m):
        raise InputError(f"cannot drive from {start_m} m to {stop_m} m at {speed_mps} m/s with {rate_hz} images/s")
    s_fine = np.arange(start_m, stop_m + 0.05, 0.05)
    travelled_m = _arc_length(street.path.at(s_fine, lane_offset_m))
    seconds = np.arange(0.0, travelled_m[-1] / speed_mps, 1.0 / rate_hz)
    rng = np.random.default_rng(seed)
    s = np.interp(seconds * speed_mps, travelled_m, s_fine)
    left = lane_offset_m + _WEAVE_M * _sway(rng, seconds, _FREQUENCIES_HZ[0] / 2.0)
    height = camera_height_m + _BOUNCE_M * _sway(rng, seconds, _FREQUENCIES_HZ[1])
    wobble = np.stack([a * _sway(rng, seconds, _FREQUENCIES_HZ[1]) for a in _WOBBLE_RAD], axis=1)
    positions = street.anchor.utm_from_map(street.path.at(s, left, height))
    rotations = _looking_along(street, s) @ so3_exp(wobble)
    stamps_ns = start_ns + np.rint(seconds * 1e9).astype(np.int64)
    return Trajectory(street.anchor.epsg, stamps_ns, positions, rotations)


def _arc_length(points: Array) -> Array:
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])


def _sway(rng: np.random.Generator, seconds: Array, fastest_hz: float) -> Array:
    """A smooth random motion (N,) of unit deviation: three sines of random frequency and phase."""
    frequencies = rng.uniform(_FREQUENCIES_HZ[0] / 4.0, fastest_hz, 3)
    phases = rng.uniform(0.0, 2.0 * np.pi, 3)
    return np.asarray(np.sin(2.0 * np.pi * np.outer(seconds, frequencies) + phases).sum(axis=1) / np.sqrt(1.5))


def _looking_along(street: Street, s: Array) -> Array:
    """Rotations (N, 3, 3) ``map_from_cam`` of a camera on a car at ``s`` that turns with its wheelbase."""
    ahead, behind = street.path.at(s + 1.3), street.path.at(s - 1.3)
    forward = ahead - behind
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return np.stack([right, np.cross(forward, right), forward], axis=2)
