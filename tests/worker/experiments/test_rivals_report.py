"""The page of rivals says what its rows say, what is worse as plainly as what is better."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from tests.benchmarks import result_tables, rivals_picture, rivals_report
from worker.domain.type_aliases import FloatArray


def row(method: str, gains: FloatArray, successes: FloatArray, seed: int = 0) -> Mapping[str, Any]:
    return {
        "task": "feeding",
        "user": "neutral",
        "method": method,
        "seed": seed,
        "labels": "200",
        "environment_steps": "50000",
        "cpu_s": "60",
        "measured": f"2026-11-2{seed}",
        "gains": rivals_report.gains_text(gains),
        "successes": rivals_report.successes_text(successes),
        "successes_reference": rivals_report.successes_text(np.ones(100)),
    }


def test_episodes_survive_the_table() -> None:
    gains = np.array([0.1234, -0.5, 0.0])
    stored = row("pbarl", gains, np.array([1.0, 0.0, 1.0]))
    np.testing.assert_allclose(rivals_report.gains_of(stored), gains, atol=5e-4)
    assert rivals_report.successes_of(stored).tolist() == [1.0, 0.0, 1.0]


def test_a_better_rival_is_named_with_what_it_does_to_the_task() -> None:
    noise = 0.01 * np.random.default_rng(0).standard_normal(100)
    lossy = (np.arange(100) >= 10).astype(float)
    page = rivals_report.page(
        [
            row("pbarl_archived", 0.10 + noise, np.ones(100)),  # the default in Feeding
            row("sliders", 0.05 + noise, np.ones(100)),
            row("dsrl", 0.20 + noise, np.ones(100)),
            row("residual_rl", 0.30 + noise, lossy),
            row("prefft", 0.30 + noise, lossy, seed=1),  # the default has no such seed
        ]
    )
    assert page.startswith("5 of 945 cells ")
    assert "Not begun: `pbarl`, " in page
    assert "`dsrl_flow`" in page.partition("Not begun: ")[2].splitlines()[0]
    assert "`dsrl`," not in page.splitlines()[0]
    assert "The default is `pbarl_archived` in feeding;" in page
    assert "Of 3 comparisons the rival is behind in 1, within the interval in 0, and ahead in 2:" in page
    assert "`dsrl` by +10.0 [+10.0, +10.0]; success +0.0 points (keeps the task)." in page
    assert "`residual_rl` by +20.0 [+20.0, +20.0]; success -10.0 points (loses the task)." in page
    assert "| `sliders` | 1 | +5" in page
    assert "| `prefft` |" not in page.partition("## All cells together")[2].partition("## Cell by cell")[0]


def test_seeds_together_judge_the_method_where_each_judges_its_training() -> None:
    """Three narrow intervals, one of them ahead; over the seeds chance explains it."""
    noise, ones = 0.001 * np.random.default_rng(0).standard_normal(100), np.ones(100)
    rows = [
        row(method, gain + noise, ones, seed)
        for method, gains in {
            "pbarl_archived": (0.10, 0.11, 0.12),
            "dsrl": (0.13, 0.09, 0.11),
            "sliders": (0.05,) * 3,
        }.items()
        for seed, gain in enumerate(gains)
    ]
    page = rivals_report.page([*rows, row("prefft", 0.3 + noise, ones), row("prefft", 0.3 + noise, ones, seed=1)])
    over_seeds = page.partition("## Where a rival is not behind over seeds")[2].partition("## All cells")[0]
    assert "* feeding, neutral, seed 0: `dsrl` by +3.0 [+3.0, +3.0]" in page
    # Differences of 3, -2 and -1 points: mean 0, standard error 1.53, t with two degrees of freedom 4.30.
    assert "Behind in 1 of 2 comparisons; in the others:" in over_seeds
    assert "`dsrl` by +0.0 [-6.6, +6.6] (within); success +0.0 points in the worst of them." in over_seeds
    assert "prefft" not in over_seeds, "two seeds say too little"
    # The three runs: standard error .58.
    assert "| `pbarl_archived` | +11.0 [+8.5, +13.5], 3 |" in page
    assert "| `dsrl` | 2026-11-20 to 2026-11-22 |" in page


def test_no_table_is_no_rows(tmp_path: Any) -> None:
    assert result_tables.read(tmp_path / "missing.csv") == []


@pytest.mark.parametrize("method", ["pbarl", "dsrl"])
def test_what_a_fit_needs_is_told(method: str) -> None:
    assert f"| `{method}` | 1 | 200 | 50000 | 60 |" in rivals_report.page([row(method, np.zeros(100), np.ones(100))])


def test_a_table_whose_writing_fails_stays_as_it_was(tmp_path: Any) -> None:
    table = tmp_path / "rows.csv"
    result_tables.write(table, [{"user": "neutral", "gain": 1.5}])
    with pytest.raises(ValueError, match="gain"):
        result_tables.write(table, [{"user": "neutral"}, {"user": "cautious", "gain": 2.5}])
    assert result_tables.read(table) == [{"user": "neutral", "gain": "1.5"}]


def test_the_folder_of_a_table_is_there_before_its_rows(tmp_path: Any) -> None:
    table = result_tables.stem(f"{tmp_path}/new/folder/rows").with_suffix(".csv")
    result_tables.write(table, [{"user": "neutral"}])
    assert result_tables.read(table) == [{"user": "neutral"}]


def test_the_picture_has_every_training_and_says_what_lies_beyond_its_edge() -> None:
    few, ones, half = np.full(100, 0.2), np.ones(100), (np.arange(100) % 2).astype(float)
    rows = [row("pbarl_archived", few, ones, seed) for seed in range(3)]
    lossy = [row("dsrl", few, half), row("prefft", few - 0.6, half)]

    def marks(rows: list[Mapping[str, Any]]) -> int:
        return rivals_picture.svg(rows).decode().count("<use ")

    assert marks([*rows, *lossy]) - marks([]) == len([*rows, *lossy])
    assert ">-40</text>" in rivals_picture.svg([*rows, *lossy]).decode()
    assert ">pbarl_n1</text>" in rivals_picture.svg([row("pbarl_n1", few, ones)]).decode(), "not among those aimed at"


def test_who_loses_as_much_as_is_tolerated_keeps_the_task() -> None:
    """2 of 100 and 10 of 500 are 2 points; as differences of shares 99 of 100 less 97 of 100 are a little more."""
    episodes = np.arange(100)
    for before, after, keeps in ((100, 98, True), (99, 97, True), (97, 95, True), (99, 96, False)):
        each = {**row("pbarl", np.zeros(100), (episodes < after).astype(float))}
        each["successes_reference"] = rivals_report.successes_text(episodes < before)
        assert rivals_report.keeps_task(each) == keeps
