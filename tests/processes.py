"""The processes that a worker has started."""

from contextlib import suppress
from pathlib import Path


def fork_servers(pid: int) -> list[int]:
    """The process that forks its compute processes, if it has begun."""
    return [child for child in children(pid) if "forkserver" in Path(f"/proc/{child}/cmdline").read_text()]


def compute_processes(pid: int) -> list[int]:
    """Those it has had forked."""
    return [child for server in fork_servers(pid) for child in children(server)]


def children(pid: int) -> list[int]:
    """Whichever of its threads has started them."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            if int(stat.read_text().rsplit(")", 1)[1].split()[1]) == pid:
                found.append(int(stat.parent.name))
    return found
