"""Whatever is killed while a backup is made, a restored studio has every answer acknowledged before it began."""

from pathlib import Path

import pytest

from tests.backup_drill import Drill


@pytest.mark.sqlite("PostgreSQL is backed up with its own tools")
def test_a_restored_studio_has_every_answer_that_was_acknowledged_before_the_backup_began(tmp_path: Path) -> None:
    drill = Drill(tmp_path, answers=400, pause_s=0.05, seed=1)
    with drill.under_load() as server:
        drill.trial(server, kill_server=False, kill_backup=False)
        drill.trial(server, kill_server=True, kill_backup=False)
        drill.trial(server, kill_server=False, kill_backup=True)
    assert drill.tally.whole == 3
    assert drill.tally.lost == 0
    assert drill.tally.kills == 2
