"""What an experimenter pastes into a paper and a preregistration: every number there is, and what is missing."""

import re
from collections.abc import Callable
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select
from sqlalchemy.orm import Session

from app.db import Database, now
from app.domain.choices import Method
from app.domain.designs import Arm, Ending
from app.domain.models import ModelKind, Report
from app.domain.participation import FormAnswer
from app.domain.power_plan import PowerInputs
from app.domain.preferences import LabelEvent, Query
from app.domain.protocol import EvaluatedMethod, EvaluationSettings
from app.domain.studies import Participant, Study
from app.domain.study_settings import PAPER_PROTOCOL, StudySettings
from app.installed_tasks import catalogue
from app.services.answers import exclusions
from app.services.participants import withdrawal
from app.services.studies import locking, power, studies
from app.storage import ArtefactStore
from tests import factories
from tests.finished_study import make_finished_study
from worker.analysis.study.report import make_report
from worker.compute import simulation
from worker.jobs.publishing import report_files

Finished = Callable[..., Study]
OSF_QUESTIONS = (
    "Title",
    "Authors",
    "Description",
    "Hypotheses",
    "Study type",
    "Blinding",
    "Is there any additional blinding in this study?",
    "Study design",
    "Randomization",
    "Existing data",
    "Explanation of existing data",
    "Data collection procedures",
    "Sample size",
    "Sample size rationale",
    "Stopping rule",
    "Manipulated variables",
    "Measured variables",
    "Indices",
    "Statistical models",
    "Transformations",
    "Inference criteria",
    "Data exclusion",
    "Missing data",
    "Exploratory analysis",
    "Other",
)
"""Of the form “OSF Preregistration”, doi.org/10.31222/osf.io/epgjd."""


@pytest.fixture
def finished(database: Database, store: ArtefactStore, monkeypatch: pytest.MonkeyPatch) -> Finished:
    """Makes a finished study with the report that the worker would make, without pictures."""
    monkeypatch.setattr("worker.analysis.study.figures.all_figures", lambda _contents: {})

    def make(*, unblinded: bool = True, lock: bool = True) -> Study:
        with database.writing() as session:
            study = make_finished_study(session, store, 6, labels=12, unblinded=unblinded)
            for person in _people(session)[:4]:
                person.completed_at = now()
            _people(session)[4].ended_as = Ending.INATTENTIVE
            factories.make_participant(session, study, ready=False)
            if lock:
                locking.lock(session, study, study.slug, "Ada")
                study.locked_at = now() - timedelta(days=1)
        report(study)
        return study

    def report(study: Study) -> None:
        with database.writing() as session:
            contents, _ = make_report(report_files.tables_of(session, session.get_one(Study, study.id)))
            run = factories.make_run(session, study, kind="report")
            session.add(Report(study_id=study.id, run_id=run.id, basis="", contents=contents, figures={}))

    return make


def _people(session: Session) -> list[Participant]:
    return list(session.scalars(select(Participant).order_by(Participant.number)))


def text_of(browser: TestClient, study: Study, path: str = "results/methods_and_results.md") -> str:
    answer = browser.get(f"/studies/{study.slug}/{path}")
    assert answer.status_code == 200
    assert "attachment" in answer.headers["content-disposition"]
    return answer.text


def test_who_came_and_who_stayed_is_counted(
    experimenter: TestClient, finished: Finished, database: Database, store: ArtefactStore
) -> None:
    study = finished()
    with database.writing() as session:
        withdrawal.withdraw(session, store, _people(session)[0], "P01")
        _people(session)[1].scripted_as = "cautious"
    said = text_of(experimenter, study)
    assert "7 people were invited or joined; 5 gave informed consent" in said
    assert "1 was sent back because of too many missed catch pairs, 1 had not finished" in said
    assert "and 3 completed the study. 1 of those invited had not consented." in said
    assert "1 person withdrew and had all their data erased" in said
    assert "1 of the participants was played by a program" in said


