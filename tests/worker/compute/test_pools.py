"""Heavy work runs in processes that may die, and must die with their worker."""

import contextlib
import errno
import io
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from tqdm import tqdm

from tests.waiting import PATIENCE_S
from worker.compute.pools import Compute, ComputeLost, Interrupted, Lane


def nothing() -> None:
    """No sign of life needed."""


def square(number: int) -> int:
    return number * number


def own_pid() -> int:
    return os.getpid()


def die() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def show_progress() -> None:
    list(tqdm(range(3), file=io.StringIO()))


def die_by_the_end_of(number: int, started: Path) -> int:
    """The process that is given 0 dies; the others are at work by then, and finish."""
    (started / str(number)).touch()
    while len(list(started.iterdir())) < 2:
        threading.Event().wait(0.01)
    if number == 0:
        die()
    while not (started / "lost").exists():
        threading.Event().wait(0.01)
    return number


def at_the_start() -> tuple[bool, int, int]:
    """Whether torch is there already, the threads it computes in, and the memory that this process has for itself."""
    loaded = sys.modules.get("torch")
    rows = dict(line.split(":", 1) for line in Path("/proc/self/smaps_rollup").read_text().splitlines()[1:])
    return loaded is not None, loaded.get_num_threads() if loaded else 0, int(rows["Private_Dirty"].split()[0]) * 1024


def fail_with_a_lock() -> None:
    raise RuntimeError("no use", threading.Lock())


def wait_forever(started: Path) -> None:
    started.write_text(str(os.getpid()))
    threading.Event().wait()


@pytest.fixture
def compute() -> Iterator[Compute]:
    compute = Compute(2)
    yield compute
    compute.close()


def test_results_come_in_the_order_of_the_arguments(compute: Compute) -> None:
    assert compute.run_all(Lane.LEARNING, nothing, square, [(number,) for number in range(7)]) == [
        0,
        1,
        4,
        9,
        16,
        25,
        36,
    ]


def test_a_killed_process_is_reported_and_replaced(compute: Compute) -> None:
    with pytest.raises(ComputeLost, match="memory"):
        compute.run(Lane.CLIPS, nothing, die)
    assert compute.run(Lane.CLIPS, nothing, square, 3) == 9


