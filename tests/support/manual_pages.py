"""Pages of the manual as steps: files that the reader writes, commands, and what they print."""

import json
import os
import re
import shlex
import signal
import sys
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from support.paths import DOCS
from support.processes import process, run, undulog, wait_for

_INCLUDE = re.compile(r"^```\{include\} (\S+)\n```$", re.MULTILINE)
_BLOCK = re.compile(r"^```(console|\{code-block\} \w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_CAPTION = re.compile(r":caption: (\S+?)(, at its end)?\n\n?")
_FENCED = re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL)
PATIENCE_S = 1000
WORDS_A_MINUTE = 200
TYPED_A_MINUTE = 150


@dataclass(frozen=True)
class File:
    """A file that the reader writes, or the lines added at its end."""

    name: str
    text: str
    added: bool


@dataclass(frozen=True)
class Command:
    """A line of a terminal, and what the page shows below it."""

    line: str
    shown: str

    @property
    def codes(self) -> set[int]:
        """The exit codes that it may have: a verdict depends on what else the computer does."""
        return {0, 1} if self.line.startswith("undulog log check ") else {0}

    @property
    def serves(self) -> bool:
        return self.line.startswith("undulog sim serve ")

    @property
    def records(self) -> bool:
        """Whether it is a recorder that runs until it is ended."""
        words = shlex.split(self.line)
        return words[:2] == ["undulog", "record"] and ":" in words[2] and "--duration" not in words


def read_page(name: str) -> str:
    """Return a page of the manual, with what it includes."""
    path = DOCS / name
    return _INCLUDE.sub(lambda m: (path.parent / m[1]).read_text(), path.read_text())


def steps(page: str) -> list[File | Command]:
    """Return what the page makes the reader do, in order."""
    files: list[File | Command] = []
    for kind, body in _BLOCK.findall(page):
        if kind == "console":
            for part in ("\n" + body).split("\n$ ")[1:]:
                line, _, shown = part.partition("\n")
                files.append(Command(line.partition("   #")[0].strip(), shown.strip()))
        elif caption := _CAPTION.match(body):
            files.append(File(caption[1], body[caption.end() :], bool(caption[2])))
    return files


def minutes(page: str) -> float:
    """Return how long the page takes: its prose to read, its files and commands to type."""
    prose = re.sub(r"\]\([^)]*\)", "]", _FENCED.sub("", page))
    typed = sum(len(s.text if isinstance(s, File) else s.line) for s in steps(page))
    return len(prose.split()) / WORDS_A_MINUTE + typed / TYPED_A_MINUTE


def lines_of(text: str) -> str:
    """Return the lines that have something in them, without spaces at their ends."""
    return "\n".join(line.rstrip() for line in text.splitlines() if line.strip())


def shows(shown: str, printed: str) -> bool:
    """Return whether the page shows what was printed; ``...`` is anything."""
    pattern = re.escape(lines_of(shown)).replace(r"\.\.\.", ".*")
    return re.fullmatch(pattern, lines_of(printed), re.DOTALL) is not None


def walk(page: str, folder: Path) -> None:
    """Do what the page says in an empty home, a terminal for each command that keeps running."""
    programs = folder / "bin"
    programs.mkdir()
    (programs / "undulog").write_text(f'#!/bin/sh\nexec {sys.executable} -m undulog "$@"\n')
    (programs / "undulog").chmod(0o755)
    home = folder / "home"
    home.mkdir()
    env = {"HOME": str(home), "XDG_RUNTIME_DIR": str(folder), "OPENBLAS_NUM_THREADS": "1"}
    env["PATH"] = f"{programs}{os.pathsep}{os.environ['PATH']}"
    options = {"cwd": home, "env": env}
    todo, robots = steps(page), []
    real_time = any(step.serves for step in todo if isinstance(step, Command))
    # The tests may run at a lower priority, which a robot and who commands it never have.
    usual = ("nice", "-n", str(-os.nice(0))) if real_time else ()
    with ExitStack() as terminals:

        def opened(command):
            words = (*usual, "bash", "-c", f"exec {command.line}")
            return terminals.enter_context(process(*words, **options))

        for step in todo:
            if isinstance(step, File):
                with (home / step.name).open("a" if step.added else "w") as file:
                    file.write(step.text)
            elif step.serves:
                robots.append(robot := opened(step))
                printed = robot.stdout.readline()
                expected = (
                    step.shown if "--wait" in step.line else f"{step.shown.partition(' it ')[0]}..."
                )
                assert shows(expected, printed), (step.line, printed)
            elif step.records:
                recorder = opened(step)
                wait_for(lambda: _connected(options), "the recorder", alive=(recorder,))
            else:
                done = run(*usual, "bash", "-c", step.line, timeout=PATIENCE_S, **options)
                assert done.returncode in step.codes, (step.line, done.stderr)
                if step.shown:
                    assert shows(step.shown, done.stdout), f"{step.line}\n{done.stdout}"
        for robot in robots:
            robot.send_signal(signal.SIGINT)
            robot.communicate(timeout=PATIENCE_S)
            assert robot.returncode == 0


def _connected(options) -> bool:
    status = json.loads(undulog("record", "status", "--json", **options).stdout or "{}")
    recordings = status.get("recordings", [])
    return bool(recordings) and recordings[0]["sources"][0]["connected"]
