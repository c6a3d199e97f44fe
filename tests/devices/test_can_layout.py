"""The head's messages on CAN FD: frames, database and bus load belong together."""

from __future__ import annotations

import cantools.database
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vibrissa.rig.devices.can_bus import open_bus
from vibrissa.rig.devices.can_database import database
from vibrissa.rig.devices.can_head import CanHead
from vibrissa.rig.devices.can_layout import (
    FRAME_SIZES,
    Assembler,
    bus_load,
    frame_seconds,
    pack_from_host,
    pack_hello,
    pack_sample,
    unpack_from_host,
)
from vibrissa.rig.devices.errors import DeviceAddressError, DeviceRefused
from vibrissa.rig.devices.protocol import Command, Foreign, Hello, HelloPlease, RawSample, Start

HELLO = Hello(7, 9, (1, 2, 3), "VIB-1")
u32 = st.integers(0, 2**32 - 1)
samples = st.builds(
    RawSample, u32, u32, u32, st.integers(0, 255), st.binary(min_size=108, max_size=108)
)


@given(samples)
def test_a_sample_is_two_frames_of_64_bytes_and_comes_back(sample: RawSample) -> None:
    a, b = pack_sample(sample)
    assert len(a[1]) == len(b[1]) == 64
    assembler = Assembler()
    assert assembler.take(a) is None
    assert assembler.take(b) == sample
    assert assembler.incomplete == 0


@given(samples, samples)
def test_halves_of_different_samples_are_never_joined(one: RawSample, other: RawSample) -> None:
    assembler = Assembler()
    assembler.take(pack_sample(one)[0])
    found = assembler.take(pack_sample(other)[1])
    assert (found is not None) == (one.seq == other.seq)
    assert assembler.incomplete == (found is None)


def test_a_hello_comes_back_and_one_with_a_missing_frame_does_not() -> None:
    frames = pack_hello(HELLO)
    assert all(len(data) in FRAME_SIZES for _, data in frames)
    assembler = Assembler()
    found = [assembler.take(f) for f in frames]
    assert found[:-1] == [None] * (len(frames) - 1)
    assert isinstance(found[-1], Hello) and found[-1].serial == "VIB-1"
    found[-1].check()
    for missing in range(len(frames)):
        rest = frames[:missing] + frames[missing + 1 :]
        assert all(Assembler().take(f) is None for f in rest)
        assembler.restart()
        assert all(assembler.take(f) is None for f in rest)


@given(st.integers(2, 255))
def test_another_version_is_recognised(version: int) -> None:
    sample = RawSample(1, 2, 3, 0, bytes(108))
    for frame in (*pack_sample(sample, version), *pack_hello(HELLO, version)):
        assert Assembler().take(frame) == Foreign(version)


@given(st.integers(0, 0x7FF), st.binary(max_size=64))
def test_any_frame_raises_nothing(identifier: int, data: bytes) -> None:
    Assembler().take((identifier, data))
    unpack_from_host((identifier, data))


def test_orders_come_back() -> None:
    for order in (Command(5, bytes(range(36))), HelloPlease(7), Start(3)):
        assert unpack_from_host(pack_from_host(order)) == order


def test_the_database_reads_what_the_driver_reads() -> None:
    text = database(HELLO).as_dbc_string()
    loaded = cantools.database.load_string(text, "dbc")
    counts = np.random.default_rng(1).integers(-30000, 30000, 54).astype("<i2")
    (ia, a), (ib, b) = pack_sample(RawSample(11, 5500, 9, 1, counts.tobytes()))
    found = {**loaded.decode_message(ia, a), **loaded.decode_message(ib, b)}
    assert (found["seq_a"], found["seq_b"], found["time"]) == (11, 11, 5500)
    assert (found["answers"], found["flags"], found["version_a"]) == (9, 1, 1)
    for channel, count in zip(HELLO.channels, counts.tolist(), strict=True):
        assert found[channel.name] == pytest.approx(count * channel.scale, rel=1e-6)
    identifier, data = pack_from_host(Command(77, counts[:18].tobytes()))
    down = loaded.decode_message(identifier, data)
    assert down["tick"] == 77
    assert down["theta_set_05"] == pytest.approx(int(counts[5]) * 1e-4, rel=1e-6)
    assert all(message.is_fd for message in loaded.messages)


def test_bus_load_agrees_with_the_bits_counted_by_hand() -> None:
    # 64 bytes, no stuffing: 29 slow bits; ESI, DLC, data, stuff count, CRC 21, 7 fixed, delimiter
    fast = 1 + 4 + 512 + 4 + 21 + 7 + 1
    assert frame_seconds(64, 1e6, 5e6, stuffed=False) == pytest.approx(29e-6 + fast / 5e6)
    least, most = (4000 * frame_seconds(64, 1e6, 5e6, stuffed=s) for s in (False, True))
    assert 0.55 < least < 0.58 and 0.66 < most < 0.69  # two packed frames per sample
    assert bus_load(1e6, 5e6)[1] < 1.0 < bus_load(1e6, 2e6)[0]


def test_a_bus_too_slow_is_refused_before_it_is_opened() -> None:
    with pytest.raises(DeviceRefused, match=r"bus load at .* found 170 to 208 %"):
        CanHead("virtual", "slow", data_bitrate=2e6)
    with pytest.raises(DeviceAddressError, match="interface: expected one of"):
        open_bus("rig.head", "carrier-pigeon", "0")
    with pytest.raises(DeviceAddressError, match="expected a port"):
        open_bus("rig.head", "loopback", "can0")
