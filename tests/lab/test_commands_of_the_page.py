"""docs/your_robot.md: its file is the example's, and its commands lead from a folder to a bundle that runs."""

import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
EXAMPLE, PAGE = ROOT / "examples" / "reach", (ROOT / "docs" / "your_robot.md").read_text()
SHOWN = PAGE.split("```toml\n")[1].split("```")[0]
COMMANDS = re.findall(r"^    (\S.*)$", PAGE.split("```")[2], re.MULTILINE)


def test_the_page_is_one_screen_and_shows_the_examples_own_file() -> None:
    assert len(PAGE.splitlines()) <= 65
    assert_within(tomllib.loads(SHOWN), tomllib.loads((EXAMPLE / "lab.toml").read_text()))


def assert_within(shown: dict[str, Any], whole: dict[str, Any]) -> None:
    """Whatever is shown stands in the file; of its texts the first sentence is enough."""
    for key, value in shown.items():
        if isinstance(value, dict):
            assert_within(value, whole[key])
        elif isinstance(value, str):
            assert "".join(whole[key].split()).startswith("".join(value.rstrip(".").split()))
        else:
            assert whole[key] == value


@pytest.mark.long
def test_the_commands_lead_to_bundles_that_prove_themselves(tmp_path: Path) -> None:
    folder = Path(shutil.copytree(EXAMPLE, tmp_path / "reach", ignore=shutil.ignore_patterns("checkpoint")))
    (folder / "lab.toml").write_text(SHOWN)
    script = "\n".join(each for each in COMMANDS if " pip install " not in each)
    script = script.replace("data/reach", str(tmp_path / "rehearsed")).replace("examples/reach", str(folder))
    done = subprocess.run(
        ["bash", "-e", "-c", script.replace(".venv/bin/python", sys.executable)],
        cwd=ROOT,
        env={**os.environ, "DATA_DIR": str(tmp_path / "data")},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert "Of 100 pairs of clips" in done.stdout
    assert "too alike" not in done.stdout
    assert "/p/" in done.stdout.splitlines()[-1]
    bundles = sorted((tmp_path / "rehearsed" / "rehearsed").glob("P*.zip"))
    assert [each.stem.split("-")[1] for each in bundles] == ["quick", "high"]
    for each in bundles:
        zipfile.ZipFile(each).extractall(tmp_path / each.stem)
        proof = subprocess.run(
            [sys.executable, "run_filter.py"], cwd=tmp_path / each.stem, capture_output=True, text=True, check=False
        )
        assert proof.returncode == 0, proof.stderr
