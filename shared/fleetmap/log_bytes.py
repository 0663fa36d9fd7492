"""Positive numbers as bytes: the logarithm in even steps, so that small and large ones keep the same ratio."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_LARGEST = 255


@dataclass(frozen=True)
class LogBytes:
    """Byte b stands for ``smallest * exp(b * step)``."""

    smallest: float
    step: float  # of the natural logarithm

    def nearest(self, values: NDArray[np.floating]) -> NDArray[np.uint8]:
        """Bytes that stand for the values within half a step; what lies outside the range becomes its end."""
        return self._clipped(np.rint(self._position(values)))

    def at_least(self, values: NDArray[np.floating]) -> NDArray[np.uint8]:
        """Bytes that stand for the values or up to a step more; what exceeds the range becomes its end."""
        return self._clipped(np.ceil(self._position(values) - 1e-4))  # what was such a number stays what it was

    def values(self, stored: NDArray[np.uint8]) -> NDArray[np.float64]:
        """What the bytes stand for."""
        return np.asarray(self.smallest * np.exp(self.step * stored.astype(np.float64)))

    def _position(self, values: NDArray[np.floating]) -> NDArray[np.float64]:
        return np.log(np.maximum(values.astype(np.float64), self.smallest) / self.smallest) / self.step

    def _clipped(self, steps: NDArray[np.float64]) -> NDArray[np.uint8]:
        return steps.clip(0, _LARGEST).astype(np.uint8)
