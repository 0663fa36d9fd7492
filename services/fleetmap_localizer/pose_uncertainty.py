"""How sure a pose is."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fleetmap_localizer.relocalization import Located


def pose_covariance(located: Located) -> NDArray[np.float64]:
    """Covariance (6, 6) of the tangent [rotation (rad), translation (m)] in the camera's frame."""
    return located.fit.answer.covariance
