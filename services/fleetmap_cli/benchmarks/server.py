"""``fleetmap benchmark server``: how fast, how patiently and how fairly the map server serves."""

from __future__ import annotations

from fleetmap_cli.benchmarks.row import Benchmark, Row
from fleetmap_cli.benchmarks.server_catalogue import catalogue
from fleetmap_cli.benchmarks.server_fleet import fleet
from fleetmap_cli.benchmarks.server_links import links, restart
from fleetmap_cli.benchmarks.server_transfer import fetch, million

BENCHMARK = Benchmark(
    "server",
    "the map server under load, over loopback",
    (
        Row(
            "fetch",
            "a map of 100 MB for one client; as much over plain TCP between two processes, in turns with it",
            fetch,
            reach="transfer / raw TCP >= 0.6, stored / TCP stored >= 0.8",
        ),
        Row(
            "fleet",
            "200 vehicles, each asking for a tile of 200 kB every 10 s, while 100 MB are fetched over and over",
            fleet,
            reach="no errors, none starved, p99 <= 250 ms",
        ),
        Row(
            "links",
            "maps over links of 2 MB/s and 100 kB/s; with stalls of 7 s and 30 s and two cut connections",
            links,
            reach="all whole, smallest share of the link >= 0.8",
        ),
        Row(
            "restart",
            "the server killed twice and started again under 50 downloads of 20 MB",
            restart,
            reach="all finished and verified",
        ),
        Row(
            "catalogue-100k",
            "a catalogue of 100,000 maps: boxes of 0.1 degrees in cities and of half the world, pages, start-up",
            catalogue,
            reach="SQLite: boxes p99 <= 5 ms, HTTP page <= 50 ms, serving after <= 2 s",
        ),
        Row(
            "million",
            "a map of 1,000,000 landmarks published and listed, one cell of 128 m fetched",
            million,
            reach="server peak <= 300 MB",
        ),
    ),
)
