"""Who took part: the paragraphs of the methods part on participants, exclusions and attention."""

from collections import Counter
from collections.abc import Iterator, Sequence

from sqlalchemy.orm import Session, joinedload

from app.domain.designs import Ending, Screen
from app.domain.power_plan import PowerTest
from app.domain.preferences import Label, Query, current_answers
from app.domain.protocol import MADE_FOR_YOU, Stage
from app.domain.studies import Participant, Study
from app.services.answers import consistency, exclusions
from app.services.answers.accuracy import Share
from app.services.evaluation import unblinding
from app.services.exports import whose_rows
from app.services.monitoring import form_summaries
from app.services.monitoring.form_summaries import FormSummary, Summary
from app.services.paper import recruitment
from app.services.paper.prose import NOT_RECORDED, count, day, listed, number, paragraph, percent, quoted, table
from app.services.paper.recruitment import Flow
from app.services.studies import power
from app.services.studies.preregistration import TEST_NAMES

LONGEST_LISTED = 30
"""Characters of a free answer that is counted in the text; longer ones may say who somebody is."""


def participants(session: Session, study: Study) -> Iterator[str]:
    """Recruitment, arms, ethics, demographics."""
    flow, settings = recruitment.flow_of(session, study), study.settings
    yield paragraph(
        f"{count(flow.invited, 'person was', 'people were')} invited or joined"
        + (f", {flow.from_panel} of them through a recruitment panel" if flow.from_panel else "")
        + f"; {flow.consented} gave informed consent"
        + _when(flow)
        + f". Of these, {_ended(flow)}{flow.unfinished} had not finished when this text was made (dropped out or still "
        f"on their way), and {flow.completed} completed the study.",
        f"{flow.not_consented} of those invited had not consented.",
        f"{count(flow.withdrawn, 'person', 'people')} withdrew and had all their data erased; they are in no other "
        "number.",
        f"**{count(flow.scripted, 'of the participants was', 'of the participants were')} played by a program: no "
        "person answered or rated there.**"
        if flow.scripted
        else "",
    )
    if settings.goes_on_from:
        yield _visit(session, study)
    by_arm = recruitment.flow_by_arm(session, study)
    if by_arm:
        rows = [_row_of_arm(study, name, flow) for name, flow in by_arm.items()]
        yield table(("arm", "methods", "allocated", "sent back", "not finished", "completed"), rows)
    elif settings.arms:
        yield "Numbers by arm are given after unblinding."
    size = sample_size(session, study)
    yield f"Sample size: {size or 'no simulation of power was stored; **add how it was chosen**.'}"
    yield paragraph(
        f"Ethics approval: {quoted(settings.consent_ethics) or NOT_RECORDED}.",
        f"Compensation: {quoted(settings.consent_payment) or NOT_RECORDED}.",
        f"How people were recruited and paid beyond that: {NOT_RECORDED}.",
    )
    yield from _demographics(session, study)


def _when(flow: Flow) -> str:
    if flow.last_completion is None:
        return ""
    first, last = day(flow.first_consent), day(flow.last_completion)
    return f" on {first}" if first == last else f" between {first} and {last}"


def _visit(session: Session, study: Study) -> str:
    people = [each for each in whose_rows.everybody(session, study) if each.withdrawn_at is None]
    returned = [each for each in people if each.earlier_id is not None]
    return (
        f"This was a return visit: {len(returned)} of these {len(people)} had completed the study "
        f"{study.settings.goes_on_from} at least {count(study.settings.days_between_visits, 'day')} before, and models "
        "went on from all that they had answered there."
    )


def sample_size(session: Session, study: Study) -> str:
    """What the newest finished simulation of this very design says; empty: there is none."""
    plans = power.of_study(session, study)
    plan = next((each for each in plans if each.contents is not None and power.is_current(study, each)), None)
    if plan is None or plan.contents is None:
        return ""
    inputs, contents = plan.inputs, plan.contents
    enough = contents["enough"]["ratings"]
    found = f"reached from {enough} people on" if enough else f"not reached with {inputs.most_people} people"
    tested = ""
    if inputs.test is not PowerTest.DIFFERENCE:
        tested = f", tested by {TEST_NAMES[inputs.test.planned(paired=contents['paired'])]}"
        tested += f" (bounds ±{contents['bound']:g} points)" if inputs.test is PowerTest.EQUIVALENCE else ""
    return (
        f"by simulation of this design ({contents['studies']} studies for each number of people){tested}: "
        f"{unblinding.NAMES[inputs.better]} better than {unblinding.NAMES[inputs.compared]} by {inputs.effect:g} "
        f"points of 5, differing between people by {inputs.spread:g} (SD), levels of people {inputs.levels:g} (SD), "
        f"noise of a rating {inputs.noise:g} (SD), {inputs.dropout_percent:g} % dropouts. A power of 80 % for ratings "
        f"is {found}."
    )


def _ended(flow: Flow) -> str:
    words = {
        Ending.SCREENED_OUT: "screened out by answers at the start",
        Ending.FULL: "sent back because no arm was open",
        Ending.INATTENTIVE: "sent back because of too many missed catch pairs",
    }
    return "".join(
        f"{count(flow.ended[ending], 'was', 'were')} {words[ending]}, " for ending in Ending if flow.ended[ending]
    )


