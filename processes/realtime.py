"""Real-time set-up of a host process, and what this machine grants of it.

Measured on a 2-core virtual machine at 2 kHz: a timer slack of 1 ns cuts wake-up lateness from 63
to 14 us for nothing; SCHED_FIFO cuts late cycles eightfold. Both must be set before the ZeroMQ
context is made, whose threads inherit them. Without the privileges everything still runs, later now
and then.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import platform
import resource
import signal
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Final, Literal

SHADOW_NICE: Final = -15
_PR_SET_TIMERSLACK: Final = 29
_PR_SET_PDEATHSIG: Final = 1
_MCL_CURRENT_AND_FUTURE: Final = 3

SHADOW_SLICE_NS: Final = 100_000
"""The shortest turn the scheduler knows: who asks for a short one need not wait for a longer."""
_SYS_SCHED_SETATTR: Final = {"x86_64": 314, "aarch64": 274}

_libc = ctypes.CDLL(None, use_errno=True)


class _SchedAttr(ctypes.Structure):
    """struct sched_attr of Linux, in its first version."""

    _fields_ = (
        ("size", ctypes.c_uint32),
        ("policy", ctypes.c_uint32),
        ("flags", ctypes.c_uint64),
        ("nice", ctypes.c_int32),
        ("priority", ctypes.c_uint32),
        ("runtime_ns", ctypes.c_uint64),
        ("deadline_ns", ctypes.c_uint64),
        ("period_ns", ctypes.c_uint64),
    )


def set_timer_slack() -> bool:
    """Ask for 1 ns timer slack for this process and the threads it starts from now on."""
    return bool(_libc.prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0) == 0)


def set_fifo(priority: int) -> bool:
    """Run under SCHED_FIFO; False when the machine does not grant it."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except (OSError, AttributeError):
        return False
    return True


def set_threads(priority: int, cores: set[int]) -> None:
    """Run all threads of this process under SCHED_FIFO, or with priority 0 as favoured others, on
    some cores.

    A controller in shadow that can't keep up would, under SCHED_FIFO, use up what the kernel allows
    all such processes of a core together, and have the reflex loop suspended for it.
    """
    for name in os.listdir("/proc/self/task"):
        thread = int(name)
        with contextlib.suppress(OSError):
            os.sched_setaffinity(thread, cores)
            if priority:
                os.sched_setscheduler(thread, os.SCHED_FIFO, os.sched_param(priority))
            else:
                os.sched_setscheduler(thread, os.SCHED_OTHER, os.sched_param(0))
                os.setpriority(os.PRIO_PROCESS, thread, SHADOW_NICE)
                _ask_short_turns(thread)
    if not priority:
        # every session may be a scheduling group, outside of which the nice value of a thread
        # means nothing; the group has one of its own
        with contextlib.suppress(OSError):
            Path("/proc/self/autogroup").write_text(str(SHADOW_NICE))


def _ask_short_turns(thread: int) -> None:
    """From Linux 6.12 on, a thread of short turns is not kept waiting until others end theirs."""
    number = _SYS_SCHED_SETATTR.get(platform.machine())
    if number is not None:
        size = ctypes.sizeof(_SchedAttr)
        wanted = _SchedAttr(size, os.SCHED_OTHER, 0, SHADOW_NICE, 0, SHADOW_SLICE_NS, 0, 0)
        _libc.syscall(number, thread, ctypes.byref(wanted), 0)


def lock_memory() -> bool:
    """Keep all pages in memory; False when the limit does not allow it."""
    soft, _ = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    if soft != resource.RLIM_INFINITY and os.geteuid() != 0:
        return False  # a finite limit would make later allocations fail instead
    return bool(_libc.mlockall(_MCL_CURRENT_AND_FUTURE) == 0)


def die_with_parent() -> None:
    """Have the kernel end this helper process when the one that started it is gone."""
    _libc.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)


Cores = Literal["reflex", "others", "any"]
"""Where a process runs: on the core of the reflex loop, on the others, or where there is room."""


def choose_cores(available: Iterable[int], cores: Cores) -> set[int]:
    """The processor cores for a process.

    The reflex loop (sample, command, sample) is a chain: its processes never work at the same time,
    so they share the last core, where waking each other needs no other core's help and nobody else
    disturbs them. Measured on 2 cores: reaction p50 199 to 147 us, all processes 1.49 to 1.2 cores.
    Controllers in shadow would overload that core; the scheduler finds them room.
    """
    found = sorted(available)
    if len(found) < 2 or cores == "any":
        return set(found)
    return {found[-1]} if cores == "reflex" else set(found[:-1])


def prepare(priority: int, cores: Cores = "others") -> list[str]:
    """Set up a process of a live run (priority 0: ordinary). Returns what was not granted."""
    missing = []
    try:
        os.sched_setaffinity(0, choose_cores(os.sched_getaffinity(0), cores))
    except OSError:
        missing.append("core affinity")
    if not set_timer_slack():
        missing.append("timer slack")
    if priority:
        if not set_fifo(priority):
            missing.append("SCHED_FIFO")
        if not lock_memory():
            missing.append("memory locking")
        gc.collect()
        gc.freeze()
        gc.disable()
    return missing


def sleep_until(deadline_ns: int) -> None:
    """Sleep to a deadline on the monotonic clock; returns at once when it has passed."""
    left = deadline_ns - time.monotonic_ns()
    if left > 0:
        time.sleep(left * 1e-9)


def privileges() -> dict[str, tuple[bool, str]]:
    """What this machine grants: name -> (granted, what to do if not). Changes nothing for good."""
    return {
        "timer slack": (_in_child(set_timer_slack), "needs Linux with prctl"),
        "SCHED_FIFO": (
            _in_child(lambda: set_fifo(10)),
            "add '@realtime - rtprio 95' to /etc/security/limits.conf and join that group",
        ),
        "memory locking": (
            _in_child(lock_memory),
            "add '@realtime - memlock unlimited' to /etc/security/limits.conf",
        ),
    }


def _in_child(attempt: Callable[[], bool]) -> bool:
    pid = os.fork()
    if pid == 0:
        granted = False
        with contextlib.suppress(BaseException):
            granted = bool(attempt())
        os._exit(0 if granted else 1)
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0
