"""The page on errors: each command gives the message that the page shows."""

import shlex

import pytest

import undulog
from support import manual_pages

COMMANDS = manual_pages.steps(manual_pages.read_page("reference/errors.md"))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("errors")
    words = ["--duration", "12", "--kernels", "numba", "-o", str(path / "run.mcap")]
    assert undulog.run(["sim", "run", "flat", *words]) == 0
    (path / "text.mcap").write_text("hello\n")
    (path / "table.csv").write_text("a,b\n1,2\n")
    (path / "trace.log").write_text("(1700000000.000000) can0 101#0011223344\n")
    return path


def test_the_page_has_the_usual_fifteen():
    assert len(COMMANDS) >= 15


@pytest.mark.nightly
@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: command.line)
def test_the_message_is_as_shown(command, folder, monkeypatch, capsys):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(folder))
    monkeypatch.chdir(folder)
    program, *words = shlex.split(command.line)
    assert program == "undulog"
    capsys.readouterr()
    assert undulog.run(words) in (1, 2)
    shown = capsys.readouterr().err
    assert manual_pages.shows(command.shown, shown), shown
