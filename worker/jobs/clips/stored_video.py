"""Columns that are the same wherever something was filmed."""

from typing import Any

from app.storage import ArtefactStore
from worker.compute.behaviours import Behaviour
from worker.compute.simulation import RecordedClip
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


def rows_of_clip(
    store: ArtefactStore, recorded: RecordedClip, scenario: int, number: int, behaviour: Behaviour, steps: int
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Stores a clip that begins with its episode; what the rows of both say. ``number``: the behaviour's."""
    rollout = {
        "scenario": scenario,
        "behaviour": number,
        "mode": behaviour.described(),
        "trajectory_sha256": store.put(recorded.trajectory),
        "success": recorded.success,
    }
    return rollout, {"first_step": 0, "step_count": steps, **video_columns(store, recorded.clip)}
