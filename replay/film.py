"""Moving pictures of the body: frames at set times, drawn off screen by Rerun's own viewer.

Nothing is filmed while it plays: every frame stands still at its own time until it is drawn whole,
so the same session gives the same frames however slow the machine is.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, ClassVar

import av
import numpy as np
import rerun.blueprint as rrb
from av.error import FFmpegError
from av.video.reformatter import ColorPrimaries, ColorRange, Colorspace, ColorTrc
from PIL import Image, ImageDraw, ImageFont

from undulog.capture.common.arrays import FloatArray
from undulog.capture.common.errors import DataError, LogWriteError, UndulogError, UsageError
from undulog.capture.common.files import check_stop, part_file
from undulog.capture.common.process import StopRequest

from .layout import build_views
from .samples.content import Content
from .viewer import HeadlessViewer

GIF_FPS = 50
"""More frames a second than this a browser slows down to ten."""

_COLORS = 128

SIDES = (160, 2160)
"""Shortest and longest side of a clip [pixels]."""

# What this viewer draws around a single view [pixels]; measured again where it does not.
_FRAME = (7, 71)
_SAMPLES = 8


@contextmanager
def open_film(
    path: Path,
    *,
    kind: str,
    size: tuple[int, int],
    fps: int,
    samples: Sequence[Image.Image],
) -> Generator[Film]:
    """Write a film; it is whole on leaving.

    Args:
        path: The file, replaced if it is there.
        kind: ``.gif`` or ``.mp4``.
        size: Width and height [pixels].
        fps: Frames a second.
        samples: A few of the frames to come, which a GIF's colours are chosen from.

    Raises:
        UsageError: If this kind of file can't hold such frames.
        LogWriteError: If it can't be written.
    """
    check_film(kind, size, fps)
    frames = _Gif if kind == ".gif" else _Mp4
    try:
        with av.open(path, "w", format=kind[1:], options=frames.options) as container:
            film = frames(container, size, fps, samples)
            yield film
            film.end()
    except FFmpegError as error:
        raise LogWriteError(path, f"can't be written: {error.strerror or error}") from error


def check_film(kind: str, size: tuple[int, int], fps: int) -> None:
    """Check what a kind of file can hold, before any work is done.

    Args:
        size: Width and height [pixels].
        fps: Frames a second.

    Raises:
        UsageError: If it can't hold them.
    """
    if kind not in {".gif", ".mp4"}:
        raise UsageError(f"a clip ends in .gif or .mp4, not in {kind or 'nothing'}")
    if kind == ".gif" and fps > GIF_FPS:
        raise UsageError(f"--fps {fps}: browsers show at most {GIF_FPS} frames of a GIF a second")
    if kind == ".mp4" and any(side % 2 for side in size):
        raise UsageError(f"--size {size[0]}x{size[1]}: H.264 needs an even width and height")


class Film:
    """A file that takes frames: one stream of a container."""

    codec: ClassVar[str]
    pixels: ClassVar[str]
    options: ClassVar[dict[str, str]] = {}

    def __init__(
        self, container: Any, size: tuple[int, int], fps: int, _samples: Sequence[Image.Image]
    ) -> None:
        """Add a stream to the container."""
        self._container = container
        self._stream = container.add_stream(self.codec, rate=fps)
        self._stream.width, self._stream.height = size
        self._stream.pix_fmt = self.pixels
        self._step, self._count = Fraction(1, fps), 0

    def add(self, frame: Image.Image) -> None:
        """Append a frame.

        Args:
            frame: RGB, of the film's size.
        """
        raise NotImplementedError

    def end(self) -> None:
        """Write what the encoder still holds."""
        self._container.mux(self._stream.encode())

    def _write(self, frame: av.VideoFrame) -> None:
        frame.pts, frame.time_base = self._count, self._step
        self._count += 1
        self._container.mux(self._stream.encode(frame))


class _Gif(Film):
    """One palette for all frames and no dither: what doesn't move doesn't flicker, and is small."""

    codec, pixels = "gif", "pal8"

    def __init__(
        self, container: Any, size: tuple[int, int], fps: int, samples: Sequence[Image.Image]
    ) -> None:
        super().__init__(container, size, fps, samples)
        sheet = Image.new("RGB", (size[0], size[1] * len(samples)))
        for row, sample in enumerate(samples):
            sheet.paste(sample, (0, row * size[1]))
        # By coverage: a median cut spends its colours on the ground and loses the markers'.
        self._palette = sheet.quantize(
            _COLORS, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE
        )
        colors = np.array(self._palette.getpalette("RGB"), dtype=np.uint8).reshape(-1, 3)
        self._argb = np.zeros((256, 4), dtype=np.uint8)
        self._argb[:, 0] = 255
        self._argb[: len(colors), 1:] = colors

    def add(self, frame: Image.Image) -> None:
        """Append a frame."""
        indices = frame.quantize(palette=self._palette, dither=Image.Dither.NONE)
        both: Any = (np.asarray(indices), self._argb)  # the stub knows no pair
        self._write(av.VideoFrame.from_ndarray(both, format="pal8"))


class _Mp4(Film):
    """H.264 that every browser plays, its colours named, its index in front."""

    codec, pixels = "libx264", "yuv420p"
    options: ClassVar[dict[str, str]] = {"movflags": "+faststart"}

    def __init__(
        self, container: Any, size: tuple[int, int], fps: int, samples: Sequence[Image.Image]
    ) -> None:
        super().__init__(container, size, fps, samples)
        coder = self._stream.codec_context
        coder.options = {"crf": "18", "preset": "medium"}
        coder.colorspace, coder.color_range = Colorspace.ITU709, ColorRange.MPEG
        coder.color_primaries, coder.color_trc = ColorPrimaries.BT709, ColorTrc.IEC61966_2_1

    def add(self, frame: Image.Image) -> None:
        """Append a frame."""
        self._write(
            av.VideoFrame.from_ndarray(np.asarray(frame), format="rgb24").reformat(
                format="yuv420p",
                dst_colorspace=Colorspace.ITU709,
                dst_color_range=ColorRange.MPEG,
                dst_color_primaries=ColorPrimaries.BT709,
                dst_color_trc=ColorTrc.IEC61966_2_1,
            )
        )


@dataclass(frozen=True)
class Shot:
    """Time window, frame rate and size of a clip.

    Attributes:
        start_s: Where it begins on ``session_time`` [s].
        end_s: Where it ends, not included [s].
        fps: Frames a second of the clip.
        speed: Seconds of the session in a second of the clip.
        size: Width and height [pixels].
    """

    start_s: float
    end_s: float
    fps: int = 25
    speed: float = 1.0
    size: tuple[int, int] = (960, 540)

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            UsageError: If there is nothing to film, or it can't be filmed so.
        """
        if not 0.0 <= self.start_s < self.end_s:
            raise UsageError(
                f"--from {self.start_s:g} --to {self.end_s:g}: expected 0 <= from < to, in "
                "seconds from the session's start"
            )
        if not 1 <= self.fps <= 100:
            raise UsageError(f"--fps {self.fps}: expected 1 to 100 frames a second")
        if not 0.001 <= self.speed <= 1000.0:
            raise UsageError(f"--speed {self.speed:g}: expected 0.001 to 1000 times real time")
        if not all(SIDES[0] <= side <= SIDES[1] for side in self.size):
            raise UsageError(
                f"--size {self.size[0]}x{self.size[1]}: expected WIDTHxHEIGHT, each from "
                f"{SIDES[0]} to {SIDES[1]} pixels"
            )

    @property
    def times_s(self) -> FloatArray:
        """Time of each frame on ``session_time`` [s], at least one, shape (n,)."""
        count = max(1, round((self.end_s - self.start_s) / self.speed * self.fps))
        return self.start_s + np.arange(count) * self.speed / self.fps


