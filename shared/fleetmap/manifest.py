"""``manifest.json``: what a map package holds, where it lies and how good it is.

The manifest names its parts by SHA-256; the map's version is the SHA-256 of the manifest's bytes, so one
hash vouches for everything. Fields of a newer minor version are kept out of the way, a newer major version
is refused.

Format 2 has lean cells that readers of format 1 cannot read (see fleetmap.cells), and they may hold fewer
keyframes and landmarks than the map. Maps of format 1 are read as ever.
"""

from __future__ import annotations

import hashlib
import json
import re
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    StringConstraints,
    ValidationError,
    model_validator,
)

from fleetmap.camera import Camera
from fleetmap.distortion import DistortionModel
from fleetmap.errors import CalibrationError, MapPackageError
from fleetmap.geodesy import UtmAnchor
from fleetmap.geometry import Sim3, rotations_from_quat_xyzw

FORMAT_NAME = "fleetmap-map"
FORMAT_MAJOR, FORMAT_MINOR = 2, 1
OLDEST_MAJOR = 1  # still read
CELL_SIZE_M = 128
MAX_MANIFEST_BYTES = 16 * 1024 * 1024
MAX_PART_BYTES = 512 * 1024 * 1024
MAX_PARTS = 100_000
MAP_ID_PATTERN = r"^[a-z0-9][a-z0-9_-]{0,63}$"
MAX_INDEX = 2**31 - 1  # keyframes and landmarks are counted in int32

Sha256 = Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{64}$")]
PartKind = Annotated[str, StringConstraints(pattern=r"^[a-z][a-z0-9_]{0,31}$")]
MapId = Annotated[str, StringConstraints(pattern=MAP_ID_PATTERN)]
Int64 = Annotated[int, Field(ge=-(2**63), le=2**63 - 1)]
Total = Annotated[int, Field(ge=0, le=2**63 - 1)]
Metres = Annotated[int, Field(ge=-100_000_000, le=100_000_000)]
CellNumber = Annotated[int, Field(ge=-1_000_000, le=1_000_000)]
LonDeg = Annotated[float, Field(ge=-180.0, le=180.0)]
LatDeg = Annotated[float, Field(ge=-90.0, le=90.0)]


def _utm_zone(epsg: int) -> int:
    if not (32601 <= epsg <= 32660 or 32701 <= epsg <= 32760):
        raise ValueError("no UTM zone on WGS84 (326xx north, 327xx south)")
    return epsg


def _unit_quaternion(quat_xyzw: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    if abs(sum(q * q for q in quat_xyzw) - 1.0) > 1e-6:
        raise ValueError("no unit quaternion")
    return quat_xyzw


def _plain_json(settings: dict[str, Any]) -> dict[str, Any]:
    try:
        json.dumps(settings, allow_nan=False, ensure_ascii=False).encode()
    except (TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"not plain JSON: {error}") from error
    return settings


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)


class Format(_Model):
    """Name and version of the package format."""

    name: Literal["fleetmap-map"] = "fleetmap-map"
    major: int = Field(default=FORMAT_MAJOR, ge=1)
    minor: int = Field(default=FORMAT_MINOR, ge=0)


class AnchorRecord(_Model):
    """The map frame's origin; see fleetmap.geodesy.UtmAnchor."""

    epsg: Annotated[int, AfterValidator(_utm_zone)]
    easting_m: Metres
    northing_m: Metres
    height_m: Annotated[int, Field(ge=-100_000, le=100_000)]

    def to_anchor(self) -> UtmAnchor:
        """The anchor of the record."""
        return UtmAnchor(self.epsg, self.easting_m, self.northing_m, self.height_m)


class Sim3Record(_Model):
    """A similarity transform; rotation as quaternion x, y, z, w."""

    scale: float = Field(gt=0.0)
    quat_xyzw: Annotated[tuple[float, float, float, float], AfterValidator(_unit_quaternion)]
    translation_m: tuple[float, float, float]

    def to_sim3(self) -> Sim3:
        """The similarity of the record, equal to the original to about 1e-15."""
        return Sim3(self.scale, rotations_from_quat_xyzw(np.array(self.quat_xyzw)), np.array(self.translation_m))


