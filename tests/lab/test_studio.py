"""The studio with a laboratory's task: the web server reads its description and runs none of its code."""

import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from starlette.testclient import TestClient

from app import __main__ as studio
from app.db import Database
from app.domain.choices import Method
from app.domain.models import ModelKind
from app.domain.protocol import Language
from app.domain.study_settings import StudySettings
from app.installed_tasks import catalogue
from app.services.studies import studies, task_limits
from app.services.studies.task_limits import TaskCannot
from app.settings import Settings
from tests import factories
from tests.app.conftest import agree
from tests.app.study_pages import typed
from tests.lab.conftest import forget

ROOT = Path(__file__).parents[2]


def test_it_stands_on_the_form_and_its_study_is_in_its_words(
    plane: Path,
    use: Callable[[Path], None],
    database: Database,
    new_browser: Callable[[], TestClient],
    experimenter: TestClient,
) -> None:
    use(plane)
    page = experimenter.get("/studies/new").text
    assert re.findall(r'name="task" value="(\w+)"', page)[-1] == "plane"
    assert "A point moves to a place." in page
    with database.writing() as session:
        study = studies.create_study(
            session, "Points", StudySettings(language=Language.GERMAN, clip_steps=40), task="plane"
        )
        _, token = factories.make_participant(session, study, ready=False)
    browser = new_browser()
    browser.get(f"/p/{token}")
    agree(browser)
    assert "Ein Punkt bewegt sich an eine Stelle." in browser.get("/p/instructions").text


def test_the_form_warns_of_a_policy_that_answers_from_a_server(
    plane: Path, use: Callable[[Path], None], experimenter: TestClient
) -> None:
    use(plane)
    assert "answers from a server" not in experimenter.get("/studies/new").text
    text = (plane / "lab.toml").read_text()
    (plane / "lab.toml").write_text(text.replace('file = "policy.onnx"', 'url = "ws://127.0.0.1:8000"'))
    use(plane)
    page = experimenter.get("/studies/new").text
    assert "The server must be running whenever clips are made" in page


@pytest.mark.parametrize("url", [None, "ws://127.0.0.1:8000"])
def test_what_its_policy_does_not_allow_is_refused_on_the_form(
    url: str | None, plane: Path, use: Callable[[Path], None], experimenter: TestClient, database: Database
) -> None:
    if url:
        text = (plane / "lab.toml").read_text()
        (plane / "lab.toml").write_text(text.replace('file = "policy.onnx"', f'url = "{url}"'))
    use(plane)
    form = typed(
        experimenter,
        name="Points",
        task="plane",
        evaluation="yes",
        evaluation_methods=["reference", "prefft", "pbarl"],
        evaluation_mode="physical",
    )
    refused = experimenter.post("/studies/new", data=form).text
    assert "PrefFT would need the policy" in refused
    assert ("a robot cannot be packed" in refused) == (url is not None)
    form |= {"evaluation_methods": ["reference", "somebody_else", "average", "self_set", "pbarl"]}
    made = experimenter.post("/studies/new", data=form | {"evaluation_mode": ["video"]}, follow_redirects=False)
    assert made.status_code == 303, made.text
    with database.reading() as session:
        study = studies.find_study(session, "points")
    with pytest.raises(TaskCannot, match="as printed"):
        task_limits.require(study.task, study.settings.model_copy(update={"method": Method.PRINTED}))


def test_the_web_server_imports_nothing_of_it(plane: Path, tmp_path: Path) -> None:
    (plane / "plane.py").write_text("raise RuntimeError('imported')\n")
    program = (
        "import sys, app.main; from app.web.texts import task_words, wording; from app.domain.protocol import Language;"
        "print(task_words.words_of('plane').title, wording.Wording(Language.GERMAN)('task-plane'));"
        "print([name for name in ('worker', 'plane', 'numpy', 'gymnasium', 'onnxruntime') if name in sys.modules])"
    )
    run = subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True,
        text=True,
        check=True,
        cwd=ROOT,
        env={**os.environ, "LAB_TASKS": str(plane)},
    )
    said, loaded = run.stdout.strip().split("\n")
    assert said == "Plane Ein Punkt bewegt sich an eine Stelle."
    assert loaded == "[]"


def test_the_demo_command_makes_a_study_of_it(
    plane: Path, use: Callable[[Path], None], settings: Settings, capsys: pytest.CaptureFixture[str]
) -> None:
    use(plane)
    assert studio.demo_study(settings, "plane") == 0
    assert "/p/" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("before", "after", "complaint"),
    [
        ('title = "Plane"', "", "title is missing"),
        ('name = "plane"', 'name = "feeding"', "the name feeding is not free"),
        ('name = "plane"', 'name = "own_clips"', "the name own_clips is not free"),
    ],
)
def test_a_lab_toml_with_a_mistake_is_left_out_and_the_page_says_why(
    plane: Path, use: Callable[[Path], None], experimenter: TestClient, before: str, after: str, complaint: str
) -> None:
    text = (plane / "lab.toml").read_text()
    (plane / "lab.toml").write_text(text.replace(before, after))
    use(plane)
    (broken,) = catalogue.installed().broken
    assert complaint in broken.why
    assert "take it out of LAB_TASKS" in broken.why
    assert "lab.toml cannot be used." in experimenter.get("/studies/new").text


def test_several_files_are_named_as_in_path(plane: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("LAB_TASKS", os.pathsep.join([str(plane), str(tmp_path / "gone.toml")]))
    forget()
    assert catalogue.names()[-1] == "plane"
    (broken,) = catalogue.installed().broken
    assert "There is no file" in broken.why
    forget()


def test_a_participants_page_has_the_labs_own_costs_and_says_which_policy_was_chosen(
    plane: Path, use: Callable[[Path], None], database: Database, experimenter: TestClient
) -> None:
    use(plane)
    effort = {"reference": 2.5, "filter": 1.5, "delta": -1.0, "low": -1.2, "high": -0.8}
    measured = factories.filter_metrics()
    measured["evaluation"] |= {"costs": {"effort": effort}}
    choice = {"policy": "careful_one", "chances": {"reference": 0.3, "careful_one": 0.7}, "sure": False}
    with database.writing() as session:
        study = studies.create_study(session, "Points", StudySettings(clip_steps=40), task="plane")
        person, _ = factories.make_participant(session, study)
        factories.make_model(session, study, person, ModelKind.FILTER, measured | {"choice": choice})
        address = f"/studies/{study.slug}/participants/{person.code}"
    page = " ".join(experimenter.get(address).text.split())
    assert "effort (m)" in page
    assert "<strong>careful one</strong> was chosen" in page
    assert "<dt>careful one</dt><dd>70 %</dd></div><div><dt>reference</dt><dd>30 %</dd>" in page
    assert "Gate" not in page, "nothing is weakened where a policy is chosen"
