"""Small worlds for the simulation's tests."""

from __future__ import annotations

import pytest

from fleetmap.camera import Camera
from fleetmap.simulation.street import Street, build_street

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
