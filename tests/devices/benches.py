"""A device of every kind on the bench: how a test opens it, tells it what to suffer, times it."""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from vibrissa.control.kinematics import Float32s
from vibrissa.rig.devices.can_emulator import CanEmulator
from vibrissa.rig.devices.can_head import CanHead
from vibrissa.rig.devices.emulation import EmulatorProcess, head_arguments
from vibrissa.rig.devices.errors import DeviceUnavailable
from vibrissa.rig.devices.head import HeadDevice, Reading
from vibrissa.rig.devices.head_emulator import HeadEmulator
from vibrissa.rig.devices.serial_emulator import SerialEmulator
from vibrissa.rig.devices.serial_head import SerialHead
from vibrissa.rig.devices.virtual_head import VirtualHead

PATIENCE = WAIT_S = 120.0
"""s; a busy machine must not make a test fail."""
ZERO = np.zeros(18, np.float32)
PORT = 20_000 + os.getpid() % 20_000


@dataclass
class HeadBench:
    """make gives a head that is not open yet; ask tells the far end what to do."""

    name: str
    make: Callable[..., HeadDevice]
    ask: Callable[[str], str]
    orders: Sequence[str] = ()
    close: Callable[[], None] = field(default=lambda: None)

    def open(self, patience: float = PATIENCE) -> HeadDevice:
        return self.make(patience=patience)


def virtual_bench() -> HeadBench:
    made: list[VirtualHead] = []

    def make(patience: float) -> HeadDevice:
        head = VirtualHead()
        head._patience = patience
        made.append(head)
        return head

    def ask(order: str) -> str:
        if order == "reset":
            made[-1].reset()
        return "ok"

    return HeadBench("virtual", make, ask, ("reset", "normal"))


def serial_bench(*arguments: str) -> HeadBench:
    emulator = EmulatorProcess("serial", ["--drift", "200", "--jitter", "50", *arguments])
    port = emulator.url.removeprefix("serial:")
    orders = ("errors", "drop", "reset", "unplug", "throttle", "noise", "impostor", "normal")
    return HeadBench(
        "serial",
        lambda patience: SerialHead(port, patience=patience),
        emulator.ask,
        orders,
        emulator.stop,
    )


def can_bench() -> HeadBench:
    channel = str(PORT)
    emulator = EmulatorProcess("can", ["--bus", f"loopback:{channel}", "--drift", "-100"])
    orders = ("errors", "drop", "reset", "unplug", "noise", "impostor", "normal")
    return HeadBench(
        "can-loopback",
        lambda patience: CanHead("loopback", channel, patience=patience),
        emulator.ask,
        orders,
        emulator.stop,
    )


def can_virtual_bench(channel: str = "bench", *arguments: str) -> HeadBench:
    """python-can's virtual bus stays inside one process: the emulator is a thread here."""
    parser = head_arguments("")
    parser.add_argument("--bus")
    emulator = CanEmulator(parser.parse_args(["--bus", f"virtual:{channel}", *arguments]))
    ask, end = in_thread(emulator)

    def close() -> None:
        end()
        emulator.close()

    return HeadBench(
        "can-virtual",
        lambda patience: CanHead("virtual", channel, patience=patience),
        ask,
        ("drop", "reset", "impostor", "normal"),
        close,
    )


def serial_thread_bench(folder: Path, *arguments: str) -> HeadBench:
    """A serial emulator as a thread, where a test needs one of its own."""
    emulator = SerialEmulator(head_arguments("").parse_args(arguments), folder / "head")
    ask, end = in_thread(emulator)
    port = str(folder / "head")
    return HeadBench("serial", lambda patience: SerialHead(port, patience=patience), ask, close=end)


def in_thread(emulator: HeadEmulator) -> tuple[Callable[[str], str], Callable[[], None]]:
    """Let an emulator live in a thread: how to ask it and how to end it."""
    lock = threading.Lock()
    done = threading.Event()

    def live() -> None:
        while not done.is_set():
            with lock:
                emulator.turn()
            time.sleep(min(emulator.clock.wait(), 0.001))

    thread = threading.Thread(target=live, daemon=True)
    thread.start()

    def ask(order: str) -> str:
        with lock:
            return emulator.orders.carry_out(order.split())

    def end() -> None:
        done.set()
        thread.join()

    return ask, end


MAKERS = {
    "virtual": virtual_bench,
    "serial": serial_bench,
    "can-loopback": can_bench,
    "can-virtual": can_virtual_bench,
}


def readings(
    head: HeadDevice, seconds: float = WAIT_S, command: Float32s = ZERO
) -> Iterator[Reading]:
    """Readings as they come, each answered with a command; fails after so long."""
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        reading = head.read(0.05)
        if reading is not None:
            head.write(reading.sample, command)
            yield reading
    raise AssertionError(f"{head.name}: what was waited for did not come: {head.counters}")


def wait_for(
    head: HeadDevice, condition: Callable[[Reading], bool], seconds: float = WAIT_S
) -> Reading:
    """The first reading of which something is true."""
    return next(r for r in readings(head, seconds) if condition(r))


def take(head: HeadDevice, count: int) -> list[Reading]:
    """So many readings."""
    stream = readings(head)
    return [next(stream) for _ in range(count)]


def opened(bench: HeadBench, patience: float) -> HeadDevice:
    """An open head; on a busy machine it may not answer the first time."""
    for _ in range(10):
        with contextlib.suppress(DeviceUnavailable):
            return bench.open(patience).open()
    return bench.open(patience).open()


@contextlib.contextmanager
def streaming(bench: HeadBench, patience: float = PATIENCE) -> Iterator[HeadDevice]:
    """An open head that has begun to stream; the bench is normal again afterwards."""
    bench.ask("normal")
    try:
        with contextlib.closing(opened(bench, patience)) as head:
            take(head, 20)
            yield head
    finally:
        bench.ask("normal")
