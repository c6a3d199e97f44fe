"""Fuzzing of everything that reads bytes: `python -m vibrissa.rig.devices.fuzz --frames N`.

Frames, whole and mutilated, go to the parsers of the drivers and to the emulators' ears: the head's
serial framing both ways, its CAN frames both ways, the RTDE packets both ways and the dashboard.
Mutations that make a target count something new are kept and mutated further; with --coverage also
those that reach a new branch of the devices' code. Fails on an exception, on memory that grows and
on a target that takes too long.
"""

from __future__ import annotations

import argparse
import random
import resource
import signal
import struct
import sys
import time
from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any, Final

from vibrissa.rig.devices import can_layout, protocol, ur10
from vibrissa.rig.devices.framing import FrameParser, frame
from vibrissa.rig.devices.protocol import (
    Command,
    FromHost,
    Hello,
    HelloPlease,
    RawSample,
    Start,
    Stop,
)
from vibrissa.rig.devices.rtde_emulator import Dashboard, Session
from vibrissa.rig.devices.rtde_robot import Robot
from vibrissa.rig.devices.rtde_wire import (
    CONTROLLER,
    DATA,
    INPUTS,
    OUTPUTS,
    START,
    VERSION,
    PacketParser,
    packet,
)

PACKAGE: Final = str(Path(protocol.__file__).parent)
KEPT: Final = 2000
"""Interesting inputs kept per target."""
GROWTH_KB: Final = 64 << 10
SLOW_S: Final = 60.0
START_POSE: Final = (0.63, 0.09, 0.177, 0.0)
HELLO: Final = Hello(7, 1, (1, 0, 0), "FUZZ")
SAMPLES: Final = (
    RawSample(3, 1500, 2, 0, bytes(range(108))),
    RawSample(2**32 - 1, 0, protocol.NO_ANSWER, 1, bytes(108)),
)
UP: Final = (HELLO, *SAMPLES)
DOWN: Final[tuple[FromHost, ...]] = (
    HelloPlease(7),
    Start(1),
    Start(5),
    Stop(),
    Command(9, bytes(range(36))),
)


@dataclass
class Target:
    """Something that takes bytes, and what it was taught to take.

    hear takes one input and says what kind of thing came of it.
    """

    name: str
    hear: Callable[[bytes], Hashable]
    seeds: Sequence[bytes]
    frames: int = 0
    seen: set[Hashable] = field(default_factory=set)
    pool: list[bytes] = field(default_factory=list)


def targets() -> list[Target]:
    """Fresh targets."""
    frames = [f for item in SAMPLES for f in can_layout.pack_sample(item)]
    frames += can_layout.pack_hello(HELLO)
    lines = [b"robotmode", b"PolyscopeVersion", b"is in remote control", b"quit", b"\xff\0"]
    return [
        _framed("serial up", protocol.unpack_from_head, [protocol.pack_from_head(i) for i in UP]),
        _framed(
            "serial down", protocol.unpack_from_host, [protocol.pack_from_host(i) for i in DOWN]
        ),
        _can("can up", can_layout.Assembler().take, frames),
        _can("can down", can_layout.unpack_from_host, [can_layout.pack_from_host(i) for i in DOWN]),
        _rtde_client(),
        _rtde_server(),
        Target("dashboard", _dashboard(), lines),
    ]


def _framed(name: str, unpack: Callable[[bytes], object], messages: Iterable[bytes]) -> Target:
    parser = FrameParser()

    def hear(data: bytes) -> Hashable:
        before = parser.crc_errors, parser.resyncs
        found = tuple(type(unpack(message)).__name__ for message in parser.feed(data))
        return found[:3], parser.crc_errors - before[0] > 0, parser.resyncs - before[1] > 0

    return Target(name, hear, [frame(m) for m in messages])


def _can(
    name: str, take: Callable[[tuple[int, bytes]], object], frames: Iterable[tuple[int, bytes]]
) -> Target:
    def hear(data: bytes) -> Hashable:
        if len(data) < 2:
            return None
        item = take((struct.unpack_from("<H", data)[0] & 0x7FF, data[2:66]))
        return type(item).__name__

    seeds = [struct.pack("<H", i) + data for i, data in frames]
    return Target(name, hear, seeds)


def _rtde_client() -> Target:
    state = {"parser": PacketParser()}

    def hear(data: bytes) -> Hashable:
        found = state["parser"].feed(data)
        if found is None:
            state["parser"] = PacketParser()
            return None
        return tuple(p.type for p in found[:3])

    return Target("rtde up", hear, [packet(DATA, bytes(60)), packet(VERSION, b"\x01")])


def _rtde_server() -> Target:
    version = (3, 15, 8, 0)
    robot = Robot(ur10.Mount(), START_POSE, 0.008)
    state = {"session": Session(robot, version)}

    def hear(data: bytes) -> Hashable:
        session = state["session"]
        answer = session.hear(data)
        if answer is None:
            state["session"] = Session(robot, version)
            return None
        if robot.runtime != 2:
            robot.unlock()
            robot.play()
        robot.step()
        return answer[2:3], len(session.data()) > 0, robot.runtime, robot.safety

    doubles = b",".join(b"input_double_register_%d" % k for k in range(11))
    servo = struct.pack(">i11d", 24, *ur10.Mount().tcp(START_POSE), 0, 0, 0.008, 0.03, 300)
    seeds = [
        packet(VERSION, b"\0\x02"),
        packet(CONTROLLER),
        packet(OUTPUTS, struct.pack(">d", 125.0) + b"timestamp,actual_q,actual_TCP_pose,"),
        packet(INPUTS, b"input_int_register_0," + doubles + b","),
        packet(START),
        packet(DATA, b"\x01" + servo),
        packet(DATA, b"\x01" + struct.pack(">i11d", 35, 10.0, *(0.0,) * 10)),
    ]
    return Target("rtde down", hear, [b"".join(seeds), *seeds])


