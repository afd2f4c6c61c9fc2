"""The training of a frozen reference policy by SAC: run, evaluate, keep the best, resume after a kill.

The exported policy is a running average of the actor, the best one by evaluation. Every few minutes the whole state
is written atomically, so that a killed training resumes. Single-threaded: a laptop core is enough.
"""

import json
import math
import platform
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor

from worker.domain.scenarios import POLICY_SELECTION, POLICY_TEST, POLICY_TRAINING
from worker.domain.spaces import Field
from worker.domain.type_aliases import Float32Array
from worker.ml.policies.demonstrations import Demonstrations
from worker.ml.policies.gaussian import GaussianPolicy
from worker.ml.policies.imitation import Demonstrate, collect, imitate
from worker.ml.policies.sac import Actor, Env, Learner, Replay, SacConfig
from worker.whole_files import written_whole

TrainingProgress = Callable[[int, dict[str, float]], None]
"""Called with the number of environment steps done so far and the newest figures."""

INPUT_SCALE = {"m": 3.0, "rad": 1.0, "1": 1.0, "N": 0.1}
"""Factor on each unit of the observation, so that typical inputs are about one."""
REPLAY_FILE, STATE_FILE, PROGRESS_FILE = "replay.npy", "state.safetensors", "state.json"


def pretrain(
    make_env: Callable[[], Env],
    config: SacConfig,
    checkpoint_dir: Path,
    progress: TrainingProgress | None = None,
    command: str = "",
    demonstrate: Demonstrate | None = None,
) -> dict[str, Any]:
    """Train a reference policy, or resume a training, in ``checkpoint_dir``; returns the record it also writes.

    Writes policy.safetensors (the best so far), training.json and, under resume/, what a restart needs. The
    environment must report ``success`` in its info and take its scenario as the seed of reset(). With ``demonstrate``,
    a scripted controller, the actor begins by imitating config.demonstrations of its episodes.
    """
    torch.set_num_threads(1)
    run = _Run(make_env, config, checkpoint_dir, command, demonstrate)
    run.resume()
    while run.steps < config.total_steps:
        run.advance()
        if run.steps % config.evaluate_every_steps < config.environments:
            figures = run.evaluate()
            if progress:
                progress(run.steps, figures)
        elif progress and run.steps % 1000 < config.environments:
            progress(run.steps, {})
        if time.monotonic() - run.last_saved > config.save_every_s:
            run.save()
    run.save()
    return run.finish()


