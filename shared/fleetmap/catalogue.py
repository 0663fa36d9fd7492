"""What the map server and its clients say to each other about maps.

A map is known by its ``map_id``; each content it ever had is a version, named by the SHA-256 of its
manifest. The latest version of an id is the one published last.
"""

from __future__ import annotations

from typing import Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field
from pyproj import Geod

from fleetmap.manifest import Manifest, MapId, Sha256

NEAR_RADIUS_M = 1000.0  # how far from a map's trajectory a place still counts as near it
_METRES_PER_DEGREE = 111_320.0  # of latitude, and of longitude at the equator; good to 0.6 %


class MapEntry(BaseModel):
    """One version of one map, as the catalogue lists it."""

    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)

    map_id: MapId
    version: Sha256
    epsg: int
    bbox_lonlat: tuple[float, float, float, float]  # west, south, east, north of the keyframes, degrees
    trajectory_lonlat: tuple[tuple[float, float], ...]  # thinned keyframe positions, degrees
    start_ns: int  # of the survey drive, UTC since the epoch
    end_ns: int
    created_ns: int  # when the mapper finished
    published_ns: int  # when the server accepted it
    keyframes: int
    landmarks: int
    length_m: float
    size_bytes: int = Field(gt=0)  # of the manifest and all parts
    publishable: bool
    gnss_mode: str
    gnss_residual_rms_m: float | None
    reprojection_rms_px: float
    warnings: tuple[str, ...] = ()

    @classmethod
    def from_manifest(cls, manifest: Manifest, version: str, manifest_bytes: int, published_ns: int) -> Self:
        """What the catalogue keeps of a manifest; ``manifest_bytes`` is the length of its file."""
        quality = manifest.quality
        parts = {part.sha256: part.size_bytes for part in manifest.parts}
        return cls(
            map_id=manifest.map_id,
            version=version,
            epsg=manifest.anchor.epsg,
            bbox_lonlat=manifest.bbox_lonlat,
            trajectory_lonlat=manifest.trajectory_lonlat,
            start_ns=manifest.provenance.start_ns,
            end_ns=manifest.provenance.end_ns,
            created_ns=manifest.provenance.created_ns,
            published_ns=published_ns,
            keyframes=quality.keyframes,
            landmarks=quality.landmarks,
            length_m=quality.length_m,
            size_bytes=manifest_bytes + sum(parts.values()),
            publishable=quality.publishable,
            gnss_mode=quality.gnss_mode,
            gnss_residual_rms_m=quality.gnss_residual_rms_m,
            reprojection_rms_px=quality.reprojection_rms_px,
            warnings=quality.warnings,
        )

    def distance_m(self, lat_deg: float, lon_deg: float) -> float:
        """Ground distance from a place to the map's trajectory (to its bounding box if it has none)."""
        nearest_lonlat = _nearest_on_path(self._outline(), lat_deg, lon_deg)
        _, _, distance_m = Geod(ellps="WGS84").inv(lon_deg, lat_deg, *nearest_lonlat)
        return float(distance_m)

    def _outline(self) -> NDArray[np.float64]:
        """The trajectory, or the corners of the bounding box; (N, 2) longitude, latitude."""
        west, south, east, north = self.bbox_lonlat
        corners = ((west, south), (east, south), (east, north), (west, north), (west, south))
        return np.array(self.trajectory_lonlat or corners, dtype=np.float64)


class MapPage(BaseModel):
    """A page of the catalogue; ``next_offset`` asks for the page after it, None at the end."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    maps: tuple[MapEntry, ...]
    next_offset: int | None = None


def search_box_lonlat(lat_deg: float, lon_deg: float, radius_m: float) -> tuple[float, float, float, float]:
    """West, south, east, north around a circle on the ground; near a pole all longitudes."""
    reach_lat_deg = 1.01 * radius_m / _METRES_PER_DEGREE
    shrink = float(np.cos(np.radians(min(abs(lat_deg) + reach_lat_deg, 90.0))))
    reach_lon_deg = reach_lat_deg / shrink if shrink > 1e-6 else 360.0
    if reach_lon_deg >= 180.0:
        return (-180.0, max(lat_deg - reach_lat_deg, -90.0), 180.0, min(lat_deg + reach_lat_deg, 90.0))
    west, east = (_wrap_lon(lon_deg - reach_lon_deg), _wrap_lon(lon_deg + reach_lon_deg))
    return (west, max(lat_deg - reach_lat_deg, -90.0), east, min(lat_deg + reach_lat_deg, 90.0))


def _nearest_on_path(path_lonlat: NDArray[np.float64], lat_deg: float, lon_deg: float) -> tuple[float, float]:
    """The point of a polyline nearest to a place, found on the plane that touches the Earth at the place."""
    shrink = max(float(np.cos(np.radians(lat_deg))), 1e-9)
    offsets = path_lonlat - (lon_deg, lat_deg)
    offsets[:, 0] = (offsets[:, 0] + 180.0) % 360.0 - 180.0
    plane = offsets * (shrink, 1.0)  # (N, 2) degrees of latitude
    starts, ends = (plane[:-1], plane[1:]) if len(plane) > 1 else (plane, plane)
    steps = ends - starts
    lengths_sq = np.maximum(np.einsum("ij,ij->i", steps, steps), 1e-30)
    along = np.clip(-np.einsum("ij,ij->i", starts, steps) / lengths_sq, 0.0, 1.0)
    feet = starts + along[:, None] * steps
    east, north = feet[np.argmin(np.einsum("ij,ij->i", feet, feet))]
    return (_wrap_lon(lon_deg + float(east) / shrink), lat_deg + float(north))


def _wrap_lon(lon_deg: float) -> float:
    return (lon_deg + 180.0) % 360.0 - 180.0
