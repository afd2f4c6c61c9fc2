"""Every table as a file: complete, explained, harmless in a spreadsheet, and silent about what is blinded."""

import csv
import io
import json
from collections.abc import Callable
from pathlib import Path

import pandas as pd
import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select

from app.db import Database, now
from app.domain.models import Export
from app.domain.people import AuditEvent, Role
from app.domain.studies import Deviation, Participant, Study
from app.services.archives import sealing
from app.services.exports import csv_cells, export_formats, export_tables
from app.services.participants import withdrawal
from app.storage import ArtefactStore
from tests import factories
from tests.finished_study import make_finished_study

DOCS = Path(__file__).resolve().parents[2] / "docs"
Table = list[dict[str, str]]


@pytest.fixture
def study(database: Database, store: ArtefactStore) -> Study:
    with database.writing() as session:
        return make_finished_study(session, store, people=2, labels=5)


@pytest.fixture
def download(experimenter: TestClient, study: Study) -> Callable[[str], Table]:
    def fetch(table: str) -> Table:
        answer = experimenter.get(f"/studies/{study.slug}/export/{table}.csv")
        assert answer.status_code == 200
        assert answer.headers["content-type"].startswith("text/csv")
        return list(csv.DictReader(io.StringIO(answer.text)))

    return fetch


@pytest.mark.parametrize("table", [table.name for table in export_tables.TABLES])
def test_every_table_has_the_columns_of_its_dictionary_in_both_formats(
    experimenter: TestClient, study: Study, table: str
) -> None:
    names = [column.name for column in export_tables.BY_NAME[table].all_columns]
    rows = experimenter.get(f"/studies/{study.slug}/export/{table}.csv").text.splitlines()
    assert rows[0].split(",") == names
    lines = experimenter.get(f"/studies/{study.slug}/export/{table}.jsonl").text.splitlines()
    assert all(list(json.loads(line)) == names for line in lines)
    assert lines or table == "deviations"


@pytest.mark.parametrize("table", export_tables.TABLES, ids=lambda table: table.name)
def test_values_are_of_the_kind_that_the_dictionary_says(
    database: Database, study: Study, table: export_formats.Table
) -> None:
    kinds: dict[str, tuple[type, ...]] = {
        "text": (str,),
        "integer": (int,),
        "number": (int, float),
        "boolean": (bool,),
        "time": (str,),
        "json": (dict,),
    }
    with database.reading() as session:
        provenance = export_formats.provenance_of(session, study)
        for row in export_formats.records(table, session, study, provenance):
            for column in table.all_columns:
                value = row[column.name]
                assert value is None or isinstance(value, kinds[column.kind.value]), (column.name, value)


def test_the_dictionary_in_the_documentation_is_up_to_date() -> None:
    assert (DOCS / "protocol.md").read_text() == export_formats.dictionary_markdown(export_tables.TABLES), (
        "run: python -m app dictionary"
    )


def test_every_column_says_what_it_means() -> None:
    assert [row for row in export_formats.dictionary(export_tables.TABLES) if len(row["meaning"]) < 4] == []


def test_formulas_that_participants_write_do_not_run_in_a_spreadsheet(
    experimenter: TestClient, study: Study, download: Callable[[str], Table]
) -> None:
    values = {row["value"] for row in download("forms") if row["item"] == "comments"}
    assert values == {'\'=HYPERLINK("http://example.com")', 'nice, "really" nice'}
    lines = experimenter.get(f"/studies/{study.slug}/export/forms.jsonl").text
    assert '"=HYPERLINK(\\"http://example.com\\")"' in lines, "other formats have the words as they were written"


RUN_BY_SPREADSHEETS = {
    "=1+1": "'=1+1",
    "+1": "'+1",
    "-1": "'-1",
    "@SUM(A1)": "'@SUM(A1)",
    "all fine\r=HYPERLINK(A1)": "all fine\n'=HYPERLINK(A1)",
    "all fine\r\n=1": "all fine\n'=1",
    "all fine\n \t@SUM(A1)": "all fine\n \t'@SUM(A1)",
    "good; =1": "good; '=1",
    "good\t-1": "good\t'-1",
    " =1": " '=1",
    "\N{ZERO WIDTH NO-BREAK SPACE}=1": "\N{ZERO WIDTH NO-BREAK SPACE}'=1",
    "\N{ZERO WIDTH SPACE}+1": "\N{ZERO WIDTH SPACE}'+1",
    "\N{NO-BREAK SPACE}=1": "\N{NO-BREAK SPACE}'=1",
    "\N{FULLWIDTH EQUALS SIGN}1": "'\N{FULLWIDTH EQUALS SIGN}1",
    "\N{FULLWIDTH COMMERCIAL AT}A1": "'\N{FULLWIDTH COMMERCIAL AT}A1",
    "\N{LINE SEPARATOR}=1": "\N{LINE SEPARATOR}'=1",
    "a\0b": "a\N{REPLACEMENT CHARACTER}b",
    "1 - 2, at most": "1 - 2, at most",
    "\tx": "\tx",
}


