"""How long clips take: run `python -m tests.benchmarks.render_speed` with OMP_NUM_THREADS=1 on an idle machine.

Prints CPU times of building the renderer, of one frame and of a whole clip of eight seconds, and the clip's size.
"""

import logging
import time

from tests.worker.waving import waving_trajectory
from worker.sim.motion import clip_motion
from worker.sim.render import ClipRenderer

STEPS = 80


def main() -> None:
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    log = logging.getLogger(__name__)
    start = time.process_time()
    renderer = ClipRenderer()
    log.info("building the renderer  %.2f s", time.process_time() - start)
    trajectory = waving_trajectory(STEPS)
    start = time.process_time()
    clip = renderer.render_clip(trajectory, 0, STEPS)
    log.info("clip of %.1f s          %.2f s", clip.duration_ms / 1000, time.process_time() - start)
    log.info("its size               %.0f KiB", len(clip.video) / 1024)
    motion = clip_motion(trajectory, 0, STEPS, renderer.style.fps)
    start = time.process_time()
    frames = sum(1 for _ in renderer.pictures(motion))
    log.info("frame without encoding %.1f ms", (time.process_time() - start) / frames * 1000)


if __name__ == "__main__":
    main()
