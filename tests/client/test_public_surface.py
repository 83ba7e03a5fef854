"""What `crkr.client` promises is what it has."""

import types

import pytest

import crkr.client


def test_every_promised_name_is_bound_and_nothing_else_is_public() -> None:
    for name in crkr.client.__all__:
        assert getattr(crkr.client, name).__name__ == name
    bound = {
        name
        for name, value in vars(crkr.client).items()
        if not name.startswith("_")
        and not isinstance(value, types.ModuleType)
        and name not in {"TYPE_CHECKING", "annotations"}
    }
    assert bound == set(crkr.client.__all__)
    assert set(crkr.client.__all__) <= set(dir(crkr.client))


def test_another_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="Mirage"):
        _ = crkr.client.Mirage