@pytest.mark.parametrize("text", RUN_BY_SPREADSHEETS)
def test_nothing_that_somebody_writes_begins_a_formula_wherever_a_cell_begins(text: str) -> None:
    written = RUN_BY_SPREADSHEETS[text]
    line = csv_cells.csv_line(("P01", text, "next"))
    assert list(csv.reader(io.StringIO(line, newline=""))) == [["P01", written, "next"]]
    frame = pd.read_csv(io.StringIO(line), header=None, keep_default_na=False)
    assert frame.to_numpy().tolist() == [["P01", written, "next"]], "pandas takes it for one row"
    for end in ",;\t":
        for cell in line.replace('"', "").replace("\n", end).split(end):
            assert not cell.strip().startswith(("=", "@")), "read with another end of cells"


def test_json_in_a_cell_means_the_same_and_begins_no_formula_either() -> None:
    value = {"note": "good; =1", "x": "a\N{LINE SEPARATOR}b", "half": "\ud800", "n": [-1, None]}
    text = csv_cells.cell(value)
    assert json.loads(text) == value
    assert "; =" not in text
    assert len(text.splitlines()) == 1
    assert text.encode()


def test_negative_numbers_stay_numbers(download: Callable[[str], Table]) -> None:
    assert any(float(row["delta"]) < 0 for row in download("evaluations"))


def test_answers_that_no_longer_count_are_there_and_marked(download: Callable[[str], Table]) -> None:
    first = [row for row in download("labels") if (row["participant"], row["ordinal"]) == ("P01", "1")]
    assert [row["superseded"] for row in first] == ["true", "false"]
    counting = next(row for row in download("queries") if (row["participant"], row["ordinal"]) == ("P01", "1"))
    assert (counting["response"], counting["revisions"]) == ("equal", "2")


def test_a_corrected_rating_counts_once(download: Callable[[str], Table]) -> None:
    ratings = [row for row in download("ratings") if (row["participant"], row["order"]) == ("P01", "1")]
    assert [(row["revision"], row["counts"]) for row in ratings] == [("1", "false"), ("2", "true")]


def test_until_unblinding_no_file_says_which_letter_is_which_method(
    database: Database, study: Study, experimenter: TestClient, download: Callable[[str], Table]
) -> None:
    assert {row["method"] for row in download("ratings")} == {"reference", "prefft", "pbarl"}
    with database.writing() as session:
        session.get_one(Study, study.id).unblinded_at = None
    assert {row["method"] for row in download("ratings")} == {""}
    assert {row["success"] for row in download("ratings")} == {""}
    for table in export_tables.TABLES:
        text = experimenter.get(f"/studies/{study.slug}/export/{table.name}.jsonl").text
        assert '"reference"' not in text or table.name in ("evaluations", "models")
        assert "prefft" not in text


def test_every_row_says_whether_the_study_was_locked_and_how_it_deviated(
    database: Database, study: Study, download: Callable[[str], Table]
) -> None:
    assert {(row["lock_hash"], row["deviations"]) for row in download("ratings")} == {("not locked", "none")}
    with database.writing() as session:
        session.get_one(Study, study.id).lock_hash = "ab" * 32
        change = {"labels_per_participant": 10}
        session.add(Deviation(study_id=study.id, actor="experimenter", reason="too long", before=change, after=change))
    (row, *_) = download("ratings")
    assert row["lock_hash"] == "ab" * 32
    assert row["deviations"].endswith(": too long")
    assert row["software_version"] == export_formats.software_version()
    assert download("deviations")[0]["reason"] == "too long"


def test_who_withdrew_is_a_tombstone_and_nothing_else(
    database: Database, store: ArtefactStore, study: Study, download: Callable[[str], Table]
) -> None:
    with database.writing() as session:
        person = session.scalars(select(Participant).where(Participant.number == 1)).one()
        withdrawal.withdraw(session, store, person, "P01")
    tombstone = next(row for row in download("participants") if row["participant"] == "P01")
    kept = {name for name, value in tombstone.items() if value} - {column.name for column in export_formats.PROVENANCE}
    assert kept == {"participant", "status", "withdrawn_at"}
    for table in export_tables.TABLES:
        if table.name not in ("participants", "clips", "deviations"):
            assert {row["participant"] for row in download(table.name)} == {"P02"}


