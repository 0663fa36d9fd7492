"""All segments of a drive in one map: placed by their fixes, or by what is seen again of a placed neighbour."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import InputError
from fleetmap.geometry import Sim3
from fleetmap_mapper.georeferencing import GnssTrack, path_at_fixes
from fleetmap_mapper.placement import georeference
from fleetmap_mapper.refinding import tie_what_is_refound
from fleetmap_mapper.relative_placing import place_beside
from fleetmap_mapper.segments import join_segments
from fleetmap_mapper.settings import MapperSettings
from fleetmap_mapper.slam import Segment

_SEEN_AGAIN = 2  # keyframes: two neighbours that agree, at least


@dataclass(frozen=True)
class JoinedSegments:
    """What became of the segments of a drive."""

    segment: Segment  # all of them as one, in the map frame
    map_from_vis: Sim3  # of the first segment
    count: int
    remarks: tuple[str, ...]  # on every join, and on what had to be left out


def place_segments(segments: Sequence[Segment], track: GnssTrack, settings: MapperSettings) -> JoinedSegments:
    """Join all segments that can be placed in the map frame, and tie what is seen from more than one.

    Raises:
        DriveError: the fixes place not one segment.
    """
    placements, refusals = _placed_by_fixes(segments, track, settings)
    if not placements:
        raise refusals[min(refusals)]
    by_fixes = set(placements)
    _place_others_beside(segments, placements, settings)
    order = sorted(placements)
    joined = join_segments([segments[i] for i in order], [placements[i] for i in order])
    segment_of = np.repeat(np.arange(len(order)), [len(segments[i].growing.keyframes) for i in order])
    ties: NDArray[np.int64] = np.zeros((len(order), len(order)), np.int64)
    if settings.gnss.mode in ("final", "full"):  # otherwise no joint adjustment follows that could use them
        ties = _tie(joined, segment_of, settings)
    remarks = [
        _join_remark(segments, i, j, by_fixes, bool(ties[order.index(i), order.index(j)] >= _SEEN_AGAIN))
        for i, j in itertools.pairwise(order)
    ]
    for index in sorted(set(range(len(segments))) - set(order)):
        remarks.append(_left_out(segments[index], refusals[index]))
    return JoinedSegments(joined, placements[order[0]], len(order), tuple(remarks))


def _placed_by_fixes(
    segments: Sequence[Segment], track: GnssTrack, settings: MapperSettings
) -> tuple[dict[int, Sim3], dict[int, InputError]]:
    placements, refusals = {}, {}
    for index, segment in enumerate(segments):
        stamps_ns = np.array([p.stamp_ns for p in segment.posed], dtype=np.int64)
        path = path_at_fixes(stamps_ns, [p.vis_from_cam for p in segment.posed], track)
        try:
            placements[index] = georeference(path, track, settings.gnss.level_sigma_deg)
        except InputError as error:
            refusals[index] = error
    return placements, refusals


def _place_others_beside(
    segments: Sequence[Segment], placements: dict[int, Sim3], settings: MapperSettings
) -> None:
    """Place segments that their fixes do not determine beside placed ones, those next in time first."""
    progress = True
    while progress:
        progress = False
        for index in sorted(set(range(len(segments))) - set(placements)):
            for neighbour in sorted(placements, key=lambda n: (abs(n - index), n)):
                neighbour_from_segment = place_beside(segments[neighbour], segments[index], settings)
                if neighbour_from_segment is not None:
                    placements[index] = placements[neighbour] @ neighbour_from_segment
                    progress = True
                    break


def _tie(joined: Segment, segment_of: NDArray[np.intp], settings: MapperSettings) -> NDArray[np.int64]:
    """Keyframes (S, S) of one segment that were found to see landmarks of another; in both directions."""
    count = int(segment_of.max()) + 1
    home = segment_of[joined.growing.reference[: joined.growing.landmark_count]]
    ties = np.zeros((count, count), np.int64)
    for refound in tie_what_is_refound(joined.growing, segment_of, settings):
        own = segment_of[refound.keyframe.index]
        for other in np.unique(home[refound.landmarks]):
            ties[own, other] += 1
            ties[other, own] += own != other
    return ties


def _join_remark(
    segments: Sequence[Segment], before: int, after: int, by_fixes: set[int], is_seen_again: bool
) -> str:
    """How two segments that follow each other hold together, and how well."""
    lost_s = (segments[after].posed[0].stamp_ns - segments[before].posed[-1].stamp_ns) * 1e-9
    how = {
        (True, True): "joined by their fixes and by landmarks found again",
        (True, False): "joined by their fixes alone, no landmark was found again: weak there",
        (False, True): "joined by landmarks found again; one of them has too few fixes of its own",
        (False, False): "joined by a few landmarks found again alone, one of them has too few fixes: weak there",
    }[{before, after} <= by_fixes, is_seen_again]
    start_s = (segments[before].posed[-1].stamp_ns - segments[0].posed[0].stamp_ns) * 1e-9
    return (
        f"tracking was lost for {max(lost_s, 0.0):.1f} s, {start_s:.1f} s into the drive; the segments are {how}"
    )


def _left_out(segment: Segment, refusal: InputError) -> str:
    return f"a stretch of {len(segment.posed)} images is left out of the map: {refusal}"
