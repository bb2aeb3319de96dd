"""Null model files: how identical modules would answer one gait, as a function of few parameters.

A program with a model of the robot (the twin, or any other) writes it; the analysis needs no
model then. With x = ln(theta / theta_0) of the parameters that all modules share, and y the vector
of ln(response / command), log gain minus j lag, of the m driven joints::

    y(x) = y_0 + sum_k x_k slope_k + 1/2 sum_kl x_k x_l curvature_kl

and a module j that deviates by z = ln(value / shared value) in one of its own parameters adds
``z modules[kind][j]``. The file is JSON; complex arrays are pairs of ``log_gain`` and ``lag_rad``
(positive when late).
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

from ..common.arrays import ComplexArray, FloatArray, frozen
from ..common.config import Name, NonNegative, Positive, read, read_field, write
from ..common.errors import DescriptionFault, NullModelError
from ..common.files import read_input, write_text
from ..common.strict_table import Faults, StrictTable
from ..common.untrusted_text import read_json

FORMAT = "undulog null model 1"


@dataclass(frozen=True)
class SharedParameter:
    """One entry of theta.

    Attributes:
        name: For example ``stall_torque``.
        unit: SI.
        value: theta_0, positive.
        reach: The model holds for abs(x) up to this.
    """

    name: Name
    unit: str
    value: Positive
    reach: Positive


@dataclass(frozen=True)
class NullModel:
    """A null model of m driven joints and K shared parameters; arrays are read-only.

    Attributes:
        joints: Driven joints, head to tail.
        command: Complex amplitudes of their commands, up to a common phase [rad], shape (m,).
        covariance: Of x, what is known of theta beforehand, shape (K, K).
        response: y_0, shape (m,).
        slope: dy/dx, shape (K, m).
        curvature: d2y/dx2, shape (K, K, m).
        modules: Kind to dy/dz, row = module that deviates, column = joint that answers, (m, m).
        error: Largest difference in y between this model and what it stands for, at parameters
            within its reach that it was not made from.
        made_by: What it was made from and with, in a sentence.
    """

    robot: str
    frequency_hz: Positive
    joints: tuple[str, ...]
    command: ComplexArray
    parameters: tuple[SharedParameter, ...]
    covariance: FloatArray
    response: ComplexArray
    slope: ComplexArray
    curvature: ComplexArray
    modules: Mapping[str, ComplexArray]
    error: NonNegative
    made_by: str

    @property
    def reach(self) -> FloatArray:
        """Largest abs(x) for which the model holds, shape (K,)."""
        return np.array([parameter.reach for parameter in self.parameters])

    def error_at(self, x: FloatArray) -> float:
        """Return the error of the model, in proportion to the distance from its reference.

        What it leaves out is of third order only where the robot is smooth; friction is not.

        Args:
            x: ln(theta / theta_0), shape (K,).

        Returns:
            In y; ``error`` where a parameter is at the end of its reach, or beyond.
        """
        return self.error * min(float(np.max(np.abs(x) / self.reach, initial=0.0)), 1.0)

    def at(self, x: FloatArray) -> tuple[ComplexArray, ComplexArray]:
        """Return the response of identical modules.

        Args:
            x: ln(theta / theta_0), shape (K,).

        Returns:
            y, shape (m,), and dy/dx, shape (K, m).
        """
        bend = np.einsum("klm,l->km", self.curvature, x)
        return self.response + x @ (self.slope + bend / 2), self.slope + bend


def write_null_model(path: Path, model: NullModel) -> None:
    """Write a null model.

    Raises:
        LogWriteError: If it can't be written.
    """
    values = {
        "format": FORMAT,
        "robot": model.robot,
        "gait": {
            "frequency_hz": model.frequency_hz,
            "joints": list(model.joints),
            "amplitude_rad": np.abs(model.command).tolist(),
            "phase_rad": np.angle(model.command).tolist(),
        },
        "parameters": [write(parameter) for parameter in model.parameters],
        "covariance": model.covariance.tolist(),
        "response": _pair(model.response),
        "slope": _pair(model.slope),
        "curvature": _pair(model.curvature),
        "modules": [{"kind": kind, **_pair(module)} for kind, module in model.modules.items()],
        "error": model.error,
        "made_by": model.made_by,
    }
    write_text(path, json.dumps(values, indent=1, allow_nan=False) + "\n")


def read_null_model(path: Path) -> NullModel:
    """Read a null model, strictly.

    Raises:
        InputFileError: If the file isn't there or can't be read.
        NullModelError: If it has faults; lists all of them.
    """
    try:
        values: Any = read_json(read_input(path))
    except ValueError as error:
        raise NullModelError(
            path, [DescriptionFault("syntax", str(error), "JSON in UTF-8")]
        ) from error
    if not isinstance(values, dict) or cast("dict[str, Any]", values).get("format") != FORMAT:
        raise NullModelError(path, [DescriptionFault("format", "no such format", f'"{FORMAT}"')])
    faults = Faults()
    top = StrictTable(cast("dict[str, Any]", values), "", faults)
    top.text("format")
    gait = top.table("gait")
    joints = gait.words("joints")
    if not joints:
        gait.fault("joints", "names of the driven joints, head to tail")
    m = len(joints)
    amplitude = _array(gait, "amplitude_rad", (m,))
    phase = _array(gait, "phase_rad", (m,))
    parameters = tuple(read(table, SharedParameter) for table in top.tables("parameters"))
    k = len(parameters)
    model = NullModel(
        robot=read_field(top, NullModel, "robot"),
        frequency_hz=read_field(gait, NullModel, "frequency_hz"),
        joints=joints,
        command=frozen(np.asarray(amplitude * np.exp(1j * phase), dtype=np.complex128)),
        parameters=parameters,
        covariance=frozen(_covariance(top, k)),
        response=_complex(top, "response", (m,)),
        slope=_complex(top, "slope", (k, m)),
        curvature=_complex(top, "curvature", (k, k, m)),
        modules=dict(_module(table, m) for table in top.tables("modules")),
        error=read_field(top, NullModel, "error"),
        made_by=read_field(top, NullModel, "made_by"),
    )
    if not model.modules:
        top.fault("modules", "at least one kind of deviation, e.g. stall_torque")
    gait.close()
    top.close()
    if noted := faults.all():
        raise NullModelError(path, noted)
    return model


def _module(table: StrictTable, m: int) -> tuple[str, ComplexArray]:
    kind, effect = table.name("kind"), _parts(table, (m, m))
    table.close()
    return kind, effect


def _covariance(top: StrictTable, k: int) -> FloatArray:
    covariance = _array(top, "covariance", (k, k))
    if np.isfinite(covariance).all():
        symmetric = np.allclose(covariance, covariance.T, rtol=1e-9)
        if not symmetric or np.linalg.eigvalsh(covariance).min(initial=1.0) <= 0:
            top.fault("covariance", "a symmetric, positive definite matrix", "another matrix")
    return covariance


def _complex(table: StrictTable, key: str, shape: tuple[int, ...]) -> ComplexArray:
    pair = table.table(key)
    y = _parts(pair, shape)
    pair.close()
    return y


def _parts(table: StrictTable, shape: tuple[int, ...]) -> ComplexArray:
    log_gain, lag_rad = (_array(table, name, shape) for name in ("log_gain", "lag_rad"))
    return frozen(log_gain - 1j * lag_rad)


def _pair(y: ComplexArray) -> dict[str, Any]:
    return {"log_gain": y.real.tolist(), "lag_rad": (-y.imag).tolist()}


def _array(table: StrictTable, key: str, shape: tuple[int, ...]) -> FloatArray:
    """Read nested arrays of finite numbers; NaN after a fault."""
    value = table.look(key)[1]
    flat: list[float] = []
    if not _fits(value, shape, flat):
        size = " x ".join(map(str, shape))
        table.fault(key, f"{size} finite numbers", None if value is None else "something else")
        return np.full(shape, math.nan)
    return np.array(flat, dtype=np.float64).reshape(shape)


def _fits(value: object, shape: tuple[int, ...], flat: list[float]) -> bool:
    """Return whether a value is nested arrays of a shape; append its numbers."""
    if not shape:
        good = isinstance(value, int | float) and not isinstance(value, bool)
        flat.append(float(cast("float", value)) if good else math.nan)
        return math.isfinite(flat[-1])
    if not isinstance(value, list) or len(cast("list[object]", value)) != shape[0]:
        return False
    return all(_fits(part, shape[1:], flat) for part in cast("list[object]", value))