def test_who_was_screened_out_is_in_no_demographics_and_what_was_asked_at_the_end_is_told(
    experimenter: TestClient, finished: Finished, database: Database
) -> None:
    study = finished()
    with database.writing() as session:
        session.get_one(Study, study.id).stored_settings = study.stored_settings | {
            "demographics": [{"name": "age", "kind": "number"}],
            "questionnaire": [{"name": "felt_safe", "kind": "likert"}],
        }
        for person, points in zip(_people(session), "43", strict=False):
            session.add(FormAnswer(participant_id=person.id, form="questionnaire", item="felt_safe", value=points))
        _people(session)[5].ended_as = Ending.SCREENED_OUT
    said = text_of(experimenter, study)
    assert "of 5 people who did not withdraw and were not screened out: age: mean 23" in said, "26 is screened out"
    assert "felt safe: mean 3.50, SD 0.71, range 3 to 4 (n = 2)" in said
    assert "consent on 2" in said, "one day is not between two"


def test_analyses_are_told_as_they_are_made(experimenter: TestClient, database: Database) -> None:
    with database.writing() as session:
        evaluation = EvaluationSettings(ask_which_is_theirs=True, ask_reasons=True, instruments=("sus", "nasa_tlx"))
        study = factories.make_study(
            session, languages=("en",), evaluation=evaluation, planned_tests=("paired_t", "equivalence")
        )
        arms = ({"name": "own", "methods": ("pbarl",)}, {"name": "usual", "methods": ("reference",)})
        apart = EvaluationSettings(methods=("reference", "pbarl"), instruments=("nasa_tlx",))
        between = factories.make_study(session, "Between", languages=("en",), arms=arms, evaluation=apart)
        locking.lock(session, study, study.slug, "Ada")
    said, planned = text_of(experimenter, study), text_of(experimenter, study, "preregistration.md")
    assert "Planned tests: Paired t; Equivalence, two one-sided paired t. Every other" in said
    assert "at a level of 5 %" in said
    assert "from all ratings, a linear mixed model" in said
    assert "exact two-sided binomial test" in said
    for text in (said, planned):
        assert "reason" in text
    assert "both one-sided p values below .05" in planned
    assert "learn_a_lot (reversed), stretched to 0 to 100." in planned, "items of 1 to 5 have no such mean"
    assert "Effort, 0 to 100: effort." in planned
    assert "Between arms scores are compared by Welch's t" in text_of(experimenter, between)
    assert "Tests between arms leave out" in text_of(experimenter, between, "preregistration.md")


def test_every_number_of_the_report_is_in_the_text(
    experimenter: TestClient, finished: Finished, database: Database
) -> None:
    said = text_of(experimenter, finished())
    with database.reading() as session:
        contents = session.scalars(select(Report)).one().contents
    for scale in contents["ratings"]["scales"].values():
        for comparison in scale["comparisons"]:
            paired = comparison["paired_t"]
            statistic, d_z = (f"{paired[name]:.2f}".replace("-", "\N{MINUS SIGN}") for name in ("statistic", "d_z"))
            assert f"t({paired['degrees_of_freedom']}) = {statistic}" in said
            assert f"d_z = {d_z} [" in said
            link = comparison["cumulative_link"]
            assert f"{link.get('odds_ratio', 0):.2f} [" in said or link["not_computable"] in said
            ends = (
                f"{comparison['equivalence'][end]:.2f}".replace("-", "\N{MINUS SIGN}") for end in ("low_90", "high_90")
            )
            assert f"90 % interval [{', '.join(ends)}], bounds ±0.5" in said
    for each in contents["head_to_heads"].get("strengths", []):
        assert f"{each['strength']:.2f}".replace("-", "\N{MINUS SIGN}") in said
    for score in contents["instruments"][0]["parts"][1]["scores"]:
        assert all(f"{each['alpha']:.2f}".replace("-", "\N{MINUS SIGN}") in said for each in score["reliability"])
    assert f"right in {100 * contents['answers']['pooled']['mean_accuracy']:.1f} %" in said
    assert "Planned tests: Paired t. Every other test is exploratory." in said
    assert "age, as typed" in said or "age: mean" in said
    for broken in ("None", "nan", "{", "}"):
        assert broken not in said, broken


def test_what_the_studio_cannot_know_is_marked_and_never_invented(experimenter: TestClient, finished: Finished) -> None:
    said = text_of(experimenter, finished())
    assert "Ethics approval: **not recorded in the studio; add it**." in said
    assert "Attention was not measured: no catch pair was answered." in said


