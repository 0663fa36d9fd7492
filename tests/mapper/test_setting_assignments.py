"""Settings on the command line: the right one changes, and nothing else is understood."""

from __future__ import annotations

import pytest

from fleetmap.errors import InputError
from fleetmap_mapper.setting_assignments import with_assignments
from fleetmap_mapper.settings import MapperSettings


def test_what_is_named_changes_and_nothing_else():
    changed = with_assignments(
        MapperSettings(seed=3), ["quality.min_posed_ratio=0.9", "quality.weak_ties=7", "gnss.mode=final"]
    )
    before, after = MapperSettings(seed=3).model_dump(), changed.model_dump()
    assert (after["quality"]["min_posed_ratio"], after["quality"]["weak_ties"], after["seed"]) == (0.9, 7, 3)
    before["quality"] |= {"min_posed_ratio": 0.9, "weak_ties": 7}
    before["gnss"]["mode"] = "final"
    assert after == before


def test_the_last_word_counts_and_no_word_changes_nothing():
    assert with_assignments(MapperSettings(), ["seed=1", "seed=2"]).seed == 2
    assert with_assignments(MapperSettings(), []) == MapperSettings()


@pytest.mark.parametrize(
    ("assignment", "message"),
    [
        ("quality.min_posed_ratio", "sets nothing; write GROUP.NAME=VALUE"),
        ("quality.min_posed=0.9", "no mapper setting 'quality.min_posed'; 'quality' has min_posed_ratio, "),
        ("qualty.min_posed_ratio=0.9", "no mapper setting 'qualty.min_posed_ratio'; the groups are features, "),
        ("quality=0.9", "no mapper setting 'quality'; the groups are features, "),
        ("quality.min_posed_ratio.x=1", "no mapper setting 'quality.min_posed_ratio.x'; the groups are "),
        ("seed.x=1", "no mapper setting 'seed.x'; the groups are "),
        ("=1", "no mapper setting ''; the groups are "),
        ("quality.min_posed_ratio=much", "'quality.min_posed_ratio' cannot be 'much': "),
        ("quality.min_posed_ratio=1.5", "'quality.min_posed_ratio' cannot be 1.5: "),
        ("quality.max_unposed_gap_s=.inf", "'quality.max_unposed_gap_s' cannot be inf: "),
        ("quality.max_unposed_gap_s=", "'quality.max_unposed_gap_s' cannot be None: "),
        ("gnss.mode=some", "'gnss.mode' cannot be 'some': "),
        ("quality.min_posed_ratio={", "the value of 'quality.min_posed_ratio={' cannot be read"),
        ("quality.min_posed_ratio=[1, 2]", "cannot be [1, 2]: "),
    ],
)
def test_what_cannot_be_set_is_refused_in_one_line(assignment, message):
    with pytest.raises(InputError) as refusal:
        with_assignments(MapperSettings(), [assignment])
    assert message in str(refusal.value)
    assert "\n" not in str(refusal.value)
