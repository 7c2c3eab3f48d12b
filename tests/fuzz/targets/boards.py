"""What programs of other users write into shared memory, what other robots declare and put, and recordings of it."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from pathlib import Path

import msgspec

from tests.fuzz.target import SENTENCES, Decoder, scratch, target


def _laid(path: Path, whole: bytes, use: Callable[[], object]) -> Callable[[bytes], object]:
    """A call that has a file of always the same size begin with a case's bytes."""

    def call(content: bytes) -> object:
        path.write_bytes(content[: len(whole)] + whole[len(content) :])
        return use()

    return call


@target("any program that may write the board: a file of it")
def board_file() -> Decoder:
    import failover
    from failover.boards.board import Board
    from failover.boards.overview import Overview
    from failover.core.board import layout
    from tests.failover.core.board import board_bytes

    place = scratch() / "board"
    place.mkdir()
    content = bytearray(board_bytes.sample())
    content[12:16] = layout.OWN.to_bytes(4, "little")  # an agent's: it is not removed
    (place / "own").write_bytes(content)
    (place / "peer-robot2").write_bytes(content)

    def used() -> object:
        opened: Board = failover.board(place)
        found: list[object] = []
        try:
            acts = [opened.names, opened.robots, opened.snapshot, opened.users, Overview(opened).look]
            acts += [lambda name=name: opened.item(name).get() for name in ("ball", "plan")]
            acts += [lambda: opened.item("ball").get("robot2"), lambda: opened.add(failover.Item("more", size=9))]
            acts += [lambda: opened.item("ball").put({"x": 1.0, "y": 2.0, "seen": 3}), lambda: opened.remove("plan")]
            for act in acts:
                with contextlib.suppress(*SENTENCES):
                    found.append(act())
        finally:
            opened.close()
        return found

    def call(changed: bytes) -> object:
        place.mkdir(exist_ok=True)  # the last user of a board without an agent removes it
        for name in ("own", "peer-robot2"):
            (place / name).unlink(missing_ok=True)
            (place / name).write_bytes(changed[: len(content)] + bytes(content[len(changed) :]))
        return used()

    return Decoder([bytes(content)], call)


@target("any program that may run tasks: the schedule's file")
def schedule_file() -> Decoder:
    from failover.boards.schedule_file import ScheduleFile
    from failover.core.schedule import layout
    from failover.schedule.overview import overview
    from tests.failover.core.schedule import table_bytes

    path = scratch() / "schedule"
    small = table_bytes.SAMPLE.read_bytes()
    whole = bytearray(layout.FILE_SIZE)
    whole[: len(table_bytes.sample())] = table_bytes.sample()

    def used() -> object:
        file = ScheduleFile.open(path)
        try:
            return overview(file), [layout.read_predecessor(file.table, index) for index in file.rows()]
        finally:
            file.close()

    return Decoder([bytes(whole[: len(small)])], _laid(path, bytes(whole), used))


@target("a member: the items that its programs add", "msgpack")
def announcement() -> Decoder:
    from failover.core.board.announcements import Announcer, Learned, asks, question
    from tests.failover.core.board import test_announcements as told

    announcer = Announcer(told.RANK)
    announcer.hold([])
    sizes = ((None, 8), ("f4[3]", 12), ("{x:f4,n:u4}", 8))
    announcer.hold([told.record(told.FIRST + n, type=kind, size=size) for n, (kind, size) in enumerate(sizes)])
    pages = [page for round_ in range(40) if (page := announcer.due(round_)) is not None]

    def call(content: bytes) -> object:
        learned = Learned(told.RANK, ())
        for change in learned.take(1, content):
            learned.note(change)
        learned.is_to_ask()
        return learned.refused, asks(content, told.RANK)

    return Decoder([*pages, question([told.RANK])], call)


TYPES = ("f4", "{x:f4,y:f8,n:u4}", "{on:bool,mark:u1[3],name:char[5]}", "i8[3]", "bytes[40]", "msgpack[40]", "json[40]")
FIXED = 4
"""So many of them have values of one size."""


@target("a member, or a program: the type of an item, as text", "text")
def item_type() -> Decoder:
    from failover.core.board import item_types, json_values
    from failover.core.board.item_values import values_of

    def call(content: bytes) -> object:
        kind = item_types.parse(content.decode(errors="surrogateescape"))
        assert item_types.parse(item_types.canonical(kind)) == kind
        json_values.schema_of(kind)
        return item_types.size_of(kind), values_of(kind)

    return Decoder([text.encode() for text in TYPES], call)


