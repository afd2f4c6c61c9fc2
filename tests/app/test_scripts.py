"""The scripts of the pages: what one imports is asked for at once, not when it has been read."""

import posixpath
import re
from pathlib import PurePosixPath

import pytest

from app.paths import ROOT
from app.web.texts.templating import imports_of

STATIC = ROOT / "static"
SCRIPTS = sorted(path.relative_to(STATIC).as_posix() for path in STATIC.rglob("*.js"))


@pytest.mark.parametrize("script", SCRIPTS)
def test_nothing_that_a_script_imports_is_overlooked(script: str) -> None:
    source = (STATIC / script).read_text(encoding="utf-8")
    named = {
        posixpath.normpath(PurePosixPath(script).parent / each) for each in re.findall(r'from\s+"([^"]+)"', source)
    }
    assert named <= set(imports_of(script)) <= set(SCRIPTS)
    for each in named:
        assert set(imports_of(each)) <= set(imports_of(script))


def test_no_side_takes_scripts_of_the_other() -> None:
    for script in SCRIPTS:
        assert {PurePosixPath(each).parts[0] for each in imports_of(script)} <= {"base", PurePosixPath(script).parts[0]}


def test_every_script_that_a_page_needs_is_there_and_no_other() -> None:
    pages = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "templates").rglob("*.html"))
    named = set(re.findall(r'"([\w/]+\.js)"', pages))
    assert named | {each for script in named for each in imports_of(script)} == set(SCRIPTS)


def test_the_labelling_page_asks_for_all_its_modules_at_once() -> None:
    wanted = {"base/lock_step.js", "participant/outbox.js", "participant/clips.js"}
    assert wanted <= set(imports_of("participant/pair.js"))
