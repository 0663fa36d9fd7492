"""A row of ``fleetmap benchmark server``: a catalogue of 100,000 maps, how soon it opens and answers."""

from __future__ import annotations

import hashlib
import sys
import time
import urllib.request
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, redirect_stdout
from dataclasses import dataclass
from functools import partial
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from fleetmap.footprint import bounding_box
from fleetmap.manifest import Manifest, PartRecord, parse_manifest
from fleetmap_cli.benchmarks.made_map import made_map
from fleetmap_cli.benchmarks.postgresql_cluster import postgresql_cluster
from fleetmap_cli.benchmarks.row import Figures
from fleetmap_cli.benchmarks.workbench import CannotMeasureHereError, Workbench
from fleetmap_cli.demo_processes import running_map_server
from fleetmap_server.catalogue import Catalogue
from fleetmap_server.database import Database
from fleetmap_server.search import MapSearch

MAPS = 100_000
_POSTGRESQL_MAPS = 10_000  # more take it an hour to be added
_CITIES, _CITY_SIGMA_DEG = 300, 0.15
_POSITIONS, _STEP_DEG = 60, 3e-4  # of a trajectory: 2 km
_PARTS = 8
_ADDED_AT_ONCE = 1000
_QUERIES, _PAGES, _LIMIT = 400, 40, 10
_YEAR_NS = 365 * 86_400 * 1_000_000_000


@dataclass(frozen=True)
class _World:
    """Cities of very different sizes, as longitude and latitude, and how large a share of the maps each has."""

    cities_lonlat: NDArray[np.float64]  # (C, 2)
    shares: NDArray[np.float64]  # (C,)

    def places(self, count: int, rng: np.random.Generator) -> NDArray[np.float64]:
        """Somewhere in cities, more often in those with many maps; (count, 2)."""
        of = rng.choice(len(self.shares), size=count, p=self.shares)
        return self.cities_lonlat[of] + rng.normal(0.0, _CITY_SIGMA_DEG, (count, 2))


def catalogue(bench: Workbench) -> Figures:
    """Fill a catalogue and ask it; the same on PostgreSQL, where it is installed, as a line of its own."""
    bench.shown("fleetmap benchmark server --rows catalogue-100k")
    folder = bench.folder / "maps"
    folder.mkdir()
    with closing(Database(f"sqlite:///{folder / 'catalogue.sqlite'}")) as database:
        figures = _measured(Catalogue(database), MAPS)
    figures |= _served(bench)
    try:
        with postgresql_cluster() as cluster, closing(Database(cluster.new_database())) as database:
            bench.lines["PostgreSQL"] = _measured(Catalogue(database), _POSTGRESQL_MAPS)
    except CannotMeasureHereError as error:
        bench.lines["PostgreSQL"] = {"not measured": str(error)}
    return figures


def _measured(catalogue: Catalogue, maps: int) -> Figures:
    rng = np.random.default_rng(7)
    world = _world(rng)
    fill_s = _timed(lambda: _fill(catalogue, _manifests(world, rng, maps)))
    cities = [_box(place, 0.1) for place in world.places(_QUERIES, rng)]
    halves = [(west, -90.0, west + 180.0, 90.0) for west in rng.uniform(-180.0, 0.0, _QUERIES)]
    found = [len(catalogue.search(MapSearch(box=box, limit=_LIMIT)).entries) for box in cities]  # warms up, too
    city_ms = _searched_ms(catalogue, [MapSearch(box=box, limit=_LIMIT) for box in cities])
    half_ms = _searched_ms(catalogue, [MapSearch(box=box, limit=_LIMIT) for box in halves])
    page_ms = _searched_ms(catalogue, [MapSearch(limit=_LIMIT)] * _PAGES)
    return {
        "maps": catalogue.count(),
        "city box p50 ms": round(float(np.percentile(city_ms, 50)), 2),
        "city box p99 ms": round(float(np.percentile(city_ms, 99)), 2),
        "half world p50 ms": round(float(np.percentile(half_ms, 50)), 2),
        "half world p99 ms": round(float(np.percentile(half_ms, 99)), 2),
        "first page p99 ms": round(float(np.percentile(page_ms, 99)), 2),
        "added per s": round(maps / fill_s),
        "found per city box": round(float(np.mean(found)), 1),
    }


