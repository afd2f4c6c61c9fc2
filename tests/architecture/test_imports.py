"""What the web server loads, and how fast."""

import subprocess
import sys

HEAVY = ("torch", "pybullet", "numpy", "imageio", "av", "dbos", "worker")


def python(code: str) -> str:
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip()


def test_the_web_server_loads_nothing_of_the_learning_stack() -> None:
    loaded = python(f"import sys, app.main; print([name for name in {HEAVY!r} if name in sys.modules])")
    assert loaded == "[]"


def test_the_domain_loads_nothing_of_the_web() -> None:
    code = "import sys, app.domain.studies; print([n for n in ('fastapi', 'starlette', 'jinja2') if n in sys.modules])"
    assert python(code) == "[]"
