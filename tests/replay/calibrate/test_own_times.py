"""Fits to commands and samples that lie beside the control ticks, and to several sessions."""

import contextlib
import io
import math

import numpy as np
import pytest

from support.twin_fits import exact, jittered, restamped, room_for, rounded
from undulog.replay.calibrate.fit import Wanted, calibrate
from undulog.sim.scenario.scenario import Kernels

FOUR = {"stall_torque": 0.3, "coulomb_friction": 0.03, "mu_tangential": 0.05, "mu_normal": 0.5}
NOISE = 0.002
STAMPS = {"exact": exact, "rounded": rounded, "jittered": jittered}


def hidden_of(truth, *, servo="", module="", ground=""):
    """The part of a scenario that is hidden."""
    of_servo = [f"{key} = {truth[key]}\n" for key in ("stall_torque", "coulomb_friction")]
    of_ground = [f"{key} = {truth[key]}\n" for key in ("mu_tangential", "mu_normal")]
    table = "[world.ground]\n" + "".join(of_ground) + ground
    return "[servo]\n" + "".join(of_servo) + servo + module + table


def drawn(number):
    """Parameters 12 % off (standard deviation)."""
    random = np.random.default_rng(1000 + number)
    return {key: value * math.exp(0.12 * random.standard_normal()) for key, value in FOUR.items()}


def fit(paths, room, only=tuple(FOUR)):
    request = Wanted(only=only, settle_s=1.5)
    return calibrate(paths, str(room / "nominal.toml"), request, kernels=Kernels.NUMBA)


def width(parameter):
    return parameter.ci95[1] - parameter.ci95[0]


@pytest.fixture(scope="module")
def strong(tmp_path_factory):
    """Strong servos, which follow a command that slips by 10 ms within 2 ms."""
    room = tmp_path_factory.mktemp("strong")
    room_for(room, 3, 5.0, "[servo]\nstall_torque = 1.5\n", noise=0.0, stall=1.2)
    return room


@pytest.mark.slow
def test_stamps_beside_the_ticks_give_the_same_parameters(strong):
    """The same rows: held by the ticks, jitter made 0.6 N m of 1.5, 114 ns a misfit of 8 mrad."""
    only = ("stall_torque", "coulomb_friction", "proportional_gain")
    fits = {
        name: fit(
            [restamped(strong / "run.mcap", strong / f"{name}.mcap", stamps, noise=NOISE, seed=1)],
            strong,
            only,
        )
        for name, stamps in STAMPS.items()
    }
    for name, most in (("exact", 1.0), ("rounded", 1.2), ("jittered", 2.0)):
        assert not fits[name].lack.significant
        for mine, best in zip(fits[name].parameters, fits["exact"].parameters, strict=True):
            assert mine.ci95[0] <= best.value <= mine.ci95[1]
            assert width(mine) <= most * width(best)
        stall = fits[name].parameters[0]
        assert stall.ci95[0] <= 1.5 <= stall.ci95[1]
        rms = np.sqrt(np.mean([joint.rms**2 for joint in fits[name].after.values()]))
        assert rms == pytest.approx(NOISE, rel=0.15)


@pytest.mark.slow
def test_several_sessions_have_one_answer(strong, tmp_path, report_of, command):
    """Two noises of one motion: intervals shrink by about the root of two, and one is in both."""
    a, b = (
        restamped(strong / "run.mcap", tmp_path / f"{name}.mcap", rounded, noise=NOISE, seed=seed)
        for seed, name in enumerate("ab", start=2)
    )
    single, both = (fit(paths, strong, ("stall_torque",)) for paths in ([a], [a, b]))
    (alone,), (shared,) = single.parameters, both.parameters
    assert both.sessions == (str(a), str(b))
    assert list(both.after) == [f"joint0{j} of {name}.mcap" for name in "ab" for j in (1, 2, 3)]
    assert shared.ci95[0] <= 1.5 <= shared.ci95[1]
    low = shared.value - shared.ci95[0], alone.value - alone.ci95[0]  # the step widens the high end
    assert low[0] / low[1] == pytest.approx(math.sqrt(0.5), rel=0.25)
    words = ("--on", f"twin:{strong / 'nominal.toml'}", "--only", "stall_torque", "--settle", "1.5")
    report = report_of("sim", "fit", a, b, *words, "-o", tmp_path / "f.toml")
    assert report["sessions"] == [str(a), str(b)]
    assert report["parameters"][0]["value"] == pytest.approx(shared.value)
    assert "fitted to a.mcap, b.mcap." in (tmp_path / "f.toml").read_text()
    twice = command("sim", "fit", a, a, *words, "-o", tmp_path / "g.toml", code=2)
    assert "is given twice" in twice.err


