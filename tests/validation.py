"""A validation document for a lab's files: what the studio promises, which tests show it, and what came out here.

Made from docs/requirements.toml and the JUnit report of a run of the whole suite (``make validate``). It exits with 1
if anything that is promised was not shown, and writes the document in any case.
"""

import argparse
import hashlib
import html
import platform
import subprocess
import sys
import tomllib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from xml.etree import ElementTree

ROOT = Path(__file__).resolve().parents[1]
REQUIREMENTS = ROOT / "docs/requirements.toml"
LIBRARIES = (
    "torch",
    "numpy",
    "scipy",
    "statsmodels",
    "pybullet",
    "onnxruntime",
    "fastapi",
    "sqlalchemy",
    "cryptography",
)
IDENTIFIED = (
    "requirements.lock",
    "docs/requirements.toml",
    "worker/tasks/**/*.safetensors",
    "migrations/versions/*.py",
)
"""Files whose hashes say what was validated, beside the commit."""


@dataclass(frozen=True)
class Requirement:
    """One promise."""

    id: str
    area: str
    must: str
    tests: Sequence[str]
    results: Sequence[str]


@dataclass(frozen=True)
class Case:
    """One test as it went."""

    file: str
    """as in the requirements"""
    name: str
    outcome: str
    """passed, failed or skipped"""
    words: str


@dataclass(frozen=True)
class Shown:
    """A requirement with the tests of it that ran."""

    requirement: Requirement
    cases: Sequence[Case]

    @property
    def verdict(self) -> str:
        """ "shown" only if every file ran, something passed and nothing failed."""
        counted = Counter(case.outcome for case in self.cases)
        if counted["failed"]:
            return "failed"
        ran = {case.file for case in self.cases if case.outcome == "passed"}
        return "shown" if ran >= {*self.requirement.tests} else "not shown"


def requirements(path: Path = REQUIREMENTS) -> list[Requirement]:
    """All of them, in their order."""
    areas = tomllib.loads(path.read_text())["area"]
    return [
        Requirement(key, area["name"], each["must"], each["tests"], each.get("results", []))
        for area in areas
        for key, each in area["requirements"].items()
    ]


def cases(report: Path) -> list[Case]:
    """The tests of a JUnit report of pytest."""
    return [_case(each) for each in ElementTree.parse(report).iter("testcase")]  # noqa: S314  (pytest wrote it just now)


def _case(element: ElementTree.Element) -> Case:
    parts = element.get("classname", "").split(".")
    modules = [index for index, part in enumerate(parts) if part.startswith("test_")]
    file = "/".join(parts[1 : modules[0] + 1]) if modules else "/".join(parts[1:])
    for outcome, tags in (("failed", ("failure", "error")), ("skipped", ("skipped",))):
        for tag in tags:
            found = element.find(tag)
            if found is not None:
                return Case(file, element.get("name", ""), outcome, found.get("message", ""))
    return Case(file, element.get("name", ""), "passed", "")


def shown(promised: Sequence[Requirement], ran: Sequence[Case]) -> list[Shown]:
    """Each requirement with its tests."""
    return [Shown(each, [case for case in ran if case.file in each.tests]) for each in promised]


def identification() -> dict[str, str]:
    """What was validated and where, by name."""
    changed = bool(_git("status", "--porcelain"))
    memory = next((line for line in Path("/proc/meminfo").read_text().splitlines() if line.startswith("MemTotal")), "")
    return {
        "PbARL Studio": metadata.version("pbarl-studio"),
        "Commit": _git("rev-parse", "HEAD") + (" with changes that are not committed" if changed else ""),
        "Date": f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC",
        "System": f"{platform.system()} {platform.release()}, {platform.machine()}",
        "Memory": memory.partition(":")[2].strip(),
        "Python": platform.python_version(),
        **{name: metadata.version(name) for name in LIBRARIES},
    }


def _git(*arguments: str) -> str:
    done = subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=False)
    return done.stdout.strip() or ("" if done.returncode == 0 else "unknown")


