"""The form of a study: presets, every setting, complaints beside their fields, changes before and after locking."""

import hashlib
import re
from collections.abc import Callable

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select

from app.db import Database
from app.domain.protocol import EvaluatedMethod, EvaluationMode, PlannedTest
from app.domain.studies import PREVIEW_NUMBERS, Deviation, Participant, Study
from app.domain.study_settings import PAPER_PROTOCOL, StudySettings
from app.services.studies import locking
from app.storage import ArtefactStore
from app.web.experimenter.study.study_form.form_lines import items_of, lines_of, lines_of_texts, texts_of
from app.web.experimenter.study.study_form.study_form import StudyForm
from tests import factories
from tests.app.study_pages import typed


def only_study(database: Database) -> Study:
    with database.reading() as session:
        return session.scalars(select(Study)).one()


def test_the_paper_s_protocol_is_one_click(experimenter: TestClient, database: Database) -> None:
    form = typed(experimenter, "/studies/new?preset=paper")
    assert experimenter.post("/studies/new", data=form).status_code == 303
    assert only_study(database).settings == PAPER_PROTOCOL


@pytest.mark.parametrize("wanted", [StudySettings(), PAPER_PROTOCOL])
def test_saving_the_settings_of_a_study_unchanged_changes_nothing(
    experimenter: TestClient, database: Database, wanted: StudySettings
) -> None:
    with database.writing() as session:
        factories.make_study(session, "Pilot", **wanted.model_dump())
    before = only_study(database)
    assert experimenter.post("/studies/pilot/settings", data=typed(experimenter, "/studies/pilot/settings")).status_code
    after = only_study(database)
    assert (after.settings, after.seed, after.name) == (before.settings, before.seed, before.name)


def test_every_new_setting_is_stored_as_typed(experimenter: TestClient, database: Database) -> None:
    form = typed(
        experimenter,
        language="de",
        demographics="age | number\nhand | choice | Which hand? | left; right",
        questionnaire="calm | likert | It was calm. | no | yes",
        wording="consent-title = Our study\nde:back = Retour",
        consent_text="Please read.\n\n- { $count } pairs",
        practice_pairs="2",
        introduction_pairs="10",
        repeated_pairs="20",
        catch_pairs="4",
        break_every="0",
        evaluation="yes",
        evaluation_methods=["reference", "pbarl"],
        evaluation_trials="5",
        evaluation_mode="physical",
        evaluation_fine_tuning_steps="2000",
        debrief="yes",
        completion_code="C0DE",
        return_url="https://panel.example/done?cc={code}",
        panel_parameter="PID",
        advisor="log",
        planned_tests=["wilcoxon", "mixed_model"],
        seed="42",
    )
    assert experimenter.post("/studies/new", data=form).status_code == 303
    study = only_study(database)
    settings = study.settings
    assert [item.name for item in settings.demographics] == ["age", "hand"]
    assert settings.demographics[1].choices == ("left", "right")
    assert (settings.questionnaire[0].low_label, settings.questionnaire[0].high_label) == ("no", "yes")
    assert settings.wording["consent-body"] == "Please read.\n\n- { $count } pairs"
    assert settings.wording["de:back"] == "Retour"
    assert settings.evaluation is not None
    assert settings.evaluation.methods == (EvaluatedMethod.REFERENCE, EvaluatedMethod.PBARL)
    assert (settings.evaluation.trials, settings.evaluation.mode) == (5, EvaluationMode.PHYSICAL)
    assert settings.planned_tests == (PlannedTest.WILCOXON, PlannedTest.MIXED_MODEL)
    assert (settings.repeated_pairs, settings.catch_pairs, settings.break_every) == (20, 4, 0)
    assert (settings.completion_code, settings.panel_parameter, settings.advisor) == ("C0DE", "PID", "log")
    assert study.seed == 42
    again = typed(experimenter, "/studies/pilot/settings")
    assert experimenter.post("/studies/pilot/settings", data=again).status_code == 303
    assert only_study(database).settings == settings


@pytest.mark.parametrize(
    ("field", "text", "complaint"),
    [
        ("demographics", "age | number\nshoe size | number", "Line 2: a name has small letters"),
        ("demographics", "age | numeral", "Line 1: after the name comes"),
        ("questionnaire", "hand | choice | Which?", "a choice needs its choices"),
        ("questionnaire", "a | text\na | text", "Line 2: the name a is taken"),
        ("wording", "no-such-text = Hello", "there is no text of this name"),
        ("wording", "back = { $code }", "cannot know code"),
        ("wording", "hello", "Line 1: write"),
        ("consent_text", "A brace { too many", "This text cannot be shown"),
        ("return_url", "panel.example", "begins with http"),
        ("panel_parameter", "my id", "letters, digits and underscores"),
        ("evaluation_trials", "0", "Enter at least 1."),
        ("evaluation_methods", "pbarl", "Choose two methods"),
        ("practice_pairs", "x", "Enter a whole number."),
        ("repeated_pairs", "1000", "Enter at most 100."),
        ("seed", "9999999999", "Enter a number below"),
    ],
)
def test_a_complaint_stands_beside_its_field_and_opens_its_group(
    experimenter: TestClient, database: Database, field: str, text: str, complaint: str
) -> None:
    form = typed(experimenter, evaluation="yes", **{field: text})
    answer = experimenter.post("/studies/new", data=form)
    assert answer.status_code == 422
    opened = "".join(re.findall(r"<details[^>]*open.*?</details>", answer.text, re.DOTALL))
    assert complaint in opened
    assert f'Please check <a href="#{field}">the marked field</a>' in answer.text
    assert answer.text.count(f'id="{field}"') == 1
    with database.reading() as session:
        assert session.scalars(select(Study)).all() == []


