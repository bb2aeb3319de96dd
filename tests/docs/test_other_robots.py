"""The page on other robots' recordings shows what the commands print."""

import re
import shlex

import pytest

from support.paths import DOCS, SHARED

PAGE = (DOCS / "how-to/other-robots.md").read_text()
BLOCKS = re.findall(r"```console\n(.*?)```", PAGE, re.DOTALL)


def test_the_page_names_no_other_folder_than_data():
    assert len(BLOCKS) == 6
    for block in BLOCKS:
        assert block.startswith("$ undulog import DATA/")
    for command in re.findall(r"^\$ (.*)$", PAGE, re.MULTILINE):
        words = shlex.split(command)
        assert not any(word.startswith(("/", "~", "..")) for word in words), command


@pytest.mark.nightly
@pytest.mark.parametrize("block", BLOCKS, ids=lambda block: block.split("\n")[0].split("/")[-1])
def test_each_block_of_the_page_is_what_is_printed(block, tmp_path, monkeypatch, command):
    if not SHARED.is_dir():
        pytest.skip(f"the real recordings {SHARED.name} are not beside this checkout")
    (tmp_path / "DATA").symlink_to(SHARED)
    monkeypatch.chdir(tmp_path)
    for line, *shown in (part.split("\n") for part in block.removeprefix("$ ").split("\n$ ")):
        program, *words = shlex.split(line)
        assert program == "undulog"
        expected = [line for line in shown if line]
        printed = [line.rstrip() for line in command(*words).out.splitlines() if line.strip()]
        if expected[-1] == "...":
            expected.pop()
            assert len(printed) > len(expected)
            printed = printed[: len(expected)]
        assert printed == expected