class CameraRecord(_Model):
    """See fleetmap.camera.Camera."""

    width_px: int = Field(gt=0, le=20_000)
    height_px: int = Field(gt=0, le=20_000)
    fx_px: float = Field(gt=0.0)
    fy_px: float = Field(gt=0.0)
    cx_px: float
    cy_px: float
    distortion: tuple[float, ...] = Field(max_length=16)
    distortion_model: DistortionModel = "plumb_bob"

    @model_validator(mode="after")
    def _is_a_camera(self) -> CameraRecord:
        try:
            self.to_camera()
        except CalibrationError as error:
            raise ValueError(str(error)) from error
        return self

    def to_camera(self) -> Camera:
        """The camera of the record."""
        return Camera(**dict(self))


class CalibrationRecord(_Model):
    """The camera's calibration as the recording has it, and as the drive itself would have it."""

    recorded: CameraRecord
    fitted: CameraRecord
    focal_sigma_px: float = Field(ge=0.0)  # one sigma each, of the fitted
    centre_sigma_px: tuple[float, float]
    distortion_sigma: tuple[float, ...] = Field(max_length=16)
    refined: bool  # whether the map was made with the fitted one


class PartRecord(_Model):
    """One content-addressed binary part; a cell part also names its 128 m UTM cell.

    Kinds of part that a newer minor version brings are carried and hashed, but not read.
    """

    kind: PartKind  # "cell", "full", "quality"
    sha256: Sha256
    size_bytes: int = Field(gt=0, le=MAX_PART_BYTES)
    cell: tuple[CellNumber, CellNumber] | None = None  # floor(easting / 128), floor(northing / 128)
    keyframes: int = Field(ge=0, le=MAX_INDEX)
    landmarks: int = Field(ge=0, le=MAX_INDEX)

    @model_validator(mode="after")
    def _cell_parts_name_their_cell(self) -> PartRecord:
        if (self.kind == "cell") != (self.cell is not None):
            raise ValueError("a part names a cell if, and only if, it is a cell part")
        return self


class WeakReason(_Model):
    """One thing that makes a stretch weak, at its worst there."""

    kind: PartKind  # as fleetmap_mapper.weak_stretches names it: "position", "landmarks", ...
    worst: float
    limit: float
    text: str  # both with their units, for people


class WeakStretch(_Model):
    """A stretch of the road on which the map is not to be trusted like elsewhere."""

    from_m: float = Field(ge=0.0)  # way driven since the first posed image
    to_m: float = Field(ge=0.0)
    start_ns: Int64
    end_ns: Int64
    start_lonlat: tuple[LonDeg, LatDeg]
    end_lonlat: tuple[LonDeg, LatDeg]
    reasons: tuple[WeakReason, ...] = Field(min_length=1, max_length=64)


class Quality(_Model):
    """What the mapper knows about how good its map is; None stands for what was not measured.

    What changes along the road lies in the quality part: fleetmap.road_quality.
    """

    keyframes: Total
    landmarks: Total
    observations: Total
    length_m: float
    frames_total: Total
    frames_posed: Total
    reprojection_rms_px: float
    gnss_fixes: Total
    gnss_residual_rms_m: float | None
    gnss_mode: Literal["none", "mapping", "final", "full"]
    publishable: bool
    warnings: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()  # worth knowing, but no reason not to publish
    segments: Total = 1  # stretches of the drive between losses of tracking
    calibration: CalibrationRecord | None = None
    position_sigma_m: float | None = None  # horizontal, worst direction; median of the keyframes
    position_sigma_p95_m: float | None = None  # 95 % of the keyframes are better
    height_sigma_m: float | None = None  # median of the keyframes
    gnss_residual_sigmas: float | None = None  # median of the fixes
    gnss_sigma_m: float | None = None  # horizontal, as the receiver states it; median of the fixes
    gnss_fixes_rejected: Total = 0  # far off though they claimed to be good
    clock_offset_s: float | None = None  # the camera's stamps minus the receiver's, as estimated from the drive
    clock_offset_sigma_s: float | None = None
    clock_offset_removed: bool = False
    landmarks_per_m: float | None = None
    weak_length_m: float | None = None
    weak_stretches: tuple[WeakStretch, ...] = Field(default=(), max_length=MAX_PARTS)


