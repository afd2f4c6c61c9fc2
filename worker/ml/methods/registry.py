"""Every method of the comparison behind one interface: fit(name, setting) gives a policy to run and what it cost.

Labels are those the reward model was trained on. Environment steps are all that the method asked for on top of them,
trials on held-out scenarios included. What is made once for everybody (the pool of clips, the response surface of the
modes, the frozen policy) counts for nobody.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import gymnasium

from app.installed_tasks.refinements import answers_ahead
from worker.domain.scenarios import RESIDUAL, first_of
from worker.domain.trajectory import Trajectory
from worker.domain.type_aliases import Act
from worker.ml.filters.encoders.pbarl_printed import PrintedConfig
from worker.ml.filters.exported import filter_act
from worker.ml.filters.fitting import mode_search, pbarl
from worker.ml.filters.fitting.filter_draft import FilterDraft
from worker.ml.filters.fitting.filter_problem import Collect, FilterProblem
from worker.ml.filters.fitting.pool import Pool
from worker.ml.filters.fitting.printed_filter import fit_printed
from worker.ml.filters.fitting.response_surface import ResponseSurface
from worker.ml.methods import (
    bayesian_modes,
    clusters,
    dsrl,
    kept_task,
    latent_people,
    pbrl_hri,
    prefft,
    prefft_lagrangian,
    residual_rl,
    sliders,
)
from worker.ml.methods.behaviour_flow import fit_flow
from worker.ml.methods.best_of_n import fit_best_of_n
from worker.ml.methods.latent_people import Latent
from worker.ml.methods.pbrl_hri import FromScratch
from worker.ml.methods.people import Person
from worker.ml.methods.prefft import TIED, FineTuning
from worker.ml.methods.prefft_lagrangian import Constraint, Price
from worker.ml.methods.steered_rl import Steering
from worker.ml.policies.checkpoint import Checkpoint
from worker.ml.policies.reference import looked_into
from worker.ml.reinforcement import refinement
from worker.ml.reinforcement.archived_policy import ArchivedPolicy, best_archived, choose_archived
from worker.ml.reinforcement.guided_reward import sketchy
from worker.ml.reinforcement.preference_rl import Env, MakeEnv, PolicyAct, learned
from worker.ml.reinforcement.quick_filter import quick_filter
from worker.ml.reinforcement.refinement import Refinement
from worker.ml.reinforcement.refinement_gate import begin_as, gate_refined
from worker.ml.rewards.reward_models import RewardModel


@dataclass(frozen=True)
class MethodConfig:
    """How much each method may do; what the studio's filter may do is in the problem's FilterConfig."""

    printed_steps: int = 3_000
    """the paper: 1.5e7"""
    printed_rollouts: int = 100
    fine_tuning: FineTuning = field(default_factory=FineTuning)
    from_scratch: FromScratch = field(default_factory=FromScratch)
    candidates: int = 10
    """n of best_of_n"""
    value_rollouts: int = 150
    value_noise: float = 0.25
    value_steps: int = 3_000
    steering: Steering = field(default_factory=Steering)
    refinement: Refinement = field(default_factory=Refinement)
    constraint: Constraint = field(default_factory=Constraint)
    others: int = 60
    """people whose answers clusters and latents are learned from; they count for nobody"""
    others_labels: int = 100
    latent: Latent = field(default_factory=Latent)


class NobodyToAsk(ValueError):
    """This method asks the person for more than labels, which only the benchmark's scripted users answer."""


