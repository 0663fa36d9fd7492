"""A small point cloud of a map, for people to look at: some of its landmarks in UTM, as a PLY file.

A landmark is taken or left by its map-wide id, so the landmarks that two cells share are taken once and the choice
is the same each time. Cells are read one after the other; no more than one of them is ever in memory.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from fleetmap.cells import decode_cell
from fleetmap.manifest import Manifest, PartRecord

MAX_PREVIEW_POINTS = 5000


def preview_ply(manifest: Manifest, read_part: Callable[[PartRecord], bytes]) -> bytes:
    """At most MAX_PREVIEW_POINTS landmarks as binary PLY: easting, northing, ellipsoidal height in metres.

    Args:
        manifest: of the map.
        read_part: gives the bytes of one of its parts.

    Raises:
        MapPackageError: a cell cannot be read.
    """
    points_m = preview_points(manifest, read_part)
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"comment map {manifest.map_id}, EPSG:{manifest.anchor.epsg}: easting, northing, ellipsoidal height in m\n"
        f"element vertex {len(points_m)}\nproperty double x\nproperty double y\nproperty double z\nend_header\n"
    )
    return header.encode("ascii") + points_m.astype("<f8").tobytes()


def preview_points(manifest: Manifest, read_part: Callable[[PartRecord], bytes]) -> NDArray[np.float64]:
    """Landmarks in UTM, (N, 3) float64, evenly out of all of them. Raises MapPackageError."""
    anchor = manifest.anchor.to_anchor()
    landmarks = manifest.quality.landmarks if manifest.localizable is None else manifest.localizable.landmarks
    every = -(-landmarks // MAX_PREVIEW_POINTS) or 1
    chosen: dict[int, NDArray[np.float64]] = {}
    for record in manifest.parts:
        if record.kind != "cell" or len(chosen) >= MAX_PREVIEW_POINTS:
            continue
        cell = decode_cell(read_part(record), record, anchor, f"cell {record.cell} of map '{manifest.map_id}'")
        rows = np.flatnonzero(cell.landmark_ids % every == 0)
        points_m = anchor.utm_from_map(cell.landmarks.points_m[rows])
        chosen |= dict(zip(cell.landmark_ids[rows].tolist(), points_m, strict=True))
    points = [chosen[landmark_id] for landmark_id in sorted(chosen)[:MAX_PREVIEW_POINTS]]
    return np.array(points, dtype=np.float64).reshape(-1, 3)