class Provenance(_Model):
    """Where the map comes from."""

    drive: str
    drive_sha256: Sha256 | None = None
    fleetmap_version: str
    settings: Annotated[dict[str, Any], AfterValidator(_plain_json)]
    start_ns: Int64
    end_ns: Int64
    created_ns: Int64


class Localizable(_Model):
    """What all cells together hold of the map."""

    keyframes: Total
    landmarks: Total
    size_bytes: Total  # of the cell parts; a landmark seen from two cells counts in both


class Manifest(_Model):
    """The whole of ``manifest.json``."""

    format: Format = Format()
    map_id: MapId
    anchor: AnchorRecord
    map_from_vis: Sim3Record
    camera: CameraRecord
    bbox_lonlat: tuple[LonDeg, LatDeg, LonDeg, LatDeg]  # west, south, east, north of the keyframes, degrees
    trajectory_lonlat: tuple[tuple[LonDeg, LatDeg], ...]  # thinned keyframe positions, for the catalogue
    parts: tuple[PartRecord, ...] = Field(min_length=1, max_length=MAX_PARTS)
    quality: Quality
    provenance: Provenance
    localizable: Localizable | None = None  # since format 2; cells of format 1 hold all of the map

    @model_validator(mode="after")
    def _parts_are_distinct(self) -> Manifest:
        cells = [part.cell for part in self.parts if part.kind == "cell"]
        if len({part.sha256 for part in self.parts}) != len(self.parts) or len(set(cells)) != len(cells):
            raise ValueError("a part or a cell is listed twice")
        for kind in ("full", "quality"):
            if sum(part.kind == kind for part in self.parts) > 1:
                raise ValueError(f"there is more than one {kind} part")
        return self

    def to_bytes(self) -> bytes:
        """Canonical JSON: sorted keys, UTF-8, indented, newline at the end."""
        return (
            json.dumps(self.model_dump(mode="json"), sort_keys=True, indent=1, allow_nan=False) + "\n"
        ).encode()


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
        document = json.loads(data, parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as error:
        raise MapPackageError(f"manifest of {origin} is not JSON: {error}") from error
    _check_format(document, origin)
    return make_manifest(document, origin)


def check_map_id(map_id: str) -> None:
    """Refuse a name that cannot be a map's id, before the work of mapping is done.

    Raises:
        MapPackageError: not 1 to 64 lower-case letters, digits, ``-`` and ``_``, or it begins with ``-`` or ``_``.
    """
    if not re.fullmatch(MAP_ID_PATTERN, map_id) or map_id.endswith("\n"):
        raise MapPackageError(
            f"{map_id[:80]!r} cannot be a map id; take 1 to 64 of a-z, 0-9, '-' and '_', a letter or digit first"
        )


def make_manifest(fields: object, origin: str) -> Manifest:
    """A manifest of its fields; ``origin`` says in messages which map it is about.

    Raises:
        MapPackageError: a field does not hold.
    """
    try:
        return Manifest.model_validate(fields)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(step) for step in first["loc"])
        raise MapPackageError(f"manifest of {origin} does not hold at '{place}': {first['msg']}") from error


def _refuse_constant(name: str) -> None:
    raise ValueError(f"{name} is no JSON number")


def _check_format(document: object, origin: str) -> None:
    """Say 'newer version' before any complaint about fields that a newer version may have changed."""
    named = document.get("format") if isinstance(document, dict) else None
    if not isinstance(named, dict) or named.get("name") != FORMAT_NAME:
        raise MapPackageError(f"{origin} is not a fleetmap map: its manifest does not name '{FORMAT_NAME}'")
    major = named.get("major")
    if not isinstance(major, int) or major < 1:
        raise MapPackageError(f"manifest of {origin} does not hold at 'format.major': it must be a whole number")
    if not OLDEST_MAJOR <= major <= FORMAT_MAJOR:
        raise MapPackageError(
            f"{origin} has map format {str(major)[:20]}, this fleetmap reads {OLDEST_MAJOR} to {FORMAT_MAJOR}; "
            "upgrade fleetmap"
        )
