"""Files of moving pictures: GIF for pages, MP4 (H.264) for talks, written frame by frame."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import Any, ClassVar, Literal, Protocol

import av
import numpy as np
from av.error import FFmpegError
from av.video.reformatter import ColorPrimaries, ColorRange, Colorspace, ColorTrc
from av.video.stream import VideoStream
from PIL import Image

from undulog.capture.common.errors import LogWriteError, UsageError

GIF_FPS = 50
"""More frames a second than this a browser slows down to ten."""

_COLORS = 128


class Film(Protocol):
    """A file that takes frames."""

    def add(self, frame: Image.Image) -> None:
        """Append a frame.

        Args:
            frame: RGB, of the film's size.
        """
        ...


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

    Yields:
        What takes the frames.

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
        kind: Suffix of its name.
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


class _Frames:
    """Frames into one stream of a container."""

    options: ClassVar[dict[str, str]] = {}

    def __init__(self, container: Any, stream: VideoStream, fps: int) -> None:
        self._container = container
        self._stream: Any = stream  # the stub's packets are of unknown kind
        self._step, self._count = Fraction(1, fps), 0

    def end(self) -> None:
        """Write what the encoder still holds."""
        self._container.mux(self._stream.encode())

    def _write(self, frame: av.VideoFrame) -> None:
        frame.pts, frame.time_base = self._count, self._step
        self._count += 1
        self._container.mux(self._stream.encode(frame))


class _Gif(_Frames):
    """One palette for all frames and no dither: what doesn't move doesn't flicker, and is small."""

    def __init__(
        self, container: Any, size: tuple[int, int], fps: int, samples: Sequence[Image.Image]
    ) -> None:
        super().__init__(container, _stream(container, "gif", size, fps, "pal8"), fps)
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


class _Mp4(_Frames):
    """H.264 that every browser plays, its colours named, its index in front."""

    options: ClassVar[dict[str, str]] = {"movflags": "+faststart"}

    def __init__(
        self, container: Any, size: tuple[int, int], fps: int, _samples: Sequence[Image.Image]
    ) -> None:
        stream = _stream(container, "libx264", size, fps, "yuv420p")
        coder = stream.codec_context
        coder.options = {"crf": "18", "preset": "medium"}
        coder.colorspace, coder.color_range = Colorspace.ITU709, ColorRange.MPEG
        coder.color_primaries, coder.color_trc = ColorPrimaries.BT709, ColorTrc.IEC61966_2_1
        super().__init__(container, stream, fps)

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


def _stream(
    container: Any, codec: Literal["gif", "libx264"], size: tuple[int, int], fps: int, pixels: str
) -> VideoStream:
    stream: VideoStream = container.add_stream(codec, rate=fps)
    stream.width, stream.height = size
    stream.pix_fmt = pixels
    return stream
