"""What the map server and its clients say to each other about maps.

A map is known by its ``map_id``; each content it ever had is a version, named by the SHA-256 of its
manifest. Publishing, and going back to an older content, adds the next number to the map's history; the latest
version is the one with the highest number. A retired version is neither listed nor served any more.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate, pairwise
from typing import Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

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

    number: int = Field(default=1, ge=1)  # in the map's history
    predecessor: Sha256 | None = None  # the version before it that is not retired
    predecessor_number: int | None = None
    successor: Sha256 | None = None  # the version after it
    successor_number: int | None = None
    is_latest: bool = True
    retired: bool = False
    origin: Literal["published", "rollback"] = "published"

    drive: str = ""  # name of the recording
    drive_sha256: Sha256 | None = None
    frames_total: int | None = None
    frames_posed: int | None = None
    segments: int = 1  # see fleetmap.manifest.Quality for this and what follows
    position_sigma_m: float | None = None
    position_sigma_p95_m: float | None = None
    height_sigma_m: float | None = None
    landmarks_per_m: float | None = None
    weak_length_m: float | None = None

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
            drive=manifest.provenance.drive,
            drive_sha256=manifest.provenance.drive_sha256,
            frames_total=quality.frames_total,
            frames_posed=quality.frames_posed,
            segments=quality.segments,
            position_sigma_m=quality.position_sigma_m,
            position_sigma_p95_m=quality.position_sigma_p95_m,
            height_sigma_m=quality.height_sigma_m,
            landmarks_per_m=quality.landmarks_per_m,
            weak_length_m=quality.weak_length_m,
        )

    def distance_m(self, lat_deg: float, lon_deg: float) -> float:
        """Ground distance from a place to the map's trajectory (to its bounding box if it has none)."""
        path = np.array(self.trajectory_lonlat or box_corners(self.bbox_lonlat), dtype=np.float64)
        return float(distances_m([path], lat_deg, lon_deg)[0])


def search_box_lonlat(lat_deg: float, lon_deg: float, radius_m: float) -> tuple[float, float, float, float]:
    """West, south, east, north around a circle on the ground; near a pole all longitudes."""
    reach_lat_deg = 1.01 * radius_m / _METRES_PER_DEGREE
    shrink = float(np.cos(np.radians(min(abs(lat_deg) + reach_lat_deg, 90.0))))
    reach_lon_deg = reach_lat_deg / shrink if shrink > 1e-6 else 360.0
    if reach_lon_deg >= 180.0:
        return (-180.0, max(lat_deg - reach_lat_deg, -90.0), 180.0, min(lat_deg + reach_lat_deg, 90.0))
    west, east = (_wrap_lon(lon_deg - reach_lon_deg), _wrap_lon(lon_deg + reach_lon_deg))
    return (west, max(lat_deg - reach_lat_deg, -90.0), east, min(lat_deg + reach_lat_deg, 90.0))


def box_corners(box: tuple[float, float, float, float]) -> tuple[tuple[float, float], ...]:
    """The closed outline of a box (west, south, east, north); longitude, latitude."""
    west, south, east, north = box
    return ((west, south), (east, south), (east, north), (west, north), (west, south))


def distances_m(
    paths_lonlat: Sequence[NDArray[np.float64]], lat_deg: float, lon_deg: float
) -> NDArray[np.float64]:
    """Ground distances from a place to polylines.

    The nearest point of each is found on the plane that touches the Earth at the place. What a path's distance
    is does not depend on the others, to the last bit.

    Args:
        paths_lonlat: (N, 2) each, N >= 1: longitude, latitude in degrees.
        lat_deg: of the place.
        lon_deg: of the place.

    Returns:
        As many as there are paths.
    """
    from pyproj import Geod  # here, so that clients that do not sort maps start without it

    if not paths_lonlat:
        return np.empty(0)
    shrink = max(float(np.cos(np.radians(lat_deg))), 1e-9)
    feet, path_starts = _nearest_of_segments(paths_lonlat, lat_deg, lon_deg, shrink)
    distances_sq = feet[:, 0] * feet[:, 0] + feet[:, 1] * feet[:, 1]
    ends = pairwise([*path_starts, len(distances_sq)])
    nearest = [begin + int(np.argmin(distances_sq[begin:end])) for begin, end in ends]
    east, north = feet[nearest].T
    here = np.ones_like(east)
    lons = (lon_deg + east / shrink + 180.0) % 360.0 - 180.0
    _, _, distances = Geod(ellps="WGS84").inv(lon_deg * here, lat_deg * here, lons, lat_deg + north)
    return np.asarray(distances, dtype=np.float64)


def _nearest_of_segments(
    paths: Sequence[NDArray[np.float64]], lat_deg: float, lon_deg: float, shrink: float
) -> tuple[NDArray[np.float64], list[int]]:
    """The nearest points of all segments, (S, 2) degrees of latitude east and north of the place; and the first
    segment of each path. A path of one position is one segment without length."""
    segments = [(path[:-1], path[1:]) if len(path) > 1 else (path, path) for path in paths]
    starts, ends = (
        _on_plane(np.concatenate(side), lat_deg, lon_deg, shrink) for side in zip(*segments, strict=True)
    )
    steps = ends - starts
    lengths_sq = np.maximum(steps[:, 0] * steps[:, 0] + steps[:, 1] * steps[:, 1], 1e-30)
    along = np.clip(-(starts[:, 0] * steps[:, 0] + starts[:, 1] * steps[:, 1]) / lengths_sq, 0.0, 1.0)
    lengths = [len(begin) for begin, _ in segments]
    return starts + along[:, None] * steps, [0, *accumulate(lengths[:-1])]


def _on_plane(lonlat: NDArray[np.float64], lat_deg: float, lon_deg: float, shrink: float) -> NDArray[np.float64]:
    """Degrees of latitude east and north of a place."""
    offsets = lonlat - (lon_deg, lat_deg)
    offsets[:, 0] = (offsets[:, 0] + 180.0) % 360.0 - 180.0
    return offsets * (shrink, 1.0)


def _wrap_lon(lon_deg: float) -> float:
    return (lon_deg + 180.0) % 360.0 - 180.0