def _dashboard() -> Callable[[bytes], Hashable]:
    robot = Robot(ur10.Mount(), START_POSE, 0.008)
    dashboard = Dashboard(robot, (3, 15, 8, 0))
    return lambda line: dashboard.answer(line.decode(errors="replace"))[:20]


def mutate(data: bytes, other: bytes, rng: random.Random) -> bytes:
    """Something like `data`: bits flipped, pieces cut, doubled, replaced, joined with `other`."""
    kind = rng.randrange(7)
    at = rng.randrange(len(data) + 1)
    if kind == 0 and data:
        hurt = bytearray(data)
        for _ in range(rng.randrange(1, 4)):
            hurt[rng.randrange(len(hurt))] ^= 1 << rng.randrange(8)
        return bytes(hurt)
    if kind == 1:
        return data[:at]
    if kind == 2:
        return data[at:] + other
    if kind == 3:
        return data[:at] + rng.randbytes(rng.randrange(1, 9)) + data[at:]
    if kind == 4:
        return data[:at] + other[rng.randrange(len(other) + 1) :]
    if kind == 5:
        return data[:at] + bytes((rng.choice((0, 1, 255)),)) * rng.randrange(1, 40) + data[at:]
    return data


class Branches:
    """Branches of this package that a call takes: pairs of lines, one after the other."""

    def __init__(self) -> None:
        self.taken: set[tuple[int, int, int]] = set()
        self._last = 0

    def new(self, hear: Callable[[bytes], Hashable], data: bytes) -> tuple[Hashable, bool]:
        """The answer to `data`, and whether a branch was taken for the first time."""
        known = len(self.taken)
        before = sys.gettrace()
        sys.settrace(self._call)
        try:
            answer = hear(data)
        finally:
            sys.settrace(before)
        return answer, len(self.taken) > known

    def _call(self, frame: FrameType, _event: str, _argument: object) -> Any:
        ours = frame.f_code.co_filename.startswith(PACKAGE)
        self._last = 0
        return self._line if ours else None

    def _line(self, frame: FrameType, _event: str, _argument: object) -> Any:
        line = frame.f_lineno
        self.taken.add((id(frame.f_code), self._last, line))
        self._last = line
        return self._line


def run(
    frames: int,
    seed: int = 0,
    report: Callable[[str], None] = print,
    *,
    coverage: bool = False,
) -> None:
    """Feed so many frames, spread over all targets. Raises what a target raises, or MemoryError
    and TimeoutError when one grows or dawdles.

    coverage: keep what reaches a new branch, too; several times slower.
    """
    branches = Branches() if coverage else None
    signal.signal(signal.SIGVTALRM, _hung)
    rng = random.Random(seed)
    everybody = targets()
    begun = time.monotonic()
    floor = 0
    share, step = frames // len(everybody) + 1, 20_000
    while any(target.frames < share for target in everybody):
        for target in everybody:
            signal.setitimer(signal.ITIMER_VIRTUAL, SLOW_S)
            _spell(target, min(step, share - target.frames), rng, branches)
        used = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        floor = floor or used
        if used - floor > GROWTH_KB:
            raise MemoryError(f"fuzz: grew by {used - floor} kB")
    signal.setitimer(signal.ITIMER_VIRTUAL, 0.0)
    total = sum(target.frames for target in everybody)
    for target in everybody:
        report(
            f"{target.name:12} {target.frames:>10} frames, {len(target.seen):>5} kinds of answer"
        )
    if branches is not None:
        report(f"{len(branches.taken)} branches taken")
    seconds = time.monotonic() - begun
    report(f"{total} frames in {seconds:.1f} s, no crash, no hang, memory within {GROWTH_KB} kB")


def _hung(*_: object) -> None:
    raise TimeoutError(f"fuzz: a spell took more than {SLOW_S:g} s of processor time")


def _spell(
    target: Target, count: int, rng: random.Random, branches: Branches | None = None
) -> None:
    pool, seen, hear = target.pool or list(target.seeds), target.seen, target.hear
    for _ in range(count):
        data = mutate(rng.choice(pool), rng.choice(pool), rng)[:2048]
        try:
            if branches is None:
                answer, fresh = hear(data), False
            else:
                answer, fresh = branches.new(hear, data)
        except BaseException:
            sys.stderr.write(f"fuzz: {target.name}: failed on {data.hex()}\n")
            raise
        if (fresh or answer not in seen) and len(pool) < KEPT:
            seen.add(answer)
            pool.append(data)
    target.pool = pool
    target.frames += count


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description="Fuzz the devices' parsers and emulators.")
    parser.add_argument("--frames", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--coverage", action="store_true", help="be guided by branches, too")
    arguments = parser.parse_args()
    run(arguments.frames, arguments.seed, coverage=arguments.coverage)


if __name__ == "__main__":
    main()
