"""A camera's pose for everybody: OGC GeoPose 1.0, Basic-Quaternion, with how exact it is and what it refers to.

Outer frame: east, north, up at the position, with true north; UTM's grid is turned against it by the convergence.
Inner frame: of the camera as a body (REP-103): x where it looks, y to its left, z up in the image. The quaternion
turns the outer frame's axes into the inner one's: it takes what is written in the inner frame into the outer one,
and is the identity for a level camera that looks east.

Source: OGC 21-056r11, "GeoPose 1.0 Data Exchange Standard"; it leaves room for members of one's own.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

from fleetmap.geodesy import UtmGrid
from fleetmap.geometry import (
    CAM_FROM_BODY,
    Pose,
    quat_xyzw_from_rotations,
    rotations_from_quat_xyzw,
)
from fleetmap.manifest import Int64, LatDeg, LonDeg, MapId, Sha256

Array = NDArray[np.float64]

_UNIT_TOLERANCE = 1e-6  # of a quaternion's length


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)


class GeoPosition(_Model):
    """A place on WGS 84; the names are GeoPose's."""

    lat: LatDeg
    lon: LonDeg
    h: float  # metres above the ellipsoid


class GeoQuaternion(_Model):
    """A unit quaternion: outer from inner frame."""

    x: float
    y: float
    z: float
    w: float

    @model_validator(mode="after")
    def _is_unit(self) -> GeoQuaternion:
        length = float(np.linalg.norm((self.x, self.y, self.z, self.w)))
        if abs(length - 1.0) > _UNIT_TOLERANCE:
            raise ValueError(f"the quaternion's length is {length:g}, not 1")
        return self


class PoseAccuracy(_Model):
    """How exact a pose is, all of it one sigma; the map's own uncertainty included where the map tells it."""

    horizontal_sigma_m: float = Field(ge=0.0)  # in the worse of the horizontal directions
    vertical_sigma_m: float = Field(ge=0.0)
    heading_sigma_deg: float = Field(ge=0.0)  # about the vertical
    tilt_sigma_deg: float = Field(ge=0.0)  # about the worse of the horizontal axes
    # Row by row, as in ROS' GeoPoseWithCovariance: east, north, up (m), turns about east, north, up (rad).
    covariance: tuple[float, ...] = Field(min_length=36, max_length=36)


class UtmPosition(_Model):
    """The same place in the map's UTM zone."""

    epsg: int
    easting_m: float
    northing_m: float
    height_m: float  # above the ellipsoid


class GeoPose(_Model):
    """Where a camera was, and how it was turned; see the module."""

    position: GeoPosition
    quaternion: GeoQuaternion
    accuracy: PoseAccuracy
    utm: UtmPosition
    map_id: MapId
    version: Sha256  # of the map
    stamp_ns: Int64 | None = None  # of the image, if whoever asked said so

    @property
    def heading_deg(self) -> float:
        """Where the camera looks, clockwise from true north, 0 to 360."""
        east, north, _ = _rotation(self.quaternion)[:, 0]
        return float(np.degrees(np.arctan2(east, north)) % 360.0)

    def utm_from_cam(self) -> Pose:
        """The pose on the grid: easting, northing, height; cam x right, y down, z forward."""
        grid_from_enu = UtmGrid(self.utm.epsg).grid_from_enu(self.position.lat, self.position.lon)
        rotation = grid_from_enu @ _rotation(self.quaternion) @ CAM_FROM_BODY.T
        return Pose(rotation, np.array([self.utm.easting_m, self.utm.northing_m, self.utm.height_m]))


def geo_pose(
    epsg: int,
    utm_from_cam: Pose,
    covariance: Array,
    *,
    map_id: str,
    version: str,
    stamp_ns: int | None = None,
) -> GeoPose:
    """The GeoPose of a camera.

    Args:
        epsg: of the UTM zone.
        utm_from_cam: easting, northing, ellipsoidal height; cam x right, y down, z forward.
        covariance: (6, 6) of the tangent [rotation (rad), translation (m)] in the camera's frame.
        map_id: the map that the pose refers to.
        version: of that map.
        stamp_ns: of the image.
    """
    grid, utm_m = UtmGrid(epsg), utm_from_cam.translation_m
    lat_deg, lon_deg, height_m = (float(value) for value in grid.to_geodetic(utm_m))
    enu_from_cam = grid.grid_from_enu(lat_deg, lon_deg).T @ utm_from_cam.rotation
    x, y, z, w = quat_xyzw_from_rotations(enu_from_cam @ CAM_FROM_BODY).tolist()
    return GeoPose(
        position=GeoPosition(lat=lat_deg, lon=lon_deg, h=height_m),
        quaternion=GeoQuaternion(x=x, y=y, z=z, w=w),
        accuracy=_accuracy(enu_from_cam, covariance, grid.point_scale_factor(lat_deg, lon_deg)),
        utm=UtmPosition(
            epsg=epsg, easting_m=float(utm_m[0]), northing_m=float(utm_m[1]), height_m=float(utm_m[2])
        ),
        map_id=map_id,
        version=version,
        stamp_ns=stamp_ns,
    )


def _accuracy(enu_from_cam: Array, covariance: Array, point_scale_factor: float) -> PoseAccuracy:
    """Both halves turned into east, north, up; horizontal metres of the grid made metres of the ground."""
    to_ground = np.diag([1.0 / point_scale_factor, 1.0 / point_scale_factor, 1.0])
    J = np.zeros((6, 6))
    J[:3, 3:], J[3:, :3] = to_ground @ enu_from_cam, enu_from_cam
    turned = J @ covariance @ J.T
    return PoseAccuracy(
        horizontal_sigma_m=_worst_sigma(turned[:2, :2]),
        vertical_sigma_m=_worst_sigma(turned[2:3, 2:3]),
        heading_sigma_deg=float(np.degrees(_worst_sigma(turned[5:, 5:]))),
        tilt_sigma_deg=float(np.degrees(_worst_sigma(turned[3:5, 3:5]))),
        covariance=tuple(turned.ravel().tolist()),
    )


def _worst_sigma(covariance: Array) -> float:
    return float(np.sqrt(max(np.linalg.eigvalsh(covariance)[-1], 0.0)))


def _rotation(quaternion: GeoQuaternion) -> Array:
    return rotations_from_quat_xyzw(np.array([quaternion.x, quaternion.y, quaternion.z, quaternion.w]))
