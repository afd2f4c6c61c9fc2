"""Serves a bundle's filter loop (filter_loop.py) to a client, before any policy: ``run_filter.py --serve PORT``.

Both sides speak openpi's websocket protocol (policy_client.py). The policy is the bundle's own, one on another server
(``--upstream ws://host:port``), or a function of this computer's (``--upstream module:function``).
"""

import argparse
import contextlib
import http
import importlib
import logging
import signal
import sys
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from websockets.exceptions import WebSocketException
from websockets.http11 import Request, Response
from websockets.sync.server import ServerConnection, serve

if __package__:
    from worker.ml.export.filter_loop import FilterLoop, Means, Refused, Run, require_same
    from worker.ml.policies.policy_client import PolicyFunction, PolicyServer, PolicyServerFailed, packed
else:  # in a bundle they lie beside this file
    from filter_loop import (  # type: ignore[import-not-found, no-redef]  # in bundles
        FilterLoop,
        Means,
        Refused,
        Run,
        require_same,
    )
    from policy_client import (  # type: ignore[import-not-found, no-redef]  # in bundles
        PolicyFunction,
        PolicyServer,
        PolicyServerFailed,
        packed,
    )

SAME_WITHIN = 1e-4
"""Largest difference of a policy's action in [-1, 1] from the recorded one: another computer rounds otherwise."""


def main(manifest: Mapping[str, Any], run: Run, means: Means | None, options: argparse.Namespace) -> int:
    """Serve until a signal; the exit code."""
    interface = manifest["interface"]
    policy: PolicyServer | PolicyFunction | Means
    if options.upstream and interface["policy"].get("settings"):
        sys.stderr.write(
            "FAILED: this bundle's policy has settings that a server does not know: leave --upstream out.\n"
        )
        return 1
    if options.upstream:
        try:
            policy = _upstream(options, interface)
        except (PolicyServerFailed, Refused) as error:
            sys.stderr.write(f"FAILED: {error}\n")
            return 1
    elif means is not None:
        policy = means
    else:
        sys.stderr.write(
            "FAILED: this bundle holds no policy: say where it is with --upstream ws://host:port or --upstream "
            "module:function.\n"
        )
        return 1
    deadline_s = options.deadline_ms / 1000.0 if options.deadline_ms else 1.0 / interface["control_rate_hz"]
    loop = FilterLoop(interface, run, policy, deadline_s, options.pause_s)
    loop.compare_with_tests(manifest, Path(__file__).parent)
    if isinstance(policy, PolicyFunction):
        try:
            _require_the_policy(loop, Path(__file__).with_name("recorded"))
        except (PolicyServerFailed, Refused) as error:
            loop.close()
            sys.stderr.write(f"FAILED: {error}\n")
            return 1
    about = {
        "interface": dict(interface),
        "bundle": {name: manifest[name] for name in ("study", "participant", "version")},
        "action_horizon": 1,
        "policy": policy.metadata if isinstance(policy, PolicyServer) else {},
    }
    logging.getLogger("websockets").setLevel(logging.CRITICAL)  # what goes wrong is said below
    try:
        with _listening(loop, about, options) as address:
            sys.stdout.write(
                f"Filter of {manifest['participant']} ({manifest['task']}) at {address}; end it with Ctrl+C.\n"
            )
            sys.stdout.flush()
            _until_signal()
    except OSError as error:
        sys.stderr.write(f"FAILED: cannot listen at {options.host}:{options.serve} ({error.strerror}).\n")
        return 1
    finally:
        loop.close()
    sys.stdout.write("Ended.\n")
    return 0


def _upstream(options: argparse.Namespace, interface: Mapping[str, Any]) -> PolicyServer | PolicyFunction:
    """Raises PolicyServerFailed, and Refused for a server of something else."""
    if "://" not in options.upstream:
        module, _, name = options.upstream.partition(":")
        try:
            return PolicyFunction(options.upstream, getattr(importlib.import_module(module), name))
        except Exception as error:  # whatever code from elsewhere may do when it is imported
            raise Refused(
                f"{options.upstream!r} is no address of a websocket, and as module:function it cannot be imported "
                f"({type(error).__name__}: {error}). Put the file beside run_filter.py, or install its package."
            ) from error
    server = PolicyServer(options.upstream, answer_s=options.upstream_s)
    try:
        server.connect()
        if isinstance(server.metadata.get("interface"), dict):
            require_same("the policy server", server.metadata["interface"], interface)
    except (PolicyServerFailed, Refused):
        server.close()
        raise
    return server


def _require_the_policy(loop: FilterLoop, recorded: Path) -> None:
    """Refuse a function that says something else of what was recorded than the policy that the filter was made for."""
    seen, mean = (np.load(recorded / f"{name}.npy", allow_pickle=False)[0] for name in ("observations", "policy_means"))
    said = loop.first_said(seen[: sum(field["size"] for field in loop.interface["observation"])])
    if float(np.abs(said - mean).max()) > SAME_WITHIN:
        raise Refused(
            f"this is another policy than the one of this bundle: it says {np.round(said, 4).tolist()} where that said "
            f"{np.round(mean, 4).tolist()}."
        )


@contextlib.contextmanager
def _listening(loop: FilterLoop, about: Mapping[str, Any], options: argparse.Namespace) -> Iterator[str]:
    one_at_a_time = threading.Lock()

    def handle(connection: ServerConnection) -> None:
        if not one_at_a_time.acquire(blocking=False):
            _refuse(connection, "somebody else is connected; a filter stands before one robot.")
            return
        try:
            loop.begin_connection()
            connection.send(packed(about))
            for stored in connection:
                if isinstance(stored, str):
                    raise Refused("the message is text; send MessagePack, as openpi's client does.")
                connection.send(packed(loop.answer(stored)))
        except Refused as error:
            _refuse(connection, str(error))
        except (OSError, WebSocketException):
            pass  # whoever is gone needs no words
        finally:
            if loop.counted.steps:
                sys.stdout.write(f"Connection ended: {loop.counted}\n")
                sys.stdout.flush()
            one_at_a_time.release()

    with serve(
        handle, options.host, options.serve, compression=None, max_size=64 << 20, process_request=_healthy
    ) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        try:
            yield f"ws://{options.host}:{server.socket.getsockname()[1]}"
        finally:
            server.shutdown()
            thread.join()


def _until_signal() -> None:
    ended = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: ended.set())
    while not ended.wait(0.2):  # a wait without an end would keep signals from being seen
        pass


def _refuse(connection: ServerConnection, why: str) -> None:
    sys.stderr.write(f"Refused: {why}\n")
    with contextlib.suppress(OSError, WebSocketException):
        connection.send(f"Refused: {why}")
        connection.close(1008, "refused")


def _healthy(connection: ServerConnection, request: Request) -> Response | None:
    return connection.respond(http.HTTPStatus.OK, "OK\n") if request.path == "/healthz" else None
