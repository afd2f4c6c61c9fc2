"""How far a fit is, when its stages say how far they are."""

import pytest

from worker.compute import stages
from worker.compute.stages import Stages


@pytest.mark.parametrize("which", [stages.QUICK, stages.LAST, stages.PRINTED, stages.REFINED])
def test_the_share_that_is_done_grows_from_nothing_to_the_whole_and_never_falls(which: Stages) -> None:
    heard = list[float]()
    for name in which:
        for share in (0.0, 0.5, 1.0):
            stages.during(which, name, lambda _, done: heard.append(done))("at work", share)
    assert heard[0] == 0.0
    assert heard == sorted(heard)
    assert heard[-1] == pytest.approx(1.0)
    assert heard[1] > 0.0


def test_what_turns_out_to_be_needed_on_the_way_takes_nothing_back() -> None:
    heard = list[float]()
    say = stages.during({"gate": 1.0}, "gate", lambda _, done: heard.append(done))
    for share in (0.0, 0.5, 0.0, 0.6):
        say("at work", share)
    assert heard == [0.0, 0.5, 0.5, 0.6]


def test_a_stage_that_takes_longer_counts_for_more() -> None:
    assert stages.so_far({"short": 1.0, "long": 3.0}, "long", 0.0) == pytest.approx(0.25)
    assert stages.so_far({"short": 1.0, "long": 3.0}, "long", 0.5) == pytest.approx(0.625)
    with pytest.raises(KeyError, match="unknown"):
        stages.so_far({"short": 1.0}, "unknown", 0.0)
