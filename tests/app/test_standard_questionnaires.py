"""Standard questionnaires: scored as published, filled in on pages, every answer kept once and exported."""

from collections.abc import Callable, Mapping
from typing import Any
from uuid import uuid4

import pytest
from fastapi.testclient import TestClient
from pydantic import ValidationError
from sqlalchemy import select

from app.db import Database, now
from app.domain.participation import FormAnswer
from app.domain.protocol import EvaluatedMethod, EvaluationSettings, FormItem, Language
from app.domain.studies import Participant, Study
from app.domain.study_settings import StudySettings
from app.questionnaires import library
from app.questionnaires.library import Instrument
from app.services.exports import codebook, export_formats, export_tables
from app.storage import ArtefactStore
from tests import factories
from tests.app.conftest import JSON
from tests.finished_study import make_finished_study
from worker.analysis.study.scales import scale_reports
from worker.jobs.publishing import report_files

ENGLISH = (Language.ENGLISH,)
ON_PURPOSE = {"on_purpose": "yes"}
BROOKE = (5, 4, 2, 1, 2, 3, 2, 4, 5, 2)
"""The filled-in form of Brooke (1996): its contributions 4, 1, 1, 4, 1, 2, 1, 1, 4, 3 make 22, and a score of 55."""


def scores(name: str, answers: Mapping[str, float | None]) -> dict[str, float | None]:
    known = library.every()[name]
    return {score.name: known.score(score, answers) for score in known.scores}


def answered(name: str, values: tuple[int, ...]) -> dict[str, float | None]:
    items = library.every()[name].items
    return {item.name: float(value) for item, value in zip(items, values, strict=True)}


# --- scoring keys ----------------------------------------------------------------------------------------------------


def test_the_sus_of_brookes_example_is_55() -> None:
    assert scores("sus", answered("sus", BROOKE)) == {"usability": pytest.approx(55.0)}


def test_the_extremes_of_the_sus_are_0_and_100() -> None:
    assert scores("sus", answered("sus", (5, 1) * 5))["usability"] == 100
    assert scores("sus", answered("sus", (1, 5) * 5))["usability"] == 0


def test_a_sus_item_that_is_left_out_counts_as_the_centre() -> None:
    left_out = answered("sus", BROOKE) | {"use_frequently": None}
    assert scores("sus", left_out)["usability"] == pytest.approx(50.0), "a contribution of 2 instead of 4"
    assert scores("sus", dict.fromkeys(left_out))["usability"] is None


def test_the_raw_tlx_is_the_mean_of_six_scales_and_none_may_be_left_out() -> None:
    answers = answered("nasa_tlx", (30, 15, 60, 40, 30, 40))
    assert scores("nasa_tlx", answers)["workload"] == pytest.approx(215 / 6)
    assert scores("nasa_tlx", answers)["performance"] == 40, "not reversed: the form runs from perfect to failure"
    short = scores("nasa_tlx", answers | {"effort": None})
    assert (short["workload"], short["effort"], short["performance"]) == (None, None, 40)


def test_trust_in_automation_mirrors_its_five_inverse_items() -> None:
    inverse = [item.name for item in library.every()["tia"].items if item.reversed]
    assert inverse == ["item_05", "item_07", "item_10", "item_15", "item_16"]
    answers: dict[str, float | None] = {f"item_{number:02}": 5.0 for number in range(1, 20)}
    found = scores("tia", answers)
    assert found["understanding_predictability"] == 3, "5 and 5, and twice 5 recoded to 1, as the manual says"
    assert found["reliability_competence"] == pytest.approx((4 * 5 + 2 * 1) / 6)
    assert found["propensity_to_trust"] == pytest.approx((1 + 5 + 5) / 3)
    assert found["trust_in_automation"] == found["familiarity"] == found["intention_of_developers"] == 5


def test_rosas_has_three_subscales_of_six_and_its_short_form_is_part_of_it() -> None:
    long, short = library.every()["rosas"], library.every()["rosas_sf"]
    assert [len(score.items) for score in long.scores] == [6, 6, 6]
    for score, shortened in zip(long.scores, short.scores, strict=True):
        assert (score.name, set(shortened.items) < set(score.items)) == (shortened.name, True)
    answers = {item.name: 9.0 if item.name in long.scores[0].items else 2.0 for item in long.items}
    assert scores("rosas", answers) == {"warmth": 9, "competence": 2, "discomfort": 2}


