"""The UGBA's cost with the calibration free: intrinsics and lens beside poses, points and fixes.

    min over c, {T_i}, {X_j} of  sum rho(|z_ij - pi(c, T_i, X_j)|^2 in Omega) + fixes and priors + |c - c_0|^2 in P

The z_ij are recorded pixels, distorted as they came: undistorted ones would move with c, and a shorter focal
length would shrink their errors. What is not an image (fixes, level prior, ...) is taken from the GTSAM graph and
linearised there; the images' part is linearised here for the drive's own lens model. The prior P holds what a
drive does not determine where the recording has it.
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np
import scipy.sparse as sp
from gtsam.symbol_shorthand import X
from numpy.typing import NDArray

from fleetmap.camera import Camera
from fleetmap.geometry import Pose, nearest_rotations
from fleetmap_mapper.bordered_system import BorderedStep, LinearisedImages, LinearisedRest, shared_blocks
from fleetmap_mapper.calibration_parameters import CalibrationPrior, recorded_jacobian
from fleetmap_mapper.global_adjustment import GlobalProblem, graph_without_images

Array = NDArray[np.float64]

_HUBER_PIXEL_SIGMAS = 2.4477  # 95 % of chi-square with 2 degrees of freedom, as in the UGBA
_MIN_DEPTH = 1e-6


@dataclass(frozen=True)
class Observations:
    """What was recorded, sorted by point."""

    pixels: Array  # (M, 2) distorted
    sigmas_px: Array  # (M,) of the recorded pixels
    keyframe_index: NDArray[np.int64]  # (M,)
    starts: NDArray[np.int64]  # (P + 1,) first observation of each point

    @property
    def point_index(self) -> NDArray[np.int64]:
        """(M,)."""
        return np.repeat(np.arange(len(self.starts) - 1), np.diff(self.starts))


def recorded_observations(problem: GlobalProblem) -> Observations:
    """The problem's observations as the sensor saw them."""
    order = np.argsort(problem.point_index, kind="stable")
    ideal = problem.pixels[order]
    return Observations(
        problem.camera.distort(ideal),
        problem.sigmas_px[order] / problem.camera.magnification(ideal),
        problem.keyframe_index[order].astype(np.int64),
        np.searchsorted(problem.point_index[order], np.arange(len(problem.points_m) + 1)).astype(np.int64),
    )


@dataclass(frozen=True)
class State:
    """One guess at everything."""

    change: Array  # (C,) of the calibration, in prior sigmas
    values: gtsam.Values  # poses, and whatever else the graph holds besides points
    points_m: Array  # (P, 3)

    def poses(self, count: int) -> tuple[Array, Array]:
        """Rotations (K, 3, 3) and centres (K, 3), map_from_cam."""
        poses = [self.values.atPose3(X(i)) for i in range(count)]
        return np.array([p.rotation().matrix() for p in poses]), np.array([p.translation() for p in poses])


