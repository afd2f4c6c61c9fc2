"""Who may do what: administrator over experimenter over reader."""

from http import HTTPStatus

from app.domain.people import Experimenter, Role
from app.errors import AppError

_RANKS = {Role.READER: 0, Role.EXPERIMENTER: 1, Role.ADMINISTRATOR: 2}


class RoleTooLow(AppError):
    """Your account may look at this, but not do it. Ask an administrator of this studio for another role."""

    status = HTTPStatus.FORBIDDEN


def may(experimenter: Experimenter, role: Role) -> bool:
    """Whether the account has this role or a higher one."""
    return _RANKS[Role(experimenter.role)] >= _RANKS[role]


def require(experimenter: Experimenter, role: Role) -> None:
    """Raises RoleTooLow."""
    if not may(experimenter, role):
        raise RoleTooLow
