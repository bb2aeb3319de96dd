"""A session held to a null model: the same robot, the same gait, then the test."""

from __future__ import annotations

import dataclasses
import hashlib
import shlex
from pathlib import Path

import numpy as np

from undulog.capture import Session
from undulog.capture.common.errors import UsageError
from undulog.capture.robot.null_model import NullModel, read_null_model

from ...estimators.intervals import t_factor
from ...response.fitting import GaitFit
from ...response.response import Response
from ...results.analysis import Analysis
from ...results.deciding import beyond, distinct
from ...results.estimate import Estimate, Provenance
from ...results.null_model import (
    ModelledAnalysis,
    ModuleDeviation,
    NullModelResult,
    SharedEstimate,
    null_answer,
)
from ...session.analyse import Measured, measure_session
from ...session.runs import SAME_COMMAND, SAME_FREQUENCY
from ...signals.stretch import Options
from .deviation import DRAWS, NullTest, null_test


def analyse_with_null(
    session: Session, file: Path, options: Options | None = None
) -> ModelledAnalysis:
    """Everything that one session can tell, and its test against a null model.

    Args:
        session: An open session.
        file: The null model.
        options: What the user chose.

    Returns:
        The result.

    Raises:
        InputFileError: If the file isn't there or can't be read.
        UsageError: If it is of another robot or gait.
        NullModelError: If the file has faults.
        MissingChannelError: If the session has neither commands nor responses.
        DataError: If they hold too few samples.
    """
    model = read_null_model(file)
    measured = measure_session(session, options)
    analysis = measured.analysis
    response, joints = _answered(measured, model, file)
    test = null_test(response, joints, model)
    result = _result(test, model, file)
    outside = [one.name for one in result.parameters if not one.within]
    warnings = list(analysis.warnings)
    if outside:
        warnings.append(
            f"{', '.join(outside)}: fitted beyond where {file.name} holds; make a null model "
            "around the fitted values"
        )
    silent = len(model.joints) - len(joints)
    if silent:
        warnings.append(f"{silent} joints without gain and lag are not held to the null model")
    known = {one.name: getattr(analysis, one.name) for one in dataclasses.fields(Analysis)}
    known |= {"warnings": tuple(warnings), "provenance": _provenance(analysis, file)}
    return ModelledAnalysis(**known, null_model=result)


def _answered(
    measured: Measured, model: NullModel, file: Path
) -> tuple[Response, np.ndarray[tuple[int], np.dtype[np.int64]]]:
    """The response of the joints that answer, and their places in the model."""
    path, gait = measured.analysis.session.path, measured.gait
    fault = _other_robot(measured.analysis, model) or _other_gait(gait, model)
    if fault is not None or gait is None or gait.response is None:
        raise UsageError(f"{path} can't be held to {file}: {fault or 'it has no gain and lag'}")
    sound = {one.name for one in measured.analysis.joints if one.lag_rad.value is not None}
    chosen = [k for k, name in enumerate(gait.answered) if name in sound]
    joints = np.array([model.joints.index(gait.answered[k]) for k in chosen], dtype=np.int64)
    return gait.response.select(chosen), joints


def _other_robot(analysis: Analysis, model: NullModel) -> str | None:
    robot = analysis.session.robot
    if robot == model.robot:
        return None
    return f"it is of {robot or 'no known robot'}, the model of {model.robot}"


def _other_gait(gait: GaitFit | None, model: NullModel) -> str | None:
    """Why the commands are another gait's; None if they are the model's."""
    if gait is None or not gait.driven:
        return "it has no gait with commands"
    if gait.others:
        return "its joints have several frequencies, the model one"
    if gait.driven != model.joints:
        return f"it drives {', '.join(gait.driven)}, the model {', '.join(model.joints)}"
    frequency, own = model.frequency_hz, gait.fit.frequency_hz
    if abs(own - frequency) > SAME_FREQUENCY * frequency:
        texts = distinct(own, frequency)
        return f"its gait has {texts[0]} Hz, the model's {texts[1]} Hz"
    command = gait.fit.fundamental[: len(gait.driven)]
    change = command / model.command
    off = np.abs(change * np.exp(-1j * np.angle(np.sum(change))) - 1)
    worst = int(np.argmax(off))
    if off[worst] <= SAME_COMMAND:
        return None
    size = beyond(100 * float(off[worst]), 100 * SAME_COMMAND)
    return (
        f"its command at {model.joints[worst]} is {size} % off the model's, more than "
        f"{100 * SAME_COMMAND:g} %: another amplitude, lag or direction"
    )


def _result(test: NullTest, model: NullModel, file: Path) -> NullModelResult:
    half = test.critical * test.error
    low, high = np.expm1(test.deviation - half), np.expm1(test.deviation + half)
    value = np.expm1(test.deviation)
    modules = [
        ModuleDeviation(
            name=name,
            named=j in test.named,
            gain=float(test.gain[j]),
            p=float(test.p[j]),
            relative={
                kind: Estimate(float(value[j, k]), (float(low[j, k]), float(high[j, k])))
                for k, kind in enumerate(model.modules)
            },
        )
        for j, name in enumerate(model.joints)
    ]
    named = [model.joints[j] for j in test.named]
    p = float(test.p[test.named[0]] if test.named else test.p.min())
    reach = t_factor(np.inf) * test.x_error
    parameters = tuple(
        SharedEstimate(
            name=one.name,
            unit=one.unit,
            assumed=one.value,
            fitted=Estimate(
                one.value * float(np.exp(x)),
                (one.value * float(np.exp(x - r)), one.value * float(np.exp(x + r))),
            ),
            within=bool(abs(x) <= one.reach),
        )
        for one, x, r in zip(model.parameters, test.x, reach, strict=True)
    )
    return NullModelResult(
        answer=null_answer(modules, named, p, test.fit_p),
        condition=f"conditional on the model {file.name}",
        file=str(file),
        made_by=model.made_by,
        parameters=parameters,
        fit=test.fit,
        fit_p=test.fit_p,
        p=p,
        modules=tuple(modules),
        named=tuple(named),
        rest_p=test.rest_p,
        draws=DRAWS,
    )


def _provenance(analysis: Analysis, file: Path) -> Provenance:
    own = analysis.provenance
    digest = hashlib.sha256(file.read_bytes()).hexdigest()
    return dataclasses.replace(
        own,
        command=f"{own.command} {shlex.join(['--null', str(file)])}",
        inputs={**own.inputs, str(file): digest},
        options={**own.options, "null": str(file), "draws": DRAWS},
    )
