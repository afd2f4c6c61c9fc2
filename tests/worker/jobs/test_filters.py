"""When a filter is trained, and when not."""

from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from sqlalchemy import func, select

from app.db import Database
from app.domain.choices import Method
from app.domain.clips import Clip, Rollout
from app.domain.models import Model, ModelKind, RunKind
from app.domain.preferences import LabelEvent, Query, Response
from app.domain.run_keys import RunKey
from app.domain.studies import Participant, Study
from app.domain.study_settings import StudySettings
from app.installed_tasks.refinements import SHORTEST_REFINEMENT
from app.services.answers import accuracy
from app.services.answers.misfit import Misfit
from app.storage import ArtefactStore
from tests.worker.at_hand import at_once
from worker.compute.behaviours import Behaviour
from worker.compute.pools import Compute
from worker.jobs.learning import fits, refinement, reward_models
from worker.jobs.learning.filters import (
    NothingToLearnFrom,
    fit_stage,
    notes_on_foresight,
    notes_on_misfit,
    train_filter,
)
from worker.jobs.runtime import records
from worker.jobs.runtime.context import WorkerContext
from worker.jobs.runtime.due_work import answers_known, is_outdated
from worker.jobs.runtime.records import Job
from worker.ml.filters.exported.filter_module import FilterWeights
from worker.ml.filters.fitting.filter_draft import FilterDraft
from worker.ml.filters.fitting.pool import Pool
from worker.ml.policies.checkpoint import PAUSE_FILE, Abandoned, Checkpoint, ask_to_pause, begin_again
from worker.ml.reinforcement.refinement import Refinement
from worker.tasks.registry import task


@pytest.fixture
def context(database: Database, store: ArtefactStore) -> WorkerContext:
    return WorkerContext(database, store, Compute(1))


def begin(context: WorkerContext, participant: Participant, kind: RunKind, answers: str = "") -> tuple[Job, int]:
    job = Job(RunKey(kind, participant_id=participant.id, labels=10, answers=answers), participant.study_id)
    with context.database.writing() as session:
        return job, records.begin_run(session, job, seed=1)


def save_model(
    context: WorkerContext,
    participant: Participant,
    kind: ModelKind,
    label_hash: str,
    metrics: Mapping[str, Any] = MappingProxyType({}),
) -> None:
    _, run_id = begin(context, participant, RunKind(kind.value), label_hash)
    with context.database.writing() as session:
        records.set_labels(session, run_id, 10, label_hash)
        records.save_model(session, run_id, kind, "0" * 64, dict(metrics))


def count_filters(context: WorkerContext) -> int:
    with context.database.reading() as session:
        return session.scalar(select(func.count(Model.id)).where(Model.kind == ModelKind.FILTER)) or 0


def test_a_filter_that_has_seen_the_same_labels_is_not_trained_again(
    context: WorkerContext, participant: Participant
) -> None:
    save_model(context, participant, ModelKind.REWARD, "same labels")
    save_model(context, participant, ModelKind.FILTER, "same labels")
    job, run_id = begin(context, participant, RunKind.FILTER, "filter/participant-1/labels-10")
    train_filter(context, job, run_id, at_once)
    assert count_filters(context) == 1


@pytest.fixture
def answered(
    add_clips: Callable[[int, int], list[Clip]], answer: Callable[[Clip, Clip, Response], Query]
) -> Callable[[int], None]:
    """Give so many answers."""
    clips = [clip for scenario in range(6) for clip in add_clips(scenario, 4)]

    def say(how_many: int) -> None:
        for index in range(how_many):
            answer(clips[index], clips[index + 1], Response.LEFT)

    return say


def filter_at(context: WorkerContext, participant: Participant, milestone: int) -> Job:
    """The training of a filter that knows the answers of now."""
    with context.database.reading() as session:
        settings = session.get_one(Study, participant.study_id).settings
        last_answer = session.scalar(select(func.max(LabelEvent.id))) or 0
    known = answers_known(settings, milestone, last_answer, None)
    key = RunKey(RunKind.FILTER, participant_id=participant.id, labels=milestone, answers=known)
    return Job(key, participant.study_id)


def outdated_at(context: WorkerContext, participant: Participant, milestone: int, *, begun: bool) -> bool:
    with context.database.reading() as session:
        return is_outdated(session, filter_at(context, participant, milestone), begun=begun)


