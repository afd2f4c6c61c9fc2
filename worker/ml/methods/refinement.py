"""The longest stage of the studio's filter: a policy of the person's own, which begins as the mode.

A network imitates the mode; soft actor-critic goes on from there, on R-hat and a sketchy reward (guided()). Its
replay begins with the rollouts that are there already (Ball et al. 2023, arXiv 2302.02948). It is tied to what it was
some time before, as prefft_anchored is to where it began, less and less while it learns: without a tie it forgets the
task before it finds anything better. Where it forgets it all the same it goes back (docs/method.md, section 5).
"""

import hashlib
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import torch

from app.installed_tasks.refinements import SHARE_AHEAD
from worker.domain.trajectory import SIGNALS, Trajectory
from worker.domain.type_aliases import Float32Array
from worker.ml.filters.filter_problem import (
    Collect,
    FilterAct,
    FilterDraft,
    FilterProblem,
    GateTrial,
    ReportProgress,
    act_of,
)
from worker.ml.filters.gate import keeps_task, to_beat, try_on
from worker.ml.filters.shield import FORCE_QUANTILE, FORCE_RAMP_N, limits_of
from worker.ml.methods import pbrl_hri
from worker.ml.methods.preference_rl import EpisodeReward, MakeEnv, PreferenceRl, learned
from worker.ml.methods.watched import WatchedLearner, best_in, price_in
from worker.ml.policies.checkpoint import Checkpoint
from worker.ml.policies.demonstrations import Demonstrations
from worker.ml.policies.imitation import imitate
from worker.ml.policies.reference import looked_into
from worker.ml.policies.sac import Actor, Learner, SacConfig

_REFINED = (
    "The filter was refined by reinforcement learning on the learned preference. It began as the execution mode that "
    "is shown, and may have gone elsewhere since."
)
STRENGTHS = (1.0, 0.8, 0.6)
"""Tried in this order, blended with the reference policy."""
LARGEST_LOSS = 0.01
"""of success in the scenarios of the check. In truth two points may be lost: who loses that much passes in one of eight
cases, who loses half a point in more than nine of ten (decision 161)"""
LEAST_LIFT = 1.1
"""times what the mode gains the refined policy has to gain: a residual, which follows otherwise, often gains as much"""
LOOKED_AT = 40
"""of the gate's scenarios, to see whether a refinement is promising"""
_STROKES, _UNDONE = SIGNALS.index("strokes"), SIGNALS.index("undelivered")
_FORCES = [SIGNALS.index("force_at_target_n"), SIGNALS.index("force_away_n")]
MOST_RAMPS = 3.0
OWN_SHARE = 3
"""How often the imitation sees the filter's own states, beside those of the rollouts that were there."""


@dataclass(frozen=True)
class Refinement:
    """How much is learned."""

    steps: int = 90_000
    """of the environment"""
    warm_up_steps: int = 4_000
    """of these, made by the filter"""
    warm_up_noise: float = 0.15
    """standard deviation of what is added to its actions then"""
    imitation_steps: int = 4_000
    critic_first_updates: int = 6_000
    critic_again_updates: int = 3_000
    """of the critics alone, when the reward has changed"""
    hidden: int = 128
    environments: int = 4
    learning_rate: float = 5e-4
    first_tie: float = 1.0
    """weight of the KL divergence from what it is tied to, the imitation at first, in units of the spread of Q; see
    prefft"""
    last_tie: float = 0.3
    hold_every_steps: int = 12_000
    """the tie is to what the policy was then: it goes far, and never far at once; see WatchedLearner"""
    price: float = 0.5
    """of every step with the task undone, once it was lost, in standard deviations of R-hat"""
    stroke_weight: float = 0.3
    """of strokes in the sketchy reward, beside the distance"""
    force_price: float = 1.0
    """of FORCE_RAMP_N more on the person than is usual (guided()), in standard deviations of R-hat; at most MOST_RAMPS
    of it are priced, or a single blow would be all that is learned from"""
    share_ahead: float = SHARE_AHEAD
    """of the steps, for a reward model of fewer answers"""

    @property
    def ahead_steps(self) -> int:
        """After so many, the reward model of all answers is needed."""
        return round(self.share_ahead * self.steps)


@dataclass(frozen=True)
class Beginning:
    """What a refinement goes on from."""

    make_env: MakeEnv
    known: Sequence[Trajectory]
    """rollouts of many behaviours, for the replay"""
    reference: Sequence[Trajectory]
    """of the frozen policy in the gate's scenarios: the unit of the sketchy reward, and what the task is kept by"""
    collect: Collect


