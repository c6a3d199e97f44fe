import io
import json
import mmap
import random
import resource
import signal
import subprocess
import sys
import time
import tracemalloc
from contextlib import contextmanager

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import Writer

from vibrissa.messages.log import (
    Channel,
    LogCutOffError,
    LogDamagedError,
    LogError,
    LogExistsError,
    LogReader,
    LogWriteError,
    LogWriter,
    NotALogError,
    Record,
)
from vibrissa.messages.recover import recover, summarise

SCHEMA = '{"type": "array"}'
CHANNELS = (
    Channel("head.sample", "sampler", "HeadSample", SCHEMA),
    Channel("whisk.command", "whisk", "WhiskCommand", SCHEMA),
    Channel("whisk.command", "whisk2", "WhiskCommand", SCHEMA),
)
METADATA = {"config": "{}", "code": "0123abcd"}


def noise(i):
    return random.Random(i).randbytes(200)


def logged(path, count=60, sync_every=20, data=lambda i: bytes([i % 251]) * 5, close=True):
    """Write `count` messages in chunks of `sync_every`; returns the records a reader must give."""
    writer = LogWriter(path, run_id="run 7", channels=CHANNELS, metadata=METADATA)
    written = []
    for i in range(count):
        channel = i % len(CHANNELS)
        writer.write(channel, i // len(CHANNELS), i * 500_000, data(i))
        topic, source = CHANNELS[channel].topic, CHANNELS[channel].source
        written.append(Record(topic, source, i // len(CHANNELS), i * 500_000, data(i)))
        if i % sync_every == sync_every - 1:
            writer.sync()
    if close:
        writer.close()
    return written


def read(path, **options):
    reader = LogReader(path, **options)
    return list(reader), reader


messages = st.tuples(
    st.integers(0, len(CHANNELS) - 1),
    st.integers(0, 2**32 - 1),
    st.integers(0, 2**63 - 1),
    st.one_of(st.binary(max_size=50), st.integers(0, 200_000).map(bytes)),
)
texts = st.text(max_size=20)


@settings(max_examples=60, deadline=None)
@given(
    sent=st.lists(messages, max_size=30),
    metadata=st.dictionaries(texts.filter(lambda k: k not in ("run_id", "crc32")), texts),
    run_id=st.text(min_size=1, max_size=20),
)
def test_what_is_written_is_read_back(tmp_path_factory, sent, metadata, run_id):
    path = tmp_path_factory.mktemp("log") / "run.mcap"
    with LogWriter(path, run_id=run_id, channels=CHANNELS, metadata=metadata) as writer:
        for message in sent:
            writer.write(*message)
    found, reader = read(path)
    assert [(r.topic, r.source, r.seq, r.t, r.data) for r in found] == [
        (CHANNELS[c].topic, CHANNELS[c].source, seq, t, data) for c, seq, t, data in sent
    ]
    assert (reader.run_id, reader.metadata, reader.channels) == (run_id, metadata, CHANNELS)
    assert (reader.complete, reader.cut_at) == (True, None)
    counts = [sum(c == i for c, *_ in sent) for i in range(len(CHANNELS))]
    assert reader.end == {"cause": "stop", "counts": json.dumps(counts)}


def test_same_calls_give_the_same_bytes_whatever_the_clock_and_the_dict_order(tmp_path):
    files = []
    for i, metadata in enumerate([METADATA, dict(reversed(METADATA.items()))]):
        path = tmp_path / f"{i}.mcap"
        with LogWriter(path, run_id="r", channels=CHANNELS, metadata=metadata) as writer:
            for k in range(2000):
                writer.write(k % 3, k, k * 500_000, k.to_bytes(100, "little"))
                if k % 700 == 0:
                    writer.sync()
                    time.sleep(0.001)
            writer.add_metadata("extra", metadata)
        files.append(path.read_bytes())
    stream = io.BytesIO()
    with LogWriter(stream, run_id="r", channels=CHANNELS, metadata=METADATA) as writer:
        for k in range(2000):
            writer.write(k % 3, k, k * 500_000, k.to_bytes(100, "little"))
            if k % 700 == 0:
                writer.sync()
        writer.add_metadata("extra", METADATA)
    assert files[0] == files[1] == stream.getvalue()


def test_other_mcap_readers_read_the_log(tmp_path):
    written = logged(tmp_path / "run.mcap")
    with open(tmp_path / "run.mcap", "rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_header().profile == "vibrissa"
        seen = [
            Record(c.topic, c.metadata["source"], m.sequence, m.log_time, m.data)
            for s, c, m in reader.iter_messages()
            if s.encoding == "jsonschema" and c.message_encoding == "msgpack"
        ]
        summary = reader.get_summary()
    assert seen == written
    assert summary.statistics.message_count == len(written)
    assert all(chunk.compression == "lz4" for chunk in summary.chunk_indexes)


def test_a_full_chunk_is_in_the_file_without_any_sync(tmp_path):
    path = tmp_path / "run.mcap"
    written = logged(path, 1000, sync_every=10**9, data=lambda i: bytes([i % 7]) * 300, close=False)
    found, reader = read(path, allow_cut=True)
    assert found == written[: len(found)]
    assert sum(len(r.data) for r in written[len(found) :]) < 64 * 1024
    assert reader.complete is False


def test_sync_closes_only_chunks_of_the_given_age(tmp_path):
    path = tmp_path / "run.mcap"
    writer = LogWriter(path, run_id="r", channels=CHANNELS, metadata={})
    writer.write(0, 0, 0, b"x")
    writer.sync(max_age=3600.0)
    assert read(path, allow_cut=True)[0] == []
    time.sleep(0.002)
    writer.sync(max_age=0.001)
    assert len(read(path, allow_cut=True)[0]) == 1
    size = path.stat().st_size
    writer.sync()
    assert path.stat().st_size == size
    writer.close()


WRITER = """
import mmap, sys
from vibrissa.messages.log import Channel, LogWriter
path, counters = sys.argv[1:]
with open(counters, "r+b") as f:
    shared = mmap.mmap(f.fileno(), 16)
writer = LogWriter(path, run_id="r", channels=[Channel("t", "s", "T", "{}")], metadata={})
i = 0
while True:
    i += 1
    shared[:8] = i.to_bytes(8, "little")
    writer.write(0, i, i, i.to_bytes(300, "little"))
    if i % 50 == 0:
        writer.sync()
        shared[8:] = i.to_bytes(8, "little")
"""


def test_a_killed_writer_loses_only_the_open_chunk(tmp_path):
    path, counters = tmp_path / "run.mcap", tmp_path / "counters"
    counters.write_bytes(bytes(16))
    with open(counters, "r+b") as stream, mmap.mmap(stream.fileno(), 16) as shared:
        child = subprocess.Popen([sys.executable, "-c", WRITER, str(path), str(counters)])
        try:
            while int.from_bytes(shared[8:], "little") < 5000 and child.poll() is None:
                time.sleep(0.01)
        finally:
            child.send_signal(signal.SIGKILL)
            child.wait()
        accepted = int.from_bytes(shared[:8], "little")
        synced = int.from_bytes(shared[8:], "little")
    found, reader = read(path, allow_cut=True)
    assert synced >= 5000
    assert synced <= len(found) <= accepted
    assert [r.seq for r in found] == list(range(1, len(found) + 1))
    assert reader.complete is False
    with pytest.raises(LogCutOffError, match="cut off"):
        LogReader(path)


def test_a_file_cut_at_any_byte_gives_a_prefix_or_a_named_error(tmp_path):
    written = logged(tmp_path / "run.mcap")
    whole = (tmp_path / "run.mcap").read_bytes()
    path = tmp_path / "cut.mcap"
    lengths = []
    for size in range(len(whole)):
        path.write_bytes(whole[:size])
        with pytest.raises((LogCutOffError, NotALogError) if size == 0 else LogCutOffError):
            LogReader(path)
        try:
            found, reader = read(path, allow_cut=True)
        except (LogCutOffError, NotALogError):
            assert size == 0 or not lengths
            continue
        assert found == written[: len(found)]
        assert reader.complete is False and reader.cut_at is not None and reader.cut_at <= size
        assert reader.metadata == METADATA
        lengths.append(len(found))
    assert set(lengths) == {0, 20, 40, 60}
    assert lengths == sorted(lengths)


@pytest.mark.parametrize("closed", [True, False])
def test_every_flipped_bit_is_detected_or_harmless(tmp_path, closed):
    written = logged(tmp_path / "run.mcap", count=9, sync_every=6, close=closed)[
        : 9 if closed else 6
    ]
    whole = bytearray((tmp_path / "run.mcap").read_bytes())
    path = tmp_path / "flipped.mcap"
    detected = 0
    for position in range(len(whole) * 8):
        whole[position // 8] ^= 1 << position % 8
        path.write_bytes(whole)
        whole[position // 8] ^= 1 << position % 8
        try:
            found, reader = read(path, allow_cut=True)
        except LogError as error:
            assert "\n" not in str(error)
            detected += 1
            continue
        if closed and not reader.complete:  # the end mark itself
            detected += 1
            assert found == written[: len(found)]
            continue
        assert (reader.metadata, reader.run_id) == (METADATA, "run 7")
        assert found == (written if closed else written[: len(found)])
        assert reader.complete is closed
    assert not closed or detected == len(whole) * 8


def test_damage_is_named_with_file_offset_time_and_topics(tmp_path):
    path = tmp_path / "run.mcap"
    logged(path, data=noise)
    whole = bytearray(path.read_bytes())
    at = [i for i in range(len(whole)) if whole.startswith(b"\x03\0\0\0lz4", i)][1]
    whole[at + 200] ^= 1
    path.write_bytes(whole)
    with pytest.raises(LogDamagedError) as caught:
        list(LogReader(path))
    told = str(caught.value)
    assert str(path) in told and f"byte {at - 37}" in told
    assert "t 10000000 to 19500000 ns" in told and "whisk.command of whisk2" in told


def test_foreign_files_are_refused_by_name(tmp_path):
    path = tmp_path / "foreign"
    for content in (b"", b"hello, world", b"\x89PNG\r\n\x1a\n" + bytes(100), bytes(1000)):
        path.write_bytes(content)
        with pytest.raises(NotALogError, match="not an MCAP file"):
            LogReader(path, allow_cut=True)
    with open(path, "wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2")
        writer.finish()
    with pytest.raises(NotALogError, match="profile 'ros2', expected 'vibrissa'"):
        LogReader(path)
    with open(path, "wb") as stream:
        writer = Writer(stream)
        writer.start(profile="vibrissa")
        writer.finish()
    with pytest.raises(NotALogError, match="no run id"):
        LogReader(path)


def test_a_file_with_two_runs_is_refused(tmp_path):
    path = tmp_path / "run.mcap"
    first, second = tmp_path / "a.mcap", tmp_path / "b.mcap"
    for name, run_id in ((first, "a"), (second, "b")):
        writer = LogWriter(name, run_id=run_id, channels=CHANNELS, metadata={})
        writer.write(0, 0, 0, b"x")
        writer.sync()
    header = len(b"\x89MCAP0\r\n") + 9 + second.read_bytes()[9]
    path.write_bytes(first.read_bytes() + second.read_bytes()[header:])
    with pytest.raises(NotALogError, match="holds the runs 'a' and 'b'"):
        list(LogReader(path, allow_cut=True))


def test_an_existing_file_is_never_overwritten(tmp_path):
    path = tmp_path / "run.mcap"
    path.write_bytes(b"precious")
    with pytest.raises(LogExistsError, match=r"run\.mcap"):
        LogWriter(path, run_id="r", channels=CHANNELS, metadata={})
    logged(tmp_path / "src.mcap")
    with pytest.raises(LogExistsError):
        recover(tmp_path / "src.mcap", path)
    assert path.read_bytes() == b"precious"


def test_a_missing_directory_is_a_write_error(tmp_path):
    with pytest.raises(LogWriteError, match="No such file"):
        LogWriter(tmp_path / "no" / "run.mcap", run_id="r", channels=CHANNELS, metadata={})


@contextmanager
def file_size_limit(size):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_full_disk_is_named_and_what_was_written_before_is_recoverable(tmp_path):
    path = tmp_path / "run.mcap"
    with file_size_limit(300_000):
        writer = LogWriter(path, run_id="r", channels=CHANNELS, metadata=METADATA)
        with pytest.raises(LogWriteError, match=r"run\.mcap: File too large") as caught:
            for i in range(100_000):
                writer.write(0, i, i, noise(i))
        with pytest.raises(LogWriteError, match="closed"):
            writer.write(0, 0, 0, b"")
        writer.close()
    assert isinstance(caught.value.__cause__, OSError)
    found, reader = read(path, allow_cut=True)
    assert len(found) > 1000 and [r.seq for r in found] == list(range(len(found)))
    assert reader.complete is False
    result = recover(path, tmp_path / "saved.mcap")
    assert result.kept == len(found)
    assert read(tmp_path / "saved.mcap")[0] == found


def test_a_disk_full_from_the_start_leaves_no_file_behind(tmp_path):
    path = tmp_path / "run.mcap"
    with file_size_limit(20), pytest.raises(LogWriteError, match="File too large"):
        LogWriter(path, run_id="r", channels=CHANNELS, metadata=METADATA)
    assert not path.exists()


def test_bad_arguments_change_nothing(tmp_path):
    path = tmp_path / "run.mcap"
    for bad in (
        {"run_id": ""},
        {"metadata": {"run_id": "x"}},
        {"metadata": {"crc32": "x"}},
        {"metadata": {"n": 1}},
        {"channels": [*CHANNELS, CHANNELS[0]]},
    ):
        with pytest.raises(ValueError):
            LogWriter(path, **{"run_id": "r", "channels": CHANNELS, "metadata": {}, **bad})
    assert not path.exists()
    with LogWriter(path, run_id="r", channels=CHANNELS, metadata={}) as writer:
        for channel, seq, t in ((3, 0, 0), (-1, 0, 0), (0, -1, 0), (0, 2**32, 0), (0, 0, -1)):
            with pytest.raises(ValueError, match=r"expected 0\.\."):
                writer.write(channel, seq, t, b"x")
        with pytest.raises(ValueError, match="by the log itself"):
            writer.add_metadata("end", {})
    assert read(path)[0] == []
    with pytest.raises(LogWriteError, match="closed"):
        writer.write(0, 0, 0, b"x")


def test_an_exception_in_the_run_is_the_cause_of_the_end(tmp_path):
    path = tmp_path / "run.mcap"
    with (
        pytest.raises(ZeroDivisionError),
        LogWriter(path, run_id="r", channels=CHANNELS, metadata={}),
    ):
        raise ZeroDivisionError
    _, reader = read(path)
    assert reader.end["cause"] == "ZeroDivisionError"


def test_recover_keeps_everything_readable_and_says_what_was_lost(tmp_path):
    path = tmp_path / "run.mcap"
    written = logged(path, close=False)
    path.write_bytes(path.read_bytes()[:-10])
    result = recover(path, tmp_path / "saved.mcap")
    found, reader = read(tmp_path / "saved.mcap")
    assert found == written[: result.kept]
    assert (reader.run_id, reader.metadata, reader.complete) == ("run 7", METADATA, True)
    assert reader.extra["recovered"]["kept"] == str(result.kept)
    assert result.lost_bytes > 0 and not result.lossless
    assert reader.end["cause"] == "recovered"


def test_recover_ends_where_the_caller_says(tmp_path):
    path = tmp_path / "run.mcap"
    written = logged(path, close=False)
    seen = []

    def up_to_the_last_command(records):
        usable = 0
        for i, record in enumerate(records):
            seen.append(record)
            usable = i + 1 if record.source == "whisk" else usable
        return usable

    result = recover(path, tmp_path / "saved.mcap", up_to_the_last_command)
    assert seen == written
    assert (result.kept, result.readable) == (59, 60)
    assert read(tmp_path / "saved.mcap")[0] == written[:59]


@pytest.mark.parametrize("chunk", [0, 1, 2])
@pytest.mark.parametrize("where", ["length", "content"])
def test_recover_skips_a_damaged_chunk_and_goes_on_behind_it(tmp_path, chunk, where):
    path = tmp_path / "run.mcap"
    written = logged(path, data=noise)
    whole = bytearray(path.read_bytes())
    at = [i for i in range(len(whole)) if whole.startswith(b"\x03\0\0\0lz4", i)][chunk]
    whole[at - 36 + 2 if where == "length" else at + 100] ^= 4
    path.write_bytes(whole)
    result = recover(path, tmp_path / "saved.mcap")
    found, _ = read(tmp_path / "saved.mcap")
    assert found == written[: chunk * 20] + written[chunk * 20 + 20 :]
    assert result.damage and str(path) in result.damage[0]


def test_recover_of_an_intact_log_is_lossless_and_reproducible(tmp_path):
    written = logged(tmp_path / "run.mcap")
    for name in ("a.mcap", "b.mcap"):
        assert recover(tmp_path / "run.mcap", tmp_path / name).lossless
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()
    assert read(tmp_path / "a.mcap")[0] == written


def test_a_failed_recovery_leaves_no_file(tmp_path):
    logged(tmp_path / "run.mcap", 3000, data=noise)
    with file_size_limit(100_000), pytest.raises(LogWriteError):
        recover(tmp_path / "run.mcap", tmp_path / "saved.mcap")
    assert not (tmp_path / "saved.mcap").exists()


def test_summary_counts_gaps_restarts_and_times(tmp_path):
    path = tmp_path / "run.mcap"
    with LogWriter(path, run_id="r", channels=CHANNELS, metadata=METADATA) as writer:
        for t, seq in enumerate([3, 4, 8, 9, 0, 1, 5]):
            writer.write(1, seq, 100 + t, b"x")
    summary = summarise(path)
    idle, busy, _ = summary.channels
    assert (idle.count, idle.first_t) == (0, None)
    assert (busy.topic, busy.source, busy.count) == ("whisk.command", "whisk", 7)
    assert (busy.gaps, busy.missing, busy.restarts) == (2, 6, 1)
    assert (busy.first_seq, busy.last_seq, busy.first_t, busy.last_t) == (3, 5, 100, 106)
    assert (summary.records, summary.duration, summary.complete) == (7, 6, True)
    assert summary.size == path.stat().st_size
    path.write_bytes(path.read_bytes()[:-1])
    assert summarise(path).complete is False


def test_reading_holds_one_chunk_at_a_time(tmp_path):
    path = tmp_path / "run.mcap"
    logged(path, 20_000, sync_every=10**9, data=noise)
    assert path.stat().st_size > 4_000_000
    tracemalloc.start()
    assert sum(1 for _ in LogReader(path)) == 20_000
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1_000_000
