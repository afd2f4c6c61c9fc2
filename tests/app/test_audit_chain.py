"""The audit log is a chain: whatever is done to its rows is found, and forgetting people leaves it whole."""

import json
import random
import threading
from collections.abc import Callable, Sequence
from datetime import timedelta
from pathlib import Path

import pytest
from alembic import command
from alembic.config import Config
from fastapi.testclient import TestClient
from sqlalchemy import create_engine, delete, select, text, update

from app import signing
from app.__main__ import main
from app.db import Database, now
from app.domain.people import AuditEvent, ErasureReceipt
from app.domain.studies import Participant, Study
from app.services import audit
from app.services.accounts import hourly_counts
from app.services.accounts.hourly_counts import HourlyCounts
from app.services.auditing import chain_check, lookup, receipts
from app.services.participants import withdrawal
from app.services.studies import retirement
from app.settings import Settings
from app.storage import ArtefactStore
from tests import factories
from tests.app.conftest import TakingPart

Rows = list[AuditEvent]
_NAMES = [column.name for column in AuditEvent.__table__.columns]


def copied(row: AuditEvent, **changes: object) -> AuditEvent:
    return AuditEvent(**{name: getattr(row, name) for name in _NAMES} | changes)


def rehashed(row: AuditEvent) -> AuditEvent:
    """As somebody writes it who knows how rows are hashed."""
    if row.subject is not None:
        row.subject_hash = audit.hash_of_subject(row.subject_salt or "", row.subject, row.participant_id)
    row.row_hash = audit.hash_of_row(row)
    return row


def edit(rows: Rows, at: int, rng: random.Random) -> Rows:
    changes: dict[str, object] = {
        "actor": "somebody else",
        "action": "nothing at all",
        "subject": "another subject",
        "at": rows[at].at + timedelta(microseconds=1),
        "study_id": 99,
        "participant_id": 99,
        "subject_salt": "0" * 32,
        "subject_hash": "0" * 64,
        "row_hash": "0" * 64,
        "previous_hash": "1" * 64,
        "id": 10**6 + at,
    }
    name = rng.choice(sorted(changes))
    return [*rows[:at], copied(rows[at], **{name: changes[name]}), *rows[at + 1 :]]


def edit_cleverly(rows: Rows, at: int, rng: random.Random) -> Rows:
    changed = rehashed(copied(rows[at], subject="another subject", actor=rng.choice(["pat", "kim"])))
    return [*rows[:at], changed, *rows[at + 1 :]]


def remove(rows: Rows, at: int, rng: random.Random) -> Rows:
    return rows[:at] + rows[at + rng.randint(1, 3) :]


def insert(rows: Rows, at: int, rng: random.Random) -> Rows:
    made_up = copied(rows[at], id=rng.choice([rows[at].id, 10**6]), subject="never happened")
    return [*rows[:at], rng.choice([made_up, rehashed(made_up)]), *rows[at:]]


def swap(rows: Rows, at: int, rng: random.Random) -> Rows:
    other = (at + rng.randint(1, len(rows) - 1)) % len(rows)
    moved = list(rows)
    moved[at], moved[other] = rows[other], rows[at]
    return moved


def blank(rows: Rows, at: int, _rng: random.Random) -> Rows:
    gone = copied(rows[at], subject=None, subject_salt=None, participant_id=None)
    return [*rows[:at], gone, *rows[at + 1 :]]


@pytest.fixture
def chain(database: Database) -> Rows:
    with database.writing() as session:
        study = factories.make_study(session)
        for _ in range(5):
            factories.make_participant(session, study)
    for number in range(14):
        with database.writing() as session:
            audit.record(session, "pat", "answers viewed", f"{study.slug}/{number}", study=study)
    with database.reading() as session:
        return list(session.scalars(select(AuditEvent).order_by(AuditEvent.id)))


