"""The methods part of a paper: what was done, in the past tense, from settings, times and counts.

Nothing here depends on which letter hides which method, so that it can be read while a study is blinded.
"""

from collections.abc import Iterator

from sqlalchemy import select
from sqlalchemy.orm import Session

from app.domain.choices import Method, RewardKind, Strategy
from app.domain.models import Model, ModelKind
from app.domain.protocol import EvaluatedMethod, EvaluationMode, EvaluationSettings, Language
from app.domain.studies import Participant, Study
from app.installed_tasks import catalogue, hints
from app.installed_tasks.by_name import archived_policy_count
from app.installed_tasks.refinements import SHARE_AHEAD, answers_ahead
from app.questionnaires import library
from app.services.answers import hint_offers
from app.services.answers.misfit import DOUBT
from app.services.evaluation import evaluation_plan, unblinding
from app.services.exports import codebook, export_formats
from app.services.paper import people
from app.services.paper.prose import count, day, listed, paragraph, percent, quoted
from app.services.studies import preregistration
from app.services.studies.preregistration import TEST_NAMES, Plan

METHODS = {
    EvaluatedMethod.REFERENCE: "personalised for nobody",
    EvaluatedMethod.PREFFT: "that policy fine-tuned on the participant's learned reward",
    EvaluatedMethod.PREFFT_ANCHORED: "that policy fine-tuned on the participant's learned reward and kept near its "
    "former actions",
    EvaluatedMethod.PBARL: "the pre-trained policy followed by the participant's own action filter",
    EvaluatedMethod.PBARL_PRINTED: "the same with the filter exactly as printed in the paper on PbARL",
    EvaluatedMethod.SOMEBODY_ELSE: "the pre-trained policy followed by the filter of another participant, drawn by a "
    "logged rule (a yoked control)",
    EvaluatedMethod.AVERAGE: "the pre-trained policy followed by one filter for what people want on average",
    EvaluatedMethod.SELF_SET: "the way of moving that participants set themselves with sliders, after comparing and "
    "before rating",
}
"""What each was, in words for a paper."""
LANGUAGES = {Language.ENGLISH: "English", Language.GERMAN: "German"}


def methods_part(session: Session, study: Study) -> Iterator[str]:
    """Paragraphs in Markdown, headings among them."""
    plan = preregistration.plan_of(session, study)
    yield "# Methods"
    yield "## Participants"
    yield from people.participants(session, study)
    yield "## Design"
    yield from _design(study)
    yield "## Materials and procedure"
    yield from _procedure(session, study)
    yield "## Measures"
    yield from _measures(study)
    yield "## Exclusions and attention"
    yield from people.exclusions_and_attention(session, study)
    yield "## Preregistration and deviations"
    yield from _deviations(study, plan)
    yield "## Analysis"
    yield from _analysis(study, plan)
    yield "## Software and reproducibility"
    yield from _provenance(study)


def _design(study: Study) -> Iterator[str]:
    settings, evaluation = study.settings, evaluation_plan.settings_of(study)
    if evaluation is None:
        yield "No methods were compared: participants answered pairs of clips, and models learned from their answers."
        return
    between = (
        f"The study was between subjects with {len(settings.arms)} arms. Whoever had consented"
        + (" and passed the screening" if settings.screening else "")
        + " came into the open arm with the fewest people who had completed it or were on their way through it; who "
        "had been silent for ten minutes only decided between arms that were level otherwise, and remaining ties were "
        "decided by lots drawn from a secret fixed before the study (minimisation on completions). "
        + (f"Each arm closed after {settings.arm_quota} completions. " if settings.arm_quota else "")
        + "Dropouts were replaced."
    )
    yield between if settings.arms else "The study was within subjects: every participant met every method."
    yield f"Methods were {listed(_method(study, evaluation, method) for method in evaluation.methods)}."
    yield paragraph(
        f"Each method was met in one block of {count(evaluation.trials, 'trial')}, "
        + ("on video" if evaluation.mode is EvaluationMode.VIDEO else "with a robot in the room, run by an operator")
        + ", in scenarios that training had not used and that were the same for all methods of a participant.",
        "Orders came from Williams squares, which balance position and first-order carryover"
        + (" within each arm." if settings.arms else " over participants."),
        "Methods were known by letters in the order of appearance. Which letter hid which method followed from a "
        f"secret{', whose hash is part of the locked plan' if study.lock_hash else ''}; neither participants nor "
        "experimenters could look it up before the study "
        + (
            f"was unblinded, on {day(study.unblinded_at)}."
            if study.unblinded_at
            else "is unblinded, which has not happened yet."
        ),
    )


