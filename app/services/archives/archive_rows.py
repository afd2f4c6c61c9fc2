"""What must be true of the rows of an archive: each by itself, and all of them together.

Nothing comes in that an export would not have written, and nothing that belongs to two people or to nobody.
"""

import json
import re
import sys
from collections.abc import Callable, Mapping
from datetime import datetime
from enum import StrEnum
from pathlib import Path
from typing import Any

from pydantic import ValidationError
from sqlalchemy import JSON, Boolean, Column, Float, Integer, String, Table

from app.db import Base, UtcDateTime
from app.domain import run_keys
from app.domain.designs import Ending
from app.domain.evaluation import DonorDraw, DonorRule, Donors, HeadToHeadResponse
from app.domain.models import ModelKind, RunKind, RunStatus
from app.domain.preferences import Purpose, Response, SkipReason
from app.domain.protocol import EvaluatedMethod, Stage
from app.domain.self_setting import PreviewFilm, SelfSetting
from app.domain.studies import PREVIEW_NUMBERS, Deviation, Participant, Study
from app.domain.study_settings import StudySettings
from app.services.archives.archive import LARGEST_ROW_BYTES, REMADE, SECRETS, ArchiveInvalid, Manifest, artefacts
from app.services.studies import locking

MOST_ROWS = 3_000_000
"""Of all tables together that others refer to: their ids are held in memory."""
_SMALLEST_ID, _LARGEST_ID = 1, 2**63 - 1
_LARGEST_NUMBER = sys.float_info.max
_DEEPEST = 30
"""Objects and lists within each other in one column; settings have three."""
_WORDS: Mapping[tuple[str, str], type[StrEnum]] = {
    ("query", "purpose"): Purpose,
    ("label_event", "response"): Response,
    ("label_event", "reason"): SkipReason,
    ("run", "kind"): RunKind,
    ("run", "status"): RunStatus,
    ("model", "kind"): ModelKind,
    ("stage_record", "stage"): Stage,
    ("assignment", "method"): EvaluatedMethod,
    ("film", "method"): EvaluatedMethod,
    ("controller", "method"): EvaluatedMethod,
    ("donor_draw", "method"): EvaluatedMethod,
    ("donor_draw", "rule"): DonorRule,
    ("participant", "ended_as"): Ending,
    ("head_to_head_answer", "response"): HeadToHeadResponse,
}
_NAMES = r"([a-z][a-z0-9_]{0,49}( [a-z][a-z0-9_]{0,49})*)?"
_PATTERNS: Mapping[tuple[str, str], str] = {
    ("study", "task"): r"[a-z][a-z0-9_]{0,39}",  # names a folder of the worker
    ("study", "key_secret"): r"[0-9a-f]{64}",
    ("run", "workflow_id"): r"[ -~]+",
    ("label_event", "mattered"): r"[a-z][a-z0-9_]{0,39}",
    ("hint_event", "hints"): _NAMES,
    ("hint_event", "offered"): _NAMES,
    ("participant", "arm"): r"[a-z][a-z0-9_]{0,39}",
    ("assignment", "letter"): r"[A-E]",
    ("trial", "letter"): r"[A-E]",
    ("form_answer", "letter"): r"[A-E]",
}
SHA256 = re.compile(r"[0-9a-f]{64}")


