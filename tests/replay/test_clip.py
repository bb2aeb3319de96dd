"""Clips as others read them: Pillow reads the GIF, Chromium plays the MP4."""

import base64
import contextlib
import io
import os
import signal

import numpy as np
import pytest
from PIL import Image

from support import golden_pictures
from support.processes import UNDULOG, process, undulog, wait_for
from undulog.capture.common.errors import UsageError
from undulog.replay.film import Shot, open_film

VERMILION = (255, 84, 48)
GROUND = (16, 18, 22)


def square(step, size=(160, 160)):
    """A vermilion square on dark ground, 4 pixels further to the right at every step."""
    frame = Image.new("RGB", size, GROUND)
    frame.paste(VERMILION, (8 + 4 * step, 40, 28 + 4 * step, 60))
    return frame


def squares(path, *, kind, fps, count=25):
    frames = [square(step) for step in range(count)]
    with open_film(path, kind=kind, size=(160, 160), fps=fps, samples=frames[::8]) as film:
        for frame in frames:
            film.add(frame)


def glowing(picture):
    """Where it is vermilion."""
    return golden_pictures.glowing(np.asarray(picture.convert("RGB")).astype(int))


def left_edge(picture):
    return int(np.flatnonzero(glowing(picture).any(axis=0))[0])


def gif_frames(path):
    """Frames and how long each is shown [ms], as Pillow reads them."""
    frames, shown_ms = [], []
    with Image.open(path) as gif:
        for number in range(gif.n_frames):
            gif.seek(number)
            frames.append(gif.convert("RGB"))
            shown_ms.append(gif.info["duration"])
    return frames, shown_ms


class TestShot:
    def test_frames_stand_at_equal_steps_and_end_before_the_end(self):
        assert np.allclose(Shot(2.0, 3.0, fps=10).times_s, 2.0 + 0.1 * np.arange(10), atol=1e-12)
        assert len(Shot(0.0, 2.0, fps=25, speed=0.25).times_s) == 200  # slow motion
        assert Shot(1.0, 1.001).times_s.tolist() == [1.0]

    @pytest.mark.parametrize(
        ("wrong", "complaint"),
        [
            ({"start_s": 3.0}, "0 <= from < to"),
            ({"start_s": float("nan")}, "0 <= from < to"),
            ({"fps": 0}, "1 to 100"),
            ({"speed": 0.0}, "0.001 to 1000"),
            ({"speed": float("nan")}, "0.001 to 1000"),
            ({"size": (100, 4000)}, "WIDTHxHEIGHT"),
        ],
    )
    def test_nonsense_is_refused(self, wrong, complaint):
        with pytest.raises(UsageError, match=complaint):
            Shot(**({"start_s": 0.0, "end_s": 3.0} | wrong))


class TestFiles:
    @pytest.mark.parametrize("fps", [12, 25, 30])
    def test_pillow_reads_the_gif(self, tmp_path, fps):
        squares(tmp_path / "a", kind=".gif", fps=fps)
        frames, shown_ms = gif_frames(tmp_path / "a")
        with Image.open(tmp_path / "a") as gif:
            assert gif.info["loop"] == 0  # it repeats
        assert [frame.size for frame in frames] == [(160, 160)] * 25
        assert [left_edge(frame) for frame in frames] == [8 + 4 * step for step in range(25)]
        # A GIF counts hundredths of a second; what it rounds doesn't add up.
        assert abs(sum(shown_ms) - 25_000 / fps) <= 10
        assert np.abs(np.array(frames[7].getpixel((45, 50))) - VERMILION).max() <= 8
        assert np.abs(np.array(frames[7].getpixel((5, 5))) - GROUND).max() <= 8

    @pytest.mark.slow
    def test_chromium_plays_the_mp4(self, tmp_path, browser):
        squares(tmp_path / "a", kind=".mp4", fps=10)
        facts, frame = played(browser, tmp_path / "a", 1.25)
        assert facts == {"width": 160, "height": 160, "duration": 2.5}
        assert left_edge(frame) == 8 + 4 * 12
        # Named colours: without them a player guesses, and vermilion turns to brick.
        assert np.abs(np.array(frame.getpixel((66, 50))) - VERMILION).max() <= 10


