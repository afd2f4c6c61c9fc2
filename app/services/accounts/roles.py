"""Who may do what: administrator over experimenter over reader."""

from app.domain.people import Experimenter, Role
from app.errors import Refused

_RANKS = {Role.READER: 0, Role.EXPERIMENTER: 1, Role.ADMINISTRATOR: 2}


class RoleTooLow(Refused):
    """Your account may look at this, but not do it. Ask an administrator of this studio for another role."""


def may(experimenter: Experimenter, role: Role) -> bool:
    """Whether the account has this role or a higher one."""
    return _RANKS[Role(experimenter.role)] >= _RANKS[role]


def require(experimenter: Experimenter, role: Role) -> None:
    """Raises RoleTooLow."""
    if not may(experimenter, role):
        raise RoleTooLow
