"""Table I and the personalisation matrix, from runs with known answers."""

import csv
import io
import json
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from scipy import stats

from worker.analysis.comparison import comparison_page, comparison_rows, result_pages
from worker.analysis.comparison.comparison_rows import EvaluatedCell, pooled, table_rows
from worker.analysis.comparison.pareto import pareto_svg, pictures
from worker.analysis.comparison.published import TABLE_1, published
from worker.analysis.comparison.table_files import tables, to_csv
from worker.analysis.filters.evaluation import success_change
from worker.ml.methods.registry import METHODS

USERS = ("neutral", "cautious", "impatient")
N = 40
TABLE_COLUMNS = (
    "task,user,method,labels,seeds,scenarios,success,success_low,success_high,"
    "success_delta,success_delta_low,success_delta_high,preference,preference_low,preference_high,"
    "preference_delta,preference_delta_low,preference_delta_high,true_preference,true_preference_low,"
    "true_preference_high,true_preference_delta,true_preference_delta_low,true_preference_delta_high"
)
MATRIX_COLUMNS = (
    "task,trained_for,judged_by,labels,gain,gain_low,gain_high,success_delta,"
    "own_advantage,own_advantage_low,own_advantage_high"
)
HARDNESS = np.random.default_rng(0).normal(0.0, 5.0, N)
"""Scenarios differ far more than methods do."""


def run(user: str, method: str, better: Sequence[float] = (0, 0, 0), seed: int = 0, lost: int = 0) -> EvaluatedCell:
    """A run with true returns -20 for everybody, more by ``better``; ``lost``: episodes that fail."""
    success = np.ones(N)
    success[:lost] = 0.0
    return EvaluatedCell(
        task="feeding",
        user=user,
        method=method,
        seed=seed,
        labels=200,
        success=success,
        preference=HARDNESS + better[USERS.index(user)],
        true_returns={judge: HARDNESS - 20.0 + gain for judge, gain in zip(USERS, better, strict=True)},
        stakes={judge: 20.0 - HARDNESS - gain for judge, gain in zip(USERS, better, strict=True)},
        costs=np.tile(HARDNESS[:, None] + 100.0 + better[0], (1, 6)),
        spent={"labels": 200, "environment_steps": 1000, "cpu_s": 4.0 + seed, "wall_s": 5.0},
        notes=("said so",),
    )


RUNS = [
    *(run(user, "reference") for user in USERS),
    run("neutral", "pbarl", (4, 1, -2), lost=2),
    run("cautious", "pbarl", (2, 6, -4)),
    run("impatient", "pbarl", (5, -4, 8)),
    run("neutral", "prefft", (1, 0, 0), lost=20),
]


def test_changes_are_paired_by_scenario() -> None:
    row = next(row for row in table_rows(pooled(RUNS)) if (row["user"], row["method"]) == ("cautious", "pbarl"))
    assert row["true_preference_delta"] == pytest.approx(6.0)
    assert row["true_preference_delta_high"] - row["true_preference_delta_low"] < 1e-9
    assert row["true_preference_high"] - row["true_preference_low"] > 2.0
    assert (row["success"], row["success_delta"]) == (1.0, 0.0)


def test_the_reference_policy_does_not_differ_from_itself() -> None:
    row = table_rows(pooled(RUNS))[0]
    assert row["method"] == "reference"
    assert [row[f"success_delta{end}"] for end in ("", "_low", "_high")] == [0.0, 0.0, 0.0]


def test_the_episodes_of_all_seeds_count_alike() -> None:
    other = run("neutral", "pbarl", (8, 0, 0), seed=1)
    by_name = {
        (row["user"], row["method"]): row
        for row in table_rows(pooled([*RUNS, run("neutral", "reference", seed=1), other]))
    }
    row = by_name["neutral", "pbarl"]
    assert (row["seeds"], row["scenarios"]) == (2, N)
    assert row["true_preference_delta"] == pytest.approx(6.0)
    assert row["success"] == pytest.approx(1.0 - 1 / N)