def played(browser, path, seconds):
    """What Chromium says of a clip, and its picture at a time."""
    data = base64.b64encode(path.read_bytes()).decode()
    browser.open("about:blank")
    browser.evaluate(
        f"""new Promise((done, failed) => {{
            window.clip = document.createElement('video');
            clip.onerror = () => failed(new Error(clip.error.message));
            clip.onseeked = done;
            clip.onloadeddata = () => {{ clip.currentTime = {seconds}; }};
            clip.src = 'data:video/mp4;base64,{data}';
        }}).then(() => true)"""
    )
    size = "width: clip.videoWidth, height: clip.videoHeight"
    facts = browser.evaluate(f"({{{size}, duration: clip.duration}})")
    shot = browser.evaluate(
        """(() => {
            const canvas = document.createElement('canvas');
            canvas.width = clip.videoWidth; canvas.height = clip.videoHeight;
            canvas.getContext('2d').drawImage(clip, 0, 0);
            return canvas.toDataURL('image/png');
        })()"""
    )
    return facts, Image.open(io.BytesIO(base64.b64decode(shot.partition(",")[2]))).convert("RGB")


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["--clip", "a.mov"], ".gif or .mp4"),
        (["--clip", "a.gif", "--fps", "60"], "at most 50"),
        (["--clip", "a.mp4", "--size", "641x480"], "even width"),
        (["--clip", "a.mp4", "--size", "big"], "WIDTHxHEIGHT"),
        (["--clip", "a.mp4", "--to", "99"], "ends at 2.990 s"),
        (["--clip", "a.mp4", "--from", "2", "--to", "1"], "0 <= from < to"),
        (["--clip", "a.mp4", "--web"], "without"),
        (["--clip", "a.mp4", "--save", "a.rrd"], "without"),
        (["--from", "0", "--size", "640x480"], "--from, --size"),
    ],
)
def test_wrong_usage_is_explained(session_file, tmp_path, arguments, complaint, command):
    with contextlib.chdir(tmp_path):
        assert complaint in command("view", session_file, *arguments, code=2).err
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_overwritten_without_force(session_file, command, tmp_path):
    clip = tmp_path / "a.gif"
    clip.write_bytes(b"mine")
    assert "--force" in command("view", session_file, "--clip", clip, code=2).err
    assert clip.read_bytes() == b"mine"


def test_a_session_without_a_body_says_what_it_takes(write, command, tmp_path):
    words = (write(tmp_path / "a.mcap", robot=False), "--clip", tmp_path / "a.gif")
    assert "robot description" in command("view", *words, code=1).err
    assert [path.name for path in tmp_path.iterdir()] == ["a.mcap"]


@pytest.mark.nightly
def test_a_gif_shows_the_gait(session_file, vulkan, report_of, tmp_path):
    clip = tmp_path / "a.gif"
    part = ("--from", 0.4, "--to", 2.8, "--fps", 5, "--size", "480x300")
    report = report_of("view", session_file, "--clip", clip, *part)
    frames, shown_ms = gif_frames(clip)
    assert report["bytes"] == clip.stat().st_size
    assert (report["frames"], report["duration_s"], report["size"]) == (12, 2.4, [480, 300])
    assert ([frame.size for frame in frames], sum(shown_ms)) == ([(480, 300)] * 12, 2400)
    # The camera goes with the body, and the gait's period is 2 s: ten frames.
    now, later, half = (glowing(frames[number]) for number in (0, 10, 5))
    assert now.sum() > 300
    assert shared(now, later) > 0.9
    assert shared(now, half) < 0.6


def shared(area, other):
    """Common part of two areas, 0 to 1."""
    return (area & other).sum() / (area | other).sum()


@pytest.mark.nightly
def test_an_mp4_of_the_body_plays_in_chromium(session_file, vulkan, browser, command, tmp_path):
    part = ("--to", 1, "--fps", 10, "--speed", 0.5, "--size", "640x360")
    output = command("view", session_file, "--clip", tmp_path / "a.mp4", *part).out
    facts, frame = played(browser, tmp_path / "a.mp4", 1.0)
    assert "20 frames of 640x360" in output
    assert facts == {"width": 640, "height": 360, "duration": 2.0}
    assert glowing(frame).sum() > 500


@pytest.mark.nightly
def test_without_a_vulkan_driver_the_packages_are_named(session_file, tmp_path):
    env = os.environ | dict.fromkeys(("VK_DRIVER_FILES", "VK_ICD_FILENAMES"), "/nonexistent")
    done = undulog("view", session_file, "--clip", tmp_path / "a.mp4", env=env, code=1)
    assert "mesa-vulkan-drivers" in done.stderr
    assert "Traceback" not in done.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.nightly
def test_ctrl_c_leaves_nothing_behind(session_file, vulkan, tmp_path):
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    words = ("--clip", tmp_path / "a.mp4", "--speed", "0.01", "--size", "320x180")
    options = {"start_new_session": True, "env": os.environ | {"TMPDIR": str(scratch)}}
    with process(*UNDULOG, "view", session_file, *words, **options) as running:
        wait_for((tmp_path / "a.mp4.part").exists, "the clip", alive=[running])
        os.killpg(running.pid, signal.SIGINT)  # as a terminal does, to all in front
        _, err = running.communicate()
    assert running.returncode == 1
    assert "stopped on request" in err
    assert (list(scratch.iterdir()), list(tmp_path.iterdir())) == ([], [scratch])
