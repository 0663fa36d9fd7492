"""Which surface each pixel sees: a z-buffer on planes, tile by tile.

Any lens works, for it is only a table of rays, and nothing needs to be cut at a near plane: see planes.py.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from fleetmap.simulation.atlas import Opacities
from fleetmap.simulation.planes import INVERSE, S, T, W
from fleetmap.simulation.rays import TILE_COLUMNS, TILE_PIXELS, RayTable

NOTHING = -1  # the index of the sky


@njit(cache=True, nogil=True, error_model="numpy")
def see(planes: Any, texture_of: Any, opacities: Opacities, table: RayTable, samples_px: Any) -> Any:
    """What each sample of each pixel sees.

    Args:
        planes: (1 or B, M, 4, 3) of all surfaces, nearest first, for all bands of rows or for each.
        texture_of: (M,) their textures.
        opacities: where the textures are solid.
        table: the camera's rays.
        samples_px: (K, 2) x and y of the samples beside a pixel's centre.

    Returns:
        Indices of surfaces, or NOTHING, (B, T, K, TILE_PIXELS) int32, and the inverse distances there, float32.
    """
    bands, tiles, count = table.rays.shape[0], table.rays.shape[1], len(samples_px)
    seen = np.full((bands, tiles, count, TILE_PIXELS), NOTHING, dtype=np.int32)
    nearest = np.zeros((bands, tiles, count, TILE_PIXELS), dtype=np.float32)
    lists = np.empty((tiles, planes.shape[1]), dtype=np.int32)
    counts = np.zeros(tiles, dtype=np.int64)
    values = np.empty((4, TILE_PIXELS), dtype=np.float32)
    shifts = np.empty((count, 3), dtype=np.float32)
    for band in range(bands):
        here = planes[min(band, len(planes) - 1)]
        middles, halves = table.middles[band], table.halves[band]
        _bin(here, middles, halves, lists, counts)
        for tile in range(tiles):
            for k in range(count):
                for axis in range(3):
                    across, down = table.across[band, tile, axis], table.down[band, tile, axis]
                    shifts[k, axis] = samples_px[k, 0] * across + samples_px[k, 1] * down
            members, rays = lists[tile, : counts[tile]], table.rays[band, tile]
            target = (nearest[band, tile], seen[band, tile])
            _see_tile(here, texture_of, members, rays, shifts, middles, halves, tile, opacities, target, values)
    return seen, nearest


@njit(cache=True, nogil=True, error_model="numpy")
def _bin(planes: Any, middles: Any, halves: Any, lists: Any, counts: Any) -> None:
    """Sort planes (M, 4, 3) into the tiles of a band: ``lists`` (T, M) and their lengths ``counts`` (T,).

    Planes are tried on the whole band first, then on ever smaller halves of it.
    """
    counts[:] = 0
    tiles = len(middles)
    depth = 0
    while 1 << depth < tiles:
        depth += 1
    # A binary heap of boxes: node n has the children 2 n and 2 n + 1, leaf 2**depth + i is tile i.
    lows, highs = np.full((2 << depth, 3), np.inf, np.float32), np.full((2 << depth, 3), -np.inf, np.float32)
    for tile in range(tiles):
        lows[(1 << depth) + tile] = middles[tile] - halves[tile]
        highs[(1 << depth) + tile] = middles[tile] + halves[tile]
    for node in range((1 << depth) - 1, 0, -1):
        for axis in range(3):
            lows[node, axis] = min(lows[2 * node, axis], lows[2 * node + 1, axis])
            highs[node, axis] = max(highs[2 * node, axis], highs[2 * node + 1, axis])
    middle, half = np.float32(0.5) * (lows + highs), np.float32(0.5) * (highs - lows)
    for m in range(len(planes)):
        node = 1
        while node > 0:
            if _may_hit(planes, m, middle, half, node):
                if node < 1 << depth:
                    node *= 2
                    continue
                tile = node - (1 << depth)
                lists[tile, counts[tile]] = m
                counts[tile] += 1
            while node & 1:  # a right child: up, until there is a right sibling to visit
                node >>= 1
            node = node + 1 if node else 0


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _highest(a: Any, b: Any, c: Any, middles: Any, halves: Any, box: Any) -> Any:
    """The largest value of (a, b, c) . d in a box of rays; NaN in an empty box."""
    return (
        (a * middles[box, 0] + abs(a) * halves[box, 0])
        + (b * middles[box, 1] + abs(b) * halves[box, 1])
        + (c * middles[box, 2] + abs(c) * halves[box, 2])
    )


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _may_hit(planes: Any, m: Any, middles: Any, halves: Any, box: Any) -> Any:
    """False only when no ray of a box hits the surface."""
    s0, s1, s2 = planes[m, S, 0], planes[m, S, 1], planes[m, S, 2]
    t0, t1, t2 = planes[m, T, 0], planes[m, T, 1], planes[m, T, 2]
    w0, w1, w2 = planes[m, W, 0], planes[m, W, 1], planes[m, W, 2]
    return (
        _highest(s0, s1, s2, middles, halves, box) >= 0.0
        and _highest(t0, t1, t2, middles, halves, box) >= 0.0
        and _highest(w0 - s0, w1 - s1, w2 - s2, middles, halves, box) >= 0.0
        and _highest(w0 - t0, w1 - t1, w2 - t2, middles, halves, box) >= 0.0
        and _highest(planes[m, INVERSE, 0], planes[m, INVERSE, 1], planes[m, INVERSE, 2], middles, halves, box)
        > 0.0
    )


@njit(cache=True, nogil=True, error_model="numpy")
def _see_tile(
    planes: Any,
    texture_of: Any,
    members: Any,
    rays: Any,
    shifts: Any,
    middles: Any,
    halves: Any,
    tile: int,
    opacities: Opacities,
    target: Any,
    values: Any,
) -> None:
    """Draw the ``members`` of a tile, nearest first, into its part of the z-buffer (K, TILE_PIXELS)."""
    nearest, seen = target
    farthest = np.float32(0.0)
    for m in members:
        i0, i1, i2 = planes[m, INVERSE, 0], planes[m, INVERSE, 1], planes[m, INVERSE, 2]
        if _highest(i0, i1, i2, middles, halves, tile) <= farthest:
            continue
        for row in range(4):
            a, b, c = planes[m, row, 0], planes[m, row, 1], planes[m, row, 2]
            for p in range(TILE_PIXELS):
                values[row, p] = a * rays[0, p] + b * rays[1, p] + c * rays[2, p]
        is_solid = opacities.level_starts[texture_of[m], 0] < 0
        for k in range(len(shifts)):
            ds, dt = _along(planes, m, S, shifts, k), _along(planes, m, T, shifts, k)
            dw, di = _along(planes, m, W, shifts, k), _along(planes, m, INVERSE, shifts, k)
            if is_solid:
                _cover(m, values, ds, dt, dw, di, k, nearest, seen)
            else:
                _cover_solid_part(m, values, ds, dt, dw, di, texture_of[m], opacities, k, nearest, seen)
        farthest = nearest.min()


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _along(planes: Any, m: Any, row: Any, rays: Any, k: Any) -> Any:
    return planes[m, row, 0] * rays[k, 0] + planes[m, row, 1] * rays[k, 1] + planes[m, row, 2] * rays[k, 2]


@njit(cache=True, nogil=True, error_model="numpy")
def _cover(m: Any, values: Any, ds: Any, dt: Any, dw: Any, di: Any, k: Any, nearest: Any, seen: Any) -> None:
    """Put a surface into the z-buffer; written without branches, so that it compiles to vector instructions."""
    for p in range(TILE_PIXELS):
        s, t = values[S, p] + ds, values[T, p] + dt
        w, inverse = values[W, p] + dw, values[INVERSE, p] + di
        hit = (s >= 0.0) & (t >= 0.0) & (w >= s) & (w >= t) & (inverse > nearest[k, p])
        nearest[k, p] = inverse if hit else nearest[k, p]
        seen[k, p] = m if hit else seen[k, p]


@njit(cache=True, nogil=True, error_model="numpy")
def _cover_solid_part(
    m: Any,
    values: Any,
    ds: Any,
    dt: Any,
    dw: Any,
    di: Any,
    texture: Any,
    opacities: Opacities,
    k: Any,
    nearest: Any,
    seen: Any,
) -> None:
    """The same for a see-through surface: only where its texture is solid."""
    level = -1
    for p in range(TILE_PIXELS):
        s, t = values[S, p] + ds, values[T, p] + dt
        w, inverse = values[W, p] + dw, values[INVERSE, p] + di
        if s >= 0.0 and t >= 0.0 and w >= s and w >= t and w > 0.0 and inverse > nearest[k, p]:
            if level < 0:
                q = p + 1 if (p + 1) % TILE_COLUMNS else p - 1
                other = np.float32(1.0) / (values[W, q] + dw)
                step_s = abs((values[S, q] + ds) * other - s / w)
                step_t = abs((values[T, q] + dt) * other - t / w)
                level = opacity_level(opacities, texture, step_s, step_t)
            if is_solid_at(opacities, texture, level, s / w, t / w):
                nearest[k, p] = inverse
                seen[k, p] = m


@njit(cache=True, nogil=True, error_model="numpy")
def opacity_level(opacities: Opacities, texture: Any, step_s: Any, step_t: Any) -> int:
    """The level of a see-through texture that fits steps of texture coordinates from pixel to pixel."""
    texels = max(step_s * opacities.level_sizes[texture, 0, 0], step_t * opacities.level_sizes[texture, 0, 1])
    level = 0
    while texels >= 2.0 and level < opacities.level_starts.shape[1] - 1:
        texels *= 0.5
        level += 1
    return level


@njit(cache=True, nogil=True, error_model="numpy")
def is_solid_at(opacities: Opacities, texture: Any, level: Any, s: Any, t: Any) -> Any:
    """Whether a see-through texture is solid at texture coordinates in [0, 1]."""
    width, height = opacities.level_sizes[texture, level, 0], opacities.level_sizes[texture, level, 1]
    x = min(max(s * width - np.float32(0.5), np.float32(0.0)), np.float32(width - 1))
    y = min(max(t * height - np.float32(0.5), np.float32(0.0)), np.float32(height - 1))
    column, row = int(x), int(y)
    right, below = min(column + 1, width - 1), min(row + 1, height - 1)
    start = opacities.level_starts[texture, level]
    fx, fy = x - np.float32(column), y - np.float32(row)
    texels = opacities.texels
    top = texels[start + row * width + column] * (np.float32(1.0) - fx) + texels[start + row * width + right] * fx
    bottom = (
        texels[start + below * width + column] * (np.float32(1.0) - fx)
        + texels[start + below * width + right] * fx
    )
    return top * (np.float32(1.0) - fy) + bottom * fy > np.float32(127.0)


@njit(cache=True, nogil=True, error_model="numpy")
def first_hits(
    planes: Any, nearest_m: Any, texture_of: Any, opacities: Opacities, rays: Any, farthest_m: float
) -> Any:
    """Distances (N,) along unit rays (N, 3) to the first of the planes (M, 4, 3) that each ray hits, or infinity.

    No ray hits plane m before ``nearest_m[m]``, which must rise with m.
    """
    distances = np.full(len(rays), np.inf)
    for n in range(len(rays)):
        distance = farthest_m
        for m in range(len(planes)):
            if nearest_m[m] > distance:
                break
            inverse = _along(planes, m, INVERSE, rays, n)
            if not inverse * distance >= 1.0:
                continue
            s, t, w = _along(planes, m, S, rays, n), _along(planes, m, T, rays, n), _along(planes, m, W, rays, n)
            if s < 0.0 or t < 0.0 or s > w or t > w or w <= 0.0:
                continue
            texture = texture_of[m]
            if opacities.level_starts[texture, 0] < 0 or is_solid_at(opacities, texture, 0, s / w, t / w):
                distance = 1.0 / inverse
                distances[n] = distance
    return distances