def test_every_episode_of_another_seed_narrows_the_interval() -> None:
    """Seeds have scenarios of their own, so two seeds are twice as many episodes."""
    second = [run("neutral", "reference", seed=1), run("neutral", "pbarl", (4, 1, -2), lost=2, seed=1)]

    def width(runs: Sequence[EvaluatedCell]) -> float:
        row = next(row for row in table_rows(pooled(runs)) if (row["user"], row["method"]) == ("neutral", "pbarl"))
        return float(row["true_preference_high"] - row["true_preference_low"])

    quantiles = stats.t.ppf(0.975, 2 * N - 1) / stats.t.ppf(0.975, N - 1)
    assert width([*RUNS, *second]) == pytest.approx(width(RUNS) * quantiles / 2**0.5, rel=0.02)


def test_methods_and_users_are_compared_in_the_seeds_they_share() -> None:
    """An unfinished second seed of one user must not be set against the first of another."""
    lucky = [run("neutral", "reference", seed=1), run("neutral", "pbarl", (100, 0, 0), seed=1)]
    before, after = (pooled(runs) for runs in (RUNS, [*RUNS, *lucky]))
    assert comparison_rows.against(after, "pbarl", "prefft") == comparison_rows.against(before, "pbarl", "prefft")
    advantages = [
        next(row["own_advantage"] for row in rows if row["trained_for"] == row["judged_by"] == "neutral")
        for rows in (comparison_rows.personalisation_rows(cells, "pbarl", [USERS]) for cells in (before, after))
    ]
    assert advantages[1] == pytest.approx(advantages[0])


MADE = {
    "commands": ["the command"],
    "cells": 7,
    "seeds": [0],
    "labels": 200,
    "manner": "5 % mistakes",
    "pool_scenarios": 48,
    "rule": "entropy",
    "reward": "structured",
    "form": "calibrated",
    "scenarios": N,
    "first_scenario": 4_000_000,
    "prefft_steps": 10,
    "pbrl_hri_steps": 10,
    "printed_steps": 10,
    "versions": "Python 3",
    "policies": {"feeding": "abc"},
    "code": {"def": 7},
    "groups": [USERS],
}


def page_of(folder: Path, runs: Sequence[EvaluatedCell]) -> str:
    """What stands on the page of these runs, by way of the files that it is made from."""
    for name, rows in tables(pooled(runs), [USERS], [{"user": "neutral", "item": "C_d", "weight": 1.0}]).items():
        (folder / f"{name}.csv").write_text(to_csv(rows))
    (folder / "made.json").write_text(json.dumps(MADE))
    return comparison_page.page(folder)


def test_the_page_says_what_each_seed_alone_says(tmp_path: Path) -> None:
    assert "Seed by seed" not in page_of(tmp_path, RUNS)
    second = [
        run("neutral", "reference", seed=1),
        run("cautious", "reference", seed=1),
        run("neutral", "pbarl", (3, 1, 0), seed=1),
        run("cautious", "pbarl", (5, 2, 0), seed=1),
    ]
    page = page_of(tmp_path, [*RUNS, *second])
    first, other = page.split("Seed by seed")[1].split("* Seed ")[1:3]
    unit = abs(HARDNESS.mean() - 20.0)
    assert f"feeding, neutral: {100 * (4 - 5) / unit:+.1f} [" in first, "the impatient user's filter is better"
    assert f"feeding, neutral: {100 * (3 - 5) / unit:+.1f} [" in other, "the cautious user's"
    assert "in 2 of 3 columns" in first
    assert "in 1 of 2 columns" in other, "the impatient user has one seed"


def test_what_somebody_has_written_on_top_of_a_page_stays(tmp_path: Path) -> None:
    page = page_of(tmp_path, RUNS)
    (tmp_path / "table1.md").write_text(page.replace(comparison_page.HEAD, "# Mine"))
    assert page_of(tmp_path, RUNS[:-1]).startswith(f"# Mine\n\n{result_pages.MARK}\n")


def test_a_run_whose_reference_is_missing_waits_for_it() -> None:
    cells = pooled([*RUNS, run("neutral", "pbarl", (9, 0, 0), seed=7)])
    assert len(cells["feeding", "neutral", "pbarl"].runs) == 1
    assert pooled([run("neutral", "pbarl")]) == {}


