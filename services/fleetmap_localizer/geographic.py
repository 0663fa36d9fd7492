"""Poses of the grid on the globe, and in another zone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fleetmap.geodesy import UtmGrid
from fleetmap.geometry import Pose
from fleetmap.geopose import GeoPose, geo_pose
from fleetmap_localizer.pose_estimate import PoseEstimate


def geographic(pose: PoseEstimate) -> GeoPose:
    """The pose as latitude, longitude and height, its covariance to the true east, north and up."""
    return geo_pose(
        pose.epsg,
        pose.utm_from_cam,
        pose.covariance,
        map_id=pose.map_id,
        version=pose.version,
        stamp_ns=pose.stamp_ns,
    )


def position_covariance_enu_m2(place: GeoPose) -> NDArray[np.float64]:
    """(3, 3), in metres on the ground."""
    return np.array(place.accuracy.covariance).reshape(6, 6)[:3, :3]


def in_zone(pose: PoseEstimate, epsg: int) -> PoseEstimate:
    """The same pose in another UTM zone. The covariance is in the camera's frame, and stays."""
    if pose.epsg == epsg:
        return pose
    here, there = UtmGrid(pose.epsg), UtmGrid(epsg)
    lat_deg, lon_deg, height_m = here.to_geodetic(pose.utm_from_cam.translation_m)
    place = float(lat_deg), float(lon_deg)
    there_from_here = there.grid_from_enu(*place) @ here.grid_from_enu(*place).T
    moved = Pose(there_from_here @ pose.utm_from_cam.rotation, there.from_geodetic(lat_deg, lon_deg, height_m))
    return replace(pose, epsg=epsg, utm_from_cam=moved)
