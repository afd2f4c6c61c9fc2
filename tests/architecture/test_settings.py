"""A study's settings are written once; what the worker and the offline commands assume for themselves agrees with them.

The worker's learning may not import the domain, and neither may know the other's defaults: here both are seen.
"""

from dataclasses import fields
from enum import StrEnum
from typing import Any, get_args

import pytest

from app.domain.choices import ClipQuality, Method, RewardKind, Strategy
from app.domain.preferences import Response
from app.domain.protocol import FROM_OTHERS, LIKERT_POINTS, EvaluatedMethod, EvaluationSettings, Language, PlannedTest
from app.domain.study_settings import PAPER_PROTOCOL, StudySettings
from app.installed_tasks import by_name
from app.paths import WORDING
from app.services.evaluation import unblinding
from app.services.studies import preregistration
from app.web.experimenter import results
from worker.analysis.filters.promise import Promise
from worker.analysis.study import between, figures, hypothesis_tests, statistics
from worker.domain import responses
from worker.domain.spaces import CONTROL_STEP_S
from worker.experiments import benchmark_cell, rollout_cache
from worker.experiments.benchmark_cell import BenchmarkConfig
from worker.jobs.learning import fits
from worker.ml import acquisition
from worker.ml.filters.exported import filter_module
from worker.ml.filters.fitting.filter_problem import FilterConfig
from worker.ml.methods.prefft import FineTuning
from worker.ml.methods.registry import METHODS
from worker.ml.rewards import reward_training
from worker.sim.render.clip import STYLES

USUAL = StudySettings()
EVALUATION = EvaluationSettings()


def default(config: type, name: str) -> Any:
    """Of a dataclass's field."""
    return next(each.default for each in fields(config) if each.name == name)


@pytest.mark.parametrize(
    ("assumed", "usual"),
    [
        (FilterConfig(), fits.filter_config(USUAL)),
        (default(Promise, "share"), USUAL.harm_share),
        (default(Promise, "confidence"), USUAL.harm_confidence),
        (default(Promise, "force_n"), USUAL.harm_force_n),
        (default(Promise, "spilled"), USUAL.harm_spilled),
        (default(FineTuning, "steps"), EVALUATION.fine_tuning_steps),
        (default(BenchmarkConfig, "labels"), PAPER_PROTOCOL.labels_per_participant),
        (default(BenchmarkConfig, "rule"), USUAL.strategy),
        (default(BenchmarkConfig, "reward"), USUAL.reward_kind),
        (default(BenchmarkConfig, "smallest_pool"), USUAL.pool_scenarios),
        (acquisition.RANDOM_SHARE, USUAL.random_share),
        (benchmark_cell.CHOOSE_EVERY, USUAL.retrain_every_labels),
        (rollout_cache.BEHAVIOURS_PER_SCENARIO, USUAL.behaviours_per_scenario),
        (statistics.POINTS, (1, LIKERT_POINTS)),
        (CONTROL_STEP_S, 1 / by_name.CONTROL_RATE_HZ),
    ],
)
def test_what_is_usual_without_a_study_is_what_is_usual_in_one(assumed: object, usual: object) -> None:
    assert assumed == usual


@pytest.mark.parametrize(
    ("offered", "known"),
    [
        (Method, get_args(filter_module.Method)),
        (RewardKind, get_args(reward_training.RewardKind)),
        (Strategy, get_args(acquisition.Strategy)),
        (ClipQuality, STYLES),
        (Response, responses.TARGETS),
        (PlannedTest, (*hypothesis_tests.TESTS, *between.BETWEEN_TESTS)),
        (PlannedTest, preregistration.TEST_NAMES),
        (EvaluatedMethod, unblinding.NAMES),
        (EvaluatedMethod, results.METHOD_NAMES),
        (EvaluatedMethod, figures.NAMES),
        (Language, [each.stem for each in WORDING.glob("*.ftl")]),
    ],
)
def test_what_can_be_chosen_is_what_is_known_elsewhere(offered: type[StrEnum], known: Any) -> None:
    assert {each.value for each in offered} == {str(each) for each in known}


def test_every_method_that_a_person_s_answers_make_is_one_of_the_benchmark() -> None:
    made_otherwise = {*FROM_OTHERS, EvaluatedMethod.SELF_SET}
    assert {each.value for each in EvaluatedMethod if each not in made_otherwise} <= set(METHODS)


def test_the_methods_have_the_same_names_on_pages_and_in_figures() -> None:
    assert dict(figures.NAMES) == dict(results.METHOD_NAMES)