@pytest.mark.slow
def test_sessions_of_different_servos_are_refused(strong, tmp_path, command):
    """One robot's second session after its servos changed: no common parameters fit both."""
    weaker = (
        (strong / "hidden.toml").read_text().replace("stall_torque = 1.5", "stall_torque = 1.1")
    )
    (strong / "weaker.toml").write_text(weaker)
    command("sim", "run", strong / "weaker.toml", "-o", tmp_path / "b.mcap", "--kernels", "numba")
    a = restamped(strong / "run.mcap", tmp_path / "a.mcap", exact, noise=NOISE, seed=4)
    b = restamped(tmp_path / "b.mcap", tmp_path / "c.mcap", exact, noise=NOISE, seed=5)
    lack = fit([a, b], strong, ("stall_torque",)).lack
    assert lack.significant
    assert lack.unfitted.by_session
    assert lack.unfitted.p < 1e-3
    words = ("sim", "fit", strong / "run.mcap", tmp_path / "b.mcap", "--only", "stall_torque")
    other = command(*words, "-o", tmp_path / "f.toml", code=2)  # each in its own world
    assert "--on twin:SCENARIO" in other.err


@pytest.mark.nightly
@pytest.mark.parametrize("noise", [0.0005, 0.002])
def test_a_finer_twin_is_within_the_intervals_and_not_refused(noise, tmp_path):
    """The robot takes steps of 0.2 ms, the twin of 1 ms, which moves the stall torque by 4 %."""
    truth = drawn(1)
    room_for(tmp_path, 3, 5.0, hidden_of(truth), noise=0.0, rate_hz=5000)
    path = restamped(tmp_path / "run.mcap", tmp_path / "a.mcap", exact, noise=noise, seed=78)
    result = fit([path], tmp_path)
    assert not result.lack.significant
    assert result.step.rms > 2e-4
    for parameter in result.parameters:
        assert parameter.ci95[0] <= truth[parameter.name] <= parameter.ci95[1]


@pytest.mark.nightly
def test_intervals_cover_and_the_right_law_is_left_alone(tmp_path):
    """20 parameter sets, three kinds of stamps: 240 intervals, 60 fits."""
    inside = {name: [] for name in STAMPS}
    refused, ratios = [], {name: [] for name in STAMPS}
    for number in range(20):
        room, truth = tmp_path / str(number), drawn(number)
        room.mkdir()
        with contextlib.redirect_stdout(io.StringIO()):
            room_for(room, 3, 5.0, hidden_of(truth), noise=0.0)
        best = None
        for name, stamps in STAMPS.items():
            path = room / f"{name}.mcap"
            restamped(room / "run.mcap", path, stamps, noise=NOISE, seed=number)
            result = fit([path], room)
            refused.append(result.lack.significant)
            if result.lack.significant:
                continue
            best = result if name == "exact" else best
            inside[name] += [p.ci95[0] <= truth[p.name] <= p.ci95[1] for p in result.parameters]
            if best is not None:
                pairs = zip(result.parameters, best.parameters, strict=True)
                ratios[name] += [width(mine) / width(other) for mine, other in pairs]
    share = {name: float(np.mean(covered)) for name, covered in inside.items()}
    most = {name: float(np.max(ratio)) for name, ratio in ratios.items()}
    print(f"inside {share}; refused {sum(refused)} of {len(refused)}; width at most {most}")
    assert min(share.values()) >= 0.90
    assert np.mean(refused) <= 0.05
    assert most["rounded"] <= 1.2
    assert most["jittered"] <= 2.0


WRONG = {
    "transeth": {"ground": 'law = "transeth"\n'},
    "box": {"ground": 'law = "box"\n'},
    "play": {"servo": "backlash = 0.04\n"},
    "stiction": {"servo": "static_friction = 0.09\nstribeck_speed = 0.3\n"},
    "weak": {"module": "[servo_of.joint02]\nstall_torque = 0.15\n"},
}


@pytest.mark.nightly
def test_a_wrong_law_of_three_times_the_noise_is_refused(tmp_path):
    """Four parameter sets of each law, the noise a third of the misfit that the law leaves."""
    refused = []
    for law, extra in WRONG.items():
        for number in range(100, 104):
            room = tmp_path / f"{law}{number}"
            room.mkdir()
            with contextlib.redirect_stdout(io.StringIO()):
                room_for(room, 3, 5.0, hidden_of(drawn(number), **extra), noise=0.0)
            clean = restamped(room / "run.mcap", room / "clean.mcap", exact, noise=1e-5)
            after = fit([clean], room).after.values()
            misfit = float(np.sqrt(np.mean([joint.rms**2 for joint in after])))
            for name, stamps in (("exact", exact), ("rounded", rounded)):
                path = room / f"{name}.mcap"
                restamped(room / "run.mcap", path, stamps, noise=misfit / 3, seed=number)
                lack = fit([path], room).lack
                refused.append(lack.significant)
                named = lack.explanation
                print(law, number, name, f"{misfit:.2g} rad, p {lack.p:.2g}", named and named.label)
                assert named is None or named.size > 0.0
    assert np.mean(refused) >= 0.95
