"""Exploring what modes change: at random, and where people would want to go."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from worker.__main__ import main
from worker.compute import simulation
from worker.compute.pools import Compute
from worker.domain.scenarios import RESPONSE_SURFACE
from worker.experiments import fit_response_surface
from worker.experiments.fit_response_surface import BLOCK, MODES_PER_SCENARIO, Block, Differences
from worker.ml.filters.fitting.response_surface import ResponseSurface
from worker.tasks import registry

FEEDING = registry.task("feeding")


def sought(number: int, work: Path) -> list[Block]:
    surface, compute = ResponseSurface.load(simulation.surface_file("feeding"), FEEDING.modes), Compute(2)
    try:
        return fit_response_surface.sought_blocks(compute, FEEDING, surface, number, work)
    finally:
        compute.close()


@pytest.mark.long
def test_modes_that_people_want_lie_at_the_edges_where_random_modes_are_rare(tmp_path: Path) -> None:
    axes = FEEDING.modes.axes
    low, high = np.array([axis.low for axis in axes]), np.array([axis.high for axis in axes])
    wanted = np.concatenate([block.modes.reshape(-1, len(axes)) for block in sought(0, tmp_path)])
    random = FEEDING.modes.sample(len(wanted), np.random.default_rng(0))
    assert (wanted >= low - 1e-6).all()
    assert (wanted <= high + 1e-6).all()

    def near_an_edge(modes: np.ndarray) -> float:
        return float((np.minimum(modes - low, high - modes) < 0.05 * (high - low)).mean())

    assert near_an_edge(wanted) > 3 * near_an_edge(random)


@pytest.mark.long
def test_every_round_seeks_anew_and_the_same_again_when_repeated(tmp_path: Path) -> None:
    first, again, second = sought(0, tmp_path), sought(0, tmp_path), sought(1, tmp_path)
    assert all(np.array_equal(one.modes, other.modes) for one, other in zip(first, again, strict=True))
    assert {block.first for block in first}.isdisjoint(block.first for block in second)
    rounds = fit_response_surface.ROUNDS * sum(block.modes.shape[1] + 1 for block in first) * BLOCK
    random = fit_response_surface.SCENARIOS * (MODES_PER_SCENARIO + 1)
    assert fit_response_surface.block_episodes(fit_response_surface.SCENARIOS) == random + rounds


@pytest.mark.long
def test_whoever_explores_anew_is_told_that_the_archive_of_modes_is_gone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shipped = simulation.surface_file("scratching")
    file, work = tmp_path / shipped.name, tmp_path / "work"
    for each in (shipped, shipped.with_suffix(".json")):
        shutil.copy(each, tmp_path)
    monkeypatch.setattr(simulation, "surface_file", lambda task: file)
    told = "`python -m worker archive --task scratching` makes another"
    fit_response_surface.explore("scratching", work, 2, BLOCK, BLOCK)
    assert told in capsys.readouterr().out
    assert ResponseSurface.load(file, registry.task("scratching").modes).archive is None
    fit_response_surface.explore("scratching", work, 2, BLOCK, BLOCK)
    assert told not in capsys.readouterr().out


@pytest.mark.parametrize("count", [-10, 0, 15, len(RESPONSE_SURFACE) + BLOCK])
@pytest.mark.parametrize("of", ["scenarios", "sought"])
def test_scenarios_of_a_round_come_in_blocks_and_rounds_share_none(of: str, count: int, tmp_path: Path) -> None:
    with pytest.raises(fit_response_surface.NoRound, match=f"A round has 10, 20, .* and not {count}"):
        fit_response_surface.explore("feeding", tmp_path, 1, **{of: count})
    assert not list(tmp_path.iterdir())


def test_a_mistyped_number_of_scenarios_is_told_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["explore", "--task", "feeding", "--work-directory", str(tmp_path), "--sought", "55"]) == 1
    assert capsys.readouterr().err == "Error: A round has 10, 20, ... 1000 scenarios, and not 55.\n"


def test_a_block_that_was_run_in_other_modes_is_run_again(tmp_path: Path) -> None:
    modes = FEEDING.modes.sample(BLOCK * MODES_PER_SCENARIO, np.random.default_rng(0)).reshape(BLOCK, -1, 5)
    block = Block("feeding", 1, modes, tmp_path / "block.npz")
    assert not block.is_there()
    flat = modes.reshape(-1, 5)
    np.savez(block.file, modes=flat)
    assert not block.is_there(), "it does not say how hard they pressed"
    np.savez(block.file, modes=flat, force_growth_n=np.zeros(len(flat)))
    assert block.is_there()
    assert not Block("feeding", 1, modes + 0.1, block.file).is_there()


def test_what_is_foreseen_is_measured_in_scenarios_that_the_surface_has_not_seen() -> None:
    scenarios, rng = 20, np.random.default_rng(0)
    modes = FEEDING.modes.sample(scenarios * MODES_PER_SCENARIO, rng)
    signals = rng.standard_normal((len(modes), len(FEEDING.signals)))
    signals[:, 0] = modes[:, 0]
    found = Differences(modes, signals, np.zeros(len(modes)), np.ones(scenarios), np.zeros(len(modes)))
    learned, chance = FEEDING.signals[:2]
    known = fit_response_surface.share(FEEDING, found, found.fit(FEEDING).predict(modes)[0])
    unseen = fit_response_surface.share(FEEDING, found, fit_response_surface.foreseen(FEEDING, found))
    assert unseen[learned] > 0.9
    assert known[chance] > 0.05
    assert unseen[chance] < 0.0


def test_signals_that_are_hardly_foreseen_are_told_of_with_what_to_do() -> None:
    record = {"scenarios": [100, 109], "explained_share": {"speed_m_s": 0.6, "distance_m": 0.5}}
    assert not fit_response_surface.little_foreseen(record, FEEDING), "as records of earlier versions have it"
    record["foreseen_share"] = {"speed_m_s": 0.5, "distance_m": -0.4}
    few = fit_response_surface.little_foreseen(record, FEEDING)
    assert "How ways change distance_m (0%) is hardly foreseen" in few
    assert "explore --task feeding --scenarios 100" in few
    many = fit_response_surface.little_foreseen({**record, "scenarios": [100, 149]}, FEEDING)
    assert "--scenarios" not in many
    assert "wrap the environment" in many
