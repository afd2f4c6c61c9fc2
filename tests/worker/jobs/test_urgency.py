"""Whoever waits comes first: found from the rows alone, kept in the lanes, and nobody else is held up for good."""

import threading
from collections.abc import Callable
from datetime import timedelta
from itertools import count
from typing import Any

import pytest
from sqlalchemy.orm import Session

from app.db import Database, now
from app.domain.evaluation import Donors, SharedFilter
from app.domain.models import ModelKind
from app.domain.protocol import EvaluatedMethod
from app.domain.studies import Awaited, Participant, Study
from app.services.evaluation import donors
from tests.worker.invented import job_of
from worker.compute.pools import Compute, Lane
from worker.jobs.runtime import lanes as lanes_module
from worker.jobs.runtime import records
from worker.jobs.runtime.lanes import Lanes
from worker.jobs.runtime.records import Job
from worker.jobs.runtime.urgency import Gate, Level, Urgency, WhoWaits


def add_study(session: Session, slug: str, study: Study) -> Study:
    other = Study(slug=slug, name=slug, stored_settings=study.stored_settings, seed=1)
    session.add(other)
    session.flush()
    return other


_numbers = count(2)


def add_person(session: Session, study: Study, awaited: Awaited | None = None, **ago_s: float) -> Participant:
    """Somebody last seen, and waiting since, so many seconds ago; never seen without."""
    number = next(_numbers)
    person = Participant(study_id=study.id, number=number, token_sha256=f"{number:064x}", seed=number)
    person.waiting_for = awaited
    person.last_seen_at = now() - timedelta(seconds=ago_s["seen"]) if "seen" in ago_s else None
    person.waiting_since = now() - timedelta(seconds=ago_s["waiting"]) if "waiting" in ago_s else None
    session.add(person)
    session.flush()
    return person


def films(person: Participant, what: str = "trials") -> Job:
    return job_of(f"films/participant-{person.id}/{what}/labels-20/answer-9", person.study_id)


def clips(study: Study) -> Job:
    return job_of(f"clips/study-{study.id}/scenario-1", study.id)


def level(database: Database, job: Job) -> Level:
    with database.reading() as session:
        return WhoWaits.look(session).urgency(job).level


def test_work_is_ordered_by_who_waits_and_how_long_and_not_by_study(database: Database, study: Study) -> None:
    with database.writing() as session:
        idle, busy, third = study, add_study(session, "busy", study), add_study(session, "third", study)
        gone = add_person(session, idle, Awaited.ROBOTS, seen=3600, waiting=4000)
        later = add_person(session, busy, Awaited.ROBOTS, seen=2, waiting=30)
        longer = add_person(session, busy, Awaited.ROBOTS, seen=20, waiting=500)
        answering = add_person(session, third, seen=5)
        unopened = add_study(session, "unopened", study)
    report = job_of("report/study-1/basis-0", idle.id)
    asked = job_of("export/study-1/data-1", idle.id)
    wanted = [films(longer), films(later), films(answering), asked, films(gone), clips(idle), clips(unopened), report]
    with database.reading() as session:
        waits = WhoWaits.look(session)
    mixed = [*reversed(wanted)]
    assert sorted(mixed, key=waits.urgency) == wanted


def test_of_one_person_what_the_first_robot_needs_comes_before_the_debrief(database: Database, study: Study) -> None:
    with database.writing() as session:
        person = add_person(session, study, Awaited.ROBOTS, seen=1, waiting=60)
    learning = job_of(f"filter/participant-{person.id}/labels-20", study.id)
    wanted = [learning, films(person), films(person, "before-after")]
    with database.reading() as session:
        waits = WhoWaits.look(session)
    mixed = [*reversed(wanted)]
    assert sorted(mixed, key=waits.urgency) == wanted
    assert [waits.urgency(job).level for job in wanted] == [Level.WAITING, Level.WAITING, Level.DUE]


def test_whoever_rates_the_first_robot_waits_for_the_next(database: Database, study: Study) -> None:
    with database.writing() as session:
        person = add_person(session, study, seen=1)
    assert level(database, films(person)) is Level.WAITING
    assert level(database, films(person, "before-after")) is Level.ANSWERING


