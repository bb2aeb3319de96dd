"""The page on physics names its proofs: each test that it names is there."""

import re
from pathlib import Path

import pytest

HERE = Path(__file__).parent
PAGE = (HERE.parents[1] / "docs" / "physics.md").read_text(encoding="utf-8")
NAMED = sorted(set(re.findall(r"`(test_\w+(?:\.py)?)`", PAGE)))


@pytest.mark.parametrize("name", NAMED)
def test_every_proof_that_is_named_is_there(name):
    if name.endswith(".py"):
        assert (HERE / name).is_file()
    else:
        assert any(f"def {name}(" in path.read_text() for path in HERE.glob("test_*.py"))


def test_proofs_are_named():
    assert len(NAMED) > 20
