"""Runs of the twin on a GPU: a batch of thousands, against the batch on one core.

Chains of 5, 25 and 50 joints under the gait of the scenario weak-servo-pi3, 1 kHz, servos that
differ from run to run. Wall time of run_batch as a whole: set-up, copies and results
included. Outputs are compared with the CPU's: joint angles over 1 s within 1e-6 of the amplitude
(float32: 1e-3), amplitudes over the last cycle within 1e-5 (float32: 1e-3).

Needs an NVIDIA GPU and numba-cuda. Run: python bench/batch_gpu.py [--seconds 2]
"""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path

import numpy as np
from batch_twin import batch_took, servos_of
from measuring import arguments, chain
from numba import cuda
from records import not_run, verdict
from twin_step import without_sensors

from undulog.capture.common.arrays import FloatArray
from undulog.sim import BatchRun, Scenario, load_scenario, run_batch
from undulog.sim.batch.cuda import require_gpu

JOINTS, WORLDS = (5, 25, 50), (1024, 4096, 16384)


def apart(scenario: Scenario) -> bool:
    """Print how far the GPU's outputs are from the CPU's; return whether too far."""
    runs = servos_of(scenario.changed(duration_s=5.0), 16)
    expected = run_batch(runs)
    good = True
    for dtype, angles, gains in ((np.float64, 1e-6, 1e-5), (np.float32, 1e-3, 1e-3)):
        on_gpu = run_batch(runs, dtype=dtype, device="cuda")
        pairs = list(zip(on_gpu, expected, strict=True))
        far = max(np.abs(a.angle - b.angle)[:101].max() for a, b in pairs)
        gain = max(np.abs(swing(a) / swing(b) - 1).max() for a, b in pairs)
        name = dtype.__name__
        good &= verdict(f"GPU to CPU: joint angles over 1 s, {name}", far / 0.4, angles, "")
        good &= verdict(f"GPU to CPU: gain over the last cycle, {name}", gain, gains, "")
    return not good


def swing(run: BatchRun) -> FloatArray:
    """Return the amplitudes of the joints that move, over the last 2 s, a cycle [rad]."""
    part = run.angle[-200:]
    wave = np.exp(-2j * np.pi * np.arange(200) / 200)
    moving = np.ptp(run.command, axis=0) > 0
    return np.abs(wave @ part[:, moving]) / 100


def main() -> None:
    """Print the table."""
    parser = arguments(__doc__, seconds=2.0)
    parser.add_argument("--worlds", type=int, nargs="+", default=WORLDS)
    options = parser.parse_args()
    if not Path("/proc/driver/nvidia/version").exists():
        not_run("a batch of the twin on a GPU", "no GPU")
        return
    require_gpu()
    weak = without_sensors(load_scenario("weak-servo-pi3").changed(duration_s=options.seconds))
    failed = apart(weak)
    # ``apart`` compiled all but the core's float32.
    run_batch(servos_of(weak.changed(duration_s=0.05), 2), dtype=np.float32)
    print(f"\n{cuda.get_current_device().name}, 1 kHz, {options.seconds:g} s")
    print(f"{'':<14}{'worlds':>7}{'joints':>7}{'wall s':>8}{'steps/s':>13}{'of a core':>11}")
    for joints in JOINTS:
        scenario = dataclasses.replace(weak, robot=chain(weak.robot, joints))
        for dtype in (np.float64, np.float32):
            core = 0.0
            for device, worlds in (("cpu", 64), *(("cuda", count) for count in options.worlds)):
                used = batch_took(scenario, worlds, dtype, device).wall_s
                rate = worlds * scenario.duration_s * scenario.physics_rate_hz / used
                if device == "cpu":
                    core = rate
                else:
                    what = f"{worlds} runs of {joints} joints, {dtype.__name__}, GPU to one core"
                    verdict(what, rate / core, None, "times as fast")
                row = f"{device}, {dtype.__name__:<8}{worlds:>8}{joints:>7}{used:>8.2f}"
                print(f"{row}{rate:>13,.0f}{rate / core:>11.1f}", flush=True)
    sys.exit(failed)


if __name__ == "__main__":
    main()