def test_films_that_somebody_may_be_shown_later_come_after_the_clips_that_they_compare(
    database: Database, study: Study
) -> None:
    with database.writing() as session:
        person = add_person(session, study, seen=1)
    ahead = job_of(f"films/participant-{person.id}/ahead", study.id)
    assert (level(database, clips(study)), level(database, ahead)) == (Level.ANSWERING, Level.POOL)


def test_pairs_that_follow_somebody_are_made_while_they_answer_and_never_before_what_anybody_waits_for(
    database: Database, study: Study
) -> None:
    with database.writing() as session:
        answering, gone = add_person(session, study, seen=1), add_person(session, study, seen=3600)
        waiting = add_person(session, study, Awaited.ROBOTS, seen=1, waiting=1)
    made = [job_of(f"clips/participant-{each.id}/made/labels-10", study.id) for each in (answering, gone, waiting)]
    assert [level(database, each) for each in made] == [Level.ANSWERING, Level.POOL, Level.POOL]
    with database.reading() as session:
        waits = WhoWaits.look(session)
    assert min([*made, films(waiting)], key=waits.urgency) == films(waiting)


def test_a_refinement_for_whoever_answers_comes_before_those_that_are_lent(database: Database, study: Study) -> None:
    with database.writing() as session:
        answering, gone = add_person(session, study, seen=1), add_person(session, study, seen=3600)
    ahead, of_gone = [
        job_of(f"refinement/participant-{each.id}/ahead/labels-20", study.id) for each in (answering, gone)
    ]
    shared = job_of(f"shared/study-{study.id}/filter-1-0", study.id)
    assert (level(database, ahead), level(database, shared)) == (Level.ANSWERING, Level.POOL)
    with database.reading() as session:
        waits = WhoWaits.look(session)
    mixed = [of_gone, shared, ahead]
    assert sorted(mixed, key=waits.urgency) == [ahead, shared, of_gone]


def test_what_the_last_filter_goes_on_from_comes_before_an_earlier_filter(database: Database, study: Study) -> None:
    with database.writing() as session:
        answering = add_person(session, study, seen=1)
    ahead = job_of(f"refinement/participant-{answering.id}/ahead/labels-20", study.id)
    early = job_of(f"filter/participant-{answering.id}/labels-20", study.id)
    with database.reading() as session:
        waits = WhoWaits.look(session)
    assert sorted([early, ahead], key=waits.urgency) == [ahead, early]
    assert waits.urgency(early).level == waits.urgency(ahead).level


def test_nobody_waits_for_the_numbers_of_a_method_that_can_be_shown(database: Database, study: Study) -> None:
    with database.writing() as session:
        person = add_person(session, study, Awaited.ROBOTS, seen=1, waiting=60)
        method = job_of(f"method/participant-{person.id}/average/labels-20/answer-9", study.id)
        run_id = records.begin_run(session, method, seed=1)
    assert level(database, method) is Level.WAITING
    with database.writing() as session:
        records.set_labels(session, run_id, 20, "hash")
        records.save_model(session, run_id, ModelKind.METHOD, "0" * 64, {"method": "average"})
    assert level(database, method) is Level.DUE


def test_whoever_looks_at_the_debrief_waits_for_its_films(database: Database, study: Study) -> None:
    with database.writing() as session:
        person = add_person(session, study, Awaited.DEBRIEF, seen=1, waiting=60)
    assert level(database, films(person, "before-after")) is Level.WAITING


@pytest.mark.parametrize(
    ("awaited", "ago_s", "expected"),
    [
        (Awaited.PAIR, {"seen": 2, "waiting": 9}, Level.WAITING),
        (None, {"seen": 2}, Level.ANSWERING),
        (Awaited.ROBOTS, {"seen": 2, "waiting": 9}, Level.POOL),
        (Awaited.PAIR, {"seen": 600, "waiting": 900}, Level.POOL),
        (None, {}, Level.POOL),
    ],
)
def test_clips_are_as_urgent_as_whoever_needs_pairs_of_them(
    database: Database, study: Study, awaited: Awaited | None, ago_s: dict[str, float], expected: Level
) -> None:
    assert level(database, clips(study)) is Level.UNOPENED
    with database.writing() as session:
        add_person(session, study, awaited, **ago_s)
    assert level(database, clips(study)) is expected