@dataclass(frozen=True)
class Setting:
    """One user's task, given to every method alike."""

    problem: FilterProblem
    """with the reward model that everybody is judged by"""
    labels: int
    pool: Pool
    surface: Callable[[], ResponseSurface]
    action_reward: Callable[[], RewardModel]
    """a model of the same labels that can score actions which were never executed"""
    reference: Callable[[range], Sequence[Trajectory]]
    """rollouts of the frozen policy's deterministic action in these scenarios"""
    collect: Collect
    make_env: MakeEnv
    config: MethodConfig = MethodConfig()
    checkpoint: Checkpoint | None = None
    """where a training that takes minutes keeps what a restart needs, and says how far it is"""
    archived: Callable[[range], Sequence[ArchivedPolicy]] = lambda _: ()
    """the task's policies that were refined beforehand, in these scenarios"""
    person: Person | None = None
    """who can be asked for more than labels; None: nobody"""

    def asked(self) -> Person:
        """The person. Raises NobodyToAsk."""
        if self.person is None:
            raise NobodyToAsk(NobodyToAsk.__doc__)
        return self.person

    def with_reward(self, reward: RewardModel) -> "Setting":
        """The same with another model of what is wanted."""
        return replace(self, problem=replace(self.problem, reward=reward))


@dataclass(frozen=True)
class Fitted:
    """A method's result. ``act`` is deterministic and can be sent to another process."""

    act: Act
    labels: int
    environment_steps: int
    cpu_s: float
    """of this process, simulation included"""
    notes: tuple[str, ...]


FitMethod = Callable[[Setting], tuple[Act, tuple[str, ...]]]


def fit(name: str, setting: Setting) -> Fitted:
    """Fit the method of this name in METHODS; raises KeyError for another."""
    method, meter, started = METHODS[name], _Meter(), time.process_time()
    act, notes = method(meter.on(setting))
    labels = 0 if name in WITHOUT_LABELS else setting.labels
    return Fitted(act, labels, meter.steps, round(time.process_time() - started, 2), notes)


# -- the methods -------------------------------------------------------------------------------------------------------


def fit_reference(setting: Setting) -> tuple[Act, tuple[str, ...]]:
    """The frozen policy: nothing is learned."""
    return PolicyAct(setting.problem.policy), ()


def fit_pbarl(setting: Setting) -> tuple[Act, tuple[str, ...]]:
    """Mode and residual: mode, gate, residual encoder, gate."""
    return _shipped(setting, _fitted(setting))


def fit_without(setting: Setting, **changed: Any) -> tuple[Act, tuple[str, ...]]:
    """Mode and residual without one of their parts: an ablation. ``changed``: of the FilterConfig."""
    problem = replace(setting.problem, config=replace(setting.problem.config, **changed))
    return fit_pbarl(replace(setting, problem=problem))


def fit_pbarl_archived(setting: Setting) -> tuple[Act, tuple[str, ...]]:
    """The best policy refined beforehand, in a mode of the person's own; mode and residual where none is better."""
    problem, block, known = setting.problem, _gate(setting), setting.pool.rollouts
    archived, reference = setting.archived(block), setting.reference(block)
    more_reference = partial(setting.reference, problem.config.check_block(problem.task))
    own = _fitted(setting)
    better = choose_archived(problem, own, archived, known, reference, more_reference, setting.collect)
    return _shipped(setting, better)


def fit_pbarl_quick(setting: Setting) -> tuple[Act, tuple[str, ...]]:
    """What a person gets who still answers: an archived policy in no mode, or the first mode that will do."""
    block = _gate(setting)
    archived, reference = setting.archived(block), setting.reference(block)
    draft = quick_filter(setting.problem, setting.surface(), setting.pool, archived, reference, setting.collect)
    return _shipped(setting, draft)


