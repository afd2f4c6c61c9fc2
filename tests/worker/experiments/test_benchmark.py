"""The benchmark's command on the real simulation, as tiny as it goes: cells, resuming, tables."""

import csv
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

from worker import cli
from worker.analysis.comparison.comparison_rows import compared
from worker.commands import benchmarking, options
from worker.experiments import benchmark, benchmark_cell
from worker.experiments.benchmark import PROFILES, Selection
from worker.experiments.benchmark_cell import OPPOSED_USERS, PAPER_USERS, BenchmarkConfig, Cell
from worker.ml.filters.fitting.filter_problem import FilterConfig
from worker.ml.methods.registry import METHODS
from worker.ml.teachers import Taste

SHY = Taste("shy", (1.0, 3.0, 2.0, 2.0, 1.0, 1.0))
TINY = replace(
    PROFILES["quick"],
    labels=12,
    scenarios=3,
    methods=replace(PROFILES["quick"].methods, printed_steps=5),
    smallest_pool=2,
    filter=FilterConfig(mode_attempts=1, gates=(), gate_scenarios=3, residual_rounds=0),
)


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A benchmark of two users that has been run once, in this process."""
    directory = tmp_path_factory.mktemp("benchmark")
    for method in ("reference", "pbarl"):
        for taste in (PAPER_USERS["cautious"], SHY):
            benchmark_cell.run_cell(Cell("feeding", taste, method, 0), TINY, directory)
    return directory


def rows(path: Path) -> list[dict[str, str]]:
    """A CSV file."""
    with path.open() as handle:
        return list(csv.DictReader(handle))


def report(work: Path, output: Path, terms: BenchmarkConfig = TINY) -> int:
    """Write the tables and run nothing."""
    return benchmark.benchmark(Selection(), terms, work, output, "the command", None)


@pytest.mark.long
def test_the_tables_are_written_from_whatever_is_finished(work: Path, tmp_path: Path) -> None:
    assert report(work, tmp_path) == 0
    table = rows(tmp_path / "table1.csv")
    assert [(row["user"], row["method"]) for row in table] == [
        ("cautious", "reference"),
        ("cautious", "pbarl"),
        ("shy", "reference"),
        ("shy", "pbarl"),
    ]
    assert {(row["labels"], row["scenarios"], row["seeds"]) for row in table} == {("12", "3", "1")}
    matrix = rows(tmp_path / "personalisation.csv")
    assert len(matrix) == 4
    shy = [row for row in rows(tmp_path / "users.csv") if row["user"] == "shy"]
    assert [row["weight"] for row in shy] == ["1", "3", "2", "2", "1", "1"]
    page = (tmp_path / "table1.md").read_text()
    assert f"as a hash: {benchmark_cell.code_mark()} (4 runs)." in page
    assert "    the command\n" in page
    assert not (tmp_path / "paired.csv").exists(), "no baseline was run"
    assert not (tmp_path / "pareto-feeding.svg").exists(), "there is one method to choose"
    assert len(rows(tmp_path / "costs.csv")) == 4


def test_pictures_show_users_for_whom_methods_can_be_compared() -> None:
    alone = [{"task": "feeding", "user": "shy", "method": method} for method in ("reference", "pbarl")]
    elsewhere = [{**row, "task": "drinking"} for row in alone]
    several = [{"task": "feeding", "user": "cautious", "method": method} for method in ("reference", "pbarl", "prefft")]
    assert compared([*alone, *several, *elsewhere]) == several
    assert compared(alone) == alone


@pytest.mark.long
def test_cells_of_other_terms_are_not_mixed_in(work: Path, tmp_path: Path) -> None:
    assert report(work, tmp_path, replace(TINY, labels=13)) == 0
    assert not list(tmp_path.iterdir())


@pytest.mark.long
def test_a_cell_run_again_gives_the_same_numbers(work: Path, tmp_path: Path) -> None:
    report(work, tmp_path / "before")
    benchmark_cell.run_cell(Cell("feeding", SHY, "pbarl", 0), TINY, work)
    report(work, tmp_path / "after")
    assert (tmp_path / "before" / "table1.csv").read_text() == (tmp_path / "after" / "table1.csv").read_text()


@pytest.mark.long
def test_an_interrupted_benchmark_runs_what_is_missing_and_nothing_else(work: Path, tmp_path: Path) -> None:
    cells = Selection(["pbarl_n1"], ["feeding"], [SHY]).cells()
    assert [cell.method for cell in cells] == ["reference", "pbarl_n1"]
    reference, missing = (cell.path(TINY, work) for cell in cells)
    written = reference.stat().st_mtime_ns
    selection = Selection(["pbarl_n1"], ["feeding"], [SHY])
    assert (
        benchmark.benchmark(selection, TINY, work, tmp_path, "the command", partial(benchmark.on_this_machine, 1)) == 0
    )
    assert missing.exists()
    assert reference.stat().st_mtime_ns == written
    assert "pbarl_n1" in [row["method"] for row in rows(tmp_path / "table1.csv")]


def test_every_seed_is_judged_in_scenarios_of_its_own() -> None:
    terms = BenchmarkConfig(scenarios=30)
    assert len({scenario for seed in range(3) for scenario in terms.unseen(seed)}) == 3 * 30


def test_the_reference_policy_comes_first_and_a_seed_is_finished_before_the_next() -> None:
    cells = Selection(["prefft", "pbarl"], ["feeding"], list(PAPER_USERS.values()), seeds=2).cells()
    assert [cell.method for cell in cells[:4]] == ["reference"] * 3 + ["pbarl"]
    assert [cell.seed for cell in cells] == [0] * 9 + [1] * 9


def test_the_quick_profile_does_everything_a_little() -> None:
    quick, full = PROFILES["quick"], PROFILES["full"]
    assert (full.labels, full.scenarios, full.methods.fine_tuning.steps) == (200, 500, 100_000)
    assert quick.methods.fine_tuning.steps < 5_000
    assert set(Selection().methods) == set(METHODS)
    assert len(full.pool) == 48
    assert len(replace(full, labels=5000).pool) == 334


def test_users_are_named_or_given_by_their_weights() -> None:
    assert options.taste("slow") == OPPOSED_USERS["slow"]
    assert options.taste("shy=1,3,2,2,1,1") == SHY
    level = options.taste("level=1,1,1,1,1,1,tilt_rad:0.3")
    assert (level.omega, level.per_signal) == ((1.0,) * 6, {"tilt_rad": 0.3})
    unknown_signal = "shy=1,1,1,1,1,1,noise:1"
    for wrong in ("nobody", "shy=1,2", "neutral=1,1,1,1,1,1", "a/b=1,1,1,1,1,1", "shy=a,1,1,1,1,1", unknown_signal):
        with pytest.raises(Exception, match="is none of"):
            options.taste(wrong)


def test_the_command_can_only_report(tmp_path: Path) -> None:
    arguments = ["benchmark", "--profile", "quick", "--report-only", "--work-directory", str(tmp_path)]
    assert cli.run(arguments) == 0
    assert not (tmp_path / "quick").exists()


@pytest.mark.parametrize(
    "how",
    ["", " --work-directory /somewhere --report-only", " --processes 1 --output=here/table", " --output here/table"],
)
def test_a_table_says_what_was_measured_and_not_on_whose_machine(how: str) -> None:
    command = f"benchmark --methods reference pbarl{how} --tasks feeding --seeds 1"
    assert benchmarking.what_is_measured(command.split()) == (
        ["benchmark", "--methods", "reference", "pbarl", "--tasks", "feeding", "--seeds", "1"]
    )


@pytest.mark.parametrize("wrong", [["--mistakes", "5"], ["--mistakes", "nan"], ["--rationality", "0"]])
def test_users_who_cannot_err_in_that_way_are_refused_in_words(
    wrong: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        cli.parser().parse_args(["benchmark", *wrong])
    assert "number" in capsys.readouterr().err