def _method(study: Study, evaluation: EvaluationSettings, method: EvaluatedMethod) -> str:
    more = f", {evaluation.fine_tuning_steps:,} steps" if method.value.startswith("prefft") else ""
    if method is EvaluatedMethod.PBARL:
        printed = study.settings.method is Method.PRINTED
        more = ", trained as printed" if printed else ", trained in the studio's own configuration"
    return f"{unblinding.NAMES[method]} ({METHODS[method]}{more})"


def _procedure(session: Session, study: Study) -> Iterator[str]:
    settings = study.settings
    installed = catalogue.find(study.task)
    title = installed.description.title if installed else study.task
    made = (
        f"simulated clips of {study.clip_s:.3g} s "
        f"({settings.clip_quality.hint.split(';')[0].rstrip('.')}), from {settings.pool_scenarios} scenarios with "
        f"{settings.behaviours_per_scenario} ways of doing each"
        if study.material is None
        else "clips that were recorded elsewhere and imported"
    )
    on_top = [
        *([f"{count(settings.repeated_pairs, 'pair')} asked twice"] if settings.repeated_pairs else []),
        *(
            [f"{count(settings.catch_pairs, 'catch pair')} (a clean success beside a clear failure)"]
            if settings.catch_pairs
            else []
        ),
    ]
    yield paragraph(
        f"The task was {quoted(title)}. Participants saw {made}, two side by side, and answered “"
        f"{quoted(settings.question)}” with left, right, equal or can't tell.",
        f"Everybody was to give {settings.labels_per_participant} answers that the model learned from"
        + (
            f", the first {settings.introduction_count} of them on whole trajectories."
            if settings.introduction_count
            else "."
        ),
        f"{count(settings.practice_pairs, 'practice pair')} came before." if settings.practice_pairs else "",
        f"On top of these came {listed(on_top)}." if on_top else "",
        f"Breaks were offered every {settings.break_every} answers." if settings.break_every else "",
        "Answers opened after both clips had been played once." if settings.answer_after_first_play else "",
        "After each answer for one side participants could name what had made the difference, or pass this over; the "
        "reward model heard the answer once more, about the quality that was named alone."
        if settings.asks_what_mattered and study.material is None
        else "",
        f"After the introduction participants could give up to {hints.MOST} hints about how the robot was to move, "
        "from a list in an order of their own, and change them later; the reward model heard each as one more answer "
        "about the signals concerned."
        if hint_offers.asks(study)
        else "",
    )
    chosen = settings.strategy.label.lower()
    yield paragraph(
        f"Pairs were chosen by this rule: {chosen}"
        + (
            f"; {percent(settings.random_share, 0)} were always drawn at random."
            if settings.strategy is not Strategy.UNIFORM
            else "."
        ),
        f"From the tenth answer on {percent(settings.following_share, 0)} of the pairs, as far as they were ready in "
        "time, followed the participant instead, whatever the rule: they showed the execution that the participant's "
        "filter would have had by then, beside a variation of it about which the newest model expected an answer to "
        "say much, both filmed for this participant alone. Each pair's probability was stored."
        if settings.following_share and study.material is None
        else "",
        f"The reward model was “{settings.reward_kind.label}”, trained anew every "
        f"{count(settings.retrain_every_labels, 'answer')}"
        f", starting from {_starting_from(session, study)}.",
        "Where models with further terms (worst moments, the time of arrival, weights that differ by distance or by "
        f"pose) made somebody's answers more than {DOUBT:g} times as probable, theirs had those that explained most; "
        "where that was weights that move along with the number of the answer, it had their mean over the last quarter "
        "of the answers."
        if settings.reward_kind is RewardKind.STRUCTURED
        else "",
        f"Action filters were trained after {listed(map(str, settings.milestones))} answers and measured on "
        f"{settings.evaluation_scenarios} unseen simulated scenarios each; they were allowed to cost "
        f"{percent(settings.success_tolerance)} of success, and to be worse than the pre-trained policy in at most "
        f"{percent(settings.harm_share)} of scenarios with {percent(settings.harm_confidence, 0)} confidence."
        if study.material is None
        else "",
        archived_in_words(study),
        _quickly_in_words(study),
        "The filter of all answers was then refined by soft actor-critic for "
        f"{settings.refinement_steps:,} environment steps, {percent(SHARE_AHEAD, 0)} of them on the preference learned "
        f"from the first {answers_ahead(settings.labels_per_participant)} answers and from its execution mode on; "
        "force on the person beyond what 95 % of the episodes of the pre-trained policy stay below had a price. The "
        "refined policy was kept where it was better and, in further scenarios too, no worse in these respects."
        if settings.refinement_steps
        else "",
    )
    languages = [LANGUAGES[each] for each in settings.offered_languages]
    yield f"Pages were in {listed(languages, 'or')}{', as participants chose' if len(languages) > 1 else ''}."


