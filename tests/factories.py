"""Rows for tests, made in one line each, with whatever the test does not care about filled in."""

import hashlib
import io
from collections.abc import Sequence
from datetime import timedelta
from functools import lru_cache
from typing import Any
from uuid import uuid4

import av
import numpy as np
from PIL import Image
from sqlalchemy import func, select
from sqlalchemy.orm import Session

from app.db import now
from app.domain.clips import Clip, Rollout
from app.domain.evaluation import Controller, Film, Rating, Trial
from app.domain.models import Bundle, Model, ModelKind, Run, RunKind, RunStatus
from app.domain.people import Experimenter, Role, StudyRole
from app.domain.preferences import LabelEvent, Query, Response
from app.domain.protocol import EvaluationMode, Stage
from app.domain.self_setting import PreviewFilm
from app.domain.studies import Participant, Study
from app.domain.study_settings import StudySettings
from app.services.evaluation import evaluation_plan
from app.services.participants import enrolment, stages
from app.services.studies import membership, studies
from app.storage import ArtefactStore

FPS = 10
FRAMES = 20
WIDTH, HEIGHT = 160, 120
AXES = {"speed_far": [-0.5, 0.4], "press": [-0.4, 0.4], "hesitate": [0.0, 0.6]}
"""Of make_previews: the last one has one direction."""


def make_study(session: Session, name: str = "Feeding at home", **settings: Any) -> Study:
    """A study; few labels and a small pool unless told otherwise, and answers need not wait for the end of a clip."""
    usual = {
        "labels_per_participant": 10,
        "pool_scenarios": 4,
        "behaviours_per_scenario": 4,
        "strategy": "uniform",
        "random_share": 0.5,
        "filter_milestones": (),
        "answer_after_first_play": False,
        "clip_quality": "quick",
    }
    return studies.create_study(session, name, StudySettings(**{**usual, **settings}), seed=7)


def make_participant(session: Session, study: Study, *, ready: bool = True) -> tuple[Participant, str]:
    """A participant and the token of the link; ``ready`` has agreed and read the instructions."""
    participant, token = enrolment.add_participant(session, study)
    if ready:
        participant.consented_at = participant.instructed_at = now()
        participant.consent_version = study.settings.consent_version
    return participant, token


def make_clip(session: Session, store: ArtefactStore, study: Study, made_for: Participant | None = None) -> Clip:
    """A clip with real files, different from every other of its study; of the pool, or made for one person."""
    number = session.scalar(select(func.count(Clip.id))) or 0
    rollout = Rollout(
        study_id=study.id,
        participant_id=made_for.id if made_for else None,
        scenario=number // 2,
        behaviour=number % 2,
        mode={},
        trajectory_sha256=hashlib.sha256(f"trajectory {number}".encode()).hexdigest(),
        success=True,
    )
    session.add(rollout)
    session.flush()
    video, poster = moving_picture(number)
    clip = Clip(
        rollout_id=rollout.id,
        first_step=0,
        step_count=FRAMES,
        video_sha256=store.put(video),
        poster_sha256=store.put(poster),
        width=WIDTH,
        height=HEIGHT,
        fps=FPS,
        duration_ms=1000 * FRAMES // FPS,
        byte_count=len(video),
    )
    session.add(clip)
    session.flush()
    return clip


def make_query(
    session: Session, participant: Participant, left: Clip, right: Clip, predicted_right: float | None = None
) -> Query:
    """The participant's next query, not served yet."""
    ordinal = session.scalar(select(func.max(Query.ordinal)).where(Query.participant_id == participant.id))
    query = Query(
        participant_id=participant.id,
        ordinal=(ordinal or 0) + 1,
        left_clip_id=left.id,
        right_clip_id=right.id,
        strategy="uniform",
        propensity=1.0,
        predicted_right=predicted_right,
    )
    session.add(query)
    session.flush()
    return query


def make_queries(session: Session, store: ArtefactStore, participant: Participant, count: int) -> Sequence[Query]:
    """Queries of different clips, enough for ``count`` answers."""
    study = session.get_one(Study, participant.study_id)
    clips = [make_clip(session, store, study) for _ in range(count + 1)]
    return [make_query(session, participant, clips[index], clips[index + 1]) for index in range(count)]


def make_label(
    session: Session, query: Query, response: Response = Response.LEFT, ago: timedelta = timedelta(0), **event: Any
) -> LabelEvent:
    """An answer to the query, given so long ago."""
    query.served_at = query.served_at or now() - ago
    given = session.scalar(select(func.count(LabelEvent.id)).where(LabelEvent.query_id == query.id)) or 0
    label = LabelEvent(
        query_id=query.id,
        revision=given + 1,
        response=response,
        client_uuid=str(uuid4()),
        created_at=now() - ago,
        **event,
    )
    session.add(label)
    session.flush()
    return label


