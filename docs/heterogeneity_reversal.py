"""Level and power of the reversal test on a tilted floor, for docs/heterogeneity.md.

Profiles without noise come from the 25-joint twin (``weak-servo-pi3``): identical modules on a
floor tilted by 0, 0.3, 1 and 2 degrees along the body and across it, and each yaw module in turn
20 % weaker and stronger. The robot has no head of its own, so half a turn of the robot with its
wave reversed is the same run read from tail to head: only the wave from head to tail is simulated,
and the relation is checked on runs of the other wave. Experiments are drawn on these profiles.

``.venv/bin/python docs/heterogeneity_reversal.py`` prints the tables; it takes about a quarter of
an hour of one core, nearly all of it for the runs of the twin, which ``--profiles FOLDER`` keeps.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from analysis import analyse_session
from capture import Session
from sim import load_scenario
from sim.physics.engine import Kernels
from sim.record import record

TILTS_DEG = (0.3, 1.0, 2.0)
DIRECTIONS = {"fore-aft": 0.0, "sideways": math.pi / 2}
SHARE = 0.2
YAW = tuple(f"joint{k:02d}" for k in range(1, 26, 2))
MIDDLE = YAW[len(YAW) // 2]


@dataclass(frozen=True)
class Case:
    """One run of the twin.

    Attributes:
        tilt_deg: Of the floor [degrees].
        direction: Where it falls to, a key of ``DIRECTIONS``.
        heading_deg: Of the robot at the start, 0 or 180 [degrees].
        joint: The module that differs; empty: none.
        share: By how much its stall torque does.
        reverse: Whether the wave runs from tail to head.
    """

    tilt_deg: float = 0.0
    direction: str = "fore-aft"
    heading_deg: int = 0
    joint: str = ""
    share: float = 0.0
    reverse: bool = False

    @property
    def file(self) -> str:
        """Name of the file that keeps its profile."""
        way = "reverse" if self.reverse else "forward"
        module = f"{self.joint}{self.share:+g}" if self.joint else "identical"
        return f"{way}-{self.tilt_deg:g}-{self.direction}-{self.heading_deg}-{module}.npy"


def profile(case, folder):
    """ln(response/command) of the yaw joints without noise, from a kept file or a run, shape (13,)."""
    kept = folder / case.file
    if kept.exists():
        return np.load(kept)
    changes = {"world.heading": math.radians(case.heading_deg)}
    if case.tilt_deg:
        changes["world.slope"] = math.radians(case.tilt_deg)
        changes["world.slope_heading"] = DIRECTIONS[case.direction]
    if case.joint:
        changes[f"servo_of.{case.joint}.stall_torque"] = 0.25 * (1 + case.share)
    scenario = load_scenario("weak-servo-pi3" + ("-reverse" if case.reverse else ""), changes)
    path = folder / "run.mcap"
    record(scenario, path, kernels=Kernels.NUMBA, force=True)
    with Session.open(path) as session:
        joints = [one for one in analyse_session(session).joints if one.gain.value is not None]
    assert tuple(one.name for one in joints) == YAW
    y = np.array([np.log(one.gain.value) - 1j * one.lag_rad.value for one in joints])
    np.save(kept, y)
    return y


def cases():
    """All runs of the wave from head to tail, and those of the other that check the relation."""
    yield Case()
    for tilt in TILTS_DEG:
        for direction in DIRECTIONS:
            for heading in (0, 180):
                yield Case(tilt, direction, heading)
    yield Case(joint="joint05", share=-SHARE, reverse=True)
    yield Case(2.0, "fore-aft", 0, "", 0.0, True)
    yield Case(2.0, "fore-aft", 0, "joint05", -SHARE, True)
    yield Case(2.0, "sideways", 0, "joint05", -SHARE, True)
    for share in (-SHARE, SHARE):
        for joint in YAW:
            yield Case(joint=joint, share=share)
    for direction in DIRECTIONS:
        for joint in YAW:
            for heading in (0, 180):
                yield Case(2.0, direction, heading, joint, -SHARE)


def main():
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--profiles", type=Path, help="folder that keeps the twin's profiles")
    folder = parser.parse_args().profiles
    with tempfile.TemporaryDirectory() as temporary:
        folder = folder or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        for case in cases():
            profile(case, folder)


if __name__ == "__main__":
    main()