class RowCheck:
    """Looks at row after row, parents first, and remembers what later ones may refer to."""

    def __init__(self, manifest: Manifest, is_here: Callable[[str], bool]) -> None:
        self._manifest, self._is_here = manifest, is_here
        self._owners: dict[str, dict[int, int]] = {}
        """By table and id the participant a row belongs to; 0: the study as a whole."""
        self._referred = {
            key.column.table.name for table in Base.metadata.sorted_tables for key in table.foreign_keys
        } | set(run_keys.ROWS.values())
        self._study: dict[str, Any] | None = None

    def table(self, table: Table, path: Path) -> None:
        """Look at every row. Raises ArchiveInvalid."""
        self._owners[table.name] = {}
        within: list[tuple[int, int]] = []
        with path.open("rb") as lines:
            count = 0
            while line := lines.readline(LARGEST_ROW_BYTES + 1):
                count += 1
                try:
                    if len(line) > LARGEST_ROW_BYTES:
                        raise _Wrong(f"it is longer than {LARGEST_ROW_BYTES >> 20} MB")
                    self._row(table, json.loads(line, parse_constant=_no_number), within)
                except _Wrong as wrong:
                    raise ArchiveInvalid(
                        f"Row {count} of the table {table.name} is refused: {wrong}. Nothing was imported."
                    ) from wrong
        if count != self._manifest.tables[table.name].rows:
            raise ArchiveInvalid(f"The table {table.name} in this archive is damaged. Nothing was imported.")
        owners = self._owners[table.name]
        if any(owners.get(row) is None or owners[row] != owners.get(other) for row, other in within):
            raise ArchiveInvalid(f"Rows of the table {table.name} do not fit together. Nothing was imported.")

    def whole(self) -> None:
        """What is true of the archive as a whole. Raises ArchiveInvalid."""
        if self._study is None:
            raise ArchiveInvalid("This archive holds no study. Nothing was imported.")
        _check_lock(self._study, self._manifest.lock_hash)

    def _row(self, table: Table, row: Any, within: list[tuple[int, int]]) -> None:
        if not isinstance(row, dict):
            raise _Wrong("it is not a row")
        allowed = {column.name for column in table.columns} - SECRETS.get(table.name, set())
        unknown = sorted(row.keys() - allowed)
        if unknown:
            raise _Wrong(f"it has a column that no archive has, {unknown[0][:40]}")
        for column in table.columns:
            if column.name in row:
                _check_value(table.name, column, row[column.name])
        if table.name == Study.__tablename__:
            self._check_study(row)
        if table.name == DonorDraw.__tablename__:
            _check_donors(row)
        if table.name == Deviation.__tablename__ and {*(row.get("before") or ())} != {*(row.get("after") or ())}:
            raise _Wrong("what was changed is not what it was changed to")
        if table.name in (SelfSetting.__tablename__, PreviewFilm.__tablename__) and not _is_mode(row.get("mode")):
            raise _Wrong("mode has a value that it cannot have")
        _check_left_out(table.name, row)
        for _, sha256 in artefacts(table.name, row):
            if not SHA256.fullmatch(sha256) or (sha256 not in self._manifest.files and self._is_here(sha256)):
                raise _Wrong("it refers to a file that this archive does not hold")
        self._remember(table, row, within)

    def _remember(self, table: Table, row: Mapping[str, Any], within: list[tuple[int, int]]) -> None:
        """Where the row belongs: to nobody but one participant, and only to what this archive holds."""
        number, owners = row.get("id"), set[int]()
        if number is None:
            raise _Wrong("it has no id")
        if table.name == Participant.__tablename__:
            owners.add(number)
        for key in table.foreign_keys:
            value, parents = row.get(key.parent.name), self._owners.get(key.column.table.name)
            if value is None:
                if not key.parent.nullable:
                    raise _Wrong(f"it has no {key.parent.name}")
            elif key.column.table is table:
                within.append((number, value))
            elif parents is None or value not in parents:
                raise _Wrong(f"its {key.parent.name} leads to something that this archive does not hold")
            else:
                owners.add(parents[value])
        owners.discard(0)
        if len(owners) > 1:
            raise _Wrong("it belongs to two participants")
        if table.name in self._referred:
            known = self._owners[table.name]
            if number in known:
                raise _Wrong("another row has its id")
            known[number] = owners.pop() if owners else 0
            if sum(map(len, self._owners.values())) > MOST_ROWS:
                raise _Wrong(f"there are more than {MOST_ROWS} rows")

    def _check_study(self, row: dict[str, Any]) -> None:
        if self._study is not None:
            raise _Wrong("an archive holds one study")
        self._study = row
        try:
            StudySettings.model_validate(row["stored_settings"])
        except (ValidationError, KeyError) as error:
            raise _Wrong("this version cannot read the study's settings") from error
        if row.get("deleted_at") is not None:
            raise _Wrong("the study was deleted")
        axes = row.get("mode_axes")
        if axes is not None and not _are_axes(axes):
            raise _Wrong("mode_axes has a value that it cannot have")
        material = row.get("material")
        if material is not None and not _describes_recordings(material):
            raise _Wrong("it does not say what its clips are made of")


class _Wrong(ValueError):
    """Why a row is refused."""


def _check_value(table_name: str, column: Column[Any], value: Any) -> None:
    """The value is one that this column can have. Raises _Wrong."""
    if value is None:
        if not column.nullable:
            raise _Wrong(f"{column.name} is empty")
        return
    place = table_name, column.name
    words, pattern = _WORDS.get(place), _PATTERNS.get(place)
    if (
        not _fits(column, value)
        or (words is not None and value not in {each.value for each in words})
        or (pattern is not None and value is not None and not re.fullmatch(pattern, value))
    ):
        raise _Wrong(f"{column.name} has a value that it cannot have")


