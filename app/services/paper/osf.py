"""What a preregistration at OSF asks for, as far as a study's settings answer it; to be filled in and pasted.

The sections and questions are those of the form “OSF Preregistration” (Bowman et al., doi.org/10.31222/osf.io/epgjd).
What only the experimenters know is left to them, and marked.
"""

from collections.abc import Mapping, Sequence

from sqlalchemy.orm import Session

from app.domain.protocol import EvaluationMode, EvaluationSettings, PlannedTest
from app.domain.studies import Study
from app.domain.study_settings import StudySettings
from app.installed_tasks import hints
from app.questionnaires import library
from app.services.answers import hint_offers
from app.services.evaluation import unblinding
from app.services.exports import codebook, export_formats
from app.services.paper import recruitment
from app.services.paper.methods import METHODS, archived_in_words
from app.services.paper.people import rule_in_words, sample_size
from app.services.paper.prose import count, day, listed, paragraph, percent, quoted
from app.services.studies import locking, preregistration
from app.services.studies.preregistration import TEST_NAMES, PlanStanding

FILE_NAME = "preregistration.md"
YOURS = "**To be written by you.**"
NOTHING = "Not applicable."


def registration(session: Session, study: Study) -> str:
    """Markdown with a heading for every question. Of a locked study what was locked, not what was changed since."""
    settings = _planned(study)
    parts = [_HEAD.format(name=quoted(study.name), version=export_formats.software_version())]
    for section, questions in (
        ("Study information", _information(study)),
        ("Design plan", _design(study, settings)),
        ("Sampling plan", _sampling(session, study, settings)),
        ("Variables", _variables(study, settings)),
        ("Analysis plan", _analysis(study, settings)),
        ("Other", {"Other": _other(study)}),
    ):
        parts.append(f"## {section}")
        parts += [f"### {question}\n\n{answer}" for question, answer in questions.items()]
    return "\n\n".join(parts) + "\n"


_HEAD = """\
# Preregistration: {name}

> Written by PbARL Studio {version} in the order of the form “OSF Preregistration”. Complete what is marked, then \
paste each part into the form at osf.io, and attach the locked document."""


def _planned(study: Study) -> StudySettings:
    return study.settings if study.lock_document is None else locking.planned_settings(study.lock_document)


def _evaluation(study: Study, settings: StudySettings) -> EvaluationSettings | None:
    return settings.evaluation if study.material is None else None


def _information(study: Study) -> Mapping[str, str]:
    return {
        "Title": quoted(study.name),
        "Authors": YOURS,
        "Description": f"{YOURS} The task is {quoted(study.task)}; the studio learns what each participant wants from "
        "pairwise comparisons of clips, and trains an action filter after a frozen policy from that.",
        "Hypotheses": f"{YOURS} For each: which two methods, on which scale, in which direction, by which of the tests "
        "below.",
    }


def _design(study: Study, settings: StudySettings) -> Mapping[str, str]:
    evaluation = _evaluation(study, settings)
    if evaluation is None:
        nothing = "Nothing is compared: participants answer pairs, and models learn from their answers."
        return {
            "Study type": "Observational study: no methods are assigned to participants.",
            "Blinding": "No blinding is involved in this study.",
            "Is there any additional blinding in this study?": NOTHING,
            "Study design": nothing,
            "Randomization": _randomisation(study, settings, None),
        }
    arms = [
        f"* {arm.name}: {listed(unblinding.NAMES[method] for method in arm.methods)}"
        + (" (stopped)" if arm.name in settings.stopped_arms else "")
        for arm in settings.arms
    ]
    design = (
        "Between subjects, with these arms:\n\n" + "\n".join(arms)
        if arms
        else "Within subjects: every participant meets every method."
    )
    methods = [f"* {unblinding.NAMES[method]}: {METHODS[method]}" for method in evaluation.methods]
    return {
        "Study type": "Experiment: a researcher assigns treatments, here methods that move the robot and their order.",
        "Blinding": "Participants do not know which method they are rating. The personnel who interact with them, and "
        "those who look at the data, do not know it either, until the study is unblinded.",
        "Is there any additional blinding in this study?": "Letters hide the methods on every page and in every file "
        "until somebody unblinds the study for good; when that was is in every export.",
        "Study design": f"{design}\n\nMethods:\n\n"
        + "\n".join(methods)
        + "\n\n"
        + paragraph(
            archived_in_words(study),
            f"Filters of all answers are refined by soft actor-critic for {settings.refinement_steps:,} environment "
            "steps and kept so where that is better by the learned preference and no worse for the task."
            if settings.refinement_steps
            else "",
            f"Each method is met in one block of {count(evaluation.trials, 'trial')} "
            + ("on video." if evaluation.mode is EvaluationMode.VIDEO else "with a robot in the room."),
            f"Every two methods that a person has met then meet {count(evaluation.head_to_heads, 'time')} side by side."
            if evaluation.head_to_heads
            else "There are no head-to-heads.",
        ),
        "Randomization": _randomisation(study, settings, evaluation),
    }


