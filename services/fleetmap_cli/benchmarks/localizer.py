"""``fleetmap benchmark localizer``: a second vehicle in the first one's map, and what that takes."""

from __future__ import annotations

from fleetmap_cli.benchmarks import (
    localizer_catalogue,
    localizer_drives,
    localizer_gaps,
    localizer_honesty,
    localizer_size,
    localizer_speed,
    localizer_start,
)
from fleetmap_cli.benchmarks.row import Benchmark

BENCHMARK = Benchmark(
    "localizer",
    "images of one vehicle in the maps of another",
    (
        *localizer_drives.ROWS,
        *localizer_catalogue.ROWS,
        *localizer_gaps.ROWS,
        *localizer_honesty.ROWS,
        *localizer_size.ROWS,
        *localizer_speed.ROWS,
        *localizer_start.ROWS,
    ),
    shares_work=True,
)
