"""Every size of a texture is in the atlas, at the place that its formula says, and averages what it stands for."""

from __future__ import annotations

import numpy as np

from fleetmap.simulation.atlas import MAX_LEVEL, build_atlas
from fleetmap.simulation.surfaces import Texture


def test_each_level_is_where_the_formula_says_and_holds_the_averages() -> None:
    rng = np.random.default_rng(0)
    textures = [Texture(rng.integers(0, 256, shape, dtype=np.uint8)) for shape in ((64, 128), (192, 64), (64, 64))]
    atlas = build_atlas(textures)
    for texture, origin, size in zip(textures, atlas.origins_px, atlas.sizes_px, strict=True):
        for i in range(MAX_LEVEL + 1):
            for j in range(MAX_LEVEL + 1):
                x, y = (origin + 2.0 * size * (1.0 - 0.5 ** np.array([i, j]))).astype(int)
                w, h = (size * 0.5 ** np.array([i, j])).astype(int)
                level = atlas.pixels[y : y + h, x : x + w].astype(float)
                expected = texture.grey.reshape(h, 2**j, w, 2**i).mean(axis=(1, 3))
                assert np.abs(level - expected).max() < 0.5 * (i + j) + 0.01  # each halving rounds once
                assert abs(level.mean() - texture.grey.mean()) < 1.0


def test_see_through_textures_keep_their_share() -> None:
    opacity = np.zeros((64, 64), dtype=np.uint8)
    opacity[:, :48] = 255
    atlas = build_atlas([Texture(np.full((64, 64), 9, dtype=np.uint8), opacity)])
    pyramid = atlas.opacities[0]
    assert pyramid is not None
    assert [level.shape[0] for level in pyramid] == [64, 32, 16, 8, 4, 2, 1]
    assert all(abs(level.mean() - 0.75 * 255.0) < 1.0 for level in pyramid)