def _searched_ms(catalogue: Catalogue, searches: Iterable[MapSearch]) -> list[float]:
    return [1e3 * _timed(partial(catalogue.search, search)) for search in searches]


def _served(bench: Workbench) -> Figures:
    """What a client sees of a server with this catalogue."""
    started = time.perf_counter()
    with redirect_stdout(sys.stderr), running_map_server("maps", bench.folder) as server:
        start_s = time.perf_counter() - started
        url = f"{server.http_url.rstrip('/')}/collections/maps/items?limit={_LIMIT}"
        first_ms = 1e3 * _timed(lambda: _fetch(url))
        page_ms = [1e3 * _timed(lambda: _fetch(url)) for _ in range(_PAGES)]
    return {
        "serving after s": round(start_s, 2),
        "very first HTTP page ms": round(first_ms, 1),
        "HTTP page p50 ms": round(float(np.percentile(page_ms, 50)), 1),
        "HTTP page p99 ms": round(float(np.percentile(page_ms, 99)), 1),
    }


def _fetch(url: str) -> None:
    with urllib.request.urlopen(url) as answer:
        answer.read()


def _fill(catalogue: Catalogue, manifests: Iterable[Manifest]) -> None:
    left = iter(manifests)
    while batch := list(islice(left, _ADDED_AT_ONCE)):
        with catalogue.database.writing() as connection:
            for manifest in batch:
                catalogue.add(connection, manifest, _sha256(manifest.map_id), 10_000, None)


def _world(rng: np.random.Generator) -> _World:
    cities = np.column_stack((rng.uniform(-175.0, 175.0, _CITIES), rng.uniform(-50.0, 65.0, _CITIES)))
    weights = 1.0 / np.arange(1, _CITIES + 1)
    return _World(cities, weights / weights.sum())


def _manifests(world: _World, rng: np.random.Generator, maps: int) -> Iterator[Manifest]:
    template = parse_manifest(made_map("template", (1000,)).manifest_bytes, "the made map")
    for number, place in enumerate(world.places(maps, rng)):
        headings = rng.uniform(0.0, 2.0 * np.pi) + np.cumsum(rng.normal(0.0, 0.15, _POSITIONS))
        path = place + _STEP_DEG * np.cumsum(np.column_stack((np.cos(headings), np.sin(headings))), axis=0)
        start_ns = int(rng.integers(0, 3 * _YEAR_NS))
        times = {"start_ns": start_ns, "end_ns": start_ns + 600_000_000_000}
        size = {"length_m": float(rng.uniform(500.0, 5000.0)), "landmarks": int(rng.integers(10**4, 10**6))}
        yield template.model_copy(
            update={
                "map_id": f"map-{number:06d}",
                "bbox_lonlat": bounding_box(path),
                "trajectory_lonlat": tuple(map(tuple, path.round(7).tolist())),
                "parts": _parts(number),
                "provenance": template.provenance.model_copy(update=times),
                "quality": template.quality.model_copy(update=size),
            }
        )


def _parts(number: int) -> tuple[PartRecord, ...]:
    return tuple(
        PartRecord.model_construct(
            kind="cell", sha256=_sha256(f"{number}/{cell}"), size_bytes=200_000, cell=(cell, number),
            keyframes=5, landmarks=500,
        )
        for cell in range(_PARTS)
    )  # fmt: skip


def _sha256(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def _box(place_lonlat: NDArray[np.float64], size_deg: float) -> tuple[float, float, float, float]:
    lon, lat = (float(degrees) for degrees in place_lonlat)
    return (lon - size_deg / 2, lat - size_deg / 2, lon + size_deg / 2, lat + size_deg / 2)


def _timed(work: Callable[[], object]) -> float:
    started = time.perf_counter()
    work()
    return time.perf_counter() - started
