"""A laboratory with several policies, or settings of a controller: one of them is chosen instead of a filter."""

import io
import subprocess
import sys
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sqlalchemy import func, select

from app.db import Database
from app.domain.models import Bundle, Model, ModelKind, RunKind
from app.domain.preferences import LabelEvent
from app.domain.protocol import EvaluatedMethod, EvaluationSettings
from app.domain.run_keys import TRIALS, RunKey
from app.domain.study_settings import StudySettings
from app.installed_tasks import lab
from app.installed_tasks.description import TaskRefused
from app.services.archives.demo_archive import usual_settings
from app.services.evaluation import evaluation_plan
from app.services.studies import task_limits
from app.storage import ArtefactStore
from tests.lab.conftest import way_to_goal
from tests.lab.policy_server import serving, to_goal
from tests.lab.test_whole_loop import LABELS, QUICK, SLOW, answer, do, film, lend, make_study, weighed
from tests.worker.at_hand import AtHand
from worker.compute import simulation
from worker.experiments import fit_response_surface
from worker.experiments.check_lab import checked
from worker.jobs.clips.evaluation_films import make_films
from worker.jobs.learning.baselines import train_method
from worker.jobs.learning.filters import train_filter
from worker.jobs.learning.reference_rollouts import reference_blocks
from worker.jobs.learning.reward_models import train_reward
from worker.jobs.runtime.context import WorkerContext
from worker.ml.export import bundle
from worker.ml.filters.fitting import policy_choice
from worker.ml.filters.fitting.filter_problem import FilterConfig
from worker.ml.policies import asked_policy
from worker.ml.policies.onnx_policy import NotAPolicy, adapted
from worker.tasks import registry

POLICIES = """
[policies.quick]
gain = 1.0

[policies.slow]
gain = 0.3

[policies.blunt]
file = "blunt.onnx"
"""
METHODS = (EvaluatedMethod.REFERENCE, EvaluatedMethod.SOMEBODY_ELSE, EvaluatedMethod.PBARL)


@pytest.fixture
def several(plane: Path) -> Path:
    """The plane's laboratory with four policies."""
    (plane / "blunt.onnx").write_bytes(way_to_goal(4.0))
    add(plane, POLICIES)
    return plane


def add(folder: Path, text: str) -> None:
    with (folder / "lab.toml").open("a") as file:
        file.write(text)


def test_a_policy_is_as_the_first_one_but_for_what_it_says_itself(several: Path) -> None:
    described = lab.read(several / "lab.toml").description
    assert isinstance(described, lab.LabDescription)
    assert (described.policies["slow"].file, described.policies["slow"].gain) == ("policy.onnx", 0.3)
    assert (described.policies["blunt"].file, described.policies["blunt"].gain) == ("blunt.onnx", 0.5)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[policies.reference]\ngain = 0.1\n", "is what the one under policy is called"),
        ("[policies.same]\ngain = 0.5\n", "policies.same is the same as policy"),
        ('[policies.gone]\nfile = "gone.onnx"\n', "policies.gone.file names"),
        ('[policies.other]\nfile = "other.pt"\n', "does not exist"),
        ("[policies.stiff]\nsettings = { stiffness = 1.0 }\n", "settings has stiffness, which is not among"),
        ('[policies.there]\nurl = "ws://there"\nsettings = { x = 1.0 }\n', "settings are for policies in files"),
        ("[policies.Odd]\ngain = 0.1\n", "small letters"),
        ("[policies]\nslow = 0.5\n", "policies.slow"),
    ],
)
def test_what_is_wrong_with_a_policy_is_said_with_its_key(plane: Path, text: str, said: str) -> None:
    add(plane, text)
    with pytest.raises(TaskRefused, match=said):
        lab.read(plane / "lab.toml")


def test_check_runs_every_policy_and_says_which_row_of_the_sheet_is_whose(several: Path) -> None:
    found = checked(several / "lab.toml", several / "sheet.png")
    assert found.wrong == ()
    assert "The last 3 rows of it are quick, slow, blunt." in " ".join(found.remarks)
    (several / "blunt.onnx").write_bytes(b"no graph")
    assert (
        "policies.blunt.file: blunt.onnx: it cannot be read as ONNX"
        in checked(several / "lab.toml", several / "s.png").wrong[0]
    )


