"""Where a map lies on the globe, as catalogues want to know it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fleetmap.geodesy import UtmAnchor, UtmGrid
from fleetmap.visual_map import Keyframes

_TRAJECTORY_SPACING_M = 10.0


def keyframes_lonlat(anchor: UtmAnchor, keyframes: Keyframes) -> NDArray[np.float64]:
    """Longitude and latitude (K, 2) of the keyframes in degrees, to about a centimetre."""
    in_utm = anchor.utm_from_map(keyframes.positions_m)
    lat_deg, lon_deg, _ = UtmGrid(anchor.epsg).to_geodetic(in_utm)
    return np.asarray(np.stack([lon_deg, lat_deg], axis=1).round(7), dtype=np.float64)


def bounding_box(lonlat: NDArray[np.float64]) -> tuple[float, float, float, float]:
    """West, south, east, north; across the antimeridian west is greater than east (RFC 7946, section 5.2)."""
    lon_deg, lat_deg = lonlat[:, 0], lonlat[:, 1]
    west, east = lon_deg.min(), lon_deg.max()
    if east - west > 180.0:
        west, east = lon_deg[lon_deg > 0.0].min(), lon_deg[lon_deg <= 0.0].max()
    return float(west), float(lat_deg.min()), float(east), float(lat_deg.max())


def thinned(positions_m: NDArray[np.float64]) -> list[int]:
    """Indices of positions about 10 m apart, the first and the last among them."""
    kept = [0]
    for index, position in enumerate(positions_m):
        if np.linalg.norm(position - positions_m[kept[-1]]) >= _TRAJECTORY_SPACING_M:
            kept.append(index)
    return kept if kept[-1] == len(positions_m) - 1 else [*kept, len(positions_m) - 1]
