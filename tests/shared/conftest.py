"""Maps with known content for the tests of what carries maps."""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from fleetmap.camera import Camera
from fleetmap.geodesy import UtmAnchor
from fleetmap.geometry import Sim3, so3_exp
from fleetmap.manifest import Provenance, Quality
from fleetmap.visual_map import Keyframes, Landmarks, Observations, VisualMap

KARLSRUHE = UtmAnchor(32632, 457_000, 5_428_000, 116)


@pytest.fixture(scope="session")
def make_map() -> Callable[..., VisualMap]:
    return street_map


@pytest.fixture(scope="session")
def quality_of() -> Callable[[VisualMap], Quality]:
    return quality_record


@pytest.fixture(scope="session")
def provenance() -> Provenance:
    return Provenance(
        drive="survey.mcap",
        drive_sha256="ab" * 32,
        fleetmap_version="0.1.0",
        settings={"gnss": "full", "keyframe_spacing_m": 1.0},
        start_ns=1_700_000_000_000_000_000,
        end_ns=1_700_000_060_000_000_000,
        created_ns=1_700_000_100_000_000_000,
    )


@pytest.fixture(scope="session")
def explode() -> Callable[[bytes], tuple[dict[str, Any], bytes]]:
    return explode_part


@pytest.fixture(scope="session")
def assemble() -> Callable[..., bytes]:
    return assemble_part


def explode_part(data: bytes) -> tuple[dict[str, Any], bytes]:
    """Header and inflated payload of a part, taken apart without the code under test."""
    major, _, length = struct.unpack_from("<HHI", data, 8)
    header = data[16 : 16 + length]
    return json.loads(zlib.decompress(header) if major > 1 else header), zlib.decompress(data[16 + length :])


def assemble_part(header: Any, payload: bytes, *, major: int = 2, minor: int = 0) -> bytes:
    """A part with whatever header and payload."""
    text = json.dumps(header).encode()
    text = zlib.compress(text) if major > 1 else text
    return struct.pack("<8sHHI", b"FMPART\r\n", major, minor, len(text)) + text + zlib.compress(payload)


def street_map(
    seed: int = 0,
    keyframes: int = 60,
    landmarks: int = 900,
    length_m: float = 400.0,
    observers: int = 6,
    anchor: UtmAnchor = KARLSRUHE,
) -> VisualMap:
    """A street towards the north-east; every landmark is seen by up to ``observers`` consecutive keyframes."""
    rng = np.random.default_rng(seed)
    along = np.linspace(0.0, length_m, keyframes)
    positions_m = np.stack([0.6 * along, 0.8 * along, 0.01 * along], axis=1) + rng.normal(0, 0.3, (keyframes, 3))
    first = np.sort(rng.integers(0, max(keyframes - observers, 0) + 1, landmarks))
    points_m = positions_m[first] + rng.normal(0.0, 15.0, (landmarks, 3))
    normals = rng.normal(0.0, 1.0, (landmarks, 3))
    pairs = np.array(
        [
            (k, n)
            for n in range(landmarks)
            for k in range(first[n], min(first[n] + rng.integers(1, observers + 1), keyframes))
        ]
    ).reshape(-1, 2)
    pairs = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]
    return VisualMap(
        anchor,
        Sim3(12.25, so3_exp(rng.normal(0.0, 1.0, 3)), rng.normal(0.0, 50.0, 3)),
        Camera(1392, 512, 959.8, 956.9, 696.0, 224.2, (-0.37, 0.2, 0.001, 0.002, -0.07)),
        Keyframes(
            1_700_000_000_000_000_000 + np.arange(keyframes, dtype=np.int64) * 100_000_001,
            so3_exp(rng.normal(0.0, 1.5, (keyframes, 3))),
            positions_m,
        ),
        Landmarks(
            points_m,
            rng.integers(0, 256, (landmarks, 32), dtype=np.uint8),
            (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32),
            rng.integers(0, 8, landmarks, dtype=np.uint8),
            rng.uniform(2.0, 80.0, landmarks).astype(np.float32),
            angles_deg=np.random.default_rng(seed + 1).uniform(0.0, 360.0, landmarks).astype(np.float32),
        ),
        Observations(
            pairs[:, 0].astype(np.int32),
            pairs[:, 1].astype(np.int32),
            rng.uniform(0.0, 512.0, (len(pairs), 2)).astype(np.float32),
            rng.integers(0, 8, len(pairs), dtype=np.uint8),
        ),
    )


def quality_record(visual_map: VisualMap) -> Quality:
    return Quality(
        keyframes=len(visual_map.keyframes),
        landmarks=len(visual_map.landmarks),
        observations=len(visual_map.observations),
        length_m=400.0,
        frames_total=600,
        frames_posed=600,
        reprojection_rms_px=0.7,
        gnss_fixes=80,
        gnss_residual_rms_m=0.05,
        gnss_mode="full",
        publishable=True,
    )
