"""The end of a world: a ring of far hills and roofs."""

from __future__ import annotations

import itertools

import cv2
import numpy as np
from numpy.typing import NDArray

from fleetmap.simulation.canvas import Canvas, GreyImage, fractal_noise
from fleetmap.simulation.shading import SKY_GREY
from fleetmap.simulation.surfaces import SurfaceBuilder

Array = NDArray[np.float64]

_SIDES = 16


def raise_horizon(
    rng: np.random.Generator,
    builder: SurfaceBuilder,
    centre: Array,
    radius_m: float,
    foot_m: float = -5.0,
    pictures: int | None = None,
) -> None:
    """Stand 16 pictures around a centre (3,), ``foot_m`` above it; they repeat after ``pictures``, if given."""
    angles = np.linspace(0.0, 2.0 * np.pi, _SIDES + 1)
    ring = centre + radius_m * np.stack([np.cos(angles), np.sin(angles), 0.0 * angles], axis=1)
    width, height = 2.0 * radius_m * np.sin(np.pi / _SIDES), 80.0 * radius_m / 220.0
    paints: list[int] = []
    for side, (far, near) in enumerate(itertools.pairwise(ring)):  # from inside, counter-clockwise is leftwards
        if pictures is None or side < pictures:
            grey, opacity = _paint(rng, width, height, seamless=pictures is not None)
            paints.append(builder.add_texture(grey, opacity))
        foot, top = [0.0, 0.0, foot_m], [0.0, 0.0, height + foot_m]
        corners = np.stack([near + top, far + top, far + foot, near + foot])
        builder.add_quad(corners, paints[side % len(paints)], lit=False)


def _paint(
    rng: np.random.Generator, width_m: float, height_m: float, *, seamless: bool = False
) -> tuple[GreyImage, GreyImage]:
    """Far roofs, trees and hills, and their opacity (H, W): the sky above them is the world's own.

    400 rows, however far and high they are; the top row is sky. ``seamless``: every ridge meets that of any other
    picture beside it.
    """
    scene = Canvas(rng, width_m, height_m, 400.0 / height_m, SKY_GREY)
    rows, columns = scene.grey.shape
    x = np.arange(columns)
    solid = np.zeros((rows, columns), dtype=bool)
    for layer, (top, grey) in enumerate(((0.32, 190.0), (0.25, 160.0), (0.19, 115.0))):
        ridge = fractal_noise(rng, (64, columns), columns / 2.0, 0.4 + 0.08 * layer)[32]
        if seamless:
            ridge = ridge * np.minimum(np.minimum(x, x[::-1]) / (0.15 * columns), 1.0)
        heights = np.clip(rows * (top + 0.05 * ridge), 4, 0.9 * rows)
        if layer == 2:  # houses: steps instead of hills
            heights = np.repeat(heights[::40], 40)[:columns]
        below = np.arange(rows)[:, None] >= rows - heights[x]
        texture = grey + (6.0 + 11.0 * layer) * fractal_noise(rng, (rows, columns), 32.0, 0.9)
        scene.grey[below] = texture[below]
        solid |= below
    softened = np.asarray(cv2.GaussianBlur(scene.finish(), (0, 0), 0.8), dtype=np.uint8)
    return softened, np.asarray(solid, dtype=np.uint8) * np.uint8(255)
