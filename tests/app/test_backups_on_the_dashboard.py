"""The dashboard says when scheduled backups fail or stay away, and nothing as long as they are made."""

import re
from datetime import timedelta

import pytest
from fastapi.testclient import TestClient

from app.db import now
from app.services.backups import schedule
from app.services.backups.schedule import Standing
from app.settings import Settings

HOUR = timedelta(hours=1)


def alerts(experimenter: TestClient) -> str:
    """What the studies' page says about backups."""
    page = " ".join(re.sub("<[^>]+>", "", experimenter.get("/studies").text).split())
    return " ".join(re.findall(r"(?:The last backup failed|No backup has been made).*?The newest one[^.]*\.", page))


@pytest.mark.parametrize(
    ("standing", "said"),
    [
        (Standing(24, now() - HOUR), ""),
        (Standing(24, now() - 100 * HOUR, made_at=now() - 47 * HOUR), ""),
        (Standing(24, now() - 100 * HOUR, made_at=now() - 49 * HOUR), "The newest one was made 2 days ago."),
        (
            Standing(24, now() - 49 * HOUR),
            "made for long. One is due every 24 hours; the worker makes it. The newest one is still to come.",
        ),
        (Standing(24, now(), now() - HOUR, failed_at=now(), words="<b>disk</b> full"), "&lt;b&gt;disk&lt;/b&gt; full"),
    ],
)
def test_an_experimenter_reads_when_backups_fail_or_stay_away(
    experimenter: TestClient, settings: Settings, standing: Standing, said: str
) -> None:
    schedule._note(settings.data_dir, standing)
    assert schedule.standing(settings.data_dir) == standing
    assert said in alerts(experimenter)
    assert bool(said) == bool(alerts(experimenter))


@pytest.mark.parametrize("damaged", ["", "[]", "{}", '{"every_hours": 24, "since": 3}', "\x00"])
def test_a_note_that_cannot_be_read_says_nothing(experimenter: TestClient, settings: Settings, damaged: str) -> None:
    (settings.data_dir / "backups.json").write_text(damaged)
    assert alerts(experimenter) == ""
