"""Questions of the forms in words: in the reader's language and in the study's own words where there are any."""

from app.domain.protocol import FormItem
from app.web.texts.own_texts import choice_key
from app.web.texts.wording import Wording


def question_of(wording: Wording, item: FormItem) -> str:
    """The study's wording in this language, else its own question, else the built-in one, else the plain name."""
    key = f"form-{item.name}"
    if item.question and not wording.is_own(key):
        return item.question
    return wording(key) if key in wording else item.name.replace("_", " ").capitalize()


def choice_of(wording: Wording, item: FormItem, place: int) -> str:
    """A choice in this language: the study's translation, else as the study has it. ``place``: from 1."""
    key = choice_key(item, place)
    return wording(key) if wording.is_own(key) else item.choices[place - 1]


def label_of(wording: Wording, item: FormItem, end: str, own: str) -> str:
    """What one end of a scale means: as question_of."""
    key = f"form-{item.name}-{end}"
    if own and not wording.is_own(key):
        return own
    return wording(key if key in wording else f"form-likert-{end}")
