"""What the web server loads, and that imports go one way."""

import subprocess
import sys
from graphlib import TopologicalSorter
from pkgutil import resolve_name

import grimp
import pytest

from app.domain.models import RunKind
from worker.jobs import workflows

HEAVY = ("torch", "pybullet", "numpy", "imageio", "av", "dbos", "worker")


def python(code: str) -> str:
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip()


def test_the_web_server_loads_nothing_of_the_learning_stack() -> None:
    loaded = python(f"import sys, app.main; print([name for name in {HEAVY!r} if name in sys.modules])")
    assert loaded == "[]"


def test_the_worker_starts_without_the_learning_stack() -> None:
    """Whoever starts it waits for less; what learns is loaded once somebody has answered."""
    heavy = ("torch", "scipy", "matplotlib", "pandas", "onnxruntime")
    code = f"import sys, worker.commands.service; print([name for name in {heavy!r} if name in sys.modules])"
    assert python(code) == "[]"


@pytest.mark.parametrize("kind", RunKind)
def test_every_kind_of_work_has_somebody_who_does_it(kind: RunKind) -> None:
    body = workflows.BODIES[kind]
    assert isinstance(body, workflows.Imported)
    assert callable(resolve_name(body.name))


def test_the_domain_loads_nothing_of_the_web() -> None:
    code = "import sys, app.domain.studies; print([n for n in ('fastapi', 'starlette', 'jinja2') if n in sys.modules])"
    assert python(code) == "[]"


def test_no_module_imports_itself_by_way_of_others() -> None:
    """Imports within functions count: whoever reads a module should not have to read it again first."""
    graph = grimp.build_graph("app", "worker")
    imports = {module: graph.find_modules_directly_imported_by(module) for module in graph.modules}
    assert len(imports) > 200
    TopologicalSorter(imports).prepare()  # raises CycleError, which names the circle