@pytest.mark.parametrize("known", library.every().values(), ids=lambda known: known.name)
def test_every_instrument_says_its_source_and_licence_and_scores_stay_in_their_range(known: Instrument) -> None:
    assert all((known.citation, known.licence, known.wording, known.missing_because, known.measures))
    assert {name for score in known.scores for name in score.items} == {item.name for item in known.items}
    for score in known.scores:
        extremes = [
            {item.name: known.answers.highest if item.reversed == low else known.answers.lowest for item in known.items}
            for low in (True, False)
        ]
        assert tuple(known.score(score, each) for each in extremes) == known.range_of(score)


def test_words_that_may_not_be_shipped_are_not() -> None:
    assert not any(library.every()["jian"].published("en").values())


# --- what a study may choose -----------------------------------------------------------------------------------------


def test_a_language_without_published_words_is_refused_with_what_to_do() -> None:
    with pytest.raises(ValidationError, match=r"in Deutsch.*leave Deutsch out.*Missing: de:scale-sus-instruction,"):
        StudySettings(instruments=("sus",))
    assert StudySettings(instruments=("sus",), languages=ENGLISH).instruments == ("sus",)
    assert StudySettings(instruments=("tia",)).instruments == ("tia",)


def test_a_study_gives_its_own_words_where_none_are_published() -> None:
    words = {library.text_name("jian", part): "x" for part in library.every()["jian"].published("en")}
    settings = StudySettings(instruments=("jian",), languages=ENGLISH, wording=words)
    assert settings.missing_words("jian", Language.ENGLISH) == ()
    del words["scale-jian-item-07"]
    with pytest.raises(ValidationError, match=r"in English.*Missing: scale-jian-item-07\."):
        StudySettings(instruments=("jian",), languages=ENGLISH, wording=words)


@pytest.mark.parametrize(("names", "complaint"), [(("mood",), "no standard questionnaire"), (("tia", "tia"), "once")])
def test_only_instruments_that_exist_and_each_once(names: tuple[str, ...], complaint: str) -> None:
    with pytest.raises(ValidationError, match=complaint):
        StudySettings(instruments=names)
    with pytest.raises(ValidationError, match=complaint):
        EvaluationSettings(instruments=names)


# --- filling in ------------------------------------------------------------------------------------------------------


class Person:
    """Somebody who has answered all pairs."""

    def __init__(self, browser: TestClient, participant: Participant, study: Study, database: Database) -> None:
        self.browser, self.participant, self.study, self.database = browser, participant, study, database
        self.trials: list[int] = []

    def where(self) -> str:
        return str(self.browser.get("/p/next").headers.get("location", "/p/next"))

    def stored(self) -> list[tuple[str, str | None, str, str | None]]:
        with self.database.reading() as session:
            rows = session.scalars(select(FormAnswer).order_by(FormAnswer.id))
            return [(row.form, row.letter, row.item, row.value) for row in rows]


Begin = Callable[..., Person]


@pytest.fixture
def begin(database: Database, store: ArtefactStore, new_browser: Callable[[], TestClient]) -> Begin:
    def start(**settings: Any) -> Person:
        with database.writing() as session:
            study = factories.make_study(session, **settings)
            participant, token = factories.make_participant(session, study)
            factories.answer_everything(session, store, study, participant)
            robots = factories.make_robots(session, store, study, participant) if study.settings.evaluation else []
            trials = [trial.id for trial in robots]
        browser = new_browser()
        browser.get(f"/p/{token}")
        person = Person(browser, participant, study, database)
        person.trials = trials
        return person

    return start


def test_pages_follow_one_another_and_the_stage_ends_with_the_last(begin: Begin) -> None:
    person = begin(
        instruments=("sus", "tia"), languages=ENGLISH, questionnaire=(FormItem(name="comments", kind="text"),)
    )
    browser = person.browser
    assert person.where() == "/p/questionnaire"
    assert browser.get("/p/questionnaire").headers["location"] == "/p/questionnaire/sus"
    given = {item.name: str(value) for item, value in zip(library.every()["sus"].items, BROOKE, strict=True)}
    assert browser.post("/p/questionnaire/sus", data=given).headers["location"] == "/p/questionnaire/tia"
    assert browser.get("/p/questionnaire").headers["location"] == "/p/questionnaire/tia", (
        "one comes back to where one was"
    )
    assert (
        browser.post("/p/questionnaire/tia", data={"item_09": "4", **ON_PURPOSE}).headers["location"]
        == "/p/questionnaire"
    )
    assert browser.post("/p/questionnaire", data={"comments": "fine"}).headers["location"] == "/p/next"
    assert person.where() == "/p/finished"
    rows = person.stored()
    assert {item: value for form, _, item, value in rows if form == "sus"} == given
    assert [value for form, _, item, value in rows if form == "tia" and value] == ["4"]
    assert len(rows) == len(set(rows)) == 10 + 19 + 1, "what was left out is known to have been left out"


