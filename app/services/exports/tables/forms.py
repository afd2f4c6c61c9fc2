"""What people entered in forms and questionnaires, and the scores of these."""

from collections.abc import Sequence
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from app.domain.participation import FormAnswer
from app.domain.protocol import LETTERS, EvaluatedMethod
from app.domain.studies import Study
from app.questionnaires import library
from app.questionnaires.library import Score
from app.services.answers import form_answers
from app.services.answers.form_answers import FilledIn
from app.services.evaluation import unblinding
from app.services.exports.export_formats import Column, Table
from app.services.exports.paging import KeyedRows, Window
from app.services.exports.tables.columns import PARTICIPANT, B, I, N, T, W, words
from app.services.exports.whose_rows import present


def _forms(session: Session, study: Study, window: Window) -> KeyedRows:
    methods = {} if unblinding.is_blinded(study) else unblinding.methods_by_letter(session, study)
    for person, wanted in present(session, study, window):
        theirs = select(FormAnswer).where(FormAnswer.participant_id == person.id, wanted.known(FormAnswer))
        answers = session.scalars(theirs.order_by(FormAnswer.id)).all()
        newest = {(each.form, each.letter, each.item): each.id for each in answers}
        for each in answers:
            superseded = newest[each.form, each.letter, each.item] != each.id
            if (each.id,) > wanted.after:
                method = methods.get((person.id, each.letter or ""))
                about = (person.code, each.form, each.letter, method)
                yield (person.number, each.id), (*about, each.item, each.value, superseded, each.created_at)


FORMS = Table(
    "forms",
    "Answers to demographics, questionnaire and standard questionnaires, item by item as they were given.",
    (
        PARTICIPANT,
        Column(
            "form",
            T,
            "Which form: the study's own, whose questions are in its settings, or a standard questionnaire.",
            allowed=", ".join(("demographics", "questionnaire", *library.every())),
        ),
        Column("letter", T, "The robot of the evaluation that it is about; empty: about none.", "", "A to E"),
        Column("method", T, "Which method that was; empty until the study is unblinded.", "", words(EvaluatedMethod)),
        Column("item", T, "Name of the question."),
        Column("value", T, "What was entered (likert: 1 to 5), nothing reversed; empty: skipped."),
        Column("superseded", B, "Whether a later answer to the same question counts instead."),
        Column("created_at", W, "When it reached the server."),
    ),
    _forms,
    (FormAnswer,),
    grows_by=FormAnswer,
)


def _scores(session: Session, study: Study, window: Window) -> KeyedRows:
    """Of every standard questionnaire that was sent; the key is the place among all that somebody could have."""
    methods = {} if unblinding.is_blinded(study) else unblinding.methods_by_letter(session, study)
    places = {
        (letter, form, score.name): place
        for place, (letter, form, score) in enumerate(
            (letter, form, score)
            for letter in (None, *LETTERS)
            for form, instrument in library.every().items()
            for score in instrument.scores
        )
    }
    for person, wanted in present(session, study, window):
        for each in form_answers.filled_in(session, person.id, wanted.known(FormAnswer)):
            for score in each.instrument.scores:
                key = (places[each.letter, each.instrument.name, score.name],)
                if key > wanted.after:
                    yield (
                        (person.number, *key),
                        (person.code, *_score(each, score, methods.get((person.id, each.letter or "")))),
                    )


def _score(each: FilledIn, score: Score, method: str | None) -> Sequence[Any]:
    answered = sum(each.answers.get(name) is not None for name in score.items)
    low, high = each.instrument.range_of(score)
    value = each.scores[score.name]
    return (each.instrument.name, each.letter, method, score.name, value, low, high, len(score.items), answered)


SCORES = Table(
    "scores",
    "Scores of standard questionnaires, by their keys, which questionnaires.md in the file of all data has.",
    (
        PARTICIPANT,
        Column("instrument", T, "Which questionnaire.", allowed=", ".join(library.every())),
        Column("letter", T, "The robot of the evaluation that it is about; empty: about none.", "", "A to E"),
        Column("method", T, "Which method that was; empty until the study is unblinded.", "", words(EvaluatedMethod)),
        Column("score", T, "Which scale or subscale."),
        Column("value", N, "The score; empty: too much was left out for one."),
        Column("lowest", N, "The lowest value it can have."),
        Column("highest", N, "The highest value it can have."),
        Column("items", I, "Items that it is made of."),
        Column("answered", I, "How many of them were answered."),
    ),
    _scores,
    (FormAnswer,),
)
