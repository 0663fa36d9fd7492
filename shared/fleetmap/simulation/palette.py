"""Who paints what: every wall anew, or walls from a pool that is painted when first asked for.

A street of a hundred metres can have each wall painted for itself; kilometres cannot, as textures are what takes
memory and time. A pool has enough of each kind for no two places to look alike.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from typing import Protocol

import cv2
import numpy as np

from fleetmap.simulation import textures
from fleetmap.simulation.canvas import GreyImage
from fleetmap.simulation.surfaces import SurfaceBuilder
from fleetmap.simulation.vehicles import CarPaint, paint_car, paint_van

Rng = np.random.Generator

STOREY_M = 2.9
_CRISPNESS, _DETAIL_PX = 1.0, 4.0
_REPAINTED = 0.75  # share of all picks that differ between variants of a world


class WallPaint(Protocol):
    """Paints, or finds, the textures of a house; each method gives a texture's number."""

    def facade(self, rng: Rng, width_m: float, height_m: float) -> int:
        """A front with windows and a door."""

    def side(self, rng: Rng, width_m: float, height_m: float) -> int:
        """A fire wall."""

    def roof(self, rng: Rng, width_m: float, height_m: float) -> int:
        """Tiles."""

    def plain(self, rng: Rng, width_m: float, height_m: float, grey: float, grain: float) -> int:
        """Concrete, brick or metal."""

    def foliage(self, rng: Rng, width_m: float, height_m: float) -> int:
        """A hedge."""


class TerracePaint(WallPaint, Protocol):
    """Paints also houses that look alike."""

    def alike(self, rng: Rng) -> int:
        """A front that differs from the others in details only."""


class FreshPaint:
    """Paints each wall anew."""

    def __init__(self, builder: SurfaceBuilder) -> None:
        self._builder = builder

    def facade(self, rng: Rng, width_m: float, height_m: float) -> int:
        """A front with windows and a door."""
        return self._builder.add_texture(textures.paint_facade(rng, width_m, height_m))

    def side(self, rng: Rng, width_m: float, height_m: float) -> int:
        """A fire wall."""
        return self._builder.add_texture(textures.paint_side(rng, width_m, height_m))

    def roof(self, rng: Rng, width_m: float, height_m: float) -> int:
        """Tiles."""
        return self._builder.add_texture(textures.paint_roof(rng, width_m, height_m))

    def plain(self, rng: Rng, width_m: float, height_m: float, grey: float, grain: float) -> int:
        """Concrete, brick or metal."""
        return self._builder.add_texture(textures.paint_plain(rng, width_m, height_m, grey, grain))

    def foliage(self, rng: Rng, width_m: float, height_m: float) -> int:
        """A hedge."""
        return self._builder.add_texture(textures.paint_foliage(rng, width_m, height_m))


