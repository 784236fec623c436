"""What differs between operating systems: locks, limits of child processes, load, affinity, durable folders.

The only file that imports modules which not every system has. It is also a program, which imports nothing of the
service: it takes on limits that can't be lifted, and becomes another program.

    python -I operating_system.py MEMORY_BYTES CPU_S PROGRAM.py ARGS
"""

from __future__ import annotations

import importlib
import os
import runpy
import sys
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from filelock import BaseFileLock

# By attributes that type checkers don't look for: each system lacks others.
_os: Any = os
try:
    resource: Any = importlib.import_module("resource")
except ImportError:  # Windows
    resource = None

_CPU_QUOTA = Path("/sys/fs/cgroup/cpu.max")
_LOWER_BY = 3
"""Nice values: a thread gets about half of what one of normal priority gets on the same core."""
_CHILD_ENVIRONMENT = ("PATH", "LD_LIBRARY_PATH", "DYLD_LIBRARY_PATH", "SYSTEMROOT", "TEMP", "TMP")
"""What a process needs to find its libraries; without SYSTEMROOT Python doesn't start on Windows."""


def locked(path: Path, wait_s: float = 0.0) -> BaseFileLock:
    """Lock a file for this process until `release()`; the system releases it when the process is killed.

    Raises BlockingIOError if another process, or another lock of this one, has it for longer than `wait_s`; OSError if
    it can't be opened.
    """
    from filelock import FileLock, Timeout

    lock = FileLock(path, timeout=wait_s)
    try:
        lock.acquire()
    except Timeout:
        raise BlockingIOError(f"{path} is locked") from None
    return lock


def limited_command(program: Path, *arguments: object, memory_bytes: int, cpu_s: int = 0) -> list[str]:
    """Return the command of a Python program that can't exceed these limits, where the system has any.

    The program finds installed packages and nothing of ours. `cpu_s` = 0: no limit of its CPU time.
    """
    values = (Path(__file__), memory_bytes, cpu_s, program, *arguments)
    return [sys.executable, "-I", *map(str, values)]


def child_environment() -> dict[str, str]:
    """Return the part of the environment that a child process needs in order to start."""
    return {name: os.environ[name] for name in _CHILD_ENVIRONMENT if name in os.environ}


def missing_limits() -> str:
    """Return what the system can't limit of a decoder's process, and what holds instead; empty if it can all."""
    if resource is None:
        return "this system has no limits of memory and CPU time for a process; a decoder's wall time is limited"
    if sys.platform == "darwin":
        return "macOS doesn't limit a process's memory; a decoder's time is limited"
    return ""


def available_cores() -> int:
    """Count the processors that this process may use: its CPU affinity, within the CPU quota of its cgroup."""
    cores = len(_os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    try:
        quota, period = _CPU_QUOTA.read_text("ascii").split()
    except (OSError, ValueError):
        return cores
    return cores if quota == "max" else max(1, min(cores, round(int(quota) / int(period))))


def lower_priority() -> None:
    """Let the calling thread run when threads of normal priority don't; where the system can't, it stays as it is."""
    # A nice value is a thread's own on Linux only; elsewhere it would slow the whole process.
    if sys.platform == "linux":
        thread = threading.get_native_id()
        lower = min(os.getpriority(os.PRIO_PROCESS, thread) + _LOWER_BY, 19)
        os.setpriority(os.PRIO_PROCESS, thread, lower)


def keep_to_cores(process: int, count: int) -> None:
    """Let a process that has just begun run on the first of the processors that this one may use; on Linux only."""
    if hasattr(os, "sched_setaffinity"):
        _os.sched_setaffinity(process, sorted(_os.sched_getaffinity(0))[:count])


def load_averages() -> tuple[float, ...]:
    """Return the mean number of running processes over 1, 5 and 15 minutes; empty where the system counts none."""
    return _os.getloadavg() if hasattr(os, "getloadavg") else ()


def sync_folder(folder: Path) -> None:
    """Wait until the names in a folder are on disk. Windows has no such call; its file system logs names itself."""
    if os.name == "nt":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _limit(memory_bytes: int, cpu_s: int) -> None:
    if resource is None:
        return
    wanted = [(resource.RLIMIT_CORE, 0)]
    if sys.platform != "darwin":  # it refuses any limit of the address space
        wanted.append((resource.RLIMIT_AS, memory_bytes))
    if cpu_s:
        wanted.append((resource.RLIMIT_CPU, cpu_s))
    for kind, value in wanted:
        resource.setrlimit(kind, (value, value))


def _become_limited() -> None:
    memory_bytes, cpu_s, program, *arguments = sys.argv[1:]
    _limit(int(memory_bytes), int(cpu_s))
    sys.argv = [program, *arguments]
    runpy.run_path(program, run_name="__main__")


if __name__ == "__main__":
    _become_limited()
