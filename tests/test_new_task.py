"""docs/new_task.md: the package it shows is installed as it stands, and its task is one like ours."""

import importlib
import re
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterator
from copy import copy
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from fastapi.testclient import TestClient
from gymnasium.utils.env_checker import check_env

import worker.sim
from app.db import Database
from app.domain.models import ModelKind
from app.domain.protocol import Language
from app.domain.study_settings import StudySettings
from app.installed_tasks import catalogue
from app.services.studies import studies
from app.web.texts import wording
from tests import factories
from tests.app.conftest import agree
from tests.app.study_pages import typed
from worker.compute import simulation
from worker.sim.assistive import AssistiveEnv
from worker.sim.rollout import rollout
from worker.tasks import registry

PAGE = Path(__file__).parents[1] / "docs" / "new_task.md"
ROOT = PAGE.parents[1]


def forget() -> None:
    """What was read or imported before, as a new process would."""
    of_texts = (wording._resource, wording._built_in, wording._known_variables, wording._remembered)
    for remembered in (catalogue.installed, registry.environment_class, registry.look, *of_texts):
        remembered.cache_clear()


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The files of the page."""
    folder = tmp_path_factory.mktemp("napkin-task")
    for name, content in re.findall(
        r"^## `([\w/.]+)`\n.*?```\w+\n(.*?)```", PAGE.read_text(), re.DOTALL | re.MULTILINE
    ):
        file = folder / name
        file.parent.mkdir(exist_ok=True)
        file.write_text(content, encoding="utf-8")
    (folder / "napkin_task" / "__init__.py").touch()
    return folder


@pytest.fixture(scope="module")
def site(package: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where pip has installed the package."""
    site = tmp_path_factory.mktemp("site")
    install = ["pip", "install", "--quiet", "--no-deps", "--no-index", "--no-build-isolation", "--target", str(site)]
    subprocess.run([sys.executable, "-m", *install, str(package)], check=True, capture_output=True)
    return site


@pytest.fixture
def installed(site: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The folder of the task, which this process and those it starts find."""
    monkeypatch.syspath_prepend(site)
    monkeypatch.setenv("PYTHONPATH", str(site))
    forget()
    yield site / "napkin_task"
    monkeypatch.undo()
    forget()
    for name in [each for each in sys.modules if each.startswith("napkin_task")]:
        del sys.modules[name]


@pytest.fixture
def env(installed: Path) -> Iterator[AssistiveEnv]:
    worker.sim.register_tasks()
    environment = gymnasium.make("pbarl/Dabbing-v0").unwrapped
    assert isinstance(environment, AssistiveEnv)
    yield environment
    environment.close()
    del gymnasium.registry["pbarl/Dabbing-v0"]


def test_the_example_is_about_a_hundred_lines_and_passes_the_checker(env: AssistiveEnv, installed: Path) -> None:
    assert len((installed / "environment.py").read_text().splitlines()) <= 110
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env)


def test_the_example_can_be_done_and_counts_gentle_touches(env: AssistiveEnv) -> None:
    """A controller that follows the straight line to the mouth, with the arm's own kinematics, succeeds."""

    def towards_mouth(observation: np.ndarray) -> np.ndarray:
        joints = observation[env.task.observation.slice_of("joint_positions_rad")].astype(float)
        tool = env.robot.link_frames(joints[None], env.tool)[0, -1]
        away = observation[env.task.observation.slice_of("tool_to_target_m")].astype(float)
        outward = observation[env.task.observation.slice_of("target_outward")].astype(float)
        goal = away + 0.01 * outward
        step = tool[:3, 3] + goal * min(1.0, 0.02 / max(float(np.linalg.norm(goal)), 1e-6))
        wanted, _ = env.robot.solve_pose(joints[None], step[None], tool[:3, :3], env.tool, 5)
        action: np.ndarray = np.clip((wanted[0] - joints) / 0.05, -1, 1).astype(np.float32)
        return action

    trajectories = [rollout(env, towards_mouth, scenario) for scenario in range(6)]
    assert sum(each.success for each in trajectories) >= 2
    for each in trajectories:
        strokes = each.signals[:, -1]
        assert each.success is bool(strokes.sum() >= 10)
    clip = simulation.renderer("quick").render_clip(trajectories[0], 0, 4)
    assert clip.n_frames == 6


def test_it_stands_behind_our_tasks_on_the_form_and_its_study_is_in_its_words(
    installed: Path, database: Database, new_browser: Callable[[], TestClient], experimenter: TestClient
) -> None:
    page = experimenter.get("/studies/new").text
    assert re.findall(r'name="task" value="(\w+)"', page) == ["feeding", "drinking", "scratching", "dabbing"]
    assert "A folded napkin dabs the corner of the mouth." in page
    assert 'd="M150 66L122 64"' in page
    form = typed(experimenter, task="dabbing", name="Napkins", clip_steps="101")
    assert "An episode of this task has 100 steps." in experimenter.post("/studies/new", data=form).text
    with database.writing() as session:
        study = studies.create_study(session, "Napkins", StudySettings(language=Language.GERMAN), task="dabbing")
        person, token = factories.make_participant(session, study, ready=False)
        factories.make_model(session, study, person, ModelKind.FILTER, factories.filter_metrics())
    assert "Dabbing · since" in re.sub(r"\s+", " ", experimenter.get("/studies").text)
    described = experimenter.get("/studies/napkins/participants/P01").text
    for words in ("Speed of the napkin", "dabs gently", "far from the mouth: slower"):
        assert words in described
    assert "spilled" not in described
    browser = new_browser()
    browser.get(f"/p/{token}")
    agree(browser)
    assert "tupft einer sitzenden Person mit einer Serviette den Mund ab" in browser.get("/p/instructions").text


def test_the_web_server_reads_it_without_importing_it_or_what_it_needs(installed: Path) -> None:
    (installed / "__init__.py").write_text("raise RuntimeError('imported')\n")
    program = (
        "import sys, app.main; from app.web.texts import task_words, wording; from app.domain.protocol import Language;"
        "print(task_words.words_of('dabbing').title, wording.Wording(Language.GERMAN)('task-dabbing'));"
        "print([name for name in ('worker', 'napkin_task', 'numpy', 'gymnasium', 'pybullet') if name in sys.modules])"
    )
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, cwd=ROOT)
    (installed / "__init__.py").write_text("")
    said, loaded = run.stdout.strip().split("\n")
    assert said.startswith("Dabbing Ein Roboterarm tupft")
    assert loaded == "[]"


