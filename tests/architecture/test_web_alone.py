"""The web server runs where nothing of learning and simulation is installed, and the compose file says so rightly."""

import re
import subprocess
import sys
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest
import yaml
from packaging.requirements import Requirement

from app.paths import ROOT
from app.settings import Settings

LOCK, WEB_LOCK, DEV_LOCK = (ROOT / f"requirements{part}.lock" for part in ("", "-web", "-dev"))
COMPOSE = yaml.safe_load((ROOT / "docker-compose.yml").read_text())
CLUSTER = {name: each for name, each in COMPOSE["services"].items() if "cluster" in each.get("profiles", ())}
ELSEWHERE = re.compile(r"AWS_|POSTGRES_|ROOT_")
"""Variables that other programs know."""

START = """
import sys
from importlib import metadata

allowed = set(sys.argv[1].split())
kept = {name for name, packages in metadata.packages_distributions().items()
        if not {each.lower().replace("_", "-").replace(".", "-") for each in packages}.isdisjoint(allowed)}
others = set(metadata.packages_distributions()) - kept - {"app", "worker"}  # where the descriptions of tasks lie

class NotInstalled:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in others:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, NotInstalled())
import pkgutil, importlib, app
for each in pkgutil.walk_packages(app.__path__, "app."):
    if each.name != "app.__main__":
        importlib.import_module(each.name)
assert "worker" not in sys.modules
"""


def pins(path: Path) -> dict[str, str]:
    """By name, in the form that packages are compared in, the whole entry."""
    entries = re.findall(r"^([A-Za-z0-9._-]+)==(.*(?:\n .*)*)", path.read_text(), re.MULTILINE)
    return {_normal(name): rest for name, rest in entries}


def _normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def _needed_by(requirement: Requirement, found: set[str]) -> None:
    """Add what is needed on any supported Python, and what that needs."""
    mark = str(requirement)
    if mark in found:
        return
    found |= {mark, _normal(requirement.name)}
    for line in metadata.requires(requirement.name) or ():
        each = Requirement(line)
        places = [
            {"extra": extra, "python_version": version, "python_full_version": f"{version}.0"}
            for extra in ("", *requirement.extras)
            for version in ("3.11", "3.12", "3.13")
        ]
        if each.marker is None or any(each.marker.evaluate(place) for place in places):
            each.marker = None
            _needed_by(each, found)


def test_the_lock_of_the_web_server_is_what_its_dependencies_need() -> None:
    project = (ROOT / "pyproject.toml").read_text()
    ours = re.findall(r'"([^"]+)"', project.partition("# web\n")[2].partition("# worker")[0])
    needed: set[str] = set()
    for line in ours:
        _needed_by(Requirement(line), needed)
    everything = pins(LOCK)
    assert pins(WEB_LOCK) == {name: pin for name, pin in everything.items() if name in needed}


def test_what_is_installed_to_run_is_what_the_tests_run_with() -> None:
    assert pins(LOCK).items() <= pins(DEV_LOCK).items()


def test_every_module_of_the_web_server_is_imported_with_nothing_else_installed() -> None:
    done = subprocess.run(
        [sys.executable, "-c", START, " ".join(pins(WEB_LOCK))], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("package", ["torch", "numpy", "pybullet"])
def test_that_test_would_notice(package: str) -> None:
    script = START.partition("import pkgutil")[0] + f"import {package}\n"
    done = subprocess.run(
        [sys.executable, "-c", script, " ".join(pins(WEB_LOCK))], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert "ModuleNotFoundError" in done.stderr


def test_without_the_profile_one_container_starts() -> None:
    assert [name for name, each in COMPOSE["services"].items() if not each.get("profiles")] == ["studio"]


def test_a_cluster_has_three_web_servers_and_three_workers_and_none_keeps_anything_to_itself() -> None:
    assert {name: CLUSTER[name]["deploy"]["replicas"] for name in ("web", "worker")} == {"web": 3, "worker": 3}
    for name in ("web", "worker", "migrate"):
        settings = CLUSTER[name]["environment"]
        assert settings["DATABASE_URL"].startswith("postgresql://")
        assert settings["STORAGE_URL"].startswith("s3://")
        assert settings["SIGNING_KEY_FILE"].startswith("/keys/"), "one key for all"
        assert "WORKER_NAME" not in settings, "the database gives names"
        assert CLUSTER[name]["volumes"] == ["keys:/keys"]


def test_only_the_worker_s_image_has_the_learning_stack() -> None:
    assert CLUSTER["web"]["build"]["target"] == CLUSTER["migrate"]["build"]["target"] == "web"
    assert CLUSTER["worker"]["build"] == "."
    first, last = re.split(r"\nFROM python:[\d.]+-slim\n", (ROOT / "Dockerfile").read_text())
    assert " AS web\n" in first
    assert "requirements-web.lock" in first
    assert "requirements.lock" in last


def test_the_bucket_is_there() -> None:
    assert CLUSTER["web"]["environment"]["STORAGE_URL"] == "s3://studio"
    assert CLUSTER["s3"]["volumes"] == ["s3-data:/gw/studio"]


def test_settings_in_the_compose_file_exist() -> None:
    known = {name.upper() for name in Settings.model_fields}
    for service in COMPOSE["services"].values():
        named: dict[str, Any] = service.get("environment", {})
        assert {name for name in named if not ELSEWHERE.match(name)} <= known


def test_the_schema_is_there_before_anything_starts() -> None:
    for name in ("web", "worker"):
        assert CLUSTER[name]["depends_on"]["migrate"] == {"condition": "service_completed_successfully"}
    assert CLUSTER["migrate"]["depends_on"]["postgres"] == {"condition": "service_healthy"}


def test_the_proxy_is_believed_and_reaches_the_web_servers() -> None:
    network = COMPOSE["networks"]["cluster"]["ipam"]["config"][0]["subnet"]
    assert CLUSTER["web"]["environment"]["TRUSTED_PROXIES"] == network
    configuration = (ROOT / "install/cluster/nginx.conf").read_text()
    assert "server web:8000" in configuration
    assert "X-Forwarded-For $remote_addr" in configuration, "what visitors claim is left out"
