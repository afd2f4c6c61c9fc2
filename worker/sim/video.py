"""Frames to an MP4 that every browser plays: H.264, yuv420p, index before the pictures."""

import io
import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import av
import imageio.v3 as iio
import numpy as np
import numpy.typing as npt

Frame = npt.NDArray[np.uint8]

CONSTANT_RATE_FACTOR = 26
PRESET = "veryfast"
CHROMA_OFFSET = -6
"""Tiny coloured food keeps its colour."""


def encode_mp4(frames: Iterable[Frame], width: int, height: int, fps: int) -> bytes:
    """Encode RGB frames (height, width, 3). The same frames always give the same bytes."""
    with tempfile.TemporaryDirectory() as folder:
        # A real file: moving the index to the front makes the writer read its own output again.
        target = Path(folder) / "clip.mp4"
        _write(target, frames, width, height, fps)
        return target.read_bytes()


def _write(target: Path, frames: Iterable[Frame], width: int, height: int, fps: int) -> None:
    with av.open(str(target), "w", format="mp4", options={"movflags": "+faststart"}) as container:
        stream = container.add_stream("libx264", rate=fps)
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        # One thread: several workers share the machine, and the output must not depend on its cores.
        stream.codec_context.thread_count = 1
        tags = "colorprim=smpte170m:transfer=smpte170m:colormatrix=smpte170m"
        stream.options = {
            "preset": PRESET,
            "crf": str(CONSTANT_RATE_FACTOR),
            "x264-params": f"chroma-qp-offset={CHROMA_OFFSET}:keyint={fps * 4}:{tags}",
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
    """Any video as H.264 in MP4; left as it is when it is that already. Raises ValueError when it cannot be read."""
    try:
        with av.open(io.BytesIO(content), "r") as container:
            stream = container.streams.video[0]
            usual = (stream.codec_context.name, stream.codec_context.pix_fmt) == ("h264", "yuv420p")
            is_mp4 = "mp4" in container.format.name
            fps = round(float(stream.average_rate or 0))
            frames = [np.asarray(each.to_ndarray(format="rgb24"), np.uint8) for each in container.decode(stream)]
    except (av.FFmpegError, IndexError) as error:
        raise ValueError(f"not a video that can be read ({error})") from error
    if not frames or fps < 1:
        raise ValueError("a video without frames")
    frames = [frame[: frame.shape[0] // 2 * 2, : frame.shape[1] // 2 * 2] for frame in frames]  # yuv420p wants even
    height, width = frames[0].shape[:2]
    video = content if usual and is_mp4 else encode_mp4(frames, width, height, fps)
    return PlayableVideo(video, encode_poster(frames[0]), width, height, fps, round(1000 * len(frames) / fps))
