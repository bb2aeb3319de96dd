"""One run of a sweep: what its key is made of, and where it may run."""

from dataclasses import replace

import pytest

from support.sweep_plans import write_plan
from undulog.capture.common.errors import UsageError
from undulog.replay.sweep.plan import read_plan
from undulog.replay.sweep.run import run_job
from undulog.replay.sweep.sweep import prepare


@pytest.fixture
def sweep(tmp_path):
    return prepare(read_plan(write_plan(tmp_path, seeds=2)), tmp_path, str(tmp_path / "rows"))


def keys(folder):
    return {job.key for job in prepare(read_plan(folder / "plan.toml"), folder, "rows").jobs}


def test_a_worker_with_other_software_is_refused_by_name(sweep):
    other = replace(sweep.setting, software={**sweep.setting.software, "numpy": "1.0"})
    with pytest.raises(UsageError, match=r"has other software: numpy \S+ instead of 1\.0"):
        run_job(other, sweep.jobs[0])


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("wave.toml", "amplitude = 0.3", "amplitude = 0.31"),
        ("chain.toml", "mass = 0.1", "mass = 0.11"),
        ("plan.toml", "seeds = 2", "seeds = 2\nfirst_seed = 2"),
        ("plan.toml", "seeds = 2", "seeds = 2\nduration_s = 1.5"),
        ("plan.toml", "seeds = 2", 'seeds = 2\nkernels = "numba"'),
        ("plan.toml", "seeds = 2", "seeds = 2\n[analysis]\nstart_s = 0.5"),
        ("plan.toml", "[0.2, 0.3]", "[0.21, 0.31]"),
    ],
)
def test_whatever_determines_a_row_is_in_its_key(name, old, new, sweep, tmp_path):
    before = {job.key for job in sweep.jobs}
    assert keys(tmp_path) == before
    path = tmp_path / name
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new))
    assert not before & keys(tmp_path)


def test_where_files_lie_is_not_in_a_key(sweep, tmp_path):
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    write_plan(elsewhere, seeds=2)
    assert keys(elsewhere) == {job.key for job in sweep.jobs}
