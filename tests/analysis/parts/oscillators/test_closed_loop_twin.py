"""Generators with feedback, coupled by the body alone, do what open-loop kicks foretell."""

import numpy as np
import pytest

from support import closed_loop
from support.compensating import Stage, Wave

pytestmark = [pytest.mark.slow, pytest.mark.built("tables")]


def from_sessions(folder, m):
    """Return the coupling and the response to the gait, by analysing sessions."""
    experiment = closed_loop.open_loop(folder, m)
    return experiment.coupling, closed_loop.base_response(experiment)


def from_batch(_folder, m):
    """Return the same from runs of a batch, whose engine isn't that of the closed loop."""
    coupling = Stage(m, 0.25, noise=0.0).kicks(Wave(m), 1)
    return coupling, np.array(coupling.base.gain) * np.exp(-1j * np.array(coupling.base.lag_rad))


@pytest.mark.parametrize(("m", "kicked"), [(5, from_sessions), (5, from_batch), (13, from_batch)])
def test_kicked_generators_relax_as_foretold(tmp_path, m, kicked):
    """Yaw joints in contact, 12 s after a kick, with nothing fitted."""
    closed_loop.write_chain(tmp_path, m, 0.25)
    run = closed_loop.closed_loop(tmp_path, *kicked(tmp_path, m))
    assert 0.08 < np.linalg.norm(run.off[0]) / m**0.5 < 0.15  # evenly drawn up to 0.2 rad
    assert run.t_s[-1] > 11.5
    # They have gone far from where the kick put them, and the prediction has gone with them.
    assert run.moved[-1] > 0.35
    assert run.error.max() < 0.15
    assert run.error[-1] < run.moved[-1] / 4
