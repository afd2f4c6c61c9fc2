"""Which account somebody has whom the identity provider has recognised.

The one that is connected to this identity. At the first login that is the account whose name is what the provider calls
the person, or a new one of the role that the installation gives to everybody it does not know, if it gives any.
"""

from http import HTTPStatus

from sqlalchemy import select
from sqlalchemy.orm import Session

from app.domain.people import Experimenter, Role
from app.errors import AppError
from app.services import audit
from app.services.accounts import accounts
from app.services.accounts.accounts import OneTimePassword
from app.services.accounts.openid import Identity


class NoAccount(AppError):
    """You have no account in this studio. Ask an administrator for one, and say what your provider calls you."""

    status = HTTPStatus.FORBIDDEN


def enter(session: Session, identity: Identity, new_role: Role | None, password: OneTimePassword) -> Experimenter:
    """The account of this identity, made or connected if need be. Raises NoAccount.

    ``password``: known to nobody, for a connected account: from now on its logins are the provider's. An administrator
    who resets the password takes the connection back.
    """
    account = session.scalar(select(Experimenter).where(Experimenter.oidc_subject == identity.subject))
    if account is None:
        account = _first_login(session, identity, new_role, password)
    if account.disabled_at is not None:
        raise NoAccount
    return account


def _first_login(
    session: Session, identity: Identity, new_role: Role | None, password: OneTimePassword
) -> Experimenter:
    account = None if identity.name is None else accounts.by_name(session, identity.name)
    if account is None and identity.name is not None and new_role is not None:
        account = accounts.add(session, identity.name, new_role, password, audit.SYSTEM)
    if account is None or account.oidc_subject is not None or account.disabled_at is not None:
        raise NoAccount
    account.oidc_subject = identity.subject
    account.password_hash, account.must_change_password = password.hash, False
    accounts.end_logins(session, account)
    audit.record(session, account.name, "account connected to the identity provider", account.name)
    return account
