"""How frames get from one process to the others: ZeroMQ between processes, memory inside one.

A `Port` is a process's side of the bus: it publishes its own frames and receives what it
subscribed to. Both kinds keep each publisher's order, never drop a frame, and know who listens, so
that nothing is sent before everybody can hear it.

Waking a process costs more than carrying a message. Listeners that need no frame at once (the
recorder, slam) therefore ask for bundles: a publisher sends them everything it said in the last few
milliseconds as one message, and a frame goes out alone only to those who must react to it.
"""

from __future__ import annotations

import collections
import ipaddress
import os
import re
import select
import socket
from collections.abc import Iterable, Mapping
from typing import Final, Protocol

import msgpack
import zmq

from vibrissa.messages.codec import MAX_FRAME_BYTES
from vibrissa.messages.errors import DecodeError, TransportError
from vibrissa.messages.topics import TOPICS

BUNDLE: Final = "bundle"
"""Not a topic of the table: what a bundled listener subscribes to."""
_BUNDLE_PREFIX: Final = b"bundle\0"
_TCP: Final = re.compile(r"tcp://(?:\[([^\[\]]+)\]|([^\[\]:/;@]+)):(\d{1,5})")


class Port(Protocol):
    """One process's side of the bus."""

    def publish(self, frame: bytes) -> None:
        """Send a frame to everybody who subscribed to its topic. Never blocks, never drops."""

    def flush(self) -> None:
        """Send what was published since the last flush to those who listen in bundles."""

    def receive(self, timeout: float) -> bytes | None:
        """The next frame, or None after `timeout` seconds; 0 looks without waiting."""

    def subscribers(self) -> Mapping[str, int]:
        """How many listeners each published topic has by now."""

    def close(self) -> None:
        """Deliver what is still on its way to running listeners, then let go."""


class ZmqPort:
    """A bus over ZeroMQ PUB/SUB: binds one publishing endpoint, connects to the others'."""

    def __init__(
        self,
        context: zmq.Context[zmq.Socket[bytes]],
        endpoint: str,
        topics: Iterable[str] = (),
        connect: Iterable[str] = (),
        *,
        bundled: bool = False,
        linger_ms: int = 2000,
    ) -> None:
        """Bind `endpoint` and subscribe to `topics` at the endpoints in `connect`.

        Raises TransportError when an endpoint is in use, malformed or not on this machine.
        """
        self._subscribers: collections.Counter[str] = collections.Counter()
        self._heard: set[bytes] = set()
        self._bundling = False
        self._waited_ms = -1
        self._poller: select.poll | None = None
        self._waiting_for = -1
        self._topics = {topic.encode() for topic in topics}
        self._bundled = bundled
        self._unbundled: collections.deque[bytes] = collections.deque()
        self._bundle: list[bytes] = []
        self._out = context.socket(zmq.XPUB)
        self._in = context.socket(zmq.SUB)
        try:
            self._out.set(zmq.XPUB_VERBOSER, 1)
            self._out.set(zmq.SNDHWM, 0)
            self._out.set(zmq.MAXMSGSIZE, 1 << 12)  # of what comes in here: subscriptions
            self._out.set(zmq.LINGER, linger_ms)
            self._in.set(zmq.RCVHWM, 0)
            self._in.set(zmq.LINGER, 0)
            self._in.set(zmq.RECONNECT_IVL, 100)  # ms; an endpoint may be bound later
            self._in.set(zmq.MAXMSGSIZE, 4 * MAX_FRAME_BYTES)
            bind(self._out, endpoint)
            for topic in [BUNDLE.encode()] if bundled else sorted(self._topics):
                self._in.subscribe(topic + b"\0")
            for other in connect:
                check_endpoint(other)
                try:
                    self._in.connect(other)
                except zmq.ZMQError as error:
                    raise TransportError(f"can't connect to {other}: {error.strerror}") from None
        except Exception:
            self.close()
            raise

    def publish(self, frame: bytes) -> None:
        if frame[: frame.find(b"\0")] in self._heard:
            self._out.send(frame, zmq.NOBLOCK)
        if self._bundling:
            self._bundle.append(frame)

    def flush(self) -> None:
        if self._bundle:
            self._out.send(_BUNDLE_PREFIX + msgpack.packb(self._bundle), zmq.NOBLOCK)
            self._bundle.clear()

    def receive(self, timeout: float) -> bytes | None:
        if not self._bundled:
            return self._receive(timeout)
        while not self._unbundled:
            bundle = self._receive(timeout)
            if bundle is None:
                return None
            self._unbundle(bundle)
        return self._unbundled.popleft()

    def wait(self, other: int, timeout: float) -> None:
        """Until a frame or the file descriptor `other` can be read, or whole ms of `timeout` s.

        libzmq's own descriptor tells of a change only, so the socket is asked before anybody sleeps
        on it.
        """
        if self._poller is None or other != self._waiting_for:
            self._poller, self._waiting_for = select.poll(), other
            self._poller.register(self._in.fileno(), select.POLLIN)
            if other >= 0:
                self._poller.register(other, select.POLLIN)
        if not int(self._in.get(zmq.EVENTS)) & zmq.POLLIN:
            self._poller.poll(int(timeout * 1000))

    def _unbundle(self, bundle: bytes) -> None:
        try:
            frames = msgpack.unpackb(bundle[len(_BUNDLE_PREFIX) :])
            wanted = [f for f in frames if f[: f.find(b"\0")] in self._topics]
        except Exception:
            raise DecodeError(
                f"bundle: expected a list of frames, found {len(bundle)} bytes that are not"
            ) from None
        self._unbundled.extend(wanted)

    def _receive(self, timeout: float) -> bytes | None:
        milliseconds = int(timeout * 1000)
        try:
            if milliseconds <= 0:
                return self._in.recv(zmq.NOBLOCK)
            if milliseconds != self._waited_ms:
                self._in.set(zmq.RCVTIMEO, milliseconds)
                self._waited_ms = milliseconds
            return self._in.recv()
        except zmq.Again:
            return None

    def subscribers(self) -> Mapping[str, int]:
        while True:
            try:
                note = self._out.recv(zmq.NOBLOCK)
            except zmq.Again:
                return self._subscribers
            topic = note[1:].removesuffix(b"\0").decode(errors="replace")
            if topic != BUNDLE and topic not in TOPICS:
                continue
            if note[:1] == b"\x01":
                self._subscribers[topic] += 1
                self._heard.add(topic.encode())  # for good: a stranger can't unsubscribe others
                self._bundling |= topic == BUNDLE
            elif note[:1] == b"\x00":
                self._subscribers[topic] -= 1

    def close(self) -> None:
        if not self._out.closed:
            self.flush()
        self._in.close()
        self._out.close()


