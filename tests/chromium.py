"""The system's Chromium, without a window: for tests, pictures and benchmarks."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager

from playwright.sync_api import Browser, sync_playwright

NAMES = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome")
"""The first has no window to draw and needs half the processor time."""


class NoBrowser(Exception):
    """There is no Chromium: install your system's package 'chromium-headless-shell'."""

    def __str__(self) -> str:
        return str(self.__doc__)


@contextmanager
def launched() -> Iterator[Browser]:
    """A browser until the end of the block."""
    path = next(filter(None, map(shutil.which, NAMES)), None)
    if path is None:
        raise NoBrowser
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=["--no-sandbox", "--disable-gpu"])
        yield browser
        browser.close()
