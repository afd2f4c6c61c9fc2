"""Filters whose graph some process of this run has traced: that takes seconds, and every process needs the same few."""

import hashlib
import os
from pathlib import Path

import onnx
import pytest

from worker.ml.filters.exported import filter_onnx
from worker.whole_files import written_whole


class Traced(dict[tuple[object, ...], onnx.ModelProto]):
    """What filter_onnx remembers by structure, and a folder in which other processes find it."""

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self._folder = folder

    def __contains__(self, structure: object) -> bool:
        if not super().__contains__(structure) and (file := self._file(structure)).exists():
            self[structure] = onnx.load(file)  # type: ignore[index]
        return super().__contains__(structure)

    def __setitem__(self, structure: tuple[object, ...], template: onnx.ModelProto) -> None:
        super().__setitem__(structure, template)
        if not (file := self._file(structure)).exists():
            with written_whole(file) as draft:
                draft.write_bytes(template.SerializeToString())

    def _file(self, structure: object) -> Path:
        return self._folder / f"{hashlib.sha256(repr(structure).encode()).hexdigest()}.onnx"


@pytest.fixture(scope="session", autouse=True)
def traced_once(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Graphs are traced once per run, not once per process; to_onnx() compares every filter with torch all the same."""
    folder = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        folder = folder.parent  # of all processes
    filter_onnx._templates = Traced(folder)