@pytest.mark.parametrize("tamper", [edit, edit_cleverly, remove, insert, swap, blank])
def test_whatever_is_done_to_a_row_is_found(chain: Rows, tamper: Callable[[Rows, int, random.Random], Rows]) -> None:
    assert chain_check.check_rows(chain, {}).faults == []
    noted = chain[-1].row_hash
    for seed in range(200):
        rng = random.Random(seed)  # noqa: S311  (no secret)
        changed = tamper(chain, rng.randrange(len(chain)), rng)
        assert chain_check.check_rows(changed, {}, noted).faults, f"seed {seed}"


@pytest.mark.parametrize("tamper", [edit, edit_cleverly, remove, insert, swap, blank])
def test_before_the_newest_rows_it_is_found_without_a_noted_head(
    chain: Rows, tamper: Callable[[Rows, int, random.Random], Rows]
) -> None:
    for seed in range(200):
        rng = random.Random(seed)  # noqa: S311  (no secret)
        changed = tamper(chain, rng.randrange(len(chain) - 4), rng)
        assert chain_check.check_rows(changed, {}).faults, f"seed {seed}"


def test_removed_newest_rows_and_a_chain_made_anew_are_found_by_whoever_noted_the_head(chain: Rows) -> None:
    head = chain[-1].row_hash
    assert chain_check.check_rows(chain[:-1], {}).faults == []
    assert chain_check.check_rows(chain[:-1], {}, head).faults
    made_anew, previous = [], audit.BEGINNING
    for row in chain:
        made_anew.append(rehashed(copied(row, actor="nobody", previous_hash=previous)))
        previous = made_anew[-1].row_hash
    assert chain_check.check_rows(made_anew, {}).faults == []
    assert chain_check.check_rows(made_anew, {}, head).faults


def test_a_head_noted_earlier_still_fits_when_rows_were_added(chain: Rows) -> None:
    outcome = chain_check.check_rows(chain, {}, chain[4].row_hash)
    assert (outcome.faults, outcome.noted) == ([], audit.Head(chain[4].id, chain[4].row_hash))


def test_the_command_says_which_row(chain: Rows, database: Database, settings: Settings, capsys: object) -> None:
    stamp(settings)
    assert run(settings, "verify-audit", "--head", chain[-1].row_hash) == 0
    with database.writing() as session:
        session.execute(update(AuditEvent).where(AuditEvent.id == chain[6].id).values(actor="somebody else"))
        session.execute(delete(AuditEvent).where(AuditEvent.id == chain[9].id))
    assert run(settings, "verify-audit") == 1
    said = capsys.readouterr().out  # type: ignore[attr-defined]
    assert f"Row {chain[6].id} was edited" in said
    assert f"Row {chain[10].id} does not follow row {chain[8].id}" in said


def stamp(settings: Settings) -> None:
    """The tables are there without migrations; commands migrate first."""
    config = Config()
    config.set_main_option("script_location", "migrations")
    config.set_main_option("sqlalchemy.url", settings.sqlalchemy_url.replace("%", "%%"))
    command.stamp(config, "head")


def run(settings: Settings, *arguments: str) -> int:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("DATA_DIR", str(settings.data_dir))
        patch.chdir(settings.data_dir)  # away from anybody's .env
        patch.setattr("app.paths.MIGRATIONS", Path("migrations").absolute(), raising=False)
        return main(arguments)