def make_run(session: Session, study: Study, participant: Participant | None = None, **columns: Any) -> Run:
    """A run of the worker; a finished reward training unless told otherwise."""
    number = session.scalar(select(func.count(Run.id)))
    usual = {"kind": RunKind.REWARD, "status": RunStatus.SUCCEEDED, "label_count": 10, "seed": 1, "finished_at": now()}
    usual["workflow_id"] = f"run/{number}"
    run = Run(
        study_id=study.id,
        participant_id=participant.id if participant else None,
        **{**usual, **columns},
    )
    session.add(run)
    session.flush()
    return run


def make_model(
    session: Session, study: Study, participant: Participant, kind: ModelKind, metrics: dict[str, Any], labels: int = 10
) -> Model:
    """A model with its run."""
    run = make_run(session, study, participant, kind=RunKind(kind.value), label_count=labels)
    model = Model(
        run_id=run.id,
        participant_id=participant.id,
        kind=kind,
        artefact_sha256="0" * 64,
        label_count=labels,
        label_hash="0" * 64,
        seed=1,
        metrics=metrics,
    )
    session.add(model)
    session.flush()
    return model


def make_bundle(session: Session, store: ArtefactStore, model: Model, content: bytes = b"PK a bundle") -> Bundle:
    """The published export of a filter."""
    newest = session.scalar(select(func.max(Bundle.version)).where(Bundle.participant_id == model.participant_id))
    bundle = Bundle(
        participant_id=model.participant_id,
        version=(newest or 0) + 1,
        model_id=model.id,
        artefact_sha256=store.put(content),
        byte_count=len(content),
    )
    session.add(bundle)
    session.flush()
    return bundle


def make_film(
    session: Session,
    store: ArtefactStore,
    participant: Participant,
    method: str,
    model: Model | None = None,
    scenario: int | None = None,
    picture: int | None = None,
) -> Film:
    """A method in a scenario, filmed; usually the first of those in which people see before and after.

    ``picture``: what it looks like; otherwise each looks different.
    """
    number = session.scalar(select(func.count(Film.id))) or 0
    video, poster = moving_picture(1000 + (number if picture is None else picture))
    film = Film(
        participant_id=participant.id,
        method=method,
        model_id=model.id if model else None,
        scenario=evaluation_plan.comparison_scenarios(participant)[0] if scenario is None else scenario,
        success=True,
        trajectory_sha256=store.put(f"trajectory of film {number}".encode()),
        video_sha256=store.put(video),
        poster_sha256=store.put(poster),
        width=WIDTH,
        height=HEIGHT,
        fps=FPS,
        duration_ms=1000 * FRAMES // FPS,
        byte_count=len(video),
    )
    session.add(film)
    session.flush()
    return film


def make_controller(session: Session, store: ArtefactStore, participant: Participant, method: str) -> Controller:
    """A method packed for a robot."""
    content = f"PK a robot of {participant.code} that acts as {method}".encode()
    controller = Controller(
        participant_id=participant.id, method=method, artefact_sha256=store.put(content), byte_count=len(content)
    )
    session.add(controller)
    session.flush()
    return controller


def answer_everything(session: Session, store: ArtefactStore, study: Study, participant: Participant) -> None:
    """Every pair answered, so that the evaluation is next."""
    for query in make_queries(session, store, participant, study.settings.question_count):
        make_label(session, query)


def make_robots(
    session: Session, store: ArtefactStore, study: Study, participant: Participant, picture: int | None = None
) -> Sequence[Trial]:
    """The evaluation drawn, and everything there that it shows: films or controllers. Returns the trials.

    ``picture``: what all films look like; otherwise each looks different.
    """
    settings = evaluation_plan.settings_for(study, participant.arm)
    if settings is None:
        raise ValueError("This study evaluates nothing.")
    evaluation_plan.draw(session, study, participant)
    methods = {each.letter: each.method for each in evaluation_plan.assignments_of(session, participant.id)}
    trials = evaluation_plan.trials_of(session, participant.id)
    if settings.mode is EvaluationMode.PHYSICAL:
        for method in methods.values():
            make_controller(session, store, participant, method)
        return trials
    for trial in trials:
        method = methods[trial.letter]
        trial.film = make_film(session, store, participant, method, scenario=trial.scenario, picture=picture)
    session.flush()
    return trials


def make_previews(session: Session, store: ArtefactStore, study: Study, modes: Sequence[dict[str, float]]) -> None:
    """What people who set a robot themselves are shown: the axes, and a film of each of these modes."""
    study.mode_axes = dict(AXES)
    for number, mode in enumerate(modes):
        video, poster = moving_picture(number)
        session.add(
            PreviewFilm(
                study_id=study.id,
                number=number,
                mode=dict.fromkeys(AXES, 0.0) | mode,
                video_sha256=store.put(video),
                poster_sha256=store.put(poster),
                width=WIDTH,
                height=HEIGHT,
                fps=FPS,
                duration_ms=1000 * FRAMES // FPS,
                byte_count=len(video),
            )
        )
    session.flush()


def rate_everything(session: Session, trials: Sequence[Trial]) -> None:
    """A rating of each of these."""
    for trial in trials:
        session.add(Rating(trial_id=trial.id, revision=1, satisfaction=4, personalisation=3, client_uuid=str(uuid4())))
    session.flush()


