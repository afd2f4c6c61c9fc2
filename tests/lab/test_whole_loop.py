"""A laboratory's task goes the whole way with the code of the built-in ones: ranges, clips, labels, filter, bundle."""

import io
import json
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from sqlalchemy import func, select
from sqlalchemy.orm import joinedload

from app.db import Database
from app.domain.clips import Clip
from app.domain.models import Bundle, Model, ModelKind, RunKind
from app.domain.preferences import LabelEvent, Response
from app.domain.protocol import EvaluationSettings
from app.domain.run_keys import RunKey
from app.domain.studies import Participant, Study
from app.domain.study_settings import StudySettings
from app.services.studies import studies
from app.storage import ArtefactStore
from app.web.texts.task_words import words_of
from tests import factories
from tests.lab.conftest import forget, way_to_goal, write_plane
from tests.worker.at_hand import AtHand, at_once
from worker.__main__ import main
from worker.compute import simulation
from worker.domain.trajectory import Trajectory
from worker.domain.type_aliases import Float32Array
from worker.experiments import fit_response_surface
from worker.jobs.clips.pool_clips import build_clips
from worker.jobs.learning import dataset, shared_filters
from worker.jobs.learning.filters import train_filter
from worker.jobs.learning.reward_models import train_reward
from worker.jobs.runtime import due_lending, records
from worker.jobs.runtime.context import Step, WorkerContext
from worker.jobs.runtime.records import Job
from worker.ml.export import bundle
from worker.sim.lab.errors import LabTaskBroken
from worker.tasks import registry

