"""LeRobot itself writes a dataset that the studio imports, and reads one that the studio exported.

    python -m venv elsewhere && elsewhere/bin/pip install lerobot==0.4.4
    elsewhere/bin/python tests/benchmarks/in_lerobot.py write handover
    elsewhere/bin/python tests/benchmarks/in_lerobot.py read exported

Needs nothing of this project but this file. ``write`` makes the dataset of tests/recordings: the picture of step t of
episode e is grey, 20 e + t. ``read`` goes through every frame of an unpacked export with its picture, and prints what
docs/results/recordings.md says.
"""

import argparse
import json
import sys
from importlib.metadata import version
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

HEIGHT, WIDTH, RATE_HZ, EPISODES = 48, 64, 10, 9
TASKS = ("hand over the cup", "put it down")


def _write(root: Path) -> None:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    film = {"dtype": "video", "shape": (HEIGHT, WIDTH, 3), "names": ["height", "width", "channels"]}
    features: dict[str, Any] = {
        "observation.state": {"dtype": "float32", "shape": (3,), "names": ["x", "y", "z"]},
        "action": {"dtype": "float32", "shape": (2,), "names": ["a", "b"]},
        "effort": {"dtype": "float32", "shape": (1,), "names": ["newton"]},
        "observation.images.front": film,
        "observation.images.wrist": dict(film),
    }
    made = LeRobotDataset.create("lab/handover", fps=RATE_HZ, features=features, root=root, use_videos=True)
    for episode in range(EPISODES):
        for step in range(12 + episode):
            picture = np.full((HEIGHT, WIDTH, 3), 20 * episode + step, np.uint8)
            made.add_frame(
                {
                    "observation.state": np.array([step, episode, 0], np.float32),
                    "action": np.array([episode, step % 2], np.float32),
                    "effort": np.array([episode + step / 10], np.float32),
                    "observation.images.front": picture,
                    "observation.images.wrist": 255 - picture,
                    "task": TASKS[episode % 2],
                }
            )
        made.save_episode()
    made.finalize()


def _read(root: Path) -> None:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    began = perf_counter()
    found = LeRobotDataset("lab/exported", root=root, video_backend="pyav")
    opened_s = perf_counter() - began
    info = json.loads((root / "meta/info.json").read_text())
    camera = next(name for name, each in info["features"].items() if each["dtype"] == "video")
    began, shape = perf_counter(), tuple(info["features"][camera]["shape"])
    for number in range(len(found)):
        row = found[number]
        picture = row[camera]
        assert tuple(picture.shape) == (shape[2], shape[0], shape[1]), picture.shape
        assert bool(np.isfinite(row["signals"].numpy()).all())
        assert int(row["index"]) == number
    read_s = perf_counter() - began
    assert len(found) == info["total_frames"]
    assert found.num_episodes == info["total_episodes"]
    names = ", ".join(name for name in ("lerobot", "datasets", "torch", "torchvision"))
    versions = ", ".join(version(name) for name in names.split(", "))
    sys.stdout.write(
        f"{names} ({versions}): {found.num_episodes} episodes, {len(found)} frames with pictures {shape}; "
        f"opened in {opened_s:.1f} s, read in {read_s:.1f} s\n"
        f"statistics: {sorted(found.meta.stats)}\n"
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("write", "read"))
    parser.add_argument("folder", type=Path)
    said = parser.parse_args()
    (_write if said.what == "write" else _read)(said.folder)
