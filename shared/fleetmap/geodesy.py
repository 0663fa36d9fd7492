"""WGS84 <-> UTM, map anchors, grid convergence and point scale factor. All of it is pyproj's work.

pyproj is imported when a place on the globe is first asked for: a localizer in one map may never ask.

Heights are ellipsoidal throughout. UTM is not a local east-north-up frame: grid north turns away from
true north by the convergence, and grid metres relate to ground metres by the point scale factor.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import InputError

if TYPE_CHECKING:
    from pyproj import Proj, Transformer

Array = NDArray[np.float64]


@dataclass(frozen=True)
class UtmAnchor:
    """Origin of a map frame: whole metres in one UTM zone. map = UTM - anchor."""

    epsg: int  # 32601..32660 north, 32701..32760 south
    easting_m: int
    northing_m: int
    height_m: int

    @property
    def offset_m(self) -> Array:
        """The anchor as an array (3,): easting, northing, height."""
        return np.array([self.easting_m, self.northing_m, self.height_m], dtype=np.float64)

    def utm_from_map(self, points_in_map: Array) -> Array:
        """Map points (..., 3) as easting, northing, height."""
        return points_in_map + self.offset_m

    def map_from_utm(self, points_in_utm: Array) -> Array:
        """Easting, northing, height (..., 3) as map points."""
        return points_in_utm - self.offset_m


def utm_epsg(lat_deg: float, lon_deg: float) -> int:
    """EPSG code of the UTM zone that holds a position (Norway's and Svalbard's exceptions not applied).

    Raises:
        InputError: the position is not on the globe, or outside UTM's 80 S to 84 N.
    """
    if not (-80.0 <= lat_deg <= 84.0 and -180.0 <= lon_deg <= 180.0):
        raise InputError(f"latitude {lat_deg}, longitude {lon_deg} lies outside UTM (80 S to 84 N)")
    zone = min(int((lon_deg + 180.0) // 6.0) + 1, 60)
    return (32600 if lat_deg >= 0.0 else 32700) + zone


@dataclass(frozen=True)
class UtmGrid:
    """One UTM zone: conversions between it and WGS84."""

    epsg: int

    def __post_init__(self) -> None:
        if not (32601 <= self.epsg <= 32660 or 32701 <= self.epsg <= 32760):
            raise InputError(f"EPSG:{self.epsg} is no UTM zone on WGS84 (326xx north, 327xx south)")

    @staticmethod
    def at(lat_deg: float, lon_deg: float) -> UtmGrid:
        """The zone that holds a position."""
        return UtmGrid(utm_epsg(lat_deg, lon_deg))

    def from_geodetic(self, lat_deg: Array, lon_deg: Array, height_m: Array) -> Array:
        """Easting, northing, height (..., 3) of geodetic positions, each (...,)."""
        easting, northing = _transformer(self.epsg).transform(lon_deg, lat_deg)
        return np.stack([np.asarray(easting), np.asarray(northing), np.asarray(height_m)], axis=-1)

    def to_geodetic(self, points_in_utm: Array) -> tuple[Array, Array, Array]:
        """Latitude, longitude (deg) and height (m), each (...,), of UTM points (..., 3)."""
        lon_deg, lat_deg = _transformer(self.epsg).transform(
            points_in_utm[..., 0], points_in_utm[..., 1], direction="INVERSE"
        )
        return np.asarray(lat_deg), np.asarray(lon_deg), np.asarray(points_in_utm[..., 2])

    def convergence_rad(self, lat_deg: float, lon_deg: float) -> float:
        """Grid convergence: the clockwise angle from true north to grid north (positive east of the meridian)."""
        return float(np.radians(_projection(self.epsg).get_factors(lon_deg, lat_deg).meridian_convergence))

    def point_scale_factor(self, lat_deg: float, lon_deg: float) -> float:
        """Grid metres per metre on the ellipsoid (0.9996 on the central meridian)."""
        return float(_projection(self.epsg).get_factors(lon_deg, lat_deg).meridional_scale)

    def grid_from_enu(self, lat_deg: float, lon_deg: float) -> Array:
        """Rotation (3, 3) that takes true east, north, up into grid east, grid north, up."""
        angle = self.convergence_rad(lat_deg, lon_deg)
        cos, sin = np.cos(angle), np.sin(angle)
        return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])


def normal_gravity_m_s2(lat_deg: float, height_m: float) -> float:
    """Normal gravity of the WGS84 ellipsoid at a latitude, at a height above it.

    Source: NIMA TR8350.2, "Department of Defense World Geodetic System 1984", 2000, eq. 4-1 and 4-3 (to first
    order in the height).
    """
    sin2 = float(np.sin(np.radians(lat_deg)) ** 2)
    on_ellipsoid = 9.7803253359 * (1.0 + 0.00193185265241 * sin2) / np.sqrt(1.0 - 0.00669437999014 * sin2)
    return float(on_ellipsoid * (1.0 - 2.0 * height_m / 6_371_000.0))


@lru_cache(maxsize=64)
def _transformer(epsg: int) -> Transformer:
    from pyproj import Transformer

    return Transformer.from_crs("EPSG:4326", f"EPSG:{epsg}", always_xy=True)


@lru_cache(maxsize=64)
def _projection(epsg: int) -> Proj:
    from pyproj import CRS, Proj
    from pyproj.exceptions import CRSError

    try:
        return Proj(CRS.from_epsg(epsg))
    except CRSError as error:
        raise InputError(f"pyproj does not know EPSG:{epsg}: {error}") from error