def test_a_study_knows_in_which_modes_the_episodes_of_its_pool_were_done(
    context: WorkerContext, participant: Participant, add_clips: Callable[..., list[Clip]]
) -> None:
    """Of these filters for wishes beyond sums learn what modes do."""
    with context.database.writing() as session:
        slow, shaken, usual = (session.get_one(Clip, each.id).rollout_id for each in add_clips(1, 3))
        session.get_one(Rollout, slow).mode = Behaviour({"speed_far": -0.4}).described()
        session.get_one(Rollout, shaken).mode = Behaviour({"speed_far": 0.3}, disturbance=0.2).described()
        session.get_one(Rollout, usual).mode = Behaviour().described()
    job, _ = begin(context, participant, RunKind.FILTER)
    pool, family = fits.pool_of(context, job), task("feeding").modes
    modes, rollouts = pool.in_modes(family)
    assert [family.named(mode)["speed_far"] for mode in modes] == [-0.4, 0.0]
    assert np.abs(modes).sum() == 0.4
    assert [len(each) for each in rollouts] == [len(pool.rollouts[0]), len(pool.rollouts[2])]


def test_of_two_milestones_that_were_passed_only_the_newer_filter_is_trained(
    context: WorkerContext, participant: Participant, answered: Callable[[int], None]
) -> None:
    answered(15)
    assert not outdated_at(context, participant, 10, begun=False)
    save_model(context, participant, ModelKind.REWARD, "ten labels")
    with context.database.writing() as session:
        study = session.get_one(Study, participant.study_id)
        study.stored_settings = {**study.stored_settings, "filter_milestones": [10, 15]}
    job, run_id = begin(context, participant, RunKind.FILTER)
    train_filter(context, job, run_id, at_once)
    assert count_filters(context) == 0, "the one of 15 is due"
    assert not outdated_at(context, participant, 10, begun=True), "one that has begun is finished while they answer"
    assert not outdated_at(context, participant, 15, begun=False)


def test_after_the_last_answer_an_earlier_filter_is_not_even_finished(
    context: WorkerContext, participant: Participant, answered: Callable[[int], None]
) -> None:
    answered(20)
    assert outdated_at(context, participant, 10, begun=True)
    assert not outdated_at(context, participant, 20, begun=True)


def test_only_the_filter_of_all_answers_and_those_for_several_people_are_sought_long_and_refined(
    context: WorkerContext, participant: Participant
) -> None:
    with context.database.reading() as session:
        settings = session.get_one(Study, participant.study_id).settings
    wanted = settings.model_copy(update={"refinement_steps": SHORTEST_REFINEMENT})
    printed = settings.model_copy(update={"method": Method.PRINTED})

    def done(chosen: StudySettings, kind: RunKind, labels: int) -> Collection[str]:
        key = RunKey(kind, participant_id=participant.id, labels=labels)
        return fits.stages_of(chosen, Job(key, participant.study_id))

    early, last = 10, settings.labels_per_participant
    for chosen in (settings, wanted):
        assert "quick" in done(chosen, RunKind.FILTER, early)
        assert not {"refinement", "residual", "archived"} & set(done(chosen, RunKind.FILTER, early))
    assert {"residual", "archived"} <= set(done(settings, RunKind.FILTER, last))
    assert "refinement" not in done(settings, RunKind.FILTER, last)
    assert "refinement" not in done(settings, RunKind.SHARED, early)
    for kind, labels in ((RunKind.FILTER, last), (RunKind.SHARED, early), (RunKind.REFINEMENT, early)):
        assert "refinement" in done(wanted, kind, labels)
        assert "archived" not in done(wanted, kind, labels), "it was compared with them when it was learned"
    assert list(done(printed, RunKind.FILTER, early)) == list(done(printed, RunKind.FILTER, last))


WHOLE = Refinement(SHORTEST_REFINEMENT).ahead_steps


