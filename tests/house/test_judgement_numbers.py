"""The judgement rests on few numbers, each with its source."""

import ast

import pytest

from support.paths import ROOT

ROOMS = ("capture/judgement", "analysis/parts/comparison", "analysis/parts/judgement")
MOST = 40
PLAIN = {-1, 0, 1, 2}
UNITS = {100, 1000}  # percent, and thousandths
SOURCES = sorted(path for room in ROOMS for path in (ROOT / room).glob("*.py"))


def numbers_of(tree):
    """Return the nodes of numeric literals that are neither plain nor factors of units."""
    return [
        node
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant)
        and isinstance(node.value, int | float | complex)
        and not isinstance(node.value, bool)
        and node.value not in PLAIN | UNITS
    ]


def test_the_judgement_has_few_numbers():
    numbers = {
        f"{path.relative_to(ROOT)}:{node.lineno}": node.value
        for path in SOURCES
        for node in numbers_of(ast.parse(path.read_text()))
    }
    assert {path.parent for path in SOURCES} == {ROOT / room for room in ROOMS}
    assert 0 < len(numbers) <= MOST, numbers


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: f"{path.parent.name}/{path.name}")
def test_constants_have_a_source(path):
    """A constant of a module that holds a number has a docstring."""
    body = ast.parse(path.read_text()).body
    for node, following in zip(body, [*body[1:], None], strict=True):
        if isinstance(node, ast.Assign) and numbers_of(node):
            is_text = isinstance(following, ast.Expr) and isinstance(following.value, ast.Constant)
            assert is_text, f"{path.name}:{node.lineno}"


def test_numbers_are_counted_in_defaults_tables_and_exponents():
    tree = ast.parse("A = {3: 4.5}\ndef f(x=7, y=-5): return x ** 0.5 + 100 * y - 2")
    assert sorted(node.value for node in numbers_of(tree)) == [0.5, 3, 4.5, 5, 7]