@pytest.mark.parametrize(
    ("file", "before", "after", "complaint"),
    [
        ("task.toml", 'title = "Dabbing"', "", "task.toml: title is missing."),
        (
            "task.toml",
            "episode_steps = 100",
            "episode_steps = '100 s'",
            "task.toml: episode_steps: Input should be a valid",
        ),
        (
            "task.toml",
            "usual_clip_steps = 60",
            "usual_clip_steps = 160",
            "usual_clip_steps must not be more than the 100 steps of an episode",
        ),
        ("task.toml", "environment:DabbingEnv", "environment.py", "task.toml: environment must be like module:name"),
        ("task.toml", "tool =", "tools =", "task.toml: words.tool is missing; words.tools is not known here."),
        ("task.toml", 'summary = "', "summary = ", "task.toml is not valid TOML: "),
        ("task.toml", "press = ", 'press = "{', "task.toml is not valid TOML: "),
        ("task.toml", "Imagine that", "Imagine {that}", "task.toml: instructions.en must not have braces"),
        ("task.toml", "en = ", "english = ", ".english.[key] must be the code of a language"),
        ("picture.svg", 'viewBox="0 0 240 150"', "", 'picture.svg: its viewBox must be "0 0 240 150"'),
        ("picture.svg", "<circle", "<script", "picture.svg: a picture has no script; use circle"),
        ("picture.svg", "<circle ", '<circle onclick="x" ', "picture.svg: a picture has no onclick; use circle"),
    ],
)
def test_a_folder_with_a_mistake_is_left_out_and_says_which(
    installed: Path, experimenter: TestClient, file: str, before: str, after: str, complaint: str
) -> None:
    right = (installed / file).read_text()
    assert before in right
    (installed / file).write_text(right.replace(before, after, 1))
    forget()
    page = experimenter.get("/studies/new")
    (installed / file).write_text(right)
    (broken,) = catalogue.installed().broken
    assert complaint in broken.why
    assert "uninstall napkin-task, and start the studio again" in broken.why
    assert "The task dabbing cannot be used." in page.text
    assert catalogue.names() == ("feeding", "drinking", "scratching")
    with pytest.raises(
        registry.UnknownTask, match=r"knows feeding, drinking, scratching\. The task dabbing cannot be used"
    ):
        registry.task("dabbing")


@pytest.mark.parametrize(
    ("before", "after", "complaint"),
    [
        (
            "import numpy as np",
            "import nunpy as np",
            "cannot be imported: ModuleNotFoundError: No module named 'nunpy'",
        ),
        (
            'name="dabbing"',
            'name="wiping"',
            "is of the task 'wiping' with 100 steps an episode, not of 'dabbing' with 100",
        ),
        (
            "class DabbingEnv(AssistiveEnv)",
            "class DabbingEnv(object)",
            "is no subclass of worker.sim.assistive.AssistiveEnv",
        ),
    ],
)
def test_code_with_a_mistake_fails_where_it_is_needed_and_says_why(
    installed: Path, before: str, after: str, complaint: str
) -> None:
    code = installed / "environment.py"
    right = code.read_text()
    code.write_text(right.replace(before, after))
    importlib.invalidate_caches()
    with pytest.raises(registry.TaskBroken, match=re.escape(complaint)) as raised:
        registry.environment_class("dabbing")
    code.write_text(right)
    assert "task.toml: environment = 'environment:DabbingEnv'" in str(raised.value)


def test_a_task_without_a_policy_says_how_to_train_one(installed: Path) -> None:
    with pytest.raises(simulation.NoPolicy, match="run python -m worker pretrain --task dabbing") as raised:
        simulation.reference_policy("dabbing")
    assert str(copy(raised.value)) == str(raised.value), "as it comes out of a compute process"


def test_two_packages_cannot_bring_a_task_of_one_name(
    installed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    info = tmp_path / "copycat-1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Name: copycat\nVersion: 1\n")
    declared = {"feeding": "napkin_task", "nowhere": "not.there", "other": "napkin_task", "Large": "napkin_task"}
    lines = [f"{name} = {package}" for name, package in (declared | {"object": "napkin_task:TASK"}).items()]
    (info / "entry_points.txt").write_text("\n".join(["[pbarl_studio.tasks]", *lines]))
    monkeypatch.syspath_prepend(tmp_path)
    forget()
    why = {each.name: each.why for each in catalogue.installed().broken}
    assert "worker.tasks.feeding is a task of the same name. Correct it or uninstall copycat" in why["feeding"]
    assert "There is no package not with an __init__.py; its entry point is 'not.there'." in why["nowhere"]
    assert "This name is not free." in why["other"]
    assert "at most 40 small letters" in why["Large"]
    assert "must name a package, and is 'napkin_task:TASK'" in why["object"]
    assert catalogue.names() == ("feeding", "drinking", "scratching", "dabbing")
