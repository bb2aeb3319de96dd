"""A session held to a null model: the same robot, the same gait, then the test.

One direction recorded, and a model of identical modules: does any module deviate?

Let y = ln(response / command) of m joints have the covariance S, block-diagonal by joints, and let
the model say f(x) for identical modules whose shared parameters are exp(x) times the assumed ones,
x known beforehand up to a covariance P (:mod:`.capture.robot.null_model`). Then, by generalised
least squares::

    Q = min r' S^-1 r + x' P^-1 x,    r = y - f(x) - D z

with z = 0 under H1 (identical modules), or z free for one module under H2. With all modules free
there are more unknowns than numbers, so they are tried one by one: Lambda_j = Q1 - Q2(j), and
T = max_j Lambda_j. Its null distribution is a parametric bootstrap from the fitted H1 (Efron &
Tibshirani, *An Introduction to the Bootstrap*, 1993, section 6.5), S drawn anew with its degrees
of freedom, too; the maximum makes p family-wise. While T is significant, the module is named,
joins the model, and the others are tried again (stepwise).

All of it is conditional on the model.
"""

from __future__ import annotations

import dataclasses
import hashlib
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

from undulog.capture import SessionView
from undulog.capture.common.arrays import ComplexArray, FloatArray, IntArray, frozen
from undulog.capture.common.errors import DataError, UsageError
from undulog.capture.robot.null_model import NullModel, read_null_model

from ..common.answer import beyond, distinct
from ..common.estimate import Estimate, Provenance
from ..estimators.intervals import CONFIDENCE, t_factor
from ..response.fitting import GaitFit
from ..response.response import Response
from ..results.analysis import Analysis
from ..results.comparison import (
    SIGNIFICANT,
    ModelledAnalysis,
    ModuleDeviation,
    NullModelResult,
    SharedEstimate,
    null_answer,
)
from ..session.analyse import measure_session
from ..session.measurement import SessionMeasurement
from ..session.runs import SAME_COMMAND, SAME_FREQUENCY
from ..signals.stretch import Options
from .mirror import parts

DRAWS = 1999


@dataclass(frozen=True)
class NullTest:
    """Test of one session against the model; m modules, K shared parameters, q kinds of deviation.

    Attributes:
        x: ln(theta / theta_0), shape (K,).
        x_error: Standard errors, shape (K,).
        fit: Q1.
        fit_p: p-value of Q1: do identical modules explain all that was seen?
        gain: Lambda_j of each module beside those named before it, shape (m,).
        p: Its family-wise p-value, shape (m,); of a module that isn't named: beside those named.
        deviation: ln(value / shared value) of each module's own parameters, shape (m, q).
        error: Standard errors, shape (m, q).
        critical: Factor on ``error`` that makes all m q intervals hold together at 95 %.
        named: Indices of the modules that deviate, the clearest first; none after one that deviates
            in a shared parameter by more than twice its reach, as its effect isn't linear.
        rest_p: p-value of what is left when the named ones deviate.
    """

    x: FloatArray
    x_error: FloatArray
    fit: float
    fit_p: float
    gain: FloatArray
    p: FloatArray
    deviation: FloatArray
    error: FloatArray
    critical: float
    named: tuple[int, ...]
    rest_p: float


@dataclass(frozen=True)
class _System:
    """The whitened linear system at the fitted x; draws of it have a leading axis.

    Attributes:
        shared: Columns of x, shape (..., n, K).
        modules: Columns of z, shape (..., n, m, q).
        rest: What the fit leaves, or noise, shape (..., n).
    """

    shared: FloatArray
    modules: FloatArray
    rest: FloatArray

    def beside(self, named: tuple[int, ...]) -> FloatArray:
        """Return columns of x and of the named modules, shape (..., n, K + q len(named))."""
        modules = self.modules[..., list(named), :]
        return np.concatenate([self.shared, modules.reshape(*modules.shape[:-2], -1)], axis=-1)


