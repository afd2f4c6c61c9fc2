"""The text that is agreed to: built-in or the study's own, with what only the study knows filled in."""

from dataclasses import dataclass

from app.domain.protocol import CONSENT_FACTS
from app.domain.studies import Participant
from app.domain.study_settings import StudySettings
from app.web.texts.wording import Wording


@dataclass(frozen=True)
class ConsentText:
    """Every word of it, in the order of the page."""

    title: str
    welcome: str
    body: str
    version: str

    @property
    def whole(self) -> str:
        """As it is stored: what was on the screen, word for word."""
        return "\n\n".join((self.title, self.welcome, self.body, self.version))


def consent_text(wording: Wording, participant: Participant) -> ConsentText:
    """The text in the language of the page."""
    settings = participant.study.settings
    facts = {name: fact_of(wording, settings, name) for name in CONSENT_FACTS}
    body = wording("consent-body", count=settings.question_count, code=participant.code, **facts)
    return ConsentText(
        title=wording("consent-title"),
        welcome=wording("consent-welcome"),
        body=_with_list(body, [*_what_happens(wording, participant), *_facts_in_words(wording, facts)]),
        version=wording("consent-version", version=settings.consent_version),
    )


def _what_happens(wording: Wording, participant: Participant) -> list[str]:
    """That earlier answers count on, that people set a robot themselves, and are shown others': wherever it happens,
    whatever the study's own text says."""
    evaluation = participant.study.settings.evaluation
    happens = {
        "consent-visit": participant.visit > 1,
        "consent-setting": evaluation is not None and evaluation.has_sliders,
        "consent-others": evaluation is not None and evaluation.shows_others,
    }
    return [wording(key) for key, is_so in happens.items() if is_so]


def fact_of(wording: Wording, settings: StudySettings, name: str) -> str:
    """What the study says about its duration, payment, ethics approval or contact; empty when it says nothing."""
    said: str = getattr(settings, f"consent_{name}")
    return wording(f"fact-{name}") if said and wording.is_own(f"fact-{name}") else said


def _facts_in_words(wording: Wording, facts: dict[str, str]) -> list[str]:
    """A line for each that is known and that the study's own text does not mention at a place of its own choice."""
    mentioned = wording.own_variables("consent-body")
    missing = {name: fact for name, fact in facts.items() if fact and name not in mentioned}
    lines = [wording(f"consent-{name}", **{name: fact}) for name, fact in missing.items()]
    if not facts["contact"] and not wording.is_own("consent-body"):
        lines.append(wording("consent-contact-unknown"))
    return lines


def _with_list(body: str, lines: list[str]) -> str:
    """The lines go on with the list that a text ends with, or are one of their own."""
    if not lines:
        return body
    ends_with_list = body.rstrip().rpartition("\n\n")[2].lstrip().startswith("- ")
    return body.rstrip() + ("\n" if ends_with_list else "\n\n") + "\n".join(f"- {line}" for line in lines)
