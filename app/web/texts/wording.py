"""What the participant's pages say: one Fluent file per language, and a study's own words on top.

Texts are plain; templates escape them like everything else. ``app/wording/*.ftl`` hold the built-in ones; what is said
of a task, ``task-`` and its name, comes from the task's folder, in as many languages as it has.
"""

import logging
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cache, lru_cache
from typing import Any

from fluent.runtime import FluentBundle, FluentResource
from fluent.syntax import FluentSerializer, ast
from jinja2 import pass_context
from jinja2.runtime import Context

from app.domain.protocol import CONSENT_FACTS, Language
from app.domain.study_settings import StudySettings
from app.installed_tasks import catalogue
from app.installed_tasks.lab import LabDescription
from app.paths import WORDING

log = logging.getLogger("app.wording")

_ASKED = re.compile(r"(?:^|,)\s*([a-z]{2,8})(?:-[a-z0-9-]*)?\s*(?:;\s*q\s*=\s*(\d(?:\.\d{0,3})?))?")
"""One language of an Accept-Language header, without its region, and how much it is wanted."""


class WordingBroken(ValueError):
    """A text is not valid Fluent, or asks for something that its page does not know."""


class Wording:
    """The texts of one language, as one study wants them. Call it with the name of a message and its variables.

    ``own``: the study's words by message, in Fluent. ``consent-title`` holds for the study's language and, because
    what a study says itself goes before what we would say, for every language it has no own words for;
    ``de:consent-title`` holds for German alone.
    """

    def __init__(
        self, language: Language, own: Mapping[str, str] | None = None, study_language: Language | None = None
    ) -> None:
        self.language = language
        self._own = _own_words(language, own or {}, study_language or language)
        self._warned: set[str] = set()

    def __call__(self, key: str, /, **variables: Any) -> str:
        """The text. Raises LookupError for a message that does not exist: a mistake in a page, not in a study."""
        if key in self._own:
            try:
                return _formatted(_compiled(self._own[key], self.language), "text", variables)
            except WordingBroken as error:
                self._warn(key, error)
        return _formatted(_built_in(self.language), key, variables)

    def __contains__(self, key: str) -> bool:
        """Whether there is such a message, built-in or the study's."""
        return key in self._own or _built_in(self.language).has_message(key)

    def paragraphs(self, key: str, /, **variables: Any) -> list[str]:
        """A long text in its paragraphs, which are separated by empty lines."""
        return [part.strip() for part in self(key, **variables).split("\n\n") if part.strip()]

    def is_own(self, key: str) -> bool:
        """Whether the study has written this text itself, for this language or for all."""
        return key in self._own

    def own_variables(self, key: str) -> set[str]:
        """What the study's own text asks for; nothing when it has none, or one that is broken."""
        try:
            return variables_of(_parsed(self._own[key])) if key in self._own else set()
        except WordingBroken:
            return set()

    def _warn(self, key: str, error: WordingBroken) -> None:
        if key not in self._warned:
            log.warning("the study's own text of %s is broken, the built-in one is shown: %s", key, error)
            self._warned.add(key)


def wording_for(settings: StudySettings, chosen: str | None = None) -> Wording:
    """The texts of a study in the language somebody chose, if it is offered, or in its own."""
    language = Language(chosen) if chosen in settings.offered_languages else settings.language
    return _remembered(language, tuple(sorted(settings.wording.items())), settings.language)


def preferred(accept_language: str, offered: Sequence[Language] = tuple(Language)) -> Language:
    """The language for somebody of whom we know only what their browser asks for; the first offered one otherwise."""
    asked = [(code, float(weight or 1)) for code, weight in _ASKED.findall(accept_language.lower())]
    asked.sort(key=lambda each: -each[1])  # of equals the first stays first
    return next((Language(code) for code, weight in asked if code in offered and weight > 0), offered[0])


@pass_context
def say(context: Context, key: str, /, **variables: Any) -> str:
    """For templates: the text in the language of the page, which is that of its ``wording``, else English.

    Texts for scripts go into data attributes, with the name of a variable where its value is to come:
    ``data-count="{{ say("pair-count", answered="{answered}", wanted="{wanted}") }}"``.
    """
    return _of_page(context)(key, **variables)


@pass_context
def page_language(context: Context) -> str:
    """For templates: the code of the language the page is written in."""
    return _of_page(context).language


@pass_context
def study_question(context: Context) -> str:
    """For templates: what is asked about every pair."""
    return question_of(_of_page(context), context["settings"])


def question_of(wording: Wording, settings: StudySettings) -> str:
    """What is asked about every pair: the study's question, translated if it is, or ours in the page's language."""
    ours = settings.question == StudySettings.model_fields["question"].default
    return wording("pair-question") if ours or wording.is_own("pair-question") else settings.question


