"""What a simulated world is made of: flat four-cornered surfaces, each with a grey texture.

A texture is stretched over its surface projectively: its outer corners lie on the surface's corners, texel
centres half a texel inside. Everything that has a place in the world (ground, walls, cars, leaves) is a surface,
so whatever sees the world (a camera now, a range sensor another day) needs to know nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
GreyImage = NDArray[np.uint8]

_PLANARITY_M = 1e-4


@dataclass(frozen=True)
class Texture:
    """A grey picture, sides a multiple of 64, and where it is opaque (None: everywhere)."""

    grey: GreyImage  # (H, W) uint8
    opacity: GreyImage | None = None  # (H, W) uint8: 255 opaque, 0 see-through


@dataclass(frozen=True)
class Surfaces:
    """Surfaces as a struct of arrays, in the map frame; corners run from top left by top right."""

    corners_in_map: Array  # (Q, 4, 3) float64
    texture_indices: NDArray[np.int64]  # (Q,) int64
    brightness: Array  # (Q,) float64, factor on the texture's grey: how the light falls
    two_sided: NDArray[np.bool_]  # (Q,) bool; the others are seen only from where the corners run clockwise
    is_lamp: NDArray[np.bool_]  # (Q,) bool: burns when it gets dark

    def __len__(self) -> int:
        return len(self.texture_indices)

    def posed(self, rotations: Array, translations_m: Array, brightness: Array) -> Surfaces:
        """Each surface turned by its (Q, 3, 3) and moved by its (Q, 3), in a new light (Q,)."""
        corners = self.corners_in_map @ rotations.transpose(0, 2, 1) + translations_m[:, None]
        return Surfaces(corners, self.texture_indices, brightness, self.two_sided, self.is_lamp)

    def joined(self, other: Surfaces) -> Surfaces:
        """These surfaces and then the others."""
        return Surfaces(
            np.concatenate([self.corners_in_map, other.corners_in_map]),
            np.concatenate([self.texture_indices, other.texture_indices]),
            np.concatenate([self.brightness, other.brightness]),
            np.concatenate([self.two_sided, other.two_sided]),
            np.concatenate([self.is_lamp, other.is_lamp]),
        )


def brightness_in(sun_in_map: Array, normals_in_map: Array, two_sided: NDArray[np.bool_]) -> Array:
    """Light (Q,) of the sky and of the sun, whose direction is a unit vector (3,), on surfaces' normals (Q, 3)."""
    sun = normals_in_map @ sun_in_map
    return np.asarray(0.42 + 0.9 * np.maximum(np.where(two_sided, np.abs(sun), sun), 0.0))


@dataclass
class SurfaceBuilder:
    """Collects textures and surfaces while a world is laid out."""

    sun_in_map: Array  # (3,) float64, unit vector towards the sun
    textures: list[Texture] = field(default_factory=list)
    _corners: list[Array] = field(default_factory=list)
    _texture_indices: list[int] = field(default_factory=list)
    _shade: list[float] = field(default_factory=list)
    _lit: list[bool] = field(default_factory=list)
    _two_sided: list[bool] = field(default_factory=list)
    _is_lamp: list[bool] = field(default_factory=list)

    def add_texture(self, grey: GreyImage, opacity: GreyImage | None = None) -> int:
        """Keep a texture; the number returned names it."""
        if grey.shape[0] % 64 or grey.shape[1] % 64:
            raise ValueError(f"texture sides must be multiples of 64, got {grey.shape}")
        self.textures.append(Texture(grey, opacity))
        return len(self.textures) - 1

    def add_quad(
        self,
        corners_in_map: Array,
        texture: int,
        *,
        two_sided: bool = False,
        lit: bool = True,
        shade: float = 1.0,
        is_lamp: bool = False,
    ) -> None:
        """Add a flat surface; corners (4, 3) clockwise from top left, as seen from its front."""
        self._corners.append(np.asarray(corners_in_map, dtype=np.float64))
        self._texture_indices.append(texture)
        self._shade.append(shade)
        self._lit.append(lit)
        self._two_sided.append(two_sided)
        self._is_lamp.append(is_lamp)

    def add_prism(
        self, bottom: Array, top: Array, sides: tuple[int, int, int, int], lid: int, *, shade: float = 1.0
    ) -> None:
        """Add four walls and a lid between two rings of corners (4, 3), both clockwise seen from above.

        Wall i stands on bottom[i], bottom[i + 1] and is painted with ``sides[i]``. Each ring lies level.
        """
        for i, side in enumerate(sides):
            j = (i + 1) % 4
            self.add_quad(np.stack([top[j], top[i], bottom[i], bottom[j]]), side, shade=shade)
        self.add_quad(top, lid, shade=shade)

    def add_box(self, foot: Array, heading_rad: float, size_m: tuple[float, float, float], texture: int) -> None:
        """Add a box standing on the middle of its base; its size is along its heading, across, and up."""
        along = 0.5 * size_m[0] * np.array([np.cos(heading_rad), np.sin(heading_rad), 0.0])
        left = 0.5 * size_m[1] * np.array([-np.sin(heading_rad), np.cos(heading_rad), 0.0])
        base = foot + np.stack([along + left, along - left, -along - left, left - along])
        self.add_prism(base, raised(base, size_m[2]), (texture, texture, texture, texture), texture)

    def surfaces(self) -> Surfaces:
        """All surfaces added so far, in the light of the sun.

        Raises:
            ValueError: the corners of one do not lie in one plane.
        """
        corners, two_sided, shade = np.stack(self._corners), np.array(self._two_sided), np.array(self._shade)
        normals = normals_of(corners)
        warp = np.abs(np.einsum("qi,qi->q", corners[:, 2] - corners[:, 0], normals))
        if not warp.max() <= _PLANARITY_M:
            crooked = corners[int(np.argmax(warp))].tolist()
            raise ValueError(f"the four corners of a surface do not lie in one plane: {crooked}")
        light = np.where(self._lit, brightness_in(self.sun_in_map, normals, two_sided), 1.0)
        textures = np.array(self._texture_indices, dtype=np.int64)
        return Surfaces(corners, textures, shade * light, two_sided, np.array(self._is_lamp))


def normals_of(corners: Array) -> Array:
    """Unit normals (Q, 3) out of the fronts of surfaces with corners (Q, 4, 3)."""
    normals = np.cross(corners[:, 3] - corners[:, 0], corners[:, 1] - corners[:, 0])
    return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))


def raised(points: Array, height_m: float) -> Array:
    """Points (..., 3) moved straight up."""
    return np.asarray(points + np.array([0.0, 0.0, height_m]))
