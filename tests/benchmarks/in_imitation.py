"""Trains a reward network of the `imitation` library on an exported participant: the arrays mean there what they say.

    python -m venv elsewhere && elsewhere/bin/pip install torch==2.13.0 imitation==1.0.1
    elsewhere/bin/python tests/benchmarks/in_imitation.py study.zip P01

Needs nothing of this project but this file and docs/arrays.md, whose snippet it runs as it stands. Every answer is held
out once. With preferences the wrong way round the network learns the opposite, which is printed beside it.
"""

import argparse
import contextlib
import re
import sys
import tempfile
import zipfile
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch

EPOCHS = 20
FOLDS = 5
DOCUMENTED = Path(__file__).resolve().parents[2] / "docs" / "arrays.md"


def main(archive: Path, participant: str) -> None:
    """Print how many answers are foreseen by networks that have learned from the others."""
    made = _as_documented(archive, participant)
    fragments, preferences = made["fragments"], made["preferences"]
    sys.stdout.write(f"{len(preferences)} answers of {participant}\n")
    for words, said in (("as documented", preferences), ("the wrong way round", 1.0 - preferences)):
        right = [_foreseen(fragments, preferences, said.astype(np.float32), fold) for fold in range(FOLDS)]
        share, count = np.concatenate(right).mean(), len(np.concatenate(right))
        sys.stdout.write(f"{words}: {share:.0%} of {count} held-out answers foreseen\n")


def _as_documented(archive: Path, participant: str) -> dict[str, Any]:
    """What the snippet for imitation makes of the participant's file."""
    snippet = re.search(r"```python imitation\n(.*?)```", DOCUMENTED.read_text(), re.DOTALL)
    if snippet is None:
        raise SystemExit(f"{DOCUMENTED} has no snippet for imitation.")
    made: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder, zipfile.ZipFile(archive) as files:
        files.extract(f"pairs/{participant}.npz", folder)
        with contextlib.chdir(folder):
            exec(snippet[1].replace("P01", participant), made)  # noqa: S102  (our own documentation)
        made["file"].close()
    return made


def _foreseen(fragments: Any, truth: Any, said: Any, fold: int) -> Any:
    """Which of the fold's decided answers a network foresees that has learned from what was ``said`` in the others."""
    from imitation.algorithms import preference_comparisons  # here, so that --help needs no environment of its own
    from imitation.rewards.reward_nets import BasicRewardNet

    rows = np.arange(len(truth))
    learned, held_out = rows[rows % FOLDS != fold], rows[(rows % FOLDS == fold) & (truth != 0.5)]
    torch.manual_seed(fold)
    observed, acted = fragments[0][0].obs.shape[1], fragments[0][0].acts.shape[1]
    space = gymnasium.spaces.Box(-np.inf, np.inf, (observed,))
    model = preference_comparisons.PreferenceModel(
        BasicRewardNet(space, gymnasium.spaces.Box(-1.0, 1.0, (acted,)), hid_sizes=(64, 64))
    )
    data = preference_comparisons.PreferenceDataset()
    data.push([fragments[row] for row in learned], said[learned])
    trainer = preference_comparisons.BasicRewardTrainer(
        model, preference_comparisons.CrossEntropyRewardLoss(), np.random.default_rng(fold), epochs=EPOCHS
    )
    trainer.train(data)
    with torch.no_grad():
        first = model([fragments[row] for row in held_out])[0].numpy()
    return (first > 0.5) == (truth[held_out] > 0.5)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("archive", type=Path, help="an exported study")
    parser.add_argument("participant", help="such as P01")
    options = parser.parse_args()
    main(options.archive.resolve(), options.participant)
