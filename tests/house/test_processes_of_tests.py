"""The four processes of the Makefile's tests: each file of tests belongs to one of them."""

import re
import shlex
from pathlib import PurePath

import pytest

from support.paths import ROOT
from support.processes import run


def listed(words):
    """Return the paths that a process collects, and those that it ignores, from its words."""
    ignored = [word.removeprefix("--ignore=") for word in words if word.startswith("--ignore=")]
    chosen = [word for word in words if not word.startswith("--")]
    return chosen or ["tests"], ignored


@pytest.mark.parametrize("target", ["test", "slow", "night"])
def test_each_file_of_tests_belongs_to_one_process(target):
    recipe = run("make", "-n", target, cwd=ROOT, code=0).stdout
    lines = re.findall(r"-m pytest .*?--junitxml (\S+/(?!night-clock)[\w-]+\.xml)(.*?)[>;]", recipe)
    processes = {name: listed(shlex.split(words)) for name, words in lines}
    assert len(processes) == 4
    for path in (ROOT / "tests").rglob("test_*.py"):
        file = PurePath(path.relative_to(ROOT))
        homes = [
            name
            for name, (chosen, ignored) in processes.items()
            if any(map(file.is_relative_to, chosen)) and not any(map(file.is_relative_to, ignored))
        ]
        assert len(homes) == 1, (file, homes)
    for chosen, ignored in processes.values():
        assert all((ROOT / place).exists() for place in (*chosen, *ignored))
