"""Cells of the benchmark on the workers' queue: what one machine asks for another does, once, and nothing is lost."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import cast

import pytest
from dbos import DBOS

from app.db import Database, now
from app.settings import Settings
from tests.waiting import until
from worker.compute.pools import Compute
from worker.experiments import asked_cell, benchmark
from worker.experiments.benchmark_cell import PAPER_USERS, BenchmarkConfig, Cell
from worker.jobs import experiments
from worker.jobs.runtime import engine, records

TERMS = BenchmarkConfig()
CELLS = [Cell("feeding", PAPER_USERS["cautious"], method, 0) for method in ("reference", "pbarl")]
"""What the worker of these tests has done before: it has their files."""


@cache
def the_cell_runner() -> experiments.CellRunner:
    """The engine knows one per process; whoever borrows it gives it processes and a directory."""
    return experiments.CellRunner(cast("Compute", None), Path())


@pytest.fixture
def theirs(tmp_path: Path) -> Path:
    """The worker's directory, with a file for each of the cells."""
    for number, cell in enumerate(CELLS):
        path = cell.path(TERMS, tmp_path / "theirs")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"cell %d" % number)
    return tmp_path / "theirs"


@contextmanager
def worker(settings: Settings, database: Database, directory: Path) -> Iterator[None]:
    """A worker's engine in this process, with a sign of life."""
    runner, compute = the_cell_runner(), Compute(1)
    runner.compute, runner.directory = compute, directory
    with database.writing() as session:
        records.sign_presence(session, settings.worker_name, now())
    with engine.running(settings, database):
        try:
            yield
        finally:
            compute.close()
            DBOS.destroy()


def collected(settings: Settings, work: Path, cells: list[Cell] = CELLS) -> list[str]:
    return experiments.on_workers(settings, 1, cells, TERMS, work, lambda: None)


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(experiments, "POLL_S", 0.2)
    monkeypatch.setattr(experiments, "LOOK_S", 0.1)


def test_what_workers_have_done_lies_where_a_run_on_this_machine_would_have_put_it(
    settings: Settings, database: Database, theirs: Path, tmp_path: Path
) -> None:
    with worker(settings, database, theirs):
        assert collected(settings, tmp_path / "ours") == []
        assert [cell.path(TERMS, tmp_path / "ours").read_bytes() for cell in CELLS] == [b"cell 0", b"cell 1"]
        assert DBOS.list_workflows(workflow_id_prefix="cell/") == []


def test_an_interrupted_command_takes_back_what_nobody_has_begun_and_the_next_one_gets_everything(
    settings: Settings, database: Database, theirs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with worker(settings, database, theirs):
        pass  # it has made the engine's tables, and is away

    def interrupt(_seconds: float) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("worker.jobs.experiments.sleep", interrupt)
        with pytest.raises(KeyboardInterrupt):
            collected(settings, tmp_path / "ours")
    with worker(settings, database, theirs):
        assert {each.status for each in DBOS.list_workflows(workflow_id_prefix="cell/")} == {"CANCELLED"}
        assert collected(settings, tmp_path / "ours") == []
    assert all(cell.path(TERMS, tmp_path / "ours").exists() for cell in CELLS)


def test_a_worker_with_other_code_says_so(
    settings: Settings, database: Database, theirs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with worker(settings, database, theirs), monkeypatch.context() as patch:
        patch.setattr(asked_cell, "code_mark", lambda: "00000000")
        (failure,) = collected(settings, tmp_path / "ours", CELLS[:1])
    assert "worker's code is not that of whoever asks" in failure
    assert not CELLS[0].path(TERMS, tmp_path / "ours").exists()


def test_what_a_worker_that_never_comes_back_was_at_is_done_by_another(
    settings: Settings, database: Database, theirs: Path, tmp_path: Path
) -> None:
    begun, may_go_on = threading.Event(), threading.Event()

    class Held(Compute):
        def run(self, *_: object) -> bytes:  # type: ignore[override]  # asked for whatever, it hangs
            begun.set()
            may_go_on.wait()
            raise SystemExit  # the engine keeps no outcome: as if the process had gone

    first = replace(CELLS[0])
    lost = settings.model_copy(update={"worker_name": "lost"})
    asking = threading.Thread(target=collected, args=(settings, tmp_path / "ours", [first]))
    with worker(lost, database, theirs):
        the_cell_runner().compute = Held(1)
        asking.start()
        assert until(begun.is_set)
    with database.writing() as session:
        records.sign_presence(session, "lost", now() - 2 * records.LEASE)
    with worker(settings, database, theirs):
        asking.join()
    may_go_on.set()
    assert first.path(TERMS, tmp_path / "ours").read_bytes() == b"cell 0"


def test_a_cell_whose_name_leads_out_of_the_directory_is_refused(tmp_path: Path) -> None:
    outside = replace(PAPER_USERS["cautious"], name="../../../../outside")
    with pytest.raises(ValueError, match="outside the directory"):
        asked_cell.run_asked(asked_cell.as_text(replace(CELLS[0], taste=outside), TERMS), tmp_path / "work")


def test_whatever_the_terms_a_cell_is_the_same_after_it_was_told() -> None:
    """The worker must look for its file, and judge, by exactly the same terms."""
    for terms in benchmark.PROFILES.values():
        for taste in [*PAPER_USERS.values(), *benchmark.population(3)]:
            cell = Cell("drinking", taste, "pbarl", 3)
            told = asked_cell._ASKED.validate_json(asked_cell.as_text(cell, terms))
            assert (told.cell, told.terms) == (cell, terms)
