"""The columns that clips and films have in common: those about the video."""

from typing import Any

from app.storage import ArtefactStore
from worker.sim.render.clip import RenderedClip
from worker.sim.render.video import PlayableVideo


def video_columns(store: ArtefactStore, video: RenderedClip | PlayableVideo) -> dict[str, Any]:
    """Stores video and poster; what a row says about them."""
    return {
        "video_sha256": store.put(video.video),
        "poster_sha256": store.put(video.poster),
        "width": video.width,
        "height": video.height,
        "fps": video.fps,
        "duration_ms": video.duration_ms,
        "byte_count": len(video.video),
    }