def scene_only(content: Content) -> rrb.Blueprint:
    """Return the layout of a clip: the body's view and nothing else.

    Raises:
        DataError: If there is no body to see.
    """
    scene = build_views(content).scene
    if scene is None:
        raise DataError(
            "there is no body to film: that takes a robot description in the session and joint "
            "angles on /joint_states"
        )
    return rrb.Blueprint(
        scene,
        rrb.TopPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.TimePanel(state="hidden"),
        auto_views=False,
        auto_layout=False,
    )


def film(
    recording: Path,
    shot: Shot,
    output: Path,
    *,
    legend: str,
    on_frame: Callable[[int], None] = lambda _: None,
    stop: StopRequest | None = None,
) -> int:
    """Film a recording that was laid out by :func:`scene_only`.

    Args:
        output: The clip, ``.gif`` or ``.mp4``; an existing one is replaced when this one is whole.
        legend: Meaning of the colours, written into every frame above its time.
        on_frame: Called with the number of frames done.
        stop: Ends the work early; nothing is written then.

    Raises:
        LogWriteError: If the clip can't be written, or a stop is requested.
        UndulogError: If the viewer doesn't start or draw.
    """
    times_s = shot.times_s
    with part_file(output) as draft, _camera(recording, shot) as look:
        font = _font(legend, shot.size)

        def frame(seconds: float) -> Image.Image:
            check_stop(output, stop)
            return _labelled(look(seconds), _caption(legend, seconds, shot.speed), font)

        every = -(-len(times_s) // _SAMPLES)
        samples = [frame(seconds) for seconds in times_s[::every].tolist()]
        kind = output.suffix.lower()
        with open_film(draft, kind=kind, size=shot.size, fps=shot.fps, samples=samples) as taken:
            for done, seconds in enumerate(times_s.tolist()):
                taken.add(frame(seconds))
                on_frame(done + 1)
    return len(times_s)


@contextmanager
def _camera(recording: Path, shot: Shot) -> Generator[Callable[[float], Image.Image]]:
    """Yield a function that takes a picture of exactly the clip's size at any time."""
    around = _FRAME
    for _ in range(2):
        window = (shot.size[0] + around[0], shot.size[1] + around[1])
        with HeadlessViewer(window) as viewer:
            viewer.open(recording, shot.start_s)
            (view_id,) = (view.view_id for view in viewer.views.values())

            def look(
                seconds: float, viewer: HeadlessViewer = viewer, view_id: str = view_id
            ) -> Image.Image:
                viewer.seek(seconds)
                return Image.open(io.BytesIO(viewer.picture_of(view_id))).convert("RGB")

            size = look(shot.start_s).size
            if size == shot.size:
                yield look
                return
            around = (window[0] - size[0], window[1] - size[1])
    raise UndulogError(f"the viewer doesn't draw a picture of {shot.size[0]}x{shot.size[1]} pixels")


def _caption(legend: str, seconds: float, speed: float) -> str:
    rate = "" if speed == 1.0 else f", {speed:g} x real time"
    return f"{legend}\n{seconds:.2f} s{rate}"


def _font(legend: str, size: tuple[int, int]) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """Return a font that is easy to read and fits the legend."""
    height = max(11.0, size[1] / 32.0)
    wide = ImageFont.load_default(height).getlength(legend)
    return ImageFont.load_default(min(height, height * 0.95 * size[0] / max(wide, 1.0)))


def _labelled(
    frame: Image.Image, caption: str, font: ImageFont.FreeTypeFont | ImageFont.ImageFont
) -> Image.Image:
    ImageDraw.Draw(frame).multiline_text(
        (12, frame.height - 10),
        caption,
        font=font,
        fill=(225, 225, 228),
        anchor="ld",
        stroke_width=2,
        stroke_fill=(16, 18, 22),
    )
    return frame
