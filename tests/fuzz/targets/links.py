"""What comes over the network: heartbeats, the replication link, names, messages of drivers, invitations."""

from __future__ import annotations

import asyncio
import contextlib
import http.client
import io
import itertools
import random
from typing import TYPE_CHECKING, Any
from unittest import mock

import msgspec

from failover.errors import RulesError
from tests.fuzz.target import SENTENCES, Decoder, scratch, target

if TYPE_CHECKING:
    from failover.core.types import Rule
    from failover.core.wire.messages import Beat


@target("anyone on the network: a datagram at the heartbeat's port")
def heartbeat_datagram() -> Decoder:
    from tests.failover.core.frames import test_frame as frames

    receiver = frames.receiver

    def call(content: bytes) -> object:
        return receiver().open(content)

    return Decoder([frames.sealed(), frames.sealed(None), frames.sealed(items=()), frames.sealed(said=None)], call)


@target("a member, whose seals are right: a heartbeat with items", "msgpack")
def heartbeat_body() -> Decoder:
    from failover.core.frames.assembly import Assembly
    from failover.core.frames.frame import Part, bodies, body_size_max
    from failover.core.wire import codec
    from tests.failover.core.frames import test_frame as frames

    room = body_size_max(3)
    large = frames.Portion(3, 5, 9, bytes(range(256)) * 10)
    seeds = [
        *bodies(frames.SAID, frames.BEAT, (frames.BALL,), frames.LEFT_US, room)[0],
        *bodies(None, None, (frames.BALL, large), frames.LEFT_US, room)[0],
    ]
    receiver = frames.receiver()
    counter = itertools.count(1)

    def call(content: bytes) -> object:
        by = frames.sealer()
        by.counter = next(counter)
        (datagram,) = by.seal([content], frames.keys_of("robot1"), round_=5)
        part = receiver.open(datagram)
        if isinstance(part, Part):
            assembly = Assembly()
            taken = [assembly.take(part.sender, item) for item in part.items]
            assert part.beat is None or codec.is_sound(part.beat)
            return part, taken
        return part

    return Decoder(seeds, call)


@target("a member: a heartbeat, as the rules take it", "msgpack")
def heartbeat_rules() -> Decoder:
    from failover.core.frames.frame import Part, bodies, body_size_max
    from failover.core.types import Rule
    from tests.failover.core.frames import test_frame as frames

    seeds = bodies(frames.SAID, frames.BEAT, (), frames.LEFT_US, body_size_max(3))[0]
    receiver, counter = frames.receiver(), itertools.count(1)

    def call(content: bytes) -> object:
        by = frames.sealer()
        by.counter = next(counter)
        part = receiver.open(by.seal([content], frames.keys_of("robot1"), round_=5)[0])
        if isinstance(part, Part) and part.beat is not None:
            return [_after_a_beat(part.beat, rule) for rule in Rule]
        return part

    return Decoder(seeds, call)


def _after_a_beat(beat: Beat, rule: Rule) -> object:
    """What a robot that runs a component does and says when it hears a member, and a little later."""
    from failover.core.events import Received, Run, Started, Tick
    from failover.core.node import Node
    from failover.core.types import ComponentSpec, Config, Launch, VoteRecord
    from failover.core.wire.codec import beat_size
    from tests.simulation.teams import ruled

    spec = ComponentSpec("/lab/x", launch=Launch(("x",)))
    (config,) = ruled(rule, [Config("robot2", ("robot1", "robot3"))])
    node = Node(config, 1, VoteRecord(), 0)
    readies = [node.step(Run(1, spec), 1), node.step(Started(spec.name, 1), 2), node.step(Received(beat), 3)]
    for _ in range(4):
        at_ns = max(node.next_deadline_ns(), 4)
        readies.append(node.step(Tick(), at_ns))
    assert all(beat_size(said) < 64 << 10 for ready in readies for said in ready.send)
    return node.status(at_ns)