def fit_pbarl_refined(setting: Setting) -> tuple[Act, tuple[str, ...]]:
    """The studio's filter with its refinement, most of which is made for the first of the labels."""
    problem, reference, config = setting.problem, setting.reference(_gate(setting)), setting.config.refinement
    more_reference = partial(setting.reference, problem.config.check_block(problem.task))
    watched = setting.reference(problem.config.watch_block(problem.task))
    beginning = refinement.Beginning(setting.make_env, setting.pool.rollouts, reference, watched, setting.collect)
    archived = setting.archived(problem.config.gate_block(problem.task))
    first = setting.asked().labels.first(answers_ahead(setting.labels))
    early = replace(problem, reward=setting.asked().fit(first))
    mode = mode_search.find_mode(early, setting.surface(), setting.pool, reference, setting.collect)
    with TemporaryDirectory() as folder:
        checkpoint = Checkpoint(Path(folder))
        known, collect = setting.pool.rollouts, setting.collect
        start = begin_as(mode, best_archived(early, mode, archived, known, reference, collect))
        refinement.refine_ahead(early, start.draft, replace(beginning, archived=start.driven), config, checkpoint)

        def refined(draft: FilterDraft) -> FilterDraft:
            best = best_archived(problem, draft, archived, known, reference, collect)
            drafts: tuple[FilterDraft, ...] = ()
            if refinement.is_promising(problem, draft, reference, config, checkpoint, setting.collect):
                start = begin_as(draft, best)
                goes_on = replace(beginning, archived=start.driven)
                drafts = refinement.refine(problem, start.draft, goes_on, config, checkpoint)
            return gate_refined(problem, draft, best, drafts, reference, more_reference, setting.collect)

        return _shipped(setting, _fitted(setting, refined))


def fit_as_printed(setting: Setting, list_length: int) -> tuple[Act, tuple[str, ...]]:
    """The paper's objective with a list of n actions; no gate, as the paper has none."""
    problem = replace(setting.problem, reward=setting.action_reward())
    rollouts = setting.reference(first_of(RESIDUAL, setting.config.printed_rollouts))
    config = PrintedConfig(
        list_length=list_length,
        betas=problem.task.printed_betas,
        steps=setting.config.printed_steps,
    )
    checkpoint = setting.checkpoint
    draft = fit_printed(problem, rollouts, config, lambda stage, share: checkpoint.note(share) if checkpoint else None)
    return _exported(problem, draft), draft.notes


def fit_prefft(setting: Setting, tie_weight: float) -> tuple[Act, tuple[str, ...]]:
    """SAC goes on from the frozen policy on the learned reward."""
    problem, config = setting.problem, replace(setting.config.fine_tuning, tie_weight=tie_weight)
    policy = prefft.fine_tune(
        setting.make_env,
        looked_into(problem.policy),
        learned(problem.reward),
        problem.task.observation,
        config,
        problem.seed,
        setting.checkpoint,
    )
    return PolicyAct(policy), (f"SAC for {config.steps} steps; tie {tie_weight:g}.",)


def fit_pbrl_hri(setting: Setting) -> tuple[Act, tuple[str, ...]]:
    """SAC from scratch on the distance and the learned reward."""
    problem, config = setting.problem, setting.config.from_scratch
    reference = setting.reference(_gate(setting))
    reward = sketchy(reference, learned(problem.reward))
    policy = pbrl_hri.train(
        setting.make_env, looked_into(problem.policy), reward, problem.task.observation, config, problem.seed
    )
    return PolicyAct(policy), (f"SAC from scratch for {config.steps} steps.",)


def fit_best_of(setting: Setting) -> tuple[Act, tuple[str, ...]]:
    """The most valuable of n samples in every step."""
    problem, config = setting.problem, setting.config
    scenarios = first_of(RESIDUAL, config.value_rollouts)
    rollouts = setting.collect(PolicyAct(looked_into(problem.policy)), scenarios, config.value_noise, problem.seed)
    act = fit_best_of_n(
        looked_into(problem.policy), problem.reward, rollouts, config.candidates, config.value_steps, problem.seed
    )
    return act, (f"n = {config.candidates} samples and the mean, ranked by value.",)


