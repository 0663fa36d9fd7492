"""The JSON schema of what this server's items hold beyond STAC's core."""

from __future__ import annotations

from typing import Any

_NUMBER = {"type": "number"}
_COUNT = {"type": "integer", "minimum": 0}
_TEXT = {"type": "string"}
_SHA256 = {"type": "string", "pattern": "^[0-9a-f]{64}$"}

_PROPERTIES: dict[str, Any] = {
    "version": _SHA256,
    "deprecated": {"type": "boolean"},
    "proj:code": {"type": "string", "pattern": "^EPSG:32[67][0-9]{2}$"},
    "fleetmap:number": {"type": "integer", "minimum": 1},
    "fleetmap:origin": {"enum": ["published", "rollback"]},
    "fleetmap:keyframes": _COUNT,
    "fleetmap:landmarks": _COUNT,
    "fleetmap:length_m": _NUMBER,
    "fleetmap:size_bytes": {"type": "integer", "minimum": 1},
    "fleetmap:publishable": {"type": "boolean"},
    "fleetmap:gnss_mode": _TEXT,
    "fleetmap:gnss_residual_rms_m": _NUMBER,
    "fleetmap:reprojection_rms_px": _NUMBER,
    "fleetmap:position_sigma_m": _NUMBER,
    "fleetmap:position_sigma_p95_m": _NUMBER,
    "fleetmap:height_sigma_m": _NUMBER,
    "fleetmap:landmarks_per_m": _NUMBER,
    "fleetmap:weak_length_m": _NUMBER,
    "fleetmap:frames_total": _COUNT,
    "fleetmap:frames_posed": _COUNT,
    "fleetmap:segments": _COUNT,
    "fleetmap:drive": _TEXT,
    "fleetmap:drive_sha256": _SHA256,
    "fleetmap:warnings": {"type": "array", "items": _TEXT},
    "fleetmap:state": {"enum": ["received", "checked"]},
    "fleetmap:verdict": _TEXT,
    "fleetmap:reasons": _TEXT,
    "fleetmap:findings": {"type": "array", "items": {"type": "object"}},
    "fleetmap:image_count": _COUNT,
    "fleetmap:image_rate_hz": _NUMBER,
    "fleetmap:camera_width_px": _COUNT,
    "fleetmap:camera_height_px": _COUNT,
}
_NEEDED = {
    "maps": ["version", "deprecated", "proj:code", "fleetmap:number", "fleetmap:size_bytes"],
    "drives": ["fleetmap:size_bytes", "fleetmap:state"],
}
_ASSET = {
    "type": "object",
    "properties": {
        "file:size": {"type": "integer", "minimum": 1},
        "file:checksum": {"type": "string", "pattern": "^1220[0-9a-f]{64}$"},
    },
    "patternProperties": {"^file:(?!size$|checksum$)": False},
}


def extension_schema(address: str) -> dict[str, Any]:
    """The schema, which says of itself that it is at ``address``."""
    return {
        "$schema": "http://json-schema.org/draft-07/schema#",
        "$id": address,
        "title": "Maps and survey drives of fleetmap",
        "description": "Of the STAC extensions version, projection and file what is used, and fields of its own",
        "type": "object",
        "properties": {
            "properties": {
                "type": "object",
                "properties": _PROPERTIES,
                "patternProperties": {f"^fleetmap:(?!({_own_fields()})$)": False},
            },
            "assets": {"type": "object", "additionalProperties": _ASSET},
        },
        "oneOf": [
            {"properties": {"collection": {"const": name}, "properties": {"required": needed}}}
            for name, needed in _NEEDED.items()
        ],
    }


def _own_fields() -> str:
    return "|".join(name.removeprefix("fleetmap:") for name in _PROPERTIES if name.startswith("fleetmap:"))
