"""Painters of the street's textures: ground, walls, roofs, cars, leaves and the far background.

Each has detail from metres down to its texels (about two centimetres): corners for cameras near and far.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from fleetmap.simulation.canvas import Canvas, GreyImage, fractal_noise

Rng = np.random.Generator

WALL_PX_PER_M = 40.0


def paint_road(
    rng: Rng, length_m: float, width_m: float, lane_lines_m: list[float], *, shadows: bool = True
) -> GreyImage:
    """Asphalt seen from above, rows along the road; ``lane_lines_m`` are measured from its left edge."""
    road = Canvas(rng, width_m, length_m, 40.0, float(rng.uniform(108.0, 122.0)))
    road.grain(9.0, 4.0, 0.8)
    stones = rng.standard_normal(road.grey.shape, dtype=np.float32)
    road.grey += np.where(stones > 2.2, np.float32(38.0), np.float32(0.0)) - np.where(
        stones < -2.2, np.float32(28.0), np.float32(0.0)
    )
    for _ in range(int(length_m * 0.35) + 1):  # repaired patches
        x, y = rng.uniform(0.0, width_m), rng.uniform(0.0, length_m)
        w, h = rng.uniform(0.5, 1.8), rng.uniform(0.4, 2.5)
        road.darken(x, y, x + w, y + h, float(rng.choice([0.7, 0.8, 1.15, 1.25])))
    for _ in range(int(length_m * 0.7) + 1):  # cracks
        start = rng.uniform((0.0, 0.0), (width_m, length_m))
        steps = rng.normal(0.0, 0.12, (12, 2)) + rng.normal(0.0, 0.12, 2)
        road.line(start + np.cumsum(steps, axis=0), 0.02, 55.0)
    for _ in range(int(length_m * 0.08) + 1):  # manholes, drains, oil
        x, y = rng.uniform(0.5, width_m - 0.5), rng.uniform(0.5, length_m - 0.5)
        road.ellipse(x, y, 0.34, 0.34, float(rng.uniform(50.0, 80.0)))
        road.ellipse(x, y, 0.24, 0.24, float(rng.uniform(85.0, 110.0)))
    for line in lane_lines_m:
        for y in np.arange(0.0, length_m, 6.0):
            patch = road.patch(line - 0.06, y, line + 0.06, y + 3.0)
            worn = fractal_noise(rng, (patch.shape[0], patch.shape[1]), 16.0) > 1.1
            patch[~worn] = 205.0
    if shadows:
        _cast_shadows(road)
    return road.finish()


def paint_crossing(rng: Rng, length_m: float, width_m: float) -> GreyImage:
    """Where people cross: asphalt with the bars of a zebra, worn, or with none."""
    bars: list[float] = [] if rng.random() < 0.4 else np.arange(0.6, width_m - 0.5, 1.0).tolist()
    road = Canvas(rng, width_m, length_m, 40.0, float(rng.uniform(108.0, 122.0)))
    road.grain(9.0, 4.0, 0.8)
    for x in bars:
        patch = road.patch(x, 0.1, x + 0.5, length_m - 0.1)
        worn = fractal_noise(rng, (patch.shape[0], patch.shape[1]), 16.0) > 1.0
        patch[~worn] = 195.0
    return road.finish()


def _cast_shadows(sheet: Canvas) -> None:
    """Shadows of houses (straight edges) and of trees (speckled)."""
    rng = sheet.rng
    for _ in range(int(sheet.height_m / 9.0)):
        y, depth = rng.uniform(0.0, sheet.height_m), rng.uniform(0.25, 0.75) * sheet.width_m
        corners = np.array([[0.0, y], [depth, y + 1.5], [depth, y + rng.uniform(3.0, 8.0)], [0.0, y + 8.0]])
        sheet.polygon(corners, 0.55)
    for _ in range(int(sheet.height_m / 5.0) + 1):
        size_px = (round(3.5 * sheet.scale[1]), round(3.5 * sheet.scale[0]))
        top = int(rng.integers(0, max(sheet.grey.shape[0] - size_px[0], 1)))
        left = int(rng.integers(0, max(sheet.grey.shape[1] - size_px[1], 1)))
        patch = sheet.grey[top : top + size_px[0], left : left + size_px[1]]
        shape = (patch.shape[0], patch.shape[1])
        patch[_blob(shape) * 2.2 + fractal_noise(rng, shape, 24.0) > 1.0] *= np.float32(0.5)


def _blob(shape: tuple[int, int]) -> NDArray[np.float32]:
    """1 in the middle, 0 on the rim of the inscribed ellipse, negative outside."""
    y = np.linspace(-1.0, 1.0, shape[0], dtype=np.float32)[:, None]
    x = np.linspace(-1.0, 1.0, shape[1], dtype=np.float32)
    return np.asarray(1.0 - (x * x + y * y), dtype=np.float32)


def paint_pavement(rng: Rng, length_m: float, width_m: float) -> GreyImage:
    """Slabs or cobbles between kerb and gardens."""
    sheet = Canvas(rng, width_m, length_m, 36.0, float(rng.uniform(135.0, 155.0)))
    slab = 0.45
    for y in np.arange(0.0, length_m, slab):
        for x in np.arange(0.0, width_m, slab):
            sheet.rectangle(x, y, x + slab - 0.03, y + slab - 0.03, float(rng.normal(152.0, 9.0)), 5.0)
    sheet.grain(8.0)
    _cast_shadows(sheet)
    return sheet.finish()


def paint_grass(rng: Rng, length_m: float, width_m: float, px_per_m: float = 16.0) -> GreyImage:
    """Lawn, gravel and bushes seen from above."""
    sheet = Canvas(rng, width_m, length_m, px_per_m, float(rng.uniform(88.0, 112.0)))
    sheet.grain(20.0, 3.0, 0.85)
    return sheet.finish()


def paint_facade(rng: Rng, width_m: float, height_m: float) -> GreyImage:
    """The front of a house: storeys of windows, a door or a shop, signs, pipes and dirt."""
    wall = _paint_wall(rng, width_m, height_m)
    pitch, window_w, window_h = rng.uniform(2.1, 3.2), rng.uniform(0.9, 1.35), rng.uniform(1.25, 1.6)
    columns = max(int((width_m - 0.6) // pitch), 1)
    left = (width_m - (columns - 1) * pitch - window_w) / 2.0
    storeys = max(int((height_m - 0.4) // 2.9), 1)
    shutters = rng.random() < 0.4
    for storey in range(storeys):
        sill = height_m - 2.9 * storey - 0.95
        if rng.random() < 0.4:
            wall.rectangle(0.0, sill + 0.85, width_m, sill + 0.97, float(rng.uniform(90.0, 220.0)))
        for column in range(columns):
            x = left + column * pitch
            if storey == 0 and column == columns // 2:
                _paint_door(wall, x, height_m)
            else:
                _paint_window(wall, x, sill - window_h, window_w, window_h, shutters)
    if rng.random() < 0.5:
        _paint_shop(wall)
    _paint_clutter(wall)
    return wall.finish()


def paint_alike(shared: Rng, own: Rng, width_m: float, height_m: float) -> GreyImage:
    """A front whose wall and windows come from ``shared``, and a few details from ``own``."""
    front = paint_facade(shared, width_m, height_m)
    wall = Canvas(own, width_m, height_m, WALL_PX_PER_M, 0.0)
    wall.grey = front.astype(np.float32)
    for _ in range(2):
        x, y = own.uniform(0.5, width_m - 1.0), own.uniform(0.5, height_m - 0.8)
        wall.rectangle(
            x, y, x + own.uniform(0.15, 0.5), y + own.uniform(0.15, 0.4), float(own.uniform(20, 240)), 8.0
        )
    wall.text(own.uniform(0.5, width_m - 1.5), height_m - 1.6, 0.22, 40.0, 3)
    return wall.finish()


def paint_side(rng: Rng, width_m: float, height_m: float) -> GreyImage:
    """A fire wall: few small windows, stains."""
    wall = _paint_wall(rng, width_m, height_m)
    for _ in range(int(rng.integers(1, 6))):
        x, y = rng.uniform(0.5, max(width_m - 1.2, 0.6)), rng.uniform(0.8, max(height_m - 2.0, 0.9))
        _paint_window(wall, x, y, 0.8, 1.1, False)
    _paint_clutter(wall)
    return wall.finish()


def _paint_wall(rng: Rng, width_m: float, height_m: float) -> Canvas:
    """Plaster or bricks, darker at the foot, streaked by rain."""
    base = float(rng.choice([rng.uniform(80.0, 130.0), rng.uniform(150.0, 215.0)]))
    wall = Canvas(rng, width_m, height_m, WALL_PX_PER_M, base)
    if rng.random() < 0.35:
        _lay_bricks(wall)
    wall.grain(7.0, 3.0, 0.8)
    for _ in range(int(width_m)):
        x, w = rng.uniform(0.0, width_m), rng.uniform(0.1, 0.5)
        top = rng.uniform(0.0, 0.8 * height_m)
        wall.darken(x, top, x + w, top + rng.uniform(0.5, 3.0), float(rng.uniform(0.88, 0.97)))
    wall.darken(0.0, height_m - rng.uniform(0.4, 1.0), width_m, height_m, float(rng.uniform(0.6, 0.85)))
    wall.darken(0.0, 0.0, width_m, 0.3, 0.6)
    return wall


def _lay_bricks(wall: Canvas) -> None:
    course, brick, joint = 0.1, 0.3, 0.025
    for row in range(int(wall.height_m / course)):
        y, shift = row * course, (row % 2) * brick / 2.0
        lefts = np.arange(-shift, wall.width_m, brick)
        tones = wall.rng.normal(1.0, 0.09, len(lefts)).astype(np.float32)
        columns = np.ones(wall.grey.shape[1], dtype=np.float32)
        starts, stops = (np.rint(x * wall.scale[0]).astype(int) for x in (lefts, lefts + brick - joint))
        for start, stop, tone in zip(starts.tolist(), stops.tolist(), tones, strict=True):
            columns[max(start, 0) : stop] = tone
        wall.patch(0.0, y, wall.width_m, y + course - joint)[...] *= columns
        wall.darken(0.0, y + course - joint, wall.width_m, y + course, 0.8)


def _paint_window(wall: Canvas, x: float, y: float, w: float, h: float, shutters: bool) -> None:
    rng = wall.rng
    frame = float(rng.choice([70.0, 225.0, 240.0]))
    wall.rectangle(x - 0.1, y - 0.1, x + w + 0.1, y + h + 0.1, float(rng.uniform(90.0, 235.0)))
    wall.rectangle(x, y, x + w, y + h, frame)
    panes = int(rng.integers(1, 4))
    for pane in range(panes):
        x0, x1 = x + 0.06 + pane * (w - 0.06) / panes, x + (pane + 1) * (w - 0.06) / panes
        glass = wall.patch(x0, y + 0.06, x1, y + h - 0.06)
        if not glass.size:
            continue
        shape = (glass.shape[0], glass.shape[1])
        glass[...] = rng.uniform(25.0, 60.0) + 18.0 * fractal_noise(rng, shape, 24.0, 0.6)
        if rng.random() < 0.5:  # curtain
            wall.rectangle(
                x0, y + 0.06, x1, y + 0.06 + rng.uniform(0.2, 0.9) * h, float(rng.uniform(120.0, 190.0)), 9.0
            )
    if rng.random() < 0.3:  # roller blind
        drop = rng.uniform(0.2, 0.8) * h
        for slat in np.arange(0.0, drop, 0.08):
            wall.rectangle(x, y + slat, x + w, y + slat + 0.05, float(rng.normal(175.0, 6.0)))
    wall.rectangle(x - 0.15, y + h + 0.02, x + w + 0.15, y + h + 0.1, 60.0)  # the sill's shadow
    if rng.random() < 0.3:  # flowers
        box = wall.patch(x, y + h - 0.2, x + w, y + h + 0.05)
        box[...] = 80.0 + 55.0 * rng.standard_normal(box.shape, dtype=np.float32)
    if shutters:
        for x0 in (x - 0.55, x + w + 0.12):
            wall.rectangle(x0, y, x0 + 0.43, y + h, 75.0, 5.0)
            for slat in np.arange(0.1, h - 0.1, 0.1):
                wall.rectangle(x0 + 0.05, y + slat, x0 + 0.38, y + slat + 0.04, 115.0)


def _paint_door(wall: Canvas, x: float, height_m: float) -> None:
    wall.rectangle(x - 0.1, height_m - 2.3, x + 1.15, height_m, 200.0)
    wall.rectangle(x, height_m - 2.2, x + 1.05, height_m, float(wall.rng.uniform(40.0, 110.0)), 5.0)
    wall.rectangle(x + 0.2, height_m - 1.9, x + 0.85, height_m - 1.1, 45.0, 12.0)
    wall.rectangle(x + 0.9, height_m - 1.1, x + 0.98, height_m - 0.95, 230.0)
    wall.text(x + 1.25, height_m - 1.6, 0.16, 40.0, 2)


def _paint_shop(wall: Canvas) -> None:
    rng, h = wall.rng, wall.height_m
    left = rng.uniform(0.3, 0.4 * wall.width_m)
    right = min(left + rng.uniform(3.0, 5.0), wall.width_m - 0.2)
    wall.rectangle(left, h - 2.9, right, h - 2.3, float(rng.choice([40.0, 230.0])), 3.0)
    letters = max(int((right - left) / 0.42), 1)
    wall.text(left + 0.15, h - 2.42, 0.38, 140.0, letters)
    window = wall.patch(left, h - 2.25, right, h - 0.5)
    if window.size:
        window[...] = 60.0 + 28.0 * fractal_noise(rng, (window.shape[0], window.shape[1]), 32.0, 0.9)
    for _ in range(5):
        x, y = rng.uniform(left, right), rng.uniform(h - 2.1, h - 1.0)
        wall.rectangle(
            x, y, x + rng.uniform(0.2, 0.6), y + rng.uniform(0.2, 0.6), float(rng.uniform(30.0, 240.0)), 12.0
        )


def _paint_clutter(wall: Canvas) -> None:
    """Drain pipe, lamps, vents, posters, scribbles, ivy."""
    rng, w, h = wall.rng, wall.width_m, wall.height_m
    x = float(rng.choice([0.15, w - 0.3]))
    wall.rectangle(x, 0.3, x + 0.1, h, 85.0)
    wall.darken(x + 0.1, 0.3, x + 0.2, h, 0.8)
    for _ in range(int(rng.integers(4, 12))):
        x, y, size = rng.uniform(0.2, w), rng.uniform(0.3, h), rng.uniform(0.08, 0.4)
        wall.rectangle(x, y, x + size, y + size * rng.uniform(0.6, 1.8), float(rng.uniform(20.0, 240.0)), 8.0)
    for _ in range(int(rng.integers(0, 4))):
        start = np.array([rng.uniform(0.0, w), h - rng.uniform(0.5, 1.8)])
        wall.line(
            start + np.cumsum(rng.normal(0.0, 0.18, (14, 2)), axis=0), 0.05, float(rng.choice([30.0, 235.0]))
        )
    if rng.random() < 0.3:
        left, size = rng.uniform(0.0, 0.7 * w), rng.uniform(1.0, 3.0)
        patch = wall.patch(left, h - 2.0 * size, left + size, h)
        shape = (patch.shape[0], patch.shape[1])
        leaves = _blob(shape) * 2.0 + fractal_noise(rng, shape, 24.0, 0.9) > 0.3
        patch[leaves] = (70.0 + 30.0 * fractal_noise(rng, shape, 8.0, 0.9))[leaves]


def paint_tunnel_wall(rng: Rng, width_m: float, height_m: float) -> GreyImage:
    """Concrete panels with a light band, cables, stains; now and then a door, a niche or a sign."""
    wall = Canvas(rng, width_m, height_m, WALL_PX_PER_M, float(rng.uniform(120.0, 140.0)))
    wall.grain(10.0, 3.0, 0.85)
    for x in np.arange(0.0, width_m, 2.0):
        wall.darken(x, 0.0, x + 0.04, height_m, 0.5)
    wall.rectangle(0.0, height_m - 1.5, width_m, height_m - 1.2, 200.0, 9.0)
    for y in (1.1, 1.25):
        wall.rectangle(0.0, y, width_m, y + 0.05, 60.0, 8.0)
    for _ in range(int(width_m * 1.5)):
        x, top = rng.uniform(0.0, width_m), rng.uniform(0.0, height_m)
        wall.darken(x, top, x + rng.uniform(0.05, 0.5), top + rng.uniform(0.5, 3.0), float(rng.uniform(0.7, 0.95)))
    kind, x = rng.random(), float(rng.uniform(0.5, width_m - 2.0))
    if kind < 0.3:
        wall.rectangle(x, height_m - 2.2, x + 1.1, height_m, float(rng.choice([50.0, 210.0])), 6.0)
        wall.text(x + 0.15, height_m - 1.6, 0.25, 128.0, 3)
    elif kind < 0.6:
        wall.rectangle(x, 1.8, x + 0.9, 2.7, 235.0, 4.0)
        wall.text(x + 0.08, 2.4, 0.3, 40.0, 3)
    for _ in range(int(rng.integers(2, 7))):
        x, y, size = rng.uniform(0.2, width_m), rng.uniform(1.4, height_m), rng.uniform(0.08, 0.35)
        wall.rectangle(x, y, x + size, y + size, float(rng.uniform(20.0, 230.0)), 8.0)
    return wall.finish()


def paint_bays(rng: Rng, size_m: float) -> GreyImage:
    """Asphalt or setts of a wide place, with or without the lines of parking bays."""
    place = Canvas(rng, size_m, size_m, 32.0, 0.0)
    road = paint_road(rng, size_m, size_m, [])
    place.grey = cv2.resize(road, place.grey.shape[::-1], interpolation=cv2.INTER_AREA).astype(np.float32)
    if rng.random() < 0.5:
        for x in np.arange(0.0, size_m, 2.5):
            place.rectangle(x, 0.0, x + 0.1, 4.8, 195.0, 12.0)
        place.rectangle(0.0, 4.8, size_m, 4.9, 195.0, 12.0)
    return place.finish()


def paint_roof(rng: Rng, width_m: float, height_m: float) -> GreyImage:
    """Rows of tiles with skylights and a chimney's shadow."""
    roof = Canvas(rng, width_m, height_m, 24.0, float(rng.uniform(70.0, 125.0)))
    roof.grain(9.0, 2.0, 0.85)
    for y in np.arange(0.0, height_m, 0.3):
        roof.darken(0.0, y, width_m, y + 0.06, 0.7)
    for _ in range(int(rng.integers(0, 4))):
        x, y = rng.uniform(0.5, width_m - 1.0), rng.uniform(0.5, max(height_m - 1.5, 0.6))
        roof.rectangle(x, y, x + 0.8, y + 1.1, 215.0)
        roof.rectangle(x + 0.08, y + 0.08, x + 0.72, y + 1.02, 50.0, 10.0)
    return roof.finish()


