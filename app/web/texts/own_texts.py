"""What a study says in its own words, and so has to translate itself.

Translations are texts of the study (StudySettings.wording) with the language before the name: ``de:form-hand``.
"""

from collections.abc import Mapping, Sequence

from app.domain.protocol import CONSENT_FACTS, FormItem, Language
from app.domain.study_settings import StudySettings
from app.web.texts.wording import Wording, built_in_texts

CONSENT = "consent-body"


def own_texts(settings: StudySettings) -> dict[str, str]:
    """Everything in the study's own words, in the order of the participant's way, by name."""
    own = {key: text for key, text in settings.wording.items() if ":" not in key}
    texts = {CONSENT: own.pop(CONSENT)} if CONSENT in own else {}
    facts = {f"fact-{name}": getattr(settings, f"consent_{name}") for name in CONSENT_FACTS}
    texts |= {key: said for key, said in facts.items() if said}
    for item in (*settings.demographics, *settings.questionnaire):
        texts |= _texts_of(item)
    if settings.question != StudySettings.model_fields["question"].default:
        texts["pair-question"] = settings.question
    return texts | own


def missing_translations(settings: StudySettings) -> dict[Language, list[str]]:
    """Names of own texts that a language people may choose does not have yet; only languages that lack any."""
    texts = own_texts(settings)
    others = settings.offered_languages[1:]
    missing = {each: [name for name in texts if f"{each}:{name}" not in settings.wording] for each in others}
    return {language: names for language, names in missing.items() if names}


def with_translations(settings: StudySettings, typed: Mapping[str, str]) -> dict[str, str]:
    """The study's texts with these translations, by ``language:name``; an empty one is taken away."""
    names = {f"{each}:{name}" for each in settings.offered_languages[1:] for name in own_texts(settings)}
    cleaned = {key: typed.get(key, "").replace("\r\n", "\n").strip() for key in names}
    kept = {key: text for key, text in settings.wording.items() if key not in names}
    return kept | {key: cleaned[key] for key in sorted(names) if cleaned[key]}


def missing_facts(settings: StudySettings) -> Sequence[str]:
    """What the consent text does not say because the study has not filled it in."""
    wording = Wording(settings.language, settings.wording, settings.language)
    needed = wording.own_variables(CONSENT) if wording.is_own(CONSENT) else set(CONSENT_FACTS)
    return [name for name in CONSENT_FACTS if name in needed and not getattr(settings, f"consent_{name}")]


def choice_key(item: FormItem, place: int) -> str:
    """Under which name the translation of a choice is kept; what is stored of an answer is the choice itself."""
    return f"form-{item.name}-choice-{place}"


def _texts_of(item: FormItem) -> dict[str, str]:
    key = f"form-{item.name}"
    texts = {key: item.question, f"{key}-low": item.low_label, f"{key}-high": item.high_label}
    if not item.question and key not in built_in_texts(Language.ENGLISH):
        texts[key] = item.name.replace("_", " ").capitalize()  # so it is shown
    texts |= {choice_key(item, place): choice for place, choice in enumerate(item.choices, 1)}
    return {name: text for name, text in texts.items() if text}
