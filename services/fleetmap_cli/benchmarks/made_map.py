"""Maps that are nothing but their size: to a server, parts are bytes."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from fleetmap.manifest import Manifest, make_manifest, manifest_version


@dataclass(frozen=True)
class MadeMap:
    """A manifest's bytes and its parts by their SHA-256."""

    map_id: str
    manifest_bytes: bytes
    parts: Mapping[str, bytes]

    @property
    def version(self) -> str:
        """SHA-256 of the manifest."""
        return manifest_version(self.manifest_bytes)

    @property
    def size_bytes(self) -> int:
        """Of manifest and parts."""
        return len(self.manifest_bytes) + sum(map(len, self.parts.values()))

    def part(self, sha256: str) -> bytes:
        """One part."""
        return self.parts[sha256]


def made_map(map_id: str, part_sizes: Sequence[int], seed: int = 0) -> MadeMap:
    """A map whose parts have given sizes; another seed gives other bytes."""
    contents = [
        hashlib.shake_128(f"{map_id}/{seed}/{number}".encode()).digest(size)
        for number, size in enumerate(part_sizes)
    ]
    parts = {hashlib.sha256(content).hexdigest(): content for content in contents}
    return MadeMap(map_id, _manifest(map_id, parts).to_bytes(), parts)


def _manifest(map_id: str, parts: Mapping[str, bytes]) -> Manifest:
    return make_manifest(
        {
            "map_id": map_id,
            "anchor": {"epsg": 32632, "easting_m": 456_000, "northing_m": 5_428_000, "height_m": 110},
            "map_from_vis": {"scale": 1.0, "quat_xyzw": (0, 0, 0, 1), "translation_m": (0, 0, 0)},
            "camera": {
                "width_px": 640, "height_px": 480, "fx_px": 500, "fy_px": 500, "cx_px": 320, "cy_px": 240,
                "distortion": (0, 0, 0, 0, 0),
            },
            "bbox_lonlat": (8.40, 49.00, 8.42, 49.01),
            "trajectory_lonlat": ((8.40, 49.00), (8.42, 49.01)),
            "parts": [
                {
                    "kind": "cell", "sha256": sha256, "size_bytes": len(content), "cell": (number, 0),
                    "keyframes": 1, "landmarks": 10,
                }
                for number, (sha256, content) in enumerate(parts.items())
            ],
            "quality": {
                "keyframes": len(parts), "landmarks": 10 * len(parts), "observations": 20 * len(parts),
                "length_m": 1700.0, "frames_total": 300, "frames_posed": 300, "reprojection_rms_px": 0.7,
                "gnss_fixes": 60, "gnss_residual_rms_m": 0.05, "gnss_mode": "full", "publishable": True,
                "warnings": (),
            },
            "provenance": {
                "drive": "benchmark", "fleetmap_version": "0", "settings": {}, "start_ns": 0, "end_ns": 1,
                "created_ns": 2,
            },
        },
        f"the made map '{map_id}'",
    )  # fmt: skip