def fit_prefft_lagrangian(setting: Setting) -> tuple[Act, tuple[str, ...]]:
    """PrefFT with a price on the task being undone, moved until success is kept."""
    problem, config, constraint = setting.problem, setting.config.fine_tuning, setting.config.constraint
    reference = setting.reference(first_of(RESIDUAL, constraint.scenarios))
    price = Price(learned(problem.reward), constraint, reference, setting.collect, problem.seed)
    policy = prefft_lagrangian.fine_tune(
        setting.make_env, looked_into(problem.policy), price, problem.task.observation, config, problem.seed
    )
    prices = ", ".join(f"{each:.2f}" for each in price.prices)
    return PolicyAct(policy), (f"SAC for {config.steps} steps; prices of an undone step: {prices}.",)


def fit_residual_rl(setting: Setting) -> tuple[Act, tuple[str, ...]]:
    """Policy Decorator: a bounded correction of the frozen policy."""
    problem, config = setting.problem, setting.config.steering
    reward, policy = learned(problem.reward), looked_into(problem.policy)
    act = residual_rl.fit(setting.make_env, policy, reward, problem.task.observation, config, problem.seed)
    return act, (f"SAC for {config.steps} steps; corrections of at most {config.residual_bound:g}.",)


def fit_dsrl(setting: Setting, flow: bool) -> tuple[Act, tuple[str, ...]]:
    """DSRL over the frozen policy's own noise, or over that of a flow fitted to the pool."""
    problem, config = setting.problem, setting.config.steering
    reward, policy = learned(problem.reward), looked_into(problem.policy)
    largest = config.largest_noise
    decoder = (
        fit_flow(setting.pool.rollouts, policy, largest, config.flow_hidden, config.flow_steps, problem.seed)
        if flow
        else dsrl.OwnNoise(policy, largest)
    )
    act = dsrl.fit(setting.make_env, decoder, policy, reward, problem.task.observation, config, problem.seed)
    return act, (f"SAC for {config.steps} steps; noise of at most {largest:g}.",)


def fit_preferential_bo(setting: Setting) -> tuple[Act, tuple[str, ...]]:
    """Modes compared in duels of whole episodes, one per label of everybody else."""
    problem, surface = setting.problem, setting.surface()
    mode = bayesian_modes.best_mode_by_duels(setting.asked(), problem, surface, setting.collect, setting.labels)
    return kept_task.strongest(problem, mode, setting.reference(_gate(setting)), setting.collect)


def fit_sliders(setting: Setting, noise: float) -> tuple[Act, tuple[str, ...]]:
    """A mode that the person sets, watching two episodes per label of everybody else."""
    mode = sliders.set_by(setting.asked(), setting.problem, setting.collect, noise, 2 * setting.labels)
    return kept_task.strongest(setting.problem, mode, setting.reference(_gate(setting)), setting.collect)


def fit_clusters(setting: Setting, count: int) -> tuple[Act, tuple[str, ...]]:
    """The studio's filter for the nearest of ``count`` kinds of people."""
    config = setting.config
    reward, notes = clusters.nearest(setting.asked(), config.others, config.others_labels, count, setting.problem.seed)
    act, more = fit_pbarl(setting.with_reward(reward))
    return act, (*notes, *more)


def fit_latent(setting: Setting) -> tuple[Act, tuple[str, ...]]:
    """The studio's filter for the reward that a population latent gives the person."""
    config, problem = setting.config, setting.problem
    reference = setting.reference(_gate(setting))
    reward = latent_people.model_of(
        setting.asked(), reference, config.others, config.others_labels, config.latent, problem.seed
    )
    return fit_pbarl(setting.with_reward(reward))


