"""A piece of a map, ready to be looked into by one camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.camera import Camera
from fleetmap.geodesy import UtmAnchor
from fleetmap.vision.place_recognition import PlaceIndex
from fleetmap.visual_map import LocalizationMap
from fleetmap_localizer.local_map import LocalMap
from fleetmap_localizer.settings import LocalizerSettings

_REACH_M = 60.0


@dataclass(frozen=True)
class LocalizableMap:
    """One version of a map, or some of its cells."""

    map_id: str
    version: str  # SHA-256 of the manifest
    camera: Camera  # of the survey vehicle
    content: LocalizationMap


class MapView:
    """What a localizer looks into: always of one version of one map, and never changed."""

    def __init__(self, source: LocalizableMap, camera: Camera, settings: LocalizerSettings) -> None:
        """Prepare for images of ``camera``."""
        content = source.content
        self.map_id, self.version, self.content = source.map_id, source.version, content
        self.local_map = LocalMap(
            content,
            float(np.sqrt(source.camera.fx_px * source.camera.fy_px)),
            camera,
            settings.features.levels,
            settings.features.scale_factor,
            settings.local_map,
        )
        self.places = PlaceIndex(
            content.landmarks.descriptors,
            content.seen_by_keyframe,
            content.seen_landmark,
            len(content.keyframes),
        )

    def reaches(self, position_in_map_m: NDArray[np.float64]) -> bool:
        """Whether some of its keyframes lie around a place (3,), so that a camera there may see what they saw."""
        away_m = self.content.keyframes.positions_m[:, :2] - position_in_map_m[:2]
        return bool(np.any(np.einsum("ki,ki->k", away_m, away_m) <= _REACH_M**2))

    @property
    def anchor(self) -> UtmAnchor:
        """Origin of the frame that the content is in."""
        return self.content.anchor
