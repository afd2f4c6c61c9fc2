"""Frames to an MP4 that every browser plays: H.264, yuv420p, index before the pictures."""

import io
import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Self

import av
import imageio.v3 as iio
import numpy as np
import numpy.typing as npt

Frame = npt.NDArray[np.uint8]

CONSTANT_RATE_FACTOR = 26
PRESET = "veryfast"
CHROMA_OFFSET = -6
"""Tiny coloured food keeps its colour."""
ASSEMBLER = "sse4.2"
"""With its code for AVX-512 the encoder's result depends on what was in memory before, and on the processor. Every
processor that NumPy runs on has this; encoding takes 3 % longer."""
SLOWEST_FPS = 12
"""Below this pictures are held, for players are bad at videos of few pictures per second."""
MOST_PIXELS, MOST_PICTURES = 4096 * 2304, 20_000
"""Of a video that somebody else has made."""
CONTAINERS = "mov,mp4,matroska,webm,avi,mpegts,mpeg,ogg,flv,asf,mxf,gif"
"""What such a video may come in: each holds its pictures itself. Playlists, which FFmpeg would follow to other files of
this machine, are none of them."""


def encode_mp4(
    frames: Iterable[Frame], width: int, height: int, fps: int, rate_factor: int = CONSTANT_RATE_FACTOR
) -> bytes:
    """Encode RGB frames (height, width, 3). The same frames always give the same bytes."""
    with tempfile.TemporaryDirectory() as folder:
        # A real file: moving the index to the front makes the writer read its own output again.
        target = Path(folder) / "clip.mp4"
        _write(target, frames, width, height, fps, rate_factor)
        return target.read_bytes()


def _write(target: Path, frames: Iterable[Frame], width: int, height: int, fps: int, rate_factor: int) -> None:
    with av.open(str(target), "w", format="mp4", options={"movflags": "+faststart"}) as container:
        stream = container.add_stream("libx264", rate=fps)
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        # One thread: several workers share the machine, and the output must not depend on its cores.
        stream.codec_context.thread_count = 1
        tags = "colorprim=smpte170m:transfer=smpte170m:colormatrix=smpte170m"
        stream.options = {
            "preset": PRESET,
            "crf": str(rate_factor),
            "x264-params": f"chroma-qp-offset={CHROMA_OFFSET}:keyint={fps * 4}:{tags}:asm={ASSEMBLER}",
        }
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        container.mux(stream.encode(None))


def encode_poster(frame: Frame) -> bytes:
    """One RGB frame (height, width, 3) as JPEG."""
    poster: bytes = iio.imwrite("<bytes>", frame, extension=".jpg", quality=84, optimize=True)
    return poster


@dataclass(frozen=True)
class PlayableVideo:
    """A video that every browser plays, with what pages need to know of it."""

    video: bytes
    poster: bytes
    width: int
    height: int
    fps: int
    duration_ms: int


def playable(content: bytes) -> PlayableVideo:
    """Any video as H.264 in MP4; left as it is when it is that already. One picture is in memory at a time.

    Raises ValueError when it cannot be read, or is larger or longer than any clip.
    """
    try:
        with av.open(io.BytesIO(content), "r", options={"format_whitelist": CONTAINERS}) as container:
            stream = container.streams.video[0]
            codec = (stream.codec_context.name, stream.codec_context.pix_fmt)
            usual = codec == ("h264", "yuv420p") and "mp4" in container.format.name
            fps = round(float(stream.average_rate or 0))
            decoded = Decoded(container.decode(stream))
            first = next(decoded, None)
            if first is None or fps < 1:
                raise ValueError("a video without frames")
            height, width = (size // 2 * 2 for size in (first.height, first.width))  # yuv420p wants even
            poster = rgb(first, width, height)
            pictures = (rgb(each, width, height) for each in chain([first], decoded))
            video = content if usual else encode_mp4(pictures, width, height, fps)
            decoded.count_the_rest()
    except (av.FFmpegError, IndexError) as error:
        raise ValueError(f"not a video that can be read ({error})") from error
    return PlayableVideo(video, encode_poster(poster), width, height, fps, round(1000 * decoded.count / fps))


class Decoded:
    """Pictures of a video that others have made, counted. Raises ValueError when they are too large or too many."""

    def __init__(self, pictures: Iterator[av.VideoFrame]) -> None:
        self._pictures = pictures
        self.count = 0

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> av.VideoFrame:
        picture = next(self._pictures)
        self.count += 1
        if picture.width * picture.height > MOST_PIXELS or self.count > MOST_PICTURES:
            raise ValueError(
                f"larger than {MOST_PIXELS / 1e6:.0f} million pixels or longer than {MOST_PICTURES} pictures"
            )
        return picture

    def count_the_rest(self) -> None:
        """Look at what nobody has looked at yet."""
        for _ in self:
            pass


def rgb(decoded: av.VideoFrame, width: int, height: int) -> Frame:
    """(height, width, 3), cropped to that. Raises ValueError for a smaller picture."""
    picture = np.asarray(decoded.to_ndarray(format="rgb24"), np.uint8)[:height, :width]
    if picture.shape[:2] != (height, width):
        raise ValueError("a video whose pictures change their size")
    return picture