@target("whatever listens at an endpoint of [coordinator]: its answer", "json")
def etcd_answer() -> Decoder:
    from agent.coordinator.etcd import Etcd
    from agent.coordinator_config import CoordinatorConfig
    from failover.core.election.coordinator import Grant, KeepAlive, Put, Request, Swap

    def call(content: bytes) -> object:
        etcd = Etcd(CoordinatorConfig(("http://etcd:2379",)), 1.0)
        with mock.patch.object(etcd, "_connected") as connected:
            connected().getresponse().configure_mock(status=http.client.OK, read=io.BytesIO(content).read)
            return etcd.answer(request_for[b"ID" in content, b"TTL" in content])

    lease, read = {"ID": "7", "TTL": "3"}, {"key": "YQ==", "mod_revision": "5", "value": "YQ=="}
    done = [{"response_txn": {"succeeded": True}}, {"response_range": {"kvs": [read, {"key": "YQ==", "mod_revision": "5"}]}}]
    swapped = {"header": {"cluster_id": "1", "revision": "7"}, "succeeded": True, "responses": done}
    swap = Swap("failover/lab/", (Put("failover/lab/word/r", b"", ()),))
    request_for: dict[tuple[bool, bool], Request] = {(False, False): swap, (True, False): swap}
    request_for |= {(False, True): KeepAlive(7), (True, True): Grant(7)}
    return Decoder([msgspec.json.encode(one) for one in (swapped, lease, {"result": {"TTL": "3"}})], call)


@target("who may write below failover/TEAM/ in etcd: a vote, and the word of a robot", "msgpack")
def etcd_values() -> Decoder:
    from failover.core.election.consent import STATES
    from failover.core.election.coordinator import Arbiter, Dialogue, Leased, Seat, Swap, Swapped, Word
    from failover.core.events import Received, Run, Started, Tick
    from failover.core.node import Node
    from failover.core.types import COORDINATOR, MS, ComponentSpec, Config, Launch, Rule, State, VoteRecord
    from failover.core.wire.codec import beat_size
    from failover.core.wire.messages import Entry
    from tests.simulation.teams import ruled

    (config,) = ruled(Rule.ETCD, [Config("robot2", ("robot1",))])
    spec = ComponentSpec("/lab/x", launch=Launch(("x",)))
    entries = (
        Entry(spec.name, STATES.index(State.PRIMARY), 3, "robot1"),
        Entry("/lab/y", STATES.index(State.FINISHED), 2, "robot1"),
    )
    seat, word = msgspec.msgpack.encode(Seat(3, "robot1", "robot2")), msgspec.msgpack.encode(Word(1, 5, entries))

    def call(content: bytes) -> object:
        whole = {"component/lab/x": seat, "component/lab/y": seat, "word/robot1": word}
        told = []
        for key in whole:
            with contextlib.suppress(*SENTENCES):
                told.append(heard({**whole, key: content}))
        if not told:
            raise RulesError("it is neither a vote nor a word")
        return told

    def heard(values: dict[str, bytes]) -> object:
        """What a robot does and says that finds this at etcd, for a second, while robot1 is silent."""
        arbiter, dialogue = Arbiter(config, "lab"), Dialogue(config)
        node = Node(config, 1, VoteRecord(), 0)
        readies = [node.step(Run(1, spec), 1), node.step(Started(spec.name, 1), 2)]
        for turn in range(1, 9):
            now_ns = turn * 200 * MS
            found = {f"failover/lab/{key}": (value, 3) for key, value in values.items()}
            steps = arbiter.round(node.word())
            try:
                request = next(steps)
                while True:
                    request = steps.send((Swapped(True, 9, found, 1) if isinstance(request, Swap) else Leased(7), now_ns))
            except StopIteration as end:
                if (beat := dialogue.beat(end.value)) is not None:
                    readies.append(node.step(Received(beat, COORDINATOR, paces=False), now_ns))
            readies.append(node.step(Tick(), max(now_ns, node.next_deadline_ns())))
        assert all(beat_size(said) < 64 << 10 for ready in readies for said in ready.send)
        return node.status(now_ns)

    return Decoder([seat, word], call)


@target("a member: a message of the replication link", "msgpack")
def link_message() -> Decoder:
    from failover.core.wire import codec, messages
    from tests.agent.worker.control.test_malformed import BULK

    offered = messages.Content(4, bytes(range(32)), 7)
    return Decoder([codec.encode_bulk(one) for one in (*BULK, offered)], codec.decode_bulk)


