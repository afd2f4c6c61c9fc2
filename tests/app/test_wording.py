"""What participants read: in two complete languages, and in a study's own words."""

import logging
import re
from pathlib import Path

import pytest
from fastapi.testclient import TestClient
from fluent.syntax import ast

from app.domain.protocol import Language
from app.domain.study_settings import StudySettings
from app.installed_tasks import catalogue
from app.paths import ROOT, WORDING
from app.web.texts import wording
from app.web.texts.wording import Wording, built_in_texts, variables_of, wording_for

TEMPLATES = sorted(
    [*(ROOT / "templates" / "participant").rglob("*.html"), ROOT / "templates" / "pieces" / "player.html"]
)
NAMES_FOR_CODE = r"{% block (page|page_data|body_class|sheet_class|stage_class|width) %}.*?{% endblock %}"
DATA = r"data-[\w-]+(=\"[^\"]*\")?"
SAID = re.compile(r"""say\(\s*["']([a-zA-Z0-9_-]+)["']\s*[,)]""")


def test_every_language_has_the_same_messages_with_the_same_variables() -> None:
    english, *others = (
        {key: variables_of(message) for key, message in built_in_texts(language).items()} for language in Language
    )
    for other in others:
        assert other == english


@pytest.mark.parametrize("language", Language)
def test_no_message_is_broken_or_there_twice(language: Language) -> None:
    text = (WORDING / f"{language}.ftl").read_text(encoding="utf-8")
    body = wording._resource(language).body
    assert [entry for entry in body if isinstance(entry, ast.Junk)] == []
    keys = re.findall(r"^([a-zA-Z][a-zA-Z0-9_-]*) =", text, re.MULTILINE)
    assert len(keys) == len(set(keys)) == len(built_in_texts(language)) - len(catalogue.names())


@pytest.mark.parametrize("template", TEMPLATES, ids=lambda path: path.name)
def test_pages_ask_for_messages_that_exist(template: Path) -> None:
    known = built_in_texts(Language.ENGLISH)
    assert [key for key in SAID.findall(template.read_text(encoding="utf-8")) if key not in known] == []


@pytest.mark.parametrize("template", TEMPLATES, ids=lambda path: path.name)
def test_no_page_has_words_of_its_own(template: Path) -> None:
    text = template.read_text(encoding="utf-8")
    for no_words in (NAMES_FOR_CODE, r"{#.*?#}|{%.*?%}|{{.*?}}", r"<(svg|kbd).*?</\1>", DATA):
        text = re.sub(no_words, "", text, flags=re.DOTALL)
    spoken = re.findall(r"(?:aria-label|title|placeholder|alt)=\"([^\"]*)\"", text)
    assert re.findall(r"[A-Za-z]{2,}", " ".join([re.sub(r"<[^>]*>", " ", text), *spoken])) == []


def test_the_study_speaks_first_and_in_every_language_until_it_says_otherwise() -> None:
    settings = StudySettings(wording={"consent-title": "Our study", "finished-title": "Ta", "de:finished-title": "Na"})
    assert wording_for(settings)("consent-title") == "Our study"
    assert wording_for(settings, "de")("consent-title") == "Our study"
    assert wording_for(settings, "de")("finished-title") == "Na"
    assert wording_for(settings)("finished-title") == "Ta"
    assert wording_for(settings, "de")("back") == "Zurück"


@pytest.mark.parametrize(
    "broken", ["", "{ $nobody } knows this", "a { brace", "a } brace", "{ -no-such-term }", "x\n.attribute = y {"]
)
def test_a_broken_text_gives_way_to_the_built_in_one_and_is_in_the_log(
    broken: str, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.WARNING, logger="app.wording")
    words = Wording(Language.ENGLISH, {"foot-code": broken})
    assert words("foot-code", code="P07") == "You are P07"
    assert words("foot-code", code="P07") == "You are P07"
    assert len(caplog.records) == 1
    assert "foot-code" in caplog.text


def test_the_form_for_texts_learns_what_is_wrong_with_them() -> None:
    own = {"foot-code": "{ $person }", "de:back": "Retour", "no-such-text": "x", "fr:back": "Retour", "back": "{"}
    assert set(wording.broken_texts(own)) == {"foot-code", "no-such-text", "fr:back", "back"}


@pytest.mark.parametrize("text", ["[sic] two\n* three", "one\n\n.four\n}five", "plain & <b>simple</b>"])
def test_a_study_may_begin_its_lines_with_any_letter(text: str) -> None:
    assert Wording(Language.ENGLISH, {"back": text})("back") == text


def test_numbers_are_written_as_the_language_writes_them() -> None:
    own = {"back": "{ $count }"}
    assert Wording(Language.ENGLISH, own)("back", count=1000) == "1,000"
    assert Wording(Language.GERMAN, own)("back", count=1000) == "1.000"


@pytest.mark.parametrize(
    ("address", "headers", "said"),
    [
        ("/p/next", {"Accept-Language": "de"}, "Bitte öffnen Sie Ihren Link noch einmal"),
        ("/p/" + "x" * 43, {"Accept-Language": "de-AT"}, "Dieser Link ist nicht gültig"),
        ("/p/nowhere", {"Cookie": "studio_language=de"}, "Seite nicht gefunden"),
        ("/join/" + "x" * 30, {"Accept-Language": "de"}, "zurzeit keine Teilnahme an einer Studie möglich"),
        ("/p/next", {}, "Please open your link again"),
        ("/studies/none", {"Accept-Language": "de", "Accept": "application/json"}, "log in"),
    ],
)
def test_what_went_wrong_is_said_to_participants_in_their_language(
    client: TestClient, address: str, headers: dict[str, str], said: str
) -> None:
    assert said in client.get(address, headers=headers).text
