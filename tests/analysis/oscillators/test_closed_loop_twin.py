"""Generators with feedback, coupled by the body alone, do what open-loop kicks foretell."""

import numpy as np
import pytest

from support import closed_loop

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("m", [5, 9, 13])
def test_kicked_generators_relax_as_foretold(tmp_path, m):
    """Yaw joints in contact, 12 s after a kick, with nothing fitted."""
    closed_loop.write_chain(tmp_path, m, 0.25)
    found = closed_loop.closed_loop(tmp_path, closed_loop.open_loop(tmp_path, m))
    assert 0.08 < np.linalg.norm(found.off[0]) / m**0.5 < 0.15  # evenly drawn up to 0.2 rad
    assert found.t_s[-1] > 11.5
    # They have gone far from where the kick put them, and the prediction has gone with them.
    assert found.moved[-1] > 0.35
    assert found.error.max() < 0.15
    assert found.error[-1] < found.moved[-1] / 4
