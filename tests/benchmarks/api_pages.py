"""How long a page takes over the API at the beginning and at the end of a table.

    python -m tests.benchmarks.api_pages --people 100 --answers 200

The ratio is what counts: it does not depend on the machine. With offsets instead of cursors the last page read
everything before it.
"""

import argparse
import sys
import tempfile
import time
from pathlib import Path
from statistics import median

from fastapi.testclient import TestClient
from sqlalchemy import insert, select

from app.__main__ import migrate
from app.domain.people import Experimenter
from app.domain.preferences import LabelEvent, Query
from app.main import create_app
from app.services.accounts import accounts, api_tokens
from app.settings import Settings
from tests import factories

TABLES = ("labels", "queries")
ROUNDS = 9


def main() -> None:
    """Fill a studio, page through its tables, and print the times."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--people", type=int, default=100)
    parser.add_argument("--answers", type=int, default=200, help="of each")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as directory:
        settings = Settings(_env_file=None, data_dir=Path(directory))
        migrate(settings)
        application = create_app(settings)
        slug, token = _fill(application.state.studio, options.people, options.answers)
        browser = TestClient(application, headers={"Authorization": f"Bearer {token}"})
        for table in TABLES:
            _measure(browser, f"/api/v1/studies/{slug}/tables/{table}?limit=100")
        application.state.studio.database.dispose()


def _measure(browser: TestClient, first: str) -> None:
    pages, page = [], first
    while page:
        pages.append(page)
        page = browser.get(page).raise_for_status().json()["next"]
    pairs = zip(pages[:ROUNDS], pages[-ROUNDS:], strict=True)  # by turns: the machine may be busy for a while
    times = [(_time_s(browser, first), _time_s(browser, last)) for first, last in pairs]
    early, late = (median(some) for some in zip(*times, strict=True))
    rows = 100 * len(pages)
    sys.stdout.write(
        f"{first.split('?')[0].split('/')[-1]}: {rows} rows; first pages {1000 * early:.0f} ms, "
        f"last pages {1000 * late:.0f} ms, ratio {late / early:.2f}\n"
    )


def _time_s(browser: TestClient, page: str) -> float:
    started = time.perf_counter()
    browser.get(page).raise_for_status()
    return time.perf_counter() - started


def _fill(studio, people: int, answers: int) -> tuple[str, str]:  # type: ignore[no-untyped-def]
    with studio.database.writing() as session:
        accounts.create_first_experimenter(session)
        session.flush()
        owner = session.scalars(select(Experimenter)).one()
        owner.must_change_password = False
        study = factories.make_study(session)
        left, right = (factories.make_clip(session, studio.store, study) for _ in range(2))
        for _ in range(people):
            person, _ = factories.make_participant(session, study)
            session.execute(
                insert(Query),
                [
                    {
                        "participant_id": person.id,
                        "ordinal": ordinal,
                        "left_clip_id": left.id,
                        "right_clip_id": right.id,
                        "strategy": "uniform",
                        "propensity": 1.0,
                    }
                    for ordinal in range(1, answers + 1)
                ],
            )
            ids = session.scalars(select(Query.id).where(Query.participant_id == person.id)).all()
            events = [{"query_id": each, "revision": 1, "response": "left", "client_uuid": f"u{each}"} for each in ids]
            session.execute(insert(LabelEvent), events)
        return study.slug, api_tokens.create(session, owner, "benchmark")[1]


if __name__ == "__main__":
    main()
