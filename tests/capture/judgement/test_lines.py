"""Lines of records of which hardly anything can be looked at."""

from types import SimpleNamespace

import numpy as np
import pytest

from undulog.capture.judgement.lines import find_lines


@pytest.mark.parametrize("steps", [0, 1, 2, 9])
def test_a_record_of_few_usable_steps_has_no_line(steps):
    n, joints = 60, 3
    t_s = 0.05 * np.arange(n)
    position = np.sin(2 * np.pi * 2.0 * t_s) * np.ones((joints, 1))
    usable = np.zeros((joints, n), dtype=bool)
    usable[:, n - steps :] = True
    course = SimpleNamespace(t_s=t_s, command=0 * position, position=position, step_s=0.05)
    exposure = SimpleNamespace(fitted=0 * position, rest_rad=np.zeros(joints), group=lambda k: [k])
    assert find_lines(course, exposure, usable) == []
