"""The lock: every package by hash, and no word of where it comes from."""

import re

import pytest

from support.paths import ROOT

LINES = (ROOT / "requirements.lock").read_text().splitlines()


@pytest.mark.parametrize(
    "word", ["http:", "https:", "--index-url", "--extra-index-url", "--find-links", "-f ", "file:"]
)
def test_the_lock_names_no_host_and_no_index(word):
    assert [line for line in LINES if word in line] == []


def test_every_package_is_pinned_with_a_hash():
    text = "\n".join(LINES)
    entries = [line for line in LINES if re.match(r"^[A-Za-z0-9]", line)]
    assert len(entries) > 50
    assert all(re.match(r"^[\w.-]+(\[[\w,]+\])?==\S+ .*\\$", line) for line in entries)
    assert text.count("--hash=sha256:") >= len(entries)


def test_the_lock_brings_the_build_tools_of_an_editable_install():
    assert {"hatchling", "editables"} <= {line.partition("==")[0] for line in LINES}