def hashes() -> dict[str, str]:
    """SHA-256 of the files that identify the release, by path."""
    files = sorted(path for pattern in IDENTIFIED for path in ROOT.glob(pattern))
    return {str(path.relative_to(ROOT)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def document(found: Sequence[Shown], ran: Sequence[Case], told: Mapping[str, str], files: Mapping[str, str]) -> str:
    """The whole document as one HTML file that needs nothing else and prints well."""
    return "\n".join(_lines(found, ran, told, files))


def _lines(
    found: Sequence[Shown], ran: Sequence[Case], told: Mapping[str, str], files: Mapping[str, str]
) -> Iterator[str]:
    verdicts = Counter(each.verdict for each in found)
    outcomes = Counter(case.outcome for case in ran)
    yield "<!doctype html><html lang=en><meta charset=utf-8><title>Validation of PbARL Studio</title>"
    yield f"<style>{STYLE}</style>"
    yield "<h1>Validation of PbARL Studio</h1>"
    yield (
        f"<p><strong>{verdicts['shown']} of {len(found)} requirements were shown.</strong> {len(ran)} tests ran: "
        f"{outcomes['passed']} passed, {outcomes['failed']} failed, {outcomes['skipped']} were skipped.</p>"
        "<p>The tests use scripted participants and simulated robots. They show that the software does what is written "
        "below on the machine named here. They show nothing about people, about a physical robot, or about how a lab "
        "operates the software.</p>"
    )
    yield "<h2>What was validated</h2>" + _table(("", ""), told.items())
    yield "<h2>Requirements</h2>"
    for area in dict.fromkeys(each.requirement.area for each in found):
        promises = [_row(each) for each in found if each.requirement.area == area]
        yield f"<h3>{_text(area)}</h3>" + _table(("", "Requirement", "Tests", "Verdict"), promises)
    for outcome, title in (("failed", "Tests that failed"), ("skipped", "Tests that were skipped")):
        rows = [(f"{case.file}: {case.name}", case.words) for case in ran if case.outcome == outcome]
        yield f"<h2>{title}</h2>" + (_table(("Test", "Reason"), rows) if rows else "<p>None.</p>")
    yield "<h2>Hashes (SHA-256)</h2>" + _table(("File", "Hash"), files.items())
    yield "<h2>Accepted by</h2>" + _table(("Name", "Role", "Date", "Signature"), [("\u00a0", "", "", "")] * 3)


def _row(each: Shown) -> tuple[str, str, str, str]:
    counted = Counter(case.file for case in each.cases if case.outcome == "passed")
    tests = [f"{name}: {counted[name]} passed" for name in each.requirement.tests]
    results = [f"measured: docs/results/{name}" for name in each.requirement.results]
    return each.requirement.id, each.requirement.must, "\n".join([*tests, *results]), each.verdict


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    titles = "".join(f"<th>{_text(each)}</th>" for each in head)
    body = "".join("<tr>" + "".join(f"<td>{_text(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    return f"<table><tr>{titles}</tr>{body}</table>"


def _text(words: str) -> str:
    return html.escape(words).replace("\n", "<br>")


STYLE = """
body { font: 11pt/1.4 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto; padding: 0 1rem; color: #1a1a1a; }
table { border-collapse: collapse; width: 100%; margin: .5rem 0 1.5rem; }
th, td { text-align: left; vertical-align: top; padding: .3rem .6rem; border-bottom: 1px solid #ccc; }
td { overflow-wrap: anywhere; }
td:first-child, td:last-child { overflow-wrap: normal; }
td:nth-child(4) { white-space: nowrap; }
td:nth-child(3) { min-width: 20rem; }
td:nth-child(n+3) { font-size: 9.5pt; }
tr { break-inside: avoid; }
h2 { margin-top: 2rem; }
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the document; 1 if anything promised was not shown."""
    parser = argparse.ArgumentParser(prog="python -m tests.validation", description=__doc__)
    parser.add_argument("report", type=Path, help="JUnit report of the suite (pytest --junitxml)")
    parser.add_argument("document", type=Path, help="the HTML file to write")
    said = parser.parse_args(arguments)
    ran = cases(said.report)
    found = shown(requirements(), ran)
    said.document.write_text(document(found, ran, identification(), hashes()))
    missing = [f"{each.requirement.id} {each.verdict}" for each in found if each.verdict != "shown"]
    sys.stdout.write(f"Wrote {said.document}. {'; '.join(missing) or f'All {len(found)} requirements were shown.'}\n")
    return 1 if missing else 0


if __name__ == "__main__":
    sys.exit(main())