@target("a member: an order, and its arguments", "msgpack")
def order_of_a_robot() -> Decoder:
    from agent.worker.control import arguments as ours
    from agent.worker.control.reservations import Hearing
    from agent.worker.network import remote_orders
    from failover.core.wire.messages import Errand

    kinds = [kind for name, kind in vars(ours).items() if name.endswith("Arguments")] + [ours.TakenTeam, Hearing]
    said: list[dict[str, Any]] = [
        {"argv": ["/bin/sh", "-c", "true"], "env": {"A": "b"}, "hooks": {"after_resume": ["x"]}, "umask": 18},
        {"name": "/lab/a", "signal": 9},
        {"name": "/lab/a", "to": "robot2"},
        {"reservations": []},
        {"pid": 7, "name": "/lab/a"},
        {"name": "/lab/a", "part": {"stream": 1, "offset": 0}},
    ]

    def call(content: bytes) -> object:
        read = remote_orders._arguments(Errand(1, "verb", content))
        found = []
        for kind in kinds:
            try:
                found.append(ours.arguments_of(kind, "verb", read))
            except SENTENCES:
                found.append(None)
        return found

    return Decoder([msgspec.msgpack.encode(one) for one in said], call)


@target("a member: what it asks a witness that keeps sealed copies", "msgpack", needs="cryptography")
def sealed_request() -> Decoder:
    from agent.worker.network import remote_orders
    from agent.worker.replication.sealed_copies import SealedCopies
    from failover.archive import signature
    from failover.archive.witness import Listed, Put, Read, Remove, Request, Size
    from failover.core.wire.messages import Errand

    place, key, kept, other = scratch(), bytes(32), "lab/@x/2.base.sealed", "lab/@x/3.base.sealed"
    (place / kept).parent.mkdir(parents=True)
    copies = SealedCopies(place, 1 << 20, "gate", lambda: signature.public_of(key))

    def call(content: bytes) -> object:
        (place / kept).write_bytes(b"sealed")  # a seed has it removed
        copies.load()
        return asyncio.run(copies.answer("robot1", remote_orders._arguments(Errand(1, "sealed", content))))

    removes, puts = signature.sign(key, signature.REMOVE, kept), signature.sign(key, signature.PUT, other, 7, bytes(32))
    requests: list[Request] = [Size(kept), Listed("lab"), Read(kept, 1), Remove(kept, removes), Put(other, 7, bytes(32), puts)]
    return Decoder([msgspec.msgpack.encode(msgspec.to_builtins(one, builtin_types=(bytes,))) for one in requests], call)


@target("a witness that keeps sealed copies: its answer", "msgpack", needs="cryptography")
def sealed_answer() -> Decoder:
    from agent.worker.network import remote_orders
    from failover.archive.witness import Answer, WitnessObjects
    from failover.core.wire.messages import Errand

    def call(content: bytes) -> object:
        witness = mock.Mock()
        witness.ask.return_value = remote_orders._arguments(Errand(1, "sealed", content))
        objects, name = WitnessObjects(witness, bytes(32)), "lab/@x/1.base.sealed"
        found: list[object] = [objects.size(name), objects.open(name).read(1 << 20), objects.put(name, empty)]
        if not witness.ask.return_value.get("more"):
            found += objects.listed("lab")
        return found

    empty = (scratch() / "empty").open("w+b")
    answers = Answer(7), Answer(content=b"sealed"), Answer(found="kept"), Answer(objects=(("lab/@x/1.base.sealed", 7, 1.5),))
    return Decoder([msgspec.msgpack.encode(msgspec.to_builtins(one, builtin_types=(bytes,))) for one in answers], call)


