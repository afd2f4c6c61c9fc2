"""Errors a person may meet. The docstring is the message; it says what happened and what to do next."""

from http import HTTPStatus
from typing import ClassVar


class AppError(Exception):
    """Something went wrong. Please try again."""

    status: ClassVar[HTTPStatus] = HTTPStatus.BAD_REQUEST

    def __init__(self, message: str | None = None) -> None:
        self.message = message or " ".join((type(self).__doc__ or "").split())
        super().__init__(self.message)
