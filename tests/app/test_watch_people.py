"""What the experimenter is told about people: where they are, their pace, what deserves a look, what is liked."""

from datetime import timedelta

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import true

from app.db import Database, now
from app.domain.clips import Clip, Rollout
from app.domain.models import ModelKind, RunKind, RunStatus
from app.domain.participation import StageRecord
from app.domain.preferences import Purpose, Response
from app.domain.protocol import Stage
from app.domain.studies import Participant, Study
from app.services.monitoring import dashboard, participant_status
from app.storage import ArtefactStore
from tests import factories


@pytest.fixture
def study(database: Database) -> Study:
    with database.writing() as session:
        return factories.make_study(
            session, "Pilot", labels_per_participant=20, pool_scenarios=6, evaluation={}, repeated_pairs=4, debrief=True
        )


@pytest.fixture
def participant(study: Study, database: Database) -> Participant:
    with database.writing() as session:
        return factories.make_participant(session, study)[0]


def overview(database: Database, study: Study) -> dashboard.StudyOverview:
    with database.reading() as session:
        return dashboard.study_overview(session, study)


class TestWherePeopleAre:
    """In words, from what has been done."""

    @pytest.mark.parametrize(
        ("stage", "words"),
        [(Stage.EVALUATION, "rating robots"), (Stage.DEBRIEF, "debrief"), (Stage.PAIRS, "comparing")],
    )
    def test_the_stage_that_was_entered_last_is_where_somebody_is(
        self, study: Study, participant: Participant, database: Database, stage: Stage, words: str
    ) -> None:
        with database.writing() as session:
            session.add(StageRecord(participant_id=participant.id, stage=Stage.CONSENT, finished_at=now()))
            session.add(StageRecord(participant_id=participant.id, stage=stage))
        assert overview(database, study).stage_counts == [(words, 1)]

    def test_all_labels_given_is_not_finished_while_the_evaluation_is_to_come(
        self, study: Study, participant: Participant, database: Database, store: ArtefactStore
    ) -> None:
        with database.writing() as session:
            for query in factories.make_queries(session, store, participant, 20):
                factories.make_label(session, query)
        assert overview(database, study).stage_counts == [("comparing", 1)]

    @pytest.mark.parametrize(("column", "words"), [("completed_at", "finished"), ("withdrawn_at", "withdrawn")])
    def test_who_is_through_or_gone_is_counted_apart(
        self, study: Study, participant: Participant, database: Database, column: str, words: str
    ) -> None:
        with database.writing() as session:
            setattr(session.get_one(Participant, participant.id), column, now())
            factories.make_participant(session, study, ready=False)
        assert overview(database, study).stage_counts == [("invited", 1), (words, 1)]


def test_the_pace_leaves_breaks_out(participant: Participant, database: Database, store: ArtefactStore) -> None:
    with database.writing() as session:
        moments = [3600, 3590, 3580, 3570, 60, 50]
        for query, ago_s in zip(factories.make_queries(session, store, participant, 6), moments, strict=True):
            factories.make_label(session, query, ago=timedelta(seconds=ago_s))
    with database.reading() as session:
        pace_s = participant_status.judged(
            participant_status.answers_given(session, [participant.id])[participant.id], None
        ).pace_s
    assert pace_s == pytest.approx(10.0, abs=0.5)


def test_flags_and_the_noise_ceiling_stand_beside_the_accuracy(
    experimenter: TestClient, participant: Participant, database: Database, store: ArtefactStore
) -> None:
    """Somebody who always says left, and says it again when asked again."""
    with database.writing() as session:
        queries = factories.make_queries(session, store, participant, 20)
        for query in queries:
            query.predicted_right = 0.2
            factories.make_label(session, query, Response.LEFT, response_time_ms=5000)
        for query in queries[:5]:
            left, right = (session.get_one(Clip, each) for each in (query.left_clip_id, query.right_clip_id))
            again = factories.make_query(session, participant, left, right)
            again.purpose, again.repeats_query_id = Purpose.REPEAT, query.id
            factories.make_label(session, again, Response.LEFT, response_time_ms=5000)
    page = experimenter.get("/studies/pilot").text
    assert "prefers a side" in page
    assert "same answer in a row" in page
    assert "of at most&nbsp;100" in page
    detail = experimenter.get("/studies/pilot/participants/P01").text
    assert "Prefers one side of the screen" in detail
    assert "of 5 pairs asked twice" in detail