def test_sending_again_changes_only_what_was_changed(begin: Begin) -> None:
    person = begin(instruments=("nasa_tlx",), languages=ENGLISH)
    person.browser.post("/p/questionnaire/nasa_tlx", data={"effort": "35", "frustration": "5"})
    person.browser.post("/p/questionnaire/nasa_tlx", data={"effort": "35", "frustration": "10"})
    stored = [(item, value) for _, _, item, value in person.stored() if value is not None]
    assert stored == [("effort", "35"), ("frustration", "5"), ("frustration", "10")]


def test_who_leaves_something_out_is_asked_once_more_and_nothing_is_lost_meanwhile(begin: Begin) -> None:
    person = begin(instruments=("nasa_tlx",), languages=ENGLISH)
    sent = {item.name: "50" for item in library.every()["nasa_tlx"].items} | {"effort": ""}
    again = person.browser.post("/p/questionnaire/nasa_tlx", data=sent).headers["location"]
    assert again == "/p/questionnaire/nasa_tlx?on_purpose"
    assert sum(value == "50" for _, _, _, value in person.stored()) == 5
    page = person.browser.get(again).text
    assert "One answer is missing." in page
    assert page.count("checked") >= 5
    assert person.browser.post("/p/questionnaire/nasa_tlx", data=sent | ON_PURPOSE).headers["location"] == "/p/next"
    assert person.where() == "/p/finished"


def test_an_answer_that_is_no_point_is_refused_and_nothing_is_kept(begin: Begin) -> None:
    person = begin(instruments=("nasa_tlx",), languages=ENGLISH)
    answer = person.browser.post("/p/questionnaire/nasa_tlx", data={"effort": "33", "frustration": "5"})
    assert (answer.status_code, person.stored()) == (422, [])
    assert 'href="#effort"' in answer.text
    assert person.browser.get("/p/questionnaire/sus").headers["location"] == "/p/next"


def test_german_pages_show_the_german_wording(begin: Begin) -> None:
    person = begin(instruments=("tia",), language=Language.GERMAN)
    page = person.browser.get("/p/questionnaire/tia").text
    assert "Ich kann mich auf das System verlassen." in page
    assert "Stimme weder zu noch nicht zu" in page
    assert "I can rely" not in page


def test_own_words_stand_in_for_what_is_not_published(begin: Begin) -> None:
    words = {
        f"de:{library.text_name('rosas_sf', part)}": f"<{part}>" for part in library.every()["rosas_sf"].published("de")
    }
    person = begin(instruments=("rosas_sf",), wording=words)
    assert "Compassionate" in person.browser.get("/p/questionnaire/rosas_sf").text
    person.browser.post("/p/language", data={"language": "de", "here": "/p/questionnaire/rosas_sf"})
    assert (
        "&lt;compassionate&gt;"
        in person.browser.get("/p/questionnaire/rosas_sf", headers={"accept-language": "de"}).text
    )


def test_every_robot_is_described_after_its_trials_and_before_the_next(begin: Begin) -> None:
    methods = (EvaluatedMethod.REFERENCE, EvaluatedMethod.PBARL)
    settings = EvaluationSettings(methods=methods, trials=1, instruments=("rosas_sf",))
    person = begin(evaluation=settings, languages=ENGLISH)
    browser = person.browser
    for letter, trial in zip("AB", person.trials, strict=True):
        path = f"/p/evaluation/robots/{letter}/rosas_sf"
        assert browser.get(path).headers["location"] == "/p/next", "not before it has been rated"
        browser.get("/p/evaluation")
        rating = {"satisfaction": 4, "personalisation": 2, "client_uuid": str(uuid4())}
        rated = browser.post(f"/p/evaluation/trials/{trial}/rating", data=rating, headers=JSON).json()
        assert rated["next_path"] == path
        assert browser.get("/p/evaluation").headers["location"] == path
        assert f"Robot {letter}" in browser.get(path).text
        browser.post(path, data={"scary": "2" if letter == "A" else "7", **ON_PURPOSE})
    assert [(letter, value) for _, letter, item, value in person.stored() if item == "scary"] == [
        ("A", "2"),
        ("B", "7"),
    ]
    assert person.where() == "/p/finished"


