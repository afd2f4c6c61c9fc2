"""Objects that a lab.toml names as ``module:name``: a file beside it first, else a module that is installed."""

import importlib.util
import sys
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

from worker.sim.lab.errors import LabTaskBroken


def named_object(folder: Path, key: str, reference: str) -> Any:
    """What ``reference`` stands for in the lab.toml of a folder. Raises LabTaskBroken."""
    module, _, name = reference.partition(":")
    try:
        found = getattr(_module(folder, module), name)
    except Exception as error:  # whatever code from elsewhere may do when it is imported
        raise LabTaskBroken(
            key,
            f"{reference!r} cannot be imported ({type(error).__name__}: {error}). Put {module}.py beside lab.toml or "
            "install its package, and check the name after the colon.",
        ) from error
    if not callable(found):
        raise LabTaskBroken(key, f"{reference!r} is no function.")
    return found


def _module(folder: Path, name: str) -> ModuleType:
    """Two labs may each have a file of the same name, so such a file is known under the path of its folder."""
    file = folder / f"{name}.py"
    if not file.is_file():
        return import_module(name)
    known = f"lab_task_{abs(hash(str(file)))}_{name}"
    if known not in sys.modules:
        spec = importlib.util.spec_from_file_location(known, file)
        assert spec is not None  # noqa: S101 -- a file that ends in .py has a loader
        assert spec.loader is not None  # noqa: S101
        module = importlib.util.module_from_spec(spec)
        sys.modules[known] = module
        try:
            spec.loader.exec_module(module)
        except BaseException:
            del sys.modules[known]
            raise
    return sys.modules[known]
