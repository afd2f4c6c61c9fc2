"""Chromium for the browser tests, one for each file, and a participant with a link to open in it."""

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from typing import Any

import pytest
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Browser, BrowserContext, Locator, Page, expect
from sqlalchemy import select
from sqlalchemy.orm import Session

from app.db import Database
from app.domain.preferences import LabelEvent, current_answers
from app.domain.studies import Participant, Study
from app.storage import ArtefactStore
from tests import factories
from tests.chromium import launched
from tests.made_once import made_once


@pytest.fixture(scope="module")
def chromium() -> Iterator[Browser]:
    """The system's Chromium, without a window.

    Not for the whole session: while Playwright is there, an event loop counts as running, in which other tests of the
    same process cannot start the worker's engine.
    """
    with launched() as browser:
        yield browser


NewPage = Callable[..., Page]
PATIENCE_MS = 120_000
"""Until a state must have come. No test depends on how fast the machine is, so this only ends tests that fail."""
expect.set_options(timeout=PATIENCE_MS)
HELD = """(() => {
    const own = Object.getOwnPropertyDescriptor(HTMLMediaElement.prototype, "playbackRate");
    Object.defineProperty(HTMLMediaElement.prototype, "playbackRate", {
        ...own,
        set(wanted) {
            const held = this.hasShown ? 0 : 0.0625;
            own.set.call(this, window.mayRun || this.currentTime > 1 ? wanted : held);
        },
    });
    const shown = ({ target }) => {
        target.requestVideoFrameCallback(() => {
            target.hasShown = true;
            target.playbackRate = 1;
        });
        target.playbackRate = 1;
    };
    addEventListener("play", shown, true);
})()"""
"""Clips play, but stand still from the first frame on that is shown to the page, until they may run; from the middle on
they run as ever. Until then they creep: one that stands still may have shown its first frame before anybody asked."""
SETTLED = """() => Promise.all(
    document.getAnimations()
        .filter((each) => each.effect.getComputedTiming().endTime !== Infinity)
        .map((each) => each.finished.catch(() => null))
)"""
"""Waits until every transition on the page has ended."""


@dataclass
class Invited:
    """A participant with a link, and queries waiting."""

    address: str
    token: str
    participant: Participant
    study: Study
    database: Database

    @property
    def link(self) -> str:
        """The personal link."""
        return f"{self.address}/p/{self.token}"

    def events(self) -> list[LabelEvent]:
        """Everything stored about this participant's answers, in its order."""
        with self.database.reading() as session:
            return list(session.scalars(select(LabelEvent).order_by(LabelEvent.id)))

    def responses(self) -> list[str]:
        """The answers that count."""
        with self.database.reading() as session:
            return [label.response.value for label in current_answers(session, self.participant.id)]


@pytest.fixture
def invited(database: Database, store: ArtefactStore, address: str, request: pytest.FixtureRequest) -> Invited:
    """Ready to compare, in a study of usual settings; ``indirect`` parametrisation gives False, or other settings."""
    param = getattr(request, "param", {})
    with database.writing() as session:
        made, token = made_once(_invite, session, store, param is not False, **(param or {}))
        participant = session.get_one(Participant, made)
        study = session.get_one(Study, participant.study_id)
    return Invited(address, token, participant, study, database)


def _invite(session: Session, store: ArtefactStore, /, ready: bool, **settings: Any) -> tuple[int, str]:
    study = factories.make_study(session, **settings)
    participant, token = factories.make_participant(session, study, ready=ready)
    factories.make_queries(session, store, participant, 12)
    return participant.id, token


@pytest.fixture
def new_page(chromium: Browser) -> Iterator[NewPage]:
    """Opens a fresh browser profile; fails the test on any error its scripts raise."""
    contexts: list[BrowserContext] = []
    errors: list[str] = []

    def open_page(**options: object) -> Page:
        context = chromium.new_context(**{"viewport": {"width": 1366, "height": 768}, **options})  # type: ignore[arg-type]
        context.set_default_timeout(PATIENCE_MS)
        contexts.append(context)
        page = context.new_page()
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.on("console", lambda message: errors.append(message.text) if "Content Security" in message.text else None)
        return page

    yield open_page
    for context in contexts:
        context.close()
    assert errors == []


def the_only(found: Locator) -> Locator:
    """Once it is alone: without scripts the closed controls stay beside the plain ones until no_script.css is there."""
    expect(found).to_have_count(1)
    return found


def hold_clips(page: Page) -> None:
    """Whatever opens from now on does not get past the first moment of a clip: what is done meanwhile may take long."""
    page.add_init_script(HELD)


def let_clips_run(page: Page) -> None:
    """Those that were held, from where they are."""
    page.evaluate(
        "window.mayRun = true; document.querySelectorAll('video').forEach((video) => (video.playbackRate = 1))"
    )


def wait_ready(page: Page, answered: int) -> None:
    """Until this many answers are given and the next pair plays."""
    expect(page.locator("[data-count]")).to_have_text(f"{answered} of 10")
    expect(page.locator("[data-phase=ready]")).to_be_visible()


STYLES_ARE_THERE = """async () => {
  const links = [...document.querySelectorAll("link[rel=stylesheet]")];
  while (!links.every((link) => link.sheet)) await new Promise((wake) => setTimeout(wake, 50));
}"""
"""Evaluated, not waited for as a function: the pages forbid what that evaluates."""


OVERFLOW = """() => {
  const page = document.documentElement;
  return [page.scrollWidth - innerWidth, page.scrollHeight - innerHeight];
}"""


def overflow(page: Page) -> list[int]:
    """By how many pixels the page is wider and higher than its window; nothing is measured before its styles count.

    Whoever has just left a page first waits for something that only the next one has.
    """
    page.evaluate(STYLES_ARE_THERE)
    return list(page.evaluate(OVERFLOW))


LOOKED_AT: dict[str, dict[str, Any]] = {"light": {}, "dark": {"runOnly": ["color-contrast"]}}
"""What the themes differ in is colours: the rest is the same page, and looked at once."""


def serious_findings(page: Page) -> list[str]:
    """What axe finds wrong in either theme for people who use assistive technology.

    Whoever has just left a page first waits for something that only the next one has.
    """
    found = []
    for scheme in ("light", "dark"):
        page.emulate_media(color_scheme="dark" if scheme == "dark" else "light")
        found += [f"{scheme}: {each}" for each in findings(page, ("serious", "critical"), LOOKED_AT[scheme])]
    page.emulate_media(color_scheme="null")
    page.evaluate(SETTLED)
    return found


def findings(page: Page, impacts: Collection[str] | None = None, options: dict[str, Any] | None = None) -> list[str]:
    """What axe finds wrong in the page as it is, by default of any impact, once nothing moves any more.

    A button that is still fading in has the contrast of no state a person reads.
    """
    page.evaluate(STYLES_ARE_THERE)
    page.evaluate(SETTLED)
    violations = Axe().run(page, options=options).response["violations"]
    return [
        f"{each['id']}: {each['nodes'][0]['html']}"
        for each in violations
        if impacts is None or each["impact"] in impacts
    ]
