"""Runs tests on an S3-compatible server of their own, started for them and gone afterwards (moto's).

python -m tests.on_s3                                what continuous integration runs there: no case twice
python -m tests.on_s3 tests/app tests/worker/jobs    any other choice, in pytest's own words
"""

import argparse
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from urllib.request import Request, urlopen

from tests.waiting import free_port, until

BUCKET = "studio"
USUAL = (
    *(f"tests/app/test_{name}.py" for name in ("artefacts", "archive", "damage", "watch_clip", "withdraw")),
    *(f"tests/worker/jobs/test_{name}.py" for name in ("exports", "repairs", "unused_files")),
    "-n",
    "2",
    "--dist",
    "loadfile",
    "-q",
    "-m",
    "first_case and not slow and not browser",
)


def main() -> int:
    """Run pytest; returns its exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("arguments", nargs=argparse.REMAINDER, help="of pytest, paths first")
    arguments = parser.parse_args().arguments
    with serving() as environment:
        command = [sys.executable, "-m", "pytest", *(arguments or USUAL)]
        ours = {**os.environ, **environment, "TEST_STORAGE_URL": f"s3://{BUCKET}"}
        return subprocess.run(command, env=ours, check=False).returncode


@contextmanager
def serving(port: int | None = None) -> Iterator[dict[str, str]]:
    """A server with an empty bucket; gives the variables by which programs find it, and are let in."""
    port = port or free_port()
    server = subprocess.Popen(
        ["setpriv", "--pdeathsig", "KILL", sys.executable, "-m", "moto.server", "-p", str(port)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        until(lambda: server.poll() is not None or _has_made_bucket(port))
        if server.poll() is not None:
            raise RuntimeError(f"moto's server has ended with {server.returncode}.")
        yield {
            "AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}",
            "AWS_ACCESS_KEY_ID": "studio",
            "AWS_SECRET_ACCESS_KEY": "of no secrecy",
            "AWS_REGION": "us-east-1",
        }
    finally:
        server.kill()
        server.wait()


def _has_made_bucket(port: int) -> bool:
    try:
        with urlopen(Request(f"http://127.0.0.1:{port}/{BUCKET}", method="PUT"), timeout=10) as answer:
            return bool(answer.status == 200)
    except OSError:
        return False


if __name__ == "__main__":
    sys.exit(main())
