"""Every command that a page, a program or an error tells somebody to type exists, takes what is said, and runs."""

import argparse
import os
import re
import runpy
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import pytest

from app.db import Database
from app.services.accounts import accounts
from app.settings import Settings
from worker import stop_signals
from worker.compute import simulation

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
PROGRAMS = [
    each
    for part in ("app", "worker", "tests/benchmarks", "tests/pictures")
    for each in sorted((ROOT / part).rglob("*.py"))
]
OTHERS = [*sorted((ROOT / "templates").rglob("*.html")), *sorted((ROOT / "install").glob("*.sh"))]
OURS = r"(?:-m (?:app|worker|tests\.(?:on_postgresql|on_s3|(?:benchmarks|pictures)\.\w+))|tests/benchmarks/\w+\.py)"
VARIABLES = r"(?:[A-Z_]+=\S+ )"
MAKE = rf"(?:{VARIABLES}+|(?<=[`>])|(?<=: )|(?<=^    ))make\b(?= |`|<|$)(?! them)"
COMMAND = re.compile(
    rf"((?:{MAKE}|{VARIABLES}*(?:[\w.]+/)*python {OURS}|\.venv/bin/[\w-]+)(?:(?! {{2}}| #| \.\.\.)[^`<\n])*)",
    re.MULTILINE,
)
EXAMPLE = {"dabbing": "feeding", "reach": "feeding", "NAME": "feeding"}
"""The tasks that docs/new_task.md makes up and docs/your_robot.md brings, and any task."""


@dataclass(frozen=True)
class Elsewhere:
    """Another test runs the program."""

    test: str


@dataclass(frozen=True)
class OnlyParsed:
    """What it is told is parsed, but it is not run."""

    because: str


ROLLOUTS = OnlyParsed("begins with the rollouts of 48 scenarios per task, which are minutes")
REAL_TIME = OnlyParsed("lets a real worker learn while somebody waits, which takes minutes")
SHIPPED = "would overwrite what ships with the studio; the same function runs small in "

