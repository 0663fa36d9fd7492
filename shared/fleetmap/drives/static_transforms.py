"""How the frames of a recording are mounted to each other: a graph of static transforms."""

from __future__ import annotations

import logging
from collections import deque

import numpy as np

from fleetmap.drives.mcap_file import McapFile
from fleetmap.drives.messages import TRANSFORMS
from fleetmap.drives.ros2_messages import TF_MESSAGE, ros2_name
from fleetmap.drives.topic_reading import read_values, topics_of
from fleetmap.geometry import Pose

_log = logging.getLogger(__name__)

_CONSTANT_WITHIN = 1e-4  # metres, and elements of the rotation matrix: what republishing in float32 may change


class StaticTransforms:
    """Frames and the rigid transforms between them, walked in either direction."""

    def __init__(self) -> None:
        self._neighbours: dict[str, dict[str, Pose]] = {}  # [target][source] = target_from_source

    def add(self, parent: str, child: str, parent_from_child: Pose) -> None:
        """Connect two frames; a later transform of the same two replaces the earlier one."""
        self._neighbours.setdefault(parent, {})[child] = parent_from_child
        self._neighbours.setdefault(child, {})[parent] = parent_from_child.inverse()

    def between(self, target: str, source: str) -> Pose | None:
        """``target_from_source`` along the shortest chain, or None where no chain connects the two."""
        target_from_reached = {target: Pose.identity()}
        waiting = deque([target])
        while waiting and source not in target_from_reached:
            reached = waiting.popleft()
            for neighbour, reached_from_neighbour in self._neighbours.get(reached, {}).items():
                if neighbour not in target_from_reached:
                    target_from_reached[neighbour] = target_from_reached[reached] @ reached_from_neighbour
                    waiting.append(neighbour)
        return target_from_reached.get(source)

    def __len__(self) -> int:
        return sum(len(neighbours) for neighbours in self._neighbours.values()) // 2


def read_static_transforms(mcap: McapFile) -> StaticTransforms:
    """All mountings of a recording: ROS' /tf_static, and of Foxglove's transforms those that stay what they are.

    Raises:
        DriveError: a message that is no rigid transform.
    """
    mountings = StaticTransforms()
    constant: dict[tuple[str, str], Pose] = {}
    moving: set[tuple[str, str]] = set()
    for topic in topics_of(mcap, TRANSFORMS):
        if ros2_name(mcap.topics[topic].message_type) == TF_MESSAGE:
            if topic.rpartition("/")[2] == "tf_static":
                for found in read_values(mcap, TRANSFORMS, topic):
                    mountings.add(found.parent, found.child, found.parent_from_child)
            continue
        for found in read_values(mcap, TRANSFORMS, topic):
            frames = found.parent, found.child
            if not _is_same(constant.setdefault(frames, found.parent_from_child), found.parent_from_child):
                moving.add(frames)
    for frames, parent_from_child in constant.items():
        if frames not in moving:
            mountings.add(*frames, parent_from_child)
    for parent, child in sorted(moving):
        _log.info("%s: '%s' moves in '%s'; that is no mounting", mcap.path.name, child, parent)
    return mountings


def _is_same(first: Pose, second: Pose) -> bool:
    shift = np.abs(first.translation_m - second.translation_m).max()
    turn = np.abs(first.rotation - second.rotation).max()
    return bool(max(shift, turn) <= _CONSTANT_WITHIN)
