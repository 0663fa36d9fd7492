"""``fleetmap benchmark mapper``: maps of real and simulated drives, beside peers and splines through the fixes."""

from __future__ import annotations

from collections.abc import Sequence

from fleetmap_cli.benchmarks.mapper_ablation import MODES, ablation_rows
from fleetmap_cli.benchmarks.mapper_drives import Circuit
from fleetmap_cli.benchmarks.mapper_gnss import consumer_rows, gnss_rows
from fleetmap_cli.benchmarks.mapper_plain import plain_rows
from fleetmap_cli.benchmarks.mapper_speed import speed_row
from fleetmap_cli.benchmarks.mapper_stress import stress_rows
from fleetmap_cli.benchmarks.row import Benchmark


def mapper_benchmark(circuit: Circuit, modes: Sequence[str] = MODES) -> Benchmark:
    """All rows, around a circuit; the ablation compares some modes of --gnss."""
    return Benchmark(
        "mapper",
        "maps of real drives and of a simulated circuit, beside their peers and splines through the same fixes",
        (
            *plain_rows(circuit),
            *gnss_rows(circuit),
            *consumer_rows(circuit),
            *stress_rows(circuit),
            *ablation_rows(circuit, modes),
            speed_row(),
        ),
        shares_work=True,
    )


BENCHMARK = mapper_benchmark(Circuit())