def test_exclusions_and_deviations_are_listed_with_their_reasons(
    experimenter: TestClient, finished: Finished, database: Database, store: ArtefactStore
) -> None:
    study = finished()
    with database.writing() as session:
        there = session.get_one(Study, study.id)
        query = session.scalars(select(Query).join(LabelEvent).order_by(Query.id)).first()
        assert query is not None
        exclusions.exclude(session, there, query.id, "phone *rang*", "Ada")
        settings = there.settings.model_copy(update={"break_every": 10})
        locking.change(
            session,
            store,
            there,
            name=there.name,
            task=there.task,
            seed=None,
            settings=settings,
            actor="Ada",
            reason="People were tired.",
        )
    said = text_of(experimenter, study)
    assert "excluded 1 answer to pairs" in said
    assert "phone \\*rang\\*: 1" in said
    assert "changed break every. Reason: People were tired." in said
    assert f"`{study.lock_hash}`" in said


def test_a_blinded_study_gives_its_methods_alone(experimenter: TestClient, finished: Finished) -> None:
    said = text_of(experimenter, finished(unblinded=False))
    assert "# Methods" in said
    assert "# Results" not in said
    assert "unblinded, which has not happened yet" in said


def test_a_study_of_the_papers_protocol_has_a_text_before_anybody_came(
    experimenter: TestClient, database: Database
) -> None:
    with database.writing() as session:
        study = studies.create_study(session, "The paper's", PAPER_PROTOCOL, seed=1)
    said = text_of(experimenter, study)
    assert "0 people were invited" in said
    assert "the first 10 of them on whole trajectories" in said
    assert "pre-trained policy" in said
    assert "Results" not in said.replace("The results", "")


@pytest.mark.parametrize(
    ("share", "material", "times"),
    [
        (0.0, None, 0),
        (0.25, None, 1),
        pytest.param(0.25, {"signals": []}, 0, id="imported clips, which are all there is"),
    ],
)
@pytest.mark.parametrize("path", ["results/methods_and_results.md", "preregistration.md"])
def test_pairs_that_follow_the_person_are_told_where_there_are_any(
    experimenter: TestClient, database: Database, share: float, material: dict[str, Any] | None, times: int, path: str
) -> None:
    with database.writing() as session:
        settings = PAPER_PROTOCOL.model_copy(update={"following_share": share})
        study = studies.create_study(session, "Following", settings, seed=1)
        study.material = material
    said = text_of(experimenter, study, path)
    assert said.count("From the tenth answer on 25 %") == times


def test_whom_the_newest_model_expected_is_told(
    experimenter: TestClient, finished: Finished, database: Database
) -> None:
    study = finished()
    assert ", starting from nothing." in text_of(experimenter, study), "models of before say nothing of populations"
    with database.writing() as session:
        shares = {"nobody known": 0.2, "scripted people": 0.7, "earlier participants": 0.1}
        metrics = factories.reward_metrics() | {"population_shares": shares}
        factories.make_model(session, session.get_one(Study, study.id), _people(session)[0], ModelKind.REWARD, metrics)
    assert ", starting from scripted people and earlier participants (or from nothing" in text_of(experimenter, study)


@pytest.mark.parametrize("asks", [True, False])
@pytest.mark.parametrize("path", ["results/methods_and_results.md", "preregistration.md"])
def test_hints_are_told_where_they_are_asked_for(
    experimenter: TestClient, database: Database, asks: bool, path: str
) -> None:
    with database.writing() as session:
        settings = StudySettings(asks_for_hints=asks)
        study = studies.create_study(session, "Hints", settings, seed=1)
    assert text_of(experimenter, study, path).count("up to 2 hints") == asks


@pytest.mark.parametrize("steps", [0, 60_000])
@pytest.mark.parametrize("path", ["results/methods_and_results.md", "preregistration.md"])
def test_a_refinement_is_told_as_it_is_made(
    experimenter: TestClient, database: Database, steps: int, path: str
) -> None:
    with database.writing() as session:
        settings = PAPER_PROTOCOL.model_copy(update={"refinement_steps": steps})
        study = studies.create_study(session, "Refined", settings, seed=1)
    said = text_of(experimenter, study, path)
    assert said.count("refined by soft actor-critic for 60,000 environment steps") == (steps > 0)
    if path.startswith("results"):
        assert ("steps, 90 % of them on the preference learned from the first 50 answers" in said) == (steps > 0)