def test_exploring_tells_of_policies_that_lose_the_task_or_do_nothing_else(
    several: Path, use: Callable[[Path], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    add(several, "[policies.lazy]\ngain = 0.01\n\n[policies.alike]\ngain = 0.499\n")
    use(several)
    monkeypatch.setattr(fit_response_surface, "Compute", lambda _: AtHand())
    record = fit_response_surface.explore("plane", several / "blocks", 1)
    assert record == {"policies": ["quick", "slow", "blunt", "lazy", "alike"]}, "studies count on all of them"
    lazy, alike = registry.found_out("plane").notes
    assert lazy.startswith("The policy lazy: success falls by")
    assert alike == "The policy alike: changes nothing that is measured. Better take it out of policies."


def test_a_study_asks_for_no_more_ways_than_there_are_policies_and_for_nothing_in_between(
    several: Path, use: Callable[[Path], None]
) -> None:
    use(several)
    said = task_limits.complaints("plane", StudySettings(clip_steps=40))
    assert said["behaviours_per_scenario"] == "This task has 4 policies to choose from. Enter at most 4."
    methods = EvaluationSettings(methods=(EvaluatedMethod.REFERENCE, EvaluatedMethod.SELF_SET))
    said = task_limits.complaints("plane", StudySettings(clip_steps=40, behaviours_per_scenario=4, evaluation=methods))
    assert said == {
        "evaluation_methods": "One of several policies is chosen in this task: nothing can be set by sliders."
    }
    usual = usual_settings("plane")
    assert task_limits.complaints("plane", usual) == {}
    said = task_limits.complaints("plane", usual.model_copy(update={"following_share": 0.2}))
    assert said == {
        "following_share": "One of several policies is chosen in this task: nothing can be varied. Enter 0."
    }


def test_where_there_is_nothing_to_shield_the_reference_policy_s_reach_is_not_found_out(
    several: Path, use: Callable[[Path], None]
) -> None:
    config = FilterConfig()
    use(several)
    fit_response_surface.find_ranges("plane", scenarios=4)
    choice, settings = registry.task("plane"), StudySettings(clip_steps=40)
    made, home = reference_blocks("plane", settings), config.home_block(choice)
    assert home not in made
    assert config.gate_block(choice) in made


def test_settings_stay_whatever_the_file_says_of_them_if_it_says_anything() -> None:
    bounds = np.array([-0.1, 0.0]), np.array([0.1, 10.0])
    seen = np.random.default_rng(0).uniform(-1, 1, (3, 4)).astype(np.float32)
    free = adapted(way_to_goal(), 4, 4, bounds, 0.5).mean(seen)
    held = adapted(way_to_goal(), 4, 4, bounds, 0.5, {1: 7.5}).mean(seen)
    np.testing.assert_allclose(held, np.stack([free[:, 0], np.full(3, 0.5)], axis=1), atol=1e-6)
    three = np.array([-0.1, -0.1, 0.0]), np.array([0.1, 0.1, 10.0])
    inserted = adapted(way_to_goal(), 4, 4, three, 0.5, {2: 2.5}).mean(seen)
    assert inserted.shape == (3, 3)
    np.testing.assert_allclose(inserted[:, 2], -0.5, atol=1e-6)
    with pytest.raises(NotAPolicy, match="outside of the environment's own bounds"):
        adapted(way_to_goal(), 4, 4, bounds, 0.5, {1: 11.0})
    with pytest.raises(NotAPolicy, match="its output has 2 numbers, but its actions has 3"):
        adapted(way_to_goal(), 4, 4, three, 0.5)


def test_chances_say_when_the_answers_cannot_tell() -> None:
    rng = np.random.default_rng(0)
    clear = np.stack([np.zeros((50, 30)), rng.normal(1.0, 1.0, (50, 30))])
    assert policy_choice.chances_of_best(clear, rng)[1] > 0.99
    torn = np.stack([np.zeros((50, 30)), np.repeat(rng.normal(0.0, 1.0, (50, 1)), 30, axis=1)])
    assert 0.3 < policy_choice.chances_of_best(torn, rng)[1] < 0.7, "half of the posterior likes it, half does not"
    assert policy_choice.in_words({"reference": 0.4, "slow": 0.6}) == "slow 60%, reference 40%"


def learned(context: WorkerContext, minds: dict[str, float], *more: tuple[Any, RunKind, str]) -> dict[str, bytes]:
    """The bundle of somebody who minds this, and the films of their blinded evaluation by method."""
    study_id, person_id = make_study(context, str(minds), EvaluationSettings(methods=METHODS, trials=1))
    film(context, study_id)
    answer(context, study_id, person_id, minds)
    with context.database.reading() as session:
        last = f"answer-{session.scalar(select(func.max(LabelEvent.id)))}"
    known = RunKey(RunKind.REWARD, participant_id=person_id, labels=LABELS, answers=last)
    do(context, train_reward, known, study_id)
    if more:
        lend(context, study_id)
    for act, kind, subject in ((train_filter, RunKind.FILTER, ""), *more):
        do(context, act, replace(known, kind=kind, subject=subject), study_id)
    with context.database.reading() as session:
        of_person = select(Model).where(Model.participant_id == person_id, Model.kind == ModelKind.FILTER)
        model = session.scalars(of_person).one()
        packed = session.scalars(select(Bundle).where(Bundle.model_id == model.id)).one()
        films = {trial.film for trial in evaluation_plan.trials_of(session, person_id)}
        shown = {each.method: context.store.read(each.trajectory_sha256) for each in films if each}
        return {"bundle": context.store.read(packed.artefact_sha256), **shown}


EVALUATED: tuple[tuple[Any, RunKind, str], ...] = (
    (train_method, RunKind.METHOD, EvaluatedMethod.SOMEBODY_ELSE),
    (make_films, RunKind.FILMS, TRIALS),
)


@pytest.mark.slow
def test_two_opposed_people_are_given_different_policies_in_bundles_that_say_which(
    several: Path, use: Callable[[Path], None], database: Database, store: ArtefactStore, tmp_path: Path
) -> None:
    use(several)
    fit_response_surface.find_ranges("plane", scenarios=4)
    context = WorkerContext(database, store, AtHand())
    found = {"quick": learned(context, QUICK, *EVALUATED), "slow": learned(context, SLOW)}
    manifests = {name: bundle.verify(each["bundle"]) for name, each in found.items()}
    assert manifests["slow"]["choice"]["policy"] == "slow"
    assert manifests["quick"]["choice"]["policy"] in {"quick", "blunt"}
    for manifest in manifests.values():
        policy, chances = manifest["choice"]["policy"], manifest["choice"]["chances"]
        assert sum(chances.values()) == pytest.approx(1.0, abs=0.01)
        clear = not any("do not clearly say" in note for note in manifest["notes"])
        assert manifest["choice"]["sure"] == clear == (chances[policy] >= policy_choice.SURE)
    assert manifests["slow"]["interface"]["policy"]["gain"] == 0.3, "of the policy that was chosen"
    assert set(METHODS) <= found["quick"].keys()
    assert found["quick"][EvaluatedMethod.PBARL] != found["quick"][EvaluatedMethod.REFERENCE]
    names, costs = registry.task("plane").signals, {}
    for name, each in found.items():
        folder = tmp_path / name
        zipfile.ZipFile(io.BytesIO(each["bundle"])).extractall(folder)
        script = [sys.executable, "run_filter.py"]
        proven = subprocess.run(script, cwd=folder, capture_output=True, text=True, check=False)
        assert proven.returncode == 0, proven.stderr
        assert f"**{manifests[name]['choice']['policy']}** was chosen" in (folder / "MODEL_CARD.md").read_text()
        policy = simulation.reference_policy("plane", manifests[name]["choice"]["policy"])
        costs[name] = weighed(simulation.run_episode("plane", policy.mean, 7), names, SLOW)
    assert costs["slow"] < costs["quick"]


@pytest.mark.long
def test_each_of_several_policies_may_answer_from_a_server_of_its_own(
    plane: Path, use: Callable[[Path], None], database: Database, store: ArtefactStore
) -> None:
    def slowly(message: dict[str, Any]) -> dict[str, Any]:
        return {"actions": 0.7 * to_goal(message)["actions"]}

    with serving() as usual, serving(slowly) as slow:
        text = (plane / "lab.toml").read_text().replace('file = "policy.onnx"', f'url = "{usual}"')
        (plane / "lab.toml").write_text(text)
        add(
            plane,
            f'[policies.slow]\nurl = "{slow}"\n\n[policies.slower]\ngain = 0.3\n\n[policies.quick]\ngain = 0.9\n',
        )
        use(plane)
        fit_response_surface.find_ranges("plane", scenarios=4)
        context = WorkerContext(database, store, AtHand())
        found = learned(context, SLOW, *EVALUATED)
    asked_policy.forget()
    manifest = bundle.verify(found["bundle"])
    assert manifest["choice"]["policy"] in {"slow", "slower"}
    assert manifest["policy"]["file"] is None
    assert set(METHODS) <= found.keys()
    assert found[EvaluatedMethod.PBARL] != found[EvaluatedMethod.REFERENCE], "every film asks its own server"
