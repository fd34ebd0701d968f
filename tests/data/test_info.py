"""The description of a data set survives JSON and refuses nonsense."""

import json

import pytest

from i2i.data.info import DataInfo


def test_round_trip_through_json():
    info = DataInfo(("a", "b"), ("none", "z"), 3, 64, "rgb", source="x", symmetry_stripped=False)
    assert DataInfo.from_dict(json.loads(json.dumps(info.to_dict()))) == info
    assert DataInfo.from_dict({**info.to_dict(), "from_the_future": 1}) == info


@pytest.mark.parametrize(
    ("names", "symmetry"), [((), ()), (("a",), ()), (("a",), ("y",)), (("a",), ("z", "z"))]
)
def test_nonsense_is_refused(names, symmetry):
    with pytest.raises(ValueError, match=r"class name|symmetr"):
        DataInfo(names, symmetry, 1, 64, "gray")
