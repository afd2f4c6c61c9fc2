"""Which Python the installation chooses, that the physics engine is built once, and what the container holds."""

import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from fnmatch import fnmatch
from pathlib import Path

import pytest

from app.paths import DEMO_STUDY, DOCS, MIGRATIONS, STATIC, TEMPLATES
from tests.waiting import PATIENCE_S, gone, until

ROOT = Path(__file__).resolve().parents[1]
TOOLS = ("bash", "cat", "find", "mkdir", "mktemp", "rm", "sed", "sleep", "tail", "touch", "wc")

FITS = "sqlite3.sqlite_version_info = (3, 45, 1)\nsysconfig.get_path = lambda name: os.environ['HEADERS']"
OLD_SQLITE = FITS + "\nsqlite3.sqlite_version_info, sqlite3.sqlite_version = (3, 40, 1), '3.40.1'"
NO_HEADERS = FITS + "\nsysconfig.get_path = lambda name: '/nowhere'"
NO_VENV = FITS + "\nsys.modules['ensurepip'] = None"

Programs = Callable[..., dict[str, str]]


def script(path: Path, lines: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"#!/bin/bash\n{lines}\n")
    path.chmod(0o755)


@pytest.fixture
def machine(tmp_path: Path) -> Programs:
    """A machine that has these programs and no others; its Pythons are this one, told that they are others."""

    def have(*names: str, **pythons: tuple[tuple[int, int], str]) -> dict[str, str]:
        programs = tmp_path / "bin"
        for tool in TOOLS:
            programs.mkdir(exist_ok=True)
            (programs / tool).symlink_to(f"/usr/bin/{tool}" if Path(f"/usr/bin/{tool}").exists() else f"/bin/{tool}")
        (tmp_path / "Python.h").touch()
        for name in names:
            script(programs / name, f'echo "{name} $*" >> {tmp_path}/called')
        for name, (version, is_otherwise) in pythons.items():
            prelude = f"import os, sqlite3, sys, sysconfig\nsys.version_info = {(*version, 1)}\n{is_otherwise}\n"
            (programs / f"{name}.prelude").write_text(prelude)
            script(
                programs / name.replace("_", "."),
                f'if [ "$1" = -c ]; then exec {sys.executable} -c "$(cat {programs / name}.prelude)\n$2"; fi\n'
                f'if [ "$1" = -m ]; then {"exit 1" if is_otherwise is NO_VENV else ""}\n'
                f'  mkdir -p "$3/bin"; echo {name} > "$3/made-by"\n'
                f'  printf "#!/bin/bash\\necho fetched > {tmp_path}/uv-came" > "$3/bin/python"\n'
                f'  printf "#!/bin/bash\\necho \\"uv \\$*\\" >> {tmp_path}/called" > "$3/bin/uv"\n'
                f"  {sys.executable} -c \"import os; [os.chmod('$3/bin/' + each, 493) for each in ('python', 'uv')]\"\n"
                f"  exit\nfi\necho {name}",
            )
        return {"PATH": str(programs), "HEADERS": str(tmp_path)}

    return have


def environment(machine: dict[str, str], tmp_path: Path, **variables: str) -> subprocess.CompletedProcess[str]:
    """Run the script."""
    return subprocess.run(
        ["/bin/bash", ROOT / "install/environment.sh", tmp_path / "venv"],
        env={**machine, **variables},
        capture_output=True,
        text=True,
        check=False,
    )


def chosen(tmp_path: Path) -> str:
    return (tmp_path / "venv/made-by").read_text().strip()


def called(tmp_path: Path) -> str:
    return (tmp_path / "called").read_text()


@pytest.mark.parametrize(
    ("pythons", "expected"),
    [
        ({"python3_11": ((3, 11), FITS), "python3_12": ((3, 12), FITS)}, "python3_11"),
        ({"python3_11": ((3, 11), OLD_SQLITE)}, "python3_11"),
        ({"python3_11": ((3, 11), NO_HEADERS)}, "python3_11"),
        ({"python3_12": ((3, 12), FITS), "python3": ((3, 12), FITS)}, "python3_12"),
        ({"python3_12": ((3, 12), OLD_SQLITE), "python3_13": ((3, 13), FITS)}, "python3_13"),
        ({"python3_11": ((3, 11), NO_VENV), "python3": ((3, 13), FITS)}, "python3"),
    ],
)
def test_the_first_python_is_taken_that_lacks_nothing(
    machine: Programs, tmp_path: Path, pythons: dict[str, tuple[tuple[int, int], str]], expected: str
) -> None:
    done = environment(machine("g++", **pythons), tmp_path)
    assert done.returncode == 0, done.stderr
    assert chosen(tmp_path) == expected