def test_the_files_have_the_promised_columns() -> None:
    cells = pooled(RUNS)
    assert to_csv(table_rows(cells)).splitlines()[0] == TABLE_COLUMNS
    matrix = to_csv(comparison_rows.personalisation_rows(cells, "pbarl", [USERS]))
    assert matrix.splitlines()[0] == MATRIX_COLUMNS
    assert len(matrix.splitlines()) == 1 + 9


def test_own_advantage_is_over_the_best_of_the_others_and_on_the_diagonal_only() -> None:
    rows = comparison_rows.personalisation_rows(pooled(RUNS), "pbarl", [USERS])
    found = {(row["trained_for"], row["judged_by"]): row for row in rows}
    assert found["cautious", "cautious"]["gain"] == pytest.approx(6.0 / abs(HARDNESS.mean() - 20.0))
    assert found["neutral", "neutral"]["own_advantage"] < 0 < found["cautious", "cautious"]["own_advantage"]
    unit = abs(HARDNESS.mean() - 20.0)
    assert found["impatient", "impatient"]["own_advantage"] == pytest.approx((8 + 2) / unit)
    assert found["neutral", "cautious"]["own_advantage"] == ""


def test_gains_of_somebody_who_also_likes_things_are_shares_of_all_that_matters_to_them() -> None:
    """Likes and dislikes may cancel out in the return; a share of next to nothing would say nothing."""
    runs = [
        replace(each, true_returns={judge: returns + 20.0 for judge, returns in each.true_returns.items()})
        for each in RUNS
    ]
    rows = comparison_rows.personalisation_rows(pooled(runs), "pbarl", [USERS])
    found = {(row["trained_for"], row["judged_by"]): row for row in rows}
    assert found["cautious", "cautious"]["gain"] == pytest.approx(6.0 / (20.0 - HARDNESS.mean()))


@pytest.mark.parametrize("default", ["pbarl_archived", "pbarl_refined"])
def test_the_default_of_some_tasks_is_judged_by_everybody_where_it_stands_alone(default: str) -> None:
    refined = [replace(each, method=default) if each.method == "pbarl" else each for each in RUNS]
    alone, beside = (tables(pooled(runs), [USERS], []) for runs in (refined, [*refined, *RUNS[3:6]]))
    quick = tables(pooled(RUNS), [USERS], [])
    assert alone["personalisation"] == beside["personalisation"] == quick["personalisation"] != []


def test_users_of_different_groups_are_not_compared() -> None:
    rows = comparison_rows.personalisation_rows(pooled(RUNS), "pbarl", [("neutral", "cautious"), ("impatient",)])
    found = {(row["trained_for"], row["judged_by"]): row for row in rows}
    assert found["impatient", "impatient"]["own_advantage"] == ""
    assert found["neutral", "neutral"]["own_advantage"] > 0


def test_the_page_stands_beside_the_papers_numbers_and_says_where_the_claim_fails(tmp_path: Path) -> None:
    page = page_of(tmp_path, RUNS)
    assert "| neutral | `pbarl` | 1 | -5.0 [" in page
    assert "] | -4 | +4.0 [" in page, "the paper's change beside ours"
    assert "| +39.5 |" in page
    assert "keeps the task (loses at most 5 points of success): 3 of 3.\n" in page
    assert "`prefft`, 1 pairs of task and user: by R-hat ahead in 1, behind in 0" in page
    assert "`pbrl_hri`" not in page, "what has not been run is not listed"
    worse = [each if each.method != "pbarl" else replace(each, success=np.zeros(N)) for each in RUNS]
    assert "2 of 3" not in page_of(tmp_path, worse).split("## Where")[0]
    assert "of success): 0 of 3: all but\n  * feeding, neutral\n" in page_of(tmp_path, worse)


def test_a_baseline_that_is_better_is_named_with_its_numbers(tmp_path: Path) -> None:
    better = [*RUNS[:-1], run("neutral", "prefft", (9, 0, 0))]
    page = page_of(tmp_path, better)
    assert "by R-hat ahead in 0, behind in 1; by r^H ahead in 0, behind in 1." in page
    assert "| feeding, neutral | `prefft` | -5.0 [-5.0, -5.0] | -5.00 [-5.00, -5.00] | -5.0 [" in page


