import dataclasses

import pytest

from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.errors import InvalidInputError

FIELDS = dataclasses.fields(EstimatorConfig)


@pytest.mark.parametrize("field", FIELDS, ids=lambda field: field.name)
def test_every_field_is_documented(field):
    assert field.metadata["description"].endswith(".")
    if isinstance(field.default, float | int) and not isinstance(field.default, bool):
        assert field.metadata["range"] is not None
    if field.name.endswith("_m"):
        assert field.metadata["unit"] == "m"
    if field.name.endswith("_m_s"):
        assert field.metadata["unit"] == "m/s"
    elif field.name.endswith("_s"):
        assert field.metadata["unit"] == "s"


@pytest.mark.parametrize("field", [f for f in FIELDS if f.metadata["range"]], ids=lambda field: field.name)
def test_both_ends_of_a_range_are_allowed_and_no_more(field):
    low, high = field.metadata["range"]
    kind = type(field.default)
    EstimatorConfig(**{field.name: kind(low)})
    EstimatorConfig(**{field.name: kind(high)})
    for outside in (kind(low - 1), kind(high + 1)):
        with pytest.raises(InvalidInputError, match=f"parameter {field.name}: expected {low} to {high}"):
            EstimatorConfig(**{field.name: outside})


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"device": "tpu"}, "expected one of auto, cuda, cpu, got 'tpu'"),
        ({"default_sigma_m": float("nan")}, "got nan m"),
        ({"default_sigma_m": "1 mm"}, "expected float, got '1 mm'"),
        ({"autostart": 1}, "expected bool, got 1"),
        ({"minimum_points": True}, "expected int, got True"),
        ({"organ": None}, "expected str, got None"),
    ],
)
def test_values_that_cannot_be_meant_are_refused(values, message):
    with pytest.raises(InvalidInputError, match=message):
        EstimatorConfig(**values)
