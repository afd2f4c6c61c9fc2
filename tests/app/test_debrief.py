"""The person's own robot before and after, what it learned, and honesty while it is still being made."""

import itertools
import re
from collections.abc import Iterable
from typing import Any

import pytest

from app.domain.models import Model, ModelKind
from app.domain.participation import StageRecord
from app.domain.preferences import Query
from app.domain.protocol import Language, Stage
from app.domain.studies import Participant, Study
from app.services.participants import debrief
from app.services.runs import model_metrics
from app.storage import ArtefactStore
from app.web.texts.wording import Wording
from tests import factories
from tests.app.conftest import TakingPart


@pytest.fixture
def at_debrief(taking_part: TakingPart) -> TakingPart:
    """The participant after the last pair, in a study with a debrief."""
    with taking_part.database.writing() as session:
        study = session.get_one(Study, taking_part.study.id)
        study.stored_settings = {**study.stored_settings, "debrief": True}
        for query in taking_part.queries[:10]:
            factories.make_label(session, session.get_one(Query, query.id))
    return taking_part


def add_filter(at: TakingPart, metrics: dict[str, Any]) -> Model:
    with at.database.writing() as session:
        return factories.make_model(session, at.study, at.participant, ModelKind.FILTER, metrics)


def test_while_nothing_is_there_it_says_so_and_holds_nobody_up(at_debrief: TakingPart) -> None:
    page = at_debrief.browser.get("/p/debrief").text
    assert "This is your robot" not in page
    assert "still being made" in page
    assert "<video" not in page
    assert at_debrief.browser.post("/p/debrief").headers["location"] == "/p/next"
    assert at_debrief.browser.get("/p/next").headers["location"] == "/p/finished"


def test_before_and_after_are_shown_side_by_side_in_one_scenario(at_debrief: TakingPart, store: ArtefactStore) -> None:
    model = add_filter(at_debrief, factories.filter_metrics())
    with at_debrief.database.writing() as session:
        before = factories.make_film(session, store, at_debrief.participant, "reference")
        elsewhere = factories.make_film(session, store, at_debrief.participant, "pbarl", model, scenario=99)
    assert "now it is being filmed" in at_debrief.browser.get("/p/debrief").text
    with at_debrief.database.writing() as session:
        after = factories.make_film(session, store, at_debrief.participant, "pbarl", model)
    page = at_debrief.browser.get("/p/debrief").text
    assert page.index(before.video_sha256) < page.index(after.video_sha256)
    assert elsewhere.video_sha256 not in page


def test_what_is_certain_is_said_in_plain_words_and_nothing_else(at_debrief: TakingPart) -> None:
    add_filter(at_debrief, factories.filter_metrics())
    page = at_debrief.browser.get("/p/debrief").text
    assert "It moves more slowly (by 41\N{NO-BREAK SPACE}%) and takes more time on its way to you." in page
    assert "it presses less hard (by 63\N{NO-BREAK SPACE}%)." in page
    assert "touches you" not in page, "its interval holds zero"


PACE = re.compile(r"quick|slow|sooner|more time|longer|moves|schnell|langsam|früher|Zeit|länger|bewegt")
MOUTH = re.compile(r"mouth|Mund")
ABOUT = (
    PACE,
    re.compile(r"where it should not|wo er es nicht soll"),
    re.compile(r"presses|drückt"),
    re.compile(r"spill|verschüttet"),
    MOUTH,
)
"""What a sentence can be about: the way to the person, touching on it, pressing at its end, spilling, the mouthful."""
SAYS = {
    "C_d": ("sooner|früher bei", "time on its way|longer|Zeit|länger"),
    "C_v": ("slowly|moves less|langsamer|weniger", "quickly|moves more|schneller|mehr"),
}
"""For the two costs that share sentences, how a decrease and an increase is said."""
LEAST = debrief.NOTICED_PERCENT / 100


def measured(sizes: Iterable[float]) -> list[model_metrics.Change]:
    """Changes of the six costs by these shares of what they were, all of them certain."""
    return [
        model_metrics.Change("", symbol, False, 2.0, 2.0 * (1 + size), 2.0 * size, 1.9 * size, 2.1 * size)
        for symbol, size in zip(model_metrics.COST_SYMBOLS, sizes, strict=True)
    ]


