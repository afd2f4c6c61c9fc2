"""The page of rivals says what its rows say, what is worse as plainly as what is better."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from tests.benchmarks import result_tables, rivals_report
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
            row("pbarl_refined", 0.10 + noise, np.ones(100)),  # the default in Feeding
            row("sliders", 0.05 + noise, np.ones(100)),
            row("dsrl", 0.20 + noise, np.ones(100)),
            row("residual_rl", 0.30 + noise, lossy),
            row("prefft", 0.30 + noise, lossy, seed=1),  # the default has no such seed
        ]
    )
    assert "The default is `pbarl_refined` in feeding;" in page
    assert "Of 3 comparisons the rival is behind in 1, within the interval in 0, and ahead in 2:" in page
    assert "`dsrl` by +10.0 [+10.0, +10.0]; success +0.0 points (keeps the task)." in page
    assert "`residual_rl` by +20.0 [+20.0, +20.0]; success -10.0 points (loses the task)." in page
    assert "| `sliders` | 1 | +5" in page
    assert "| `prefft` |" not in page.partition("## All cells together")[2].partition("## Cell by cell")[0]


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
