"""Logging in at an identity provider: OpenID Connect, the authorization code flow with PKCE.

What the provider says is believed only when its signature, issuer, audience, times and nonce are right. It says who
somebody is, never what they may do here: roles stay in this studio.
"""

import base64
import hashlib
import hmac
import secrets
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from http import HTTPStatus
from typing import Any

import httpx2
from joserfc import jwt
from joserfc.errors import JoseError
from joserfc.jwk import KeySet
from pydantic import BaseModel, ValidationError

from app.errors import AppError
from app.settings import Settings

ALGORITHMS = ["RS256", "RS384", "RS512", "PS256", "PS384", "PS512", "ES256", "ES384", "ES512", "EdDSA", "Ed25519"]
"""Those with a public key: with a shared secret, whoever knows it could make tokens, and "none" anybody could."""
LEEWAY_S = 60
"""How far the clocks may differ."""
KEPT_S = 3600.0
PATIENCE_S = 10.0
SCOPE = "openid profile email"


class ProviderRefused(AppError):
    """The identity provider did not let you in, or the login took too long. Please try again."""

    status = HTTPStatus.UNAUTHORIZED


class ProviderUnusable(AppError):
    """The identity provider does not answer as it should. Try again later, or ask an administrator of this studio."""

    status = HTTPStatus.BAD_GATEWAY


@dataclass(frozen=True)
class Attempt:
    """One login that has begun; kept in the browser that began it, so that nobody else can end it."""

    state: str
    nonce: str
    verifier: str

    @staticmethod
    def new() -> "Attempt":
        """With random values."""
        return Attempt(*(secrets.token_urlsafe(32) for _ in range(3)))


@dataclass(frozen=True)
class Identity:
    """Whom the provider has recognised."""

    subject: str
    """Issuer and the provider's own name for the person, which is never given to anybody else."""
    name: str | None
    """What an account of this person is called here; None: the provider does not say, or is not sure."""


class _Metadata(BaseModel):
    """What an identity provider says about itself."""

    issuer: str
    authorization_endpoint: str
    token_endpoint: str
    jwks_uri: str


class Provider:
    """The identity provider of this installation. What it says about itself and its keys are kept for an hour."""

    def __init__(self, settings: Settings, clock: Callable[[], float] = time.monotonic) -> None:
        if settings.oidc_issuer is None or settings.oidc_client_id is None:
            raise ValueError("OIDC_ISSUER and OIDC_CLIENT_ID are not set.")
        self._issuer, self._client_id = settings.oidc_issuer, settings.oidc_client_id
        self._secret, self._claim = settings.oidc_client_secret, settings.oidc_account_claim
        self._clock, self._lock = clock, threading.Lock()
        self._kept: tuple[float, _Metadata, KeySet] | None = None

    def address_of_login(self, attempt: Attempt, redirect_uri: str) -> str:
        """Where the browser is sent. Raises ProviderUnusable."""
        metadata, _ = self._known()
        asked = {
            "response_type": "code",
            "client_id": self._client_id,
            "redirect_uri": redirect_uri,
            "scope": SCOPE,
            "state": attempt.state,
            "nonce": attempt.nonce,
            "code_challenge": _challenge(attempt.verifier),
            "code_challenge_method": "S256",
        }
        return str(httpx2.URL(metadata.authorization_endpoint).copy_merge_params(asked))

    def identity(self, attempt: Attempt, state: str, code: str, redirect_uri: str) -> Identity:
        """Exchange the code for who it is. Raises ProviderRefused and ProviderUnusable."""
        if not hmac.compare_digest(state.encode(), attempt.state.encode()):
            raise ProviderRefused
        metadata, keys = self._known()
        form = {
            "grant_type": "authorization_code",
            "code": code,
            "redirect_uri": redirect_uri,
            "client_id": self._client_id,
            "code_verifier": attempt.verifier,
        }
        token = self._token(metadata, form)
        try:
            claims = self._claims(token, keys, attempt.nonce)
        except (JoseError, ValueError):  # perhaps it has a new key
            with self._lock:
                self._kept = None
            _, keys = self._known()
            try:
                claims = self._claims(token, keys, attempt.nonce)
            except (JoseError, ValueError) as error:
                raise ProviderRefused from error
        return Identity(f"{self._issuer} {claims['sub']}", self._name(claims))

    def _token(self, metadata: _Metadata, form: Mapping[str, str]) -> str:
        secret = None if self._secret is None else self._secret.get_secret_value()
        auth = None if secret is None else httpx2.BasicAuth(self._client_id, secret)
        try:
            answer = httpx2.post(metadata.token_endpoint, data=dict(form), auth=auth, timeout=PATIENCE_S)
            token = answer.json().get("id_token") if answer.status_code == HTTPStatus.OK else None
        except (httpx2.HTTPError, ValueError, AttributeError) as error:
            raise ProviderUnusable from error
        if not isinstance(token, str):
            raise ProviderRefused
        return token

    def _claims(self, token: str, keys: KeySet, nonce: str) -> Mapping[str, Any]:
        """Raises JoseError and ValueError."""
        claims = jwt.decode(token, keys, algorithms=ALGORITHMS).claims
        registry = jwt.JWTClaimsRegistry(
            leeway=LEEWAY_S,
            iss={"essential": True, "value": self._issuer},
            aud={"essential": True, "value": self._client_id},
            exp={"essential": True},
            iat={"essential": True},
            nonce={"essential": True, "value": nonce},
            sub={"essential": True},
        )
        registry.validate(claims)
        several = isinstance(claims["aud"], list) and len(claims["aud"]) > 1
        if (several or "azp" in claims) and claims.get("azp") != self._client_id:
            raise ValueError("The token was made for another client.")
        if not isinstance(claims["sub"], str) or not 1 <= len(claims["sub"]) <= 255:
            raise ValueError("The token names nobody.")
        return claims

    def _name(self, claims: Mapping[str, Any]) -> str | None:
        name = claims.get(self._claim)
        unsure = self._claim == "email" and claims.get("email_verified") is not True
        return name if isinstance(name, str) and name and not unsure else None

    def _known(self) -> tuple[_Metadata, KeySet]:
        with self._lock:
            if self._kept is None or self._clock() - self._kept[0] > KEPT_S:
                metadata = self._metadata()
                self._kept = (self._clock(), metadata, self._keys(metadata))
            return self._kept[1:]

    def _metadata(self) -> _Metadata:
        try:
            metadata = _Metadata.model_validate(
                _fetched(f"{self._issuer.rstrip('/')}/.well-known/openid-configuration")
            )
        except ValidationError as error:
            raise ProviderUnusable from error
        if metadata.issuer != self._issuer:
            raise ProviderUnusable
        endpoints = metadata.authorization_endpoint, metadata.token_endpoint, metadata.jwks_uri
        if self._issuer.startswith("https:") and not all(each.startswith("https:") for each in endpoints):
            raise ProviderUnusable
        return metadata

    def _keys(self, metadata: _Metadata) -> KeySet:
        try:
            return KeySet.import_key_set(_fetched(metadata.jwks_uri))
        except (JoseError, ValueError, KeyError, TypeError) as error:
            raise ProviderUnusable from error


def _fetched(address: str) -> Any:
    try:
        answer = httpx2.get(address, timeout=PATIENCE_S).raise_for_status()
        return answer.json()
    except (httpx2.HTTPError, ValueError) as error:
        raise ProviderUnusable from error


def _challenge(verifier: str) -> str:
    """S256 of RFC 7636."""
    return base64.urlsafe_b64encode(hashlib.sha256(verifier.encode()).digest()).rstrip(b"=").decode()
