"""The control channel between supervisor and processes: a few small, checked messages.

A process says hello, ready, beat, refused, fault, bye; the supervisor says go, finish, leave.
Clients (the command line, scripts) ask and are answered. Every message is a msgpack map
{"kind": ..., ...}. Nothing that changes what a node computes travels here: that goes over
`run.event`, where it is recorded.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Generator, Mapping
from typing import Any

import msgpack
import zmq

from vibrissa.messages.errors import DecodeError, TransportError
from vibrissa.messages.transport import bind, check_endpoint

_FIELDS: dict[str, dict[str, type]] = {
    "hello": {"pid": int, "missing": list},
    "ready": {},
    "beat": {"t": int, "steps": int, "done": bool},
    "fault": {"cause": str},
    "refused": {"source": str, "count": int, "cause": str},
    "bye": {"sent": dict, "stats": dict, "cpu_s": float, "counters": dict},
    "go": {"t0_ns": int},
    "finish": {"sent": dict, "cause": str, "died": str},
    "closed": {"received": dict, "cpu_s": float},
    "leave": {},
    "ask": {"verb": str, "arguments": dict},
    "answer": {"accepted": bool, "text": str, "data": dict},
}
_MAX_BYTES = 1 << 20


def pack(kind: str, **fields: Any) -> bytes:
    """A control message. Its fields are those listed for its kind."""
    assert set(fields) == set(_FIELDS[kind]), (kind, fields)
    packed: bytes = msgpack.packb({"kind": kind, **fields})
    return packed


def unpack(raw: bytes) -> dict[str, Any]:
    """Read a control message. Raises DecodeError for anything but one of the known kinds."""
    if len(raw) > _MAX_BYTES:
        raise DecodeError(f"control: expected at most {_MAX_BYTES} bytes, found {len(raw)}")
    try:
        message = msgpack.unpackb(raw, strict_map_key=True)
        fields = _FIELDS[message["kind"]]
    except Exception:
        raise DecodeError(f"control: expected a message, found {raw[:24]!r}") from None
    for name, kind in fields.items():
        if type(message.get(name)) is not kind:
            raise DecodeError(f"control: {message['kind']}.{name} is not {kind.__name__}")
    if len(message) != len(fields) + 1:
        raise DecodeError(f"control: {message['kind']} has fields it should not have")
    return dict(message)


class ControlLine:
    """A process's end of the control channel."""

    def __init__(self, context: zmq.Context[zmq.Socket[bytes]], endpoint: str, name: str) -> None:
        check_endpoint(endpoint)
        self._socket = context.socket(zmq.DEALER)
        self._socket.set(zmq.IDENTITY, name.encode())
        self._socket.set(zmq.LINGER, 1000)
        self._socket.set(zmq.SNDHWM, 0)
        self._socket.connect(endpoint)

    def say(self, kind: str, **fields: Any) -> None:
        self._socket.send(pack(kind, **fields), zmq.NOBLOCK)

    def hear(self, timeout: float) -> dict[str, Any] | None:
        """The supervisor's next message, or None after `timeout` seconds."""
        if self._socket.poll(int(timeout * 1000)):
            return unpack(self._socket.recv())
        return None

    def close(self) -> None:
        self._socket.close()

    def wait_for_go(
        self, parent: int, subscribers: Callable[[], Mapping[str, int]], wanted: Mapping[str, int]
    ) -> Generator[None, None, int]:
        """Say ready when everybody listens, then wait, a little per turn; ends with t0 in ns.

        Raises SystemExit when the supervisor (process `parent`) is gone or calls the run off.
        """
        told = False
        while True:
            heard = subscribers()
            if not told and all(heard.get(topic, 0) >= n for topic, n in wanted.items()):
                self.say("ready")
                told = True
            order = self.hear(0.02)
            if order and order["kind"] == "go":
                t0_ns: int = order["t0_ns"]
                return t0_ns
            if os.getppid() != parent or (order and order["kind"] == "leave"):
                raise SystemExit(1)
            yield

    def wait_to_leave(self, parent: int) -> None:
        """Until the supervisor (process `parent`) says so or is gone, but not for ever."""
        deadline = time.monotonic() + 15
        while time.monotonic() < deadline and os.getppid() == parent:
            order = self.hear(0.05)
            if order and order["kind"] == "leave":
                break


class ControlDesk:
    """The supervisor's end of the control channel."""

    def __init__(self, context: zmq.Context[zmq.Socket[bytes]], endpoint: str) -> None:
        self._socket = context.socket(zmq.ROUTER)
        self._socket.set(zmq.LINGER, 0)
        self._socket.set(zmq.MAXMSGSIZE, _MAX_BYTES)
        try:
            bind(self._socket, endpoint)
        except TransportError:
            self._socket.close()
            raise

    def say(self, name: str, kind: str, **fields: Any) -> None:
        self._socket.send_multipart([name.encode(), pack(kind, **fields)], zmq.NOBLOCK)

    def hear(self, timeout: float) -> tuple[str, dict[str, Any]] | None:
        """The next (process name, message), or None after `timeout` seconds. Raises DecodeError."""
        if not self._socket.poll(int(timeout * 1000)):
            return None
        name, *rest = self._socket.recv_multipart()
        sender = name.decode(errors="replace")
        if len(rest) != 1:
            raise DecodeError(f"control: expected one part from {sender!r}, found {len(rest)}")
        return sender, unpack(rest[0])

    def close(self) -> None:
        self._socket.close()
