"""Blocks of runs on a GPU, a thread a run.

The steps are those of :mod:`.sim.batch.kernels`, compiled for the GPU by numba; there's no other
form of the equations. A run's work space lies in registers and the thread's own memory; the arrays
have the run as the last axis, so that neighbouring threads read neighbouring numbers.

With ``NUMBA_ENABLE_CUDASIM=1`` and ``NUMBA_DISABLE_JIT=1`` numba runs the same code on the CPU,
slowly, for tests where no GPU is.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from importlib import import_module
from typing import Any
from warnings import catch_warnings, filterwarnings

import numpy as np
from numba.extending import overload

from undulog.capture.common.arrays import BoolArray, FloatArray
from undulog.capture.common.errors import UsageError

from .body import CARRIED_ROWS, floor, of_lanes
from .kernels import run_lanes

cuda: Any = import_module("numba.cuda")  # it has no types
_THREADS = 64
"""Of a group of threads: a run needs most of the registers that a thread can have."""


@overload(of_lanes, target="cuda")
def _of_any(rows: FloatArray) -> Callable[[FloatArray], None]:  # noqa: ARG001 - its type
    def check(rows: FloatArray) -> None:
        pass

    return check


@overload(floor, target="cuda")
def _floor(x: float) -> Callable[[float], float]:  # noqa: ARG001 - its type
    def by_conversion(x: float) -> float:
        return type(x)(math.floor(x))

    return by_conversion


@cache
def _kernel(dtype: np.dtype) -> Any:
    """Compile the steps in a precision."""

    @cuda.jit
    def run(
        links: FloatArray,
        head: FloatArray,
        ground: FloatArray,
        gravity: FloatArray,
        vertical: BoolArray,
        law: int,
        commands: FloatArray,
        samples: FloatArray,
        poses: FloatArray,
        failure: FloatArray,
        limits: FloatArray,
        step_s: float,
        steps: int,
        first: int,
        last: int,
    ) -> None:
        r = cuda.grid(1)
        if r < head.shape[1]:
            end = r + 1
            carried = cuda.local.array((CARRIED_ROWS, 1), dtype)
            for row in range(CARRIED_ROWS):
                carried[row, 0] = 0
            run_lanes(
                *(links[:, :, r:end], head[:, r:end], carried, ground[:, r:end]),
                *(gravity[:, r:end], vertical, law, commands[:, :, r:end]),
                *(samples[:, :, :, r:end], poses[:, :, r:end], failure[:, r:end]),
                *(limits, step_s, steps, first, last, 1),
            )

    return run


def require_gpu() -> None:
    """Raise if there's no GPU.

    Raises:
        UsageError: With what to do.
    """
    if not cuda.is_available():
        raise UsageError(
            "device cuda: no NVIDIA GPU that numba can use (`numba -s` lists what it finds); "
            "install NVIDIA's driver and numba-cuda, or use device cpu"
        )


def run_block_on_gpu(*block: Any) -> None:
    """Run a block, its state taken to the GPU and back: :func:`.kernels.run_lanes`.

    Raises:
        UsageError: If there is no GPU.
    """
    require_gpu()
    # Each thread has work space of its own, in place of what is carried.
    links, head, _, ground, gravity, vertical, law, commands, samples, poses, *rest = block
    failure, limits, *times, lanes = rest
    state = [cuda.to_device(array) for array in (links, head, failure)]
    filled = [cuda.device_array(array.shape, array.dtype) for array in (samples, poses)]
    filled[0][0].copy_to_device(samples[0])
    devices = [cuda.to_device(array) for array in (ground, gravity, vertical, commands, limits)]
    with catch_warnings():
        # That few runs don't fill the GPU: their number is the caller's.
        filterwarnings("ignore", ".*Grid size")
        _kernel(links.dtype)[-(-lanes // _THREADS), _THREADS](
            *(state[0], state[1], *devices[:3], law, devices[3], *filled, state[2], devices[4]),
            *times,
        )
    for array, copy in zip((links, head, failure), state, strict=True):
        copy.copy_to_host(array)
    filled[0].copy_to_host(samples)
    filled[1][1:].copy_to_host(poses[1:])
