"""Figures of the README: sampling times of joints, and a weak joint.

``python studies/readme_figures.py`` simulates and records what they show, and draws it into
``docs/images``, or elsewhere with ``-o``. With ``--quick`` the runs are short, only to see that it
runs.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib import pyplot as plt

import undulog
from undulog.analysis import analyse_session
from undulog.capture import Session

IMAGES = Path(__file__).parents[1] / "docs/images"
SLOT_S = 0.00039


def simulate(session: Path, setting: str, seconds: float) -> None:
    """Record the snake on flat ground with one thing changed."""
    words = ["sim", "run", "flat", "--set", setting, "--duration", str(seconds), "-o", str(session)]
    if undulog.run(words):
        raise SystemExit(1)


def lags(session: Path) -> tuple[list[int], list[float], list[float]]:
    """Return the lags of driven joints by their own sampling times, and by one stamp a cycle [ms].

    The bus asks joint after joint; a controller that stamps all of them together takes the time of
    the first.
    """
    with Session.open(session) as opened:
        result = analyse_session(opened)
        angles = opened.joints("/joint_states", "position")
        number, true, stamped = list[int](), list[float](), list[float]()
        for joint in result.joints:
            if joint.lag_rad.value is None or joint.frequency_hz is None:
                continue
            place = angles.names.index(joint.name)
            late = 1e-9 * float(angles.t_ns[place][0] - angles.t_ns[0][0])
            number.append(place + 1)
            true.append(1e3 * joint.lag_rad.value / (2 * np.pi * joint.frequency_hz))
            stamped.append(true[-1] - 1e3 * late)
    return number, true, stamped


def main() -> None:
    """Draw both."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", dest="images", type=Path, default=IMAGES, help="folder to write to")
    parser.add_argument("--quick", action="store_true", help="short runs")
    given = parser.parse_args()
    seconds = 6.5 if given.quick else 12.0
    mpl.rcParams.update({"svg.hashsalt": "undulog", "svg.fonttype": "none", "font.size": 9})
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        given.images.mkdir(parents=True, exist_ok=True)
        simulate(folder / "polled.mcap", f"sensing.servo.slot_s={SLOT_S}", seconds)
        number, true, stamped = lags(folder / "polled.mcap")
        figure, axes = plt.subplots(figsize=(6.4, 2.2), layout="constrained")
        axes.plot(number, true, "o-", color="#1971c2", label="at each joint's own sampling time")
        axes.plot(number, stamped, "s--", color="#e8590c", label="with one stamp for all")
        axes.set(xlabel="joint, head to tail", ylabel="lag [ms]")
        axes.legend(frameon=False)
        axes.spines[["top", "right"]].set_visible(False)
        figure.savefig(given.images / "sampling-times.svg", metadata={"Date": None})
        simulate(folder / "weak.mcap", "servo_of.joint07.stall_torque=0.15", seconds)
        page, plots = folder / "weak.html", folder / "plots"
        words = ["report", folder / "weak.mcap", "-o", page, "--plots", plots]
        if undulog.run([str(word) for word in words]):
            raise SystemExit(1)
        (plots / "segments.svg").replace(given.images / "weak-joint.svg")
    for k, (a, b) in enumerate(zip(true, stamped, strict=True)):
        print(f"joint {number[k]:2d}: {a:6.2f} ms, with one stamp {b:6.2f} ms")


if __name__ == "__main__":
    main()
