"""How many studies are brought in at the same time: every upload fills the disk and keeps a thread busy."""

from collections.abc import Iterator
from contextlib import contextmanager
from http import HTTPStatus

from app.errors import AppError

IMPORTS_AT_ONCE = 2


class TooManyImports(AppError):
    """Two studies are being imported at this moment. Please wait until one of them is done, then try again."""

    status = HTTPStatus.SERVICE_UNAVAILABLE


class ImportLimit:
    """Places for uploads, all in one event loop."""

    def __init__(self) -> None:
        self._taken = 0

    @contextmanager
    def place(self) -> Iterator[None]:
        """A place at the desk. Raises TooManyImports instead of letting anybody wait with gigabytes at hand."""
        if self._taken >= IMPORTS_AT_ONCE:
            raise TooManyImports
        self._taken += 1
        try:
            yield
        finally:
            self._taken -= 1