SCENARIOS, BEHAVIOURS = 5, 4
LABELS = SCENARIOS * BEHAVIOURS * (BEHAVIOURS - 1) // 2
Act = Callable[[WorkerContext, Job, int, Step], None]


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The plane with what the program has found out about it, from few scenarios."""
    folder = tmp_path_factory.mktemp("explored") / "plane_lab"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LAB_TASKS", str(write_plane(folder)))
        patch.setattr(fit_response_surface, "Compute", lambda _: AtHand())
        patch.setattr(fit_response_surface, "ROUNDS", 1)
        forget()
        fit_response_surface.explore("plane", folder.parent / "blocks", 1, scenarios=10)
        yield folder
    forget()


@pytest.fixture
def explored(found: Path, use: Callable[[Path], None], tmp_path: Path) -> Path:
    """A copy of it, in use."""
    folder = Path(shutil.copytree(found, tmp_path / "plane_lab"))
    use(folder)
    return folder


@pytest.fixture
def context(database: Database, store: ArtefactStore) -> WorkerContext:
    return WorkerContext(database, store, AtHand())


def make_study(
    context: WorkerContext, name: str = "On a plane", evaluation: EvaluationSettings | None = None
) -> tuple[int, int]:
    """A study of the plane and its participant, by id."""
    settings = StudySettings(
        labels_per_participant=LABELS,
        pool_scenarios=SCENARIOS,
        behaviours_per_scenario=BEHAVIOURS,
        clip_steps=40,
        filter_milestones=(),
        evaluation_scenarios=30,
        harm_share=0.5,
        strategy="uniform",
        evaluation=evaluation,
    )
    with context.database.writing() as session:
        study = studies.create_study(session, name, settings, task="plane", seed=3)
        person, _ = factories.make_participant(session, study)
        return study.id, person.id


def do(context: WorkerContext, act: Act, key: RunKey, study_id: int) -> None:
    job = Job(key, study_id)
    with context.database.writing() as session:
        run_id = records.begin_run(session, job, seed=1)
    act(context, job, run_id, at_once)


def lend(context: WorkerContext, study_id: int) -> None:
    """Draw whose robots everybody is shown, and fit what is fitted for several."""
    with context.database.writing() as session:
        due_lending.settle(session, study_id)
        jobs = due_lending.due(session, session.get_one(Study, study_id))
        runs = [records.begin_run(session, job, seed=1) for job in jobs]
    for job, run_id in zip(jobs, runs, strict=True):
        shared_filters.fit(context, job, run_id, at_once)


def film(context: WorkerContext, study_id: int) -> None:
    for scenario in range(SCENARIOS):
        do(
            context,
            build_clips,
            RunKey(RunKind.CLIPS, study_id=study_id, subject="scenario", number=scenario),
            study_id,
        )


def answer(context: WorkerContext, study_id: int, person_id: int, minds: dict[str, float]) -> None:
    """Every pair of the pool, by somebody who minds these signals, without mistakes."""
    names = registry.task("plane").signals
    with context.database.writing() as session:
        person, pairs = (
            session.get_one(Participant, person_id),
            dataset.matched_pairs(dataset.pool_clips(session, study_id)),
        )
        for left, right in pairs:
            cost = [weighed(dataset.shown(context.store, clip), names, minds) for clip in (left, right)]
            says = Response.LEFT if cost[0] < cost[1] else Response.RIGHT
            factories.make_label(session, factories.make_query(session, person, left, right), says)


def weighed(trajectory: Trajectory, names: tuple[str, ...], minds: dict[str, float]) -> float:
    sums = trajectory.signals.sum(axis=0)
    return float(sum(weight * sums[names.index(name)] for name, weight in minds.items()))


QUICK, SLOW = {"distance_m": 1.0}, {"speed_squared_m2_s2": 1.0}


@pytest.mark.slow
def test_from_a_lab_toml_to_bundles_that_serve_two_opposed_people(
    explored: Path, context: WorkerContext, tmp_path: Path
) -> None:
    bundles = {}
    for name, minds in (("quick", QUICK), ("slow", SLOW)):
        study_id, person_id = make_study(context, name)
        film(context, study_id)
        answer(context, study_id, person_id, minds)
        with context.database.reading() as session:
            last = f"answer-{session.scalar(select(func.max(LabelEvent.id)))}"
        for act, kind in ((train_reward, RunKind.REWARD), (train_filter, RunKind.FILTER)):
            do(context, act, RunKey(kind, participant_id=person_id, labels=LABELS, answers=last), study_id)
        with context.database.reading() as session:
            model = session.scalars(
                select(Model).where(Model.participant_id == person_id, Model.kind == ModelKind.FILTER)
            ).one()
            stored = context.store.read(
                session.scalars(select(Bundle).where(Bundle.model_id == model.id)).one().artefact_sha256
            )
        manifest = bundle.verify(stored)
        assert manifest["signals"] == list(registry.task("plane").signals)
        assert manifest["control_rate_hz"] == 10.0
        assert [field["name"] for field in manifest["action"]["fields"]] == ["x", "y"]
        assert set(manifest["evaluation"]["costs"]) == {"effort"}
        assert "max_force_n" not in manifest["evaluation"]["safety"], "nothing measures a force here"
        assert manifest["evaluation"]["success"]["delta"] >= -0.035
        bundles[name] = stored
    driven = {
        name: [run(stored, tmp_path / name, scenario) for scenario in range(20)] for name, stored in bundles.items()
    }
    names = registry.task("plane").signals
    for own, other, minds in (("quick", "slow", QUICK), ("slow", "quick", SLOW)):
        mine, theirs = (np.mean([weighed(each, names, minds) for each in driven[whose]]) for whose in (own, other))
        assert mine < theirs, f"{own} is served better by their own filter"


def run(stored: bytes, folder: Path, scenario: int) -> Trajectory:
    """An episode of the plane with the files of a bundle alone."""
    if not folder.exists():
        zipfile.ZipFile(io.BytesIO(stored)).extractall(folder)
        checked = subprocess.run(
            [sys.executable, "run_filter.py"], cwd=folder, capture_output=True, text=True, check=False
        )
        assert checked.returncode == 0, checked.stderr
    import onnxruntime

    policy, session = (onnxruntime.InferenceSession(folder / name) for name in ("policy.onnx", "filter.onnx"))

    def act(observation: Float32Array) -> Float32Array:
        (mean,) = policy.run(["policy_mean"], {"observation": observation[None]})
        filtered: Float32Array = session.run(["action"], {"observation": observation[None], "policy_mean": mean})[0][0]
        return filtered

    return simulation.lab_environment("plane").episode(act, scenario)


def test_ranges_are_found_and_written_beside_the_lab_toml(explored: Path) -> None:
    found = json.loads((explored / "checkpoint" / "found.json").read_text())
    assert found["reference"]["success"] == 1.0
    assert {axis["name"] for axis in found["axes"]} >= {"speed_far", "speed_near", "smooth"}
    assert all(axis["low"] <= 0 <= axis["high"] for axis in found["axes"])
    record = json.loads((explored / "checkpoint" / "response_surface.json").read_text())
    assert set(record["explained_share"]) <= set(registry.task("plane").signals)


def test_a_policy_that_goes_at_its_limit_is_told_of_for_nobody_could_have_it_quicker(
    plane: Path, use: Callable[[Path], None]
) -> None:
    text = (plane / "lab.toml").read_text()
    (plane / "lab.toml").write_text(text.replace("gain = 0.5", ""))
    (plane / "policy.onnx").write_bytes(way_to_goal(40.0))
    use(plane)
    fit_response_surface.find_ranges("plane", scenarios=4)
    note = registry.found_out("plane").notes[-1]
    assert "of the policy's actions are at their limit, so nobody can have it quicker. Set policy.gain below 1" in note


def test_a_policy_that_never_succeeds_has_no_ranges(
    plane: Path, use: Callable[[Path], None], capsys: pytest.CaptureFixture[str]
) -> None:
    text = (plane / "lab.toml").read_text()
    (plane / "lab.toml").write_text(text.replace("gain = 0.5", "gain = 0.001"))
    use(plane)
    with pytest.raises(LabTaskBroken, match="succeeded in none of 4 episodes"):
        fit_response_surface.find_ranges("plane", scenarios=4)
    assert main(["explore", "--task", "plane", "--work-directory", str(plane / "blocks")]) == 1
    assert "Error: success: the policy succeeded in none of 15 episodes" in capsys.readouterr().err


def test_what_was_found_for_another_lab_toml_is_not_used(explored: Path, use: Callable[[Path], None]) -> None:
    text = (explored / "lab.toml").read_text()
    (explored / "lab.toml").write_text(text.replace('title = "Plane"', 'title = "The plane"'))
    use(explored)
    assert registry.task("plane").title == "The plane", "words change nothing that was found"
    (explored / "lab.toml").write_text(text.replace("gain = 0.5", "gain = 0.4"))
    use(explored)
    with pytest.raises(
        registry.NotExplored, match="has changed since its ways were found: run python -m worker explore"
    ):
        registry.task("plane")


def test_an_unexplored_task_says_which_command_explores_it(plane: Path, use: Callable[[Path], None]) -> None:
    use(plane)
    with pytest.raises(registry.NotExplored, match="run python -m worker explore --task plane"):
        simulation.reference_policy("plane")


def test_a_stretch_filmed_again_shows_the_same(explored: Path, context: WorkerContext) -> None:
    study_id, _ = make_study(context)
    film(context, study_id)
    with context.database.reading() as session:
        clip = session.scalars(select(Clip).order_by(Clip.id).options(joinedload(Clip.rollout))).first()
        assert clip is not None
        trajectory, before = context.store.read(clip.rollout.trajectory_sha256), context.store.read(clip.video_sha256)
    again = simulation.film_again("quick", trajectory, 0, 40)
    assert again.video == before
    assert (again.fps, again.duration_ms) == (20, 4000), "40 steps at 10 Hz, each picture shown twice"


def test_there_are_words_for_everything_that_is_stored_about_it(explored: Path) -> None:
    words = words_of("plane")
    task = registry.task("plane")
    assert set(task.modes.names) <= set(words.axes)
    assert set(words.signals) == set(task.signals)
    assert dict(words.costs) == {"effort": "effort (m)"}


def test_exported_arrays_name_the_labs_own_signals(explored: Path, context: WorkerContext) -> None:
    study_id, _ = make_study(context)
    with context.database.reading() as session:
        assert dataset.signal_names(session.get_one(Study, study_id)) == registry.lab("plane").signal_names  # type: ignore[union-attr]
