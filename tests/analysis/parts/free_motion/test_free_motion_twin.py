"""Motion of the twin without its commands, read at another log's times, with noise."""

import json

import motion_tables
import numpy as np
import pytest

from support.joint_runs import turns
from support.written_topics import write_topics


@pytest.fixture(scope="module")
def motion():
    servo, tables = motion_tables.GAITS["weak servos"]
    return motion_tables.twin_motions(servo, tables, max(motion_tables.CYCLES))[0]


@pytest.mark.built("tables")
@pytest.mark.slow
@pytest.mark.parametrize("cycles", motion_tables.CYCLES)
def test_intervals_of_the_twin_hold_its_motion_without_noise(motion, cycles):
    """95 % of 200 draws within binomial scatter, no wider than 1.1 times the Cramer-Rao bound."""
    coverage = motion_tables.coverage(motion, cycles, 200)
    assert all(0.91 <= share <= 0.98 for share in coverage.inside.values()), coverage
    assert all(width < 1.1 for width in coverage.width.values()), coverage


def test_the_record_decides_no_end_and_the_note_says_so(motion_without_robot, command):
    result = json.loads(command("analyse", motion_without_robot, "--json").out)
    (wave,) = result["free_motion"]["waves"]
    assert wave["direction"] == "first-to-last"
    (note,) = [text for text in result["notes"] if "head is unknown" in text]
    assert "directions are relative to that order" in note
    assert "directions are relative to that order" in " ".join(
        command("analyse", motion_without_robot).out.split()
    )


@pytest.fixture
def motion_without_robot(tmp_path):
    """A wave along joints that only the order of the file sorts."""
    angles = 0.3 * np.real(turns(0.9, 500) * np.exp(-0.7j * np.arange(5)))
    topics = {"/joint_states": ([f"j{k}" for k in range(5)], "rad", angles)}
    return write_topics(tmp_path / "s.mcap", np.arange(500) * 20_000_000, topics, epoch_ns=0)
