"""The process table is whole: everything in it exists, and everything said is heard or recorded."""

from __future__ import annotations

import collections
import importlib
from itertools import combinations

import pytest

from vibrissa.messages.codec import CODECS
from vibrissa.messages.topics import TOPICS
from vibrissa.messages.transport import BUNDLE
from vibrissa.processes.config import Experiment
from vibrissa.processes.framelog import channels
from vibrissa.processes.layout import Layout
from vibrissa.processes.pump import Pump
from vibrissa.processes.table import (
    ALL_SLOTS,
    DEVICES,
    PROCESSES,
    PUBLISHED_BY_HOSTS,
    ROWS,
    Process,
    build,
    listeners,
    producers,
)

every_process = pytest.mark.parametrize("row", ROWS.values(), ids=lambda row: row.name)


@every_process
def test_every_topic_of_the_process_table_is_in_the_topic_table(row: Process) -> None:
    assert set(row.hears) | set(row.says) <= set(TOPICS)
    assert len(set(row.hears)) == len(row.hears) and len(set(row.says)) == len(row.says)
    assert not set(row.says) & set(PUBLISHED_BY_HOSTS)


@pytest.mark.parametrize("name", PROCESSES | ALL_SLOTS)
def test_every_node_of_the_table_can_be_made(name: str, short: Experiment) -> None:
    assert callable(build(name, short).step)


@pytest.mark.parametrize("name", DEVICES)
def test_every_device_of_the_table_has_a_process_that_says_what_the_rig_would(name: str) -> None:
    module, _, attribute = DEVICES[name].node.partition(":")
    assert issubclass(getattr(importlib.import_module(module), attribute), Pump)
    assert set(DEVICES[name].says) <= set(PROCESSES["rig"].says)


@every_process
def test_every_node_takes_the_decisions_of_the_supervisor(row: Process) -> None:
    assert "run.event" in row.hears


@every_process
def test_what_drives_a_process_and_what_it_awaits_are_topics_it_hears(row: Process) -> None:
    assert (row.hears[0] == "host.timer") == (row.pacing == "timer")
    assert not row.answer or row.answer in row.hears
    assert row.priority == 0 or 0 < row.priority < 99
    assert (row.pacing == "drain") == (row.priority == 0)
    assert row.silence > 1.0


@every_process
def test_every_topic_a_process_hears_is_said_by_somebody(row: Process) -> None:
    for topic in row.hears:
        assert producers(topic) or topic == "host.timer"  # which a host makes for itself


@pytest.mark.parametrize("topic", TOPICS)
def test_the_producer_in_the_topic_table_is_who_says_it(topic: str) -> None:
    row = TOPICS[topic]
    said_by = [p.name for p in PROCESSES.values() if topic in p.says]
    if row.producer not in ("any", "supervisor"):
        assert said_by == [row.producer]
    if row.producer == "supervisor":
        assert said_by == [] and producers(topic) == ["supervisor"]
    if row.producer == "any":
        assert topic in PUBLISHED_BY_HOSTS or said_by or topic == "host.timer"
    assert set(listeners(topic)) == {p.name for p in PROCESSES.values() if topic in p.hears}


def test_every_recorded_topic_has_a_channel_with_a_schema_for_everybody_who_says_it() -> None:
    found = channels()
    keys = [(c.topic, c.source) for c in found]
    assert len(set(keys)) == len(keys)
    for channel in found:
        assert channel.schema_json == CODECS[channel.topic].json_schema()
        assert channel.schema_name == TOPICS[channel.topic].type.__name__
    for topic, row in TOPICS.items():
        said_by = {source for t, source in keys if t == topic}
        assert said_by == (set(producers(topic)) if row.recorded else set())


def layout(together: list[list[str]]) -> Layout:
    grouped = {n: "+".join(group) for group in together for n in group}
    hosts: dict[str, list[str]] = {}
    for name in PROCESSES:
        hosts.setdefault(grouped.get(name, name), []).append(name)
    names = ["control", "supervisor", "recorder", *hosts, *ALL_SLOTS]
    endpoints = {name: f"ipc:///run/{name}" for name in names}
    return Layout(hosts, endpoints, experiment="{}", log="run.mcap", metadata={})


PLACEMENTS = [[], [["sampler", "whisk"]], [["rig", "sampler", "whisk", "arm", "slam"]]]
PLACEMENTS += [[list(pair)] for pair in combinations(PROCESSES, 2)]


@pytest.mark.parametrize("together", PLACEMENTS, ids=str)
def test_wherever_nodes_are_placed_everybody_is_connected_to_whom_they_hear(
    together: list[list[str]],
) -> None:
    made = layout(together)
    host_of = {node: host for host, nodes in made.hosts.items() for node in nodes}
    for host, nodes in made.hosts.items():
        for node in nodes:
            for topic in PROCESSES[node].hears:
                for speaker in (p for p in PROCESSES if topic in PROCESSES[p].says):
                    if host_of[speaker] != host:
                        assert topic in made.hears(host)
                        assert made.endpoints[host_of[speaker]] in made.connections(host)
        assert made.endpoints["supervisor"] in made.connections(host)
        assert made.endpoints[host] not in made.connections(host)
        assert made.endpoints[host] in made.connections("recorder")
    assert set(made.hears("recorder")) == {t for t, row in TOPICS.items() if row.recorded}


@pytest.mark.parametrize("together", PLACEMENTS, ids=str)
def test_the_barrier_waits_for_exactly_the_subscriptions_that_come(
    together: list[list[str]],
) -> None:
    made = layout(together)
    for process in ["supervisor", *made.hosts]:
        subscriptions: collections.Counter[str] = collections.Counter()
        for other in ("supervisor", "recorder", *made.hosts):
            if other != process and made.endpoints[process] in made.connections(other):
                hears = [BUNDLE] if made.bundled(other) else made.hears(other)
                subscriptions.update(hears)
        audience = made.audience(process)
        assert all(subscriptions[topic] >= n for topic, n in audience.items())
        assert audience[BUNDLE] >= 1  # the recorder, at least
        for topic, n in subscriptions.items():
            if topic in made.says(process):
                assert audience[topic] == n


@pytest.mark.parametrize("together", PLACEMENTS, ids=str)
def test_bundles_are_only_for_those_who_need_not_react_at_once(together: list[list[str]]) -> None:
    made = layout(together)
    assert made.bundled("recorder") and not made.bundled("supervisor")
    for host, nodes in made.hosts.items():
        assert made.bundled(host) == all(PROCESSES[n].pacing == "drain" for n in nodes)
