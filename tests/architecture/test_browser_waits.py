"""How tests in a browser wait."""

from pathlib import Path

import tests.browser


def test_no_test_waits_by_what_our_pages_forbid() -> None:
    """Playwright's wait_for_function() looks once, and then by eval, which the pages' Content Security Policy refuses.

    So it passes where what it waits for is there already, and fails on a busy machine; tests.waiting.until() does not.
    """
    folder = Path(tests.browser.__file__).parent
    assert [file.name for file in folder.glob("*.py") if "wait_for_function(" in file.read_text()] == []
