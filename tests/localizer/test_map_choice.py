"""Which of several maps of one place is looked into."""

from __future__ import annotations

from types import SimpleNamespace

from fleetmap_localizer.map_choice import MapOffer, Way, choose_maps

EAST, WEST = 0, 2


def offer(map_id: str, end_ns: int) -> MapOffer:
    return MapOffer(SimpleNamespace(map_id=map_id, end_ns=end_ns, version=map_id), SimpleNamespace())  # type: ignore[arg-type]


def road(first: int, last: int, keyframes: float = 10.0, direction: int = EAST) -> dict[Way, float]:
    return {(32632, (number, 7), direction): keyframes for number in range(first, last + 1)}


OLD, NEW = offer("old", 1), offer("new", 2)


def names(chosen: list[MapOffer]) -> list[str]:
    return [each.entry.map_id for each in chosen]


def test_of_two_maps_that_show_the_same_the_newer_is_taken_alone() -> None:
    for shown in ([(OLD, road(0, 4)), (NEW, road(0, 4))], [(NEW, road(0, 4, 8.0)), (OLD, road(0, 4))]):
        assert names(choose_maps(shown, set(), 9)) == ["new"]


def test_the_best_coverage_counts_more_than_the_date() -> None:
    assert names(choose_maps([(OLD, road(0, 9)), (NEW, road(0, 3))], set(), 9)) == ["old"]


def test_a_map_in_use_stays_until_it_shows_less_than_half() -> None:
    assert names(choose_maps([(OLD, road(0, 5)), (NEW, road(0, 9))], {"old"}, 1)) == ["old"]
    assert names(choose_maps([(OLD, road(0, 3)), (NEW, road(0, 9))], {"old"}, 1)) == ["new"]
    assert names(choose_maps([(OLD, road(0, 9)), (NEW, road(0, 9))], {"old"}, 1)) == ["old"]


def test_where_one_map_ends_the_next_is_there_too() -> None:
    assert set(names(choose_maps([(OLD, road(0, 4)), (NEW, road(4, 7))], set(), 9))) == {"old", "new"}
    assert len(choose_maps([(OLD, road(0, 4)), (NEW, road(4, 7))], set(), 1)) == 1


def test_the_other_direction_of_a_road_is_another_view() -> None:
    shown = [(OLD, road(0, 4, direction=WEST)), (NEW, road(0, 4))]
    assert set(names(choose_maps(shown, set(), 9))) == {"old", "new"}


def test_where_there_is_nothing_nothing_is_chosen() -> None:
    assert choose_maps([], set(), 9) == []
    assert choose_maps([(OLD, {})], {"old"}, 9) == []