def test_several_questionnaires_are_ticked_and_kept(experimenter: TestClient, database: Database) -> None:
    page = experimenter.get("/studies/new").text
    assert re.findall(r'type="(\w+)" name="(?:evaluation_)?instruments" value="sus"', page) == ["checkbox"] * 2
    form = typed(
        experimenter,
        languages=["en"],
        instruments=["sus", "nasa_tlx"],
        evaluation="yes",
        evaluation_instruments=["rosas_sf"],
    )
    assert experimenter.post("/studies/new", data=form).status_code == 303
    settings = only_study(database).settings
    assert settings.instruments == ("sus", "nasa_tlx")
    assert settings.evaluation is not None
    assert settings.evaluation.instruments == ("rosas_sf",)


def test_a_complaint_about_methods_that_do_not_go_together_says_which_do(experimenter: TestClient) -> None:
    form = typed(experimenter, evaluation="yes", evaluation_ask_which_is_theirs="yes")
    answer = experimenter.post("/studies/new", data=form | {"evaluation_methods": ["pbarl", "prefft"]})
    assert answer.status_code == 422
    assert "choose PbARL, and beside it only" in answer.text
    assert "Choose two methods" not in answer.text


def test_a_page_that_is_not_there_leads_back_to_the_studies(experimenter: TestClient) -> None:
    answer = experimenter.get("/studies/nowhere")
    assert answer.status_code == 404
    assert 'href="/studies">All studies</a>' in answer.text


def test_the_first_of_several_wrong_fields_is_one_link_away(experimenter: TestClient) -> None:
    form = typed(experimenter, seed="x", task="cooking", practice_pairs="x")
    answer = experimenter.post("/studies/new", data=form).text
    assert 'Please check <a href="#task">the 3 marked fields</a>' in answer
    answer = experimenter.post("/studies/new", data=typed(experimenter, seed="x", practice_pairs="x")).text
    (first,) = re.findall(r'id="(\w+)"[^>]*autofocus', answer)
    assert first == "practice_pairs"


def test_the_fields_of_the_form_are_declared_in_the_order_of_the_page(experimenter: TestClient) -> None:
    shown = list(dict.fromkeys(re.findall(r' name="(\w+)"', experimenter.get("/studies/new").text)))
    elsewhere = {"reason", "preset", "switch_to", "like", "same_name"}  # shown at times, or no field of a setting
    typed_in = [each for each in StudyForm.model_fields if each not in elsewhere]
    assert typed_in == [each for each in shown if each in typed_in]


def test_questions_and_texts_are_read_back_as_they_were_written() -> None:
    questions = "age | number\nhand | choice | Which? | left; right\ncalm | likert | Calm? | no | yes"
    assert lines_of(items_of(questions)) == questions
    texts = {"consent-body": "One.\n\nTwo.\n- three", "de:back": "Retour"}
    assert texts_of(lines_of_texts(texts)) == texts


def test_the_names_of_all_texts_can_be_looked_up(experimenter: TestClient) -> None:
    page = experimenter.get("/studies/texts?language=de").text
    assert "consent-title" in page
    assert "Teilnahme" in page or "Teilnehmen" in page


