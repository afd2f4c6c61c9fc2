"""Questions of the forms as the participants read them, for the experimenter's pages."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from app.domain.protocol import FormItem, Stage
from app.domain.studies import Study
from app.services.monitoring.form_summaries import FormSummary, Sheet
from app.web.texts.form_questions import label_of, question_of
from app.web.texts.wording import wording_for

TITLES: Mapping[Stage, str] = {
    Stage.DEMOGRAPHICS: "Questions at the start",
    Stage.QUESTIONNAIRE: "Questions at the end",
}


@dataclass(frozen=True)
class Asked:
    """A form with its title and its questions in words, by name."""

    title: str
    form: Sheet | FormSummary
    questions: Mapping[str, str]
    ends: Mapping[str, tuple[str, str]]
    """Of scales: what 1 and 5 mean."""


def sheets(study: Study, found: Sequence[Sheet]) -> Sequence[Asked]:
    """The forms of one person."""
    return [_asked(study, sheet, [each.item for each in sheet.answers]) for sheet in found]


def summaries(study: Study, found: Sequence[FormSummary]) -> Sequence[Asked]:
    """The forms of everybody."""
    return [_asked(study, summary, [each.item for each in summary.questions]) for summary in found]


def _asked(study: Study, form: Sheet | FormSummary, items: Sequence[FormItem]) -> Asked:
    wording = wording_for(study.settings)
    ends = {
        item.name: (label_of(wording, item, "low", item.low_label), label_of(wording, item, "high", item.high_label))
        for item in items
        if item.kind == "likert"
    }
    return Asked(TITLES[form.form], form, {item.name: question_of(wording, item) for item in items}, ends)
