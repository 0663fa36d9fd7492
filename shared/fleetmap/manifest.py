"""``manifest.json``: what a map package holds, where it lies and how good it is.

The manifest names its parts by SHA-256; the map's version is the SHA-256 of the manifest's bytes, so one
hash vouches for everything. Fields of a newer minor version are kept out of the way, a newer major version
is refused.
"""

from __future__ import annotations

import hashlib
import json
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, StringConstraints, ValidationError

from fleetmap.errors import MapPackageError

FORMAT_NAME = "fleetmap-map"
FORMAT_MAJOR, FORMAT_MINOR = 1, 0
CELL_SIZE_M = 128
MAX_MANIFEST_BYTES = 16 * 1024 * 1024
MAX_PART_BYTES = 512 * 1024 * 1024
MAX_PARTS = 100_000
MAP_ID_PATTERN = r"^[a-z0-9][a-z0-9_-]{0,63}$"

Sha256 = Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{64}$")]
MapId = Annotated[str, StringConstraints(pattern=MAP_ID_PATTERN)]


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)


class Format(_Model):
    """Name and version of the package format."""

    name: Literal["fleetmap-map"] = "fleetmap-map"
    major: int = Field(default=FORMAT_MAJOR, ge=1)
    minor: int = Field(default=FORMAT_MINOR, ge=0)


class AnchorRecord(_Model):
    """The map frame's origin; see fleetmap.geodesy.UtmAnchor."""

    epsg: int
    easting_m: int
    northing_m: int
    height_m: int


class Sim3Record(_Model):
    """A similarity transform; rotation as quaternion x, y, z, w."""

    scale: float = Field(gt=0.0)
    quat_xyzw: tuple[float, float, float, float]
    translation_m: tuple[float, float, float]


class CameraRecord(_Model):
    """See fleetmap.camera.Camera."""

    width_px: int = Field(gt=0, le=20_000)
    height_px: int = Field(gt=0, le=20_000)
    fx_px: float = Field(gt=0.0)
    fy_px: float = Field(gt=0.0)
    cx_px: float
    cy_px: float
    distortion: tuple[float, float, float, float, float]


class PartRecord(_Model):
    """One content-addressed binary part; a cell part also names its 128 m UTM cell."""

    kind: Literal["cell", "full"]
    sha256: Sha256
    size_bytes: int = Field(gt=0, le=MAX_PART_BYTES)
    cell: tuple[int, int] | None = None  # floor(easting / 128), floor(northing / 128)
    keyframes: int = Field(ge=0)
    landmarks: int = Field(ge=0)


class Quality(_Model):
    """What the mapper knows about how good its map is."""

    keyframes: int
    landmarks: int
    observations: int
    length_m: float
    frames_total: int
    frames_posed: int
    reprojection_rms_px: float
    gnss_fixes: int
    gnss_residual_rms_m: float | None
    gnss_mode: Literal["none", "final", "full"]
    publishable: bool
    warnings: tuple[str, ...] = ()


class Provenance(_Model):
    """Where the map comes from."""

    drive: str
    drive_sha256: Sha256 | None = None
    fleetmap_version: str
    settings: dict[str, Any]
    start_ns: int
    end_ns: int
    created_ns: int


class Manifest(_Model):
    """The whole of ``manifest.json``."""

    format: Format = Format()
    map_id: MapId
    anchor: AnchorRecord
    map_from_vis: Sim3Record
    camera: CameraRecord
    bbox_lonlat: tuple[float, float, float, float]  # west, south, east, north of the keyframes, degrees
    trajectory_lonlat: tuple[tuple[float, float], ...]  # thinned keyframe positions, for the catalogue
    parts: tuple[PartRecord, ...] = Field(min_length=1, max_length=MAX_PARTS)
    quality: Quality
    provenance: Provenance

    def to_bytes(self) -> bytes:
        """Canonical JSON: sorted keys, UTF-8, indented, newline at the end."""
        return (json.dumps(self.model_dump(mode="json"), sort_keys=True, indent=1) + "\n").encode()


def manifest_version(data: bytes) -> str:
    """The version of the map whose manifest these bytes are: their SHA-256 in hex."""
    return hashlib.sha256(data).hexdigest()


def parse_manifest(data: bytes, origin: str) -> Manifest:
    """Read and check a manifest; ``origin`` says in messages where it came from.

    Raises:
        MapPackageError: too large, no JSON, a newer major version, or fields that do not hold.
    """
    if len(data) > MAX_MANIFEST_BYTES:
        raise MapPackageError(f"manifest of {origin} is larger than {MAX_MANIFEST_BYTES} bytes")
    try:
        document = json.loads(data)
    except (UnicodeDecodeError, ValueError, RecursionError) as error:
        raise MapPackageError(f"manifest of {origin} is not JSON: {error}") from error
    _check_format(document, origin)
    try:
        return Manifest.model_validate(document)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(step) for step in first["loc"])
        raise MapPackageError(f"manifest of {origin} does not hold at '{place}': {first['msg']}") from error


def _check_format(document: object, origin: str) -> None:
    """Say 'newer version' before any complaint about fields that a newer version may have changed."""
    named = document.get("format") if isinstance(document, dict) else None
    if not isinstance(named, dict) or named.get("name") != FORMAT_NAME:
        raise MapPackageError(f"{origin} is not a fleetmap map: its manifest does not name '{FORMAT_NAME}'")
    if named.get("major") != FORMAT_MAJOR:
        raise MapPackageError(
            f"{origin} has map format {named.get('major')}, this fleetmap reads {FORMAT_MAJOR}; upgrade fleetmap"
        )
