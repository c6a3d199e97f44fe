"""The bus: every promise of a port holds over ipc, over tcp and in memory, alone and in bundles."""

from __future__ import annotations

import contextlib
import itertools
import socket
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import msgpack
import pytest
import zmq

from vibrissa.messages.errors import DecodeError, TransportError
from vibrissa.messages.topics import TOPICS
from vibrissa.messages.transport import BUNDLE, Hub, Port, ZmqPort, check_endpoint

pytestmark = pytest.mark.live

PATIENCE_S = 20.0
"""How long a test waits for something that must happen; never asserted."""


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        number: int = probe.getsockname()[1]
        return number


class Bus:
    """Ports of one kind, joined: every listener hears every speaker."""

    def __init__(self, kind: str, folder: Path) -> None:
        self.kind = kind
        self._folder = folder
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._hub = Hub()
        self._ports: list[Port] = []
        self._endpoints: list[str] = []
        self._listening: dict[str, int] = {}

    def endpoint(self) -> str:
        if self.kind == "tcp":
            return f"tcp://127.0.0.1:{free_port()}"
        return f"ipc://{self._folder}/{len(self._ports)}"

    def speaker(self) -> Port:
        return self._add(self._hub.port() if self.kind == "memory" else self._zmq())

    def listener(self, *topics: str) -> Port:
        if self.kind == "memory":
            return self._add(self._hub.port(topics))
        bundled = self.kind == "bundled"
        return self._add(self._zmq(topics, connect=self._endpoints[:], bundled=bundled))

    def _zmq(
        self, topics: Sequence[str] = (), connect: Sequence[str] = (), bundled: bool = False
    ) -> Port:
        endpoint = self.endpoint()
        port = ZmqPort(self._context, endpoint, topics, connect, bundled=bundled)
        self._endpoints.append(endpoint)
        return port

    def _add(self, port: Port) -> Port:
        self._ports.append(port)
        return port

    def hears(self, topic: str) -> str:
        """What a publisher is told when somebody listens to a topic."""
        return BUNDLE if self.kind == "bundled" else topic

    def wait(self, speaker: Port, **listeners: int) -> None:
        """Until a speaker knows so many listeners of each topic (its dots as underscores)."""
        wanted = {self.hears(name.replace("_", ".")): n for name, n in listeners.items()}
        until(lambda: all(speaker.subscribers().get(t, 0) == n for t, n in wanted.items()))

    def close(self) -> None:
        for port in self._ports:
            port.close()
        self._context.destroy(linger=0)


def until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.002)


def take(port: Port, count: int) -> list[bytes]:
    """The next frames, as many as asked for."""
    frames = []
    while len(frames) < count:
        frame = port.receive(PATIENCE_S)
        assert frame is not None, f"{len(frames)} of {count} frames arrived"
        frames.append(frame)
    return frames


def says(topic: str, number: int, speaker: int = 0) -> bytes:
    return topic.encode() + b"\0" + msgpack.packb([speaker, number])


@pytest.fixture(params=["ipc", "tcp", "bundled", "memory"])
def bus(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Bus]:
    made = Bus(request.param, tmp_path)
    yield made
    made.close()


@pytest.fixture(params=["ipc", "tcp"])
def zmq_bus(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Bus]:
    made = Bus(request.param, tmp_path)
    yield made
    made.close()


def test_the_order_of_every_publisher_is_kept(bus: Bus) -> None:
    speakers = [bus.speaker() for _ in range(3)]
    listener = bus.listener("head.sample", "arm.state")
    for speaker in speakers:
        bus.wait(speaker, head_sample=1)
    for number in range(1000):
        for index, speaker in enumerate(speakers):
            speaker.publish(says("arm.state" if number % 7 == 0 else "head.sample", number, index))
            if number % 50 == 0:
                speaker.flush()
    for speaker in speakers:
        speaker.flush()
    heard = [msgpack.unpackb(f[f.find(b"\0") + 1 :]) for f in take(listener, 3000)]
    for index in range(3):
        assert [number for who, number in heard if who == index] == list(range(1000))
    assert listener.receive(0) is None


