"""Every command and snippet of the README does what it says."""

import os
import re
import shlex
import sys

import pytest

from support import processes
from support.paths import ROOT

README = (ROOT / "README.md").read_text()
COMMANDS = [
    line.removeprefix("$ ").partition("   #")[0].partition("  #")[0].strip()
    for block in re.findall(r"```console\n(.*?)```", README, re.DOTALL)
    for line in block.splitlines()
    if line.startswith("$ ")
]
RUN = "undulog sim run weak-servo-pi3 -o run.mcap"
CLIP = "undulog view run.mcap --clip run.mp4"
SHORTER = {RUN: f"{RUN} --duration 12.5", f"{CLIP} --to 4": f"{CLIP} --to 0.2"}
"""What is run in place of two commands [s]: a session that is only as long as `log cut --stop 12`
needs, as test_demo.py has a whole one, and fewer pictures."""
SNIPPETS = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
# An ArcSnake-like exchange: request and reply share an identifier, direction tells them apart.
TRACE = "".join(
    f"(1700000000.{k:02d}0000) can0 14B#A400000000{k:02X}0000 T\n"
    f"(1700000000.{k:02d}0500) can0 14B#92{k:02X}000000000000 R\n"
    for k in range(50)
)


def test_the_readme_shows_a_picture_before_anything_else():
    assert README.index("![") < README.index("```")
    for path in re.findall(r"!\[[^]]*\]\(([^)]+)\)", README):
        assert (ROOT / path).is_file(), f"{path} is missing: make pictures"


@pytest.mark.parametrize("command", [c for c in COMMANDS if c.startswith("make ")])
def test_make_targets_exist_and_are_run_by_the_integration(command):
    processes.run(*shlex.split(command), "-n", cwd=ROOT, code=0)
    assert command in (ROOT / ".ci" / "run").read_text()


@pytest.mark.slow
def test_the_verbs_in_order_then_the_snippets(tmp_path):
    (tmp_path / "trace.log").write_text(TRACE)
    verbs = [command for command in COMMANDS if not command.startswith("make ")]
    assert len(verbs) >= 8
    assert SHORTER.keys() <= {*verbs}
    for command in verbs:
        program, *words = shlex.split(SHORTER.get(command, command))
        assert program == "undulog"
        run([sys.executable, "-m", "undulog", *words], tmp_path)
    assert (tmp_path / "back.log").read_text() == TRACE
    assert SNIPPETS
    for snippet in SNIPPETS:
        assert "joint01" in run([sys.executable, "-c", snippet], tmp_path)


def run(command, folder):
    return processes.run(*command, cwd=folder, env=dict(os.environ), code=0).stdout
