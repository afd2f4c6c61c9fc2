"""The codebook of standard questionnaires: words, scoring key, source and licence of all that a study uses."""

from collections.abc import Sequence
from typing import Any

from app.domain.protocol import Language
from app.domain.study_settings import StudySettings
from app.questionnaires import library
from app.questionnaires.library import Instrument
from app.services.exports.csv_cells import csv_line

MISSING = {
    "none": "A score is empty when one of its items was left out.",
    "centre": "An item that was left out counts as the centre; a score of which all were left out is empty.",
}


def entries(settings: StudySettings) -> Sequence[dict[str, Any]]:
    """The data file of each questionnaire, and the words that people read, by language and part."""
    return [
        library.every()[name].model_dump() | {"asked_as": _words(settings, library.every()[name])}
        for name in settings.all_instruments
    ]


def markdown(settings: StudySettings) -> str:
    """The same for people."""
    chapters = [_chapter(settings, library.every()[name]) for name in settings.all_instruments]
    return "\n".join(["# Standard questionnaires of this study\n", *(chapters or ["None.\n"])])


def scoring_key_csv() -> str:
    """Which item enters which score, of every questionnaire in the library, as a table for scripts."""
    head = ("instrument", "score", "item", "reversed", "answer_lowest", "answer_highest", "missing")
    rows = [
        (
            each.name,
            score.name,
            item,
            item in each.reversed_items,
            each.answers.lowest,
            each.answers.highest,
            each.missing,
        )
        for each in library.every().values()
        for score in each.scores
        for item in score.items
    ]
    return "".join(csv_line(row) for row in (head, *rows))


def is_own(settings: StudySettings, instrument: str, language: Language) -> bool:
    """Whether some of the words in a language are the study's own, and so nobody has validated them."""
    parts = library.every()[instrument].published(language.value)
    return any(settings.own_words(instrument, part, language) for part in parts)


def _words(settings: StudySettings, instrument: Instrument) -> dict[str, dict[str, str]]:
    return {
        language.value: {
            part: settings.own_words(instrument.name, part, language) or published
            for part, published in instrument.published(language.value).items()
        }
        for language in settings.offered_languages
    }


def _chapter(settings: StudySettings, known: Instrument) -> str:
    own = [each.label for each in settings.offered_languages if is_own(settings, known.name, each)]
    answers, words = known.answers, _words(settings, known)
    lines = [
        f"## {known.title} (`{known.name}`)\n",
        f"{known.measures}\n",
        f"* Source: {known.citation}",
        f"* Licence: {known.licence}",
        f"* Words: {known.wording}"
        + (f" In {', '.join(own)} some are this study's own, which nobody validated." if own else ""),
        f"* Answers: {answers.lowest} to {answers.highest} in steps of {answers.step}.",
        f"* Left out: {MISSING[known.missing]} {known.missing_because}\n",
        "| score | title | range | mean of |\n|---|---|---|---|",
    ]
    for score in known.scores:
        low, high = known.range_of(score)
        key = ", ".join(f"{name} (reversed)" if name in known.reversed_items else name for name in score.items)
        lines.append(f"| `{score.name}` | {score.title} | {low} to {high} | {key} |")
    languages = list(words)
    lines += [f"\n| part | {' | '.join(languages)} |", "|---" * (len(languages) + 1) + "|"]
    for part in words[languages[0]]:
        texts = [" ".join(words[language][part].split()).replace("|", "\\|") for language in languages]
        lines.append(f"| `{part}` | {' | '.join(texts)} |")
    return "\n".join(lines) + "\n"
