"""What is said when somebody has an image and asks where it was taken: the question, and the answer."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, StringConstraints, model_validator

from fleetmap.geopose import GeoPose
from fleetmap.manifest import Int64, LatDeg, LonDeg

MAX_IMAGE_BYTES = 7 * 1024 * 1024  # of a JPEG or PNG, in one message
MAX_CAMERA_BYTES = 16 * 1024

CameraText = Annotated[str, StringConstraints(min_length=1, max_length=MAX_CAMERA_BYTES)]


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)


class LocalizeRequest(_Model):
    """By which camera the image was taken, and what is known already."""

    camera: CameraText  # the content of a calibration file, see fleetmap.camera_file
    lat_deg: LatDeg | None = None  # off by 300 m at most: only what was mapped around here is looked into
    lon_deg: LonDeg | None = None
    stamp_ns: Int64 | None = None  # comes back in the answer

    @model_validator(mode="after")
    def _fits_together(self) -> LocalizeRequest:
        if (self.lat_deg is None) != (self.lon_deg is None):
            raise ValueError("lat_deg and lon_deg go together")
        return self

    @property
    def near_lat_lon_deg(self) -> tuple[float, float] | None:
        """Roughly where the image was taken, if that is known."""
        return None if self.lat_deg is None or self.lon_deg is None else (self.lat_deg, self.lon_deg)


class Localized(_Model):
    """A pose, or why there is none: one of the two."""

    pose: GeoPose | None = None
    reason: str | None = None  # for people

    @model_validator(mode="after")
    def _is_one_of_the_two(self) -> Localized:
        if (self.pose is None) == (self.reason is None):
            raise ValueError("there is either a pose or a reason why there is none")
        return self
