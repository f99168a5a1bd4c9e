# SPDX-License-Identifier: GPL-3.0-or-later
"""JSON of files is compared with a description, and the path of the first wrong value is named."""

import pytest

from fdda_addon.core.json_check import COUNT, NUMBER, POSITIVE, Interval, check_json

DESCRIPTION = {
    "name": str,
    "is_key?": bool,
    "count": COUNT,
    "joints": [range(-1, 3)],
    "kind": {"hard", "smooth"},
    "error": (NUMBER, None),
    "unit?": POSITIVE,
    "sources": {str: [{"factor": Interval(1, 4)}]},
}
VALUE = {
    **{"name": "a", "count": 3, "joints": [-1, 2], "kind": "hard", "error": 0.5, "other": []},
    **{"sources": {"b": [{"factor": 2}]}},
}


@pytest.mark.parametrize("change", [{}, {"error": None}, {"is_key": True, "unit": 0.01}, {"joints": [], "sources": {}}])
def test_a_value_as_described_is_accepted(change):
    check_json(VALUE | change, DESCRIPTION)


@pytest.mark.parametrize(
    ("value", "words"),
    [
        ([], "it is []"),
        ({"name": "a"}, "it lacks 'count'"),
        (VALUE | {"name": 3}, "name is 3"),
        (VALUE | {"name": None}, "name is None"),
        (VALUE | {"is_key": 1}, "is_key is 1"),
        (VALUE | {"count": -1}, "count is -1"),
        (VALUE | {"count": True}, "count is True"),
        (VALUE | {"count": 1.0}, "count is 1.0"),
        (VALUE | {"count": 10**30}, "count is 1000000000000000000000000000000"),
        (VALUE | {"joints": {}}, "joints is {}"),
        (VALUE | {"joints": [0, 3]}, "joints[1] is 3"),
        (VALUE | {"kind": []}, "kind is []"),
        (VALUE | {"error": float("nan")}, "error is nan"),
        (VALUE | {"error": True}, "error is True"),
        (VALUE | {"unit": 0}, "unit is 0"),
        (VALUE | {"unit": float("inf")}, "unit is inf"),
        (VALUE | {"sources": {"b": [{"factor": "2"}]}}, "sources.b[0].factor is '2'"),
        (VALUE | {"sources": {"b": [{}]}}, "sources.b[0] lacks 'factor'"),
    ],
)
def test_another_value_is_refused_with_its_path(value, words):
    with pytest.raises(ValueError, match=r".") as error:
        check_json(value, DESCRIPTION)
    assert str(error.value) == words


def test_a_long_value_is_quoted_in_part():
    with pytest.raises(ValueError, match=r"^it is \['x+\.\.\.x+'\]$") as error:
        check_json(["x" * 10**6], {})
    assert len(str(error.value)) < 100
