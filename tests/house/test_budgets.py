"""Sizes that keep the tree readable: modules, functions, nesting."""

import ast

import pytest

import undulog
from support.paths import ROOT

PRODUCT = ("capture", "sim", "analysis", "replay", "undulog")
SOURCES = sorted(
    path
    for folder in PRODUCT
    for path in (ROOT / folder).rglob("*.py")
    if folder != "undulog" or path.parent == ROOT / folder  # its folders are links to the others
)
MODULE_LINES, FUNCTION_LINES = 500, 80
DEEP, DEEP_SHARE = 4, 0.01
VERBS, OPTIONS = 45, 330
KERNELS = {"sim/batch/body.py": "passes over a tree of links, compiled as one loop each"}
"""Modules whose functions are compiled, and may be longer."""
BLOCKS = (ast.If, ast.For, ast.While, ast.With, ast.Try, ast.Match)


def functions_of(path):
    """Return all functions of a module."""
    tree = ast.parse(path.read_text())
    return [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]


def length_of(function):
    """Return the lines of a function's body without its docstring, which says much for some."""
    body = function.body[bool(ast.get_docstring(function)) :]
    return body[-1].end_lineno - body[0].lineno + 1 if body else 0


def depth_of(node):
    """Return how many blocks stand in each other at most; ``elif`` is no deeper than its ``if``."""
    depths = [0]
    for name, field in ast.iter_fields(node):
        for child in field if isinstance(field, list) else [field]:
            if not isinstance(child, ast.AST):
                continue
            is_elif = isinstance(node, ast.If) and name == "orelse" and isinstance(child, ast.If)
            depths.append(depth_of(child) + (isinstance(child, BLOCKS) and not is_elif))
    return max(depths)


@pytest.mark.parametrize("folder", PRODUCT)
def test_modules_are_short(folder):
    lengths = {
        str(path.relative_to(ROOT)): len(path.read_text().splitlines())
        for path in SOURCES
        if path.is_relative_to(ROOT / folder)
    }
    assert lengths
    assert {name: n for name, n in lengths.items() if n > MODULE_LINES} == {}


def test_functions_are_short():
    long = {
        f"{path.relative_to(ROOT)}:{node.name}": length_of(node)
        for path in SOURCES
        if str(path.relative_to(ROOT)) not in KERNELS
        for node in functions_of(path)
        if length_of(node) > FUNCTION_LINES
    }
    assert long == {}


def test_few_functions_are_nested_deeply():
    depths = [depth_of(node) for path in SOURCES for node in functions_of(path)]
    assert sum(depth >= DEEP for depth in depths) <= DEEP_SHARE * len(depths)


def test_constants_stand_above_the_functions():
    """Except those that are made by a function or class of their module."""
    below = []
    for path in SOURCES:
        ours, after = set(), False
        for node in ast.parse(path.read_text()).body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                ours.add(node.name)
                after |= isinstance(node, ast.FunctionDef)
            elif isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
                targets = node.targets if isinstance(node, ast.Assign) else [node.target]
                parts = (part for target in targets for part in ast.walk(target))
                names = {part.id for part in parts if isinstance(part, ast.Name)}
                names -= {"__all__", "__getattr__"}
                used = {name.id for name in ast.walk(node.value) if isinstance(name, ast.Name)}
                if used & ours:
                    ours |= names
                elif after and names:
                    below.append(f"{path.relative_to(ROOT)}:{node.lineno}")
    assert below == []


def test_the_command_line_stays_small():
    options = 0
    for verb in undulog.VERBS:
        command = undulog.build(verb.split())
        for word in verb.split():
            command = command[word]
        names = (str(argument.name) for argument in command.assemble_argument_collection())
        options += sum(name.startswith("--") for name in names)
    assert len(undulog.VERBS) <= VERBS
    assert 200 < options <= OPTIONS
