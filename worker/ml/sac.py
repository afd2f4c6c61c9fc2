"""Soft actor-critic (Haarnoja et al. 2018, arXiv 1812.05905) in one file: trains the frozen reference policy.

Twin critics with layer normalisation, entropy temperature tuned to a target, one update per two environment steps.
The exported policy is a running average of the actor, the best one by evaluation. Every few minutes the whole state
is written atomically, so that a killed training resumes. Single-threaded: a laptop core is enough.
"""

import json
import math
import os
import platform
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from worker.ml.demonstrations import Demonstrate, Demonstrations, collect, imitate, imitation_loss
from worker.ml.policies import LOG_STD_HIGH, LOG_STD_LOW, GaussianPolicy
from worker.spaces import Field, Space

Array = npt.NDArray[np.float32]
Env = gymnasium.Env[Any, Any]
Progress = Callable[[int, dict[str, float]], None]
"""Called with the number of environment steps done so far and the newest figures."""

INPUT_SCALE = {"m": 3.0, "rad": 1.0, "1": 1.0, "N": 0.1}
"""Factor on each unit of the observation, so that typical inputs are about one."""
EVALUATION_SEED = 2_000_000
TEST_SEED = 1_000_000
REPLAY_FILE, STATE_FILE, PROGRESS_FILE = "replay.npy", "state.safetensors", "state.json"


@dataclass(frozen=True)
class SacConfig:
    """Everything that decides the outcome of a training, apart from the environment."""

    observation: Space = field(repr=False)
    seed: int = 0
    total_steps: int = 260_000
    random_steps: int = 4_000
    """before learning starts; with demonstrations the imitating actor makes them"""
    environments: int = 4
    hidden: int = 128
    batch: int = 128
    learning_rate: float = 5e-4
    final_learning_rate: float = 1e-4
    discount: float = 0.97
    target_rate: float = 0.01
    average_rate: float = 0.002
    target_entropy: float = -7.0
    initial_temperature: float = 0.1
    updates_per_step: float = 0.5
    evaluate_every_steps: int = 20_000
    evaluation_episodes: int = 50
    test_episodes: int = 500
    early_success: tuple[float, ...] = (0.4, 0.7)
    """The first policies to succeed about this often are kept under early/: clumsier behaviours for pools of clips."""
    input_scales: Mapping[str, float] = field(default_factory=dict)
    """INPUT_SCALE for single fields, by name, where small differences matter"""
    save_every_s: float = 180.0
    action_limit: float = 0.7
    """share of the arm's largest step that the exported policy uses; the rest is left for people who want it quicker"""
    training_limit: float = 1.0
    """the same share while training"""
    demonstrations: int = 0
    """episodes of a scripted controller to begin with, if one is given; the actor begins by imitating them"""
    demonstration_share: float = 0.25
    """of every batch"""
    imitation_steps: int = 4_000
    early_imitation_steps: int = 155
    """After so few the imitation is still clumsy, and may be kept as an early policy."""
    imitation_weight: float = 0.5
    """of the imitation loss beside the actor's own, fading to 0 over imitation_updates"""
    imitation_updates: int = 40_000
    critic_first_updates: int = 3_000
    """of the critics alone, after the imitation"""


class Actor(nn.Module):
    """States (B, D) -> mean and log standard deviation of a Gaussian before the tanh, (B, A) each."""

    offset: Tensor
    scale: Tensor

    def __init__(self, offset: Tensor, scale: Tensor, actions: int, hidden: int) -> None:
        super().__init__()
        self.register_buffer("offset", offset)
        self.register_buffer("scale", scale)
        self.layers = nn.ModuleList(
            [nn.Linear(len(offset), hidden), nn.Linear(hidden, hidden), nn.Linear(hidden, 2 * actions)]
        )

    def forward(self, states: Tensor) -> tuple[Tensor, Tensor]:
        """See the class."""
        hidden = (states - self.offset) * self.scale
        for layer in self.layers[:-1]:
            hidden = F.relu(layer(hidden))
        mean, spread = self.layers[-1](hidden).chunk(2, -1)
        return mean, LOG_STD_LOW + 0.5 * (LOG_STD_HIGH - LOG_STD_LOW) * (spread.tanh() + 1)

    def sample(self, states: Tensor) -> tuple[Tensor, Tensor]:
        """Actions (B, A) and their log probability (B,)."""
        mean, log_std = self(states)
        noise = torch.randn_like(mean)
        raw = mean + noise * log_std.exp()
        # log(1 - tanh(raw)^2), written so that it does not underflow.
        squash = 2 * (math.log(2) - raw - F.softplus(-2 * raw))
        log_probability = -0.5 * noise**2 - log_std - 0.5 * math.log(2 * math.pi) - squash
        return raw.tanh(), log_probability.sum(-1)

    def policy(self, action_limit: float = 1.0) -> GaussianPolicy:
        """The same policy for NumPy."""
        weights: dict[str, Array] = {"offset": self.offset.numpy(), "scale": self.scale.numpy()}
        weights["action_limit"] = np.array([action_limit], np.float32)
        for index in range(len(self.layers)):
            weights[f"weight_{index}"] = self.get_parameter(f"layers.{index}.weight").detach().numpy().T.copy()
            weights[f"bias_{index}"] = self.get_parameter(f"layers.{index}.bias").detach().numpy().copy()
        return GaussianPolicy(weights)


