"""Compensation: on linear chains its commands are known in closed form."""

import math
from dataclasses import replace

import kick_tables
import numpy as np
import pytest

from support import linear_chain
from support.compensating import Wave, gait_run
from support.kick_runs import kicked
from undulog.analysis.experiment.kick_coupling import kick_coupling
from undulog.analysis.plan.compensate import RESERVE, compensation
from undulog.analysis.plan.runs import BaseGait
from undulog.analysis.response.response import Response
from undulog.capture import Session, load_robot
from undulog.capture.common.errors import DataError, UsageError
from undulog.capture.robot.model import Plane

M = 7
H, WANTED = kick_tables.chain(M)
H = H + 0.04j * np.diag(np.linspace(-1, 1, M))
WAVE = Wave(M)
NAMES = tuple(f"j{k + 1}" for k in range(M))
BASE = BaseGait(NAMES, tuple(range(M)), WANTED, np.zeros(M), WAVE.omega)


def coupling(*, noise=1e-7, scatter=0.0, size=1.0):
    """Analyse kicks of the chain; small ones and no noise make M exact."""
    random = np.random.default_rng(3)
    experiment = kicked(random, H, WANTED, kick_tables.plan(M), scatter, noise=noise, size=size)
    return kick_coupling(experiment, lambda _: None)


EXACT = replace(coupling(size=0.25), valid_to=0.5)


def answered(command):
    """Return the run of a command, and how unlike the joints respond to the wanted wave."""
    answer = H @ command
    small = np.full(M, 1e-12)
    run = gait_run(NAMES, WAVE, command, Response(answer / command, small, small, small + 20))
    return run, spreads(answer / WANTED)


def driven(command, local):
    return replace(answered(command)[0], names=local.joints)


def spreads(ratio):
    return np.abs(ratio).std() / np.abs(ratio).mean(), np.angle(ratio / ratio.mean()).std()


def test_newtons_step_is_that_of_the_planted_matrix():
    plan, commands = compensation(EXACT, BASE, None, keep=0.0)
    L = H * WANTED / (H @ WANTED)[:, None]  # d ln a = L d ln c of a linear chain
    matrix = np.block([[L.real, L.imag], [-L.imag, L.real]])  # of (d psi, d ln|.|)
    response = H @ WANTED / WANTED
    y = np.concatenate([np.angle(response), np.log(np.abs(response))])
    y = (y.reshape(2, M) - y.reshape(2, M).mean(axis=1, keepdims=True)).ravel()
    step = np.linalg.solve(matrix, -y)
    expected = step[M:] + 1j * (step[:M] - step[:M].mean())
    np.testing.assert_allclose(np.log(commands / WANTED), expected, atol=2e-4)
    assert plan.directions == 2 * M - 1
    assert plan.identified == pytest.approx(2 * M - 1, abs=1e-3)
    assert max(plan.predicted_gain_cv, plan.predicted_lag_sd) < 1e-4
    kicked_spread = plan.kicked.gain_cv.value, plan.kicked.lag_sd.value
    assert kicked_spread == pytest.approx(spreads(response), rel=1e-2)


def test_steps_from_what_was_measured_converge():
    history, after = [spreads(H @ WANTED / WANTED)], ()
    for _ in range(3):
        plan, commands = compensation(EXACT, BASE, None, after, keep=0.0)
        run, spread = answered(commands)
        turned = replace(run, command=run.command * np.exp(2j))  # a run starts at any time
        after = (turned, turned)
        history.append(spread)
    assert plan.now.gain_cv.value == pytest.approx(history[2][0], abs=1e-6)
    first, second, third = (
        np.linalg.norm(history[k + 1]) / np.linalg.norm(history[k]) for k in range(3)
    )
    assert first < 0.1
    assert max(second, third) < 0.1
    assert np.linalg.norm(history[-1]) < 1e-4
    assert np.abs(H @ commands).mean() == pytest.approx(plan.target_gain * 0.4, rel=1e-3)


def test_a_joint_at_its_limit_is_named_and_the_others_make_up_for_it():
    robot = load_robot("snake25")
    yaw = robot.joint_indices(Plane.HORIZONTAL)[:M]
    names = robot.joint_names
    base = BaseGait(names, tuple(yaw), WANTED, np.zeros(25), WAVE.omega)
    local = replace(EXACT, joints=tuple(names[k] for k in yaw))
    free, _ = compensation(local, base, None, keep=0.0)
    needs = np.array([joint.amplitude_rad for joint in free.joints])
    worst = int(np.argmax(needs))
    limit = float((needs[worst] + np.sort(needs)[-2]) / 2)
    joints = list(robot.joints)
    joints[yaw[worst]] = replace(joints[yaw[worst]], upper=limit / (1 - RESERVE))
    plan, commands = compensation(local, base, replace(robot, joints=tuple(joints)), keep=0.0)
    joint = plan.joints[worst]
    assert abs(commands[worst]) == pytest.approx(limit, rel=1e-6)
    assert (joint.limited_by, joint.margin) == ("position", pytest.approx(RESERVE))
    assert joint.lacking == pytest.approx(math.log(needs[worst] / limit), abs=1e-3)
    assert [other.name for other in plan.joints if other.lacking > 0] == [joint.name]
    again, held = compensation(
        local, base, replace(robot, joints=tuple(joints)), (driven(commands, local),), keep=0.0
    )
    assert abs(held[worst]) == pytest.approx(limit, rel=1e-6)
    assert again.joints[worst].lacking > 0
    # Better than cutting the command of that joint alone.
    _, cut = compensation(local, base, None, keep=0.0)
    cut[worst] *= limit / abs(cut[worst])
    here, there = (np.linalg.norm(spreads(H @ c / WANTED)) for c in (commands, cut))
    assert here < there
    low = replace(robot, joints=tuple(replace(j, upper=0.35, lower=-0.35) for j in robot.joints))
    with pytest.raises(UsageError, match=r"limit of 0\.35 rad already"):
        compensation(local, base, low)


