"""Poses as GeoJSON (RFC 7946): the way driven, broken where poses are missing, and a point a pose.

Coordinates are longitude, latitude, height above the ellipsoid, on WGS84.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from fleetmap.files import write_text_atomically
from fleetmap.geopose import GeoPose
from fleetmap_localizer.geographic import geographic, position_covariance_enu_m2
from fleetmap_localizer.pose_estimate import NoPose, PoseEstimate

Position = list[float]


def write_geojson(path: Path, answers: Sequence[PoseEstimate | NoPose]) -> None:
    """Write a FeatureCollection, replacing the file atomically."""
    features = [_way(answers), *(_point(each) for each in answers if isinstance(each, PoseEstimate))]
    content = {"type": "FeatureCollection", "features": [feature for feature in features if feature]}
    write_text_atomically(path, json.dumps(content, allow_nan=False, separators=(",", ":")) + "\n")


def _way(answers: Sequence[PoseEstimate | NoPose]) -> dict[str, Any] | None:
    """A line through the poses of images that follow on each other; None where no two do."""
    lines: list[list[Position]] = [[]]
    for answer in answers:
        if isinstance(answer, NoPose):
            lines.append([])
            continue
        position = _position(geographic(answer))
        if lines[-1] and abs(lines[-1][-1][0] - position[0]) > 180.0:  # RFC 7946, 3.1.9: cut at the antimeridian
            lines.append([])
        lines[-1].append(position)
    lines = [line for line in lines if len(line) > 1]
    if not lines:
        return None
    whole = len(lines) == 1
    geometry = {
        "type": "LineString" if whole else "MultiLineString",
        "coordinates": lines[0] if whole else lines,
    }
    return {"type": "Feature", "geometry": geometry, "properties": _way_properties(answers)}


def _way_properties(answers: Sequence[PoseEstimate | NoPose]) -> dict[str, Any]:
    poses = [answer for answer in answers if isinstance(answer, PoseEstimate)]
    return {
        "start": _time(poses[0].stamp_ns),
        "end": _time(poses[-1].stamp_ns),
        "images": len(answers),
        "poses": len(poses),
        "maps": [list(each) for each in dict.fromkeys((pose.map_id, pose.version) for pose in poses)],
    }


def _point(pose: PoseEstimate) -> dict[str, Any]:
    place = geographic(pose)
    east_m, north_m, up_m = np.sqrt(np.diag(position_covariance_enu_m2(place))).tolist()
    properties = {
        "time": _time(pose.stamp_ns),
        "kind": pose.kind,
        "heading_deg": round(place.heading_deg, 4),
        "sigma_east_m": round(east_m, 4),
        "sigma_north_m": round(north_m, 4),
        "sigma_up_m": round(up_m, 4),
        "epsg": pose.epsg,
        "easting_m": round(place.utm.easting_m, 4),
        "northing_m": round(place.utm.northing_m, 4),
        "map_id": pose.map_id,
        "version": pose.version,
        "inliers": pose.inlier_count,
    }
    geometry = {"type": "Point", "coordinates": _position(place)}
    return {"type": "Feature", "geometry": geometry, "properties": properties}


def _position(place: GeoPose) -> Position:
    return [round(place.position.lon, 9), round(place.position.lat, 9), round(place.position.h, 4)]


def _time(stamp_ns: int) -> str:
    """RFC 3339 to the nanosecond; JavaScript's numbers would not hold the stamp itself."""
    second, nanosecond = divmod(stamp_ns, 1_000_000_000)
    return f"{datetime.fromtimestamp(second, UTC):%Y-%m-%dT%H:%M:%S}.{nanosecond:09d}Z"