def go_half_way(folder: Path) -> bool:
    return go_on(folder, WHOLE // 2)


def go_on(folder: Path, until: int = WHOLE) -> bool:
    """As a training does: from its checkpoint, and no pause that was asked for before counts."""
    begin_again(folder)
    begun = Checkpoint(folder).read_counts() or {"steps": 0}
    Checkpoint(folder).write({"nothing": torch.zeros(1)}, {"steps": until, "begun_at": begun["steps"]})
    return True


def come_too_late(folder: Path) -> bool:
    raise Abandoned(folder.name)


@pytest.fixture
def refining(monkeypatch: pytest.MonkeyPatch, context: WorkerContext, participant: Participant) -> Callable[..., None]:
    """Have refinements be made by such a function, in a compute process."""
    with context.database.writing() as session:
        study = session.get_one(Study, participant.study_id)
        study.stored_settings = {**study.stored_settings, "refinement_steps": SHORTEST_REFINEMENT}
    monkeypatch.setattr(reward_models, "fit", lambda *_: SimpleNamespace(stored=b""))
    monkeypatch.setattr(fits, "pool_of", lambda *_: Pool())
    monkeypatch.setattr(fits, "load_draft", lambda *_: None)

    def by(part: Callable[[Path], bool], **then: Any) -> None:
        fit = SimpleNamespace(refine_ahead=lambda known, steps, train: train(part), **then)
        monkeypatch.setattr(fits, "fitting", lambda *_, **__: fit)

    return by


def test_the_last_filter_goes_on_from_what_is_made_ahead_and_leaves_whoever_still_makes_it_alone(
    context: WorkerContext, participant: Participant, answered: Callable[[int], None], refining: Callable[..., None]
) -> None:
    theirs = context.store.unfinished.folder(participant.id)
    found: dict[str, Any] = {}

    def refine(draft: object, known: object, steps: int, begun: Path, train: object) -> None:
        (first,) = [each for each in theirs.glob("ahead-*") if each != begun]
        found["asked to pause"] = (first / PAUSE_FILE).exists()
        found["left off at"] = (Checkpoint(first).read_counts() or {})["steps"]
        found.update(Checkpoint(begun).read_counts() or {})

    answered(15)
    job, run_id = begin(context, participant, RunKind.REFINEMENT)
    refining(go_half_way)
    refinement.refine_ahead(context, job, run_id, at_once)
    (ahead,) = theirs.glob("ahead-*")
    ask_to_pause(ahead)  # with the last answer; the training has not looked yet
    answered(5)
    _, run_id = begin(context, participant, RunKind.FILTER)
    refining(go_on, refine=refine)
    job = filter_at(context, participant, 20)
    refinement.refine(context, run_id, job, context.store.put(b"reward"), "", shared=False)
    assert found == {"asked to pause": True, "left off at": WHOLE // 2, "begun_at": WHOLE // 2, "steps": WHOLE}


@pytest.mark.parametrize(
    ("evidence", "learned", "refined"),
    [(None, "", True), (1.9, "", True), (2.1, "", False), (2.1, "phases", True), (30.0, "arrival", True)],
)
def test_nobody_is_refined_by_a_model_that_something_richer_explains_the_answers_twice_as_well_as(
    context: WorkerContext,
    participant: Participant,
    answered: Callable[[int], None],
    refining: Callable[..., None],
    monkeypatch: pytest.MonkeyPatch,
    evidence: float | None,
    learned: str,
    refined: bool,
) -> None:
    answered(20)
    (context.store.unfinished.folder(participant.id) / "ahead-of-before").mkdir(parents=True)
    found = {} if evidence is None else {"evidence": evidence, "explanation": learned or "arrival"}
    save_model(context, participant, ModelKind.REWARD, "all labels", {"misfit": found, "further": learned})
    _, run_id = begin(context, participant, RunKind.FILTER)
    refining(go_on, refine=lambda draft, *_: replace(draft, notes=("refined",)))
    monkeypatch.setattr(fits, "load_draft", lambda *_: FilterDraft(FilterWeights(mode={"speed_far": 0.2})))
    job = filter_at(context, participant, 20)
    (note,) = FilterDraft.from_bytes(
        context.store.read(refinement.refine(context, run_id, job, context.store.put(b"reward"), "", shared=False))
    ).notes
    assert (note == "refined") == refined
    assert refined or "when the robot arrives" in note
    assert list(context.store.unfinished.folder(participant.id).glob("ahead-*")) == []


def test_what_is_made_ahead_ends_when_the_last_filter_has_cleared_it_away(
    context: WorkerContext, participant: Participant, answered: Callable[[int], None], refining: Callable[..., None]
) -> None:
    answered(15)
    job, run_id = begin(context, participant, RunKind.REFINEMENT)
    refining(come_too_late)
    refinement.refine_ahead(context, job, run_id, at_once)


def test_what_was_to_be_made_ahead_leaves_no_folder_once_everything_is_answered(
    context: WorkerContext, participant: Participant, answered: Callable[[int], None], refining: Callable[..., None]
) -> None:
    theirs = context.store.unfinished.folder(participant.id)

    def last_answer_meanwhile(known: object, steps: int, train: Callable[[Callable[[Path], bool]], bool]) -> None:
        answered(5)
        for folder in theirs.glob("ahead-*"):  # as the last filter does when it is done
            context.store.unfinished.forget(folder)
        train(go_on)

    answered(15)
    job, run_id = begin(context, participant, RunKind.REFINEMENT)
    refining(go_on)
    fit = SimpleNamespace(refine_ahead=last_answer_meanwhile)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(fits, "fitting", lambda *_, **__: fit)
        refinement.refine_ahead(context, job, run_id, at_once)
    assert list(theirs.glob("ahead-*")) == []


def test_without_a_reward_model_the_run_says_why_there_is_no_filter(
    context: WorkerContext, participant: Participant
) -> None:
    job, run_id = begin(context, participant, RunKind.FILTER, "filter/participant-1/labels-10")
    with pytest.raises(NothingToLearnFrom, match="can't tell"):
        train_filter(context, job, run_id, at_once)


@pytest.mark.parametrize(
    ("hits", "said"), [([1.0] + [0.0] * 6, "foresaw 1 of 7"), ([], "foresaw none"), ([0.5] * 3, "foresaw 1.5 of 3")]
)
def test_the_card_of_a_filter_says_that_its_model_may_be_guessing(hits: list[float], said: str) -> None:
    (note,) = notes_on_foresight(accuracy.curve(hits))
    assert "not been shown to be better than guessing" in note
    assert said in note


def test_the_card_of_a_filter_says_that_its_model_does_not_fit_and_what_would() -> None:
    (note,) = notes_on_misfit(Misfit("arrival", 30.0))
    assert "does not fit this person" in note
    assert "explained better by when the robot arrives" in note
    (note,) = notes_on_misfit(Misfit("arrival", 3.0, is_learned=True))
    assert "terms for when the robot arrives" in note
    (note,) = notes_on_misfit(Misfit("changing", 3.0, is_learned=True))
    assert "weights that change from the first answer to the last" in note
    assert "over the last quarter of the answers" in note
    assert notes_on_misfit(Misfit("arrival", 3.0)) == []
    assert notes_on_misfit(None) == []


def test_a_model_that_foresees_answers_needs_no_note() -> None:
    assert notes_on_foresight(accuracy.curve([1.0] * 10)) == []


OWN = FilterDraft(FilterWeights(), notes=("mode and residual",))
ARCHIVED = FilterDraft(FilterWeights(), notes=("archived",))


@pytest.mark.parametrize(("evidence", "made"), [(1.9, "archived"), (2.1, "not refined")], ids=["the usual", "doubted"])
@pytest.mark.parametrize(("stage", "answers"), [("archived", 20), ("quick", 10)])
def test_a_filter_is_compared_with_archived_policies_where_the_answers_are_understood(
    context: WorkerContext,
    participant: Participant,
    answered: Callable[[int], None],
    refining: Callable[..., None],
    monkeypatch: pytest.MonkeyPatch,
    stage: str,
    answers: int,
    evidence: float,
    made: str,
) -> None:
    answered(answers)
    misfit = {"misfit": {"evidence": evidence, "explanation": "arrival"}, "further": ""}
    save_model(context, participant, ModelKind.REWARD, "all labels", misfit)
    refining(
        go_on,
        choose_archived=lambda own, pool: ARCHIVED,
        find_quickly=lambda pool, archived: ARCHIVED if archived else OWN,
        task="feeding",
    )
    monkeypatch.setattr(fits, "load_draft", lambda *_: OWN)
    _, run_id = begin(context, participant, RunKind.FILTER)
    job = filter_at(context, participant, answers)
    draft = fit_stage(context, run_id, job, context.store.put(b"reward"), "of mode and residual", stage)
    assert made in FilterDraft.from_bytes(context.store.read(draft)).notes[-1]
