"""Two and more replication links on the loopback: which peers are admitted, which messages arrive, what is reported."""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
from collections.abc import Awaitable, Callable, Coroutine
from pathlib import Path
from typing import Any

import pytest

from agent.errors import LaneError
from agent.system import connection_quota
from agent.worker.network.replication_link import MEND, Callbacks, KeyOwners, Keys, LinkState, ReplicationLink, new_keys, shown
from failover.core.wire.messages import CHUNK_SIZE_MAX, Bulk, Cancel, Chunk

PATIENCE_S = 20.0


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


async def until(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(PATIENCE_S):
        while not condition():
            await asyncio.sleep(0.01)


class Pair:
    """robot1 and robot2, and what each of them heard."""

    def __init__(self, keys1: Keys, keys2: Keys) -> None:
        self.ports = {"robot1": free_port(), "robot2": free_port()}
        self.heard: dict[str, list[tuple[str, Bulk]]] = {"robot1": [], "robot2": []}
        self.unread: dict[str, list[tuple[str, str]]] = {"robot1": [], "robot2": []}
        self.links = {name: self.link(name, keys) for name, keys in (("robot1", keys1), ("robot2", keys2))}

    def link(self, name: str, keys: Keys) -> ReplicationLink:
        def receive(peer: str, message: Bulk) -> None:
            self.heard[name].append((peer, message))

        peers = {peer: f"127.0.0.1:{port}" for peer, port in self.ports.items() if peer != name}

        def unread(*sign: str) -> None:
            self.unread[name].append((sign[0], sign[1]))

        where = f"127.0.0.1:{self.ports[name]}"
        return ReplicationLink(name, where, peers, keys, Callbacks(receive, lambda *_: None, unread))

    def state(self, name: str) -> LinkState:
        other = next(peer for peer in self.ports if peer != name)
        return self.links[name].links[other].state

    def connected(self) -> bool:
        return all(self.state(name) is LinkState.CONNECTED for name in self.ports)


def run(keys1: Keys, keys2: Keys, body: Callable[[Pair], Awaitable[None]]) -> None:
    async def main() -> None:
        pair = Pair(keys1, keys2)
        for link in pair.links.values():
            link.open()
        try:
            await body(pair)
        finally:
            for link in pair.links.values():
                await link.close()

    coroutine: Coroutine[Any, Any, None] = main()
    asyncio.run(coroutine)


def team_keys() -> tuple[Keys, Keys]:
    pairs = {name: new_keys() for name in ("robot1", "robot2")}
    publics = {name: public for name, (public, _) in pairs.items()}
    return Keys(*pairs["robot1"], publics), Keys(*pairs["robot2"], publics)


@pytest.mark.parametrize("keyed", [True, False])
def test_words_and_chunks_arrive_whole_and_in_order(keyed: bool) -> None:
    keys1, keys2 = team_keys() if keyed else (Keys("", "", {}), Keys("", "", {}))

    async def body(pair: Pair) -> None:
        await until(pair.connected)
        pieces = [os.urandom(CHUNK_SIZE_MAX) for _ in range(20)]
        for index, piece in enumerate(pieces):
            await pair.links["robot1"].ship("robot2", Chunk(1, index, piece))
        pair.links["robot2"].say("robot1", Cancel(7))
        await until(lambda: len(pair.heard["robot2"]) == len(pieces) and bool(pair.heard["robot1"]))
        assert [message for _, message in pair.heard["robot2"]] == [Chunk(1, i, piece) for i, piece in enumerate(pieces)]
        assert pair.heard["robot1"] == [("robot2", Cancel(7))]

    run(keys1, keys2, body)


def test_an_attempt_that_gets_no_answer_is_given_up_and_made_again() -> None:
    """A listener whose queue is full answers no attempt, as a network does that is cut."""

    async def body(listener: socket.socket, fillers: list[socket.socket]) -> None:
        where = listener.getsockname()
        for filler in fillers:
            filler.setblocking(False)
            filler.connect_ex(where)
        await until(lambda: _attempts(where[1]) >= 1)  # an attempt of the fillers waits: the queue is full
        states: list[tuple[LinkState, str]] = []
        changed = Callbacks(lambda *_: None, lambda _, state, reason: states.append((state, reason)))
        link = ReplicationLink(
            "robot1", f"127.0.0.1:{free_port()}", {"robot2": f"127.0.0.1:{where[1]}"}, Keys("", "", {}), changed
        )
        try:
            link.open()
            await until(lambda: (LinkState.CONNECTING, "no agent listens there") in states)
        finally:
            await link.close()

    with socket.socket() as listener, contextlib.ExitStack() as files:
        listener.bind(("127.0.0.1", 0))
        listener.listen(0)
        asyncio.run(body(listener, [files.enter_context(socket.socket()) for _ in range(3)]))


def _attempts(port: int) -> int:
    """Connections to a port of the loopback that have begun and got no answer (SYN_SENT)."""
    lines = [line.split() for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
    return sum(int(words[2].rpartition(":")[2], 16) == port and words[3] == "02" for words in lines)


def test_a_stranger_with_a_key_of_its_own_is_refused_and_both_sides_say_so() -> None:
    keys1, keys2 = team_keys()
    public, secret = new_keys()
    stranger = Keys(public, secret, {**keys2.peers, "robot2": public})

    async def body(pair: Pair) -> None:
        await until(lambda: pair.state("robot2") is LinkState.REFUSED)
        assert "team.toml" in pair.links["robot2"].links["robot1"].reason
        assert pair.links["robot1"].strangers > 0
        pair.links["robot2"].say("robot1", Cancel(1))
        with pytest.raises(LaneError, match="down"):
            await pair.links["robot2"].ship("robot1", Chunk(1, 0, b"let me in"))
        assert pair.heard["robot1"] == []
        await until(lambda: len(pair.unread["robot1"]) > 1 and len(pair.unread["robot2"]) > 1)  # each is told again and again
        assert ("robot2", mismatch) in pair.unread["robot1"] and mismatch in pair.links["robot1"].troubles()
        assert any(peer == "robot1" and shown(public) in why for peer, why in pair.unread["robot2"])

    mismatch = f"robot2 presents the key {shown(public)}, and team.toml here has {shown(keys1.peers['robot2'])} for it: {MEND}"
    run(keys1, stranger, body)


def test_a_member_cannot_speak_under_another_members_name() -> None:
    keys1, _ = team_keys()
    public3, secret3 = new_keys()
    everybody = {**keys1.peers, "robot3": public3}

    async def body(pair: Pair) -> None:
        await until(lambda: pair.state("robot2") is LinkState.CONNECTED)
        before = pair.links["robot1"].strangers
        pair.links["robot2"].say("robot1", Cancel(1))
        await until(lambda: pair.links["robot1"].strangers > before)
        assert pair.heard["robot1"] == []

    run(Keys(keys1.public, keys1.secret, everybody), Keys(public3, secret3, everybody), body)


def test_a_link_that_is_lost_says_so_and_comes_back() -> None:
    keys1, keys2 = team_keys()

    async def body(pair: Pair) -> None:
        await until(pair.connected)
        await pair.links["robot2"].close()
        await until(lambda: pair.state("robot1") is not LinkState.CONNECTED)
        with pytest.raises(LaneError):
            await pair.links["robot1"].ship("robot2", Chunk(1, 0, b""))
        pair.links["robot2"] = pair.link("robot2", keys2)
        pair.links["robot2"].open()
        await until(pair.connected)
        pair.links["robot1"].say("robot2", Cancel(2))
        await until(lambda: ("robot1", Cancel(2)) in pair.heard["robot2"])

    run(keys1, keys2, body)


def hangs_up(connection: socket.socket) -> bool:
    """Whether the other end has hung up by now."""
    try:
        while connection.recv(1 << 16):
            pass  # ZeroMQ greets everybody
    except BlockingIOError:
        return False
    except ConnectionError:
        pass
    return True


def test_connections_of_strangers_are_limited_and_a_member_comes_in_beside_them() -> None:
    keys1, keys2 = team_keys()
    many = connection_quota.OTHERS_MAX + 40

    async def body(pair: Pair) -> None:
        port, strangers = pair.ports["robot1"], []
        await until(pair.connected)
        await pair.links["robot2"].close()
        try:
            for number in range(many):
                stranger = socket.create_connection(("127.0.0.1", port), source_address=(f"127.0.1.{number % 60 + 1}", 0))
                stranger.setblocking(False)
                strangers.append(stranger)
                await asyncio.sleep(0)
            await until(lambda: sum(map(hangs_up, strangers)) >= many - connection_quota.OTHERS_MAX)
            pair.links["robot2"] = pair.link("robot2", keys2)
            pair.links["robot2"].open()
            await until(pair.connected)
            (told,) = pair.links["robot1"].troubles()
            assert "connections to port" in told
            assert "were turned away, last from 127.0.1." in told
        finally:
            for stranger in strangers:
                stranger.close()

    run(keys1, keys2, body)


def test_one_address_holds_no_more_than_its_share() -> None:
    keys1, keys2 = team_keys()

    async def body(pair: Pair) -> None:
        await until(pair.connected)
        crowd = [socket.create_connection(("127.0.0.1", pair.ports["robot1"])) for _ in range(3 * connection_quota.ADDRESS_MAX)]
        for one in crowd:
            one.setblocking(False)
        await until(lambda: sum(map(hangs_up, crowd)) >= 2 * connection_quota.ADDRESS_MAX)
        assert pair.connected()
        assert any("were turned away" in told for told in pair.links["robot1"].troubles())
        for one in crowd:
            one.close()

    run(keys1, keys2, body)


# --- A key that is replaced -------------------------------------------------------------------------------------------


def test_both_keys_of_a_peer_count_and_the_old_one_is_refused_at_once_on_a_connection_that_stands() -> None:
    keys1, keys2 = team_keys()
    public, secret = new_keys()
    both = Keys(keys1.public, keys1.secret, keys1.peers, {"robot2": public})
    after = Keys(keys1.public, keys1.secret, {**keys1.peers, "robot2": public})

    async def body(pair: Pair) -> None:
        one, other = pair.links["robot1"], pair.links["robot2"]
        addresses = {name: f"127.0.0.1:{port}" for name, port in pair.ports.items()}
        await until(pair.connected)
        to_other = one.links["robot2"]
        await one.change({"robot2": addresses["robot2"]}, both)
        other.say("robot1", Cancel(1))
        await until(lambda: ("robot2", Cancel(1)) in pair.heard["robot1"])
        assert one.links["robot2"] is to_other and pair.connected(), "a second key interrupts nothing"

        await one.change({"robot2": addresses["robot2"]}, after)
        before = one.strangers
        other.say("robot1", Cancel(2))  # by the old key, on the connection that was admitted with it
        await until(lambda: one.strangers > before)
        assert ("robot2", Cancel(2)) not in pair.heard["robot1"]
        await until(lambda: pair.state("robot1") is LinkState.REFUSED)  # it proves the old key, too

        await other.change({"robot1": addresses["robot1"]}, Keys(public, secret, {**keys2.peers, "robot2": public}))
        await until(pair.connected)
        other.say("robot1", Cancel(3))
        await until(lambda: ("robot2", Cancel(3)) in pair.heard["robot1"])
        one.say("robot2", Cancel(4))
        await until(lambda: ("robot1", Cancel(4)) in pair.heard["robot2"])

    run(keys1, keys2, body)


def test_once_a_peer_has_used_its_new_key_the_old_one_is_refused_though_both_count_still() -> None:
    """Who has a copy of the old one could else greet in its name until the last moment."""
    keys1, keys2 = team_keys()
    public, secret = new_keys()
    both = Keys(keys1.public, keys1.secret, keys1.peers, {"robot2": public})

    async def body(pair: Pair) -> None:
        one, other = pair.links["robot1"], pair.links["robot2"]
        await until(pair.connected)
        other.say("robot1", Cancel(1))
        await until(lambda: ("robot2", Cancel(1)) in pair.heard["robot1"])
        address = {"robot1": f"127.0.0.1:{pair.ports['robot1']}"}
        await other.change(address, Keys(public, secret, {**keys2.peers, "robot2": public}))
        await until(pair.connected)
        other.say("robot1", Cancel(2))
        await until(lambda: ("robot2", Cancel(2)) in pair.heard["robot1"])
        before = one.strangers
        await other.change(address, keys2)
        await until(lambda: one.strangers > before)
        await until(lambda: pair.state("robot2") is LinkState.REFUSED)
        (trouble,) = (told for told in one.troubles() if told.startswith("robot2 presents"))
        assert (
            "has used its next key already: " in trouble
            and "failover team rotate robot2 ends" in trouble
            and "team.toml here has" not in trouble
        )

    run(both, keys2, body)


def test_a_team_file_without_the_next_key_brings_the_key_before_back() -> None:
    """A replacement that was begun can be undone: by a team file from before, at each robot."""
    public, following = new_keys()[0], new_keys()[0]
    own = new_keys()
    before = Keys(*own, {"robot2": public})
    both = Keys(*own, {"robot2": public}, {"robot2": following})
    owners = KeyOwners(both)
    owners.used(following, "robot2")
    owners.know(both)
    assert (owners.owner(public), owners.owner(following)) == (None, "robot2") and owners.is_replaced(public)
    owners.know(before)
    assert (owners.owner(public), owners.owner(following)) == ("robot2", None) and not owners.is_replaced(public)


@pytest.mark.parametrize("uses", ["the old one", "the new one"])
def test_a_peer_with_two_keys_is_found_by_the_one_that_it_uses_and_no_refusal_is_told(uses: str) -> None:
    keys1, keys2 = team_keys()
    public, secret = new_keys()
    both = Keys(keys1.public, keys1.secret, keys1.peers, {"robot2": public})
    used = keys2 if uses == "the old one" else Keys(public, secret, keys2.peers)

    async def body(pair: Pair) -> None:
        await until(pair.connected)
        pair.links["robot1"].say("robot2", Cancel(1))
        pair.links["robot2"].say("robot1", Cancel(2))
        await until(lambda: bool(pair.heard["robot1"] and pair.heard["robot2"]))
        assert pair.unread == {"robot1": [], "robot2": []}

    run(both, used, body)


def test_a_peer_that_has_neither_of_its_two_keys_is_refused_and_told_of() -> None:
    keys1, keys2 = team_keys()
    lost, other = new_keys(), new_keys()
    both = Keys(keys1.public, keys1.secret, {**keys1.peers, "robot2": lost[0]}, {"robot2": other[0]})

    async def body(pair: Pair) -> None:
        await until(lambda: pair.state("robot1") is LinkState.REFUSED)
        await until(lambda: len(pair.unread["robot1"]) > 3)  # again and again
        assert pair.heard == {"robot1": [], "robot2": []}

    run(both, keys2, body)
