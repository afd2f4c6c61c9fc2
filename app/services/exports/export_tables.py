"""The tables of an export, in the order in which they are listed."""

from collections.abc import Sequence

from app.services.exports.export_formats import Table
from app.services.exports.tables import answers, evaluation, forms, learning, people, study

TABLES: Sequence[Table] = (
    people.PARTICIPANTS,
    people.ALLOCATIONS,
    people.STAGES,
    answers.QUERIES,
    answers.LABELS,
    answers.HINTS,
    forms.FORMS,
    forms.SCORES,
    people.CONSENT,
    people.EVENTS,
    evaluation.RATINGS,
    evaluation.HEADTOHEADS,
    evaluation.SETTINGS,
    evaluation.DONORS,
    learning.MODELS,
    learning.EVALUATIONS,
    study.CLIPS,
    study.DEVIATIONS,
)
BY_NAME = {table.name: table for table in TABLES}