def archived_in_words(study: Study) -> str:
    """What is chosen instead of an execution mode, where a task has policies that were refined beforehand."""
    policies = archived_policy_count(study.task)
    if study.material is not None or study.settings.method is not Method.STUDIO or not policies:
        return ""
    return (
        f"A filter is one of {policies} policies that had been refined by soft actor-critic beforehand for people to "
        "whom one thing matters most, in an execution mode of their own, wherever one gains more by the "
        "learned preference than the participant's mode and residual around the pre-trained policy, and keeps the "
        "task."
    )


def _quickly_in_words(study: Study) -> str:
    """How filters were found that followed some of the answers."""
    settings = study.settings
    if study.material is not None or settings.method is not Method.STUDIO or len(settings.milestones) == 1:
        return ""
    archived = ", or one of these policies, in no mode sought for the participant, where that gains more"
    instead = archived if archived_policy_count(study.task) else ""
    return (
        "For the filters of fewer than all answers no residual was learned, and the first execution mode was taken "
        f"that was better and kept the task{instead}."
    )


def _starting_from(session: Session, study: Study) -> str:
    """Whom reward models expect before the first answer: what the newest one says of itself."""
    newest = (
        select(Model.metrics)
        .join(Participant, Participant.id == Model.participant_id)
        .where(Participant.study_id == study.id, Model.kind == ModelKind.REWARD)
        .order_by(Model.id.desc())
        .limit(1)
    )
    shares = (session.scalar(newest) or {}).get("population_shares", {})
    known = [name for name in shares if name != "nobody known"]
    if known:
        return f"{listed(known)} (or from nothing, as far as answers contradicted that)"
    return "earlier participants" if study.settings.pooled_prior else "nothing"


def _measures(study: Study) -> Iterator[str]:
    settings, evaluation = study.settings, evaluation_plan.settings_of(study)
    if evaluation is not None:
        yield paragraph(
            "After every trial participants rated satisfaction and personalisation from 1 to 5.",
            f"Then every two methods met {count(evaluation.head_to_heads, 'time')} side by side in one scenario; "
            "participants said which one they would rather have"
            + (" or that both were equal." if evaluation.head_to_head_ties else ".")
            if evaluation.head_to_heads
            else "",
            "Beside each of these answers they could give a reason in words." if evaluation.ask_reasons else "",
            "At the end they named the robot that they thought was made for them."
            if evaluation.ask_which_is_theirs
            else "",
        )
    for name in settings.all_instruments:
        known = library.every()[name]
        where = [
            *(["about each robot"] if evaluation is not None and name in evaluation.instruments else []),
            *(["at the end"] if name in settings.instruments else []),
        ]
        own = [each.label for each in settings.offered_languages if codebook.is_own(settings, name, each)]
        yield paragraph(
            f"{known.title} was filled in {' and '.join(where)} ({' '.join(known.citation.split())}).",
            codebook.MISSING[known.missing],
            f"Words in {listed(own)} were the study's own, which nobody had validated." if own else "",
        )
    if settings.questionnaire:
        asked = "; ".join(quoted(each.question or each.name.replace("_", " ")) for each in settings.questionnaire)
        yield f"Questions of the study's own at the end: {asked}."
    yield paragraph(
        "Each answer to a pair that was drawn at random was predicted by the newest reward model before it was given; "
        "the share predicted correctly is the model's accuracy on data that it had not seen.",
        "Pairs that were asked twice measure how far participants agreed with themselves."
        if settings.repeated_pairs
        else "Test-retest agreement was not measured: no pair was asked twice.",
    )


