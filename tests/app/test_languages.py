"""In which language somebody reads: what they chose, else what their browser asks for; on every page, to the end."""

from collections.abc import Callable
from typing import Any

import pytest
from fastapi.testclient import TestClient

from app.db import Database
from app.domain.protocol import Language
from app.domain.study_settings import StudySettings
from app.services.participants import recruitment_panel
from app.web.texts.wording import preferred, wording_for
from tests import factories
from tests.app.conftest import TakingPart, agree

GERMAN = {"Accept-Language": "de-AT,de;q=0.9,en;q=0.5"}


@pytest.fixture
def invite(database: Database) -> Callable[..., str]:
    """Makes a study with these settings; gives the path of its first participant's link."""

    def make(**settings: Any) -> str:
        with database.writing() as session:
            study = factories.make_study(session, **settings)
            _, token = factories.make_participant(session, study, ready=False)
        return f"/p/{token}"

    return make


def language_of(page: str) -> str:
    return page.split('<html lang="')[1].split('"')[0]


def test_the_browsers_language_is_spoken_from_the_first_page_on(invite: Callable[..., str], client: TestClient) -> None:
    client.get(invite(), headers=GERMAN)
    assert language_of(client.get("/p/consent").text) == "de"


def test_a_program_that_looks_at_links_does_not_choose_the_language(
    invite: Callable[..., str], new_browser: Callable[[], TestClient]
) -> None:
    link = invite()
    scanner, reader = new_browser(), new_browser()
    scanner.headers["Accept-Language"] = "en"
    assert scanner.get(scanner.get(link).headers["location"]).status_code < 400
    reader.get(link, headers=GERMAN)
    assert language_of(reader.get("/p/consent", headers=GERMAN).text) == "de"


def test_the_language_of_consent_holds_on_another_device_whatever_that_asks_for(
    invite: Callable[..., str], new_browser: Callable[[], TestClient]
) -> None:
    link = invite()
    first, other = new_browser(), new_browser()
    first.headers.update(GERMAN)
    first.get(link)
    agree(first)
    other.headers["Accept-Language"] = "en"
    other.get(link)
    assert language_of(other.get("/p/withdraw").text) == "de"


def test_who_began_before_languages_were_kept_goes_on_in_the_studys(
    database: Database, new_browser: Callable[[], TestClient]
) -> None:
    with database.writing() as session:
        study = factories.make_study(session, language="de")
        _, token = factories.make_participant(session, study)
    browser = new_browser()
    browser.get(f"/p/{token}", headers={"Accept-Language": "en"})
    assert language_of(browser.get("/p/withdraw").text) == "de"


def test_a_language_the_study_does_not_offer_is_neither_spoken_nor_to_be_chosen(
    invite: Callable[..., str], client: TestClient
) -> None:
    client.get(invite(languages=("en",)), headers=GERMAN)
    page = client.get("/p/consent").text
    assert language_of(page) == "en"
    assert "Deutsch" not in page
    client.post("/p/language", data={"language": "de"})
    for address in ("/p/consent", "/p/nowhere"):
        assert language_of(client.get(address, headers={"Accept": "text/html"}).text) == "en"


def test_the_studys_own_language_is_always_offered() -> None:
    settings = StudySettings(language=Language.GERMAN, languages=(Language.ENGLISH,))
    assert settings.offered_languages == (Language.GERMAN, Language.ENGLISH)
    assert wording_for(settings)("back") == "Zurück"


def test_changing_the_language_comes_back_to_the_same_page(taking_part: TakingPart) -> None:
    page = taking_part.browser.get("/p/withdraw").text
    assert 'name="here" value="/p/withdraw"' in page
    answer = taking_part.browser.post("/p/language", data={"language": "de", "here": "/p/withdraw"})
    assert answer.headers["location"] == "/p/withdraw"
    assert language_of(taking_part.browser.get("/p/withdraw").text) == "de"


def test_the_speeds_of_a_pair_are_said_as_the_language_writes_numbers(taking_part: TakingPart) -> None:
    assert 'aria-label="0.25 times normal speed"' in taking_part.browser.get("/p/next").text
    taking_part.browser.post("/p/language", data={"language": "de"})
    page = taking_part.browser.get("/p/next").text
    assert 'aria-label="0,25-faches Tempo"' in page
    assert 'aria-label="1-faches Tempo"' in page


@pytest.mark.parametrize("elsewhere", ["https://evil.example/p/", "//evil.example", "/studies", "/p/\r\nx: y", ""])
def test_changing_the_language_leads_to_pages_of_participants_only(taking_part: TakingPart, elsewhere: str) -> None:
    answer = taking_part.browser.post("/p/language", data={"language": "de", "here": elsewhere})
    assert answer.headers["location"] == "/p/next"


def test_the_page_after_withdrawing_keeps_the_language_and_can_change_it(taking_part: TakingPart) -> None:
    browser = taking_part.browser
    browser.post("/p/language", data={"language": "de"})
    browser.headers["Accept-Language"] = "en"
    browser.get(browser.post("/p/withdraw").headers["location"])
    assert "Ihre Daten sind gelöscht" in browser.get("/p/withdrawn").text
    assert "Ihre Daten sind gelöscht" in browser.get(browser.get(f"/p/{taking_part.token}").headers["location"]).text
    browser.post("/p/language", data={"language": "en", "here": "/p/withdrawn"})
    assert language_of(browser.get("/p/withdrawn").text) == "en"


@pytest.mark.parametrize("address", ["/p/next", "/p/nowhere", "/p/" + "x" * 43, "/join/" + "x" * 30, "/p/withdrawn"])
def test_who_is_unknown_can_change_the_language_of_every_page(client: TestClient, address: str) -> None:
    assert "Deutsch" in client.get(address, headers={"Accept": "text/html"}).text
    answer = client.post("/p/language", data={"language": "de", "here": address})
    assert answer.headers["location"] == address
    assert language_of(client.get(address, headers={"Accept": "text/html"}).text) == "de"


def test_what_was_chosen_before_joining_holds_after_it(database: Database, client: TestClient) -> None:
    with database.writing() as session:
        study = factories.make_study(session)
        token = recruitment_panel.open_joining(session, study, "someone")
    address = f"/join/{token}"
    page = client.get(address, headers=GERMAN).text  # without the panel's parameter
    assert language_of(page) == "de"
    client.post("/p/language", data={"language": "en", "here": address})
    client.get(f"{address}?PROLIFIC_PID=abc", headers=GERMAN)
    assert language_of(client.get("/p/consent", headers=GERMAN).text) == "en"


@pytest.mark.parametrize(
    ("asked", "given"),
    [
        ("de-AT,de;q=0.9,en;q=0.8", "de"),
        ("en;q=0.3,de;q=0.7", "de"),
        ("fr,en;q=0.5", "en"),
        ("de;q=0, en", "en"),
        ("fr-FR, de-CH ;q=0.4", "de"),
        ("*", "en"),
        ("den, deutsch", "en"),
        (";;;q=de,", "en"),
        ("", "en"),
    ],
)
def test_a_browser_is_given_what_it_wants_most(asked: str, given: str) -> None:
    assert preferred(asked) == given