RUN: dict[str, str | Elsewhere | OnlyParsed] = {
    "app audit-head": "",
    "app check": Elsewhere("tests/app/test_deploy_check.py::test_the_command_says_what_is_unsafe_and_exits_with_1"),
    "app check-signature": Elsewhere("tests/app/test_signing.py::test_commands_show_the_key_and_check_files"),
    "app backup": "../backups",
    "app demo": "--task drinking",
    "app dictionary": Elsewhere(
        "tests/app/test_export_data.py::test_the_dictionary_in_the_documentation_is_up_to_date"
    ),
    "app erasure-receipts": "",
    "app import-study": Elsewhere("tests/app/test_archive.py::test_a_study_is_imported_by_a_command"),
    "app link": "",
    "app migrate": "",
    "app reset-password": "",
    "app reset-second-factor": Elsewhere(
        "tests/app/test_second_factor.py::test_without_the_key_codes_are_refused_in_words_and_a_command_helps"
    ),
    "app restore": Elsewhere("tests/app/backups/test_backups.py::test_the_commands_say_what_was_done"),
    "app scrub": "",
    "app signing-key": "",
    "app test-alert": Elsewhere("tests/app/test_alerts.py::test_a_test_message_shows_whether_it_comes"),
    "app up": Elsewhere("tests/app/test_start_and_stop.py::test_the_first_start_prints_all_that_is_needed"),
    "app web": Elsewhere("tests/app/test_logs.py::test_the_web_server_alone_writes_nothing_but_json"),
    "app verify-audit": Elsewhere("tests/app/test_audit_chain.py::test_the_command_says_which_row"),
    "app verify": Elsewhere("tests/app/backups/test_backups.py::test_the_commands_say_what_was_done"),
    "worker --help": "",
    "worker behaviours": "--tasks feeding --scenarios 1 --axis-scenarios 1",
    "worker benchmark": Elsewhere("tests/worker/experiments/test_benchmark.py::test_the_command_can_only_report"),
    "worker check": Elsewhere("tests/lab/test_your_robot.py::test_the_example_can_be_used"),
    "worker demo-study": OnlyParsed(
        "takes minutes; what it made is looked at by tests/worker/rehearsal/test_demo_study.py"
    ),
    "worker explore": OnlyParsed(SHIPPED + "tests/worker/experiments/test_fit_response_surface.py"),
    "worker archive": OnlyParsed(SHIPPED + "tests/worker/experiments/test_archive_modes.py"),
    "worker archive-policies": OnlyParsed(SHIPPED + "tests/worker/experiments/test_archive_policies.py"),
    "worker archive-policies-in-modes": OnlyParsed(
        SHIPPED + "tests/worker/experiments/test_archive_policies_in_modes.py"
    ),
    "worker foresee": OnlyParsed(SHIPPED + "tests/worker/ml/test_signal_predictor.py"),
    "worker import-clips": Elsewhere(
        "tests/worker/jobs/test_own_clips.py::test_the_documented_example_becomes_a_study"
    ),
    "worker pretrain": OnlyParsed("trains for ten minutes at least; tests/worker/ml/test_sac.py trains small policies"),
    "worker rehearse": OnlyParsed("takes minutes; tests/worker/jobs/test_loop.py rehearses a study"),
    "worker run": Elsewhere("tests/worker/jobs/test_stop.py::test_while_it_films"),
    "worker speed-weight": "--scenarios 1",
    "worker start-posture": "--restarts 50",
    "advice_to_stop": ROLLOUTS,
    "archived_policies": ROLLOUTS,
    "policies_in_modes": ROLLOUTS,
    "backups": Elsewhere(
        "tests/app/test_backup_drill.py::"
        "test_a_restored_studio_has_every_answer_that_was_acknowledged_before_the_backup_began"
    ),
    "api_pages": "--people 1 --answers 20",
    "changed_physics": ROLLOUTS,
    "chosen_modes": ROLLOUTS,
    "few_answers": ROLLOUTS,
    "following_pairs": ROLLOUTS,
    "hints": ROLLOUTS,
    "mattered": ROLLOUTS,
    "misfit": ROLLOUTS,
    "more_ways": ROLLOUTS,
    "nonlinear_filters": ROLLOUTS,
    "comparison_report": "results/paper_form",
    "contact_sheet": "sheets feeding --films 1 --steps 5 --no-people",
    "disagreement": "feeding --file cells.csv --shares 1 --scenarios 12",
    "foreign": OnlyParsed("fits six filters, which takes minutes; tests/lab/test_whole_loop.py fits two small ones"),
    "arms": "--arrivals 20 --studies 1 --to .",
    "between": "--studies 2 --to .",
    "error_rates": Elsewhere("tests/worker/analysis/test_error_rates.py::test_the_command_writes_every_table"),
    "feedback_efficiency": OnlyParsed("begins with 240 rollouts of unseen scenarios, and draws all its figures"),
    "feedback_report": "results",
    "first_robot": REAL_TIME,
    "made_pairs": REAL_TIME,
    "fuzz_api": "--requests 20",
    "likert": Elsewhere("tests/worker/analysis/test_likert.py::test_the_command_writes_page_and_table"),
    "head_to_head": OnlyParsed("computes each truth from 200 000 people; what it measures has tests of its own"),
    "reliability": OnlyParsed("computes each truth from 400 000 people; what it measures has tests of its own"),
    "in_r": OnlyParsed("needs R with two packages; tests/worker/analysis/test_exported_scripts.py runs it where it is"),
    "in_lerobot": OnlyParsed("needs the library lerobot, in an environment of its own"),
    "in_imitation": OnlyParsed("needs the library imitation, in an environment of its own"),
    "in_stable_baselines3": ROLLOUTS,
    "kills": REAL_TIME,
    "labellers": "--labellers 2 --thought 0.2 --people 1 --labels 40 --seconds 1 --rounds 1 --settling 0",
    "on_postgresql": OnlyParsed("runs the suite itself, and needs a PostgreSQL server"),
    "on_s3": OnlyParsed("runs the suite itself"),
    "cluster": REAL_TIME,
    "second_worker": REAL_TIME,
    "point_in_time": REAL_TIME,
    "replica": REAL_TIME,
    "onlookers": "--people 1 --labels 40 --labellers 1 --dashboards 1 --seconds 1 --thought 0.1",
    "page_times": "--people 1 --labels 20 --times 2",
    "pages": OnlyParsed("photographs a real studio, which takes minutes, and writes to docs/pictures"),
    "pool_rollouts": "--first 10800000 --scenarios 1 --directory pool",
    "planted": OnlyParsed(
        "asks for plans of thousands of invented studies; tests/app/test_scripted_people.py walks through the pages"
    ),
    "printed_readings": ROLLOUTS,
    "render_speed": "--tasks feeding --films 1 --steps 1",
    "replayed_waiting": REAL_TIME,
    "retraining": ROLLOUTS,
    "promises": ROLLOUTS,
    "promise_error_rates": "--people 2 --output promise_error_rates",
    "rivals": "--report-only --output results/rivals",
    "rivals_error_rates": "--tables 1 --output rivals_error_rates",
    "rooms": Elsewhere("tests/architecture/test_rooms.py::test_the_picture_of_the_rooms_is_up_to_date"),
    "rounds": "1",
    "same_bits": OnlyParsed("trains every method; docs/results/same_bits.txt is what it prints"),
    "sliders": OnlyParsed("moves the sliders of a running studio; tests/app/test_self_setting.py has what it sends"),
    "save_latency": "52 1",  # beyond the first break
    "sim_speed": "--resets 1 --episodes 1",
}
"""What runs small enough, by program."""
TOOLS = {
    "alembic": "check",
    "pip": "show pbarl-studio",
    "pre-commit": "validate-config",
    "pytest": "--collect-only -q --noconftest tests/architecture/test_scenarios.py",
}
"""What shows that a tool does its work here."""


