"""A cell of the benchmark that another machine is asked for, as text."""

from dataclasses import dataclass
from pathlib import Path

from pydantic import TypeAdapter

from worker.experiments.benchmark_cell import BenchmarkConfig, Cell, code_mark, run_cell


@dataclass(frozen=True)
class AskedCell:
    """A cell, and which state of the code it is to be made with."""

    cell: Cell
    terms: BenchmarkConfig
    code: str


_ASKED = TypeAdapter(AskedCell)


def as_text(cell: Cell, terms: BenchmarkConfig) -> str:
    """What run_asked() takes."""
    return _ASKED.dump_json(AskedCell(cell, terms, code_mark())).decode()


def run_asked(asked: str, work: Path) -> bytes:
    """The finished cell's file. ``asked``: made by as_text(). Raises ValueError for other code, or another place."""
    told = _ASKED.validate_json(asked)
    if told.code != code_mark():
        raise ValueError(f"This worker's code is not that of whoever asks ({code_mark()}, {told.code}). Update one.")
    path = told.cell.path(told.terms, work)
    if not path.resolve().is_relative_to(work.resolve()):
        raise ValueError(f"A cell called {told.cell.taste.name!r} would lie outside the directory of cells.")
    return (path if path.exists() else run_cell(told.cell, told.terms, work)).read_bytes()
