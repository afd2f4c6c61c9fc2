"""The longest stage of the studio's filter: a policy of the person's own, which begins as the mode or an archived one.

A network imitates what it begins as; soft actor-critic goes on from there, on R-hat and a sketchy reward (guided()).
Its replay begins with the rollouts that are there already (Ball et al. 2023, arXiv 2302.02948). It is tied to the best
it was so far, as prefft_anchored is to where it began, less and less while it learns: without a tie it forgets the task
before it finds anything better. Where it got no better all the same it goes back (docs/method.md, section 5).
"""

import hashlib
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from app.installed_tasks.refinements import SHARE_AHEAD
from worker.domain.trajectory import Trajectory
from worker.domain.type_aliases import Float32Array
from worker.ml.filters.exported.filter_act import FilterAct, act_of
from worker.ml.filters.fitting.filter_draft import FilterDraft
from worker.ml.filters.fitting.filter_problem import Collect, FilterProblem
from worker.ml.filters.fitting.gate import keeps_task, to_beat
from worker.ml.policies.checkpoint import Checkpoint
from worker.ml.policies.demonstrations import Demonstrations
from worker.ml.policies.imitation import imitate
from worker.ml.policies.reference import looked_into
from worker.ml.policies.sac import Actor, Learner, SacConfig
from worker.ml.reinforcement.guided_reward import guided, priced
from worker.ml.reinforcement.preference_rl import MakeEnv, PreferenceRl, learned
from worker.ml.reinforcement.refinement_gate import LARGEST_LOSS, try_refined
from worker.ml.reinforcement.tied_learner import anchor_in
from worker.ml.reinforcement.watched_learner import WatchedLearner, price_in

LOOKED_AT = 40
"""of the gate's scenarios, to see whether a refinement is promising"""
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
    target_entropy: float = -14.0
    """twice as far down as is usual for 7 joints: what is learned counts the noise, what is judged has none (decision
    193)"""
    first_tie: float = 1.0
    """weight of the KL divergence from what it is tied to, the imitation at first, in units of the spread of Q; see
    TiedLearner"""
    last_tie: float = 0.3
    hold_every_steps: int = 12_000
    """how often it is tried, and tied to what it has become or goes back: it goes far, and never far at once; see
    WatchedLearner"""
    largest_loss: float = LARGEST_LOSS
    """of success in the scenarios in which it is tried on the way; what loses more has lost the task"""
    price: float = 0.5
    """of every step with the task undone, once it was lost, in standard deviations of R-hat"""
    stroke_weight: float = 0.3
    """of strokes in the sketchy reward, beside the distance"""
    force_price: float = 1.0
    """of FORCE_RAMP_N more on the person than is usual, in standard deviations of R-hat; see guided()"""
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
    """of the frozen policy in the gate's scenarios: the unit of the sketchy reward"""
    watched: Sequence[Trajectory]
    """of the frozen policy in the scenarios in which it is tried on the way: what the task is kept by"""
    collect: Collect
    archived: Sequence[Trajectory] = ()
    """of the archived policy that it begins as, in the gate's scenarios. Clips show modes; what such a policy does
    beyond them has to count, or learning may leave it"""


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
    return replace(draft, weights=draft.weights.changed(refined=actor.policy().weights, refined_mode={}))


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
    actor.load_state_dict(anchor_in(kept[0]))
    trial, _ = try_refined(problem, _with(draft, actor), 1.0, reference[:LOOKED_AT], collect)
    return trial.preference > to_beat(problem, draft, reference)


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
        target_entropy=config.target_entropy,
        critic_first_updates=config.critic_first_updates if kept is None else config.critic_again_updates,
    )
    policy, reference, watched = looked_into(problem.policy), beginning.reference, beginning.watched
    offset, scale = torch.from_numpy(policy.offset), torch.from_numpy(policy.scale)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(problem.seed)
        reaching = problem.reward.reaching(beginning.archived)
        reward = guided(reference, learned(reaching), config.stroke_weight, config.force_price)
        mark = hashlib.sha256(problem.reward.to_bytes()).hexdigest()
        first_reward = priced(reward, price_in(kept[0]) if kept else 0.0)
        training = PreferenceRl(beginning.make_env, first_reward, settings, [*beginning.known, *reference], mark)
        learner = WatchedLearner(settings, offset, scale, training.actions, config.first_tie)

        def move_tie(training: PreferenceRl, _: Learner) -> None:
            learner.weight = config.first_tie + training.steps / config.steps * (config.last_tie - config.first_tie)
            learned_for = training.steps - settings.random_steps
            is_time = learned_for % config.hold_every_steps < config.environments <= learned_for
            if is_time and training.steps < config.ahead_steps:  # later on somebody waits
                look()

        def look() -> None:
            """Hold it where it is if that is better than ever before, or go back."""
            trial, _ = try_refined(problem, _with(draft, learner.average), 1.0, watched, beginning.collect)
            if keeps_task(problem, trial, watched) and trial.success_change >= -config.largest_loss:
                learner.passed(trial.preference)
            else:
                learner.failed(config.price)
                training.reward_anew(priced(reward, learner.price))
                for _ in range(config.critic_again_updates):
                    learner.update(training.replay, actor=False)

        if kept is None:
            _imitate(learner, training, _begun_as(problem, draft), config)
            look()
        else:
            training.restore(learner, *kept)
        training.learn(learner, checkpoint, move_tie, until)
        training.close()
    return learner


def _begun_as(problem: FilterProblem, draft: FilterDraft) -> FilterAct:
    """The mode at its strength, or the archived policy, which is whole however much that mode was weakened."""
    weights = draft.weights.changed(gate=1.0) if draft.weights.refined else draft.weights
    return act_of(problem.task.modes, problem.policy, weights)


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
