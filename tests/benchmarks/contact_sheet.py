"""Pictures to look at.

    python -m tests.benchmarks.contact_sheet some_folder feeding drinking

Writes people.png (every body in every skin tone) and, for each task, TASK.png: one row per film, its frames from start
to end, the films drawn from the pool of behaviours that participants see.
"""

import argparse
import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from app.installed_tasks import catalogue
from tests.benchmarks.films import films
from worker.domain.trajectory import BODIES, SKIN_TONES, Trajectory
from worker.sim.human import BODY_SHAPES
from worker.sim.render.clip import ClipRenderer
from worker.tasks.registry import filmed_task

FRAMES = 5
TILE = (400, 300)


def main() -> None:
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("tasks", nargs="*", default=catalogue.names())
    parser.add_argument("--films", type=int, default=6, help="of each task")
    parser.add_argument("--steps", type=int, default=60, help="of a film")
    parser.add_argument("--people", action=argparse.BooleanOptionalAction, default=True, help="people.png as well")
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    renderer = ClipRenderer(filmed_task)
    for task in options.tasks:
        rows = [strip(renderer, film, options.steps) for film in films(task, options.films)]
        _save(rows, options.folder / f"{task}.png")
    if options.people:
        _save(people(renderer, next(films(options.tasks[0], 1))), options.folder / "people.png")
    renderer.close()


def strip(renderer: ClipRenderer, film: Trajectory, steps: int) -> list[Image.Image]:
    """Frames from the start to the end of what participants see of a film."""
    pictures = [picture.resize(TILE) for picture in renderer.pictures(film, 0, min(steps, len(film)))]
    return [pictures[index] for index in np.linspace(0, len(pictures) - 1, FRAMES).astype(int)]


def people(renderer: ClipRenderer, film: Trajectory) -> list[list[Image.Image]]:
    """The first frame of a film with everybody in it, a row per body."""
    return [
        [next(renderer.pictures(_seated(film, body, tone), 0, 1)).resize(TILE) for tone in range(SKIN_TONES)]
        for body in BODIES
    ]


def _seated(film: Trajectory, body: str, skin_tone: int) -> Trajectory:
    """The film with somebody else in it, who looks straight ahead."""
    shape, count = BODY_SHAPES[body], len(film) + 1
    mouth = np.array(shape.neck_pivot_m) + shape.mouth_from_neck_m
    ahead = np.tile(np.array([0.0, 0.0, 0.0, 1.0], np.float32), (count, 1))
    target = np.tile(mouth.astype(np.float32), (count, 1))
    return replace(film, body=body, skin_tone=skin_tone, head_quaternions=ahead, target_m=target)


def _save(rows: Sequence[Sequence[Image.Image]], path: Path) -> None:
    width, height = TILE
    sheet = Image.new("RGB", (width * len(rows[0]), height * len(rows)))
    for y, row in enumerate(rows):
        for x, picture in enumerate(row):
            sheet.paste(picture, (x * width, y * height))
    sheet.save(path)
    logging.getLogger(__name__).info("%s", path)


if __name__ == "__main__":
    main()
