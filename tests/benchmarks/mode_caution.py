"""What caution about the labels' uncertainty is worth when a mode is chosen: python -m tests.benchmarks.mode_caution

For 10 to 200 scripted labels (5 % mistakes, 10 % equal), three users and six seeds: the true return that the response
surface predicts for the chosen mode, in % of the mean absolute return of the pool's clips. No filter is trained.
About two minutes.
"""

import sys

import numpy as np

from worker import laboratory
from worker.exploration import surface_file
from worker.ml import acquisition, reward_training
from worker.ml.response_surface import ResponseSurface, best_mode
from worker.ml.reward_training import SignalScale
from worker.ml.segments import SegmentPairs
from worker.ml.teachers import OMEGA, Manner, ScriptedTeacher, User
from worker.sim.costs import preference_rewards, signal_weights
from worker.sim.rollout import rollout

TASK = laboratory.task("feeding")
CLIP_STEPS, SEEDS, SCENARIOS = 60, 6, 36
TARGETS = {"left": 0.0, "right": 1.0, "equal": 0.5}


def main() -> None:
    """Print mean and worst gain per number of labels and caution."""
    clips = [
        rollout(laboratory.environment(TASK.name), laboratory.act_as(TASK.name, behaviour), scenario)
        for scenario in range(10_000_000, 10_000_000 + SCENARIOS)
        for behaviour in laboratory.behaviours(TASK.name, scenario, 4)
    ]
    surface = ResponseSurface.load(surface_file(TASK.name), TASK.modes)
    rows = acquisition.matched_pairs([clip.scenario for clip in clips])
    shown = SegmentPairs.cut([(clips[left], clips[right]) for left, right in rows], 0, CLIP_STEPS)
    scale = SignalScale.of(shown)
    rewards = {
        user: np.array([preference_rewards(TASK, clip.costs, clip.signals, OMEGA[user]) for clip in clips])
        for user in User
    }
    for count in (10, 30, 100, 200):
        gains: dict[float, list[float]] = {0.0: [], 0.5: [], 1.0: [], 2.0: []}
        for seed in range(SEEDS):
            for user in User:
                sides = rewards[user][rows][:, :, :CLIP_STEPS]
                rng = np.random.default_rng([seed, 7])
                teacher = ScriptedTeacher.calibrated(Manner(), sides)
                chosen = rng.permutation(len(rows))[:count]
                targets = [TARGETS[teacher.answer(left, right, rng)] for left, right in sides[chosen]]
                model = reward_training.fit(shown.take(chosen), targets, "structured", seed, scale=scale).model
                unit = abs(rewards[user].sum(axis=1).mean()) / 100
                for caution, found in gains.items():
                    mode = best_mode(surface, model.signal_weights([]), seed, caution=caution)
                    found.append(float(surface.predict(mode)[0] @ signal_weights(TASK, OMEGA[user])) / unit)
        cells = (f"{caution:g}: {np.mean(each):+.1f} (worst {min(each):+.1f})" for caution, each in gains.items())
        sys.stdout.write(f"{count:4d} labels  " + "   ".join(cells) + "\n")


if __name__ == "__main__":
    main()