def null_test(response: Response, joints: IntArray, model: NullModel) -> NullTest:
    """Test identical modules against the model, and name those that deviate.

    Args:
        response: Of r joints.
        joints: Their places among the model's joints, shape (r,).
        model: The model of m joints.

    Raises:
        DataError: If fewer numbers than unknowns were seen, or no shared parameters fit.
    """
    kinds = np.stack(list(model.modules.values()), axis=-1)[:, joints]  # (m, r, q)
    variance = np.concatenate([response.log_gain_variance, response.lag_variance])
    if variance.size // kinds.shape[-1] < 2:
        raise DataError(f"{joints.size} joints with gain and lag are too few to hold to a model")
    most = min(variance.size // kinds.shape[-1] - 1, len(kinds))
    named: tuple[int, ...] = ()
    p = np.ones(len(kinds))
    whole: tuple[FloatArray, FloatArray] | None = None
    beyond_reach, reaches = (
        False,
        {parameter.name: parameter.reach for parameter in model.parameters},
    )
    reach = np.array([reaches.get(kind, np.inf) for kind in model.modules])
    while True:
        x, system = _linear(np.log(response.ratio), variance, joints, model, named)
        drawn = _draws(system, np.tile(response.dof, 2), np.random.default_rng(1))
        left, noise_left = _left(system, named), _left(drawn, named)
        whole = whole or (left, noise_left)
        gain, deviation, error = _one_by_one(system, named)
        noise_gain, noise_deviation, noise_error = _one_by_one(drawn, named)
        others = [j for j in range(len(kinds)) if j not in named]
        p[others] = _share(noise_gain[:, others].max(axis=1)[:, None], gain[others])
        best = others[int(np.argmax(gain[others]))]
        if p[best] >= SIGNIFICANT or len(named) + 1 >= most or beyond_reach:
            break
        named = (*named, best)
        # Of a deviation far beyond the model's reach it leaves what isn't linear to other modules.
        beyond_reach = bool(np.any(np.abs(deviation[best]) > 2 * reach))
    score = np.abs(noise_deviation / noise_error).max(axis=(1, 2))
    design = system.beside(named)
    information = np.linalg.inv(design.T @ design)
    return NullTest(
        x=frozen(x),
        x_error=frozen(np.sqrt(np.diag(information)[: x.size])),
        fit=float(whole[0]),
        fit_p=float(_share(whole[1], whole[0])),
        gain=frozen(gain),
        p=frozen(p),
        deviation=frozen(deviation),
        error=frozen(error),
        critical=float(np.quantile(score, CONFIDENCE, method="higher")),
        named=named,
        rest_p=float(_share(noise_left, left)),
    )


def _linear(
    y: ComplexArray,
    variance: FloatArray,
    joints: IntArray,
    model: NullModel,
    named: tuple[int, ...],
) -> tuple[FloatArray, _System]:
    """Fit x with the named modules free, and the system there."""
    effects = np.stack(list(model.modules.values()), axis=-1)[:, joints]  # (m, r, q)
    columns = np.concatenate([effects.real, effects.imag], axis=1).transpose(1, 0, 2)
    free = columns[:, list(named)].reshape(len(columns), -1)
    x = _fitted(y, variance, joints, model, free)
    # Where the shared parameters are far from the model's own, its error is noise, too.
    variance = variance + model.error_at(x) ** 2
    x = _fitted(y, variance, joints, model, free)
    weight, prior = 1 / np.sqrt(variance), _root(model)
    return x, _System(
        shared=np.concatenate([weight[:, None] * parts(model.at(x)[1][:, joints]).T, prior]),
        modules=np.concatenate(
            [weight[:, None, None] * columns, np.zeros((x.size, *columns.shape[1:]))]
        ),
        rest=np.concatenate([weight * _residual(y, joints, model, x), -prior @ x]),
    )


def _root(model: NullModel) -> FloatArray:
    """Return L with L' L = P^-1, shape (K, K)."""
    return np.linalg.cholesky(np.linalg.inv(model.covariance)).T.astype(np.float64)


def _residual(y: ComplexArray, joints: IntArray, model: NullModel, x: FloatArray) -> FloatArray:
    """Return the residual r = y - f(x), lags within half a turn, shape (2 r,)."""
    off = y - model.at(x)[0][joints]
    return parts(off.real + 1j * np.angle(np.exp(1j * off.imag)))


def _fitted(
    y: ComplexArray, variance: FloatArray, joints: IntArray, model: NullModel, columns: FloatArray
) -> FloatArray:
    """Fit x by Levenberg and Marquardt's method, beside the free columns of modules, (2 r, c)."""
    prior, weight, count = _root(model), 1 / np.sqrt(variance), len(model.parameters)
    free = np.concatenate([weight[:, None] * columns, np.zeros((count, columns.shape[1]))])

    def left(unknown: FloatArray) -> FloatArray:
        x, z = unknown[:count], unknown[count:]
        return np.concatenate([weight * _residual(y, joints, model, x), -prior @ x]) - free @ z

    def slope(unknown: FloatArray) -> FloatArray:
        shared = parts(model.at(unknown[:count])[1][:, joints]).T
        design = np.concatenate([weight[:, None] * shared, prior])
        return -np.concatenate([design, free], axis=1)

    start = np.zeros(count + columns.shape[1])
    from scipy.optimize import least_squares  # only for who asks for it: half a second

    solution = least_squares(left, start, jac=slope, method="lm", xtol=1e-12, ftol=1e-12)
    if solution.status <= 0:
        raise DataError("no shared parameters of the null model fit this session")
    return np.asarray(solution.x[:count], dtype=np.float64)


def _draws(system: _System, dof: FloatArray, random: np.random.Generator) -> _System:
    """Draw noise of the fitted H1, whitened by a covariance that is itself estimated."""
    count = dof.size
    half = count // 2
    # Gain and lag of a joint share their noise estimate.
    level = random.chisquare(dof[:half], (DRAWS, half)) / dof[:half]
    scale = np.ones((DRAWS, len(system.rest)))
    scale[:, :count] = np.tile(1 / np.sqrt(level), 2)
    return _System(
        shared=scale[..., None] * system.shared,
        modules=scale[..., None, None] * system.modules,
        rest=scale * random.normal(size=scale.shape),
    )


def _one_by_one(
    system: _System, named: tuple[int, ...]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return Lambda (..., m), deviations and errors (..., m, q) of each module by itself."""
    gain, deviation, error = _alone(system, system.beside(named))
    for j in named:
        base = system.beside(tuple(k for k in named if k != j))
        alone = _alone(_System(system.shared, system.modules[..., [j], :], system.rest), base)
        gain[..., j] = alone[0][..., 0]
        deviation[..., j, :], error[..., j, :] = alone[1][..., 0, :], alone[2][..., 0, :]
    return gain, deviation, error


def _alone(system: _System, base: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Add each module's columns to a base by itself (Frisch & Waugh, Econometrica 1, 1933)."""
    q, _ = np.linalg.qr(base)
    shape = system.modules.shape
    columns = system.modules.reshape(*shape[:-2], -1)
    columns = (columns - q @ (np.swapaxes(q, -1, -2) @ columns)).reshape(shape)
    rest = system.rest - (q @ (np.swapaxes(q, -1, -2) @ system.rest[..., None]))[..., 0]
    gram = np.einsum("...nmp,...nmq->...mpq", columns, columns)
    inverse = cast("FloatArray", np.linalg.pinv(gram, hermitian=True))
    pull = np.einsum("...nmq,...n->...mq", columns, rest)
    deviation = np.einsum("...mpq,...mq->...mp", inverse, pull)
    error = np.sqrt(np.einsum("...mqq->...mq", inverse))
    return np.sum(pull * deviation, axis=-1), deviation, error


def _left(system: _System, named: tuple[int, ...]) -> FloatArray:
    """Return Q with the named modules free, shape (...)."""
    q, _ = np.linalg.qr(system.beside(named))
    inside = (np.swapaxes(q, -1, -2) @ system.rest[..., None])[..., 0]
    return np.sum(system.rest**2, axis=-1) - np.sum(inside**2, axis=-1)


def _share(drawn: FloatArray, seen: FloatArray) -> FloatArray:
    """Return the share of the draws that reach the observed value, itself included: never 0."""
    return (1 + np.sum(drawn >= seen, axis=0)) / (len(drawn) + 1)


def analyse_with_null(
    session: SessionView, file: Path, options: Options | None = None
) -> ModelledAnalysis:
    """Analyse one session, and test it against a null model.

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
    result = _result(null_test(response, joints, model), model, file)
    outside = [parameter.name for parameter in result.parameters if not parameter.within]
    warnings = list(analysis.warnings)
    if outside:
        warnings.append(
            f"{', '.join(outside)}: fitted beyond where {file.name} holds; make a null model "
            "around the fitted values"
        )
    if silent := len(model.joints) - len(joints):
        warnings.append(f"{silent} joints without gain and lag are not held to the null model")
    fields: dict[str, Any] = {**vars(analysis), "warnings": tuple(warnings)}
    fields["provenance"] = _provenance(analysis, file)
    return ModelledAnalysis(**fields, null_model=result)


def _answered(
    measured: SessionMeasurement, model: NullModel, file: Path
) -> tuple[Response, np.ndarray[tuple[int], np.dtype[np.int64]]]:
    """Return the response of the joints that have one, and their indices in the model."""
    path, gait = measured.analysis.session.path, measured.gait
    robot = measured.analysis.session.robot
    fault = _other_gait(gait, model)
    if robot != model.robot:
        fault = f"it is of {robot or 'no known robot'}, the model of {model.robot}"
    if fault is not None or gait is None or gait.response is None:
        raise UsageError(f"{path} can't be held to {file}: {fault or 'it has no gain and lag'}")
    sound = {joint.name for joint in measured.analysis.joints if joint.lag_rad.value is not None}
    chosen = [k for k, name in enumerate(gait.answered) if name in sound]
    joints = np.array([model.joints.index(gait.answered[k]) for k in chosen], dtype=np.int64)
    return gait.response.select(chosen), joints


def _other_gait(gait: GaitFit | None, model: NullModel) -> str | None:
    """Return why the commands are another gait's; None if they are the model's."""
    if gait is None or not gait.driven:
        return "it has no gait with commands"
    if gait.others:
        return "its joints have several frequencies, the model one"
    if gait.driven != model.joints:
        return f"it drives {', '.join(gait.driven)}, the model {', '.join(model.joints)}"
    frequency, measured = model.frequency_hz, gait.fit.frequency_hz
    if abs(measured - frequency) > SAME_FREQUENCY * frequency:
        texts = distinct(measured, frequency)
        return f"its gait has {texts[0]} Hz, the model's {texts[1]} Hz"
    change = gait.fit.fundamental[: len(gait.driven)] / model.command
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
    return NullModelResult(
        answer=null_answer(modules, named, p, test.fit_p),
        condition=f"conditional on the model {file.name}",
        file=str(file),
        made_by=model.made_by,
        parameters=tuple(
            SharedEstimate(
                name=parameter.name,
                unit=parameter.unit,
                assumed=parameter.value,
                fitted=Estimate(
                    parameter.value * float(np.exp(x)),
                    (
                        parameter.value * float(np.exp(x - r)),
                        parameter.value * float(np.exp(x + r)),
                    ),
                ),
                within=bool(abs(x) <= parameter.reach),
            )
            for parameter, x, r in zip(model.parameters, test.x, reach, strict=True)
        ),
        fit=test.fit,
        fit_p=test.fit_p,
        p=p,
        modules=tuple(modules),
        named=tuple(named),
        rest_p=test.rest_p,
        draws=DRAWS,
    )


def _provenance(analysis: Analysis, file: Path) -> Provenance:
    provenance = analysis.provenance
    return dataclasses.replace(
        provenance,
        command=f"{provenance.command} {shlex.join(['--null', str(file)])}",
        inputs={**provenance.inputs, str(file): hashlib.sha256(file.read_bytes()).hexdigest()},
        options={**provenance.options, "null": str(file), "draws": DRAWS},
    )
