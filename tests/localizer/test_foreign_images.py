"""What is no image of the mapped street has no pose, neither on its own nor where a track could have gone on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fleetmap_cli.benchmarks.foreign_images import SPOILERS, alone_and_after
from fleetmap_localizer.localizer import Localizer
from fleetmap_localizer.map_view import LocalizableMap, MapView
from fleetmap_localizer.settings import LocalizerSettings


@pytest.fixture
def street_localizer(mapped_street, second_drive) -> Localizer:
    source = LocalizableMap("street", "v", mapped_street.manifest.camera.to_camera(), mapped_street.content)
    settings = LocalizerSettings()
    return Localizer(second_drive.camera, (MapView(source, second_drive.camera, settings),), settings)


def test_another_street_and_spoilt_images_have_no_pose(street_localizer, second_drive, foreign_drive) -> None:
    good = second_drive.frames[:3]
    asked = [("another street", frame) for frame in foreign_drive.frames[:4]]
    asked += [(kind, second_drive.frames[3 + n]) for n, kind in enumerate(SPOILERS)]
    spoilt = [
        (kind, replace(f, image=SPOILERS[kind](f.image, np.random.default_rng(1))))
        if kind in SPOILERS
        else (kind, f)
        for kind, f in asked
    ]
    answers = list(alone_and_after(street_localizer, good, spoilt))
    assert len(answers) == 2 * len(asked)  # every one of them after a track as well
    assert [answer.kind for answer in answers if answer.is_posed] == []


def test_unspoilt_images_of_the_street_do_have_one(street_localizer, second_drive) -> None:
    """What the test above is worth."""
    good = second_drive.frames[:3]
    answers = list(alone_and_after(street_localizer, good, [("itself", second_drive.frames[2])]))
    assert [answer.is_posed for answer in answers] == [True, True]
