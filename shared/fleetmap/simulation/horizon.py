"""The end of a world: a ring of far hills and roofs."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from fleetmap.simulation import textures
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
            grey, opacity = textures.paint_horizon(rng, width, height, SKY_GREY, seamless=pictures is not None)
            paints.append(builder.add_texture(grey, opacity))
        foot, top = [0.0, 0.0, foot_m], [0.0, 0.0, height + foot_m]
        corners = np.stack([near + top, far + top, far + foot, near + foot])
        builder.add_quad(corners, paints[side % len(paints)], lit=False)