class _Run:
    """One training in progress: environments, learner, replay, curve."""

    def __init__(
        self,
        make_env: Callable[[], Env],
        config: SacConfig,
        folder: Path,
        command: str,
        demonstrate: Demonstrate | None = None,
    ) -> None:
        self.config, self.folder, self.command = config, folder, command
        (folder / "resume").mkdir(parents=True, exist_ok=True)
        torch.manual_seed(config.seed)
        self.rng = np.random.default_rng(config.seed)
        self.envs = [make_env() for _ in range(config.environments)]
        self.test_env = make_env()
        self.states = np.stack([env.reset(seed=self._scenario())[0] for env in self.envs])
        self.actions = int(np.prod(self.envs[0].action_space.shape or ()))
        self.replay = Replay(config.total_steps + config.environments, config.observation.size, self.actions)
        self.learner: Learner | None = None
        self.shown: Demonstrations | None = None
        if demonstrate and config.demonstrations:
            rng = np.random.default_rng([config.seed, 1])
            self.shown = collect(self.test_env, demonstrate, config, rng, POLICY_TRAINING)
        self.steps = 0
        self.owed_updates = 0.0
        self.best = (-1.0, -math.inf)
        self.curve: list[dict[str, float]] = []
        self.earlier_cpu_s = 0.0
        self.started_cpu_s = time.process_time()
        self.last_saved = time.monotonic()

    @property
    def cpu_s(self) -> float:
        return self.earlier_cpu_s + time.process_time() - self.started_cpu_s

    def advance(self) -> None:
        """One step in every environment and the gradient steps that go with it."""
        actions = self._actions()
        next_states, rewards, goes_on, fresh = [], [], [], []
        for env, action in zip(self.envs, actions, strict=True):
            state, reward, terminated, truncated, _ = env.step(self.config.training_limit * action)
            next_states.append(state)
            rewards.append(float(reward))
            goes_on.append(float(not terminated))
            fresh.append(env.reset(seed=self._scenario())[0] if terminated or truncated else state)
        self.replay.add(self.states, actions, np.array(rewards), np.array(goes_on), np.array(next_states))
        self.states = np.stack(fresh)
        self.steps += len(self.envs)
        if self.steps < self.config.random_steps:
            return
        if self.learner is None:
            self.learner = self._new_learner(self.replay.rows[: self.replay.count])
        if self.shown and not self.learner.updates:
            for _ in range(self.config.critic_first_updates):
                self.learner.update(self.replay, self.shown, actor=False)
        self.learner.set_learning_rate(self.steps / self.config.total_steps)
        self.owed_updates += self.config.updates_per_step * len(self.envs)
        while self.owed_updates >= 1:
            self.learner.update(self.replay, self.shown)
            self.owed_updates -= 1

    def evaluate(self) -> dict[str, float]:
        """Measure the averaged actor on unseen scenarios and keep it if it is the best so far."""
        if self.learner is None:
            return {}
        policy = self.learner.average.policy(self.config.action_limit)
        outcome = evaluate(self.test_env, policy.mean, POLICY_SELECTION.start, self.config.evaluation_episodes)
        temperature = float(self.learner.log_temperature.detach().exp())
        self.curve.append({"steps": self.steps, "cpu_s": round(self.cpu_s, 1), "alpha": temperature, **outcome})
        self._keep_early(policy, outcome["success"])
        if (outcome["success"], outcome["return"]) > self.best:
            self.best = (outcome["success"], outcome["return"])
            with written_whole(self.folder / "policy.safetensors") as draft:
                policy.save(draft)
        return outcome

    def _keep_early(self, policy: GaussianPolicy, success: float) -> None:
        for share in self.config.early_success:
            early = self.folder / "early" / f"success_{round(100 * share)}.safetensors"
            if share <= success < share + 0.3 and not early.exists():
                early.parent.mkdir(exist_ok=True)
                with written_whole(early) as draft:
                    policy.save(draft)
                break

    def _watch_imitation(self, actor: Actor) -> None:
        policy = actor.policy(self.config.action_limit)
        outcome = evaluate(self.test_env, policy.mean, POLICY_SELECTION.start, self.config.evaluation_episodes)
        self._keep_early(policy, outcome["success"])

    def finish(self) -> dict[str, Any]:
        """Test the exported policy on scenarios that played no part in the training; write the record."""
        policy = GaussianPolicy.load(self.folder / "policy.safetensors")
        rng = np.random.default_rng(self.config.seed)
        first, count = POLICY_TEST.start, self.config.test_episodes
        record = {
            "command": self.command,
            "config": {key: value for key, value in asdict(self.config).items() if key != "observation"},
            "observation": [field.name for field in self.config.observation.fields],
            "steps": self.steps,
            "updates": self.learner.updates if self.learner else 0,
            "cpu_s": round(self.cpu_s, 1),
            "versions": _versions(),
            "curve": self.curve,
            "test_scenarios": [first, first + count - 1],
            "test_mean_action": evaluate(self.test_env, policy.mean, first, count),
            "test_sampled_action": evaluate(self.test_env, lambda state: policy.sample(state, rng), first, count),
        }
        text = json.dumps(record, indent=2) + "\n"
        with written_whole(self.folder / "training.json") as draft:
            draft.write_text(text)
        for env in (*self.envs, self.test_env):
            env.close()
        return record

    def save(self) -> None:
        """Write everything a restart needs; the small file that names the counts goes last."""
        self.last_saved = time.monotonic()
        if self.learner is None:
            return
        resume = self.folder / "resume"
        tensors = {**self.learner.state(), "torch_rng": torch.get_rng_state()}
        rows = self.replay.rows[: self.replay.count].numpy()
        with written_whole(resume / REPLAY_FILE) as draft:
            np.save(draft, rows, allow_pickle=False)
        with written_whole(resume / STATE_FILE) as draft:
            save_file(tensors, draft)
        counts = {
            "steps": self.steps,
            "updates": self.learner.updates,
            "cpu_s": self.cpu_s,
            "best": self.best,
            "curve": self.curve,
            "rng": self.rng.bit_generator.state,
        }
        with written_whole(resume / PROGRESS_FILE) as draft:
            draft.write_text(json.dumps(counts))

    def resume(self) -> None:
        """Continue a killed training; the episodes that were in flight start anew."""
        folder = self.folder / "resume"
        if not (folder / PROGRESS_FILE).exists():
            self._imitate()
            return
        counts = json.loads((folder / PROGRESS_FILE).read_text())
        tensors = load_file(folder / STATE_FILE)
        rows = torch.from_numpy(np.load(folder / REPLAY_FILE, allow_pickle=False))
        # A kill between the three writes leaves a replay that is longer than the counts say, never shorter.
        self.steps = self.replay.count = counts["steps"]
        self.replay.rows[: self.steps] = rows[: self.steps]
        self.learner = Learner(self.config, tensors["actor.offset"], tensors["actor.scale"], self.actions)
        self.learner.load_state(tensors, counts["updates"])
        torch.set_rng_state(tensors["torch_rng"])
        self.rng.bit_generator.state = counts["rng"]
        self.best, self.curve, self.earlier_cpu_s = tuple(counts["best"]), counts["curve"], counts["cpu_s"]

    def _actions(self) -> Float32Array:
        if self.learner is None:
            return self.rng.uniform(-1, 1, (len(self.envs), self.actions)).astype(np.float32)
        with torch.no_grad():
            actions: Float32Array = self.learner.actor.sample(torch.from_numpy(self.states))[0].numpy()
        return actions

    def _scenario(self) -> int:
        return int(self.rng.integers(POLICY_TRAINING.start, POLICY_TRAINING.stop))

    def _imitate(self) -> None:
        if self.shown:
            self.learner = self._new_learner(self.shown.rows)
            config = self.config
            imitate(
                self.learner.actor,
                self.shown,
                config.imitation_steps,
                config.early_imitation_steps,
                self._watch_imitation,
            )
            self.learner.average.load_state_dict(self.learner.actor.state_dict())

    def _scale(self, part: Field) -> float:
        return self.config.input_scales.get(part.name, INPUT_SCALE[part.unit])

    def _new_learner(self, rows: Tensor) -> Learner:
        offset = rows[:, : self.config.observation.size].mean(0)
        scale = torch.cat([torch.full((part.size,), self._scale(part)) for part in self.config.observation.fields])
        return Learner(self.config, offset, scale, self.actions)


def evaluate(
    env: Env, act: Callable[[Float32Array], Float32Array], first_scenario: int, episodes: int
) -> dict[str, float]:
    """Success rate, mean return, mean of each episode's largest contact force and its 95th percentile, in N."""
    successes, returns, forces = [], [], []
    for scenario in range(first_scenario, first_scenario + episodes):
        state, _ = env.reset(seed=scenario)
        total, force, over = 0.0, 0.0, False
        success = False
        while not over:
            state, reward, terminated, truncated, info = env.step(act(state))
            total += float(reward)
            force = max(force, info.get("contact_force_n", 0.0))
            success, over = bool(info["success"]), terminated or truncated
        successes.append(success)
        returns.append(total)
        forces.append(force)
    return {
        "success": float(np.mean(successes)),
        "return": float(np.mean(returns)),
        "max_force_n": float(np.mean(forces)),
        "max_force_n_95": float(np.percentile(forces, 95)),
    }


def _versions() -> dict[str, str]:
    return {
        "python": platform.python_version(),
        "numpy": np.__version__,
        "torch": torch.__version__,
        "gymnasium": gymnasium.__version__,
    }