def commands() -> Iterator[tuple[str, str]]:
    """File and command."""
    for path in (*PAGES, *PROGRAMS, *OTHERS):
        lines = path.read_text().splitlines()
        text = "\n".join(line for line in lines if any(word in line for word in ("make", "python", ".venv")))  # faster
        ends = "" if path.suffix == ".md" else '"'
        for found in COMMAND.finditer(text):
            command = found[1].split(ends)[0] if ends else found[1]
            command = command.rstrip(" .,;:'").removesuffix("\\n")
            is_name = path.suffix == ".py" and re.search(r" -m (app|worker)$", command)  # as in "usage: ..."
            if "{" not in command and not is_name:
                yield str(path.relative_to(ROOT)), command


ALL = sorted(set(commands()))


def words_of(command: str) -> list[str]:
    """Without the variables before it."""
    words = [EXAMPLE.get(word, word) for word in shlex.split(command)]
    return words[next(index for index, word in enumerate(words) if "=" not in word) :]


def programs_of(command: str) -> Iterator[tuple[str, list[str]]]:
    """The programs of ours that a command runs, with their arguments."""
    words = words_of(command)
    if words[0] == "make":
        for line in planned(words):
            if found := re.search(rf"python ({OURS}.*)", line):
                yield from programs_of(f"python {found[1]}")
    elif words[0].endswith("python"):
        module, *arguments = words[2:] if words[1] == "-m" else words[1:]
        if module in ("app", "worker"):
            yield f"{module} {arguments[0] if arguments else ''}", arguments
        else:
            yield Path(module).stem if module.endswith(".py") else module.rpartition(".")[2], arguments


def planned(words: list[str]) -> list[str]:
    """What ``make`` would run."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("MAKE")}
    done = subprocess.run(
        ["make", "-n", *words[1:]], cwd=ROOT, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def file_of(program: str) -> Path:
    """What Python runs."""
    part = program.split()[0]
    if part in ("app", "worker"):
        return ROOT / part / "__main__.py"
    return next((ROOT / "tests").rglob(f"{program}.py"))


def run(program: str, arguments: list[str], monkeypatch: pytest.MonkeyPatch) -> int:
    """Run it in this process, which has loaded most of it already; the exit code."""
    file = file_of(program)
    monkeypatch.setattr(sys, "argv", [str(file), *arguments])
    monkeypatch.setattr(os, "_exit", sys.exit)  # the worker's way to end would end the suite
    monkeypatch.setattr(stop_signals, "any_signal_is_ctrl_c", lambda: None)
    try:
        runpy.run_path(str(file), run_name="__main__")
    except SystemExit as end:
        return int(end.code or 0)
    finally:
        simulation.environment.cache_clear()  # programs close what they have used
    return 0


class Parsed(Exception):
    """The arguments were taken."""


@pytest.fixture
def only_parses(monkeypatch: pytest.MonkeyPatch) -> None:
    """Programs end as soon as they have taken their arguments."""
    parse_args = argparse.ArgumentParser.parse_args

    def parse_and_end(*given: Any, **named: Any) -> NoReturn:
        parse_args(*given, **named)
        raise Parsed

    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", parse_and_end)


@pytest.fixture(scope="module")
def directory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data directory with an account and a study in it."""
    directory = tmp_path_factory.mktemp("documented")
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setenv("DATA_DIR", str(directory / "data"))
        monkeypatch.chdir(directory)
        assert run("app demo", ["demo"], monkeypatch) == 0
        database = Database(Settings().sqlalchemy_url)
        with database.writing() as session:
            accounts.create_first_experimenter(session)  # as the first start does
        database.dispose()
    results = directory / "results"
    results.mkdir()
    tables = ROOT / "docs/results"
    for file in (*tables.glob("feedback_efficiency-*.csv"), tables / "rivals.csv"):
        shutil.copy(file, results)
    shutil.copytree(tables / "paper_form", results / "paper_form")
    return directory