def _randomisation(study: Study, settings: StudySettings, evaluation: EvaluationSettings | None) -> str:
    return paragraph(
        "Everything that is drawn follows from seeds in the locked document and from the study's secret, whose hash is "
        "in it.",
        f"Pairs: {settings.strategy.label.lower()}; at least {percent(settings.random_share, 0)} are drawn at random. "
        + (
            f"From the tenth answer on {percent(settings.following_share, 0)} follow the person: what their filter "
            "would do by then beside a variation of it, filmed for them alone; until such a pair is ready, the rule "
            "chooses. "
            if settings.following_share and study.material is None
            else ""
        )
        + "Sides are drawn.",
        "Orders of methods come from Williams squares; letters are given in the order of appearance."
        if evaluation
        else "",
        "Arms: minimisation on completions. Whoever arrives comes into the open arm with the fewest people who have "
        "completed it or are on their way through it; who has been silent for ten minutes only decides between arms "
        "that are level otherwise, and lots decide remaining ties. Who has given no sign for "
        f"{settings.arm_away_minutes} minutes counts as dropped out and is replaced."
        if settings.arms
        else "",
    )


def _sampling(session: Session, study: Study, settings: StudySettings) -> Mapping[str, str]:
    plan, flow = preregistration.plan_of(session, study), recruitment.flow_of(session, study)
    existing = plan.first_answer_at is not None
    first = f"First answer: {day(plan.first_answer_at)}. " if existing else ""
    rated = f"First rating: {day(plan.first_rating_at)}. " if plan.first_rating_at else ""
    proof = (
        "The plan was locked before the first answer." if plan.standing is PlanStanding.BEFORE_DATA else plan.in_words
    )
    quota = (
        f"{settings.arm_quota} completions in each of {len(settings.arms)} arms."
        if settings.arms and settings.arm_quota
        else f"{YOURS} The studio sets no limit."
    )
    screening = "; ".join(rule_in_words(each) for each in settings.screening)
    return {
        "Existing data": "Registration after the creation of data: this file was written after the first answer."
        if existing
        else "Registration prior to creation of data.",
        "Explanation of existing data": f"{first}{rated}{proof}" if existing else NOTHING,
        "Data collection procedures": paragraph(
            f"{YOURS} (population, recruitment, payment, setting).",
            f"Payment as participants read it: {quoted(settings.consent_payment)}." if settings.consent_payment else "",
            f"Ethics: {quoted(settings.consent_ethics)}." if settings.consent_ethics else "",
            f"Who may take part, by answers at the start: {screening}." if screening else "No rule screens people out.",
            f"Each participant is asked {settings.question_count} pairs: {settings.labels_per_participant} that the "
            f"model learns from ({settings.introduction_count} of whole trajectories), {settings.repeated_pairs} asked "
            f"again and {settings.catch_pairs} catch pairs; {settings.practice_pairs} practice pairs come before.",
            "After each answer for one side they can name what made the difference, or pass this over."
            if settings.asks_what_mattered and study.material is None
            else "",
            f"After the introduction they can give up to {hints.MOST} hints, and change them later."
            if hint_offers.asks(study)
            else "",
            f"So far: {flow.consented} consented, {flow.completed} completed." if flow.consented else "",
        ),
        "Sample size": quota,
        "Sample size rationale": _rationale(session, study),
        "Stopping rule": paragraph(
            str((study.lock_document or locking.document(study))["stop_rule"]),
            f"Somebody who misses {count(settings.end_after_misses, 'catch pair')} is sent back."
            if settings.end_after_misses
            else "",
            f"An arm closes at {settings.arm_quota} completions." if settings.arms and settings.arm_quota else "",
            f"When recruitment as a whole stops: {YOURS}" if not (settings.arms and settings.arm_quota) else "",
        ),
    }


def _rationale(session: Session, study: Study) -> str:
    found = sample_size(session, study)
    if not found:
        return f"{YOURS} No simulation of this design is stored (page “How many people”)."
    return found[0].upper() + found[1:]


def _variables(study: Study, settings: StudySettings) -> Mapping[str, str]:
    evaluation = _evaluation(study, settings)
    measured = [
        *(["Ratings after every trial, 1 to 5: satisfaction, personalisation."] if evaluation else []),
        *(
            [
                "Head-to-heads: left, right"
                + (" or equal" if evaluation.head_to_head_ties else "")
                + ", which robot they would rather have."
            ]
            if evaluation and evaluation.head_to_heads
            else []
        ),
        *(["Reasons in words, beside ratings and head-to-heads."] if evaluation and evaluation.ask_reasons else []),
        *(["Which robot was made for them."] if evaluation and evaluation.ask_which_is_theirs else []),
        *(f"{library.every()[name].title}, {_when(name, settings, evaluation)}." for name in settings.all_instruments),
        "Answers to pairs (left, right, equal, can't tell), with response times.",
        "Share of answers on randomly drawn pairs that the newest reward model predicted before they were given.",
        *(["Agreement of answers to pairs asked twice."] if settings.repeated_pairs else []),
        *(["Wrong answers to catch pairs."] if settings.catch_pairs else []),
        *([f"Questions at the start: {_names(settings.demographics)}."] if settings.demographics else []),
        *([f"Questions at the end: {_names(settings.questionnaire)}."] if settings.questionnaire else []),
    ]
    return {
        "Manipulated variables": f"Method: {listed(unblinding.NAMES[method] for method in evaluation.methods)}."
        + (f" Arm: {listed(arm.name for arm in settings.arms)}." if settings.arms else "")
        if evaluation
        else NOTHING,
        "Measured variables": "\n".join(f"* {each}" for each in measured),
        "Indices": _indices(settings, evaluation),
    }


