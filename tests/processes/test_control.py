"""The control channel takes checked messages from those it knows and survives everybody else."""

from __future__ import annotations

import contextlib
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgpack
import pytest
import zmq
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.messages.test_transport import PATIENCE_S, free_port
from vibrissa.messages.errors import DecodeError, TransportError
from vibrissa.processes.control import ControlDesk, ControlLine, pack, unpack

GOOD = [
    {"kind": "hello", "pid": 7, "missing": ["SCHED_FIFO"]},
    {"kind": "ready"},
    {"kind": "beat", "t": 5, "steps": 6, "done": False},
    {"kind": "fault", "cause": "because"},
    {"kind": "go", "t0_ns": 2**60},
    {"kind": "leave"},
]


@pytest.mark.parametrize("message", GOOD, ids=lambda m: m["kind"])
def test_a_message_comes_out_as_it_went_in(message: dict[str, Any]) -> None:
    fields = {name: value for name, value in message.items() if name != "kind"}
    assert unpack(pack(message["kind"], **fields)) == message


@pytest.mark.parametrize("message", GOOD, ids=lambda m: m["kind"])
def test_what_is_missing_added_or_of_another_kind_is_refused(message: dict[str, Any]) -> None:
    wrong = [message | {"extra": 1}, message | {"kind": "other"}, message | {"kind": ["beat"]}]
    wrong += [{k: v for k, v in message.items() if k != name} for name in message]
    wrong += [message | {name: None} for name in message]
    wrong += [message | {name: True} for name, value in message.items() if type(value) is int]
    for changed in wrong:
        with pytest.raises(DecodeError) as caught:
            unpack(msgpack.packb(changed))
        assert str(caught.value).isprintable()


KEYS = st.text(max_size=5)
TREES = st.recursive(
    st.none() | st.integers(0, 9) | KEYS | st.binary(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(KEYS, inner, max_size=4),
)


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=100) | TREES.map(msgpack.packb))
def test_random_messages_are_refused(raw: bytes) -> None:
    with pytest.raises(DecodeError) as caught:
        unpack(raw)
    assert str(caught.value).isprintable() and len(str(caught.value)) < 200


def test_an_oversized_message_is_refused() -> None:
    with pytest.raises(DecodeError, match="at most"):
        unpack(pack("fault", cause="x" * (1 << 20)))


@pytest.fixture(params=["ipc", "tcp"])
def endpoint(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    if request.param == "ipc":
        return f"ipc://{tmp_path}/control"
    return f"tcp://127.0.0.1:{free_port()}"


@pytest.fixture
def context() -> Iterator[zmq.Context[zmq.Socket[bytes]]]:
    made: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    yield made
    made.destroy(linger=0)


def test_both_ends_talk(endpoint: str, context: zmq.Context[zmq.Socket[bytes]]) -> None:
    desk, line = ControlDesk(context, endpoint), ControlLine(context, endpoint, "rig")
    line.say("ready")
    assert desk.hear(PATIENCE_S) == ("rig", {"kind": "ready"})
    desk.say("rig", "leave")
    assert line.hear(PATIENCE_S) == {"kind": "leave"}
    assert desk.hear(0) is None and line.hear(0) is None
    desk.say("nobody", "leave")  # who is not there is not waited for
    line.close()
    desk.close()


def test_a_desk_that_is_taken_is_refused(
    endpoint: str, context: zmq.Context[zmq.Socket[bytes]]
) -> None:
    desk = ControlDesk(context, endpoint)
    with pytest.raises(TransportError, match="in use") as caught:
        ControlDesk(context, endpoint)
    assert endpoint in str(caught.value)
    desk.close()


@pytest.mark.parametrize("bad", ["tcp://0.0.0.0:5790", "tcp://10.1.1.1:5790", "nonsense", ""])
def test_an_endpoint_beyond_this_machine_is_refused(
    bad: str, context: zmq.Context[zmq.Socket[bytes]]
) -> None:
    with pytest.raises(TransportError):
        ControlDesk(context, bad)
    with pytest.raises(TransportError):
        ControlLine(context, bad, "rig")


def test_strangers_do_no_harm(endpoint: str, context: zmq.Context[zmq.Socket[bytes]]) -> None:
    desk, line = ControlDesk(context, endpoint), ControlLine(context, endpoint, "rig")
    strangers: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    line.say("ready")
    assert desk.hear(PATIENCE_S) == ("rig", {"kind": "ready"})
    said: list[list[bytes]] = [
        [b""], [b"\x00"], [b"x" * 100], [b"a", b"b", b"c"], [b"", pack("ready")],
        [pack("ready")], [msgpack.packb({"kind": "beat"})], [b"\xc1" * 5000],
    ]  # fmt: skip
    try:
        for kind, name in (
            (zmq.DEALER, b"\xff\xfe"),
            (zmq.DEALER, b"rig"),
            (zmq.REQ, b"q"),
            (zmq.PUB, b"p"),
        ):
            stranger = strangers.socket(kind)
            stranger.set(zmq.IDENTITY, name)
            stranger.set(zmq.LINGER, 0)
            stranger.set(zmq.SNDTIMEO, 100)
            stranger.connect(endpoint)
            for parts in said:
                with contextlib.suppress(zmq.ZMQError):
                    stranger.send_multipart(parts)
        _raw(endpoint, b"GET / HTTP/1.0\r\n\r\n" * 20)
        _raw(endpoint, b"\xff" + bytes(8) + b"\x7f" * 2000)
        heard: list[str] = []
        deadline = time.monotonic() + PATIENCE_S
        line.say("beat", t=1, steps=2, done=False)
        while "rig" not in heard or time.monotonic() < deadline - PATIENCE_S + 0.5:
            assert time.monotonic() < deadline, "the process is not heard any more"
            try:
                taken = desk.hear(0.05)
            except DecodeError as error:
                assert str(error).isprintable()
                continue
            if taken is not None:
                heard.append(taken[0])
                if taken[0] == "rig":
                    assert taken[1] == {"kind": "beat", "t": 1, "steps": 2, "done": False}
        assert heard.count("rig") == 1  # nobody can speak in the name of one who is there
        desk.say("rig", "leave")
        assert line.hear(PATIENCE_S) == {"kind": "leave"}
    finally:
        strangers.destroy(linger=0)
        line.close()
        desk.close()


def _raw(endpoint: str, data: bytes) -> None:
    """Bytes on a bare stream to an endpoint, below ZeroMQ."""
    with contextlib.suppress(OSError):
        if endpoint.startswith("ipc://"):
            stream = socket.socket(socket.AF_UNIX)
            stream.connect(endpoint.removeprefix("ipc://"))
        else:
            stream = socket.create_connection(("127.0.0.1", int(endpoint.rpartition(":")[2])))
        with stream:
            stream.sendall(data)
