"""TOML and JSON of any origin: the same values as the standard parsers, or a sentence."""

import json
import tomllib

import pytest

from support.paths import ROOT
from undulog.capture.common.untrusted_text import check_yaml, read_json, read_toml

SIZE = 120_000
"""Characters of a hostile text. What grows with the square takes a minute."""

HOSTILE = {
    "header": ("[" + "a." * (SIZE // 2) + "a]", "dotted key"),
    "key": ("a." * (SIZE // 2) + "a=1", "dotted key"),
    "key with spaces": ("a . " * (SIZE // 4) + "a=1", "dotted key"),
    "quoted key": ('"a".' * (SIZE // 4) + "a=1", "dotted key"),
    "key in an inline table": ("x={" + "a." * (SIZE // 2) + "a=1}", "dotted key"),
    "header behind a text": ('x="""\n"""\n[' + "a." * (SIZE // 2) + "a]", "dotted key"),
    "header behind a comment": ('#"""\n[' + "a." * (SIZE // 2) + "a]", "dotted key"),
    "long header over many keys": (
        "[" + ".".join("a" * (SIZE // 4)) + "]\n" + "b=1\n" * (SIZE // 12),
        "dotted key",
    ),
    "arrays": ("x=" + "[" * SIZE, "64 deep"),
    "inline tables": ("x=" + "{a=" * (SIZE // 3), "64 deep"),
    "both": ("x=" + "[{a=" * 33 + "1" + "}]" * 33, "64 deep"),
    "integer": ("x=" + "9" * SIZE, "64 bits"),
    "hexadecimal": ("x=0x" + "f" * SIZE, "64 bits"),
    "open texts": ('"\\"' + '\\"' * (SIZE // 2), "."),
    "open text of several lines": ('x="""' + '\\"' * (SIZE // 2), "."),
    "too long": ("#\n" * (3 << 20), "4 MiB"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_toml_is_refused_by_a_sentence(name):
    text, why = HOSTILE[name]
    with pytest.raises(ValueError, match=why):
        read_toml(text)


@pytest.mark.parametrize(
    "text",
    [
        'x = "' + "a." * 100 + '"',
        "x = '" + "[" * 100 + "'",
        'x = """\n' + "a.b.c." * 30 + "\n" + "{[" * 50 + '\n"""',
        "x = '''\n''" + "a." * 100 + "''''\ny = 1",
        "# " + "a." * 100 + "[" * 100 + "\nx = 1",
        ".".join(["a"] * 60) + " = [1.5, 1979-05-27T07:32:00.999Z, 0.1]",
        'x = """\\""""\ny = "\\\\"\n[a."b.c".\'d.e\']\nf = [[[]], {g.h = 1}]',
        "x = [" + "1.5, 2.5," * 500 + "]",
        "x = [" + "{a = 1}, " * 500 + "]",
    ],
)
def test_what_only_looks_hostile_is_read_as_tomllib_reads_it(text):
    assert read_toml(text) == tomllib.loads(text)


@pytest.mark.parametrize(
    "path", sorted((ROOT / "capture" / "robot" / "shipped").glob("*.toml")), ids=lambda p: p.stem
)
def test_shipped_descriptions_are_read_as_tomllib_reads_them(path):
    assert read_toml(path.read_text()) == tomllib.loads(path.read_text())


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("[" * SIZE, "64 deep"),
        ('{"a":' * SIZE, "64 deep"),
        ("[" * 65 + "]" * 65, "64 deep"),
        ('{"a":' + "9" * SIZE + "}", "64 bits"),
        ("9223372036854775808", "64 bits"),
        (b'"\xff"', "utf-8"),
        ('"\ud800"'.encode("utf-8", "surrogatepass"), "utf-8"),
        ("[1,", "line 1"),
    ],
)
def test_hostile_json_is_refused_by_a_sentence(text, why):
    with pytest.raises(ValueError, match=why):
        read_json(text)


def test_json_is_read_as_the_standard_parser_reads_it():
    text = json.dumps({"a": [1, -(2**63), 1.5e-300, None, True, "[" * 99], "b": {"c": [[]]}})
    assert read_json(text) == read_json(text.encode()) == json.loads(text)


def test_depth_is_counted_alike_whatever_nests():
    for depth in (62, 63):
        assert read_json("[" * depth + "]" * depth)
        assert read_toml("x = " + "[" * (depth - 1) + "]" * (depth - 1))


@pytest.mark.parametrize(
    ("text", "why"),
    [("a: " + "[" * SIZE, "64 deep"), ("{a: " * 65, "64 deep"), (f"a: [{'a,' * SIZE}]", "items")],
)
def test_hostile_yaml_is_refused_by_a_sentence(text, why):
    with pytest.raises(ValueError, match=why):
        check_yaml(text)


def test_yaml_of_thousands_of_parts_passes():
    check_yaml("".join(f"  - path: run_{k}.mcap\n    tags: [a, b]\n" for k in range(5000)))