def broken_texts(own: Mapping[str, str]) -> dict[str, str]:
    """What is wrong with a study's own texts, by key: for the form in which they are written."""
    wrong = {}
    for key, text in own.items():
        prefix, _, name = key.rpartition(":")
        try:
            if not _built_in(Language.ENGLISH).has_message(name) and not name.startswith(("form-", "fact-", "scale-")):
                raise WordingBroken("there is no text of this name")
            if prefix not in {"", *Language}:
                raise WordingBroken(f"there is no language {prefix}")
            unknown = variables_of(_parsed(text)) - _known_variables(name)
            if unknown:
                raise WordingBroken(f"it cannot know {', '.join(sorted(unknown))}")
        except WordingBroken as error:
            wrong[key] = str(error)
    return wrong


def built_in_texts(language: Language) -> dict[str, ast.Message]:
    """Every built-in message of a language, in the order of its file."""
    return {entry.id.name: entry for entry in _resource(language).body if isinstance(entry, ast.Message)}


def plain_text(name: str, language: Language) -> str:
    """A built-in text as a study would write its own: in Fluent, without its name."""
    written = FluentSerializer().serialize_entry(built_in_texts(language)[name])
    return "\n".join(line.removeprefix("    ") for line in written.partition("=")[2].strip().split("\n"))


def variables_of(node: ast.BaseNode) -> set[str]:
    """The variables a text asks for."""
    if isinstance(node, ast.VariableReference):
        return {node.id.name}
    children: Iterable[Any] = vars(node).values()
    nested = [each for child in children for each in (child if isinstance(child, list) else [child])]
    return {name for each in nested if isinstance(each, ast.BaseNode) for name in variables_of(each)}


def _of_page(context: Context) -> Wording:
    wording = context.get("wording")
    return wording if isinstance(wording, Wording) else Wording(Language.ENGLISH)


def _own_words(language: Language, own: Mapping[str, str], study_language: Language) -> dict[str, str]:
    of_all = {key: text for key, text in own.items() if ":" not in key}
    of_this = {key.partition(":")[2]: text for key, text in own.items() if key.startswith(f"{language}:")}
    if language != study_language:
        return of_all | of_this
    return of_this | of_all


@cache
def _resource(language: Language) -> ast.Resource:
    """The language's file, and in it what is said of each task, before what is said of any other."""
    texts: list[ast.EntryType] = []
    for entry in FluentResource((WORDING / f"{language}.ftl").read_text(encoding="utf-8")).body:
        if isinstance(entry, ast.Message) and entry.id.name == "task-lab":
            texts += _of_tasks(language, entry.value)
        texts.append(entry)
    return ast.Resource(texts)


def _of_tasks(language: Language, of_labs: ast.Pattern | None) -> Iterator[ast.Message]:
    """What each task says of itself; a laboratory's that says nothing in this language, what is true of all of them."""
    for task in catalogue.installed().tasks.values():
        text = task.description.instructions.get(language)
        said = ast.Pattern([ast.TextElement(text)]) if text is not None else of_labs
        if text is not None or isinstance(task.description, LabDescription):
            yield ast.Message(ast.Identifier(f"task-{task.name}"), said)


@cache
def _built_in(language: Language) -> FluentBundle:
    bundle = FluentBundle([language], use_isolating=False)
    bundle.add_resource(_resource(language))
    return bundle


@cache
def _known_variables(name: str) -> frozenset[str]:
    message = built_in_texts(Language.ENGLISH).get(name)
    facts = CONSENT_FACTS if name == "consent-body" else ()
    return frozenset(facts) if message is None else frozenset({*variables_of(message), *facts})


@lru_cache(maxsize=64)
def _remembered(language: Language, own: tuple[tuple[str, str], ...], study_language: Language) -> Wording:
    return Wording(language, dict(own), study_language)


def _parsed(text: str) -> ast.Message:
    """A study's own text as a message of its own. Raises WordingBroken."""
    lines = text.replace("\r\n", "\n").strip().split("\n")
    # A line that begins with one of these would end the text in Fluent; as a quoted letter it is one like any other.
    # Lines of a choice in braces must stay as they are, and do begin with these.
    if "{" not in text:
        lines = [f'{{"{line[0]}"}}{line[1:]}' if line[:1] in {"[", "*", ".", "}"} else line for line in lines]
    entries = FluentResource("text =\n" + "\n".join(f"    {line}" for line in lines)).body
    if len(entries) != 1 or not isinstance(entries[0], ast.Message) or entries[0].attributes:
        raise WordingBroken("it is empty, or a brace is missing or too many")
    return entries[0]


@lru_cache(maxsize=512)
def _compiled(text: str, language: Language) -> FluentBundle:
    bundle = FluentBundle([language], use_isolating=False)
    bundle.add_resource(ast.Resource([_parsed(text)]))
    return bundle


def _formatted(bundle: FluentBundle, key: str, variables: Mapping[str, Any]) -> str:
    value = bundle.get_message(key).value
    if value is None:
        raise LookupError(key)
    text, errors = bundle.format_pattern(value, dict(variables))
    if errors:
        raise WordingBroken(f"{key}: {errors[0]}")
    return str(text)