def test_nothing_of_a_flood_is_lost_on_the_way_to_two_listeners(bus: Bus) -> None:
    speaker = bus.speaker()
    listeners = [bus.listener("head.sample"), bus.listener("head.sample", "arm.state")]
    bus.wait(speaker, head_sample=2)
    sent = [says("head.sample", number) + bytes(300) for number in range(20_000)]
    for index, frame in enumerate(sent):
        speaker.publish(frame)  # nobody takes anything meanwhile
        if index % 20 == 0:
            speaker.flush()
    speaker.flush()
    for listener in listeners:
        assert take(listener, len(sent)) == sent
        assert listener.receive(0) is None


def test_a_listener_hears_its_topics_and_no_others(bus: Bus) -> None:
    speaker = bus.speaker()
    one, other = bus.listener("arm.state", "run.event"), bus.listener("arm.setpoint")
    bus.wait(speaker, arm_state=2 if bus.kind == "bundled" else 1)
    bus.wait(speaker, arm_setpoint=2 if bus.kind == "bundled" else 1)
    for topic in TOPICS:
        speaker.publish(says(topic, 1))
    speaker.publish(says("run.event", 2))
    speaker.publish(says("arm.setpoint", 2))
    speaker.flush()
    wanted = [t for t in TOPICS if t in ("arm.state", "run.event")]
    assert take(one, 3) == [says(t, 1) for t in wanted] + [says("run.event", 2)]
    assert take(other, 2) == [says("arm.setpoint", 1), says("arm.setpoint", 2)]
    assert one.receive(0) is None and other.receive(0) is None


def test_a_topic_that_begins_like_another_does_not_leak_into_it(bus: Bus) -> None:
    speaker = bus.speaker()
    listener = bus.listener("head.sample", "whisk.c")
    bus.wait(speaker, head_sample=1)
    for topic in ("head.sampled", "head.sample", "head.sampl", "whisk.command", "whisk.cycle"):
        speaker.publish(says(topic, 1))
    speaker.publish(says("head.sample", 2))
    speaker.flush()
    assert take(listener, 2) == [says("head.sample", 1), says("head.sample", 2)]
    assert listener.receive(0.05) is None


def test_a_publisher_knows_how_many_listen_to_each_topic(bus: Bus) -> None:
    speaker = bus.speaker()
    assert not any(speaker.subscribers().values())
    first = bus.listener("head.sample", "arm.state")
    second = bus.listener("head.sample")
    third = bus.listener("head.sample")
    bus.wait(speaker, head_sample=3)
    assert speaker.subscribers().get(bus.hears("arm.state"), 0) == (
        3 if bus.kind == "bundled" else 1
    )
    assert speaker.subscribers().get("run.event", 0) == 0
    second.close()
    bus.wait(speaker, head_sample=2)
    third.close()
    bus.wait(speaker, head_sample=1)
    first.close()
    bus.wait(speaker, head_sample=0, arm_state=0)


def test_those_who_stay_hear_on_when_others_leave(bus: Bus) -> None:
    speaker = bus.speaker()
    stays, leaves = bus.listener("head.sample"), bus.listener("head.sample")
    bus.wait(speaker, head_sample=2)
    speaker.publish(says("head.sample", 1))
    speaker.flush()
    assert take(leaves, 1) == [says("head.sample", 1)]
    leaves.close()
    bus.wait(speaker, head_sample=1)
    speaker.publish(says("head.sample", 2))
    speaker.flush()
    assert take(stays, 2) == [says("head.sample", 1), says("head.sample", 2)]


def test_publishing_to_nobody_does_not_block_and_keeps_nothing(bus: Bus) -> None:
    speaker = bus.speaker()
    for number in range(5000):
        speaker.publish(says("head.sample", number))
    speaker.flush()
    late = bus.listener("head.sample")
    bus.wait(speaker, head_sample=1)
    speaker.publish(says("head.sample", 5000))
    speaker.flush()
    assert take(late, 1) == [says("head.sample", 5000)]


def test_a_look_without_waiting_and_a_wait_that_ends_give_nothing(bus: Bus) -> None:
    speaker = bus.speaker()
    listener = bus.listener("head.sample")
    for timeout in (0.0, 0.01, 0.0, 0.02):
        assert listener.receive(timeout) is None
    bus.wait(speaker, head_sample=1)
    speaker.publish(says("head.sample", 1))
    speaker.flush()
    assert take(listener, 1) == [says("head.sample", 1)]
    assert listener.receive(0.01) is None


