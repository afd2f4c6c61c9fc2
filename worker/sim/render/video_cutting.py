"""A stretch of somebody else's MP4 as a clip, one picture per step: read with FFmpeg's MP4 reader and no other."""

import io
from collections.abc import Callable, Iterator
from itertools import chain, islice
from math import ceil
from pathlib import Path

import av

from worker.sim.render.video import SLOWEST_FPS, Decoded, Frame, PlayableVideo, encode_mp4, encode_poster, rgb

LARGEST_FILE_BYTES = 4 << 30
SHORT_BY_S = 0.5
"""So much may be missing at the end, where the last picture is held, or be too much."""

Pictures = Iterator[av.VideoFrame]


def cut_by_time(path: Path, from_s: float, steps: int, rate_hz: int) -> PlayableVideo:
    """Of a video of many episodes the pictures at from_s, from_s + 1 / rate_hz, ... Raises ValueError."""
    return _cut(path, from_s, lambda pictures: _at_steps(pictures, from_s, steps, rate_hz), steps, rate_hz)


def at_steps(clip: bytes, steps: int, rate_hz: int, width: int, height: int) -> Iterator[Frame]:
    """The pictures of a stored clip at 0, 1 / rate_hz, ...: (height, width, 3) each. Raises ValueError."""
    with av.open(io.BytesIO(clip), "r", format="mp4") as container:
        pictures = _at_steps(container.decode(container.streams.video[0]), 0.0, steps, rate_hz)
        scaled = (each.reformat(width=width, height=height) for each in pictures)
        yield from _as_many(scaled, steps, rate_hz, width, height)


def _at_steps(pictures: Pictures, from_s: float, steps: int, rate_hz: int) -> Pictures:
    step = 0
    for each in pictures:
        if each.time is None:
            raise ValueError("a video whose pictures have no time")
        while step < steps and each.time >= from_s + (step - 0.5) / rate_hz:
            yield each
            step += 1
        if step == steps:
            return


def cut_by_number(path: Path, steps: int, rate_hz: int) -> PlayableVideo:
    """A video with a picture per step, whatever pace it says of itself. Raises ValueError."""

    def in_order(pictures: Pictures) -> Pictures:
        yield from islice(pictures, steps)
        spare = int(SHORT_BY_S * rate_hz)
        if sum(1 for _ in islice(pictures, spare + 1)) > spare:
            raise ValueError(f"a video of more pictures than the {steps} steps that were recorded")

    return _cut(path, 0.0, in_order, steps, rate_hz)


def _cut(path: Path, from_s: float, chosen: Callable[[Pictures], Pictures], steps: int, rate_hz: int) -> PlayableVideo:
    if path.stat().st_size > LARGEST_FILE_BYTES:
        raise ValueError(f"larger than {LARGEST_FILE_BYTES / 1e9:.0f} GB")
    try:
        with av.open(str(path), "r", format="mp4") as container:
            stream = container.streams.video[0]
            if from_s > 0 and stream.time_base:
                container.seek(int(from_s / stream.time_base), stream=stream)
            return _encoded(chosen(Decoded(container.decode(stream))), steps, rate_hz)
    except (av.FFmpegError, IndexError, OverflowError) as error:
        raise ValueError(f"not an MP4 video that can be read ({str(error)[:200]})") from error


def _encoded(pictures: Pictures, steps: int, rate_hz: int) -> PlayableVideo:
    first = next(pictures, None)
    if first is None:
        raise ValueError("a video that ends before this episode begins")
    height, width = (size // 2 * 2 for size in (first.height, first.width))  # yuv420p wants even
    held = ceil(SLOWEST_FPS / rate_hz)
    frames = _as_many(chain([first], pictures), steps, rate_hz, width, height)
    video = encode_mp4((each for each in frames for _ in range(held)), width, height, rate_hz * held)
    poster = encode_poster(rgb(first, width, height))
    return PlayableVideo(video, poster, width, height, rate_hz * held, round(1000 * steps / rate_hz))


def _as_many(pictures: Pictures, steps: int, rate_hz: int, width: int, height: int) -> Iterator[Frame]:
    count = 0
    for each in pictures:
        frame = rgb(each, width, height)
        count += 1
        yield frame
    if steps - count > SHORT_BY_S * rate_hz:
        raise ValueError(f"a video that has {count} pictures for the {steps} steps that were recorded")
    yield from [frame] * (steps - count)