class TwinCritics(nn.Module):
    """Two critics evaluated as one batch: states (B, D), actions (B, A) -> (2, B)."""

    offset: Tensor
    scale: Tensor

    def __init__(self, offset: Tensor, scale: Tensor, actions: int, hidden: int) -> None:
        super().__init__()
        self.register_buffer("offset", offset)
        self.register_buffer("scale", scale)
        sizes = [len(offset) + actions, hidden, hidden, 1]
        pairs = list(pairwise(sizes))
        self.weights = nn.ParameterList(
            [nn.Parameter((torch.rand(2, inputs, outputs) * 2 - 1) / math.sqrt(inputs)) for inputs, outputs in pairs]
        )
        self.biases = nn.ParameterList([nn.Parameter(torch.zeros(2, 1, outputs)) for _, outputs in pairs])

    def forward(self, states: Tensor, actions: Tensor) -> Tensor:
        """See the class."""
        scaled = (states - self.offset) * self.scale
        hidden = torch.cat([scaled, actions], -1).expand(2, -1, -1)
        for index, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            hidden = torch.baddbmm(bias, hidden, weight)
            if index < len(self.weights) - 1:
                hidden = F.relu(F.layer_norm(hidden, hidden.shape[-1:]))
        return hidden.squeeze(-1)


class Replay:
    """All transitions so far in one table: state, action, reward, whether the episode went on, next state."""

    def __init__(self, capacity: int, states: int, actions: int) -> None:
        self.splits = [states, actions, 1, 1, states]
        self.rows = torch.zeros(capacity, sum(self.splits))
        self.count = 0

    def add(self, states: Array, actions: Array, rewards: Array, goes_on: Array, next_states: Array) -> None:
        """Append (N, ...) transitions. The table is made large enough for the whole training."""
        table = np.concatenate([states, actions, rewards[:, None], goes_on[:, None], next_states], 1)
        self.rows[self.count : self.count + len(table)] = torch.from_numpy(table.astype(np.float32))
        self.count += len(table)

    def sample(self, batch: int) -> tuple[Tensor, ...]:
        """Random transitions, split into their five parts."""
        return self.split(self.rows[torch.randint(self.count, (batch,))])

    def split(self, rows: Tensor) -> tuple[Tensor, ...]:
        """Whole transitions (B, ...) as their five parts."""
        return torch.split(rows, self.splits, 1)