class Hub:
    """Joins `MemoryPort`s of one process."""

    def __init__(self) -> None:
        self._inboxes: dict[str, list[collections.deque[bytes]]] = {}

    def port(self, topics: Iterable[str] = ()) -> MemoryPort:
        """A new port that listens to `topics`."""
        return MemoryPort(self._inboxes, topics)


class MemoryPort:
    """A bus inside one process: a frame is in every listener's inbox when publish returns."""

    def __init__(
        self, inboxes: dict[str, list[collections.deque[bytes]]], topics: Iterable[str]
    ) -> None:
        self._inboxes = inboxes
        self._inbox: collections.deque[bytes] = collections.deque()
        for topic in topics:
            inboxes.setdefault(topic, []).append(self._inbox)

    def publish(self, frame: bytes) -> None:
        for inbox in self._inboxes.get(frame[: frame.find(b"\0")].decode(), ()):
            inbox.append(frame)

    def flush(self) -> None:
        """Nothing is ever held back in memory."""

    def receive(self, timeout: float) -> bytes | None:
        return self._inbox.popleft() if self._inbox else None

    def subscribers(self) -> Mapping[str, int]:
        return {topic: len(inboxes) for topic, inboxes in self._inboxes.items()}

    def close(self) -> None:
        for inboxes in self._inboxes.values():
            inboxes[:] = [inbox for inbox in inboxes if inbox is not self._inbox]


def check_endpoint(endpoint: str) -> None:
    """Refuse what is not on this machine. Raises TransportError."""
    if endpoint.startswith("ipc://"):
        if not 0 < len(os.fsencode(_ipc_path(endpoint))) <= zmq.IPC_PATH_MAX_LEN:
            raise TransportError(
                f"endpoint {endpoint}: expected a path of 1 to {zmq.IPC_PATH_MAX_LEN} bytes"
            )
        return
    address = _TCP.fullmatch(endpoint)
    if address is None or not 0 < int(address[3]) < 2**16:
        raise TransportError(f"endpoint {endpoint}: expected ipc://PATH or tcp://ADDRESS:PORT")
    if not _loopback(address[1] or address[2]):
        raise TransportError(
            f"endpoint {endpoint}: expected an address of this machine (127.x.x.x, localhost, "
            "[::1]); others are refused because traffic is not encrypted"
        )


def bind(publisher: zmq.Socket[bytes], endpoint: str) -> None:
    """Bind a socket to an endpoint of this machine. Raises TransportError, also when in use."""
    check_endpoint(endpoint)
    if endpoint.startswith("ipc://"):  # ZeroMQ would quietly take it from its owner
        with socket.socket(socket.AF_UNIX) as probe:
            if probe.connect_ex(_ipc_path(endpoint)) == 0:
                raise TransportError(f"can't bind {endpoint}: Address already in use")
    try:
        publisher.bind(endpoint)
    except zmq.ZMQError as error:
        raise TransportError(f"can't bind {endpoint}: {error.strerror}") from None


def _ipc_path(endpoint: str) -> str:
    return endpoint.removeprefix("ipc://")


def _loopback(host: str) -> bool:
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
