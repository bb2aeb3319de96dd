"""Sessions of the twin that begin in the transient, against the value at which it settles."""

import numpy as np
import pytest

from support.analysed import analysed
from undulog.analysis.signals.stretch import Options
from undulog.sim import load_scenario, record
from undulog.sim.scenario.scenario import Kernels

LEFT = 1e-4
"""What may be left of the transient in the long run, and of friction's own scatter, in ln H."""


@pytest.mark.nightly
@pytest.mark.parametrize("name", ["weak-servo-pi3", "flat"])
def test_a_short_session_gives_what_a_long_one_settles_at(name, tmp_path):
    pytest.importorskip("pybullet")
    pytest.importorskip("numba")
    path = tmp_path / f"{name}.mcap"
    record(load_scenario(name).changed(duration_s=40.0), path, kernels=Kernels.NUMBA)
    truth = {
        joint.name: (joint.gain.value, joint.lag_rad.value)
        for joint in analysed(path, Options(start_s=24.0)).joints
        if joint.gain.value is not None
    }
    for start_s, cycles in ((1.0, 6), (1.0, 10), (2.0, 8)):
        short = analysed(path, Options(start_s=start_s, stop_s=start_s + cycles / 0.5))
        inside = []
        for joint in short.joints:
            if joint.name not in truth:
                continue
            for estimate, value in zip((joint.gain, joint.lag_rad), truth[joint.name], strict=True):
                low, high = estimate.ci95
                inside.append(low - LEFT <= value <= high + LEFT)
        assert len(inside) > 20
        assert np.mean(inside) >= 0.91, (start_s, cycles)