class Palette:
    """A pool of textures, the same for the same seed whatever order they are asked for in.

    ``richness`` is how many of each kind there are, as a factor. In a ``variant`` other than 0, three
    quarters of all that is picked are painted otherwise; which, its number says. Trees have other crowns.
    """

    def __init__(self, seed: int, builder: SurfaceBuilder, richness: float = 1.0, variant: int = 0) -> None:
        self._seed, self._builder, self._richness, self._variant = seed, builder, richness, variant
        self._variant_rng = np.random.default_rng([seed, variant])
        self._painted: dict[tuple[str, int], int] = {}
        self._cars: dict[int, CarPaint] = {}

    def pick(self, rng: Rng, kind: str, count: int, paint: Callable[[Rng], GreyImage]) -> int:
        """One of ``count`` textures of a kind, painted now if it was never asked for."""
        available = max(round(count * self._richness), 1)
        number = int(rng.integers(available))
        if self._variant and self._variant_rng.random() < _REPAINTED:
            number += available * self._variant
        return self.numbered(kind, number, paint)

    def numbered(self, kind: str, number: int, paint: Callable[[Rng], GreyImage]) -> int:
        """A certain texture of a kind."""
        key = (kind, number)
        if key not in self._painted:
            self._painted[key] = self._builder.add_texture(_crisp(paint(self._rng(kind, number))))
        return self._painted[key]

    def facade(self, rng: Rng, width_m: float, height_m: float) -> int:
        """A front with windows and a door, of about this size."""
        storeys, width = max(round(height_m / STOREY_M - 0.35), 1), 3.0 * round(width_m / 3.0)
        height = storeys * STOREY_M + 1.0
        return self.pick(
            rng, f"facade {storeys} {width}", 5, lambda own: textures.paint_facade(own, width, height)
        )

    def alike(self, rng: Rng) -> int:
        """A front that differs from the others in details only: curtains, a name, what hangs on the wall."""
        return self.pick(
            rng,
            "alike",
            6,
            lambda own: textures.paint_alike(self._rng("all alike", 0), own, 9.0, 2.0 * STOREY_M + 0.6),
        )

    def side(self, rng: Rng, width_m: float, height_m: float) -> int:
        """A fire wall of about this size."""
        storeys, width = max(round(height_m / STOREY_M), 1), 4.0 * max(round(width_m / 4.0), 1)
        height = storeys * STOREY_M
        return self.pick(rng, f"side {storeys} {width}", 3, lambda own: textures.paint_side(own, width, height))

    def roof(self, rng: Rng, width_m: float, height_m: float) -> int:
        """Tiles."""
        width, height = 4.0 * max(round(width_m / 4.0), 1), 2.0 * max(round(height_m / 2.0), 1)
        return self.pick(rng, f"roof {width} {height}", 3, lambda own: textures.paint_roof(own, width, height))

    def plain(self, rng: Rng, width_m: float, height_m: float, grey: float, grain: float) -> int:
        """Concrete, brick or metal, of about this grey."""
        shade = 30.0 * max(round(grey / 30.0), 1)
        kind = f"plain {shade} {width_m:.1f} {height_m:.1f}"
        return self.pick(rng, kind, 1, lambda own: textures.paint_plain(own, width_m, height_m, shade, grain))

    def foliage(self, rng: Rng, width_m: float, height_m: float) -> int:
        """A hedge."""
        height = 0.5 * max(round(height_m / 0.5), 1)
        return self.pick(rng, f"hedge {height}", 3, lambda own: textures.paint_foliage(own, width_m, height))

    def crowns(self) -> list[int]:
        """Leafy outlines of trees."""
        count = max(round(8 * self._richness), 3)
        return [self._crown(count * self._variant + number) for number in range(count)]

    def bark(self) -> int:
        """Trunks."""
        return self.numbered("bark", 0, lambda own: textures.paint_plain(own, 0.4, 2.6, 70.0, 16.0))

    def metal(self) -> int:
        """Poles."""
        return self.numbered("metal", 0, lambda own: textures.paint_plain(own, 0.2, 6.0, 130.0, 14.0))

    def signs(self) -> list[int]:
        """Traffic signs."""
        return [self.numbered("sign", i, lambda own: textures.paint_sign(own, 0.7, 0.7)) for i in range(12)]

    def boxes(self) -> list[int]:
        """Junction boxes, bins."""
        return [self.numbered("box", i, lambda own: textures.paint_sign(own, 1.1, 1.1)) for i in range(6)]

    def car(self, number: int) -> CarPaint:
        """The paint of a certain car; every fifth is a van."""
        if number not in self._cars:
            paint = paint_van if number % 5 == 4 else paint_car
            self._cars[number] = paint(self._rng("car", number), self._builder)
        return self._cars[number]

    def _crown(self, number: int) -> int:
        key = ("crown", number)
        if key not in self._painted:
            rng = self._rng(*key)
            grey = _crisp(textures.paint_foliage(rng, 4.8, 4.8))
            self._painted[key] = self._builder.add_texture(grey, textures.cut_crown(rng, grey))
        return self._painted[key]

    def _rng(self, kind: str, number: int) -> Rng:
        return np.random.default_rng([self._seed, zlib.crc32(kind.encode()), number])


def _crisp(grey: GreyImage) -> GreyImage:
    """With more contrast in its details, as corners are as many and as strong on real roads."""
    sharp = grey.astype(np.float32)
    sharp += np.float32(_CRISPNESS) * (sharp - cv2.GaussianBlur(sharp, (0, 0), _DETAIL_PX))
    return np.asarray(np.clip(np.rint(sharp), 1, 255), dtype=np.uint8)