def paint_foliage(rng: Rng, width_m: float, height_m: float, px_per_m: float = 40.0) -> GreyImage:
    """Leaves, lit from above."""
    sheet = Canvas(rng, width_m, height_m, px_per_m, 88.0)
    sheet.grain(26.0, 0.8, 0.9)
    sheet.grey *= np.linspace(1.25, 0.7, sheet.grey.shape[0], dtype=np.float32)[:, None]
    return sheet.finish()


def cut_crown(rng: Rng, grey: GreyImage) -> GreyImage:
    """The outline of a tree's crown as an opacity (H, W): ragged, with holes."""
    shape = (grey.shape[0], grey.shape[1])
    solid = _blob(shape) * 2.0 + 0.55 * fractal_noise(rng, shape, 64.0, 0.8) > 0.35
    solid &= fractal_noise(rng, shape, 24.0, 0.8) < 1.5
    solid[[0, -1]], solid[:, [0, -1]] = False, False
    return np.asarray(solid, dtype=np.uint8) * np.uint8(255)


def paint_plain(rng: Rng, width_m: float, height_m: float, grey: float, grain: float = 6.0) -> GreyImage:
    """Bark, metal, concrete: one grey with grain."""
    sheet = Canvas(rng, width_m, height_m, 48.0, grey)
    sheet.grain(grain, 0.5, 0.9)
    return sheet.finish()


def paint_sign(rng: Rng, width_m: float, height_m: float) -> GreyImage:
    """A panel with a rim and letters."""
    sign = Canvas(rng, width_m, height_m, 90.0, 225.0)
    sign.rectangle(0.04, 0.04, width_m - 0.04, height_m - 0.04, float(rng.choice([60.0, 190.0])), 3.0)
    sign.text(0.1 * width_m, 0.65 * height_m, 0.32 * height_m, 245.0 - 180.0 * float(rng.random() < 0.5), 4)
    return sign.finish()
