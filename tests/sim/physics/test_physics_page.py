"""The page on physics names its proofs: each test that it names is there."""

import re
from pathlib import Path

import pytest

from support.paths import DOCS

SIM = Path(__file__).parents[1]
PAGE = (DOCS / "explanation/physics.md").read_text(encoding="utf-8")
NAMED = sorted(set(re.findall(r"`(test_\w+(?:\.py)?)`", PAGE)))


@pytest.mark.parametrize("name", NAMED)
def test_every_proof_that_is_named_is_there(name):
    if name.endswith(".py"):
        assert any(SIM.rglob(name))
    else:
        assert any(f"def {name}(" in path.read_text() for path in SIM.rglob("test_*.py"))


def test_proofs_are_named():
    assert len(NAMED) > 20