def _deviations(study: Study, plan: Plan) -> Iterator[str]:
    if plan.locked_at is not None:
        yield (
            f"Settings, plan of pairs, stopping rule and tests were locked on {day(plan.locked_at)} (SHA-256 of the "
            f"document: `{study.lock_hash}`)."
        )
    yield plan.in_words
    if plan.deviations:
        when = {True: ", after the first rating", False: ""}
        yield "\n".join(
            f"* {day(each.at)}{when[plan.seen_before(each)]}: changed "
            f"{listed(name.replace('_', ' ') for name in each.after)}. Reason: {quoted(each.reason)}"
            for each in plan.deviations
        )
    elif plan.locked_at is not None:
        yield "No setting was changed after locking."


def _analysis(study: Study, plan: Plan) -> Iterator[str]:
    evaluation = evaluation_plan.settings_of(study)
    if evaluation is None:
        yield "No tests were planned: nothing was compared."
        return
    planned = "; ".join(TEST_NAMES[test] for test in plan.planned)
    yield paragraph(
        f"Planned tests: {planned}. Every other test is exploratory."
        if plan.planned
        else "No test was planned; all are exploratory.",
        "Tests compared every two methods on each scale, two-sided and at a level of 5 %; p values were corrected by "
        "Holm's method over the comparisons of one scale and one test, those included that could not be computed. "
        "The two-sample t-test, "
        "which counts every rating as if a different person had given it, was computed as in the paper on PbARL and "
        "not corrected.",
        "Within people, from each person's mean rating of a method: Student's paired t-test (Cohen's d_z with its "
        "exact interval) and Wilcoxon's signed-rank test (exact given ties; matched-pairs rank-biserial correlation "
        "with an approximate interval); from all ratings, a linear mixed model with random intercepts and slopes for "
        "people, estimated in two stages (Paule-Mandel, Hartung-Knapp).",
        "Beside it, ratings as ordered categories: a cumulative link mixed model (proportional odds, random intercept "
        "for people, maximum likelihood) with a sandwich covariance over people and t with people less "
        "one degrees of freedom.",
        f"Equivalence: two one-sided paired t-tests with bounds of ±{study.settings.equivalence_bound:g} points, at "
        "5 % each.",
        "Between arms: Welch's t-test (Hedges' g), a permutation test of its statistic, the cumulative link model with "
        "a variance for each arm and Welch's degrees of freedom, and equivalence by two one-sided Welch tests with the "
        "same bounds; all without people who met both methods."
        if study.settings.arms
        else "",
        "Order and carryover: F tests of the analysis of variance of a crossover (person, method, period; then the "
        "method before).",
        "Head-to-heads: Bradley-Terry strengths, an equal answer as half a win for each, with a sandwich variance over "
        "people corrected for the people whom a difference rests on (Bell and McCaffrey 2002), t with Satterthwaite's "
        "degrees of freedom; where no finite strength fits or all answered alike, each person's share of wins, with "
        "Wilson's interval of its mean (people as trials) and Wilcoxon's exact signed-rank test; Holm's method over "
        "all comparisons."
        if evaluation.head_to_heads
        else "",
        "Which robot was made for them: exact two-sided binomial test against chance."
        if evaluation.ask_which_is_theirs
        else "",
        "Questionnaires: scores as published, with Cronbach's alpha and McDonald's omega, and of those about robots "
        "paired t-tests and Wilcoxon's test between methods."
        if study.settings.all_instruments
        else "",
        "Between arms scores are compared by Welch's t and the permutation test; questionnaires at the end are not."
        if study.settings.all_instruments and study.settings.arms
        else "",
        "Intervals are 95 % intervals.",
    )


def _provenance(study: Study) -> Iterator[str]:
    yield paragraph(
        f"The study ran on PbARL Studio; this text was written by version {export_formats.software_version()}"
        + (
            f", the plan was locked with version {study.lock_document.get('software_version', 'unknown')}."
            if study.lock_document
            else "."
        ),
        f"Seed of the study: {study.seed}.",
        f"Lock hash: `{study.lock_hash or export_formats.NOT_LOCKED}`.",
        "The export of the study has all tables as CSV files, and `analysis.py` and `analysis.R`, which compute every "
        "table and figure of the results from them.",
    )
