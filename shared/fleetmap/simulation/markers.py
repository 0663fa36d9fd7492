"""ArUco markers of known pose, on boards beside a road."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Pose
from fleetmap.simulation.canvas import GreyImage
from fleetmap.simulation.palette import Palette
from fleetmap.simulation.plot import Plot, under_roof
from fleetmap.simulation.surfaces import SurfaceBuilder, raised

Array = NDArray[np.float64]

DICTIONARY = "DICT_5X5_250"
_MODULES = 7  # of the black square's side: five of the code, and its rim
_SIDE_M, _BOARD_M = 0.56, 0.72  # the board shows a white module around the square
_MIDDLE_ABOVE_M, _BOARD_PX = 2.75, 320  # above vans
_TOWARDS_ROAD_RAD = 0.15
_MOST_MARKERS = 250


@dataclass(frozen=True)
class Marker:
    """A square ArUco marker."""

    number: int  # its id in the dictionary
    dictionary: str  # its name in cv2.aruco
    side_m: float  # outer edge of the black square
    map_from_marker: Pose  # origin in the middle, x right, y up as one looks at it, z out of the board

    @property
    def corners_in_map(self) -> Array:
        """The black square's corners (4, 3), in OpenCV's order: clockwise from the top left."""
        half = self.side_m / 2.0
        corners = np.array([[-half, half, 0.0], [half, half, 0.0], [half, -half, 0.0], [-half, -half, 0.0]])
        return self.map_from_marker.transform(corners)


def set_up_markers(builder: SurfaceBuilder, palette: Palette, plot: Plot) -> tuple[Marker, ...]:
    """Boards on poles at a plot's places; each looks back along the path and a little towards it."""
    markers, line = [], plot.path
    for number, (s, left) in enumerate(plot.marker_places[:_MOST_MARKERS]):
        light = float(under_roof(s, plot.tunnels_m))
        foot = line.at(s, left)
        heading = float(line.heading_rad(s)) + np.pi - np.sign(left) * -_TOWARDS_ROAD_RAD
        out = np.array([np.cos(heading), np.sin(heading), 0.0])
        right, up = np.array([-out[1], out[0], 0.0]), np.array([0.0, 0.0, 1.0])
        middle = raised(foot, _MIDDLE_ABOVE_M)
        pose = Pose(np.stack([right, up, out], axis=1), middle)
        markers.append(Marker(number, DICTIONARY, _SIDE_M, pose))
        board = builder.add_texture(_paint_board(number))
        half = _BOARD_M / 2.0 * np.array([[-1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, -1.0, 0.0]])
        builder.add_quad(pose.transform(half), board, lit=light == 1.0, shade=light)
        height = _MIDDLE_ABOVE_M + _BOARD_M / 2.0
        builder.add_box(foot - 0.06 * out, heading, (0.08, 0.08, height), palette.metal())
        back = half[[1, 0, 3, 2]] - [0.0, 0.0, 0.01]
        builder.add_quad(pose.transform(back), palette.metal())
    return tuple(markers)


def _paint_board(number: int) -> GreyImage:
    modules = _MODULES + 2
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, DICTIONARY))
    square = cv2.aruco.generateImageMarker(dictionary, number, _MODULES * _BOARD_PX)
    board = np.full((modules * _BOARD_PX, modules * _BOARD_PX), 255, dtype=np.uint8)
    board[_BOARD_PX:-_BOARD_PX, _BOARD_PX:-_BOARD_PX] = square
    small = cv2.resize(board, (_BOARD_PX, _BOARD_PX), interpolation=cv2.INTER_AREA)
    return np.asarray(np.rint(28.0 + small.astype(np.float32) * (185.0 / 255.0)), dtype=np.uint8)
