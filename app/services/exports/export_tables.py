"""The tables of an export and what every column means; export_rows reads what stands in them."""

from collections.abc import Iterable, Sequence
from typing import Any

from app.domain.choices import Strategy
from app.domain.clips import Clip
from app.domain.designs import Ending
from app.domain.evaluation import DonorDraw, DonorRule, HeadToHead, HeadToHeadAnswer, HeadToHeadResponse, Rating, Trial
from app.domain.hints import HintEvent
from app.domain.models import Model, ModelKind
from app.domain.participation import Allocation, ConsentRecord, FormAnswer, ParticipantEvent, StageRecord
from app.domain.preferences import FOLLOWING, NO_LABELS, LabelEvent, Purpose, Query, Response, SkipReason
from app.domain.protocol import FROM_OTHERS, EvaluatedMethod, Stage
from app.domain.self_setting import SelfSetting
from app.domain.studies import Deviation, Participant
from app.questionnaires import library
from app.services.exports import export_rows
from app.services.exports.export_formats import Column, ColumnKind, Table

PARTICIPANT = Column("participant", ColumnKind.TEXT, "Code of the participant.", allowed="P01, P02, ...")
ORDINAL = Column("ordinal", ColumnKind.INTEGER, "Place of the pair in this participant's order.", allowed="from 1")
SHA256 = "64 hexadecimal digits"
WITHOUT_SCRIPT = (
    "Whether the page's script sent it. False: a browser without script, where nothing is measured and nothing "
    "waits until the clips were seen. Empty: taken back, or from a version that did not note it."
)


def _words(values: Iterable[Any]) -> str:
    return ", ".join(value.value for value in values)


MEASURED_METHODS = [each for each in EvaluatedMethod if each is not EvaluatedMethod.REFERENCE]
T, I, N = ColumnKind.TEXT, ColumnKind.INTEGER, ColumnKind.NUMBER  # noqa: E741
B, W, J = ColumnKind.BOOLEAN, ColumnKind.TIME, ColumnKind.JSON