def refine_ahead(
    problem: FilterProblem, draft: FilterDraft, beginning: Beginning, config: Refinement, checkpoint: Checkpoint
) -> None:
    """The larger part of a refinement, for a reward model of fewer answers; refine() goes on from the checkpoint."""
    _train(problem, draft, beginning, config, checkpoint, config.ahead_steps)


def refine(
    problem: FilterProblem,
    draft: FilterDraft,
    beginning: Beginning,
    config: Refinement,
    checkpoint: Checkpoint | None = None,
) -> tuple[FilterDraft, ...]:
    """Train the person's refined policy; gate_refined() decides whether it takes the filter's place.

    Returns the draft with the last policy, and with what had gained most on the way while the task was kept. With a
    checkpoint, a training that was killed goes on where it was, with the same result, and one of refine_ahead() goes
    on with this reward model.
    """
    started = time.perf_counter()
    learner = _train(problem, draft, beginning, config, checkpoint)
    drafts = (_with(draft, actor) for actor in (learner.average, learner.best) if actor is not None)
    return tuple(each.timed("refinement", started) for each in drafts)


def _with(draft: FilterDraft, actor: Actor) -> FilterDraft:
    return replace(draft, weights=draft.weights.changed(refined=actor.policy().weights))


def is_promising(
    problem: FilterProblem,
    draft: FilterDraft,
    reference: Sequence[Trajectory],
    config: Refinement,
    checkpoint: Checkpoint,
    collect: Collect,
) -> bool:
    """Whether the best that refine_ahead() came to is better than the mode, by the reward model of all answers.

    If not, somebody would wait for the rest, which is hardly worth their time. How often that would have become better
    after all was not measured.
    """
    kept = checkpoint.read()
    if kept is None:
        return True
    policy = looked_into(problem.policy)
    actor = Actor(torch.from_numpy(policy.offset), torch.from_numpy(policy.scale), policy.action_size, config.hidden)
    actor.load_state_dict(best_in(kept[0]))
    trial, _ = _tried(problem, _with(draft, actor), 1.0, reference[:LOOKED_AT], collect)
    return trial.preference > to_beat(problem, draft, reference)


def _tried(
    problem: FilterProblem, draft: FilterDraft, gate: float, reference: Sequence[Trajectory], collect: Collect
) -> tuple[GateTrial, Sequence[Trajectory]]:
    act = act_of(problem.task.modes, problem.policy, draft.weights.changed(gate=gate))
    trial, driven = try_on(problem, act, gate, 0.0, reference, collect)
    return replace(trial, refined=True), driven


def given_up(draft: FilterDraft) -> FilterDraft:
    """Without a refinement, which is not promising."""
    return replace(draft, notes=(*draft.notes, "The refinement had made nothing better on the way and was given up."))


def _train(
    problem: FilterProblem,
    draft: FilterDraft,
    beginning: Beginning,
    config: Refinement,
    checkpoint: Checkpoint | None,
    until: int | None = None,
) -> WatchedLearner:
    kept = checkpoint.read() if checkpoint else None
    settings = SacConfig(
        problem.task.observation,
        seed=problem.seed,
        total_steps=config.steps,
        random_steps=min(config.warm_up_steps, config.steps),
        environments=config.environments,
        hidden=config.hidden,
        learning_rate=config.learning_rate,
        critic_first_updates=config.critic_first_updates if kept is None else config.critic_again_updates,
    )
    policy, reference = looked_into(problem.policy), beginning.reference
    offset, scale = torch.from_numpy(policy.offset), torch.from_numpy(policy.scale)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(problem.seed)
        reward = guided(reference, learned(problem.reward), config.stroke_weight, config.force_price)
        mark = hashlib.sha256(problem.reward.to_bytes()).hexdigest()
        priced = _priced(reward, price_in(kept[0]) if kept else 0.0)
        training = PreferenceRl(beginning.make_env, priced, settings, [*beginning.known, *reference], mark)
        learner = WatchedLearner(settings, offset, scale, training.actions, config.first_tie)
        if kept is None:
            _imitate(learner, training, act_of(problem.task.modes, problem.policy, draft.weights), config)
        else:
            training.restore(learner, *kept)

        def move_tie(training: PreferenceRl, _: Learner) -> None:
            learner.weight = config.first_tie + training.steps / config.steps * (config.last_tie - config.first_tie)
            learned_for = training.steps - settings.random_steps
            is_time = learned_for % config.hold_every_steps < config.environments <= learned_for
            if is_time and training.steps < config.ahead_steps:  # later on somebody waits
                look()

        def look() -> None:
            """Hold it where it is, or go back."""
            trial, _ = _tried(problem, _with(draft, learner.average), 1.0, reference, beginning.collect)
            if keeps_task(problem, trial, reference):
                learner.passed(trial.preference)
            else:
                learner.failed(config.price)
                training.reward_anew(_priced(reward, learner.price))
                for _ in range(config.critic_again_updates):
                    learner.update(training.replay, actor=False)

        training.learn(learner, checkpoint, move_tie, until)
        training.close()
    return learner


