"""The validation document: each test file shows something promised, and nothing is called shown that was not."""

import subprocess
import sys
from pathlib import Path

import pytest

from tests import validation
from tests.validation import ROOT, Case, Requirement, Shown


def test_every_file_of_tests_belongs_to_a_requirement_and_every_named_file_is_there() -> None:
    there = {str(path.relative_to(ROOT / "tests").with_suffix("")) for path in (ROOT / "tests").rglob("test_*.py")}
    assert {name for each in validation.requirements() for name in each.tests} == there


def test_every_named_result_is_there() -> None:
    named = {name for each in validation.requirements() for name in each.results}
    assert [name for name in named if not (ROOT / "docs/results" / name).is_file()] == []


@pytest.mark.parametrize(
    ("outcomes", "verdict"),
    [
        ({"a": "passed", "b": "passed"}, "shown"),
        ({"a": "passed", "b": "failed"}, "failed"),
        ({"a": "passed", "b": "skipped"}, "not shown"),
        ({"a": "passed"}, "not shown"),
        ({}, "not shown"),
    ],
)
def test_shown_is_only_what_ran_and_passed(outcomes: dict[str, str], verdict: str) -> None:
    promise = Requirement("X1", "Area", "It works.", ("a", "b"), ())
    assert Shown(promise, [Case(name, "test", outcome, "") for name, outcome in outcomes.items()]).verdict == verdict


def test_the_command_reads_what_pytest_writes_and_says_what_is_missing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    suite = tmp_path / "tests"
    suite.mkdir()
    (suite / "__init__.py").touch()
    (suite / "test_validation.py").write_text(
        "import pytest\n"
        "class TestOne:\n"
        "    def test_good(self): pass\n"
        "def test_bad(): assert 1 == '<b>2</b>'\n"
        "@pytest.mark.skip(reason='no robot here')\n"
        "def test_left_out(): pass\n"
    )
    report, target = tmp_path / "report.xml", tmp_path / "validation.html"
    command = [sys.executable, "-m", "pytest", "-q", f"--junitxml={report}", "-p", "no:cacheprovider", "tests"]
    subprocess.run(command, cwd=tmp_path, capture_output=True, check=False)
    assert [(case.file, case.outcome) for case in validation.cases(report)] == [
        ("test_validation", "passed"),
        ("test_validation", "failed"),
        ("test_validation", "skipped"),
    ]
    assert validation.main([str(report), str(target)]) == 1
    assert "O3 failed" in capsys.readouterr().out
    written = target.read_text()
    for words in ("no robot here", "&lt;b&gt;", "requirements.lock"):
        assert words in written