@pytest.mark.parametrize(
    ("task", "method", "is_told"),
    [("feeding", Method.STUDIO, True), ("scratching", Method.STUDIO, True), ("feeding", Method.PRINTED, False)],
)
@pytest.mark.parametrize("path", ["results/methods_and_results.md", "preregistration.md"])
def test_policies_that_were_refined_beforehand_are_told_of_where_filters_may_be_one_of_them(
    experimenter: TestClient, database: Database, task: str, method: Method, is_told: bool, path: str
) -> None:
    with database.writing() as session:
        settings = PAPER_PROTOCOL.model_copy(update={"method": method})
        study = studies.create_study(session, "Archived", settings, seed=1, task=task)
    said = text_of(experimenter, study, path)
    policies = [str(len(simulation.archived_policies(task)))] if is_told else []
    assert re.findall(r"A filter is one of (\d+) policies that had been refined", said) == policies


@pytest.mark.parametrize(
    ("method", "milestones", "is_told"),
    [(Method.STUDIO, (50,), True), (Method.STUDIO, (), False), (Method.PRINTED, (50,), False)],
)
def test_how_filters_of_fewer_answers_were_found_is_told_where_there_were_any(
    experimenter: TestClient, database: Database, method: Method, milestones: tuple[int, ...], is_told: bool
) -> None:
    with database.writing() as session:
        settings = PAPER_PROTOCOL.model_copy(update={"method": method, "filter_milestones": milestones})
        study = studies.create_study(session, "On the way", settings, seed=1)
    said = text_of(experimenter, study, "results/methods_and_results.md")
    assert ("For the filters of fewer than all answers no residual was learned" in said) == is_told


@pytest.mark.parametrize("path", ["results/methods_and_results.md", "preregistration.md"])
def test_a_task_without_such_policies_is_not_told_of_any(
    experimenter: TestClient, database: Database, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, path: str
) -> None:
    with database.writing() as session:
        study = studies.create_study(session, "None archived", PAPER_PROTOCOL, seed=1)
    installed = catalogue.find("feeding")
    assert installed
    without = replace(installed, folder=tmp_path)
    monkeypatch.setattr(catalogue, "find", lambda _: without)
    assert "had been refined by soft actor-critic beforehand" not in text_of(experimenter, study, path)


def test_a_preregistration_answers_every_question_of_osf(
    experimenter: TestClient, database: Database, store: ArtefactStore
) -> None:
    with database.writing() as session:
        study = factories.make_study(
            session,
            arms=(Arm(name="own", methods=(EvaluatedMethod.PBARL,)), Arm(name="usual", methods=("reference",))),
            arm_quota=12,
            catch_pairs=4,
            end_after_misses=3,
            instruments=("tia",),
            evaluation=EvaluationSettings(methods=("reference", "pbarl"), head_to_heads=0),
            planned_tests=("welch_t",),
        )
        plan = power.ask(session, study, PowerInputs(), "Ada")
        plan.contents = {"studies": 400, "enough": {"ratings": 30, "head_to_heads": None}}
        locking.lock(session, study, study.slug, "Ada")
    said = text_of(experimenter, study, "preregistration.md")
    asked = re.findall(r"^### (.*)\n\n(.+)", said, re.MULTILINE)
    assert tuple(question for question, _ in asked) == OSF_QUESTIONS
    answers = dict(asked)
    assert answers["Existing data"] == "Registration prior to creation of data."
    assert answers["Sample size"] == "12 completions in each of 2 arms."
    assert "80 % for ratings is reached from 30 people on" in answers["Sample size rationale"]
    assert "misses 3 catch pairs is sent back" in answers["Stopping rule"]
    assert "Hypotheses" in answers
    assert "To be written by you" in answers["Hypotheses"]
    assert "* own: PbARL\n* usual: pre-trained policy" in said
    assert "* Welch t, between people" in said
    assert f"`{study.lock_hash}`" in said


def test_what_was_locked_is_preregistered_and_not_what_was_changed_since(
    experimenter: TestClient, database: Database, store: ArtefactStore
) -> None:
    with database.writing() as session:
        study = factories.make_study(session, repeated_pairs=2)
        locking.lock(session, study, study.slug, "Ada")
        settings = study.settings.model_copy(update={"repeated_pairs": 7})
        study.stored_settings = settings.model_dump(mode="json")
    assert "2 asked again" in text_of(experimenter, study, "preregistration.md")
