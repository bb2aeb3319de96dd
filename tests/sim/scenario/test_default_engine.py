"""Engine of a scenario that names none, by what is installed."""

import json

import pytest

from support.processes import python

RUN = (
    "import sys; {hide} import undulog;"
    "sys.exit(undulog.run(['sim', 'run', {scenario!r}, '--duration', '0.1', '-o', 'run.mcap'"
    ", '--json']))"
)


def run(folder, *hidden, scenario="flat"):
    hide = "".join(f"sys.modules[{name!r}] = None;" for name in hidden)
    return python(RUN.format(hide=hide, scenario=scenario), cwd=folder)


@pytest.mark.nightly
@pytest.mark.parametrize(("hidden", "engine"), [((), "bullet"), (("pybullet",), "mujoco")])
def test_the_twin_runs_on_the_engine_that_is_installed_and_names_it(tmp_path, hidden, engine):
    done = run(tmp_path, *hidden)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["engine"] == engine
    code = "import sys; sys.modules['pybullet'] = None; import undulog; sys.exit(undulog.run({}))"
    shown = python(code.format(["analyse", "run.mcap", "--json"]), cwd=tmp_path)
    result = json.loads(shown.stdout)
    assert result["provenance"]["versions"]["engine of the session"] == engine


def test_an_engine_that_is_named_is_not_replaced(tmp_path):
    (tmp_path / "named.toml").write_text(
        'description = "x"\nrobot = "snake13"\nduration_s = 0.1\nengine = "bullet"\n'
        "[gait.horizontal]\namplitude = 0.1\nfrequency_hz = 1.0\nlag = 1.0\n"
    )
    done = run(tmp_path, "pybullet", scenario="named.toml")
    assert done.returncode == 2
    assert "the engine 'bullet' needs the package pybullet" in done.stderr
    assert 'engine = "mujoco" in the scenario runs without it' in done.stderr