def test_a_useless_model_is_a_flag_and_what_rests_on_it_is_grey(
    experimenter: TestClient, participant: Participant, study: Study, database: Database, store: ArtefactStore
) -> None:
    """One of seven foreseen, one of two obvious pairs missed, and a filter that the model thinks well of."""
    with database.writing() as session:
        for number, query in enumerate(factories.make_queries(session, store, participant, 9)):
            query.predicted_right = 0.9 if number else 0.1
            if number > 6:
                query.purpose, query.expected = Purpose.CATCH, Response.LEFT if number == 7 else Response.RIGHT
            factories.make_label(session, query, Response.LEFT)
        factories.make_model(session, study, participant, ModelKind.REWARD, factories.reward_metrics())
        factories.make_model(session, study, participant, ModelKind.FILTER, factories.filter_metrics())
    page = experimenter.get("/studies/pilot").text
    assert "model may be guessing" in page
    assert "misses obvious pairs" in page
    assert "verdict-unproven" in page
    assert "verdict-better" not in page
    detail = experimenter.get("/studies/pilot/participants/P01").text
    assert detail.count("not been shown to be better than guessing (1 of 7 preferences predicted correctly)") == 2
    assert 'class="card stack unproven"' in detail


def test_what_rests_on_a_model_that_foresees_answers_is_not_grey(
    experimenter: TestClient, participant: Participant, study: Study, database: Database, store: ArtefactStore
) -> None:
    with database.writing() as session:
        for query in factories.make_queries(session, store, participant, 10):
            query.predicted_right = 0.1
            factories.make_label(session, query, Response.LEFT)
        factories.make_model(session, study, participant, ModelKind.FILTER, factories.filter_metrics())
    assert "verdict-better" in experimenter.get("/studies/pilot").text
    assert "guessing (" not in experimenter.get("/studies/pilot/participants/P01").text


def test_answers_to_pairs_a_model_chose_do_not_count_for_the_accuracy(
    study: Study, participant: Participant, database: Database, store: ArtefactStore
) -> None:
    with database.writing() as session:
        for number, query in enumerate(factories.make_queries(session, store, participant, 12)):
            query.strategy = "uniform" if number < 6 else "entropy"
            query.predicted_right = 0.1 if number < 6 else 0.9
            factories.make_label(session, query, Response.LEFT)
    (row,) = overview(database, study).rows
    assert row.curve.overall is not None
    assert (row.curve.overall.correct, row.curve.overall.scored) == (6, 6)


def test_the_clips_the_model_likes_best_and_least_are_shown(
    experimenter: TestClient, study: Study, participant: Participant, database: Database, store: ArtefactStore
) -> None:
    with database.writing() as session:
        clips = [factories.make_clip(session, store, study) for _ in range(8)]
        rollouts = [session.get_one(Rollout, clip.rollout_id) for clip in clips]
        ranking = [[rollout.scenario, rollout.behaviour, 2.0 - place] for place, rollout in enumerate(rollouts)]
        metrics = factories.reward_metrics() | {"ranking": ranking}
        factories.make_model(session, study, participant, ModelKind.REWARD, metrics)
    page = experimenter.get("/studies/pilot/participants/P01").text
    liked, _, least = page.partition("Liked least")
    assert [clip.video_sha256 in liked for clip in clips] == [True] * 3 + [False] * 5
    assert [clip.video_sha256 in least for clip in clips] == [False] * 5 + [True] * 3