def test_what_errors_hide_is_not_moved():
    sizes, identified = [], []
    for scale in (1, 1e2, 1e4):
        wide = {
            key: replace(
                getattr(EXACT, key),
                standard_error=tuple(
                    tuple(1e-3 * scale for _ in row) for row in EXACT.P.standard_error
                ),
            )
            for key in "PRGS"
        }
        plan, commands = compensation(replace(EXACT, **wide), BASE, None, keep=0.0)
        sizes.append(np.linalg.norm(np.log(commands / WANTED)))
        identified.append(plan.identified)
    assert sizes[0] > sizes[1] > 10 * sizes[2]
    assert identified[0] > 12.9
    assert identified[2] < 0.5


def test_the_price_of_a_change_holds_over_the_steps():
    """A linear chain ends where spread and change of the commands balance, from any step."""
    after, sizes = (), []
    for _ in range(4):
        _, commands = compensation(EXACT, BASE, None, after, keep=0.5)
        after = (answered(commands)[0],)
        sizes.append(np.linalg.norm(np.log(commands / WANTED)))
    _, free = compensation(EXACT, BASE, None, keep=0.0)
    assert sizes[3] == pytest.approx(sizes[2], rel=0.02)
    assert sizes[3] < 0.9 * np.linalg.norm(np.log(free / WANTED))


def test_what_does_not_fit_is_refused():
    run, _ = answered(WANTED)
    with pytest.raises(DataError, match="no amplitude kicks"):
        compensation(replace(EXACT, G=None), BASE, None)
    with pytest.raises(UsageError, match="of the gait that was kicked"):
        compensation(replace(EXACT, joints=NAMES[::-1]), BASE, None)
    with pytest.raises(UsageError, match="other commands"):
        compensation(
            EXACT,
            BASE,
            None,
            (run, replace(run, command=WANTED * 1.0 ** np.arange(M) * np.exp(0.1j * np.arange(M)))),
        )
    with pytest.raises(UsageError, match="other joints or another frequency"):
        compensation(EXACT, BASE, None, (replace(run, frequency_hz=0.6),))
    with pytest.raises(UsageError, match="above 0"):
        compensation(EXACT, BASE, None, target_gain=0.0)


@pytest.mark.nightly
def test_by_the_commands_of_the_manual(tmp_path, command, report_of):
    """Kicks, analysis, compensation, its recording, and again with --after."""
    paths = linear_chain.kicked(tmp_path)
    kicks = tmp_path / "kicks.json"
    command("analyse", *paths, "-o", kicks)
    words = ("plan", "compensate", kicks, "--like", paths[0])
    reports = []
    for k in range(2):
        more = ("--after", tmp_path / f"driven{k - 1}.mcap") if k else ()
        reports.append(report_of(*words, *more, "-o", tmp_path / f"next{k}"))
        asked = commanded(reports[-1]["files"][0])
        linear_chain.write_run(
            tmp_path / f"driven{k}.mcap", asked, linear_chain.CHAIN @ asked, 90 + k, 0.002
        )
    first, second = reports
    assert (first["plan"], first["settle_s"]) == ("compensate", 10.0)
    assert first["now"] == first["kicked"] == second["kicked"]
    for name in ("gain_cv", "lag_sd"):
        assert second["now"][name]["ci95"][1] < 0.5 * first["now"][name]["ci95"][0]
    text = command(*words, "-o", tmp_path / "text").out
    assert "Gain CV" in text
    assert "The kicks identify" in text
    command(*words, "-o", tmp_path / "text", code=2)  # it is there


def commanded(file):
    """Return the commands' complex amplitudes, by a plain sum over the last 10 s."""
    with Session.open(file) as session:
        signals = session.joints("/joint_commands")
        columns = [signals.signal(name) for name in linear_chain.NAMES]
        t = (columns[0].t_ns - session.start_ns) * 1e-9
    used = (t >= 10.0 - 1e-9) & (t < 20.0 - 1e-9)
    values = np.stack([column.values for column in columns])[:, used]
    return 2 / used.sum() * values @ np.exp(-2j * np.pi * t[used])
