"""A run's key says all that the run is about: what is read from it is what was written."""

import pytest

from app.domain import run_keys
from app.domain.models import RunKind
from app.domain.run_keys import AGAIN, BASIS, SCENARIO, TRIALS, RunKey

STORED = {
    "clips/study-1/scenario-17": RunKey(RunKind.CLIPS, 1, subject=SCENARIO, number=17),
    "clips/study-1/whole-17": RunKey(RunKind.CLIPS, 1, subject="whole", number=17),
    "clips/study-1/again-5-1763811000": RunKey(RunKind.CLIPS, 1, subject=AGAIN, number=5, mark="1763811000"),
    "reward/participant-3/labels-20": RunKey(RunKind.REWARD, participant_id=3, labels=20),
    "reward/participant-3/labels-200/answer-345": RunKey(
        RunKind.REWARD, participant_id=3, labels=200, answers="answer-345"
    ),
    "filter/participant-3/labels-200/answer-345-exclusion-6": RunKey(
        RunKind.FILTER, participant_id=3, labels=200, answers="answer-345-exclusion-6"
    ),
    "filter/participant-3/labels-10/exclusion-6": RunKey(
        RunKind.FILTER, participant_id=3, labels=10, answers="exclusion-6"
    ),
    "method/participant-3/pbrl_hri/labels-200/answer-345": RunKey(
        RunKind.METHOD, participant_id=3, subject="pbrl_hri", labels=200, answers="answer-345"
    ),
    "films/participant-3/before-after/labels-200": RunKey(
        RunKind.FILMS, participant_id=3, subject="before-after", labels=200
    ),
    "films/participant-3/trials/labels-200/answer-1": RunKey(
        RunKind.FILMS, participant_id=3, subject=TRIALS, labels=200, answers="answer-1"
    ),
    "films/participant-3/again-8-9": RunKey(RunKind.FILMS, participant_id=3, subject=AGAIN, number=8, mark="9"),
    "report/study-1/basis-0123456789012345": RunKey(RunKind.REPORT, 1, subject=BASIS, mark="0123456789012345"),
    "report/study-1/basis-abcdefabcdefabcd": RunKey(RunKind.REPORT, 1, subject=BASIS, mark="abcdefabcdefabcd"),
    "export/study-1/archive-4": RunKey(RunKind.EXPORT, 1, subject="archive", number=4),
    "shared/study-1/filter-7-19ab0c3d4e5": RunKey(RunKind.SHARED, 1, subject="filter", number=7, mark="19ab0c3d4e5"),
    "power/study-1/plan-4": RunKey(RunKind.POWER, 1, subject="plan", number=4),
    "reward/participant-3/labels-20/imported-0b9c-1f": RunKey(
        RunKind.REWARD, participant_id=3, labels=20, copy="/imported-0b9c-1f"
    ),
}


@pytest.mark.parametrize(("stored", "key"), STORED.items(), ids=lambda each: str(each))
def test_what_is_read_is_what_was_written(stored: str, key: RunKey) -> None:
    assert str(key) == stored
    assert run_keys.read(stored) == key


@pytest.mark.parametrize(
    "foreign", ["", "run/1", "other/study-1/scenario-2", "clips/scenario-2", "reward/participant-x"]
)
def test_a_key_that_nobody_here_has_written_is_none(foreign: str) -> None:
    assert run_keys.read(foreign) is None


@pytest.mark.parametrize(
    ("later", "makes_good", "not_this"),
    [
        ("reward/participant-3/labels-30", "reward/participant-3/labels-20", "filter/participant-3/labels-20"),
        (
            "method/participant-3/prefft/labels-20/answer-9",
            "method/participant-3/prefft/labels-20",
            "method/participant-3/pbrl_hri/labels-20",
        ),
        ("clips/study-1/again-5-20", "clips/study-1/again-5-10", "clips/study-1/again-6-10"),
        ("clips/study-1/scenario-2", "clips/study-1/scenario-1", "clips/study-1/again-1-1"),
        ("report/study-1/basis-b", "report/study-1/basis-a", "report/study-2/basis-a"),
        ("export/study-1/data-4", "export/study-1/data-4", "export/study-1/data-3"),
    ],
)
def test_a_later_run_makes_good_what_failed_at_the_same_work(later: str, makes_good: str, not_this: str) -> None:
    series = [key.series for key in map(run_keys.read, (later, makes_good, not_this)) if key]
    assert series[0] == series[1] != series[2]


def test_a_study_that_moves_takes_the_keys_of_its_runs_along() -> None:
    def new_id(table: str, old: int) -> int:
        return old + {"study": 10, "participant": 20, "label_event": 30, "exclusion": 40, "rollout": 50}[table]

    def moved(stored: str) -> str:
        key = run_keys.read(stored)
        assert key is not None
        return str(run_keys.renumbered(key, new_id))

    assert moved("filter/participant-3/labels-200/answer-5-exclusion-6") == (
        "filter/participant-23/labels-200/answer-35-exclusion-46"
    )
    assert moved("clips/study-1/scenario-17") == "clips/study-11/scenario-17"
    assert moved("clips/study-1/again-5-99") == "clips/study-11/again-55-99"