@pytest.mark.parametrize(("advisor", "shown"), [("show", True), ("log", False)])
def test_the_advice_is_shown_only_where_the_study_wants_it(
    experimenter: TestClient, database: Database, advisor: str, shown: bool
) -> None:
    with database.writing() as session:
        study = factories.make_study(session, "Advised", advisor=advisor)
        person, _ = factories.make_participant(session, study)
        for labels in (10, 20, 30):
            metrics = {"advice": {"relative_regret": 0.05}}
            factories.make_model(session, study, person, ModelKind.REWARD, metrics, labels=labels)
    assert ("enough answers" in experimenter.get("/studies/advised").text) is shown
    assert ("more answers could gain" in experimenter.get("/studies/advised/participants/P01").text) is shown


@pytest.mark.parametrize(
    ("explanation", "further", "said"),
    [
        ("arrival", "arrival", "the model has terms for it"),
        ("changing", "changing", "the model follows the last answers"),
        ("arrival", "", "the model has no terms for it"),
    ],
)
def test_the_experimenter_reads_what_the_model_makes_of_what_explains_more(
    experimenter: TestClient,
    study: Study,
    participant: Participant,
    database: Database,
    explanation: str,
    further: str,
    said: str,
) -> None:
    found = {"misfit": {"evidence": 25.0, "explanation": explanation}, "further": further}
    with database.writing() as session:
        metrics = factories.reward_metrics() | found
        factories.make_model(session, study, participant, ModelKind.REWARD, metrics, labels=70)
    assert said in experimenter.get("/studies/pilot/participants/P01").text


@pytest.mark.parametrize(("evidence", "flagged"), [([25.0], True), ([19.0], False), ([25.0, 3.0], False)])
def test_a_model_that_does_not_fit_is_a_flag_until_a_newer_one_does(
    experimenter: TestClient,
    study: Study,
    participant: Participant,
    database: Database,
    evidence: list[float],
    flagged: bool,
) -> None:
    with database.writing() as session:
        for labels, each in enumerate(evidence, 10):
            metrics = factories.reward_metrics() | {"misfit": {"evidence": each, "explanation": "arrival"}}
            factories.make_model(session, study, participant, ModelKind.REWARD, metrics, labels=labels)
    assert ('class="flag">beyond weighted signals' in experimenter.get("/studies/pilot").text) is flagged
    assert ("when the robot arrives" in experimenter.get("/studies/pilot/participants/P01").text) is flagged


@pytest.mark.parametrize(
    ("evidence", "said"), [(783.3, "783 times as probable"), (3.8e9, "over 1000 times as probable")]
)
def test_evidence_that_a_model_does_not_fit_is_a_number_that_can_be_read(
    experimenter: TestClient, study: Study, participant: Participant, database: Database, evidence: float, said: str
) -> None:
    with database.writing() as session:
        metrics = factories.reward_metrics() | {"misfit": {"evidence": evidence, "explanation": "poses"}}
        factories.make_model(session, study, participant, ModelKind.REWARD, metrics)
    assert said in experimenter.get("/studies/pilot/participants/P01").text


def test_what_was_learned_is_said_in_words_about_the_six_costs_whatever_the_model(
    experimenter: TestClient, study: Study, participant: Participant, database: Database
) -> None:
    weights = {
        "C_v": {"mean": -0.6, "low": -0.8, "high": -0.4},
        "C_hf": {"mean": 0.3, "low": 0.1, "high": 0.5},
        "C_d": {"mean": 0.1, "low": -0.2, "high": 0.4},
    }
    with database.writing() as session:
        factories.make_model(
            session, study, participant, ModelKind.REWARD, {"costs": {"weights": weights, "explained": 0.5}}
        )
    page = " ".join(experimenter.get("/studies/pilot/participants/P01").text.split())
    assert "Dislikes speed of the spoon. Likes high force at the mouth. About the rest" in page
    assert "account for 50 %" in page