def test_a_filter_for_several_is_as_urgent_as_whoever_is_to_be_lent_it(database: Database, study: Study) -> None:
    with database.writing() as session:
        person = add_person(session, study, Awaited.ROBOTS, seen=2, waiting=30)
        drawn = donors.draw(session, study, person, EvaluatedMethod.AVERAGE, ["neutral", "cautious"])
        add_person(session, study, seen=2)
        theirs, another = (
            SharedFilter(study_id=study.id, stored_donors=Donors(types=types).model_dump(mode="json"))
            for types in (drawn.donors.types, ("impatient",))
        )
        session.add_all([theirs, another])
        session.flush()
        jobs = [Job(donors.key_of(each), study.id) for each in (theirs, another)]
    assert [level(database, job) for job in jobs] == [Level.WAITING, Level.POOL]


def test_a_report_is_asked_for_once_the_study_is_unblinded(database: Database, study: Study) -> None:
    report = job_of("report/study-1/basis-0", study.id)
    assert level(database, report) is Level.UNREAD
    with database.writing() as session:
        session.get_one(Study, study.id).unblinded_at = now()
    assert level(database, report) is Level.ASKED


def at(what: Level) -> Callable[[], Urgency]:
    return lambda: Urgency(what, now(), 0)


def test_a_gate_lets_the_most_urgent_in_first_however_late_they_came() -> None:
    gate, order = Gate(1), list[Level]()
    threads = []

    def go(what: Level) -> None:
        with gate.passed(at(what)):
            order.append(what)

    with gate.passed(at(Level.DUE)):
        for what in (Level.UNREAD, Level.POOL, Level.WAITING, Level.DUE):
            thread = threading.Thread(target=go, args=(what,))
            thread.start()
            threads.append(thread)
            while len(gate._waiting) < len(threads):
                threading.Event().wait(0.01)
        assert gate.is_awaited_above(Level.DUE)
        assert not gate.is_awaited_above(Level.WAITING)
    for thread in threads:
        thread.join()
    assert order == [Level.WAITING, Level.DUE, Level.POOL, Level.UNREAD]


class Slowly(Compute):
    """Works in this process, one task at a time, each when it is told to."""

    def __init__(self) -> None:
        super().__init__(1)
        self.order: list[str] = []
        self.go_on = threading.Semaphore(0)

    def run(self, lane: Lane, beat: Callable[[], None], function: Any, *args: Any, **kwargs: Any) -> Any:
        """See Compute."""
        self.go_on.acquire()
        return function(*args, **kwargs)


def test_a_long_job_that_began_earlier_gives_way_within_one_task(database: Database, study: Study) -> None:
    with database.writing() as session:
        away = add_person(session, study, seen=3600)
        waiting = add_person(session, study, Awaited.ROBOTS, seen=1, waiting=5)
    compute = Slowly()
    lanes = Lanes(compute)
    with database.reading() as session:
        lanes.who_waits = WhoWaits.look(session)

    def work(person: Participant, name: str, tasks: int) -> threading.Thread:
        turn = lanes.of(films(person))
        arguments = [(f"{name}{index}",) for index in range(tasks)]
        thread = threading.Thread(target=turn.run_all, args=(Lane.CLIPS, lambda: None, compute.order.append, arguments))
        thread.start()
        return thread

    gate = lanes.gate(Lane.CLIPS)
    long = work(away, "long", 6)
    while gate._free > 0:
        threading.Event().wait(0.01)
    urgent = work(waiting, "urgent", 2)
    while not gate.is_awaited_above(Level.DUE):
        threading.Event().wait(0.01)
    for _ in range(8):
        compute.go_on.release()
    long.join()
    urgent.join()
    places = compute.size(Lane.CLIPS) + 1
    assert {"urgent0", "urgent1"} <= set(compute.order[: places + 2]), "after the tasks that were already in the lane"
    assert len(compute.order) == 8, "and the long job is finished afterwards"