def _fits(column: Column[Any], value: Any) -> bool:
    kind = column.type
    if isinstance(kind, UtcDateTime):
        return isinstance(value, str) and _is_moment(value)
    if isinstance(kind, JSON):
        return isinstance(value, dict) and _is_plain(value, _DEEPEST)
    if isinstance(kind, Boolean):
        return isinstance(value, bool)
    if isinstance(kind, Integer):
        smallest = _SMALLEST_ID if column.primary_key or column.foreign_keys else -_LARGEST_ID
        return isinstance(value, int) and not isinstance(value, bool) and smallest <= value <= _LARGEST_ID
    if isinstance(kind, Float):
        return _is_number(value)
    if isinstance(kind, String):
        return isinstance(value, str) and (kind.length is None or len(value) <= kind.length) and _is_text(value)
    return False


def _is_plain(value: Any, depth: int) -> bool:
    """Whether every page and every file can show it."""
    if isinstance(value, dict | list):
        inside = [*value, *value.values()] if isinstance(value, dict) else value
        return depth > 0 and all(_is_plain(each, depth - 1) for each in inside)
    return _is_text(value) if isinstance(value, str) else value is None or isinstance(value, bool) or _is_number(value)


def _is_moment(value: str) -> bool:
    try:
        return datetime.fromisoformat(value).tzinfo is not None
    except ValueError:
        return False


def _is_text(value: str) -> bool:
    """Whether it can be stored: half a character cannot."""
    try:
        value.encode()
    except UnicodeEncodeError:
        return False
    return True


def _check_left_out(table_name: str, row: Mapping[str, Any]) -> None:
    """What an export leaves out must not come in. Raises _Wrong."""
    if table_name == "run" and row.get("kind") in REMADE:
        raise _Wrong("reports and exports are made here, not imported")
    if table_name == Participant.__tablename__:
        if row.get("is_preview"):
            raise _Wrong("previews are not imported")
        if not 0 < (row.get("number") or 0) < PREVIEW_NUMBERS:
            raise _Wrong("number has a value that it cannot have")


def _check_donors(row: Mapping[str, Any]) -> None:
    """Raises _Wrong."""
    try:
        Donors.model_validate(row.get("stored_donors"))
    except ValidationError as error:
        raise _Wrong("stored_donors has a value that it cannot have") from error


def _is_mode(mode: Any) -> bool:
    """Numbers by the names of axes."""
    return isinstance(mode, dict) and all(_is_axis(name) and _is_number(value) for name, value in mode.items())


def _are_axes(axes: Mapping[str, Any]) -> bool:
    """Ranges around 0 by the names of axes."""
    return all(
        _is_axis(name)
        and isinstance(ends, list)
        and len(ends) == 2
        and all(map(_is_number, ends))
        and ends[0] <= 0 <= ends[1]
        for name, ends in axes.items()
    )


def _is_axis(name: str) -> bool:
    return re.fullmatch(r"[a-z][a-z0-9_]{0,59}", name) is not None


def _is_number(value: Any) -> bool:
    """One that every reader of JSON can hold."""
    return (
        isinstance(value, int | float) and not isinstance(value, bool) and -_LARGEST_NUMBER <= value <= _LARGEST_NUMBER
    )


def _describes_recordings(material: Mapping[str, Any]) -> bool:
    signals, rate = material.get("signals"), material.get("rate_hz")
    return (
        isinstance(rate, int | float)
        and isinstance(signals, list)
        and all(isinstance(each, dict) and isinstance(each.get("name"), str) for each in signals)
    )


def _check_lock(study: Mapping[str, Any], in_manifest: str | None) -> None:
    """A study is locked with the document that the hash is of, or it is not locked. Raises ArchiveInvalid."""
    stored, document = study.get("lock_hash"), study.get("lock_document")
    if not stored and not document and not study.get("locked_at") and not in_manifest:
        return
    if not document or not study.get("locked_at") or stored != in_manifest or locking.hash_of(document) != stored:
        raise ArchiveInvalid(
            "The lock hash in this archive is not the hash of what it says was locked, so it proves nothing. "
            "Ask whoever sent it for the archive as it was written. Nothing was imported."
        )
    try:
        locking.Locked.model_validate(document)
        locking.planned_settings(document)
    except ValidationError as error:
        raise ArchiveInvalid(
            "This version cannot read what was locked in this archive. Nothing was imported."
        ) from error


def _no_number(name: str) -> float:
    raise _Wrong(f"{name} is not a number")