def test_what_was_learned_is_a_sentence_with_units_as_they_are_written(
    experimenter: TestClient, study: Study, participant: Participant, database: Database
) -> None:
    with database.writing() as session:
        factories.make_model(session, study, participant, ModelKind.REWARD, factories.reward_metrics())
    page = experimenter.get("/studies/pilot/participants/P01").text
    assert "Dislikes spoon speed squared (m²/s²) and force at the mouth (N). Likes speed" in page


def test_answers_to_either_side_are_counted_beside_the_pace(
    experimenter: TestClient, participant: Participant, database: Database, store: ArtefactStore
) -> None:
    with database.writing() as session:
        said = [Response.LEFT, Response.LEFT, Response.RIGHT, Response.SKIP]
        for query, response in zip(factories.make_queries(session, store, participant, 4), said, strict=True):
            factories.make_label(session, query, response)
    assert "2 left, 1 right, 1 can\N{RIGHT SINGLE QUOTATION MARK}t tell" in experimenter.get("/studies/pilot").text


def test_every_job_that_failed_or_is_at_work_is_listed_with_its_error_and_a_button(
    experimenter: TestClient, study: Study, participant: Participant, database: Database
) -> None:
    failed = {"status": RunStatus.FAILED, "error": "The disk was full."}
    with database.writing() as session:
        for method, columns in (("prefft", failed), ("pbarl", {})):
            run = factories.make_run(session, study, participant, kind=RunKind.METHOD, **columns)
            run.workflow_id = f"method/participant-1/{method}/labels-10"
        factories.make_run(session, study, kind=RunKind.REPORT, status=RunStatus.FAILED, error="A bad day.")
        factories.make_run(session, study, kind=RunKind.REPORT)
        factories.make_run(session, study, kind=RunKind.CLIPS, status=RunStatus.RUNNING, stage="clip 3")
    jobs = overview(database, study).jobs
    assert [(job.run.kind, job.code) for job in jobs] == [("method", "P01"), ("clips", None)]
    page = experimenter.get("/studies/pilot").text.partition('id="jobs-title"')[2]
    assert "The disk was full." in page
    assert f"/studies/pilot/runs/{jobs[0].run.id}/retry" in page
    assert "A bad day." not in page
    assert "1 failed job<" in experimenter.get("/studies").text


def test_finished_on_the_list_of_studies_are_those_who_are_through_with_everything(
    study: Study, participant: Participant, database: Database, store: ArtefactStore
) -> None:
    def finished() -> int:
        with database.reading() as session:
            return dashboard.study_lines(session, true())[0].finished

    with database.writing() as session:
        for query in factories.make_queries(session, store, participant, 20):
            factories.make_label(session, query)
    assert finished() == 0, "the evaluation is still to come"
    with database.writing() as session:
        session.get_one(Participant, participant.id).completed_at = now()
    assert finished() == 1


def test_somebody_erased_keeps_a_row_and_nothing_to_press(
    experimenter: TestClient, participant: Participant, database: Database
) -> None:
    experimenter.post("/studies/pilot/participants/P01/erase", data={"typed": "P01"})
    page = experimenter.get("/studies/pilot").text
    assert "erased" in page
    assert experimenter.get("/studies/pilot/participants/P01").status_code == 200


def test_answers_by_the_plain_form_are_a_flag_that_leads_to_them(
    experimenter: TestClient, participant: Participant, database: Database, store: ArtefactStore
) -> None:
    with database.writing() as session:
        for query, by_script in zip(factories.make_queries(session, store, participant, 2), (True, False), strict=True):
            factories.make_label(session, query, by_script=by_script)
    page = experimenter.get("/studies/pilot/participants/P01").text
    assert "how the clips were watched, and whether to the end, is not known" in page
    assert "of 2 answers" in page
    assert "without the page\N{RIGHT SINGLE QUOTATION MARK}s script</span>" in experimenter.get("/studies/pilot").text
    marked = experimenter.get("/studies/pilot/answers?participant=P01&mark=without_script").text
    assert "<strong>1</strong> answer" in marked
