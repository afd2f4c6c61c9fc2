"""A policy behind a websocket goes the whole way: ranges, clips, labels, filter, blinded films, a bundle that runs."""

import io
import subprocess
import sys
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from sqlalchemy import func, select

from app.db import Database
from app.domain.models import Bundle, Model, ModelKind, RunKind
from app.domain.preferences import LabelEvent
from app.domain.protocol import EvaluatedMethod, EvaluationSettings
from app.domain.run_keys import TRIALS, RunKey
from app.services.evaluation import evaluation_plan
from app.storage import ArtefactStore
from tests.lab.conftest import write_plane
from tests.lab.policy_server import serving
from tests.lab.test_whole_loop import LABELS, SLOW, answer, do, film, lend, make_study
from tests.worker.at_hand import AtHand
from worker.experiments import fit_response_surface
from worker.jobs.clips.evaluation_films import make_films
from worker.jobs.learning.baselines import train_method
from worker.jobs.learning.filters import train_filter
from worker.jobs.learning.reward_models import train_reward
from worker.jobs.runtime.context import WorkerContext
from worker.ml.export import bundle
from worker.ml.policies import asked_policy

METHODS = (EvaluatedMethod.REFERENCE, EvaluatedMethod.SOMEBODY_ELSE, EvaluatedMethod.PBARL)


@pytest.mark.long
def test_from_a_policy_server_to_a_bundle(
    tmp_path: Path,
    use: Callable[[Path], None],
    database: Database,
    store: ArtefactStore,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    folder = write_plane(tmp_path / "plane_lab")
    with serving() as url:
        text = (folder / "lab.toml").read_text()
        (folder / "lab.toml").write_text(text.replace('file = "policy.onnx"', f'url = "{url}"\nexecution_horizon = 2'))
        use(folder)
        monkeypatch.setattr(fit_response_surface, "Compute", lambda _: AtHand())
        fit_response_surface.explore("plane", tmp_path / "blocks", 1, scenarios=20)
        context = WorkerContext(database, store, AtHand())
        study_id, person_id = make_study(context, evaluation=EvaluationSettings(methods=METHODS, trials=1))
        film(context, study_id)
        answer(context, study_id, person_id, SLOW)
        with database.reading() as session:
            last = f"answer-{session.scalar(select(func.max(LabelEvent.id)))}"
        known = RunKey(RunKind.REWARD, participant_id=person_id, labels=LABELS, answers=last)
        do(context, train_reward, known, study_id)
        lend(context, study_id)
        for act, kind, subject in (
            (train_filter, RunKind.FILTER, ""),
            (train_method, RunKind.METHOD, EvaluatedMethod.SOMEBODY_ELSE),
            (make_films, RunKind.FILMS, TRIALS),
        ):
            do(context, act, replace(known, kind=kind, subject=subject), study_id)
        with database.reading() as session:
            model = session.scalars(select(Model).where(Model.kind == ModelKind.FILTER)).one()
            films = {trial.film for trial in evaluation_plan.trials_of(session, person_id)}
            shown = {film.method: film.trajectory_sha256 for film in films if film}
            stored = store.read(
                session.scalars(select(Bundle).where(Bundle.model_id == model.id)).one().artefact_sha256
            )
    asked_policy.forget()
    assert set(shown) == set(METHODS), "somebody else's is that of a type of user, while there is nobody else"
    assert len(set(shown.values())) == len(METHODS), "every robot acts differently"
    manifest = bundle.verify(stored)
    assert manifest["policy"]["file"] is None
    assert manifest["mode"]["speed_far"] < 0, "whoever minds speed has it slower"
    assert manifest["evaluation"]["success"]["delta"] >= -0.035
    assert manifest["evaluation"]["preference"]["low"] > 0
    zipfile.ZipFile(io.BytesIO(stored)).extractall(tmp_path / "bundle")
    checked = subprocess.run(
        [sys.executable, "-I", "run_filter.py"], cwd=tmp_path / "bundle", capture_output=True, text=True, check=False
    )
    assert checked.returncode == 0, checked.stderr
    assert "OK: filter reproduces its recorded actions" in checked.stdout