@pytest.mark.parametrize("language", Language)
def test_no_two_sentences_contradict_each_other_whatever_was_measured(language: Language) -> None:
    say = Wording(language)
    for sizes in itertools.product((-0.6, 0.03, 0.4, 3.0), repeat=len(model_metrics.COST_SYMBOLS)):
        lessons = debrief.lessons_of(measured(sizes))
        sentences = [say(f"debrief-{lesson.words}", percent=lesson.percent) for lesson in lessons]
        about_the_way = [each for each in sentences if PACE.search(each) and not MOUTH.search(each)]
        assert len(about_the_way) <= 1, about_the_way
        for topic in ABOUT[1:]:
            assert sum(bool(topic.search(each)) for each in sentences) <= 1, sentences
        noticed = {
            symbol: size for symbol, size in zip(model_metrics.COST_SYMBOLS, sizes, strict=True) if abs(size) >= LEAST
        }
        said = len(noticed) - ({"C_d", "C_v"} <= noticed.keys())
        assert len(sentences) == said, "every noticeable change is said, and nothing else"
        for symbol, (less, more) in SAYS.items():
            if symbol in noticed:
                assert re.search(more if noticed[symbol] > 0 else less, " ".join(about_the_way)), (symbol, sentences)


def test_a_change_too_small_to_be_noticed_is_not_spoken_of_however_certain() -> None:
    assert debrief.lessons_of(measured([-LEAST, LEAST - 0.01, 0, 0, 0, 0])) == [debrief.Lesson("C_d-less", 5)]


@pytest.mark.parametrize(
    ("before", "after", "sentence"),
    [
        (0.01, 0.27, "It spills a little more on you; before, it was next to nothing."),
        (0.6, 1.7, "It spills much more on you."),
    ],
)
def test_more_than_double_is_no_percentage_and_only_much_where_it_is(
    at_debrief: TakingPart, before: float, after: float, sentence: str
) -> None:
    metrics, delta = factories.filter_metrics(), after - before
    spilled = {"reference": before, "filter": after, "delta": delta, "low": 0.9 * delta, "high": 1.1 * delta}
    metrics["evaluation"]["costs"]["C_fd"] = spilled
    add_filter(at_debrief, metrics)
    page = at_debrief.browser.get("/p/debrief").text
    assert sentence in page
    assert f"{round(100 * delta / before):,}" not in page
    assert (page.index(sentence) > page.index("presses less hard")) == ("little" in sentence)


def test_a_robot_that_learned_nothing_certain_is_not_made_more_of(at_debrief: TakingPart) -> None:
    metrics = factories.filter_metrics()
    for cost in metrics["evaluation"]["costs"].values():
        cost |= {"low": -1.0, "high": 1.0}
    add_filter(at_debrief, metrics)
    assert "much like the robot before" in at_debrief.browser.get("/p/debrief").text


def test_a_robot_that_is_the_reference_is_called_that(at_debrief: TakingPart) -> None:
    add_filter(at_debrief, factories.filter_metrics() | {"uses_reference": True})
    page = at_debrief.browser.get("/p/debrief").text
    assert "your robot is the one that everybody starts with" in page
    assert "slowly" not in page


def test_metrics_that_cannot_be_read_are_no_lesson(at_debrief: TakingPart) -> None:
    model = add_filter(at_debrief, {"evaluation": "nonsense"})
    with at_debrief.database.reading() as session:
        assert debrief.learned(session, session.get_one(Participant, model.participant_id)) is None


def test_the_debrief_can_be_seen_again_after_the_end(at_debrief: TakingPart) -> None:
    at_debrief.browser.post("/p/debrief")
    assert 'href="/p/debrief"' in at_debrief.browser.get("/p/finished").text
    assert at_debrief.browser.get("/p/debrief").status_code == 200
    with at_debrief.database.reading() as session:
        stages = {record.stage for record in session.query(StageRecord)}
    assert Stage.DEBRIEF in stages