class Learner:
    """Actor, critics, temperature and their optimisers; one call of update() is one gradient step."""

    def __init__(self, config: SacConfig, offset: Tensor, scale: Tensor, actions: int) -> None:
        self.config = config
        self.actor = Actor(offset, scale, actions, config.hidden)
        self.average = Actor(offset, scale, actions, config.hidden).requires_grad_(False)
        self.critics = TwinCritics(offset, scale, actions, config.hidden)
        self.targets = TwinCritics(offset, scale, actions, config.hidden).requires_grad_(False)
        self.average.load_state_dict(self.actor.state_dict())
        self.targets.load_state_dict(self.critics.state_dict())
        self.log_temperature = torch.tensor(math.log(config.initial_temperature), requires_grad=True)
        rate = config.learning_rate
        self.optimisers = {
            "actor": torch.optim.Adam(self.actor.parameters(), rate, fused=True),
            "critics": torch.optim.Adam(self.critics.parameters(), rate, fused=True),
            "temperature": torch.optim.Adam([self.log_temperature], rate),
        }
        self.updates = 0

    def set_learning_rate(self, share_done: float) -> None:
        """Constant for the first half, then linearly down to the final rate."""
        config = self.config
        fade = max(0.0, 2 * share_done - 1)
        rate = config.learning_rate + fade * (config.final_learning_rate - config.learning_rate)
        for optimiser in self.optimisers.values():
            optimiser.param_groups[0]["lr"] = rate

    def update(self, replay: Replay, shown: Demonstrations | None = None, actor: bool = True) -> None:
        """One step for the critics, every second time one for actor and temperature, then the slow copies."""
        states, actions, rewards, goes_on, next_states, wanted = self._batch(replay, shown)
        self._update_critics(states, actions, rewards[:, 0], goes_on[:, 0], next_states)
        if actor:
            self.updates += 1
            if self.updates % 2 == 0:
                self._update_actor(states, wanted)
                _move_towards(self.average, self.actor, self.config.average_rate)
        _move_towards(self.targets, self.critics, self.config.target_rate)

    def _batch(self, replay: Replay, shown: Demonstrations | None) -> tuple[Tensor, ...]:
        """Transitions, the demonstrated ones last, and what the demonstrator wanted in those (empty without any)."""
        if shown is None:
            return (*replay.sample(self.config.batch), torch.empty(0))
        count = round(self.config.demonstration_share * self.config.batch)
        demonstrated, wanted = shown.sample(count)
        own = replay.sample(self.config.batch - count)
        both = zip(own, replay.split(demonstrated), strict=True)
        return (*(torch.cat(parts) for parts in both), wanted)

    def _update_critics(
        self, states: Tensor, actions: Tensor, rewards: Tensor, goes_on: Tensor, next_states: Tensor
    ) -> None:
        with torch.no_grad():
            next_actions, log_probability = self.actor.sample(next_states)
            entropy_bonus = -self.log_temperature.exp() * log_probability
            next_values = self.targets(next_states, next_actions).amin(0) + entropy_bonus
            wanted = rewards + self.config.discount * goes_on * next_values
        loss = 2 * F.mse_loss(self.critics(states, actions), wanted.expand(2, -1))
        self._descend("critics", loss)

    def _update_actor(self, states: Tensor, wanted: Tensor) -> None:
        self.critics.requires_grad_(False)
        actions, log_probability = self.actor.sample(states)
        temperature = self.log_temperature.detach().exp()
        loss = (temperature * log_probability - self.critics(states, actions).amin(0)).mean() + self.tie(states)
        weight = self.config.imitation_weight * (1 - self.updates / self.config.imitation_updates)
        if len(wanted) and weight > 0:
            loss = loss + weight * imitation_loss(self.actor(states[-len(wanted) :])[0], wanted)
        self._descend("actor", loss)
        self.critics.requires_grad_(True)
        surplus = log_probability.detach().mean() + self.config.target_entropy
        self._descend("temperature", -self.log_temperature * surplus)

    def tie(self, states: Tensor) -> Tensor | float:
        """What else the actor's loss has, for subclasses that hold the actor back: (B, D) -> ()."""
        return 0.0

    def _descend(self, name: str, loss: Tensor) -> None:
        optimiser = self.optimisers[name]
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()

    def state(self) -> dict[str, Tensor]:
        """Every number of the learner, by name."""
        tensors = {"log_temperature": self.log_temperature.detach().clone()}
        for name in ("actor", "average", "critics", "targets"):
            module: nn.Module = getattr(self, name)
            tensors |= {f"{name}.{key}": value.clone() for key, value in module.state_dict().items()}
        for name, optimiser in self.optimisers.items():
            for index, moments in optimiser.state_dict()["state"].items():
                tensors |= {f"optimiser.{name}.{index}.{key}": value for key, value in moments.items()}
        return tensors

    def load_state(self, tensors: dict[str, Tensor], updates: int) -> None:
        """Continue from state()."""
        self.updates = updates
        with torch.no_grad():
            self.log_temperature.copy_(tensors["log_temperature"])
        for name in ("actor", "average", "critics", "targets"):
            getattr(self, name).load_state_dict(_under(tensors, f"{name}."))
        for name, optimiser in self.optimisers.items():
            moments: dict[int, dict[str, Tensor]] = {}
            for key, value in _under(tensors, f"optimiser.{name}.").items():
                index, moment = key.split(".")
                moments.setdefault(int(index), {})[moment] = value
            optimiser.load_state_dict({**optimiser.state_dict(), "state": moments})