@target("a member, or a program: the value of an item; its first byte chooses the type", "msgpack")
def item_value() -> Decoder:
    from failover.core.board.item_types import parse, size_of
    from failover.core.board.item_values import values_of
    from failover.core.board.recording import Coder
    from tests.failover.core.board.test_recording import channel

    values = [values_of(parse(text)) for text in TYPES]
    coders, sizes = [Coder(channel(text)) for text in TYPES], [size_of(parse(text)) for text in TYPES]
    tree = {"a": [1, 2.5, None, b"x"], "b": {"c": "text"}}

    def call(content: bytes) -> object:
        index, value = content[0] % len(TYPES) if content else 0, content[1:41]
        if index < FIXED:  # the board gives values of this size only
            value = value[: sizes[index]].ljust(sizes[index], b"\0")
        put = coders[index].put_of(value, 1, 5, 6, False)
        msgspec.json.encode(put)
        return values[index].unpack(value)

    seeds = [bytes([index]) + bytes(size) for index, size in ((0, 4), (1, 16), (2, 9), (3, 24), (4, 7))]
    seeds += [b"\x05" + msgspec.msgpack.encode(tree), b"\x06" + msgspec.json.encode({"a": [1, 2.5, None]})]
    return Decoder(seeds, call)


@target("who gives a recording: messages and channels of it", "json")
def recorded_message() -> Decoder:
    from failover.core.board import recording
    from failover.core.board.recording import Coder
    from tests.failover.core.board.test_recording import channel

    coders = [Coder(channel(text)) for text in TYPES]
    put = {"value": {"x": 1.0, "y": 2.0, "n": 3}, "number": 4, "age_us": 5, "stale": False, "age_max_us": 6}
    robots = {"here": "robot1", "robots": [{"name": "robot2", "state": "run", "age_us": 5, "rank": 1}]}
    metadata = recording.metadata_of(channel(TYPES[1]))

    def call(content: bytes) -> object:
        found: list[object] = []
        with contextlib.suppress(*SENTENCES):
            read = recording.read_put(content, "topic")
            for coder in coders:
                with contextlib.suppress(*SENTENCES):
                    found.append(coder.octets_of(read))
        with contextlib.suppress(*SENTENCES):
            found.append(recording.read_robots(content))
        with contextlib.suppress(ValueError, RecursionError):
            found.append(recording.read_channel(msgspec.json.decode(content, type=dict[str, str])))
        return found

    more = [
        {"value": [1, 2, 3], "number": 4, "age_us": 5, "stale": True},
        {"number": 1, "age_us": 1, "stale": False, "raw": "AAAA"},
    ]
    return Decoder([msgspec.json.encode(one) for one in (put, *more, robots, metadata)], call)


@target("who gives a recording: an MCAP file", needs="mcap")
def recording_file() -> Decoder:
    from failover.recording.mcap_file import Recorded
    from tests.failover.recording.test_mcap_file import written

    place = scratch()
    written(place / "whole.mcap")
    written(place / "cut.mcap", close=False)
    path = place / "case.mcap"

    def call(content: bytes) -> object:
        path.write_bytes(content)
        recorded = Recorded(path)
        return sum(1 for _ in recorded.messages()), recorded.loss.sentence(path)

    return Decoder([(place / name).read_bytes() for name in ("whole.mcap", "cut.mcap")], call)


@target("the agent's table of primaries in a board, which another user's agent may have made", "msgpack")
def primaries_table() -> Decoder:
    from failover.boards import component_item
    from failover.boards.component_item import Primary

    table = {"/lab/a": Primary("robot1", 3, 500), "/lab/b": Primary("", 0, 0)}
    return Decoder([component_item.encode(table)], component_item.decode)


@target("who gives an rtdb.conf of CAMBADA", "text")
def rtdb_conf() -> Decoder:
    from failover.core.board import rtdb_conf as module

    sample = (Path(__file__).parents[2] / "samples" / "rtdb.conf").read_bytes()

    def call(content: bytes) -> object:
        found = module.parse(content, "rtdb.conf")
        module.shares(found)
        return module.as_items(found, {item.name: 16 for item in found.items}, {})

    return Decoder([sample], call)


@target("who gives an rtdb2_configuration.xml", "text")
def rtdb_xml() -> Decoder:
    from failover.core.board import rtdb_xml as module

    text = (
        '<?xml version="1.0"?>\n<RtDB2Configuration>\n <default period="2"/>\n <keys>\n'
        '  <key id="BALL" period="3" phase="1" shared="true"/>\n  <key id="POSE" shared="0"/>\n </keys>\n</RtDB2Configuration>\n'
    )
    return Decoder([text.encode()], lambda content: module.parse(content, "x.xml"))


@target("who gives a pman.conf", "text")
def pman_conf() -> Decoder:
    from failover.core.schedule import pman_conf as module

    def call(content: bytes) -> object:
        return module.declarations(content.decode(errors="surrogateescape"), 10_000_000)

    return Decoder([b"# name period phase deadline priority\nvision 4 0 4 40\nworld 4 1 8 99 # last\n"], call)
