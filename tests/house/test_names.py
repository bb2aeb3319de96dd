"""Names say what a thing is, and a name of a class means one thing."""

import ast
from collections import defaultdict

import pytest

from support.paths import ROOT

PRODUCT = ("capture", "sim", "analysis", "replay", "undulog")
FOLDERS = (*PRODUCT, "bench", "studies", "tests", "docs", ".ci")
EMPTY = frozenset({"one", "found", "known", "own", "each", "said", "wanted", "told"})
"""Words that say nothing of a joint, a series or a result."""
PUBLIC_KEYS = {("capture/log/health/contract.py", "found")}
"""A field that is a key of the JSON of ``log check``."""

NAME_IN = {
    ast.Name: "id",
    ast.Attribute: "attr",
    ast.arg: "arg",
    ast.alias: "asname",
    ast.FunctionDef: "name",
    ast.AsyncFunctionDef: "name",
    ast.ClassDef: "name",
    ast.ExceptHandler: "name",
    ast.MatchAs: "name",
    ast.MatchStar: "name",
    ast.MatchMapping: "rest",
}
"""Parts of the syntax that give a name, unless they only load it, and where they have it."""


def bindings_of(tree):
    """Yield what a tree gives a name to: (name, line, whether it is a class)."""
    for node in ast.walk(tree):
        key = NAME_IN.get(type(node))
        if key is not None and not isinstance(getattr(node, "ctx", None), ast.Load):
            yield getattr(node, key), node.lineno, isinstance(node, ast.ClassDef)


@pytest.fixture(scope="module")
def bindings():
    """Module, as a path from the root, to what it gives a name to."""
    return {
        path.relative_to(ROOT).as_posix(): list(bindings_of(ast.parse(path.read_text())))
        for folder in FOLDERS
        for path in (ROOT / folder).rglob("*.py")
    }


@pytest.mark.parametrize(
    "code",
    [
        "one = 1",
        "one: int",
        "one += 1",
        "first, *one = joints",
        "joint.one = 1",
        "joint.one, rest = pair",
        "(one := 1)",
        "[one for one in joints]",
        "for one in joints: pass",
        "with series as one: pass",
        "import joints as one",
        "from joints import series as one",
        "try: pass\nexcept ValueError as one: pass",
        "def joint(one): pass",
        "def joint(*one): pass",
        "def joint(*, one=1): pass",
        "def joint(**one): pass",
        "lambda one: 1",
        "def one(): pass",
        "async def one(): pass",
        "class one: pass",
        "class Joint:\n    one: int",
        "match joint:\n    case one: pass",
        "match joint:\n    case [*one]: pass",
        "match joint:\n    case {**one}: pass",
        "match joint:\n    case Joint() as one: pass",
    ],
)
def test_every_way_to_give_a_name_is_seen(code):
    assert "one" in {name for name, *_ in bindings_of(ast.parse(code))}


def test_a_name_that_is_only_used_is_not_seen():
    tree = ast.parse("import one\nfrom one import joint\njoint(one=1)\nprint(joint.one, one)")
    assert "one" not in {name for name, *_ in bindings_of(tree)}


def test_names_say_what_they_name(bindings):
    assert len(bindings) > 500
    assert [
        f"{path}:{line}: {name}"
        for path, named in sorted(bindings.items())
        for name, line, _ in named
        if name in EMPTY and (path, name) not in PUBLIC_KEYS
    ] == []


def test_a_public_class_has_a_name_of_its_own(bindings):
    places = defaultdict(list)
    for path, named in bindings.items():
        if path.startswith(tuple(f"{folder}/" for folder in PRODUCT)):
            for name, line, is_class in named:
                if is_class and not name.startswith("_"):
                    places[name].append(f"{path}:{line}")
    assert len(places) > 200
    assert {name: lines for name, lines in places.items() if len(lines) > 1} == {}