class CalibratedGraph:
    """Made once from a problem, then evaluated and linearised at one state after the other."""

    def __init__(self, problem: GlobalProblem, prior: CalibrationPrior) -> None:
        self.prior, self.keyframes = prior, len(problem.poses)
        self.observations = recorded_observations(problem)
        self._graph, values = graph_without_images(problem)
        self.start = State(prior.change(problem.camera), values, problem.points_m)
        self._columns = _columns(self.keyframes, values)
        k, starts = self.observations.keyframe_index, self.observations.starts
        self._shared_blocks = shared_blocks(k, starts, self.keyframes)
        seen = np.isfinite(self._errors_px(self.start)).all(axis=1)
        self._weights = np.where(seen, 1.0 / self.observations.sigmas_px, 0.0)

    def camera(self, state: State) -> Camera:
        """The calibration of a state."""
        return self.prior.camera(state.change)

    def poses(self, state: State) -> list[Pose]:
        """The poses of a state."""
        rotations, centres = state.poses(self.keyframes)
        # Every step multiplies rotations: without this, rounding errors pile up.
        return [Pose(R, t) for R, t in zip(nearest_rotations(rotations), centres, strict=True)]

    def cost(self, state: State) -> float:
        """Half of all squares; infinite where something seen at the start has no pixel any more."""
        counted = self._weights > 0.0
        norms = np.linalg.norm(self._errors_px(state)[counted], axis=1) * self._weights[counted]
        if not np.isfinite(norms).all():
            return float("inf")
        limit = _HUBER_PIXEL_SIGMAS
        images = np.where(norms <= limit, 0.5 * norms**2, limit * (norms - 0.5 * limit)).sum()
        return float(images + self._graph.error(state.values) + 0.5 * state.change @ state.change)

    def linearised(self, state: State) -> tuple[LinearisedImages, LinearisedRest]:
        """First derivatives, weighted by the sigmas and Huber's root; poses move as T exp([w, v])."""
        camera, counted = self.camera(state), self._weights > 0.0
        rotations, in_cam = self._in_cam(state)
        depth = np.where(counted, in_cam[:, 2], 1.0)[:, None]
        normalised = np.where(counted[:, None], in_cam[:, :2] / depth, 0.0)
        errors = _recorded(camera, normalised) - self.observations.pixels
        errors[~counted] = 0.0
        norms = np.linalg.norm(errors, axis=1) * self._weights
        weights = self._weights * np.sqrt(_HUBER_PIXEL_SIGMAS / np.maximum(norms, _HUBER_PIXEL_SIGMAS))
        by_cam = np.zeros((len(depth), 2, 3))
        by_cam[:, 0, 0] = by_cam[:, 1, 1] = 1.0 / depth[:, 0]
        by_cam[:, :, 2] = -normalised / depth
        by_cam = weights[:, None, None] * (recorded_jacobian(camera, normalised) @ by_cam)
        images = LinearisedImages(
            errors * weights[:, None],
            np.concatenate([by_cam @ _cross_matrices(in_cam), -by_cam], axis=2),
            by_cam @ rotations.transpose(0, 2, 1),
            self.prior.pixel_jacobian(camera, normalised) * weights[:, None, None],
            self.observations.keyframe_index,
            self.observations.starts,
            self.keyframes,
            self._shared_blocks,
        )
        return images, self._linearised_rest(state)

    def moved(self, state: State, step: BorderedStep) -> State:
        """The state after a step."""
        delta = gtsam.VectorValues()
        for key, columns in self._columns.items():
            delta.insert(key, step.poses[columns])
        return State(state.change + step.calibration, state.values.retract(delta), state.points_m + step.points)

    def _in_cam(self, state: State) -> tuple[Array, Array]:
        """For each observation the rotation map_from_cam (M, 3, 3), and the point in the camera (M, 3)."""
        rotations, centres = state.poses(self.keyframes)
        k = self.observations.keyframe_index
        offsets = state.points_m[self.observations.point_index] - centres[k]
        return rotations[k], (offsets[:, None, :] @ rotations[k])[:, 0]

    def _errors_px(self, state: State) -> Array:
        """(M, 2); NaN where nothing is imaged."""
        _, in_cam = self._in_cam(state)
        return np.asarray(self.camera(state).project(in_cam) - self.observations.pixels)

    def _linearised_rest(self, state: State) -> LinearisedRest:
        size = sum(len(columns) for columns in self._columns.values())
        entries, rows, columns, residuals = [], [], [], []
        linear, row = self._graph.linearize(state.values), 0
        for index in range(linear.size()):
            A, b = linear.at(index).jacobian()
            where = np.concatenate([self._columns[key] for key in linear.at(index).keys()])  # noqa: SIM118
            i, j = np.meshgrid(np.arange(row, row + len(b)), where, indexing="ij")
            entries.append(np.asarray(A).ravel())
            rows.append(i.ravel())
            columns.append(j.ravel())
            residuals.append(-np.asarray(b))
            row += len(b)
        if not residuals:
            return LinearisedRest(sp.csr_matrix((0, size)), np.zeros(0))
        places = (np.concatenate(rows), np.concatenate(columns))
        jacobian = sp.csr_matrix((np.concatenate(entries), places), shape=(row, size))
        return LinearisedRest(jacobian, np.concatenate(residuals))


def _columns(keyframes: int, values: gtsam.Values) -> dict[int, NDArray[np.int64]]:
    """Where each variable stands in a step: poses in their order, then all others."""
    sizes = values.dims()
    poses = [X(i) for i in range(keyframes)]
    others = sorted(set(sizes) - set(poses))
    ends = np.cumsum([sizes[key] for key in (*poses, *others)])
    return {key: np.arange(end - sizes[key], end) for key, end in zip((*poses, *others), ends, strict=True)}


def _recorded(camera: Camera, normalised: Array) -> Array:
    """Recorded pixels (N, 2) of normalised points (N, 2)."""
    return camera.project(np.column_stack([normalised, np.ones(len(normalised))]))


def _cross_matrices(vectors: Array) -> Array:
    """[v]x (N, 3, 3) of vectors (N, 3)."""
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    return np.asarray(np.stack([np.stack(row, axis=1) for row in rows], axis=1))
