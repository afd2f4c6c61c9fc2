"""Reading a table page by page while people write to it.

All pages together are the rows that were there when the first page was read: none twice and none lost. The first page
notes the newest id of every table behind it, and what came later belongs to no page; each page says where it ended,
by the key of its last row, so the next one begins there and reads nothing that lies before.
"""

import base64
import binascii
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from http import HTTPStatus
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from sqlalchemy import BigInteger, BindParameter, ColumnElement, and_, func, literal, select, true, tuple_
from sqlalchemy.orm import InstrumentedAttribute, Session

from app.db import Base
from app.errors import AppError

Key = tuple[int, ...]
"""Where a row stands: keys ascend in the order of the rows, and a row keeps its key as long as it exists."""
KeyedRows = Iterator[tuple[Key, Sequence[Any]]]

LONGEST_CURSOR = 1000


class CursorInvalid(AppError):
    """This cursor is not one of ours for this table. Begin again without a cursor, then follow next."""

    status = HTTPStatus.UNPROCESSABLE_ENTITY


@dataclass(frozen=True)
class Window:
    """The part of a table that is wanted: rows after a key, made of nothing newer than the first page."""

    after: Key = ()
    newest: Mapping[str, int] = field(default_factory=dict)
    """Largest id by name of database table; a table that is not named has no bound."""
    since: int = 0
    """Of a table that grows: the largest id that an earlier reading has seen."""

    def known(self, *entities: type[Base]) -> ColumnElement[bool]:
        """That rows of these were there when the first page was read."""
        bounds = ((each, self.newest.get(each.__tablename__)) for each in entities)
        return and_(true(), *(each.__table__.c.id <= _any(bound) for each, bound in bounds if bound is not None))

    def beyond(self, *columns: InstrumentedAttribute[int]) -> ColumnElement[bool]:
        """That a row comes after the key, which consists of these columns."""
        return tuple_(*columns) > tuple_(*map(_any, self.after)) if len(self.after) == len(columns) else true()

    def reaches(self, first: InstrumentedAttribute[int]) -> ColumnElement[bool]:
        """That some row whose key begins with this column may come after the key."""
        return first >= _any(self.after[0]) if self.after else true()

    def within(self, first: int) -> "Window":
        """The part that is wanted of the rows whose keys begin with this number, by the rest of their keys."""
        return Window(self.after[1:] if self.after[:1] == (first,) else (), self.newest, self.since)


EVERYTHING = Window()


def _any(number: int) -> BindParameter[int]:
    """To be compared with a column, although PostgreSQL could not store it there."""
    return literal(number, BigInteger)


_Number = Annotated[int, Field(strict=True, ge=-(2**63), lt=2**63)]


class _Cursor(BaseModel):
    """What a client carries from page to page. It holds nothing secret and gives no right, so it is not signed."""

    model_config = ConfigDict(extra="forbid")

    of: Annotated[str, Field(max_length=200)]
    after: Annotated[list[_Number], Field(max_length=6)]
    """Empty: the reading has not begun."""
    newest: Annotated[dict[str, _Number], Field(max_length=6)]
    since: _Number = 0


def first_window(session: Session, entities: Sequence[type[Base]], since: int = 0) -> Window:
    """Everything there is now of a table that is made of these, or of what came since."""
    newest = {each.__tablename__: session.scalar(select(func.max(each.__table__.c.id))) or 0 for each in entities}
    return Window(newest=newest, since=since)


def cursor_of(of: str, window: Window, last: Key) -> str:
    """What leads to the rows after the last one. ``of``: whose rows these are."""
    return _written(_Cursor(of=of, after=list(last), newest=dict(window.newest), since=window.since))


def later_cursor(of: str, window: Window, grows_by: type[Base]) -> str:
    """What leads, at another time, to the rows that were added after this reading began."""
    return _written(_Cursor(of=of, after=[], newest={}, since=window.newest[grows_by.__tablename__]))


def window_of(session: Session, cursor: str, of: str, entities: Sequence[type[Base]]) -> Window:
    """Where to go on. Raises CursorInvalid for everything that cursor_of and later_cursor would not have made."""
    try:
        read = _Cursor.model_validate_json(base64.b64decode(cursor + "=" * (-len(cursor) % 4), b"-_", validate=True))
    except (binascii.Error, ValueError, ValidationError) as error:
        raise CursorInvalid from error
    if read.of == of and not read.after and not read.newest:
        return first_window(session, entities, read.since)
    if read.of != of or not read.after or set(read.newest) != {each.__tablename__ for each in entities}:
        raise CursorInvalid
    return Window(tuple(read.after), read.newest, read.since)


def _written(cursor: _Cursor) -> str:
    return base64.urlsafe_b64encode(cursor.model_dump_json().encode()).decode().rstrip("=")
