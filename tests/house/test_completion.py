"""Completion of the command line, as a shell asks for it."""

import os
import shutil

import pytest

from support import processes

ASK = """
source "$1"
COMP_WORDS=("${@:2}")
COMP_CWORD=$((${#COMP_WORDS[@]} - 1))
_undulog
printf '%s\\n' "${COMPREPLY[@]}"
"""


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    home = tmp_path_factory.mktemp("home")
    environment = {k: v for k, v in os.environ.items() if not k.startswith("ZSH")}
    for shell in ("bash", "zsh", "fish"):
        done = processes.undulog(
            "--install-completion", "--shell", shell, env=environment | {"HOME": str(home)}, code=0
        )
        assert str(home) in done.stdout
    return home


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["an"], {"analyse"}),
        (["record", "un"], {"unit"}),
        (["record", "--ri"], {"--ring"}),
        (["log", "info", "--js"], {"--json"}),
        (["sim", "run", "flat", "--kernels", ""], {"auto", "numba", "numpy"}),
    ],
)
def test_bash_completes_commands_options_and_choices(home, words, expected):
    script = home / ".local/share/bash-completion/completions/undulog"
    done = processes.run("bash", "-c", ASK, "ask", script, "undulog", *words)
    assert {line.strip() for line in done.stdout.split()} == expected, done.stderr


@pytest.mark.slow
def test_the_scripts_of_other_shells_parse(home):
    for shell, pattern in (("zsh", ".zsh/**/*undulog"), ("fish", ".config/fish/**/*.fish")):
        (script,) = home.glob(pattern)
        assert "analyse" in script.read_text()
        if shutil.which(shell):
            assert processes.run(shell, "-n", script).returncode == 0


def test_an_unknown_shell_is_refused(command):
    assert "--shell" in command("--install-completion", "--shell", "ksh", code=2).err