def test_commands_are_found_wherever_they_are_told() -> None:
    told = {command for _, command in ALL}
    assert {
        "make run",
        'make rehearse ARGS="--labels 30"',
        "HOST=0.0.0.0 PUBLIC_URL=http://your-address:8000 make run",
        "python -m tests.benchmarks.save_latency 200 1 8",
        "python -m app scrub",
        "python -m worker --help",
        ".venv/bin/pre-commit install",
        "elsewhere/bin/python tests/benchmarks/in_imitation.py study.zip P01",
    } <= told
    by_kind = {path.rpartition(".")[2] for path, _ in ALL}
    assert by_kind == {"md", "py", "html", "sh"}
    mentioned = sum(len(re.findall(rf"python {OURS}", path.read_text())) for path in PAGES)
    assert (
        sum(len(re.findall(rf"python {OURS}", command)) for path, command in commands() if ".md" in path) == mentioned
    )


@pytest.mark.parametrize("command", sorted({command for _, command in ALL if "make " in command}))
def test_make_knows_the_target(command: str) -> None:
    assert planned(words_of(command)) is not None


@pytest.mark.usefixtures("only_parses")
@pytest.mark.parametrize("command", sorted({command for _, command in ALL if ".venv" not in command}))
def test_a_program_takes_what_it_is_told(command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for program, arguments in programs_of(command):
        assert program in RUN, f"{program} is told of, so RUN says how it is run small."
        assert "parse_args" in file_of(program).read_text() or program.startswith("worker ")
        with suppress(Parsed):
            assert run(program, arguments, monkeypatch) == 0, "no more than --help"


SMALL = [name for name, small in RUN.items() if isinstance(small, str)]
BENCHMARKS = {name for name in SMALL if not name.startswith(("app ", "worker "))}


@pytest.mark.parametrize(
    "program", [pytest.param(name, marks=[pytest.mark.long] if name in BENCHMARKS else []) for name in SMALL]
)
def test_a_program_runs(program: str, directory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    small = RUN[program]
    assert isinstance(small, str)
    monkeypatch.setenv("DATA_DIR", str(directory / "data"))
    monkeypatch.chdir(directory)
    assert run(program, [*program.split()[1:], *small.split()], monkeypatch) == 0


def test_no_program_is_listed_in_vain() -> None:
    told = {program for _, command in ALL for program, _ in programs_of(command)}
    assert set(RUN) <= told
    for small in RUN.values():
        if isinstance(small, Elsewhere):
            path, _, name = small.test.partition("::")
            assert f"\ndef {name}(" in (ROOT / path).read_text(), small.test


@pytest.mark.parametrize("tool", sorted({Path(words_of(each)[0]).name for _, each in ALL if ".venv/bin/" in each}))
def test_a_tool_is_installed_and_works_here(tool: str, directory: Path) -> None:
    if tool == "python":
        return
    environment = {**os.environ, "DATA_DIR": str(directory / "data")}
    command = [str(Path(sys.executable).parent / tool), *TOOLS[tool].split()]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_every_benchmark_that_is_named_exists() -> None:
    named = {name for path in (*PAGES, *PROGRAMS) for name in re.findall(r"tests/benchmarks/\w+\.py", path.read_text())}
    assert {name for name in named if not (ROOT / name).exists()} == set()