def test_what_was_published_before_a_close_still_arrives(bus: Bus) -> None:
    speaker = bus.speaker()
    listener = bus.listener("head.sample")
    bus.wait(speaker, head_sample=1)
    sent = [says("head.sample", number) + bytes(1000) for number in range(2000)]
    for frame in sent:
        speaker.publish(frame)
    speaker.close()
    assert take(listener, len(sent)) == sent


def test_a_closed_port_may_be_closed_again(bus: Bus) -> None:
    listener = bus.listener("head.sample")
    listener.close()
    listener.close()


@pytest.mark.parametrize(
    "endpoint",
    [
        "tcp://0.0.0.0:5790",
        "tcp://*:5790",
        "tcp://192.168.0.7:5790",
        "tcp://8.8.8.8:53",
        "tcp://example.org:5790",
        "tcp://localhost.example.org:5790",
        "tcp://127.0.0.1.example.org:5790",
        "tcp://user@192.168.0.7:5790",
        "tcp://127.0.0.1@192.168.0.7:5790",
        "tcp://127.0.0.1:0;192.168.0.7:5790",
        "tcp://[::]:5790",
        "tcp://[2001:db8::1]:5790",
        "tcp://eth0:5790",
    ],
)
def test_an_endpoint_beyond_this_machine_is_refused(endpoint: str, tmp_path: Path) -> None:
    assert_refused(endpoint, tmp_path)


@pytest.mark.parametrize(
    "endpoint",
    [
        "",
        "nonsense",
        "ipc",
        "ipc://",
        "tcp://",
        "tcp://127.0.0.1",
        "tcp://127.0.0.1:",
        "tcp://127.0.0.1:port",
        "tcp://127.0.0.1:99999",
        "tcp://127.0.0.1:-5",
        "tcp://[::1",
        "tcp:///127.0.0.1:5790",
        "udp://127.0.0.1:5790",
        "inproc://name",
        "pgm://127.0.0.1:5790",
        "http://127.0.0.1:5790",
        "ipc://" + "x" * 200,
        "ipc:///no/such/directory/socket",
    ],
)
def test_a_malformed_endpoint_is_refused(endpoint: str, tmp_path: Path) -> None:
    assert_refused(endpoint, tmp_path, connecting="directory" not in endpoint)


def assert_refused(endpoint: str, tmp_path: Path, *, connecting: bool = True) -> None:
    """To bind it and to connect to it raise a one-line TransportError that names it."""
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    good = f"ipc://{tmp_path}/good"
    attempts = [(endpoint, [])] + ([(good, [endpoint])] if connecting else [])
    try:
        for bound, connect in attempts:
            with pytest.raises(TransportError) as caught:
                ZmqPort(context, bound, ["head.sample"], connect).close()
            assert str(caught.value).isprintable() and endpoint in str(caught.value)
    finally:
        context.destroy(linger=0)


@pytest.mark.parametrize(
    "endpoint", ["tcp://127.0.0.1:5790", "tcp://127.1.2.3:80", "tcp://[::1]:5790", "ipc:///tmp/x"]
)
def test_endpoints_on_this_machine_are_allowed(endpoint: str) -> None:
    check_endpoint(endpoint)


def test_an_endpoint_in_use_is_refused_and_its_owner_not_disturbed(zmq_bus: Bus) -> None:
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    endpoint = zmq_bus.endpoint()
    owner = ZmqPort(context, endpoint)
    listener = ZmqPort(
        context, zmq_bus.endpoint() + "b" * (zmq_bus.kind == "ipc"), ["run.event"], [endpoint]
    )
    try:
        until(lambda: owner.subscribers().get("run.event", 0) == 1)
        with pytest.raises(TransportError, match="in use") as caught:
            ZmqPort(context, endpoint)
        assert endpoint in str(caught.value)
        owner.publish(says("run.event", 1))
        assert take(listener, 1) == [says("run.event", 1)]
    finally:
        owner.close()
        listener.close()
        context.destroy(linger=0)