class TestChangingSettings:
    """Free at first, bounded by what was used, with a reason once locked."""

    @pytest.fixture
    def study(self, database: Database) -> Study:
        with database.writing() as session:
            return factories.make_study(session, "Pilot")

    def test_what_clips_were_made_of_cannot_be_changed(
        self, experimenter: TestClient, study: Study, database: Database, store: ArtefactStore
    ) -> None:
        with database.writing() as session:
            factories.make_clip(session, store, study)
        assert "Fixed: clips have been made." in experimenter.get("/studies/pilot/settings").text
        form = typed(experimenter, "/studies/pilot/settings", task="drinking", seed="1", question="Which one?")
        assert experimenter.post("/studies/pilot/settings", data=form).status_code == 303
        changed = only_study(database)
        assert (changed.task, changed.seed, changed.settings.question) == ("feeding", study.seed, "Which one?")

    def test_the_number_of_pairs_is_fixed_once_somebody_was_given_some(
        self, experimenter: TestClient, study: Study, database: Database, store: ArtefactStore
    ) -> None:
        with database.writing() as session:
            participant, _ = factories.make_participant(session, study)
            factories.make_queries(session, store, participant, 1)
        form = typed(experimenter, "/studies/pilot/settings", labels_per_participant="12")
        experimenter.post("/studies/pilot/settings", data=form)
        assert only_study(database).settings.labels_per_participant == 10

    def test_a_locked_study_changes_with_a_reason_only_and_the_change_is_kept(
        self, experimenter: TestClient, study: Study, database: Database
    ) -> None:
        experimenter.post("/studies/pilot/lock", data={"typed": "pilot"})
        form = typed(experimenter, "/studies/pilot/settings", break_every="30")
        refused = experimenter.post("/studies/pilot/settings", data=form)
        assert refused.status_code == 422
        assert "Say why it has to change" in refused.text
        assert only_study(database).settings.break_every == 50
        locked = only_study(database).lock_hash
        answer = experimenter.post("/studies/pilot/settings", data=form | {"reason": ["People tire."]})
        assert answer.status_code == 303
        with database.reading() as session:
            deviation = session.scalars(select(Deviation)).one()
        assert (deviation.before, deviation.after) == ({"break_every": 50}, {"break_every": 30})
        assert (deviation.reason, deviation.actor) == ("People tire.", "experimenter")
        assert only_study(database).lock_hash == locked
        assert "People tire." in experimenter.get("/studies/pilot/lock").text

    def test_saving_a_locked_study_unchanged_is_no_deviation(
        self, experimenter: TestClient, study: Study, database: Database
    ) -> None:
        experimenter.post("/studies/pilot/lock", data={"typed": "pilot"})
        form = typed(experimenter, "/studies/pilot/settings")
        assert experimenter.post("/studies/pilot/settings", data=form).status_code == 303
        with database.reading() as session:
            assert session.scalars(select(Deviation)).all() == []


class TestLocking:
    """What was planned, as one document and its hash."""

    @pytest.fixture
    def study(self, database: Database) -> Study:
        with database.writing() as session:
            return factories.make_study(session, "Pilot")

    def test_the_hash_is_that_of_the_document_one_can_download(
        self, experimenter: TestClient, study: Study, database: Database
    ) -> None:
        assert experimenter.post("/studies/pilot/lock", data={"typed": "Pilot "}).status_code == 303
        contents = experimenter.get("/studies/pilot/lock.json").content
        locked = only_study(database)
        assert locked.lock_hash == hashlib.sha256(contents).hexdigest()
        assert locked.lock_document is not None
        assert locked.lock_document["plan_of_pairs"]["preference"] == 10
        assert locked.lock_hash in experimenter.get("/studies/pilot/lock").text
        assert locked.lock_hash[:12] in experimenter.get("/studies/pilot").text

    def test_the_document_holds_the_seeds_that_participants_get(self, study: Study, database: Database) -> None:
        with database.writing() as session:
            participant, _ = factories.make_participant(session, study)
        assert locking.document(study)["plan_of_pairs"]["participant_seeds"][0] == participant.seed

    def test_nothing_is_locked_without_its_name(
        self, experimenter: TestClient, study: Study, database: Database
    ) -> None:
        answer = experimenter.post("/studies/pilot/lock", data={"typed": "yes"})
        assert answer.status_code == 422
        assert only_study(database).lock_hash is None

    def test_locking_twice_is_refused(self, experimenter: TestClient, study: Study, database: Database) -> None:
        experimenter.post("/studies/pilot/lock", data={"typed": "pilot"})
        first = only_study(database).lock_hash
        assert experimenter.post("/studies/pilot/lock", data={"typed": "pilot"}).status_code == 409
        assert only_study(database).lock_hash == first


class TestPreview:
    """The study as a participant would see it."""

    @pytest.fixture
    def study(self, database: Database) -> Study:
        with database.writing() as session:
            return factories.make_study(session, "Pilot")

    def test_a_preview_is_a_participant_s_way_and_counts_nowhere(
        self, experimenter: TestClient, study: Study, database: Database
    ) -> None:
        assert experimenter.post("/studies/pilot/preview").headers["location"] == "/p/next"
        page = experimenter.get("/p/consent")
        assert page.status_code == 200
        assert "preview" in page.text.lower()
        with database.reading() as session:
            preview = session.scalars(select(Participant)).one()
        assert preview.is_preview
        assert preview.number > PREVIEW_NUMBERS
        assert preview.code not in experimenter.get("/studies/pilot").text
        assert preview.code not in experimenter.get("/studies/pilot/export/participants.csv").text

    def test_a_preview_takes_no_participant_s_number(
        self, experimenter: TestClient, study: Study, database: Database
    ) -> None:
        experimenter.post("/studies/pilot/preview")
        with database.writing() as session:
            participant, _ = factories.make_participant(session, study)
        assert participant.code == "P01"

    def test_a_preview_ends_when_its_pairs_would_not_fit_any_more(
        self, experimenter: TestClient, study: Study, database: Database, new_browser: Callable[[], TestClient]
    ) -> None:
        experimenter.post("/studies/pilot/preview")
        form = typed(experimenter, "/studies/pilot/settings", practice_pairs="1")
        experimenter.post("/studies/pilot/settings", data=form)
        with database.reading() as session:
            assert session.scalars(select(Participant)).one().withdrawn_at is not None