def _row_of_arm(study: Study, name: str, flow: Flow) -> Sequence[str]:
    arm = next(each for each in study.settings.arms if each.name == name)
    methods = ", ".join(unblinding.NAMES[method] for method in arm.methods)
    numbers = (flow.consented, sum(flow.ended.values()), flow.unfinished, flow.completed)
    return (name, methods, *map(str, numbers))


def _demographics(session: Session, study: Study) -> Iterator[str]:
    found = _forms(session, study, Stage.DEMOGRAPHICS)
    if not found:
        yield (
            "Demographics were not asked for."
            if not study.settings.demographics
            else ("Nobody had answered the questions at the start.")
        )
    for form in found:
        said = "; ".join(_question(each) for each in form.questions)
        yield (
            f"Answers at the start, of {count(form.people, 'person', 'people')} who did not withdraw and were not "
            f"screened out: {said}."
        )


def closing_answers(session: Session, study: Study) -> Iterator[str]:
    """What people said to the study's own questions at the end; which robot was made for them has a test."""
    for form in _forms(session, study, Stage.QUESTIONNAIRE):
        said = [_question(each) for each in form.questions if each.item.name != MADE_FOR_YOU]
        if said:
            yield "## Questions at the end"
            yield f"Answers of {count(form.people, 'person', 'people')} who did not withdraw: {'; '.join(said)}."


def _forms(session: Session, study: Study, stage: Stage) -> Sequence[FormSummary]:
    found = form_summaries.summaries_of(session, study, screened_out=False)
    return [each for each in found if each.form == stage]


def _question(each: Summary) -> str:
    name = quoted(each.item.question or each.item.name.replace("_", " "))
    left_out = f", {each.left_out} left out" if each.left_out else ""
    if each.numbers is not None:
        found = each.numbers
        spread = f", SD {number(found.sd)}" if found.sd is not None else ""
        ends = f"range {number(found.low, 0)} to {number(found.high, 0)}"
        return f"{name}: mean {number(found.mean)}{spread}, {ends} (n = {each.answered}{left_out})"
    if each.counts:
        counts = ", ".join(f"{quoted(value)} ({times})" for value, times in each.counts)
        return f"{name}: {counts} (n = {each.answered}{left_out})"
    texts = [" ".join(text.lower().split()) for _, text in each.texts]
    if any(len(text) > LONGEST_LISTED for text in texts):
        return f"{name}: free answers, not listed here (n = {each.answered}{left_out})"
    counts = ", ".join(f"{quoted(text)} ({times})" for text, times in sorted(Counter(texts).items()))
    return f"{name}, as typed: {counts or 'nothing'} (n = {each.answered}{left_out})"


def exclusions_and_attention(session: Session, study: Study) -> Iterator[str]:
    """Rules of screening, excluded answers, catch pairs."""
    settings = study.settings
    rules = "; ".join(rule_in_words(each) for each in settings.screening)
    yield paragraph(
        f"Who may take part was decided by answers at the start: {rules}."
        if rules
        else "Nobody was screened out by a rule.",
        f"Whoever missed {count(settings.end_after_misses, 'catch pair')} was sent back."
        if settings.end_after_misses
        else "No rule sent anybody back for missed catch pairs.",
    )
    reasons = Counter(each.word.reason for each in exclusions.changed_since(session, study, study.created_at))
    listed_reasons = "; ".join(f"{quoted(reason)}: {times}" for reason, times in sorted(reasons.items()))
    yield (
        f"Experimenters excluded {count(reasons.total(), 'answer')} to pairs from learning and statistics. Reasons, "
        f"with numbers of answers: {listed_reasons}."
        if reasons
        else "No answer was excluded by an experimenter."
    )
    yield _attention(session, study)


def rule_in_words(each: Screen) -> str:
    """Of who may take part: the question and the answers that may."""
    if each.answers:
        return f"{quoted(each.name)}: {listed(map(quoted, each.answers), 'or')}"
    return f"{quoted(each.name)}: {each.low:g} to {each.high:g}"


def _attention(session: Session, study: Study) -> str:
    missed = missed_catches(session, study)
    asked, wrong = sum(each.scored for each in missed), sum(each.correct for each in missed)
    if not asked:
        return "Attention was not measured: no catch pair was answered."
    return (
        f"Of {asked} answered catch pairs, {wrong:g} ({percent(wrong / asked)}) were answered the obviously wrong way."
    )


def missed_catches(session: Session, study: Study) -> Sequence[Share]:
    """Of everybody who has answered a catch pair and not withdrawn: how many of them were wrong."""
    people = [each for each in whose_rows.everybody(session, study) if each.withdrawn_at is None]
    found = [consistency.catch_errors(consistency.answers_of(_answers(session, each))) for each in people]
    return [each for each in found if each is not None]


def _answers(session: Session, person: Participant) -> Sequence[Label]:
    return current_answers(session, person.id, joinedload(Query.left_clip), joinedload(Query.right_clip))
