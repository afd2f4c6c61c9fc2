"""A small identity provider for tests: the server side of Authlib, real keys, real HTTP. One person is logged in."""

import secrets
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from typing import Any, ClassVar

from authlib.integrations.flask_oauth2 import AuthorizationServer
from authlib.oauth2.rfc6749 import ClientMixin
from authlib.oauth2.rfc6749.grants import AuthorizationCodeGrant
from authlib.oauth2.rfc7636 import CodeChallenge
from authlib.oidc.core import AuthorizationCodeMixin, UserInfo
from authlib.oidc.core.grants import OpenIDCode
from flask import Flask, jsonify, request
from joserfc.jwk import RSAKey
from werkzeug.serving import make_server

CLIENT, SECRET = "the-studio", "a secret between provider and studio"


@dataclass
class Client(ClientMixin):  # type: ignore[misc]
    """The studio, as the provider knows it."""

    redirect_uri: str

    def get_client_id(self) -> str:
        return CLIENT

    def get_default_redirect_uri(self) -> str:
        return self.redirect_uri

    def get_allowed_scope(self, scope: str) -> str:
        return scope

    def check_redirect_uri(self, redirect_uri: str) -> bool:
        return redirect_uri == self.redirect_uri

    def check_client_secret(self, client_secret: str) -> bool:
        return secrets.compare_digest(client_secret, SECRET)

    def check_endpoint_auth_method(self, method: str, endpoint: str) -> bool:
        return method == "client_secret_basic"

    def check_response_type(self, response_type: str) -> bool:
        return response_type == "code"

    def check_grant_type(self, grant_type: str) -> bool:
        return grant_type == "authorization_code"


@dataclass
class Code(AuthorizationCodeMixin):  # type: ignore[misc]
    """An authorization code that was given out, with what it stands for."""

    code: str
    redirect_uri: str
    scope: str
    nonce: str
    code_challenge: str
    code_challenge_method: str
    user: dict[str, Any]

    def get_redirect_uri(self) -> str:
        return self.redirect_uri

    def get_scope(self) -> str:
        return self.scope

    def get_nonce(self) -> str:
        return self.nonce

    def get_auth_time(self) -> int:
        return int(time.time())


@dataclass
class IdentityProvider:
    """One that runs; what it says can be bent, as a hostile or broken one would."""

    issuer: str
    client: Client
    user: dict[str, Any]
    """Whoever is logged in there: the claims of the ID token about the person."""
    key: RSAKey
    published: RSAKey
    """What the provider says its key is."""
    bent: dict[str, Any] = field(default_factory=dict)
    """Claims that the ID token has instead of the right ones; None: not at all."""
    codes: dict[str, Code] = field(default_factory=dict)
    asked: list[str] = field(default_factory=list)
    """Paths, in their order."""


def _application(provider: IdentityProvider) -> Flask:
    application = Flask(__name__)
    server = AuthorizationServer(application, query_client=lambda _: provider.client, save_token=lambda *_: None)

    class Grant(AuthorizationCodeGrant):  # type: ignore[misc]
        TOKEN_ENDPOINT_AUTH_METHODS: ClassVar[list[str]] = ["client_secret_basic"]

        def save_authorization_code(self, code: str, asked: Any) -> None:
            data = asked.payload.data
            provider.codes[code] = Code(
                code,
                data["redirect_uri"],
                data["scope"],
                data["nonce"],
                data["code_challenge"],
                data["code_challenge_method"],
                asked.user,
            )

        def query_authorization_code(self, code: str, client: Client) -> Code | None:
            return provider.codes.get(code)

        def delete_authorization_code(self, authorization_code: Code) -> None:
            del provider.codes[authorization_code.code]

        def authenticate_user(self, authorization_code: Code) -> dict[str, Any]:
            return authorization_code.user

    class IdToken(OpenIDCode):  # type: ignore[misc]
        def exists_nonce(self, nonce: str, asked: Any) -> bool:
            return any(each.nonce == nonce for each in provider.codes.values())

        def resolve_client_private_key(self, client: Client) -> RSAKey:
            return provider.key

        def get_client_algorithm(self, client: Client) -> str:
            return "RS256"

        def get_encode_header(self, client: Client) -> dict[str, str]:
            return {"alg": "RS256", "kid": str(provider.key.kid)}

        def get_client_claims(self, client: Client) -> dict[str, Any]:
            return {"iss": provider.issuer, "aud": [CLIENT]}

        def get_authorization_code_claims(self, authorization_code: Code) -> dict[str, Any]:
            return {"nonce": authorization_code.get_nonce()}

        def generate_user_info(self, user: dict[str, Any], scope: str) -> UserInfo:
            return UserInfo(**(user | provider.bent))

    server.register_grant(Grant, [CodeChallenge(required=True), IdToken(require_nonce=True)])

    @application.before_request
    def note() -> None:
        provider.asked.append(request.path)

    @application.get("/.well-known/openid-configuration")
    def configuration() -> Any:
        endpoints = {"authorization": "authorize", "token": "token"}
        described = {f"{name}_endpoint": f"{provider.issuer}/{path}" for name, path in endpoints.items()}
        return jsonify(issuer=provider.issuer, jwks_uri=f"{provider.issuer}/keys", **described)

    @application.get("/keys")
    def keys() -> Any:
        return jsonify(keys=[provider.published.as_dict(private=False)])

    @application.get("/authorize")
    def authorize() -> Any:
        grant = server.get_consent_grant(end_user=provider.user)
        return server.create_authorization_response(grant_user=provider.user, grant=grant)

    @application.post("/token")
    def token() -> Any:
        return server.create_token_response()

    return application


@cache
def _first_key() -> RSAKey:
    return RSAKey.generate_key(2048, {"kid": "first"})


@contextmanager
def running(redirect_uri: str) -> Iterator[IdentityProvider]:
    """Serves one on a free port."""
    key = _first_key()
    user = {"sub": "4711", "email": "ada@example.org", "email_verified": True}
    provider = IdentityProvider("", Client(redirect_uri), user, key, key)
    server = make_server("127.0.0.1", 0, _application(provider))
    provider.issuer = f"http://127.0.0.1:{server.server_port}"
    thread = threading.Thread(target=server.serve_forever, args=(0.02,))
    thread.start()
    try:
        yield provider
    finally:
        server.shutdown()
        thread.join()
        server.server_close()
