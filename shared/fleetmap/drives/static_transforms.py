"""How the frames of a recording are mounted to each other: a graph of static transforms."""

from __future__ import annotations

from collections import deque

from fleetmap.geometry import Pose


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
