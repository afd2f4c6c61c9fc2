"""Web server and worker as child processes: started again when they fall, and never one because of the other."""

import ctypes
import os
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import FrameType
from typing import IO

from app.db import now
from app.falls import Falls, note

GRACE_S = 9.0
"""Both programs end by themselves within eight seconds of being asked."""
FIRST_PAUSE_S, LONGEST_PAUSE_S = 1.0, 60.0
STEADY_S = 600.0
"""Whoever has run for so long has recovered, and falls before that are forgotten. A start alone may take a minute."""
NICENESS = {"worker": 5}
"""Whoever waits for a page goes before whoever plans and computes; compute processes are nicer than this by as much."""
_LOOK_S = 0.2
_LONGEST_WORDS = 300
_PR_SET_PDEATHSIG = 1
_LIBC = ctypes.CDLL(None) if sys.platform == "linux" else None  # loaded here: a forked child must not load libraries
_COLOURS = {"web": "\033[36m", "worker": "\033[35m"}
_RESET = "\033[0m"


class Programs:
    """Web server and worker side by side, their logs merged line by line.

    A program that falls is started again, as a service manager would, after a pause that doubles with every fall.
    """

    def __init__(self, greeting: str, data_dir: Path, commands: Mapping[str, Sequence[str]]) -> None:
        self._greeting, self._data_dir = greeting, data_dir
        self._programs = [_Program(name, arguments) for name, arguments in commands.items()]
        self._stop = threading.Event()

    def run(self) -> int:
        """Until somebody stops it; returns the exit code."""
        for number in asking():
            signal.signal(number, self._on_signal)
        note(self._data_dir, [])
        for program in self._programs:
            program.start()
        say(self._greeting)
        while not self._stop.wait(_LOOK_S):
            changed = [program.look() for program in self._programs]
            if any(changed):
                note(self._data_dir, [program.falls for program in self._programs if program.falls is not None])
        self._shut_down()
        say("Stopped.")
        return 0

    def _on_signal(self, _number: int, _frame: FrameType | None) -> None:
        self._stop.set()

    def _shut_down(self) -> None:
        for program in self._programs:
            program.ask_to_stop()
        deadline = time.monotonic() + GRACE_S
        for program in self._programs:
            program.stop(deadline)


class _Program:
    """One program, its present process if it runs, and what its falls came to."""

    def __init__(self, name: str, arguments: Sequence[str]) -> None:
        self.name = name
        self.falls: Falls | None = None
        self._arguments = arguments
        self._child: subprocess.Popen[str] | None = None
        self._reader: threading.Thread | None = None
        self._words: deque[str] = deque(maxlen=1)
        self._moment = 0.0
        """when it was started, or is to be started again"""

    def start(self) -> None:
        """In a process group of its own: Ctrl-C in the terminal reaches only us, and we stop it in good order."""
        try:
            self._child = self._new_process()
        except OSError as error:  # no memory, most likely
            self._words.append(f"could not be started: {error.strerror}")
            self._has_fallen(error.errno)
            return
        self._moment = time.monotonic()
        if self._child.stdout is not None:
            self._reader = threading.Thread(target=self._forward, args=(self._child.stdout,), daemon=True)
            self._reader.start()

    def _new_process(self) -> "subprocess.Popen[str]":
        return subprocess.Popen(
            [sys.executable, *self._arguments],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            bufsize=1,
            env={**os.environ, "PYTHONUNBUFFERED": "1"},
            process_group=0,
            preexec_fn=self._begin,
        )

    def _begin(self) -> None:
        """Run in the new child."""
        end_with_parent()
        os.nice(NICENESS.get(self.name, 0))

    def look(self) -> bool:
        """Start it again if that is due; whether there is something new to tell about its falls."""
        moment = time.monotonic()
        if self._child is None:
            if moment < self._moment:
                return False
            self.start()
            return self._child is None
        if self._child.poll() is not None:
            self._has_fallen(self._child.returncode)
            return True
        if self.falls is not None and moment - self._moment > STEADY_S:
            self.falls = None
            return True
        return False

    def _has_fallen(self, code: int | None) -> None:
        if self._reader is not None:
            self._reader.join(timeout=1.0)  # its last words may still be on their way
        count = 1 if self.falls is None else self.falls.count + 1
        since = now() if self.falls is None else self.falls.since
        self.falls = Falls(self.name, count, since, self._words[-1] if self._words else f"exit code {code}")
        pause_s = min(LONGEST_PAUSE_S, FIRST_PAUSE_S * 2.0 ** min(count - 1, 10))
        times = "" if count == 1 else f", {count} times by now"
        again = "starting it again" if count == 1 else f"starting it again in {pause_s:.0f} s"
        say(f"The {self.name} stopped by itself (exit code {code}{times}); {again}.")
        self._child, self._moment = None, time.monotonic() + pause_s

    def ask_to_stop(self) -> None:
        if self._child is not None and self._child.poll() is None:
            self._child.terminate()

    def stop(self, deadline: float) -> None:
        if self._child is None:
            return
        try:
            self._child.wait(max(0.1, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            self._child.kill()
            self._child.wait()

    def _forward(self, stream: IO[str]) -> None:
        colour, reset = (_COLOURS[self.name], _RESET) if sys.stdout.isatty() else ("", "")
        for line in stream:
            say(f"{colour}{self.name:<6}{reset} {line.rstrip()}")
            if line.strip():
                self._words.append(line.strip()[:_LONGEST_WORDS])


def asking() -> list[signal.Signals]:
    """The signals that ask a program to stop. Not a closed terminal if somebody has seen to that (nohup)."""
    hung_up = [] if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN else [signal.SIGHUP]
    return [signal.SIGINT, signal.SIGTERM, *hung_up]


def end_with_parent() -> None:
    """Run in a new child: when whoever started it is killed outright, Linux asks it to stop as Ctrl-C would have.

    That is the thread that started it: it has to live as long as the child is to.
    """
    if _LIBC is not None:
        _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


def say(text: str) -> None:
    """Print a line at once."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()
