"""Cars and vans: a body and a cabin, painted on all sides."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.simulation.canvas import Canvas, GreyImage
from fleetmap.simulation.surfaces import SurfaceBuilder

Array = NDArray[np.float64]
Rng = np.random.Generator

_PX_PER_M = 60.0


@dataclass(frozen=True)
class CarShape:
    """Sizes in metres; the cabin is a prism on the body, whose ends lean inwards."""

    length: float
    width: float
    body: float  # height of the body, and of the whole car
    height: float
    cabin_rear: tuple[float, float]  # its foot and its roof begin so far before the rear,
    cabin_front: tuple[float, float]  # and end so far behind the front
    panes: int  # windows on each side


CAR = CarShape(4.3, 1.78, 0.86, 1.48, (0.15, 0.55), (1.25, 2.05), 3)
VAN = CarShape(5.4, 2.0, 1.15, 2.45, (0.02, 0.1), (0.75, 1.45), 2)


@dataclass(frozen=True)
class CarPaint:
    """Texture numbers of one car."""

    side: int
    end: int
    bonnet: int
    cabin_side: int
    cabin_end: int
    roof: int
    shape: CarShape = CAR


def paint_car(rng: Rng, builder: SurfaceBuilder, shape: CarShape = CAR) -> CarPaint:
    """Paint one car's textures."""
    lacquer = float(rng.choice([30.0, 45.0, 80.0, 130.0, 190.0, 235.0]))
    return CarPaint(
        side=builder.add_texture(_side(rng, shape, lacquer)),
        end=builder.add_texture(_end(rng, shape, lacquer)),
        bonnet=builder.add_texture(_lid(rng, shape, shape.length, lacquer)),
        cabin_side=builder.add_texture(_glass(rng, shape, shape.length - 1.7, lacquer, shape.panes)),
        cabin_end=builder.add_texture(_glass(rng, shape, 1.5, lacquer, 1)),
        roof=builder.add_texture(_lid(rng, shape, shape.length - 2.6, lacquer)),
        shape=shape,
    )


def paint_van(rng: Rng, builder: SurfaceBuilder) -> CarPaint:
    """Paint one van's textures."""
    return paint_car(rng, builder, VAN)


def park_car(builder: SurfaceBuilder, paint: CarPaint, map_from_car: Array, origin: Array, size: float) -> None:
    """Stand a car on the ground; ``map_from_car`` (3, 3) has the columns forward, left, up."""
    shape = paint.shape

    def ring(rear: float, front: float, half_width: float, height: float) -> Array:
        corners = [(front, half_width), (front, -half_width), (rear, -half_width), (rear, half_width)]
        return size * np.array([(x, y, height) for x, y in corners]) @ map_from_car.T + origin

    half, half_width = shape.length / 2.0, shape.width / 2.0
    body = (paint.end, paint.side, paint.end, paint.side)
    low, high = (ring(-half, half, half_width, height) for height in (0.02, shape.body))
    builder.add_prism(low, high, body, paint.bonnet)
    cabin = (paint.cabin_end, paint.cabin_side, paint.cabin_end, paint.cabin_side)
    lower, upper = (
        ring(-half + rear, half - front, half_width - inset, height)
        for rear, front, inset, height in zip(
            shape.cabin_rear, shape.cabin_front, (0.02, 0.2), (shape.body, shape.height), strict=True
        )
    )
    builder.add_prism(lower, upper, cabin, paint.roof)


def _side(rng: Rng, shape: CarShape, lacquer: float) -> GreyImage:
    side = Canvas(rng, shape.length, shape.body, _PX_PER_M, lacquer)
    _polish(side)
    side.rectangle(0.0, shape.body - 0.2, shape.length, shape.body, 18.0)  # the gap under the car
    for x in (1.35, 2.35, 3.2):
        side.rectangle(x, 0.02, x + 0.02, shape.body - 0.25, 0.4 * lacquer)
        side.rectangle(x - 0.25, 0.12, x - 0.08, 0.16, 0.5 * lacquer + 60.0)
    for x in (0.8, shape.length - 0.85):
        side.ellipse(x, shape.body - 0.3, 0.36, 0.36, 14.0)
        side.ellipse(x, shape.body - 0.3, 0.31, 0.31, 32.0)
        side.ellipse(x, shape.body - 0.3, 0.2, 0.2, float(rng.uniform(120.0, 200.0)))
        for angle in np.arange(0.0, 2.0 * np.pi, 2.0 * np.pi / 5.0):
            side.ellipse(x + 0.13 * np.cos(angle), shape.body - 0.3 + 0.13 * np.sin(angle), 0.05, 0.05, 25.0)
    return side.finish()


def _end(rng: Rng, shape: CarShape, lacquer: float) -> GreyImage:
    end = Canvas(rng, shape.width, shape.body, _PX_PER_M, lacquer)
    _polish(end)
    end.rectangle(0.0, shape.body - 0.22, shape.width, shape.body, 18.0)
    for x in (0.06, shape.width - 0.4):
        end.rectangle(x, 0.1, x + 0.34, 0.32, 150.0, 22.0)
        end.rectangle(x + 0.1, 0.14, x + 0.2, 0.28, 235.0)
    end.rectangle(0.1, 0.45, shape.width - 0.1, 0.5, 0.55 * lacquer)
    end.rectangle(0.62, 0.36, 1.16, 0.49, 240.0)
    end.text(0.66, 0.47, 0.09, 30.0, 7)
    for x in (0.08, shape.width - 0.3):
        end.rectangle(x, shape.body - 0.3, x + 0.22, shape.body, 10.0)
    return end.finish()


def _glass(rng: Rng, shape: CarShape, width_m: float, lacquer: float, panes: int) -> GreyImage:
    glass = Canvas(rng, width_m, shape.height - shape.body, _PX_PER_M, lacquer)
    step = (width_m - 0.1) / panes
    for pane in range(panes):
        left = 0.06 + pane * step
        glass.rectangle(left, 0.06, left + step - 0.05, shape.height - shape.body - 0.04, 35.0)
        inner = glass.patch(left, 0.06, left + step - 0.05, shape.height - shape.body - 0.04)
        inner += 12.0 * np.linspace(1.0, -1.0, inner.shape[0], dtype=np.float32)[:, None]
        x = left + rng.uniform(0.1, 0.6) * step
        glass.rectangle(x, 0.22, x + 0.2, 0.55, float(rng.uniform(15.0, 110.0)), 8.0)
    return glass.finish()


def _lid(rng: Rng, shape: CarShape, length_m: float, lacquer: float) -> GreyImage:
    lid = Canvas(rng, shape.width, length_m, 40.0, min(lacquer + 25.0, 245.0))
    _polish(lid)
    return lid.finish()


def _polish(sheet: Canvas) -> None:
    """Soft reflections."""
    sheet.grain(7.0, 0.8, 0.4)