def pretrain(
    make_env: Callable[[], Env],
    config: SacConfig,
    checkpoint_dir: Path,
    progress: Progress | None = None,
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
            self.shown = collect(self.test_env, demonstrate, config, rng, TEST_SEED)
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
        outcome = evaluate(self.test_env, policy.mean, EVALUATION_SEED, self.config.evaluation_episodes)
        temperature = float(self.learner.log_temperature.detach().exp())
        self.curve.append({"steps": self.steps, "cpu_s": round(self.cpu_s, 1), "alpha": temperature, **outcome})
        self._keep_early(policy, outcome["success"])
        if (outcome["success"], outcome["return"]) > self.best:
            self.best = (outcome["success"], outcome["return"])
            _replace(self.folder / "policy.safetensors", policy.save)
        return outcome

    def _keep_early(self, policy: GaussianPolicy, success: float) -> None:
        for share in self.config.early_success:
            early = self.folder / "early" / f"success_{round(100 * share)}.safetensors"
            if share <= success < share + 0.3 and not early.exists():
                early.parent.mkdir(exist_ok=True)
                _replace(early, policy.save)
                break

    def _watch_imitation(self, actor: Actor) -> None:
        policy = actor.policy(self.config.action_limit)
        outcome = evaluate(self.test_env, policy.mean, EVALUATION_SEED, self.config.evaluation_episodes)
        self._keep_early(policy, outcome["success"])

    def finish(self) -> dict[str, Any]:
        """Test the exported policy on scenarios that played no part in the training; write the record."""
        policy = GaussianPolicy.load(self.folder / "policy.safetensors")
        rng = np.random.default_rng(self.config.seed)
        count = self.config.test_episodes
        record = {
            "command": self.command,
            "config": {key: value for key, value in asdict(self.config).items() if key != "observation"},
            "observation": [field.name for field in self.config.observation.fields],
            "steps": self.steps,
            "updates": self.learner.updates if self.learner else 0,
            "cpu_s": round(self.cpu_s, 1),
            "versions": _versions(),
            "curve": self.curve,
            "test_scenarios": [TEST_SEED, TEST_SEED + count - 1],
            "test_mean_action": evaluate(self.test_env, policy.mean, TEST_SEED, count),
            "test_sampled_action": evaluate(self.test_env, lambda state: policy.sample(state, rng), TEST_SEED, count),
        }
        text = json.dumps(record, indent=2) + "\n"
        _replace(self.folder / "training.json", lambda path: path.write_text(text))
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
        _replace(resume / REPLAY_FILE, lambda path: _write_rows(path, rows))
        _replace(resume / STATE_FILE, lambda path: save_file(tensors, path))
        counts = {
            "steps": self.steps,
            "updates": self.learner.updates,
            "cpu_s": self.cpu_s,
            "best": self.best,
            "curve": self.curve,
            "rng": self.rng.bit_generator.state,
        }
        _replace(resume / PROGRESS_FILE, lambda path: path.write_text(json.dumps(counts)))

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

    def _actions(self) -> Array:
        if self.learner is None:
            return self.rng.uniform(-1, 1, (len(self.envs), self.actions)).astype(np.float32)
        with torch.no_grad():
            actions: Array = self.learner.actor.sample(torch.from_numpy(self.states))[0].numpy()
        return actions

    def _scenario(self) -> int:
        return int(self.rng.integers(TEST_SEED))

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


def evaluate(env: Env, act: Callable[[Array], Array], first_scenario: int, episodes: int) -> dict[str, float]:
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


def _move_towards(slow: nn.Module, fast: nn.Module, rate: float) -> None:
    with torch.no_grad():
        torch._foreach_lerp_(list(slow.parameters()), list(fast.parameters()), rate)


def _under(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {key.removeprefix(prefix): value for key, value in tensors.items() if key.startswith(prefix)}


def _replace(path: Path, write: Callable[[Path], Any]) -> None:
    """Write to a neighbour and rename, so that a reader or a restart never sees half a file."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    write(temporary)
    with temporary.open("rb") as handle:
        os.fsync(handle.fileno())
    temporary.replace(path)


def _write_rows(path: Path, rows: Array) -> None:
    with path.open("wb") as handle:
        np.save(handle, rows, allow_pickle=False)


def _versions() -> dict[str, str]:
    return {
        "python": platform.python_version(),
        "numpy": np.__version__,
        "torch": torch.__version__,
        "gymnasium": gymnasium.__version__,
    }
