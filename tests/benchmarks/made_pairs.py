"""Prints how soon a pair that follows somebody is ready, and whether anybody waited meanwhile.

Scripted participants answer in a real studio with the usual settings. Wanted is a pair from the moment in which the
model is stored that it follows; only one is in the making at a time. A page is timed from sending an answer to having
read the page with the next pair.

    python -m tests.benchmarks.made_pairs --people 1
"""

import argparse
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from datetime import datetime
from itertools import pairwise
from pathlib import Path

import numpy as np
from sqlalchemy import func, select

from app.db import Database, now
from app.domain.clips import Clip, Rollout
from app.domain.models import Model, Run
from app.domain.preferences import FOLLOWING, LabelEvent, Query
from app.domain.run_keys import MADE
from app.domain.study_settings import StudySettings
from app.services.participants import enrolment
from app.services.studies import studies
from app.storage import ArtefactStore
from worker.ml.teachers import TASTES, Manner
from worker.rehearsal.browser import UP_TO_PAIRS, FormBrowser
from worker.rehearsal.participant_steps import ScriptedPerson
from worker.rehearsal.server import POLL_S, OwnStudio, wait_until

PATIENCE_S = 3600.0


class Decided(ScriptedPerson):
    """Makes up their mind before the clock runs."""

    said = ""

    def decide(self, query_id: int) -> None:
        """Watch both clips."""
        self.said = super().answer(query_id)

    def answer(self, query_id: int) -> str:
        """See Visitor."""
        return self.said


@dataclass
class Times:
    """What was seen of one participant."""

    participant_id: int
    pages: list[tuple[datetime, float]] = field(default_factory=list)
    """when an answer was sent, and the ms until there was the next page"""
    without_pair: int = 0
    """pages after an answer on which no pair was ready"""


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--people", type=int, default=1, help="at once")
    parser.add_argument("--labels", type=int, default=40)
    parser.add_argument("--scenarios", type=int, default=9, help="of the pool, which is filmed before anybody answers")
    parser.add_argument("--share", type=float, default=0.3)
    parser.add_argument("--pace", type=float, default=6.0, help="seconds between two answers")
    parser.add_argument("--task", default="feeding")
    options = parser.parse_args()
    wanted = {"pool_scenarios": options.scenarios, "following_share": options.share, "filter_milestones": ()}
    settings = StudySettings(labels_per_participant=options.labels, practice_pairs=0, catch_pairs=0, **wanted)
    with tempfile.TemporaryDirectory() as directory, OwnStudio(Path(directory)) as studio, ExitStack() as browsers:
        database, store = Database(studio.settings.sqlalchemy_url), ArtefactStore(Path(directory) / "artefacts")
        with database.writing() as session:
            study = studies.create_study(session, "Following", settings, seed=2, task=options.task)
            invited = [enrolment.add_participant(session, study) for _ in range(options.people)]
        clips = options.scenarios * settings.behaviours_per_scenario
        wait_until(PATIENCE_S, "not all clips", lambda: _count(database) >= clips or None)
        people = [
            (
                Times(participant.id),
                Decided(database, store, study, TASTES["cautious"], Manner(), participant.number),
                browsers.enter_context(FormBrowser(studio.settings.base_url, f"/p/{token}")),
            )
            for participant, token in invited
        ]
        while any(browser.page in UP_TO_PAIRS for _, _, browser in people):
            began = time.monotonic()
            for times, person, browser in people:
                _step(times, person, browser)
            time.sleep(max(POLL_S, options.pace - (time.monotonic() - began)))
        _report(database, [times for times, _, _ in people])
        database.dispose()


def _count(database: Database) -> int:
    with database.reading() as session:
        return session.scalar(select(func.count(Clip.id))) or 0


def _step(times: Times, person: Decided, browser: FormBrowser) -> None:
    """One page of one participant."""
    if browser.page not in UP_TO_PAIRS:
        return
    query_id = browser.query_id()
    if query_id is None:
        browser.act(person)
        return
    person.decide(query_id)
    sent, began = now(), time.perf_counter()
    browser.act(person)
    times.pages.append((sent, 1000 * (time.perf_counter() - began)))
    times.without_pair += browser.page == "waiting"


def _report(database: Database, everybody: Sequence[Times]) -> None:
    ready: list[list[float]] = []
    made_in, busy, idle, following, answered = list[float](), list[float](), list[float](), 0, 0
    with database.reading() as session:
        for times in everybody:
            mine = Run.participant_id == times.participant_id
            runs = session.scalars(select(Run).where(mine, Run.workflow_id.contains(f"/{MADE}/"))).all()
            spans = [(run.started_at, run.finished_at or now()) for run in runs]
            for sent, ms in times.pages:
                (busy if any(begin <= sent <= end for begin, end in spans) else idle).append(ms)
            made = session.scalars(
                select(Rollout).where(Rollout.participant_id == times.participant_id).order_by(Rollout.created_at)
            ).all()[1::2]
            models = session.scalars(select(Model).join(Run, Run.id == Model.run_id).where(mine)).all()
            for model in sorted(models, key=lambda each: each.created_at):
                later = [each.created_at for each in models if each.created_at > model.created_at]
                until = min(later, default=now())
                stored = [each.created_at for each in made if model.created_at <= each.created_at < until]
                marks = [model.created_at, *stored]
                ready.append([(each - model.created_at).total_seconds() for each in stored])
                made_in += [(b - a).total_seconds() for a, b in pairwise(marks)]
            given = select(Query.strategy).join(LabelEvent).where(Query.participant_id == times.participant_id)
            shown = session.scalars(given.where(Query.ordinal > 10)).all()
            following, answered = following + shown.count(FOLLOWING), answered + len(shown)
    for place in range(max(map(len, ready), default=0)):
        seconds = [each[place] for each in ready if len(each) > place]
        _say(f"pair {place + 1} of a model, from the stored model: {_spread(seconds)} s")
    _say(f"each pair after the one before: {_spread(made_in)} s")
    _say(f"pages while a pair is made: {_spread(busy)} ms; at other times: {_spread(idle)} ms")
    _say(f"answers after the tenth: {answered}, of which {following} to pairs that follow")
    _say(f"answers after which no pair was ready: {sum(each.without_pair for each in everybody)}")


def _spread(values: Sequence[float]) -> str:
    if not values:
        return "none"
    middle, high = np.quantile(values, [0.5, 0.95])
    return f"median {middle:.1f}, 95 % within {high:.1f}, slowest {max(values):.1f} (N = {len(values)})"


def _say(text: str) -> None:
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
