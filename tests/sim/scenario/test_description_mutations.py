"""Odd numbers and depths in robots, scenarios, settings and plans: run, or an error of ours."""

from __future__ import annotations

import random
import re

import pytest

import undulog
from support.paths import ROOT

NUMBER = re.compile(r"(?<![\w.\"])-?\d+(?:\.\d+)?(?:e-?\d+)?(?![\w.\"])")
ODD = ("1e308", "-1e308", "1e15", "1e-320", "1e-30", "0", "-1", "nan", "inf", "9" * 400)
DEEP = {
    "array": "x = " + "[" * 5000 + "]" * 5000,
    "inline table": "x = " + "{a=" * 5000 + "1" + "}" * 5000,
    "dotted key": "a." * 5000 + "b = 1",
    "table": "[" + ".".join(["a"] * 5000) + "]",
    "integer": "x = " + "9" * 400,
    "long integer": "x = " + "9" * 5000,
}
LINES = (
    "sim run {file} -o {out}",
    "record can:virtual:b --robot {file} -o {out}",
    "record --settings {file}",
    "drive {file} --on twin -o {out}",
)


@pytest.mark.parametrize("line", LINES)
@pytest.mark.parametrize("kind", DEEP)
def test_depth_and_long_integers_are_faults(kind, line, tmp_path, capsys):
    file = tmp_path / "deep.toml"
    file.write_text(DEEP[kind])
    assert undulog.run(line.format(file=file, out=tmp_path / "x.mcap").split()) in (1, 2)
    shown = capsys.readouterr().err
    assert f"{file}" in shown
    assert "64" in shown or "digits" in shown


def changed(text: str, rng: random.Random) -> str:
    """One number of a text is another."""
    match = rng.choice(list(NUMBER.finditer(text)))
    return text[: match.start()] + rng.choice(ODD) + text[match.end() :]


@pytest.mark.slow
@pytest.mark.parametrize("folder", ["capture/robot/shipped", "sim/scenarios"])
def test_odd_numbers_end_in_a_run_or_an_error_of_ours(folder, tmp_path, capsys):
    texts = [path.read_text() for path in sorted((ROOT / folder).glob("*.toml"))]
    texts = [text for text in texts if NUMBER.search(text)]
    robot, run = tmp_path / "robot.toml", tmp_path / "run.toml"
    for path in (ROOT / "capture/robot/shipped").glob("*.dbc"):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    for seed in range(40):
        rng = random.Random(f"{folder} {seed}")
        text = changed(rng.choice(texts), rng)
        if folder == "sim/scenarios":
            run.write_text(text)
        else:
            robot.write_text(text)
            flat = (ROOT / "sim/scenarios/flat.toml").read_text()
            run.write_text(re.sub(r'(?m)^robot = ".*"', 'robot = "robot.toml"', flat))
        words = f"sim run {run} -o {tmp_path / 'o.mcap'} --force --set duration_s=0.02"
        code = undulog.run(words.split())
        shown = capsys.readouterr().err
        assert code == 0 or "error: " in shown, (seed, shown)
