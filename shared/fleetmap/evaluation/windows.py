"""Errors of shape: a Sim(3) of its own fitted to every window of the road.

One Sim(3) over a whole drive judges plain SLAM by luck: drift bends the ends, and a lucky bend cancels another.
A window of tens of metres is too short to bend much, so its residual tells the local error, and the scales of
the windows tell the drift.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import InputError
from fleetmap.evaluation.trajectory_errors import TrajectoryErrors
from fleetmap.geometry import umeyama_alignment

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

WINDOW_M = 50.0
STEP_M = 1.0
MIN_POSES = 6  # 18 coordinates for the 7 unknowns of a Sim(3)


@dataclass(frozen=True)
class WindowErrors:
    """What is left of each of K windows when it alone is aligned; K is 0 where none could be."""

    window_m: float
    starts_m: Array  # (K,) way driven along the reference at the window's first pose
    rmse_m: Array  # (K,) of the 3-D position, after the alignment
    scales: Array  # (K,) reference metres per metre of the estimate as it was given
    left_out: int  # windows with too few poses, with a hole, or in which the estimate stands still
    length_m: float  # way driven from the first to the last compared pose

    @property
    def count(self) -> int:
        """How many windows were fitted."""
        return len(self.starts_m)

    @property
    def centres_m(self) -> Array:
        """Way driven (K,) at the middle of each window."""
        return self.starts_m + 0.5 * self.window_m

    def to_json(self) -> dict[str, float | int] | None:
        """The figures, or None where no window could be fitted."""
        if self.count == 0:
            return None
        smallest, largest = float(self.scales.min()), float(self.scales.max())
        return {
            "window_m": self.window_m,
            "count": self.count,
            "left_out": self.left_out,
            "mean_rmse_m": float(self.rmse_m.mean()),
            "max_rmse_m": float(self.rmse_m.max()),
            "scale_min": smallest,
            "scale_max": largest,
            "scale_ratio": largest / smallest,
            "log_scale_std": float(np.log(self.scales).std()),
        }


def fit_windows(errors: TrajectoryErrors, window_m: float = WINDOW_M, step_m: float = STEP_M) -> WindowErrors:
    """Umeyama's alignment of the estimate's positions to the truth, in every window of the road.

    Way is measured along the reference. A window starts at the first compared pose of every ``step_m`` metres of
    it (so at every pose of a drive that makes a metre or more between two, and not again and again where the
    vehicle waits) and ends at the first compared pose at least ``window_m`` further on. Windows that do not end
    before the drive does are none. Left out are windows of fewer than 6 poses, with a hole of more than half
    their length, or in which the estimate does not move. A straight window is good: the turn about its line is
    free, and neither residual nor scale depends on it.

    Raises:
        InputError: a window or step that is not positive.
    """
    if not (0.0 < window_m < np.inf and 0.0 < step_m < np.inf):
        raise InputError(f"a window of {window_m:g} m every {step_m:g} m makes no sense; both must be positive")
    driven_m = errors.driven_m
    firsts, lasts = _spans(driven_m, window_m, step_m)
    holes = np.concatenate([[0], np.cumsum(np.diff(driven_m) > 0.5 * window_m)])
    sound = (lasts - firsts + 1 >= MIN_POSES) & (holes[lasts] == holes[firsts])
    estimated_m, true_m = errors.positions_m, errors.true_positions_m
    fits = [
        _fit(estimated_m[a : b + 1], true_m[a : b + 1]) for a, b in zip(firsts[sound], lasts[sound], strict=True)
    ]
    fitted = np.array([fit is not None for fit in fits], dtype=bool)
    rmse_m, scales = np.array([fit for fit in fits if fit is not None]).reshape(-1, 2).T
    return WindowErrors(
        window_m=window_m,
        starts_m=driven_m[firsts[sound][fitted]],
        rmse_m=rmse_m,
        scales=scales * (1.0 if errors.scale is None else errors.scale),
        left_out=len(firsts) - len(rmse_m),
        length_m=float(driven_m[-1] - driven_m[0]),
    )


def _spans(driven_m: Array, window_m: float, step_m: float) -> tuple[Indices, Indices]:
    """First and last compared pose (K,), (K,) of every window that fits whole."""
    # A trifle off: steps that should add up to a metre or to the window do so only but for rounding.
    _, firsts = np.unique(np.floor((driven_m - driven_m[0]) / step_m + 1e-6), return_index=True)
    lasts = np.searchsorted(driven_m, driven_m[firsts] + (window_m - 1e-9))
    whole = lasts < len(driven_m)
    return firsts[whole], lasts[whole]


def _fit(estimated_m: Array, true_m: Array) -> tuple[float, float] | None:
    """RMSE and scale of one window's alignment; None where the estimate has no extent to align."""
    # Centred first: at a UTM northing a product of float64 keeps only nanometres.
    estimated_m, true_m = estimated_m - estimated_m.mean(axis=0), true_m - true_m.mean(axis=0)
    try:
        true_from_estimated = umeyama_alignment(estimated_m, true_m)
    except InputError:
        return None
    if true_from_estimated.scale <= 0.0:
        return None
    residuals_m = true_from_estimated.transform(estimated_m) - true_m
    return float(np.sqrt((residuals_m**2).sum(axis=1).mean())), true_from_estimated.scale