def _priced(reward: EpisodeReward, price: float) -> EpisodeReward:
    """The same, less so much in every step with the task undone."""

    def both(signals: Float32Array, observations: Float32Array, actions: Float32Array) -> npt.NDArray[np.floating]:
        rewards: npt.NDArray[np.floating] = reward(signals, observations, actions) - price * signals[:, _UNDONE]
        return rewards

    return both


def guided(
    reference: Sequence[Trajectory], learned: EpisodeReward, stroke_weight: float, force_price: float
) -> EpisodeReward:
    """The reward that is learned from: PbRL-HRI's, more for strokes where a task is done by them, and less for force.

    Distance and strokes in standard deviations over reference rollouts. A critic that is asked for a policy's value
    does not know that episodes end: without the latter strokes that come too late cost nothing. R-hat forgives a blow
    that is short; so force has a price where it is more than 95 of 100 reference episodes reach (decision 162;
    docs/results/rivals.md).
    """
    approaching = pbrl_hri.sketchy(reference, learned)
    unit = float(np.concatenate([each.signals[:, _STROKES] for each in reference]).std())
    worth = stroke_weight / unit if unit else 0.0
    usual = float(np.quantile([each.contact_force_n.max() for each in reference], FORCE_QUANTILE))

    def reward(signals: Float32Array, observations: Float32Array, actions: Float32Array) -> npt.NDArray[np.floating]:
        force = signals[:, _FORCES].sum(axis=1)
        too_much = np.clip((force - usual) / FORCE_RAMP_N, 0.0, MOST_RAMPS)
        rewards: npt.NDArray[np.floating] = approaching(signals, observations, actions)
        rewards = rewards + worth * signals[:, _STROKES] - force_price * too_much
        return rewards

    return reward


def _imitate(learner: WatchedLearner, training: PreferenceRl, act: FilterAct, config: Refinement) -> None:
    """Begin as the filter, which makes the warm-up's steps."""

    def disturbed(states: Float32Array) -> Float32Array:
        actions = act.batch(states)
        noise = training.rng.normal(0.0, config.warm_up_noise, actions.shape)
        return np.clip(actions + noise, -1.0, 1.0).astype(np.float32)

    before = training.replay.count
    states = training.warm_up(disturbed)
    shown = np.concatenate([states, *[states[before:]] * OWN_SHARE])
    demonstrations = Demonstrations(shown, act.batch(shown))
    imitate(learner.actor, demonstrations, config.imitation_steps, early=-1, watch=lambda _: None)
    learner.average.load_state_dict(learner.actor.state_dict())
    learner.hold()


def gate_refined(
    problem: FilterProblem,
    drafts: Sequence[FilterDraft],
    reference: Sequence[Trajectory],
    more_reference: Callable[[], Sequence[Trajectory]],
    collect: Collect,
    progress: ReportProgress = lambda stage, share: None,
) -> FilterDraft:
    """As much of the refined policy as keeps the task and is better enough than the mode; else the mode.

    ``drafts``: of refine(). What had been best on the way is tried where the last one is not good enough.
    ``more_reference``: the frozen policy in the scenarios of the check, which what passes the gate is tried in, too.
    """
    started, (draft, *_) = time.perf_counter(), drafts
    least = LEAST_LIFT * to_beat(problem, draft, reference)
    for candidate, gate in [*((each, 1.0) for each in drafts[:-1]), *((drafts[-1], gate) for gate in STRENGTHS)]:
        progress(f"checking {gate:.0%} of the refined policy on held-out scenarios", 0.35)
        trial, driven = _tried(problem, candidate, gate, reference, collect)
        draft = replace(draft, trials=(*draft.trials, trial))
        if trial.preference <= max(least, 0.0) or not keeps_task(problem, trial, reference):
            continue
        checked, _ = _tried(problem, candidate, gate, more_reference(), collect)
        draft = replace(draft, trials=(*draft.trials, checked))
        if keeps_task(problem, checked, more_reference()) and checked.success_change >= -LARGEST_LOSS:
            weights = candidate.weights.changed(gate=gate)
            tested = limits_of(problem.task.observation, problem.task.action, driven, reference)
            draft = replace(draft, weights=weights, tested=tested, notes=(*draft.notes, _REFINED))
            return draft.timed("gate_refined", started)
    notes = (*draft.notes, "The refined policy was no better on held-out scenarios and is off.")
    draft = replace(draft, weights=draft.weights.changed(refined={}), notes=notes)
    return draft.timed("gate_refined", started)