# --- what comes out --------------------------------------------------------------------------------------------------


def rows_of(table: str, database: Database, study: Study) -> list[dict[str, Any]]:
    with database.reading() as session:
        found = session.get_one(Study, study.id)
        provenance = export_formats.provenance_of(session, found)
        return list(export_formats.records(export_tables.BY_NAME[table], session, found, provenance))


def test_items_are_exported_as_given_and_scores_by_the_key(begin: Begin) -> None:
    person = begin(instruments=("sus", "tia"), languages=ENGLISH)
    given = {item.name: str(value) for item, value in zip(library.every()["sus"].items, BROOKE, strict=True)}
    person.browser.post("/p/questionnaire/sus", data=given | {"complex": "1"})
    person.browser.post("/p/questionnaire/sus", data=given)
    person.browser.post("/p/questionnaire/tia", data={"item_03": "5", "item_17": "2", "item_09": "4"})
    items = [row for row in rows_of("forms", person.database, person.study) if row["form"] == "sus"]
    assert [(row["value"], row["superseded"]) for row in items if row["item"] == "complex"] == [
        ("1", True),
        ("4", False),
    ]
    found = {(row["instrument"], row["score"]): row for row in rows_of("scores", person.database, person.study)}
    assert found["sus", "usability"]["value"] == pytest.approx(55)
    assert (found["sus", "usability"]["lowest"], found["sus", "usability"]["highest"]) == (0, 100)
    assert found["tia", "familiarity"]["value"] == 3.5
    trust = found["tia", "trust_in_automation"]
    assert (trust["value"], trust["items"], trust["answered"]) == (None, 2, 1)


def test_a_method_stands_beside_a_robots_scores_only_after_unblinding(database: Database, store: ArtefactStore) -> None:
    with database.writing() as session:
        study = make_finished_study(session, store, people=3, labels=4, unblinded=False)
    for table in ("forms", "scores"):
        about = [row for row in rows_of(table, database, study) if row["letter"]]
        assert about
        assert {row["method"] for row in about} == {None}
    with database.writing() as session:
        session.get_one(Study, study.id).unblinded_at = now()
    methods = {(row["letter"] is None, row["method"]) for row in rows_of("scores", database, study)}
    assert methods == {(True, None), (False, "reference"), (False, "prefft"), (False, "pbarl")}


@pytest.mark.parametrize("unblinded", [False, True])
def test_the_report_has_scores_per_robot_with_reliability(
    database: Database, store: ArtefactStore, unblinded: bool
) -> None:
    with database.writing() as session:
        study = make_finished_study(session, store, people=6, labels=4, unblinded=unblinded)
        tables = report_files.tables_of(session, study)
    (tia,) = scale_reports(tables.instruments, tables.groups, compare=not tables.blinded)
    at_the_end, about_robots = tia["parts"]
    trust = {score["name"]: score for score in about_robots["scores"]}["trust_in_automation"]
    assert (at_the_end["people"], trust["left_out"]) == (6, 3), "the second person left it out for each of three robots"
    assert about_robots["groups"] == (["reference", "prefft", "pbarl"] if unblinded else ["A", "B", "C"])
    assert len(trust["comparisons"]) == (3 if unblinded else 0)
    competence = about_robots["scores"][0]
    exported = [row for row in rows_of("scores", database, study) if row["score"] == competence["name"]]
    group = "method" if unblinded else "letter"
    for mean, agreement in zip(competence["means"], competence["reliability"], strict=True):
        values = [row["value"] for row in exported if row[group] == mean["group"]]
        assert mean["participant_mean"] == pytest.approx(sum(values) / 6)
        assert 0.5 < agreement["alpha"] < 1


def test_the_codebook_has_key_words_source_and_whose_translation_it_is() -> None:
    published = library.every()["sus"].published("de")
    words = {f"de:{library.text_name('sus', part)}": f"deutsch {part}" for part in published}
    settings = StudySettings(instruments=("sus", "tia"), wording=words)
    text = codebook.markdown(settings)
    assert "Brooke, J. (1996)" in text
    assert "CC BY-SA 4.0" in text
    assert "complex (reversed)" in text
    assert "In Deutsch some are this study's own" in text.split("## System Usability")[1].split("## Trust")[0]
    assert "this study's own" not in text.split("## Trust")[1]
    (sus, _) = codebook.entries(settings)
    assert sus["asked_as"]["de"]["easy"] == "deutsch easy"