def test_a_bundle_that_is_none_is_refused_by_name(tmp_path: Path) -> None:
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    publisher = context.socket(zmq.XPUB)
    publisher.bind(f"ipc://{tmp_path}/rogue")
    listener = ZmqPort(
        context, f"ipc://{tmp_path}/own", ["run.event"], [f"ipc://{tmp_path}/rogue"], bundled=True
    )
    try:
        assert publisher.recv() == b"\x01" + BUNDLE.encode() + b"\0"
        for garbage in (
            b"",
            b"\xc1",
            b"\x01",
            msgpack.packb([1]),
            msgpack.packb({1: 2}),
            b"\xdd\xff",
        ):
            publisher.send(BUNDLE.encode() + b"\0" + garbage)
            with pytest.raises(DecodeError, match="bundle: expected a list of frames"):
                take(listener, 1)
        publisher.send(BUNDLE.encode() + b"\0" + msgpack.packb([says("run.event", 1)]))
        assert take(listener, 1) == [says("run.event", 1)]
    finally:
        listener.close()
        publisher.close()
        context.destroy(linger=0)


GARBAGE = (b"", b"\0", b"\x01", b"\x00\xff\xfe", b"\x01" + b"x" * 100_000, b"\x02hello", b"GET /")


def test_strangers_do_no_harm_to_a_publisher(zmq_bus: Bus) -> None:
    speaker = zmq_bus.speaker()
    endpoint = zmq_bus._endpoints[0]
    listener = zmq_bus.listener("head.sample")
    zmq_bus.wait(speaker, head_sample=1)
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    numbers = itertools.count()

    def still_heard() -> None:
        number = next(numbers)
        speaker.publish(says("head.sample", number))
        assert take(listener, 1) == [says("head.sample", number)]

    try:
        with contextlib.ExitStack() as stack:
            stack.enter_context(_raw_connection(endpoint)).sendall(b"GET / HTTP/1.1\r\n\r\n" * 50)
            stack.enter_context(_raw_connection(endpoint)).sendall(
                b"\xff" + bytes(8) + b"\x7f" * 5000
            )
            for kind in (zmq.XSUB, zmq.DEALER, zmq.PUB, zmq.REQ):
                stranger = context.socket(kind)
                stranger.set(zmq.LINGER, 0)
                stranger.set(zmq.SNDTIMEO, 200)
                stranger.connect(endpoint)
                for garbage in (*GARBAGE, b"\x01head.sample\0", *[b"\x00head.sample\0"] * 5):
                    with contextlib.suppress(zmq.ZMQError):
                        stranger.send(garbage)
                for _ in range(20):
                    time.sleep(0.005)
                    speaker.subscribers()
                    still_heard()
    finally:
        context.destroy(linger=0)
    for _ in range(20):
        time.sleep(0.005)
        speaker.subscribers()
        still_heard()
    assert listener.receive(0) is None


def test_a_stranger_can_not_unsubscribe_others(zmq_bus: Bus) -> None:
    speaker = zmq_bus.speaker()
    listener = zmq_bus.listener("head.sample")
    zmq_bus.wait(speaker, head_sample=1)
    with _raw_connection(zmq_bus._endpoints[0]) as stranger:
        stranger.sendall(ZMTP_SUBSCRIBER)
        greeting = b""
        while not greeting.endswith(b"XPUB"):
            greeting += stranger.recv(1)
        stranger.sendall(_zmtp(b"\x00head.sample\0") * 5 + _zmtp(b"\x01arm.state\0"))
        zmq_bus.wait(speaker, arm_state=1)  # so the others have been read as well
        speaker.publish(says("head.sample", 1))
        assert take(listener, 1) == [says("head.sample", 1)]


def _zmtp(body: bytes) -> bytes:
    """A message as it travels below ZeroMQ (ZMTP 3.0)."""
    return bytes([0, len(body)]) + body


READY = b"\x05READY\x0bSocket-Type\0\0\0\x03SUB"
ZMTP_SUBSCRIBER = (
    b"\xff" + bytes(8) + b"\x7f\x03\0" + b"NULL".ljust(20, b"\0") + bytes(32)
    + bytes([4, len(READY)]) + READY
)  # fmt: skip
"""What a subscriber says first, after which any message is taken for a subscription."""


@contextlib.contextmanager
def _raw_connection(endpoint: str) -> Iterator[socket.socket]:
    """A bare stream to an endpoint, below ZeroMQ."""
    if endpoint.startswith("ipc://"):
        stream = socket.socket(socket.AF_UNIX)
        stream.connect(endpoint.removeprefix("ipc://"))
    else:
        stream = socket.create_connection(("127.0.0.1", int(endpoint.rpartition(":")[2])))
    with stream:
        yield stream