def test_between_two_works_of_somebody_who_waits_nothing_else_slips_in(
    database: Database, study: Study, monkeypatch: pytest.MonkeyPatch
) -> None:
    with database.writing() as session:
        waiting = add_person(session, study, Awaited.ROBOTS, seen=1, waiting=5)
    lanes = Lanes(Compute(1))
    with database.reading() as session:
        lanes.who_waits = WhoWaits.look(session)
    with lanes.working(Lane.LEARNING, films(waiting)):
        pass
    assert lanes._holds_back(Lane.CLIPS, Level.UNOPENED)
    assert not lanes._holds_back(Lane.CLIPS, Level.WAITING)
    lanes.who_waits = WhoWaits()
    assert not lanes._holds_back(Lane.CLIPS, Level.UNOPENED), "nobody waits any more"
    monkeypatch.setattr(lanes_module, "LINGER_S", 0.0)
    with database.reading() as session:
        lanes.who_waits = WhoWaits.look(session)
    with lanes.working(Lane.LEARNING, films(waiting)):
        pass
    assert not lanes._holds_back(Lane.CLIPS, Level.UNOPENED), "and not for ever, whatever they still wait for"


def test_while_somebody_waits_no_lane_takes_what_nobody_is_here_for(
    database: Database, study: Study, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lanes_module, "LINGER_S", 0.0)
    with database.writing() as session:
        waiting = add_person(session, study, Awaited.ROBOTS, seen=1, waiting=5)
        unopened = add_study(session, "unopened", study)
    lanes = Lanes(Compute(1))
    with database.reading() as session:
        lanes.who_waits = WhoWaits.look(session)
    done = threading.Event()

    def make_clips() -> None:
        with lanes.gate(Lane.CLIPS).passed(lambda: lanes.who_waits.urgency(clips(unopened))):
            done.set()

    with lanes.working(Lane.LEARNING, films(waiting)):
        thread = threading.Thread(target=make_clips)
        thread.start()
        while not lanes.gate(Lane.CLIPS)._waiting:
            threading.Event().wait(0.01)
        with lanes.gate(Lane.CLIPS).passed(lambda: lanes.who_waits.urgency(films(waiting))):
            assert not done.is_set(), "there is room, but the processors are needed"
    thread.join()
    assert done.is_set()


def test_a_training_of_many_minutes_does_not_stop_the_other_lanes(database: Database, study: Study) -> None:
    with database.writing() as session:
        waiting = add_person(session, study, Awaited.ROBOTS, seen=1, waiting=5)
    lanes = Lanes(Compute(1))
    with database.reading() as session:
        lanes.who_waits = WhoWaits.look(session)
    with (
        lanes.working(Lane.PATIENT, films(waiting)),
        lanes.gate(Lane.CLIPS).passed(lambda: lanes.who_waits.urgency(clips(study))),
    ):
        pass


@pytest.mark.parametrize("lane", [Lane.LEARNING, Lane.PATIENT])
def test_clips_of_a_study_without_participants_leave_a_processor_to_what_is_learned_for_somebody(
    database: Database, study: Study, lane: Lane
) -> None:
    with database.writing() as session:
        present = add_person(session, study, None, seen=1)
        unopened = add_study(session, "unopened", study)
    lanes = Lanes(Compute(2))
    with database.reading() as session:
        lanes.who_waits = WhoWaits.look(session)
    first = lanes.gate(Lane.CLIPS).passed(lambda: lanes.who_waits.urgency(clips(unopened)))
    with lanes.working(lane, job_of(f"refinement/participant-{present.id}/ahead/labels-20", study.id)):
        assert not lanes._holds_back(Lane.CLIPS, Level.UNOPENED), "there are two processors"
        with first:
            assert lanes._holds_back(Lane.CLIPS, Level.UNOPENED)
            assert not lanes._holds_back(Lane.CLIPS, Level.POOL), "whose study has participants"
    with lanes.gate(Lane.CLIPS).passed(lambda: lanes.who_waits.urgency(clips(unopened))):
        assert not lanes._holds_back(Lane.CLIPS, Level.UNOPENED), "nothing is learned"


def test_what_goes_wrong_in_one_task_reaches_the_job(database: Database, study: Study) -> None:
    compute = Slowly()
    for _ in range(3):
        compute.go_on.release()
    turn = Lanes(compute).of(clips(study))
    with pytest.raises(ZeroDivisionError):
        turn.run_all(Lane.CLIPS, lambda: None, divmod, [(1, 1), (1, 0)])
