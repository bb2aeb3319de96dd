"""A result file in which anything stands in another's place: a result or one sentence."""

import json

import pytest

from support.built_results import make_single, make_snake
from undulog.analysis import load
from undulog.capture.common.errors import DataError

OTHERS = [[], ["a", "b"], {}, {"a": 1}, "word", 3, 2.5, True, None]


def places(value, path=()):
    """Every path to a value in JSON."""
    yield path
    inside = value.items() if isinstance(value, dict) else ()
    inside = enumerate(value[:2]) if isinstance(value, list) else inside
    for key, inner in inside:
        yield from places(inner, (*path, key))


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    path = tmp_path_factory.mktemp("whole") / "snake.json"
    result = make_snake()
    result.save(path)
    assert load(path) == result
    return json.loads(path.read_text())


@pytest.mark.slow
@pytest.mark.parametrize("other", OTHERS, ids=repr)
def test_whatever_stands_there_it_is_a_result_or_a_sentence(other, whole, tmp_path):
    path, refused = tmp_path / "x.json", 0
    paths = [place for place in places(whole) if place]
    for place in paths[:: max(1, len(paths) // 15)]:
        data = json.loads(json.dumps(whole))
        node = data
        for key in place[:-1]:
            node = node[key]
        node[place[-1]] = other
        path.write_text(json.dumps(data))
        sentence = ""
        try:
            load(path)
        except DataError as error:
            sentence = str(error)
        assert not sentence or str(path) in sentence, place
        refused += bool(sentence)
    assert refused > 5


def test_a_text_is_no_list_of_letters(tmp_path):
    path = tmp_path / "x.json"
    make_single().save(path)
    data = json.loads(path.read_text())
    lists = [
        place
        for place in places(data)
        if place and isinstance(_at(data, place), list) and _at(data, place)
    ]
    assert lists
    for place in lists:
        changed = json.loads(json.dumps(data))
        _at(changed, place[:-1])[place[-1]] = "abc"
        path.write_text(json.dumps(changed))
        with pytest.raises(DataError, match="'abc' where"):
            load(path)


def _at(value, place):
    for key in place:
        value = value[key]
    return value