def test_an_export_is_remembered(database: Database, study: Study, download: Callable[[str], Table]) -> None:
    download("ratings")
    with database.reading() as session:
        acts = session.scalars(select(AuditEvent.subject).where(AuditEvent.action == "table exported")).all()
    assert acts == [f"{study.slug}/ratings.csv"]


def test_who_may_only_look_may_not_export(database: Database, study: Study, experimenter: TestClient) -> None:
    with database.writing() as session:
        factories.give_role(session, Role.READER)
    answer = experimenter.get(f"/studies/{study.slug}/export/ratings.csv")
    assert (answer.status_code, "another role" in answer.text) == (403, True)
    page = experimenter.get(f"/studies/{study.slug}/export")
    assert page.status_code == 200
    assert "ratings.csv" not in page.text


def test_a_table_that_there_is_not_has_a_page_that_says_so(study: Study, experimenter: TestClient) -> None:
    answer = experimenter.get(f"/studies/{study.slug}/export/secrets.csv")
    assert (answer.status_code, "no table of this name" in answer.text) == (404, True)


def test_strangers_get_nothing(client: TestClient, study: Study) -> None:
    assert client.get(f"/studies/{study.slug}/export/ratings.csv").status_code == 303
    assert client.get(f"/studies/{study.slug}/results").status_code == 303


def test_a_file_is_asked_for_once_and_downloaded_when_it_is_there(
    database: Database, store: ArtefactStore, study: Study, experimenter: TestClient
) -> None:
    for _ in range(2):
        assert experimenter.post(f"/studies/{study.slug}/export/files/data").status_code == 303
    assert "waiting for the worker" in experimenter.get(f"/studies/{study.slug}/export").text
    with database.writing() as session:
        (export,) = session.scalars(select(Export)).all()
        assert (export.kind, export.requested_by) == ("data", "experimenter")
        export.artefact_sha256, export.byte_count, export.finished_at = store.put(b"PK"), 2, now()
    assert experimenter.get(f"/studies/{study.slug}/export/files/{export.id}.zip").content == b"PK"
    assert experimenter.get(f"/studies/{study.slug}/export/files/99.zip").status_code == 404


def test_an_export_that_somebody_withdrew_from_is_taken_back_in_words_and_its_number_is_not_used_again(
    database: Database, store: ArtefactStore, study: Study, experimenter: TestClient
) -> None:
    address = f"/studies/{study.slug}/export"
    for kind in ("data", "archive"):
        experimenter.post(f"{address}/files/{kind}")
    with database.writing() as session:
        finished, waiting = session.scalars(select(Export).order_by(Export.id)).all()
        old, next_one = finished.id, waiting.id
        finished.artefact_sha256, finished.byte_count, finished.finished_at = store.put(b"PK of two"), 9, now()
        finished.missing = {"recordings: pairs of P01": ["0" * 64]}
        session.flush()
        person = session.scalars(select(Participant).where(Participant.number == 1)).one()
        withdrawal.withdraw(session, store, person, "P01")
    page = experimenter.get(address).text
    assert "somebody who was in it has withdrawn" in page
    assert "waiting for the worker" in page
    assert "pairs of P01" not in page
    assert experimenter.get(f"{address}/files/{old}.zip").status_code == 404
    experimenter.post(f"{address}/files/data")
    with database.reading() as session:
        numbers = [each.id for each in session.scalars(select(Export).order_by(Export.id))]
    assert numbers == [old, next_one, next_one + 1]


def test_the_seal_key_is_shown_to_who_asks_and_that_is_kept(
    database: Database, study: Study, experimenter: TestClient
) -> None:
    address = f"/studies/{study.slug}/export"
    with database.writing() as session:
        session.get_one(Study, study.id).unblinded_at = None
    assert "encrypted" in experimenter.get(address).text
    assert sealing.key_of(study) not in experimenter.get(address).text
    assert sealing.key_of(study) in experimenter.post(f"{address}/seal-key").text
    with database.writing() as session:
        assert session.scalars(select(AuditEvent.subject).where(AuditEvent.action == "seal key shown")).all() == [
            study.slug
        ]
        factories.give_role(session, Role.READER)
    assert experimenter.post(f"{address}/seal-key").status_code == 403