class TestTransactions:
    """A record is kept if and only if the act is."""

    def test_what_is_undone_leaves_no_record(self, database: Database) -> None:
        with database.reading() as session:
            audit.record(session, "pat", "undone", "x")
            session.rollback()
        with database.writing() as session:
            audit.record(session, "pat", "kept", "x")
            savepoint = session.begin_nested()
            audit.record(session, "pat", "undone", "x")
            with session.begin_nested():
                audit.record(session, "pat", "undone within", "x")
            savepoint.rollback()
            with session.begin_nested():
                audit.record(session, "pat", "kept, too", "x")
        with database.reading() as session:
            assert session.scalars(select(AuditEvent.action).order_by(AuditEvent.id)).all() == ["kept", "kept, too"]
            assert chain_check.check(session).faults == []

    def test_many_writers_at_once_make_one_chain(self, database: Database) -> None:
        def write(name: str) -> None:
            for number in range(10):
                with database.writing() as session:
                    audit.record(session, name, "did something", str(number))

        threads = [threading.Thread(target=write, args=(f"writer {number}",)) for number in range(6)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        with database.reading() as session:
            outcome = chain_check.check(session)
        assert (outcome.rows, outcome.faults) == (60, [])


def subjects(database: Database) -> Sequence[str | None]:
    with database.reading() as session:
        return session.scalars(select(AuditEvent.subject).order_by(AuditEvent.id)).all()


class TestForgetting:
    """People are forgotten, the chain stays whole, and receipts say what went."""

    @pytest.fixture
    def withdrawn(self, taking_part: TakingPart, experimenter: TestClient) -> TakingPart:
        page = f"/studies/{taking_part.study.slug}/participants/{taking_part.participant.code}"
        taking_part.turn()
        taking_part.answer(taking_part.queries[0])
        assert experimenter.get(page).status_code == 200
        assert any(taking_part.participant.code in (each or "") for each in subjects(taking_part.database))
        taking_part.browser.post("/p/withdraw")
        return taking_part

    def test_no_row_names_who_has_withdrawn_and_the_chain_is_whole(
        self, withdrawn: TakingPart, experimenter: TestClient
    ) -> None:
        code = withdrawn.participant.code
        before = len(subjects(withdrawn.database))
        for _ in range(3):  # looking at what is left names nobody either, and is kept once an hour
            experimenter.get(f"/studies/{withdrawn.study.slug}/participants/{code}")
        assert len(subjects(withdrawn.database)) == before + 1
        assert [each for each in subjects(withdrawn.database) if each is not None and code in each] == []
        with withdrawn.database.reading() as session:
            outcome = chain_check.check(session)
            assert session.scalars(select(AuditEvent).where(AuditEvent.actor == code)).all() == []
            assert session.scalars(select(AuditEvent.id).where(AuditEvent.participant_id.is_not(None))).all() == []
        assert outcome.faults == []
        assert outcome.erased == 2

    def test_a_subject_that_was_erased_cannot_be_guessed(self, withdrawn: TakingPart) -> None:
        """There are few codes, so whoever had the salt would find out by trying."""
        with withdrawn.database.reading() as session:
            rows = session.scalars(select(AuditEvent).where(AuditEvent.subject.is_(None))).all()
        assert {row.subject_salt for row in rows} == {None}
        likely = f"{withdrawn.study.slug}/{withdrawn.participant.code}"
        assert audit.hash_of_subject("", likely, withdrawn.participant.id) not in {row.subject_hash for row in rows}

    def test_the_receipt_says_how_much_went_and_nothing_of_whom(
        self, withdrawn: TakingPart, experimenter: TestClient
    ) -> None:
        assert "Receipts of erasures" in experimenter.get("/audit/proof").text
        answer = experimenter.get("/audit/receipts/1.json")
        document = answer.json()
        (step,) = document["steps"]
        assert (step["rows"]["label_event"], step["rows"]["query"]) == (1, 12)
        assert (step["of"], document["complete"]) == ("participant", False)
        assert withdrawn.participant.code not in answer.text
        assert withdrawn.token not in answer.text
        settings = experimenter.app.state.studio.settings  # type: ignore[attr-defined]
        assert signing.signer_of(document) == signing.load(settings).fingerprint
        document["steps"][0]["files"] += 1
        with pytest.raises(signing.SignatureBroken):
            signing.signer_of(document)

    def test_a_receipt_that_is_edited_or_removed_is_found(self, withdrawn: TakingPart) -> None:
        with withdrawn.database.reading() as session:
            rows = session.scalars(select(AuditEvent).order_by(AuditEvent.id)).all()
            contents = dict(session.scalars(select(ErasureReceipt)).one().contents)
        assert chain_check.check_rows(rows, {1: contents}).faults == []
        edited = chain_check.check_rows(rows, {1: {**contents, "files": 9}}).faults
        assert edited == ["Receipt 1 was edited: it is not what the audit log says."]
        assert "Receipt 1 was removed" in chain_check.check_rows(rows, {}).faults[0]
        inserted = chain_check.check_rows(rows, {1: contents, 2: contents}).faults
        assert inserted == ["Receipt 2 was inserted: the audit log does not say that there was one."]

    def test_a_deleted_study_is_named_nowhere(self, database: Database, store: ArtefactStore) -> None:
        with database.writing() as session:
            study = factories.make_study(session, "Hospital of Weyer")
            person, _ = factories.make_participant(session, study)
            factories.make_label(session, factories.make_queries(session, store, person, 1)[0])
            other = factories.make_study(session, "Another one")
        with database.writing() as session:
            found = session.get_one(Study, study.id)
            retirement.delete(session, store, found, "hospital-of-weyer", "pat")
        assert [each for each in subjects(database) if each is not None and "weyer" in each] == []
        assert other.slug in subjects(database)
        with database.reading() as session:
            assert chain_check.check(session).faults == []
            (erasure,) = receipts.erasures(session)
        assert erasure.steps[0].contents["of"] == "study"
        assert erasure.steps[0].contents["rows"]["label_event"] == 1

    def test_what_is_recorded_in_the_transaction_of_the_erasure_names_nobody_either(
        self, database: Database, store: ArtefactStore
    ) -> None:
        with database.writing() as session:
            study = factories.make_study(session)
            person, _ = factories.make_participant(session, study)
            withdrawal.withdraw(session, store, person, "pat")
        assert [each for each in subjects(database) if each is not None and "P01" in each] == []
        with database.reading() as session:
            assert chain_check.check(session).faults == []

    def test_rows_are_listed_as_ranges_that_can_be_read_again(self) -> None:
        assert receipts.as_ranges([7, 1, 2, 3, 9, 10]) == "1-3,7,9-10"
        assert list(receipts.from_ranges("1-3,7,9-10")) == [(1, 3), (7, 7), (9, 10)]
        assert list(receipts.from_ranges(receipts.as_ranges([]))) == []


def test_an_export_is_checked_without_the_database(chain: Rows, database: Database, store: ArtefactStore) -> None:
    with database.writing() as session:
        person = session.scalars(select(Participant)).first()
        assert person is not None
        withdrawal.withdraw(session, store, person, "pat")
    with database.reading() as session:
        lines = list(lookup.json_lines(session))
    assert lookup.check_lines(lines, chain[-1].row_hash).faults == []
    changed = [line.replace("answers viewed", "answers vjewed", 1) for line in lines]
    assert len(lookup.check_lines(changed).faults) == 14
    assert lookup.check_lines([line for line in lines if '"receipt"' not in line]).faults
    for malformed in ("{}", "[]", "3", "[" * 100_000):
        with pytest.raises(lookup.LogUnreadable):
            lookup.check_lines([malformed])


def test_rows_of_before_are_chained_and_name_nobody_who_is_gone(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path / 'old.sqlite3'}"
    config = Config()
    config.set_main_option("script_location", "migrations")
    config.set_main_option("sqlalchemy.url", url)
    command.upgrade(config, "0008")
    engine = create_engine(url)
    acts = [
        ("studio", "account created", "experimenter"),
        ("pat", "study created", "gone"),
        ("pat", "participant added", "gone/P01"),
        ("pat", "study deleted", "gone"),
        ("pat", "study created", "gone"),
        ("pat", "participant added", "gone/P01"),
        ("pat", "participant added", "gone/P02"),
        ("pat", "study unblinded", "gone (3 of 9 trials rated)"),
        ("pat", "run retried", "reward/participant-2/labels-10/answer-3"),
        ("P02", "participant withdrew", "gone/P02"),
        ("pat", "logged in", "pat"),
    ]
    with engine.begin() as connection:
        study = "INSERT INTO study (id, slug, name, task, stored_settings, seed, created_at, key_secret, deleted_at)"
        for number, slug, deleted in ((1, "deleted-1", "2026"), (2, "gone", None)):
            values = {"id": number, "slug": slug, "deleted": deleted}
            connection.execute(
                text(f"{study} VALUES (:id, :slug, 'x', 'feeding', '{{}}', 7, '2026', 'x', :deleted)"), values
            )
        person = "INSERT INTO participant (id, study_id, number, token_sha256, seed, created_at, withdrawn_at)"
        for number, withdrawn in ((1, None), (2, "2026-01-02")):
            values = {"number": number, "withdrawn": withdrawn}
            connection.execute(
                text(f"{person} VALUES (:number, 2, :number, 'hash' || :number, 1, '2026', :withdrawn)"), values
            )
        for actor, action, subject in acts:
            connection.execute(
                text(
                    "INSERT INTO audit_event (at, actor, action, subject) "
                    "VALUES ('2026-01-02 03:04:05.000678', :actor, :action, :subject)"
                ),
                {"actor": actor, "action": action, "subject": subject},
            )
    engine.dispose()
    command.upgrade(config, "head")
    database = Database(url)
    with database.reading() as session:
        outcome = chain_check.check(session)
        rows = session.execute(
            select(AuditEvent.actor, AuditEvent.subject, AuditEvent.study_id, AuditEvent.participant_id).order_by(
                AuditEvent.id
            )
        ).all()
    assert (outcome.rows, outcome.faults) == (len(acts), [])
    unknown, someone = "a deleted study", "somebody whose data are erased"
    assert [tuple(row) for row in rows] == [
        ("studio", "experimenter", None, None),
        ("pat", unknown, None, None),
        ("pat", unknown, None, None),
        ("pat", unknown, None, None),
        ("pat", "gone", 2, None),
        ("pat", "gone/P01", 2, 1),
        ("pat", someone, 2, None),
        ("pat", "gone (3 of 9 trials rated)", 2, None),
        ("pat", someone, 2, None),
        ("participant", someone, 2, None),
        ("pat", "pat", None, None),
    ]
    with database.writing() as session:
        audit.record(session, "pat", "went on", "x")
    with database.reading() as session:
        assert chain_check.check(session).faults == []
    database.dispose()


class TestFailedLogins:
    """Written down so that somebody notices, and never what was typed."""

    def rows(self, database: Database) -> Sequence[str | None]:
        with database.reading() as session:
            failed = select(AuditEvent.subject).where(AuditEvent.action == "login failed").order_by(AuditEvent.id)
            return session.scalars(failed).all()

    def test_a_wrong_password_is_a_row_of_the_account_and_is_not_in_it(
        self, client: TestClient, database: Database, password: str
    ) -> None:
        client.post("/login", data={"name": "experimenter", "password": "hunter2-hunter2"})
        client.post("/login", data={"name": "my password: hunter2", "password": "x"})
        assert self.rows(database) == ["experimenter", hourly_counts.UNKNOWN_NAME]
        with database.reading() as session:
            assert "hunter2" not in json.dumps(list(lookup.json_lines(session)))

    def test_a_thousand_failures_are_four_rows_and_the_next_hour_begins_anew(self) -> None:
        moment = [now()]
        counts = HourlyCounts(lambda: moment[0])
        written = [counts.count("pat") for _ in range(1500)]
        assert [each for each in written if each is not None] == [1, 10, 100, 1000]
        assert counts.count("kim") == 1
        moment[0] += hourly_counts.COUNTED_FOR
        assert counts.count("pat") == 1

    def test_made_up_names_are_counted_together(self, client: TestClient, database: Database, password: str) -> None:
        studio = client.app.state.studio  # type: ignore[attr-defined]
        for number in range(studio.settings.login_attempts_per_minute + 5):  # the rest is refused unread, and counted
            client.post("/login", data={"name": f"name {number}", "password": "x"})
        assert self.rows(database) == [
            hourly_counts.UNKNOWN_NAME,
            f"{hourly_counts.UNKNOWN_NAME} (10 times within an hour)",
        ]

    def test_wrong_tokens_are_counted_too(self, client: TestClient, database: Database, password: str) -> None:
        for _ in range(3):
            client.get("/api/v1/me", headers={"Authorization": "Bearer pbarl_secret-of-somebody"})
        assert self.rows(database) == [hourly_counts.WRONG_TOKEN]

    def test_logging_out_is_a_row(self, experimenter: TestClient, database: Database) -> None:
        experimenter.post("/logout")
        with database.reading() as session:
            assert session.scalars(select(AuditEvent.action)).all() == ["logged out"]
