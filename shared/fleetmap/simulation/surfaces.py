"""What a simulated world is made of: flat four-cornered surfaces, each with a grey texture.

A texture is stretched over its surface projectively: its outer corners lie on the surface's corners, texel
centres half a texel inside. Everything that has a place in the world (ground, walls, cars, leaves) is a surface,
so whatever sees the world (a camera now, a range sensor another day) needs to know nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

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

    def __len__(self) -> int:
        return len(self.texture_indices)

    @cached_property
    def map_from_texture(self) -> Array:
        """(Q, 3, 3): takes texture coordinates (s, t, 1), each in [0, 1], to map points times a weight.

        The third row of :attr:`weights` times (s, t, 1) is that weight. From the corner correspondences; the
        general case is in P. Heckbert, "Fundamentals of Texture Mapping and Image Warping", 1989, section 2.2.3.
        """
        top_left, right_axis, down_axis = self._axes()
        basis = np.stack([right_axis, down_axis, top_left], axis=2)
        return np.asarray(basis @ self.weights)

    @cached_property
    def weights(self) -> Array:
        """(Q, 3, 3): takes (s, t, 1) to homogeneous coordinates along the top and left edge."""
        top_left, right_axis, down_axis = self._axes()
        axes = np.stack([right_axis, down_axis], axis=2)
        diagonal = (self.corners_in_map[:, 2] - top_left)[:, :, None]
        along = (np.linalg.pinv(axes) @ diagonal)[:, :, 0]
        along = along / (along.sum(axis=1, keepdims=True) - 1.0)
        weights = np.zeros((len(self), 3, 3))
        weights[:, 0, 0], weights[:, 1, 1], weights[:, 2, 2] = along[:, 0], along[:, 1], 1.0
        weights[:, 2, 0], weights[:, 2, 1] = along[:, 0] - 1.0, along[:, 1] - 1.0
        return weights

    def posed(self, rotations: Array, translations_m: Array, brightness: Array) -> Surfaces:
        """Each surface turned by its (Q, 3, 3) and moved by its (Q, 3), in a new light (Q,).

        Turning and moving leave :attr:`weights` as they are, so that the matrices need no second solution.
        """
        corners = self.corners_in_map @ rotations.transpose(0, 2, 1) + translations_m[:, None]
        moved = Surfaces(corners, self.texture_indices, brightness, self.two_sided)
        texture = rotations @ self.map_from_texture + translations_m[:, :, None] * self.weights[:, 2:3]
        return moved._with_matrices(texture, self.weights)

    def joined(self, other: Surfaces) -> Surfaces:
        """These surfaces and then the others; nothing is solved again."""
        both = Surfaces(
            np.concatenate([self.corners_in_map, other.corners_in_map]),
            np.concatenate([self.texture_indices, other.texture_indices]),
            np.concatenate([self.brightness, other.brightness]),
            np.concatenate([self.two_sided, other.two_sided]),
        )
        texture = np.concatenate([self.map_from_texture, other.map_from_texture])
        return both._with_matrices(texture, np.concatenate([self.weights, other.weights]))

    def _with_matrices(self, map_from_texture: Array, weights: Array) -> Surfaces:
        self.__dict__.update(map_from_texture=map_from_texture, weights=weights)  # where the cached ones live
        return self

    def _axes(self) -> tuple[Array, Array, Array]:
        top_left = self.corners_in_map[:, 0]
        return top_left, self.corners_in_map[:, 1] - top_left, self.corners_in_map[:, 3] - top_left


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

    def add_texture(self, grey: GreyImage, opacity: GreyImage | None = None) -> int:
        """Keep a texture; the number returned names it."""
        if grey.shape[0] % 64 or grey.shape[1] % 64:
            raise ValueError(f"texture sides must be multiples of 64, got {grey.shape}")
        self.textures.append(Texture(grey, opacity))
        return len(self.textures) - 1

    def add_quad(
        self, corners_in_map: Array, texture: int, *, two_sided: bool = False, lit: bool = True, shade: float = 1.0
    ) -> None:
        """Add a flat surface; corners (4, 3) clockwise from top left, as seen from its front."""
        self._corners.append(np.asarray(corners_in_map, dtype=np.float64))
        self._texture_indices.append(texture)
        self._shade.append(shade)
        self._lit.append(lit)
        self._two_sided.append(two_sided)

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
        return Surfaces(corners, np.array(self._texture_indices, dtype=np.int64), shade * light, two_sided)


def normals_of(corners: Array) -> Array:
    """Unit normals (Q, 3) out of the fronts of surfaces with corners (Q, 4, 3)."""
    normals = np.cross(corners[:, 3] - corners[:, 0], corners[:, 1] - corners[:, 0])
    return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))


def raised(points: Array, height_m: float) -> Array:
    """Points (..., 3) moved straight up."""
    return np.asarray(points + np.array([0.0, 0.0, height_m]))
