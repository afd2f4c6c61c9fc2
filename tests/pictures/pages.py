"""Takes the pictures of the pages that README and docs show, in Chromium: ``python -m tests.pictures.pages``.

A studio of its own shows the demo study. docs/pictures/pair.webp is somebody who answers a pair and sees the next one,
docs/pictures/dashboard.png what the experimenter sees then. This takes some minutes: while clips are photographed they
play at a tenth of their speed, so that no machine is too slow.
"""

import argparse
import io
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import timedelta
from pathlib import Path

from PIL import Image
from playwright.sync_api import Browser, Page, Route, expect

from app.db import Database
from app.services.accounts import accounts, browser_sessions
from app.services.archives import demo_archive
from app.storage import ArtefactStore
from tests.chromium import launched
from worker.rehearsal.server import OwnStudio

PICTURES = Path(__file__).resolve().parents[2] / "docs/pictures"
PATIENCE_MS = 600_000

SLOWER = 0.1
"""Speed of the clips while they are photographed."""
SLOW_CLIPS = f"""(() => {{
    const own = Object.getOwnPropertyDescriptor(HTMLMediaElement.prototype, "playbackRate");
    Object.defineProperty(HTMLMediaElement.prototype, "playbackRate", {{
        ...own,
        get() {{ return own.get.call(this) / {SLOWER}; }},
        set(wanted) {{ own.set.call(this, wanted * {SLOWER}); }},
    }});
    addEventListener("play", ({{ target }}) => (target.playbackRate = 1), true);
}})()"""
POSITION = "Math.max(...[...document.querySelectorAll('video')].map((each) => each.currentTime))"
FRAME_MS, REST_MS = 100, 1000
SECOND_PAIR_MS = 2000
QUALITY = 70
WIDE = 1366
ANSWERS = ("Left", "Right", "Right", "Left")
"""Before the pair that is filmed, so that the dashboard has something to show of whoever answers."""


@dataclass
class Film:
    """Pictures of a page and how long each of them stands."""

    page: Page
    frames: list[Image.Image] = field(default_factory=list)
    durations_ms: list[int] = field(default_factory=list)

    def take(self, duration_ms: int = FRAME_MS) -> None:
        """One picture of the page as it is."""
        self.frames.append(Image.open(io.BytesIO(self.page.screenshot())).convert("RGB"))
        self.durations_ms.append(duration_ms)

    def take_clips(self, longest_ms: int = PATIENCE_MS) -> None:
        """The clips from where they are to their end, or as much of them."""
        taken_ms, before_s = 0, 0.0
        while taken_ms < longest_ms and (now_s := self.page.evaluate(POSITION)) >= before_s:
            if now_s * 1000 >= taken_ms:
                self.take()
                taken_ms += FRAME_MS
            before_s = now_s

    def save(self, path: Path) -> None:
        """As one animated picture that goes round for ever."""
        first, *others = self.frames
        first.save(
            path,
            save_all=True,
            append_images=others,
            duration=self.durations_ms,
            loop=0,
            quality=QUALITY,
            method=6,
            minimize_size=True,
        )


@contextmanager
def demo_studio() -> Iterator[tuple[str, str, str]]:
    """The address of a studio with the demo study in it, a participant's token, and an experimenter's cookie."""
    with tempfile.TemporaryDirectory() as directory, OwnStudio(Path(directory)) as studio:
        database = Database(studio.settings.sqlalchemy_url)
        with database.writing() as session:
            token = demo_archive.import_finished(session, ArtefactStore(Path(directory) / "artefacts"))
            accounts.create_first_experimenter(session)
            account = accounts.by_name(session, accounts.FIRST_EXPERIMENTER)
            assert account is not None
            account.must_change_password = False
            cookie = browser_sessions.open_for_experimenter(session, account, timedelta(hours=1))
        database.dispose()
        yield studio.settings.base_url, token, cookie


def film_pairs(chromium: Browser, link: str) -> Film:
    """Somebody opens the link, answers some pairs, and is filmed while they answer another."""
    page = chromium.new_page(viewport={"width": 960, "height": 600})
    page.set_default_timeout(PATIENCE_MS)
    page.goto(link)
    page.get_by_role("button", name="I agree to take part").click()
    page.get_by_role("button", name="Start with practice").click()
    expect(page.locator("[data-page=practice][data-phase=ready]")).to_be_visible()
    page.get_by_role("button", name="Left").click()
    *before, filmed = ANSWERS
    for answered, name in enumerate(before):
        wait_ready(page, answered)
        page.get_by_role("button", name=name).click()
    wait_ready(page, len(before))
    return film_pair(page, filmed)


def wait_ready(page: Page, answered: int) -> None:
    """Until this many answers are stored and the next one can be given."""
    expect(page.locator("[data-page=pair] [data-count]")).to_have_text(f"{answered} of 24")
    expect(page.locator("[data-phase=ready]")).to_be_visible()


def film_pair(page: Page, response: str) -> Film:
    """One pair from its beginning, the answer to it, and the beginning of the next pair."""
    film = Film(page)
    page.add_init_script(SLOW_CLIPS)
    page.route("**/queries/*/label", lambda route: _hold(film, route))
    page.reload()
    expect(page.locator("[data-phase=watching]")).to_be_visible()
    film.take_clips()
    expect(page.locator("[data-phase=ready]")).to_be_visible()
    film.take(REST_MS)
    page.get_by_role("button", name=response).click()
    expect(page.locator("[data-phase=watching]")).to_be_visible()
    film.take_clips(SECOND_PAIR_MS)
    return film


def _hold(film: Film, route: Route) -> None:
    """The answer is photographed on its way."""
    film.take(REST_MS)
    route.continue_()


def photograph_dashboard(chromium: Browser, address: str, cookie: str) -> None:
    """The study's page, once it says who is comparing."""
    context = chromium.new_context(viewport={"width": WIDE, "height": 800})
    context.add_cookies([{"name": "studio_experimenter", "value": cookie, "url": address}])
    page = context.new_page()
    page.set_default_timeout(PATIENCE_MS)
    page.goto(f"{address}/studies")
    page.get_by_role("link", name="Demo: feeding").click()
    expect(page.get_by_role("row").filter(has_text="P04")).to_contain_text(f"{len(ANSWERS)} of 24")
    table = page.get_by_role("table").first.bounding_box()
    assert table is not None
    page.screenshot(
        path=PICTURES / "dashboard.png",
        full_page=True,
        clip={"x": 0, "y": 0, "width": WIDE, "height": table["y"] + table["height"] + 16},
    )


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter).parse_args()
    expect.set_options(timeout=PATIENCE_MS)
    with demo_studio() as (address, token, cookie), launched() as chromium:
        film_pairs(chromium, f"{address}/p/{token}").save(PICTURES / "pair.webp")
        photograph_dashboard(chromium, address, cookie)
    for name in ("pair.webp", "dashboard.png"):
        sys.stdout.write(f"Wrote docs/pictures/{name}, {(PICTURES / name).stat().st_size / 1e6:.2f} MB\n")
