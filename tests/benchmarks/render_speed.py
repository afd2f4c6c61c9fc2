"""How long clips take. Run it on an idle machine:

    OMP_NUM_THREADS=1 python -m tests.benchmarks.render_speed

Prints, for each task and on trajectories from its pool of behaviours, the CPU time of one frame with inset and moving
shadow, of the start of a clip (medians over films), and of a whole clip of five seconds from stored states to finished
MP4 and its size (median and largest); and the memory of the process after all of them.
"""

import argparse
import logging
import resource
import statistics
import time
from collections.abc import Callable
from functools import partial

from app.installed_tasks import catalogue
from tests.benchmarks.films import films
from worker.domain.trajectory import Trajectory
from worker.sim.render.clip import STYLES, ClipRenderer
from worker.tasks.registry import filmed_task


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", choices=catalogue.names(), default=catalogue.names())
    parser.add_argument("--quality", choices=STYLES, default="sharp", help="of the clips")
    parser.add_argument("--films", type=int, default=6, help="of each task")
    parser.add_argument("--steps", type=int, default=50, help="of a clip")
    options = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    log = logging.getLogger(__name__)
    trajectories = {task: list(films(task, options.films)) for task in options.tasks}
    before_mib = resident_mib()
    start = time.process_time()
    renderer = ClipRenderer(filmed_task, STYLES[options.quality])
    first_picture(renderer, next(iter(trajectories.values()))[0])
    log.info("first picture of all, with one body  %5.2f s", time.process_time() - start)
    log.info("task         ms per frame   start of a clip, s   5 s clip, s   (max)   kB   (max)")
    for task, recorded in trajectories.items():
        for film in recorded:
            first_picture(renderer, film)
        starts = [cpu_s(partial(first_picture, renderer, film)) for film in recorded]
        frames = [frame_ms(renderer, film, options.steps) for film in recorded]
        clips, sizes = zip(*(clip(renderer, film, options.steps) for film in recorded), strict=True)
        log.info(
            "%-12s %12.1f %20.2f %13.2f %7.2f %4.0f %7.0f",
            task,
            statistics.median(frames),
            statistics.median(starts),
            statistics.median(clips),
            max(clips),
            statistics.median(sizes) / 1000,
            max(sizes) / 1000,
        )
    renderer.close()
    log.info("memory: %.0f MiB, of which %.0f before drawing", resident_mib(), before_mib)
    log.info("most ever: %.0f MiB", resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)


def cpu_s(work: Callable[[], object]) -> float:
    """CPU seconds of a piece of work."""
    start = time.process_time()
    work()
    return time.process_time() - start


def first_picture(renderer: ClipRenderer, film: Trajectory) -> None:
    """Everything that is done once per clip, and one frame."""
    next(renderer.pictures(film, 0, 1))


def frame_ms(renderer: ClipRenderer, film: Trajectory, steps: int) -> float:
    """CPU milliseconds per frame once the clip has started."""
    pictures = renderer.pictures(film, 0, steps)
    next(pictures)
    start = time.process_time()
    count = sum(1 for _ in pictures)
    return (time.process_time() - start) / count * 1000


def clip(renderer: ClipRenderer, film: Trajectory, steps: int) -> tuple[float, int]:
    """CPU seconds and bytes of a finished clip."""
    start = time.process_time()
    finished = renderer.render_clip(film, 0, steps)
    return time.process_time() - start, len(finished.video)


def resident_mib() -> float:
    """Memory of this process now."""
    with open("/proc/self/statm") as statm:  # noqa: PTH123 -- not a file on disk
        return int(statm.read().split()[1]) * 4096 / 2**20


if __name__ == "__main__":
    main()
