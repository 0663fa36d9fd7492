"""Images that must have no pose: of other streets, of houses that look alike, and of nothing.

Each is asked for on its own, and in the simulation as well after two images that a track goes on from.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from fleetmap.camera import Camera
from fleetmap.drive import Frame
from fleetmap.drives import open_drive
from fleetmap_cli.benchmarks.simulated_draws import STREETS, Draw
from fleetmap_localizer.localizer import Localizer
from fleetmap_localizer.map_source import read_map
from fleetmap_localizer.map_view import LocalizableMap, MapView
from fleetmap_localizer.pose_estimate import PoseEstimate
from fleetmap_localizer.settings import LocalizerSettings

Image = NDArray[np.uint8]
Spoiler = Callable[[Image, np.random.Generator], Image]

OTHER, ALIKE = "another street", "houses that look alike"
TWIN = "a street of the same shape, a quarter of its surfaces the same"
_FIRST_DRAW = 1000
_IMAGES_PER_STREET = 12
_STEP_NS = 100_000_000


@dataclass(frozen=True)
class ForeignQuery:
    """A question that has no answer."""

    kind: str
    is_posed: bool  # whether it was answered all the same


def real_queries(package: Path, recording: Path) -> Iterator[ForeignQuery]:
    """Every image of a recording, in the map of another street; and all of them spoilt."""
    drive = open_drive(recording)
    localizer = _localizer(read_map(package), drive.camera)
    for number, frame in enumerate(drive.frames()):
        yield ForeignQuery(OTHER, _is_posed_alone(localizer, frame))
        kind = list(SPOILERS)[number % len(SPOILERS)]
        yield ForeignQuery(kind, _is_posed_alone(localizer, _spoilt(frame, kind, number)))


def simulated_queries(streets: int = 2 * len(STREETS)) -> Iterator[ForeignQuery]:
    """Every street's map is asked for the images of all others, for its own spoilt, and for its twin's."""
    draws = [Draw(_FIRST_DRAW + number, STREETS[number % len(STREETS)]) for number in range(streets)]
    images = {draw: _images(draw) for draw in draws}
    for draw in draws:
        asked = [(_kind(draw, other), frame) for other in draws if other != draw for frame in images[other]]
        asked += [
            (kind, _spoilt(frame, kind, number)) for kind in SPOILERS for number, frame in enumerate(images[draw])
        ]
        if draw.has_twin:
            asked += [(TWIN, frame) for frame in _images(replace(draw, variant=1))]
        yield from alone_and_after(_localizer(draw.mapped(), draw.query().camera), images[draw], asked)


def alone_and_after(
    localizer: Localizer, good: Sequence[Frame], asked: Sequence[tuple[str, Frame]]
) -> Iterator[ForeignQuery]:
    """Each image on its own, and as the next of a track through good images, where those can be followed."""
    for number, (kind, frame) in enumerate(asked):
        yield ForeignQuery(kind, _is_posed_alone(localizer, frame))
        first = number % (len(good) - 1)
        localizer.forget()
        if all(isinstance(localizer.localize(each), PoseEstimate) for each in good[first : first + 2]):
            following = replace(frame, stamp_ns=good[first + 1].stamp_ns + _STEP_NS)
            yield ForeignQuery(kind, isinstance(localizer.localize(following), PoseEstimate))


def _localizer(source: LocalizableMap, camera: Camera) -> Localizer:
    settings = LocalizerSettings()
    return Localizer(camera, (MapView(source, camera, settings),), settings)


def _is_posed_alone(localizer: Localizer, frame: Frame) -> bool:
    localizer.forget()
    return isinstance(localizer.localize(frame), PoseEstimate)


def _images(draw: Draw) -> list[Frame]:
    return [frame for _, frame, _ in islice(draw.images(rate_hz=10.0), _IMAGES_PER_STREET)]


def _kind(draw: Draw, other: Draw) -> str:
    return ALIKE if draw.kind == other.kind == "facades" else OTHER


def _spoilt(frame: Frame, kind: str, seed: int) -> Frame:
    return replace(frame, image=SPOILERS[kind](frame.image, np.random.default_rng(seed)))


def noise(image: Image, rng: np.random.Generator) -> Image:
    """Nothing but noise."""
    return np.asarray(rng.integers(0, 256, image.shape), dtype=np.uint8)


def black(image: Image, rng: np.random.Generator) -> Image:
    """Night without lamps: a few grey levels of the sensor's noise."""
    return np.clip(rng.normal(2.0, 1.5, image.shape), 0, 255).astype(np.uint8)


def blurred(image: Image, rng: np.random.Generator) -> Image:
    """Far out of focus, by a thirtieth of the width, with the sensor's noise."""
    sharp = image.astype(np.float32)
    smooth = np.asarray(cv2.GaussianBlur(sharp, (0, 0), image.shape[1] / 30.0), dtype=np.float32)
    return np.clip(smooth + rng.normal(0.0, 1.5, image.shape), 0, 255).astype(np.uint8)


def covered(image: Image, rng: np.random.Generator) -> Image:
    """A lens under blotches of dirt, but for a twentieth of the view."""
    height, width = image.shape
    spots = rng.normal(0.0, 1.0, image.shape)
    dirt = np.asarray(cv2.GaussianBlur(spots, (0, 0), width / 60.0), dtype=np.float64)
    result: Image = np.clip(40.0 + 20.0 * dirt / float(dirt.std()), 0, 255).astype(np.uint8)
    window = slice(height // 2, height // 2 + height // 5), slice(width // 8, width // 8 + width // 4)
    result[window] = image[window]
    return result


SPOILERS: dict[str, Spoiler] = {"noise": noise, "black": black, "blurred": blurred, "lens covered": covered}
