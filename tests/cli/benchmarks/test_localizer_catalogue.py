"""The catalogue that cold queries are asked in: long enough, with streets that look alike, and judged strictly."""

from __future__ import annotations

from pathlib import Path

import pytest

from fleetmap_cli.benchmarks import localizer_catalogue
from fleetmap_cli.benchmarks.localizer_catalogue import Catalogue, counted, verdict_of
from fleetmap_cli.benchmarks.workbench import Workbench

TRUTH = "# epsg=32632\n1.0 700000.0 5400000.0 400.0 0 0 0 1\n3.0 700020.0 5400000.0 400.0 0 0 0 1\n"


@pytest.fixture
def bench(tmp_path: Path) -> Workbench:
    for name in ("city-1-0-query.reference.tum", "survey.tum"):
        (tmp_path / name).write_text(TRUTH)
    return Workbench(tmp_path, tmp_path, tmp_path)


def answer(map_id: str | None, easting_m: float, recording: str = "city-1-0-query") -> dict[str, object]:
    described: dict[str, object] = {"recording": recording, "stamp_ns": 2_000_000_000, "duration_s": 0.05}
    if map_id is None:
        return described | {"reason": "no place"}
    return described | {"map": map_id, "position_m": [easting_m, 5400000.0, 400.0]}


@pytest.mark.parametrize("recording", ["city-1-0-query", "second"])
def test_a_pose_is_right_within_two_metres_in_the_right_map(bench: Workbench, recording: str) -> None:
    right_map = "city-1-0-map" if recording != "second" else "survey-map"
    verdicts = [
        verdict_of(bench, answer(map_id, easting_m, recording), right_map)
        for map_id, easting_m in (
            (right_map, 700010.0),
            (right_map, 700011.9),
            (right_map, 700012.1),
            ("other-map", 700010.0),
            (None, 0.0),
        )
    ]
    assert verdicts == ["right", "right", "wrong place", "wrong map", "none"]


def test_figures_tell_twins_from_others() -> None:
    figures = counted(["right", "none", "right", "wrong map"], [True, True, False, False])
    assert figures["queries"] == 4
    assert (figures["right"], figures["right %"]) == (2, 50.0)
    assert (figures["wrong map"], figures["wrong place"]) == (1, 0)
    assert (figures["twins right %"], figures["others right %"]) == (50.0, 50.0)
    assert counted(["right"], [False])["twins right %"] is None


def test_the_catalogue_has_ten_kilometres_and_twins_among_them() -> None:
    catalogue = Catalogue()
    assert 10.0 <= catalogue.kilometres < 15.0
    twins = [street for street in catalogue.streets if catalogue.is_twin(street)]
    assert 4 <= len(twins) <= len(catalogue.streets) // 3
    names = [street.name for street in catalogue.streets]
    assert len(set(names)) == len(names)


def test_the_row_says_what_it_asks_for() -> None:
    row = localizer_catalogue.ROWS[0]
    assert row.name == "cold-10km"
    assert "no wrong map" in row.reach
    assert len(row.needs) == 2
    assert not localizer_catalogue.cold_row(Catalogue(with_real_drives=False)).needs