TABLES: Sequence[Table] = (
    Table(
        "participants",
        "One row per participant, including tombstones of those who withdrew.",
        (
            PARTICIPANT,
            Column("status", T, "How far they have come.", allowed="invited, consented, completed, withdrawn"),
            Column("seed", I, "Seed of everything that is drawn for this person."),
            Column("language", T, "Language of the pages.", allowed="en, de"),
            Column("invited_at", W, "When the personal link was made."),
            Column("consented_at", W, "When they agreed."),
            Column("consent_version", T, "Version of the text they agreed to."),
            Column("instructed_at", W, "When they had read the instructions."),
            Column("completed_at", W, "When they had finished everything."),
            Column("last_seen_at", W, "When their browser last asked for anything."),
            Column("panel_id", T, "Their id at the recruitment panel, if they came through one. Personal data."),
            Column("withdrawn_at", W, "When they withdrew; nothing else about them is kept."),
            Column(
                "scripted_as", T, "The user that a program played; no person has answered or rated. Empty: a person."
            ),
            Column("arm", T, "Between subjects: the arm; empty until the study is unblinded."),
            Column("ended_as", T, "Why they were sent back before the end.", allowed=_words(Ending)),
            Column("visit", I, "Which visit of theirs this study is.", allowed="from 1"),
            Column(
                "earlier_participant", T, "Their code at the visit before, in the study that this one goes on from."
            ),
        ),
        export_rows.participants,
        (Participant,),
    ),
    Table(
        "allocations",
        "Between subjects: how each participant came into their arm; no rows until the study is unblinded.",
        (
            PARTICIPANT,
            Column("arm", T, "Into which arm."),
            Column("place", I, "In the arm, from 1; decides in which order they met its methods."),
            Column(
                "lot",
                N,
                "Picked among the open arms with the smallest completed + on_their_way - silent, of these the fewest "
                "silent. The first 13 hexadecimal digits of SHA-256 of <secret>/evaluation/arm/<number of the "
                "participant>, divided by 16^13.",
                allowed="0 to 1",
            ),
            Column("considered", J, "By arm, as it was then: completed, on_their_way, of these silent, open."),
            Column("allocated_at", W, "When."),
        ),
        export_rows.allocations,
        (Allocation,),
        grows_by=Allocation,
    ),
    Table(
        "stages",
        "When each participant entered and finished each stage.",
        (
            PARTICIPANT,
            Column("stage", T, "Which stage.", allowed=_words(Stage)),
            Column("entered_at", W, "When it was first shown."),
            Column(
                "finished_at",
                W,
                "When it was finished; empty for stages that are counted instead (practice, pairs, evaluation).",
            ),
        ),
        export_rows.stages,
        (StageRecord,),
    ),
    Table(
        "queries",
        "One row per pair that was made for a participant, with the answer that counts.",
        (
            PARTICIPANT,
            ORDINAL,
            Column(
                "purpose", T, "Why it is shown; only introduction and preference are learned from.", "", _words(Purpose)
            ),
            Column("repeats_ordinal", I, "Of a repeat: the ordinal of the pair that it asks again."),
            Column("sides_swapped", B, "Of a repeat: whether the clips have exchanged sides."),
            Column("expected", T, "Of a catch pair: the obvious answer.", allowed="left, right"),
            Column(
                "left_scenario", I, "Situation of the left clip; with the behaviour it names the clip (table clips)."
            ),
            Column("left_behaviour", I, "Way of doing the task on the left."),
            Column("right_scenario", I, "Situation of the right clip; usually the same."),
            Column("right_behaviour", I, "Way of doing the task on the right."),
            Column("left_steps", I, "Length of the left clip.", "control steps"),
            Column("right_steps", I, "Length of the right clip.", "control steps"),
            Column("left_video_sha256", T, "The video that was shown on the left.", allowed=SHA256),
            Column("right_video_sha256", T, "The video that was shown on the right.", allowed=SHA256),
            Column(
                "strategy",
                T,
                "How the pair was chosen: at random (uniform), by a rule, or following the person: their robot as it "
                "would have been then, beside a variation of it, made for them alone. The last four are no pairs for "
                "labels.",
                allowed=", ".join((*Strategy, FOLLOWING, *NO_LABELS)),
            ),
            Column(
                "propensity",
                N,
                "Probability with which it was chosen from the candidates: over all ways in which a label's pair could "
                "be chosen at that moment, not only the one that it was.",
                allowed="0 to 1",
            ),
            Column(
                "predicted_right",
                N,
                "P(right preferred) by the newest model that had not seen this pair's answer; empty without one.",
                allowed="0 to 1",
            ),
            Column("predicted_from_labels", I, "How many answers that model had learned from."),
            Column("served_at", W, "When it was first shown."),
            Column(
                "response", T, "The answer that counts; empty: not answered, or taken back.", allowed=_words(Response)
            ),
            Column("reason", T, "Why they could not tell (skip).", allowed=_words(SkipReason)),
            Column("response_time_ms", I, "From the first frame of both videos to the answer.", "ms"),
            Column("answered_at", W, "When that answer reached the server."),
            Column("revisions", I, "Number of answers and undos of this pair; the table labels has them all."),
            Column("is_label", B, "Whether the answer is learned from."),
            Column("excluded", B, "Whether an experimenter has left the answer out of learning and statistics."),
            Column("exclusion_reason", T, "Why, in their words."),
        ),
        export_rows.queries,
        (Query, LabelEvent),
    ),
    Table(
        "labels",
        "Every answer and every undo as it came in, including those that no longer count.",
        (
            PARTICIPANT,
            ORDINAL,
            Column("purpose", T, "Purpose of the pair.", allowed=_words(Purpose)),
            Column("revision", I, "First, second, ... answer or undo of this pair.", allowed="from 1"),
            Column(
                "response", T, "What was said; empty: the previous answer was taken back.", allowed=_words(Response)
            ),
            Column("superseded", B, "Whether a later answer or undo of this pair counts instead."),
            Column("reason", T, "Why they could not tell (skip).", allowed=_words(SkipReason)),
            Column("mattered", T, "What they said made the difference; empty: nothing, or nobody asked."),
            Column("response_time_ms", I, "From the first frame of both videos to the answer.", "ms"),
            Column("replay_count", I, "How often the clips were started again."),
            Column("scrub_count", I, "How often somebody moved through the clips by hand."),
            Column("playback_rate", N, "Speed at the moment of the answer; 1 is real time.", allowed="0.25 to 2"),
            Column("watched_whole", B, "Whether both clips had been seen from beginning to end."),
            Column("left_watched_ms", I, "How much of the left clip had been played, in its own time.", "ms"),
            Column("right_watched_ms", I, "How much of the right clip had been played, in its own time.", "ms"),
            Column("play_error_count", I, "Clips that could not be loaded or played."),
            Column("stall_count", I, "How often a clip had to wait for the network."),
            Column("stalled_ms", I, "How long it waited altogether.", "ms"),
            Column(
                "largest_drift_ms",
                I,
                "How far the two clips were apart at most, before they were synchronised.",
                "ms",
            ),
            Column("by_script", B, WITHOUT_SCRIPT),
            Column("created_at", W, "When it reached the server."),
            Column("excluded", B, "Whether an experimenter has left this answer out of learning and statistics."),
        ),
        export_rows.labels,
        (LabelEvent,),
        grows_by=LabelEvent,
    ),
    Table(
        "hints",
        "Every set of hints that a participant gave beside their answers; the last one counts.",
        (
            PARTICIPANT,
            Column("revision", I, "First, second, ... set of this participant.", allowed="from 1"),
            Column("hints", T, "Names of the hints, as the task calls them; empty: nothing special."),
            Column("superseded", B, "Whether a later set counts instead."),
            Column("answered", I, "How many answers this participant had given, practice not counted."),
            Column("offered", T, "Everything that could be ticked, in the order of this participant's page."),
            Column("created_at", W, "When it reached the server."),
        ),
        export_rows.hints,
        (HintEvent,),
        grows_by=HintEvent,
    ),
    Table(
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
            Column(
                "method", T, "Which method that was; empty until the study is unblinded.", "", _words(EvaluatedMethod)
            ),
            Column("item", T, "Name of the question."),
            Column("value", T, "What was entered (likert: 1 to 5), nothing reversed; empty: skipped."),
            Column("superseded", B, "Whether a later answer to the same question counts instead."),
            Column("created_at", W, "When it reached the server."),
        ),
        export_rows.forms,
        (FormAnswer,),
        grows_by=FormAnswer,
    ),
    Table(
        "scores",
        "Scores of standard questionnaires, by their keys, which questionnaires.md in the file of all data has.",
        (
            PARTICIPANT,
            Column("instrument", T, "Which questionnaire.", allowed=", ".join(library.every())),
            Column("letter", T, "The robot of the evaluation that it is about; empty: about none.", "", "A to E"),
            Column(
                "method", T, "Which method that was; empty until the study is unblinded.", "", _words(EvaluatedMethod)
            ),
            Column("score", T, "Which scale or subscale."),
            Column("value", N, "The score; empty: too much was left out for one."),
            Column("lowest", N, "The lowest value it can have."),
            Column("highest", N, "The highest value it can have."),
            Column("items", I, "Items that it is made of."),
            Column("answered", I, "How many of them were answered."),
        ),
        export_rows.scores,
        (FormAnswer,),
    ),
    Table(
        "consent",
        "The consent text each participant agreed to, word for word.",
        (
            PARTICIPANT,
            Column("version", T, "Version of the text."),
            Column("language", T, "Language of the text.", allowed="en, de"),
            Column("agreed_at", W, "When they agreed."),
            Column("text", T, "The text, word for word."),
        ),
        export_rows.consent,
        (ConsentRecord,),
        grows_by=ConsentRecord,
    ),
    Table(
        "events",
        "What happened besides answers: breaks, hidden pages, clips that would not play.",
        (
            PARTICIPANT,
            Column("at", W, "When it happened."),
            Column("kind", T, "What happened; app/services/participant_events.py says what each kind means."),
            Column("detail", J, "Numbers that belong to it."),
        ),
        export_rows.events,
        (ParticipantEvent,),
        grows_by=ParticipantEvent,
    ),
    Table(
        "ratings",
        "Every trial of the blinded evaluation with its rating; a corrected rating has one row per revision.",
        (
            PARTICIPANT,
            Column(
                "letter",
                T,
                "The letter the participant knew the method by, in the order of appearance.",
                "",
                "A to E",
            ),
            Column(
                "method", T, "Which method it was; empty until the study is unblinded.", allowed=_words(EvaluatedMethod)
            ),
            Column("repetition", I, "Which trial of this method.", allowed="from 1"),
            Column("order", I, "Place of the trial among all trials of this participant.", allowed="from 1"),
            Column("scenario", I, "Situation; the same for all methods of a participant and repetition."),
            Column("satisfaction", I, "Overall satisfaction.", allowed="1 to 5; empty: not rated"),
            Column("personalisation", I, "How personalised the robot seemed.", allowed="1 to 5; empty: not rated"),
            Column(
                "reason",
                T,
                "Why, in their own words; empty: not asked, or left empty.",
                allowed="up to 1000 characters",
            ),
            Column("counts", B, "Whether this rating counts: false if it was corrected later, or if there is none."),
            Column("revision", I, "First, second, ... rating of this trial.", allowed="from 1"),
            Column(
                "response_time_ms", I, "From the moment the scales were shown to the moment the rating was sent.", "ms"
            ),
            Column("by_script", B, WITHOUT_SCRIPT),
            Column("rated_at", W, "When it reached the server."),
            Column("shown_at", W, "Video: when the film was first shown."),
            Column("started_at", W, "Physical: when the operator started the robot."),
            Column("finished_at", W, "Physical: when the operator said that it was done."),
            Column("success", B, "Video: whether the robot succeeded; empty until the study is unblinded."),
        ),
        export_rows.ratings,
        (Trial, Rating),
        grows_by=Rating,
    ),
    Table(
        "headtoheads",
        "Every head-to-head of two rated robots with its answer; a changed answer has one row per revision.",
        (
            PARTICIPANT,
            Column("order", I, "Place among all head-to-heads of this participant.", allowed="from 1"),
            Column("left_letter", T, "Letter of the robot on the left; it was not shown.", allowed="A to E"),
            Column("right_letter", T, "Letter of the robot on the right; it was not shown.", allowed="A to E"),
            Column(
                "left_method", T, "Method on the left; empty until the study is unblinded.", "", _words(EvaluatedMethod)
            ),
            Column(
                "right_method",
                T,
                "Method on the right; empty until the study is unblinded.",
                allowed=_words(EvaluatedMethod),
            ),
            Column("repetition", I, "Whose films these are: the repetition of both rated trials.", allowed="from 1"),
            Column("scenario", I, "Situation; the same on both sides."),
            Column(
                "response",
                T,
                "Which one they would rather have; empty: not answered.",
                allowed=_words(HeadToHeadResponse),
            ),
            Column(
                "reason",
                T,
                "Why, in their own words; empty: not asked, or left empty.",
                allowed="up to 1000 characters",
            ),
            Column("counts", B, "Whether this answer counts: false if it was changed later, or if there is none."),
            Column("revision", I, "First, second, ... answer to this head-to-head.", allowed="from 1"),
            Column("response_time_ms", I, "From the first frame of both films to the answer.", "ms"),
            Column("by_script", B, WITHOUT_SCRIPT),
            Column("answered_at", W, "When it reached the server."),
            Column("shown_at", W, "When both films were first shown."),
        ),
        export_rows.headtoheads,
        (HeadToHead, HeadToHeadAnswer),
        grows_by=HeadToHeadAnswer,
    ),
    Table(
        "settings",
        "Every setting of the sliders that a participant let go of, for the method self_set; one row per axis.",
        (
            PARTICIPANT,
            Column("revision", I, "First, second, ... setting of this participant.", allowed="from 1"),
            Column("axis", T, "Axis of the task's execution modes."),
            Column(
                "place",
                I,
                "Where the slider stood; 0 is the reference policy's own way, which is where all begin.",
                allowed="-4 to 4; 0 to 4 where an axis has one direction",
            ),
            Column("value", N, "The axis' value, in its own unit."),
            Column("counts", B, "Whether this is what the robot was made of: the last one of who has gone on."),
            Column(
                "moved", T, "Whose slider was let go of; empty: several, none, or a browser without script.", allowed=""
            ),
            Column("filmed", B, "Whether exactly this setting had been filmed when it was saved."),
            Column("response_time_ms", I, "From the opening of the page, or the setting before, to this one.", "ms"),
            Column("by_script", B, WITHOUT_SCRIPT),
            Column("saved_at", W, "When it reached the server."),
        ),
        export_rows.settings,
        (SelfSetting,),
        grows_by=SelfSetting,
    ),
    Table(
        "donors",
        "Whose filter a participant was shown as somebody_else and average; no rows until the study is unblinded.",
        (
            PARTICIPANT,
            Column("method", T, "As what it was shown.", allowed=_words(FROM_OTHERS)),
            Column(
                "rule",
                T,
                "How it was drawn. by_lot: one of the candidates, nobody much more often than others. mean_of_people: "
                "all candidates. type_of_user, mean_of_types: there were too few candidates. withdrew: whose it was "
                "has withdrawn since.",
                allowed=_words(DonorRule),
            ),
            Column("people", T, "Codes of those whose filter, or whose wishes, these are; separated by spaces."),
            Column("types", T, "The paper's types of users whose wishes these are; separated by spaces."),
            Column("candidates", T, "Codes of those who could have been drawn, without who has withdrawn since."),
            Column("drawn_at", W, "When it was drawn: in the second half of the participant's answers, or later."),
        ),
        export_rows.donors,
        (DonorDraw,),
    ),
    Table(
        "models",
        "Every model that was trained for a participant.",
        (
            PARTICIPANT,
            Column("kind", T, "Kind of model.", allowed=_words(ModelKind)),
            Column(
                "label_count",
                I,
                "Answers given by then, including excluded ones and those without a preference.",
            ),
            Column("label_hash", T, "Hash of these answers.", allowed=SHA256),
            Column("seed", I, "Seed of the training."),
            Column(
                "artefact_sha256", T, "The stored file; empty for methods while the study is blinded.", allowed=SHA256
            ),
            Column("created_at", W, "When it was ready."),
            Column("metrics", J, "What was measured while training."),
        ),
        export_rows.models,
        (Model,),
        grows_by=Model,
    ),
    Table(
        "evaluations",
        "What each filter, and each method it is compared with, changes on unseen simulated scenarios, against the "
        "reference policy; one row per measure.",
        (
            PARTICIPANT,
            Column(
                "method",
                T,
                "pbarl: the participant's own filter.",
                allowed=_words(MEASURED_METHODS),
            ),
            Column("label_count", I, "Answers it has learned from, or the participant had given."),
            Column("newest", B, "Whether it is the participant's newest of the method."),
            Column("bundle_version", I, "Version of the published bundle, if there is one."),
            Column("scenarios", I, "Unseen scenarios it was measured on."),
            Column(
                "measure",
                T,
                "success: share of scenarios. preference: learned return, in standard deviations of the reference's. "
                "C_*: the paper's costs, summed per episode.",
                allowed="success, preference, C_d, C_v, C_f, C_hf, C_fd, C_fdv",
            ),
            Column("reference", N, "Mean with the reference policy; empty for preference."),
            Column("filtered", N, "Mean with the filter; empty for preference."),
            Column("delta", N, "Mean difference, filtered minus reference, paired by scenario."),
            Column("low", N, "Lower end of the 95 % interval of the difference."),
            Column("high", N, "Upper end."),
        ),
        export_rows.evaluations,
        (Model,),
    ),
    Table(
        "clips",
        "The pool of clips that pairs are made of.",
        (
            Column("video_sha256", T, "The video.", allowed=SHA256),
            Column("scenario", I, "Situation: its seed, or the number given when clips were imported."),
            Column("behaviour", I, "Way of doing the task in this situation.", allowed="from 0"),
            Column("mode", J, "What the behaviour is."),
            Column("success", B, "Whether the whole trajectory succeeded."),
            Column("first_step", I, "First control step that is shown."),
            Column("step_count", I, "How many steps are shown.", "control steps"),
            Column("duration_ms", I, "Length of the video.", "ms"),
            Column("fps", I, "Frames per second.", "1/s"),
            Column("trajectory_sha256", T, "The stored trajectory.", allowed=SHA256),
            Column("made_for", T, "Participant for whom alone it was made; empty: it is of the study's pool."),
        ),
        export_rows.clips,
        (Clip,),
    ),
    Table(
        "deviations",
        "Changes to the study after it was locked.",
        (
            Column("at", W, "When it was made."),
            Column("actor", T, "Account that made it."),
            Column("reason", T, "Why, in their words."),
            Column("before", J, "The changed settings, as they were."),
            Column("after", J, "The changed settings, as they are since."),
        ),
        export_rows.deviations,
        (Deviation,),
        grows_by=Deviation,
    ),
)
BY_NAME = {table.name: table for table in TABLES}