def test_time_is_averaged_over_users_and_seeds() -> None:
    cells = pooled([*RUNS, run("neutral", "reference", seed=1), run("neutral", "pbarl", seed=1)])
    row = next(row for row in comparison_rows.spent_rows(cells) if row["method"] == "pbarl")
    assert (row["fits"], row["cpu_s"]) == (4, pytest.approx(4.25))


def test_the_paper_lost_success_wherever_it_gained_preference() -> None:
    """Copied numbers: their changes are those that the paper prints beside them."""
    changes = {
        (task, user, method): (success - of["reference"][0], round(gain - of["reference"][1], 1))
        for (task, user), of in TABLE_1.items()
        for method, (success, gain) in of.items()
    }
    assert changes["feeding", "neutral", "pbarl"] == (-4, 39.5)
    assert changes["drinking", "impatient", "prefft"] == (-11, 22.7)
    assert changes["scratching", "impatient", "pbarl"] == (-4, 40.9)
    assert published("feeding", "neutral", "pbarl_printed") == published("feeding", "neutral", "pbarl")
    assert published("feeding", "neutral", "best_of_n") is None


def test_success_averaged_over_repetitions_has_an_interval_too() -> None:
    halves = np.full(N, 0.5)
    change = success_change(np.ones(N), halves)
    assert change["low"] < change["delta"] == -0.5 < change["high"]


def marks_of(rows: list[comparison_rows.Row]) -> list[ElementTree.Element]:
    """The circles of the picture, each with the method as its title."""
    drawn = ElementTree.fromstring(pareto_svg("feeding", rows, list(METHODS)))  # noqa: S314  (drawn by ourselves)
    return drawn.findall(".//{*}circle[{*}title]")


def test_the_picture_is_valid_and_has_a_mark_per_method_and_user() -> None:
    rows = table_rows(pooled(RUNS))
    titled = [mark[0].text or "" for mark in marks_of(rows)]
    assert sorted(titled) == sorted(row["method"] for row in rows)
    assert list(csv.reader(io.StringIO(to_csv([])))) == []


@pytest.mark.parametrize("users", [1, 3, 24])
def test_the_panels_of_many_users_can_be_told_apart(users: int) -> None:
    one = [row for row in table_rows(pooled(RUNS)) if row["user"] == "neutral"]
    rows = [{**row, "user": f"person-{number}"} for number in range(users) for row in one]
    picture = ElementTree.fromstring(pareto_svg("feeding", rows, list(METHODS)))  # noqa: S314  (drawn by ourselves)
    _, _, width, height = map(float, picture.attrib["viewBox"].split())
    panels = [each for each in picture.findall("{*}rect") if each.get("fill") == "none"]
    assert len(panels) == users
    boxes = [[float(each.attrib[side]) for side in ("x", "y", "width", "height")] for each in panels]
    for x, y, wide, high in boxes:
        assert x + wide <= width
        assert y + high <= height
        assert wide > 0.2 * width, "on a page that is as wide as the picture"
    for (x, y, wide, high), (other_x, other_y, _, _) in combinations(boxes, 2):
        assert abs(x - other_x) > wide or abs(y - other_y) > high


def test_a_picture_shows_methods_to_choose_between_and_none_that_fails_the_task() -> None:
    rows = table_rows(pooled(RUNS))
    [(name, without)] = pictures(rows, list(METHODS))
    assert name == "pareto-feeding.svg"
    keeping = [{**row, "success_delta": -0.1} if row["method"] == "prefft" else row for row in rows]
    [(_, drawn)] = pictures(keeping, list(METHODS))
    assert "<title>prefft</title>" in drawn
    assert "<title>prefft</title>" not in without
    assert not list(pictures([row for row in rows if row["method"] != "prefft"], list(METHODS)))


def test_a_method_keeps_its_colour_in_a_picture_without_the_others() -> None:
    rows = table_rows(pooled(RUNS))

    def colour(shown: list[comparison_rows.Row]) -> str | None:
        return next(mark.get("fill") for mark in marks_of(shown) if mark[0].text == "prefft")

    assert colour(rows) == colour([row for row in rows if row["method"] == "prefft"])