def test_only_the_job_whose_process_died_is_lost(compute: Compute, tmp_path: Path) -> None:
    outcomes: dict[int, object] = {}

    def work(number: int) -> None:
        try:
            outcomes[number] = compute.run(Lane.LEARNING, nothing, die_by_the_end_of, number, tmp_path)
        except ComputeLost as lost:
            outcomes[number] = lost
            (tmp_path / "lost").touch()

    threads = [threading.Thread(target=work, args=(number,)) for number in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(timeout=PATIENCE_S)
    assert isinstance(outcomes[0], ComputeLost)
    assert outcomes[1] == 1


def test_processes_begin_with_everything_loaded_in_one_thread_and_share_its_memory(compute: Compute) -> None:
    for lane in (Lane.CLIPS, Lane.LEARNING):
        is_loaded, threads, own_memory_bytes = compute.run(lane, nothing, at_the_start)
        assert is_loaded
        assert threads == 1
        assert own_memory_bytes < 160 * 2**20, "torch alone is more"


def test_a_process_that_cannot_be_started_is_reported_and_tried_again_by_the_next_job(
    compute: Compute, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_memory(_self: object) -> None:
        raise OSError(errno.ENOMEM, "Cannot allocate memory")

    with monkeypatch.context() as machine:
        machine.setattr("multiprocessing.context.ForkServerProcess.start", no_memory)
        with pytest.raises(ComputeLost):
            compute.run(Lane.LEARNING, nothing, square, 2)
    assert compute.run(Lane.LEARNING, nothing, square, 3) == 9


def test_an_error_says_where_in_the_process_it_happened_even_one_that_cannot_travel(compute: Compute) -> None:
    with pytest.raises(ZeroDivisionError) as divided:
        compute.run(Lane.LEARNING, nothing, divmod, 1, 0)
    assert "compute process" in "".join(divided.value.__notes__)
    with pytest.raises(RuntimeError, match="no use") as failed:
        compute.run(Lane.LEARNING, nothing, fail_with_a_lock)
    assert "fail_with_a_lock" in "".join(failed.value.__notes__)


def test_a_compute_process_that_was_stopped_does_not_hold_up_the_end(tmp_path: Path) -> None:
    compute = Compute(1)
    idle = compute.run(Lane.CLIPS, nothing, own_pid)
    started = tmp_path / "started"
    raised: list[BaseException] = []

    def work() -> None:
        try:
            compute.run(Lane.LEARNING, nothing, wait_forever, started)
        except BaseException as error:
            raised.append(error)

    thread = threading.Thread(target=work)
    thread.start()
    while not (started.exists() and started.read_text()):
        threading.Event().wait(0.01)
    busy = int(started.read_text())
    for pid in (idle, busy):
        os.kill(pid, signal.SIGSTOP)
    compute.close()
    thread.join(timeout=PATIENCE_S)
    assert [type(error) for error in raised] == [Interrupted]
    assert ends(idle)
    assert ends(busy)


def test_who_is_answering_does_not_wait_for_somebody_else_s_filter(tmp_path: Path) -> None:
    compute = Compute(1)
    started = tmp_path / "started"

    def train() -> None:
        with contextlib.suppress(Interrupted):
            compute.run(Lane.LEARNING, nothing, wait_forever, started)

    thread = threading.Thread(target=train)
    thread.start()
    assert compute.run(Lane.REWARDS, nothing, square, 3) == 9
    compute.close()
    thread.join(timeout=PATIENCE_S)
    assert not thread.is_alive()


def test_stopping_interrupts_whoever_waits_with_nothing_that_could_be_recorded_as_an_outcome(tmp_path: Path) -> None:
    compute = Compute(1)
    started = tmp_path / "started"
    raised: list[BaseException] = []

    def work() -> None:
        try:
            compute.run(Lane.LEARNING, stop_when_started, wait_forever, started)
        except BaseException as error:
            raised.append(error)

    def stop_when_started() -> None:
        while not started.exists():
            threading.Event().wait(0.01)
        compute.close()

    thread = threading.Thread(target=work)
    thread.start()
    thread.join(timeout=PATIENCE_S)
    assert [type(error) for error in raised] == [Interrupted]
    assert not isinstance(raised[0], Exception)


def test_compute_processes_die_with_a_worker_that_is_killed() -> None:
    program = (
        "import os, sys\n"
        "from tests.worker.compute.test_pools import nothing, own_pid\n"
        "from worker.compute.pools import Compute, Lane\n"
        "if __name__ == '__main__':\n"
        "    print(Compute(1).run(Lane.LEARNING, nothing, own_pid), flush=True)\n"
        "    sys.stdin.read()\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as parent:
        assert parent.stdout is not None
        child = int(parent.stdout.readline())
        parent.kill()
        parent.wait()
        assert ends(child)


@pytest.mark.parametrize(("last", "words"), [("compute.close()", ""), ("raise SystemExit", None)])
def test_processes_with_nothing_left_to_do_leave_without_a_word_and_keep_nobody(last: str, words: str | None) -> None:
    program = (
        "from tests.worker.compute.test_pools import nothing, show_progress\n"
        "from worker.compute.pools import Compute, Lane\n"
        "if __name__ == '__main__':\n"
        "    compute = Compute(1)\n"
        "    compute.run(Lane.LEARNING, nothing, show_progress)\n"
        f"    {last}\n"
    )
    ended = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=PATIENCE_S, check=True
    )
    assert words is None or ended.stderr == words


def ends(pid: int) -> bool:
    """Whether the process ends; a zombie whose parent has not asked counts as ended."""
    for _ in range(int(PATIENCE_S * 50)):
        try:
            status = Path(f"/proc/{pid}/stat").read_text()
        except FileNotFoundError:
            return True
        if status.rsplit(")", 1)[1].split()[0] == "Z":
            return True
        threading.Event().wait(0.02)
    return False