@pytest.mark.parametrize(
    ("version", "is_otherwise", "reason"),
    [
        ((3, 10), FITS, "is not Python 3.11, 3.12 or 3.13."),
        ((3, 14), FITS, "is not Python 3.11, 3.12 or 3.13."),
        ((3, 11), NO_VENV, "(install python3-venv)."),
        ((3, 12), NO_HEADERS, "(install python3-dev)."),
        ((3, 12), OLD_SQLITE, "needs SQLite 3.42 and has 3.40.1 (Python 3.11 does without)."),
    ],
)
def test_what_a_python_lacks_is_said_whether_it_was_named_or_found(
    machine: Programs, tmp_path: Path, version: tuple[int, int], is_otherwise: str, reason: str
) -> None:
    here = machine("g++", "uv", python3=(version, is_otherwise))
    named = environment(here, tmp_path, PYTHON=f"{here['PATH']}/python3")
    assert named.returncode == 1
    assert reason in named.stdout
    assert not (tmp_path / "called").exists(), "who names a Python wants no other"
    found = environment(here, tmp_path)
    assert found.returncode == 0
    assert reason in found.stdout
    assert called(tmp_path) == f"uv venv --quiet --seed --python 3.11 {tmp_path / 'venv'}\n"


def test_without_a_compiler_a_newer_python_is_left_alone(machine: Programs, tmp_path: Path) -> None:
    done = environment(machine("uv", python3_13=((3, 13), FITS)), tmp_path)
    assert "python3.13 needs g++" in done.stdout
    assert called(tmp_path).startswith("uv venv")


def test_uv_comes_from_the_package_index_where_it_is_not_installed(machine: Programs, tmp_path: Path) -> None:
    done = environment(machine(python3=((3, 14), FITS)), tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    assert called(tmp_path) == f"uv venv --quiet --seed --python 3.11 {tmp_path / 'venv'}\n"


@pytest.mark.parametrize("pythons", [{}, {"python3": ((3, 12), NO_VENV)}])
def test_where_nothing_helps_ways_are_named_docker_last(
    machine: Programs, tmp_path: Path, pythons: dict[str, tuple[tuple[int, int], str]]
) -> None:
    done = environment(machine("g++", **pythons), tmp_path)
    assert done.returncode == 1
    ways = [done.stdout.index(way) for way in ("apt-get install", "install uv", "docker compose")]
    assert ways == sorted(ways)


@pytest.mark.long
def test_this_python_makes_an_environment(tmp_path: Path) -> None:
    done = environment(dict(os.environ), tmp_path, PYTHON=sys.executable)
    assert done.returncode == 0, done.stdout
    subprocess.run([tmp_path / "venv/bin/python", "-m", "pip", "--version"], check=True, capture_output=True)


def compiling(tmp_path: Path, imports: str) -> Path:
    """An environment of Python 3.12 whose compiler never ends; what it was asked for is noted."""
    script(
        tmp_path / "venv/bin/python",
        f'if [ "$1" = -c ]; then case "$2" in *pybullet*) {imports};; *) echo False; exit;; esac; fi\n'
        f'echo "$*" >> {tmp_path}/asked\n'
        f'case "$*" in *" wheel "*) sleep 1000 & echo $! > {tmp_path}/compiler; wait;; esac',
    )
    return tmp_path / "venv"


def test_an_engine_that_is_there_is_not_built_again(tmp_path: Path) -> None:
    venv = compiling(tmp_path, "exit 0")
    subprocess.run(["install/engine.sh", venv], cwd=ROOT, check=True, timeout=PATIENCE_S)
    assert not (tmp_path / "asked").exists()


def test_ctrl_c_ends_the_compiler_too_and_leaves_no_files(tmp_path: Path) -> None:
    work = tmp_path / "work"
    work.mkdir()
    build = subprocess.Popen(
        ["env", "--default-signal=INT", "install/engine.sh", compiling(tmp_path, "exit 1")],  # nohup ignores it
        cwd=ROOT,
        env={**os.environ, "TMPDIR": str(work)},
        start_new_session=True,
        stdout=subprocess.DEVNULL,
    )
    compiler = tmp_path / "compiler"
    assert until(lambda: compiler.exists() and bool(compiler.read_text()))
    os.killpg(build.pid, signal.SIGINT)  # as a terminal does
    assert build.wait(PATIENCE_S) != 0
    assert until(lambda: gone(int(compiler.read_text())))
    assert list(work.iterdir()) == []


def in_the_container(path: Path) -> bool:
    """Whether the Dockerfile copies the file, and .dockerignore, whose last word counts, lets it."""
    name = path.relative_to(ROOT).as_posix()
    parts = {name, *(each.as_posix() for each in Path(name).parents)}
    copies = re.findall(r"^COPY (.+) \S+$", (ROOT / "Dockerfile").read_text(), re.MULTILINE)
    left_out = False
    for rule in (ROOT / ".dockerignore").read_text().split():
        if any(fnmatch(part, rule.lstrip("!")) for part in parts):
            left_out = not rule.startswith("!")
    return not left_out and not parts.isdisjoint(" ".join(copies).split())


@pytest.mark.parametrize(
    "needed", [MIGRATIONS / "env.py", STATIC / "icon.svg", TEMPLATES / "base.html", DEMO_STUDY, DOCS / "arrays.md"]
)
def test_the_container_has_the_files_that_the_programs_read(needed: Path) -> None:
    assert in_the_container(needed)


def test_the_container_has_no_tests() -> None:
    assert not in_the_container(ROOT / "tests/conftest.py")