# What is new comes last: a method has its colour in pictures by its place.
METHODS: Mapping[str, FitMethod] = {
    "reference": fit_reference,
    "pbarl": fit_pbarl,
    "pbarl_archived": fit_pbarl_archived,
    "pbarl_refined": fit_pbarl_refined,
    "pbarl_printed": partial(fit_as_printed, list_length=10),
    "pbarl_n1": partial(fit_as_printed, list_length=1),
    "pbarl_n20": partial(fit_as_printed, list_length=20),
    "prefft": partial(fit_prefft, tie_weight=0.0),
    "prefft_anchored": partial(fit_prefft, tie_weight=TIED),
    "pbrl_hri": fit_pbrl_hri,
    "best_of_n": fit_best_of,
    "prefft_lagrangian": fit_prefft_lagrangian,
    "residual_rl": fit_residual_rl,
    "dsrl": partial(fit_dsrl, flow=False),
    "dsrl_flow": partial(fit_dsrl, flow=True),
    "preferential_bo": fit_preferential_bo,
    "sliders": partial(fit_sliders, noise=0.11),
    "sliders_noisy": partial(fit_sliders, noise=0.35),
    "average": partial(fit_clusters, count=1),
    "clusters_3": partial(fit_clusters, count=3),
    "latent_people": fit_latent,
    "pbarl_no_mode": partial(fit_without, mode_attempts=0),
    "pbarl_no_residual": partial(fit_without, residual_rounds=0),
    "pbarl_no_caution": partial(fit_without, success_caution=0.0),
    "pbarl_quick": fit_pbarl_quick,
}
"""Episodes seen with a blur of 0.11 (0.35) spreads of a pair are ordered wrongly in about 5 (15) of 100 pairs, if their
differences are normal: as often as answers are, and three times as often."""
WITHOUT_LABELS = ("reference", "average")
"""Nobody's own answers are used."""


# -- inside ------------------------------------------------------------------------------------------------------------


def _gate(setting: Setting) -> range:
    return setting.problem.config.gate_block(setting.problem.task)


def _home(setting: Setting) -> Callable[[], Sequence[Trajectory]]:
    return partial(setting.reference, setting.problem.config.home_block(setting.problem.task))


def _fitted(setting: Setting, refined: Callable[[FilterDraft], FilterDraft] = lambda mode: mode) -> FilterDraft:
    gate, home, surface = setting.reference(_gate(setting)), _home(setting), setting.surface()
    return pbarl.fit_studio(setting.problem, surface, setting.pool, gate, home, setting.collect, refined=refined)


def _shipped(setting: Setting, draft: FilterDraft) -> tuple[Act, tuple[str, ...]]:
    problem = setting.problem
    draft = draft.shielded(problem.task.observation, _home(setting))
    weights = draft.weights
    mode = ", ".join(f"{axis} {value:+.2f}" for axis, value in weights.executed_mode.items()) or "off"
    share = weights.residual_share if weights.encoder else 0.0
    refined = " Refined." if weights.refined else ""
    return _exported(problem, draft), (
        *draft.notes,
        f"Mode: {mode}; gate {weights.gate:g}; residual {share:g}.{refined}",
    )


def _exported(problem: FilterProblem, draft: FilterDraft) -> Act:
    """What is evaluated is what would be shipped: the ONNX file."""
    return filter_act.act_of(problem.task.modes, problem.policy, draft.weights)


class _Meter:
    """Counts the environment steps behind everything that a setting offers."""

    def __init__(self) -> None:
        self.steps = 0

    def on(self, setting: Setting) -> Setting:
        """The same setting, measured."""

        def collect(act: Act, scenarios: Sequence[int], noise: float, seed: int) -> list[Trajectory]:
            return self._counted(setting.collect(act, scenarios, noise, seed))

        def reference(scenarios: range) -> list[Trajectory]:
            return self._counted(setting.reference(scenarios))

        def make_env() -> Env:
            return _Metered(setting.make_env(), self)

        return replace(setting, collect=collect, reference=reference, make_env=make_env)

    def _counted(self, trajectories: Sequence[Trajectory]) -> list[Trajectory]:
        self.steps += sum(len(each) for each in trajectories)
        return list(trajectories)


class _Metered(gymnasium.Wrapper[Any, Any, Any, Any]):
    """An environment whose steps are counted."""

    def __init__(self, env: Env, meter: _Meter) -> None:
        super().__init__(env)
        self._meter = meter

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """See gymnasium.Env."""
        self._meter.steps += 1
        return self.env.step(action)
