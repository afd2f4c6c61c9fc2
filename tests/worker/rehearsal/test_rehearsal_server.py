"""Commands that start a studio of their own leave nothing of it running, however they end."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from functools import partial
from itertools import count
from pathlib import Path

import pytest

from tests.waiting import PATIENCE_S, gone, hear_hangups, until
from worker.rehearsal.server import StandsStill, wait_until

PROGRAM = """
import sys
from pathlib import Path
from worker import stop_signals
from worker.rehearsal.server import OwnStudio

if __name__ == "__main__":
    stop_signals.any_signal_is_ctrl_c()
    try:
        with OwnStudio(Path(sys.argv[1])):
            sys.stdin.read()
    except KeyboardInterrupt:
        sys.exit(130)
"""


def programs_in(directory: Path) -> dict[str, int]:
    """Processes of a studio in this directory, by what they are."""
    found = {}
    for process in Path("/proc").glob("[0-9]*"):
        try:
            command, environment = (process / "cmdline").read_text(), (process / "environ").read_text()
        except OSError:
            continue
        name = next((name for name in ("app\0web", "worker\0run", "forkserver") if name in command), None)
        if name is not None and f"DATA_DIR={directory}\0" in environment:
            found[name] = int(process.name)
    return found


@pytest.fixture
def command(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator["subprocess.Popen[bytes]"]:
    process = subprocess.Popen(request.param(tmp_path), stdin=subprocess.PIPE, preexec_fn=hear_hangups)
    yield process
    process.kill()
    process.communicate()
    for pid in programs_in(tmp_path).values():
        os.kill(pid, signal.SIGKILL)


def own_studio(directory: Path) -> list[str]:
    return [sys.executable, "-c", PROGRAM, str(directory)]


def rehearsal(directory: Path) -> list[str]:
    return [sys.executable, "-m", "worker", "rehearse", "--labels", "20", "--directory", str(directory)]


@pytest.mark.parametrize("command", [own_studio], indirect=True)
@pytest.mark.parametrize("number", [pytest.param(signal.SIGHUP, marks=pytest.mark.long), signal.SIGKILL])
def test_a_signal_that_ends_the_command_ends_its_web_server_and_its_worker(
    command: "subprocess.Popen[bytes]", number: int, tmp_path: Path
) -> None:
    assert until(lambda: programs_in(tmp_path).keys() >= {"app\0web", "worker\0run"})
    started = programs_in(tmp_path)
    command.send_signal(number)
    assert command.wait(PATIENCE_S) == (-number if number == signal.SIGKILL else 130)
    assert until(lambda: all(gone(pid) for pid in started.values()))
    assert until(lambda: programs_in(tmp_path) == {})


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.parametrize("command", [rehearsal], indirect=True)
def test_a_rehearsal_that_is_told_to_stop_takes_its_studio_along(
    command: "subprocess.Popen[bytes]", tmp_path: Path
) -> None:
    assert until(lambda: programs_in(tmp_path).keys() >= {"app\0web", "worker\0run", "forkserver"}), "it films by now"
    command.terminate()
    assert command.wait(PATIENCE_S) == 130
    assert until(lambda: programs_in(tmp_path) == {})


def test_whoever_waits_is_patient_for_as_long_as_something_moves() -> None:
    looks = iter(range(8))
    found = wait_until(1.2, "nothing", lambda: "there" if next(looks) == 7 else None, partial(next, count()))
    assert found == "there", "after longer than the patience"
    with pytest.raises(StandsStill, match="no bundle for 1 s"):
        wait_until(1.0, "no bundle", lambda: None, lambda: "always the same")
