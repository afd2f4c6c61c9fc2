"""The scripts of the pages: what one imports is asked for at once, not when it has been read."""

import re
from pathlib import Path

import pytest

from app.paths import ROOT
from app.web.texts.templating import imports_of

SCRIPTS = sorted((ROOT / "static").glob("*.js"))


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: path.name)
def test_nothing_that_a_script_imports_is_overlooked(path: Path) -> None:
    named = re.findall(r'from\s+"\./([^"]+)"', path.read_text(encoding="utf-8"))
    assert set(named) <= set(imports_of(path.name))
    for each in named:
        assert set(imports_of(each)) <= set(imports_of(path.name))


def test_the_labelling_page_asks_for_all_its_modules_at_once() -> None:
    assert {"lock_step.js", "outbox.js", "clips.js"} <= set(imports_of("pair.js"))
