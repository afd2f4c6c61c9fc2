"""Clips of a laboratory's environment, which draws itself: a picture after every step, as a video of the same pace."""

from collections.abc import Sequence

import numpy as np

from worker.domain.trajectory import Trajectory
from worker.domain.type_aliases import Act, Float32Array
from worker.sim.lab.environment import LabEnvironment, Picture
from worker.sim.lab.errors import LabTaskBroken
from worker.sim.render import video
from worker.sim.render.clip import RenderedClip

SAME_WITHIN = 1e-3
"""Largest difference of an observation between an episode and the same actions again."""


def film(
    environment: LabEnvironment, act: Act, scenario: int, reference: Act, first_step: int, step_count: int
) -> tuple[Trajectory, RenderedClip]:
    """A whole episode, and the video of a stretch of it."""
    pictures: list[Picture] = []
    wanted = range(first_step, first_step + step_count)
    trajectory = environment.episode(act, scenario, reference, lambda step: pictures.append if step in wanted else None)
    return trajectory, rendered(pictures, environment.description.environment.rate_hz)


def film_again(environment: LabEnvironment, recorded: Trajectory, first_step: int, step_count: int) -> RenderedClip:
    """Another stretch of an episode that was recorded before, from its actions. Raises LabTaskBroken if it differs."""
    actions = iter(recorded.actions)
    repeated, clip = film(environment, lambda _: next(actions), recorded.scenario, _nothing, first_step, step_count)
    difference = float(np.abs(repeated.observations - recorded.observations).max())
    if difference > SAME_WITHIN:
        raise LabTaskBroken(
            "environment.reset",
            f"scenario {recorded.scenario} with the same actions went otherwise (by up to {difference:.3g}), so it "
            'cannot be filmed again. Set reset = "rebuild" for a study of its own.',
        )
    return clip


def rendered(pictures: Sequence[Picture], rate_hz: float) -> RenderedClip:
    """Pictures that were taken so many times a second, at the pace at which they were."""
    held = max(1, int(np.ceil(video.SLOWEST_FPS / rate_hz)))
    fps = max(1, round(rate_hz * held))
    height, width = pictures[0].shape[:2]
    count = len(pictures) * held
    return RenderedClip(
        video=video.encode_mp4((each for each in pictures for _ in range(held)), width, height, fps),
        poster=video.encode_poster(pictures[0]),
        width=width,
        height=height,
        fps=fps,
        n_frames=count,
        duration_ms=round(1000 * count / fps),
    )


def _nothing(observations: Float32Array) -> Float32Array:
    return np.zeros((len(observations), 0), np.float32)
