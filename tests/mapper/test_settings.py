from __future__ import annotations

import json

import pytest
from pydantic import ValidationError

from fleetmap_mapper.settings import FeatureGroup, GnssGroup, MapperSettings


def test_settings_travel_as_json_in_a_maps_provenance_and_come_back():
    settings = MapperSettings(seed=7, gnss=GnssGroup(mode="final"), features=FeatureGroup(count=1234))
    text = json.dumps(settings.model_dump(mode="json"))
    assert MapperSettings.model_validate_json(text) == settings != MapperSettings()


def test_a_misspelt_setting_is_refused():
    with pytest.raises(ValidationError, match="cuont"):
        MapperSettings.model_validate({"features": {"cuont": 3000}})


@pytest.mark.parametrize("text", ['{"gnss": {"mode": "perhaps"}}', '{"features": {"count": 10}}'])
def test_a_value_that_cannot_be_is_refused(text):
    with pytest.raises(ValidationError):
        MapperSettings.model_validate_json(text)


def test_settings_cannot_be_changed_afterwards():
    with pytest.raises(ValidationError):
        MapperSettings().seed = 3