@target("a process of the team, or of this network: tables of names", "msgpack")
def names_message() -> Decoder:
    from failover.core.naming import records, scan
    from failover.core.naming.records import Record
    from failover.core.naming.scan import MULTICAST, Ask, Digest, Pages, Row, Scan
    from failover.core.naming.tables import Entry, Page

    record = Record("lab/robot2/PWM", "driver", ("tcp://10.0.0.2:7000",), ("the motor",), {"set": {"type": "object"}}, ("1.2",))
    entries = (Entry("lab/robot2/PWM", 1, records.pack(record)), Entry("lab/robot2/old", 2))
    page = Page("robot2", 5, 0, 2, "tcp://10.0.0.2:7001", 3, 0, entries)
    row = Row("robot2", 5, 2, 3, 1)
    seeds = [
        Digest("tcp://10.0.0.2:7001", (row,)),
        Ask("tcp://10.0.0.2:7001", (row,)),
        Pages("tcp://10.0.0.2:7001", (page,), ("robot3",)),
    ]

    def call(content: bytes) -> object:
        message = scan.decode(content)
        if message is None:
            return None
        ours = Scan("robot1", 7, 0, address="tcp://10.0.0.1:7001", multicast=True)
        ours.put(Record("lab/robot1/PWM", addresses=("tcp://10.0.0.1:7000",)), 1)
        sends = ours.heard(message, 2)
        sends += ours.tick(30 * scan.SECOND)
        for send in sends:
            assert send.to == MULTICAST or isinstance(send.to, str)
            scan.encode(send.message)
        tree, found = ours.tree(3), []
        for name in ("PWM", "the motor", "lab/robot2/PWM"):
            with contextlib.suppress(*SENTENCES):
                found.append((tree.resolve(name), tree.claimants(name)))
        return found, tree.under()

    return Decoder([scan.encode(one) for one in seeds], call)


@target("a process of the team: what stands behind a name", "msgpack")
def name_record() -> Decoder:
    from failover.core.naming import records
    from failover.core.naming.records import Record

    record = Record("lab/robot2/PWM", "driver", ("tcp://10.0.0.2:7000",), ("the motor",), {"set": {"type": "object"}}, ("1.2",))

    def call(content: bytes) -> object:
        found = records.unpack.__wrapped__(content)
        return found and [records.numeric(address) for address in found.addresses]

    return Decoder([records.pack(record)], call)


@target("who calls a driver: a name, by hand", "text")
def name_text() -> Decoder:
    from failover.core.naming import names
    from failover.core.wire import names as members

    def call(content: bytes) -> object:
        text = content.decode(errors="surrogateescape")
        found = names.parse(text)
        for check in (names.path, names.alias, members.check_robot):
            with contextlib.suppress(*SENTENCES):
                check(text)
        return found

    return Decoder([b"lab/robot1/Engines/3/PWM", b"tcp://10.0.0.1:7000", b"[fe80::1]:80", "ﬁ".encode()], call)


_HEAD = {"to": "lab/robot1/PWM", "verb": "set", "id": "7", "from": "me", "boot": 3, "seq": 4, "after": 3, "reliable": True}
ASKED = {
    **_HEAD,
    "deadline_ms": 500,
    "hops": [["me", 5, 6], ["x", "9007199254740993", None]],
    "note": 1,
    "body": {"duty": 0.5, "names": ["a", "b"]},
}
ANSWERED = {"re": "7", "boot": 3, "seq": 4, "ok": {"x": [1, 2.5, None, True]}}
REFUSED = {"re": "7", "error": {"kind": "busy", "sentence": "not now"}}


def _envelope(content: bytes) -> object:
    from failover.core.messaging import envelope

    found = envelope.decode(content)
    for encoding in ("json", "msgpack"):
        assert envelope.decode(envelope.encode(found, encoding)) == found, "it comes back otherwise"
    return envelope.encode_answer(envelope.answer(envelope.came(found, "us", 5), found.body if found.body else None))


@target("who calls a driver: a message as JSON", "json")
def envelope_json() -> Decoder:
    return Decoder([msgspec.json.encode(one) for one in (ASKED, ANSWERED, REFUSED)], _envelope)


@target("who calls a driver: a message as msgpack", "msgpack")
def envelope_msgpack() -> Decoder:
    return Decoder([msgspec.msgpack.encode(one) for one in (ASKED, ANSWERED, REFUSED)], _envelope)


@target("who calls a driver: a message as Avro", needs="fastavro")
def envelope_avro() -> Decoder:
    from failover.core.messaging import envelope

    made = [envelope.decode(msgspec.json.encode(one)) for one in (ASKED, ANSWERED, REFUSED)]
    return Decoder([envelope.encode(one, "avro") for one in made], _envelope)