def make_rated_trials(session: Session, participant: Participant, count: int) -> None:
    """More trials of the participant, with a rating each."""
    known = session.scalar(select(func.count(Trial.id)).where(Trial.participant_id == participant.id)) or 0
    for ordinal in range(known + 1, known + count + 1):
        trial = Trial(participant_id=participant.id, ordinal=ordinal, letter="A", repetition=ordinal, scenario=ordinal)
        session.add(trial)
        session.flush()
        rate_everything(session, [trial])


def finish_everything(session: Session, participant: Participant, study: Study) -> None:
    """Everything that the participant is asked is done; their queries are there."""
    participant.study = study
    participant.consented_at = participant.instructed_at = now()
    participant.consent_version = study.settings.consent_version
    for query in session.scalars(select(Query).where(Query.participant_id == participant.id)).all():
        make_label(session, query)
    if study.settings.evaluation is not None:
        make_rated_trials(session, participant, study.settings.evaluation.trial_count)
    for stage in (Stage.SELF_SETTING, Stage.DEMOGRAPHICS, Stage.QUESTIONNAIRE, Stage.DEBRIEF):
        stages.finish(session, participant, stage)
        session.flush()


def filter_metrics(scenarios: int = 100) -> dict[str, Any]:
    """Metrics of a filter as the worker writes them."""
    costs = {
        "C_d": {"reference": 21.4, "filter": 23.9, "delta": 2.5, "low": 1.1, "high": 3.9},
        "C_v": {"reference": 8.31, "filter": 4.87, "delta": -3.44, "low": -4.2, "high": -2.7},
        "C_f": {"reference": 0.12, "filter": 0.1, "delta": -0.02, "low": -0.09, "high": 0.04},
        "C_hf": {"reference": 1.94, "filter": 0.71, "delta": -1.23, "low": -1.9, "high": -0.6},
        "C_fd": {"reference": 0.31, "filter": 0.22, "delta": -0.09, "low": -0.22, "high": 0.05},
        "C_fdv": {"reference": 0.084, "filter": 0.041, "delta": -0.043, "low": -0.06, "high": -0.02},
    }
    return {
        "evaluation": {
            "scenarios": scenarios,
            "success": {"reference": 0.95, "filter": 0.94, "delta": -0.01, "low": -0.05, "high": 0.03},
            "preference": {"delta": 0.82, "low": 0.61, "high": 1.04},
            "costs": costs,
        },
        "gate": 0.85,
        "mode": {"speed_far": -0.42, "speed_near": -0.71, "from_below": 0.1, "to_side": -0.05, "press": -0.3},
        "method": "studio",
        "seconds": {"fit": 41.0},
        "notes": [],
        "promise": {"share": 0.05, "sentence": "With 95 % confidence, in at most 5 % of scenarios it is worse."},
    }


def reward_metrics() -> dict[str, Any]:
    """Metrics of a reward model as the worker writes them."""
    weights = {
        "speed_squared_m2_s2": {"mean": -1.42, "low": -1.8, "high": -1.05},
        "force_at_target_n": {"mean": -0.81, "low": -1.2, "high": -0.4},
        "distance_m": {"mean": -0.33, "low": -0.7, "high": 0.05},
        "spilled_on_person": {"mean": -0.29, "low": -0.66, "high": 0.1},
        "intake_speed_m_s": {"mean": 0.22, "low": 0.02, "high": 0.43},
    }
    return {"prequential": {"correct": 15, "scored": 20}, "weights": weights, "trained_on": 20, "fit_seconds": 1.2}


@lru_cache(maxsize=1000)
def moving_picture(number: int) -> tuple[bytes, bytes]:
    """A small H.264 video of a moving square and its poster; every number looks different."""
    frames = [_frame(number, step) for step in range(FRAMES)]
    video = io.BytesIO()
    with av.open(video, "w", format="mp4") as container:
        stream = container.add_stream("libx264", rate=FPS, options={"preset": "ultrafast", "crf": "30"})
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        container.mux(stream.encode())
    poster = io.BytesIO()
    Image.fromarray(frames[0]).save(poster, "JPEG")
    return video.getvalue(), poster.getvalue()


def _frame(number: int, step: int) -> "np.typing.NDArray[np.uint8]":
    frame = np.empty((HEIGHT, WIDTH, 3), np.uint8)
    frame[:] = np.array((214, 206, 196), np.uint8)
    frame[HEIGHT * 3 // 4 :] = np.array((176, 160, 144), np.uint8)
    at = 10 + (WIDTH - 40) * step // FRAMES
    up = 30 + (number * 17) % 50
    frame[up : up + 20, at : at + 20] = np.array(((number * 67) % 200, (number * 31) % 160, 90), np.uint8)
    return frame


def give_role(session: Session, role: Role, study_role: StudyRole = StudyRole.VIEWER) -> None:
    """Another role for every account, and in every study that there is."""
    for account in session.scalars(select(Experimenter)):
        account.role = role
        for study in session.scalars(select(Study)):
            membership.admit(session, study, account.name, study_role, "the test")
