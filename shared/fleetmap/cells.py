"""The "cell" parts of a map package: all that a localizer needs, one part per 128 m UTM cell.

A cell holds the keyframes whose camera centre lies in it, every landmark they see, and who sees what. It stands on
its own, so a landmark seen from two cells lies in both; map-wide ids tell when cells are merged.

Maps of format 2 have them in the layout of fleetmap.compact_cells, those of format 1 in fleetmap.early_cells.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from typing import Any, TypeVar

import numpy as np

from fleetmap.cell import Cell, CellIndex, Ids, cell_attributes, corner_offset_m
from fleetmap.compact_cells import compact_arrays, read_compact_cell
from fleetmap.early_cells import read_early_cell
from fleetmap.errors import MapPackageError
from fleetmap.full_part import check_ascending
from fleetmap.geodesy import UtmAnchor
from fleetmap.manifest import CELL_SIZE_M, PartRecord
from fleetmap.parts import decode_part, encode_part
from fleetmap.visual_map import Keyframes, Landmarks, LocalizationMap, VisualMap, taken

MAX_CELL_BYTES = 128 * 1024 * 1024  # inflated; two million landmarks
_LAYOUT = 2
_READERS = {"1": read_early_cell, "2": read_compact_cell}

Group = TypeVar("Group", Keyframes, Landmarks)


def whole_map(visual_map: VisualMap) -> LocalizationMap:
    """All keyframes and landmarks, and all that was observed."""
    observations = visual_map.observations
    pairs = np.unique(observations.keyframe_index.astype(np.int64) << 32 | observations.landmark_index)
    return LocalizationMap(
        visual_map.anchor,
        visual_map.keyframes,
        visual_map.landmarks,
        (pairs >> 32).astype(np.int32),
        (pairs & 0xFFFFFFFF).astype(np.int32),
    )


def split_into_cells(content: LocalizationMap) -> dict[CellIndex, Cell]:
    """The cells that hold keyframes, in order of their index."""
    cells, cell_of_keyframe = cells_of_keyframes(content)
    cell_of_pair = cell_of_keyframe[content.seen_by_keyframe]
    by_cell = np.argsort(cell_of_pair, kind="stable")
    borders = np.searchsorted(cell_of_pair[by_cell], np.arange(1, len(cells)))
    return {
        (int(east), int(north)): _cut_out(content, np.flatnonzero(cell_of_keyframe == number), seen)
        for number, ((east, north), seen) in enumerate(zip(cells, np.split(by_cell, borders), strict=True))
    }


def cells_of_keyframes(content: VisualMap | LocalizationMap) -> tuple[Ids, Ids]:
    """The indices (C, 2) of the cells that hold keyframes, and which of them each keyframe (K,) lies in."""
    in_utm = content.anchor.utm_from_map(content.keyframes.positions_m)
    cells, cell_of_keyframe = np.unique(
        np.floor(in_utm[:, :2] / CELL_SIZE_M).astype(np.int64), axis=0, return_inverse=True
    )
    return cells, cell_of_keyframe.reshape(-1)


def encode_cell(index: CellIndex, cell: Cell, anchor: UtmAnchor) -> bytes:
    """The part of one cell of a map that passed check_visual_map.

    Raises:
        MapPackageError: the cell is too large.
    """
    arrays = compact_arrays(cell, corner_offset_m(index, anchor))
    return encode_part("cell", cell_attributes(index, anchor) | {"layout": _LAYOUT}, arrays, MAX_CELL_BYTES)


def decode_cell(data: bytes, record: PartRecord, anchor: UtmAnchor, origin: str) -> Cell:
    """The content of a cell part in the map frame of ``anchor``; ``origin`` says where the bytes came from.

    Raises:
        MapPackageError: the part is malformed, or is not the cell that the manifest's record describes.
    """
    part = decode_part(data, origin, MAX_CELL_BYTES)
    wanted = cell_attributes(record.cell, anchor) if record.cell else {}
    if part.kind != "cell" or {key: part.attributes.get(key) for key in wanted} != wanted or not record.cell:
        raise MapPackageError(
            f"{origin} is not the cell {record.cell} of EPSG:{anchor.epsg} that the manifest names"
        )
    read = _READERS.get(str(part.attributes.get("layout", 1)))
    if read is None:
        raise MapPackageError(f"{origin} has a cell layout that this fleetmap does not know; upgrade fleetmap")
    return read(part, record, corner_offset_m(record.cell, anchor))


def merge_cells(anchor: UtmAnchor, cells: Sequence[Cell]) -> LocalizationMap:
    """One map of any cells of a package; each landmark appears once, keyframes are in time order.

    Raises:
        MapPackageError: two cells claim the same keyframe, or their clocks disagree with their keyframes' order.
    """
    cells = cells or [_EMPTY_CELL]
    all_keyframe_ids = np.concatenate([cell.keyframe_ids for cell in cells])
    keyframe_ids, keyframe_rows = np.unique(all_keyframe_ids, return_index=True)
    if len(keyframe_ids) != len(all_keyframe_ids):
        raise MapPackageError("two cells of the map claim the same keyframe; build or download the map again")
    landmark_ids, landmark_rows = np.unique(
        np.concatenate([cell.landmark_ids for cell in cells]), return_index=True
    )
    seen_by_keyframe = np.concatenate([cell.keyframe_ids[cell.seen_by_keyframe] for cell in cells])
    seen_landmark = np.concatenate([cell.landmark_ids[cell.seen_landmark] for cell in cells])
    order = np.lexsort((seen_landmark, seen_by_keyframe))
    keyframes = taken(_joined([cell.keyframes for cell in cells]), keyframe_rows)
    check_ascending(keyframes.stamps_ns, "keyframe stamps", "the map merged of its cells")
    return LocalizationMap(
        anchor,
        keyframes,
        taken(_joined([cell.landmarks for cell in cells]), landmark_rows),
        np.searchsorted(keyframe_ids, seen_by_keyframe[order]).astype(np.int32),
        np.searchsorted(landmark_ids, seen_landmark[order]).astype(np.int32),
    )


def _cut_out(content: LocalizationMap, keyframe_ids: Ids, pairs: Ids) -> Cell:
    """The cell of these keyframes and of what they see, which is the ``pairs`` (m,) of the map's."""
    landmark_ids, seen_landmark = np.unique(content.seen_landmark[pairs].astype(np.int64), return_inverse=True)
    return Cell(
        keyframe_ids,
        taken(content.keyframes, keyframe_ids),
        landmark_ids,
        taken(content.landmarks, landmark_ids),
        np.searchsorted(keyframe_ids, content.seen_by_keyframe[pairs]),
        seen_landmark,
    )


def _joined(groups: Sequence[Group]) -> Group:
    """All rows; a column that one of the groups lacks is left out."""
    columns: dict[str, Any] = {}
    for field in fields(groups[0]):
        parts = [getattr(group, field.name) for group in groups]
        columns[field.name] = None if any(part is None for part in parts) else np.concatenate(parts)
    return type(groups[0])(**columns)


_NO_IDS = np.empty(0, np.int64)
_EMPTY_CELL = Cell(
    _NO_IDS,
    Keyframes(_NO_IDS, np.empty((0, 3, 3)), np.empty((0, 3))),
    _NO_IDS,
    Landmarks(
        np.empty((0, 3)),
        np.empty((0, 32), np.uint8),
        np.empty((0, 3), np.float32),
        np.empty(0, np.uint8),
        np.empty(0, np.float32),
    ),
    _NO_IDS,
    _NO_IDS,
)