def _in_pieces(take: Any, content: bytes) -> list[bytes]:
    """As a socket gives it: cut at places that its own bytes choose."""
    dice, found, at = random.Random(len(content)), [], 0
    while at < len(content):
        step = dice.choice((1, 7, 4_096))
        found += take(content[at : at + step])
        at += step
    return found


@target("who calls a driver over a socket of this machine: JSON typed by hand", "json")
def typed_by_hand() -> Decoder:
    from failover.core.messaging.by_hand import Typed

    whole = msgspec.json.encode(ASKED)
    return Decoder([whole, whole + b"\n \n" + whole, b'{"a": "}\\"{"}'], lambda content: _in_pieces(Typed().take, content))


@target("who calls a driver over a socket of this machine: messages with their lengths")
def framed_messages() -> Decoder:
    from failover.drivers.local import Framed, framed

    return Decoder([framed(b"{}"), framed(b"{}") * 3, framed(bytes(300))], lambda content: _in_pieces(Framed().take, content))


@target("another robot, by a takeover: the mailbox that a driver keeps", "msgpack")
def kept_mailbox() -> Decoder:
    from failover.core.messaging import envelope, mailbox
    from failover.core.messaging.mailbox import Stream

    answer = envelope.decode(msgspec.json.encode(ANSWERED))
    kept = [("me", Stream(3, 4, 4, {4: answer})), ("you", Stream(1))]
    return Decoder([msgspec.msgpack.encode(kept), b""], lambda content: mailbox.Mailbox(mailbox.unpacked(content)).packed())


@target("who prints a line for failover team join", "text")
def invitation_line() -> Decoder:
    from failover.config import invitation
    from failover.config.invitation import Invitation

    made = [Invitation("robot2", "10.0.0.1", 7480, bytes(range(16))), Invitation("w", "fe80::1", 1, bytes(16), "witness")]

    def call(content: bytes) -> object:
        found = invitation.read(content.decode(errors="surrogateescape"))
        return found.inviting_secret(), found.joining_secret()

    return Decoder([one.line.encode() for one in made], call)


@target("who has an invitation: its answer, and what it asks", "msgpack")
def invitation_answer() -> Decoder:
    from failover.cli.verbs import team_invitations as verbs
    from failover.config.invitation import Invitation

    line = Invitation("robot2", "10.0.0.1", 7480, bytes(16))
    seeds = [verbs.Welcome("no"), verbs.Welcome(files={"team.toml": b'team = "lab"\n', "rights.toml": b""})]
    return Decoder([msgspec.msgpack.encode(one) for one in seeds], lambda content: verbs._understood(content, line))


@target("who has an invitation: what it says of itself; then the team file is read", "msgpack")
def invitation_wish() -> Decoder:
    import argparse

    from failover.cli.verbs import team_invitations as verbs
    from failover.config import team
    from failover.config.team import Robot
    from tests.fuzz.target import scratch

    directory = scratch()
    first = team.Team("lab", {"robot1": Robot(("10.0.0.1:7400",), "10.0.0.1:7401", public_key=KEY)})
    arguments = argparse.Namespace(directory=str(directory), role="robot", json=True, socket=str(directory / "none"))
    wish = verbs.Wish(verbs.VERSION, "robot2", Robot(("10.0.0.2:7400",), "10.0.0.2:7401", public_key=KEY[::-1]))

    def call(content: bytes) -> object:
        team.write(directory, first)
        welcome = verbs._welcome(arguments, "robot2", content)
        found = team.read(directory)
        assert set(found.robots) == ({"robot1"} if welcome.refusal else {"robot1", "robot2"}), welcome
        assert found.robots["robot1"].public_key == KEY, "another member was changed"
        return welcome

    return Decoder([msgspec.msgpack.encode(wish)], call)


KEY = "0123456789abcdefghijklmnopqrstuvwxyzABCD"
"""Characters of a public key."""


@target("a member: lines of its event log", "json")
def event_log_line() -> Decoder:
    import zlib

    from agent import event_log
    from tests.agent.main_loop.test_event_log_writer import line

    packed = event_log.packed(line(1))

    def call(content: bytes) -> object:
        return event_log.unpacked(b"%08x %b" % (zlib.crc32(content), content)), event_log.unpacked(content)

    return Decoder([packed[event_log.SUM_SIZE :].rstrip(b"\n")], call)
