"""Small worlds for the simulation's tests."""

from __future__ import annotations

from dataclasses import replace

import pytest

from fleetmap.camera import Camera
from fleetmap.simulation.street import Street, anchor_at, build_street

SMALL = Camera(320, 120, 185.0, 186.0, 158.3, 57.9)
DISTORTED = Camera(320, 120, 185.0, 186.0, 158.3, 57.9, (-0.32, 0.14, 0.0015, -0.001, -0.03))


@pytest.fixture(params=[SMALL, DISTORTED], ids=["pinhole", "plumb_bob"])
def camera(request: pytest.FixtureRequest) -> Camera:
    """A small camera, ideal and distorted."""
    camera: Camera = request.param
    return camera


@pytest.fixture(scope="session")
def street() -> Street:
    """A short street."""
    return build_street(5, 40.0)


@pytest.fixture(scope="session")
def meridian_street(street: Street) -> Street:
    """The same street on the central meridian, where a grid metre is 0.4 mm more than one on the ground."""
    return replace(street, anchor=anchor_at(48.77, 9.0, 420.0))