def _when(name: str, settings: StudySettings, evaluation: EvaluationSettings | None) -> str:
    about = ["about each robot"] if evaluation and name in evaluation.instruments else []
    return listed([*about, *(["at the end"] if name in settings.instruments else [])])


def _names(items: Sequence[object]) -> str:
    return ", ".join(quoted(str(getattr(each, "question", "") or getattr(each, "name", ""))) for each in items)


def _indices(settings: StudySettings, evaluation: EvaluationSettings | None) -> str:
    lines = ["* Of several ratings of one method by one person: their mean."] if evaluation else []
    for name in settings.all_instruments:
        known = library.every()[name]
        for score in known.scores:
            low, high = known.range_of(score)
            items = listed(f"{item} (reversed)" if item in known.reversed_items else item for item in score.items)
            made = items if len(score.items) == 1 else f"mean of {items}"
            if (low, high) != (known.answers.lowest, known.answers.highest):
                made += f", stretched to {low} to {high}"
            lines.append(f"* {known.title}, {score.title}, {low} to {high}: {made}.")
    return "\n".join(lines) or NOTHING


def _analysis(study: Study, settings: StudySettings) -> Mapping[str, str]:
    evaluation = _evaluation(study, settings)
    tests = [f"* {TEST_NAMES[test]}" for test in settings.planned_tests]
    models = (
        "Planned tests of the ratings, of every two methods on each scale, two-sided:\n\n"
        + ("\n".join(tests) or "* none")
        + (
            f"\n\nBounds of equivalence: ±{settings.equivalence_bound:g} points of the scale from 1 to 5."
            if {PlannedTest.EQUIVALENCE, PlannedTest.EQUIVALENCE_BETWEEN} & set(settings.planned_tests)
            else ""
        )
        + (
            "\n\nHead-to-heads: Bradley-Terry strengths, an equal answer as half a win for each, with a sandwich "
            "variance over people corrected for the people whom a difference rests on (Bell and McCaffrey 2002), and t "
            "with Satterthwaite's degrees of freedom: people less one where everybody compares all, fewer in arms. "
            "Where no finite strength fits, as when one method is always preferred, or where all answered alike: "
            "Wilcoxon's exact signed-rank test of each person's share of wins."
            if evaluation and evaluation.head_to_heads
            else ""
        )
        + (
            "\n\nWhich robot was made for them: exact binomial test against chance."
            if evaluation and evaluation.ask_which_is_theirs
            else ""
        )
    )
    missing = [
        f"{library.every()[name].title}: {codebook.MISSING[library.every()[name].missing]}"
        for name in settings.all_instruments
    ]
    return {
        "Statistical models": models if evaluation else "No test is planned: nothing is compared.",
        "Transformations": "None. Reversed items of questionnaires are mirrored within the range of answers.",
        "Inference criteria": "Two-sided p values below .05 after Holm's correction over the comparisons of one scale "
        "and one test, and 95 % intervals; equivalence: both one-sided p values below .05 after the same correction. "
        "The two-sample t-test as in the paper on PbARL, p < .01, is not corrected."
        if evaluation
        else NOTHING,
        "Data exclusion": paragraph(
            "Previews, practice, and everything of people who withdraw are in no analysis. Answers to pairs are left "
            "out only by an experimenter, each with a reason that is kept and listed, with whether it came after "
            "unblinding.",
            f"People are sent back after {count(settings.end_after_misses, 'missed catch pair')}."
            if settings.end_after_misses
            else "No rule excludes people for missed catch pairs.",
            f"Further rules: {YOURS}",
        ),
        "Missing data": paragraph(
            "Tests within people use who has rated both methods of a comparison; nothing is imputed.",
            "Tests between arms leave out who has rated both." if settings.arms else "",
            *missing,
        ),
        "Exploratory analysis": "Every test that is not named above: order and carryover, reliability of scales, "
        "changes of success, costs and learned preference in simulation, and differences between methods on "
        "questionnaires.",
    }


def _other(study: Study) -> str:
    contents = study.lock_document or locking.document(study)
    fingerprint = study.lock_hash or locking.hash_of(contents)
    state = f"locked on {day(study.locked_at)}" if study.lock_hash else "not locked yet: lock the study, then publish"
    return paragraph(
        f"Locked document (JSON): SHA-256 `{fingerprint}`, {state}. It has every setting, the seeds, the rule by which "
        "pairs are planned and the hash of the secret that letters and arms are drawn from.",
        "The export of the study has scripts that compute every table and figure from its CSV files.",
        f"Seed of the study: {contents['study']['seed']}; software: PbARL Studio {contents['software_version']}.",
    )
