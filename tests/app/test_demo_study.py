"""One command makes a demo study of any task, also in a directory where nothing has ever run."""

from pathlib import Path

import pytest
from sqlalchemy import select

from app.__main__ import main
from app.db import Database
from app.domain.studies import USUAL_CLIP_STEPS, Participant, Study, TaskName
from app.settings import Settings


@pytest.mark.parametrize("task", TaskName)
def test_a_demo_study_has_one_participant_whose_link_is_printed(
    task: TaskName, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("DATA_DIR", str(tmp_path))
    assert main(["demo", "--task", task]) == 0
    assert "/p/" in capsys.readouterr().out.splitlines()[-1]
    database = Database(Settings(_env_file=None, data_dir=tmp_path).sqlalchemy_url)
    with database.reading() as session:
        study = session.scalars(select(Study)).one()
        assert (study.task, study.settings.clip_steps) == (task, USUAL_CLIP_STEPS[task])
        assert session.scalars(select(Participant.study_id)).all() == [study.id]
    database.dispose()


def test_a_task_that_does_not_exist_is_refused_with_the_ones_that_do(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["demo", "--task", "dressing"])
    assert "'feeding', 'drinking', 'scratching'" in capsys.readouterr().err
