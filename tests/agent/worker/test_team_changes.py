"""Changes of the team at several members at once: lost answers, rivals, clients that go, one robot's word, keys replaced.

The members are real but for the lines between them: files, settings and grants are theirs. What a line loses is told by the test.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from msgspec.structs import replace as changed

from agent import config as configuration
from agent.coordinator_config import CoordinatorConfig
from agent.errors import RefusedError
from agent.main_loop.messages import Told
from agent.worker import team_changes
from agent.worker.network.replication_link import new_keys, public_key_of
from agent.worker.team_changes import Answer, TeamChanges, told_of
from failover.config import members, team
from failover.config.team import Robot, Role, Team
from failover.core import acts, events
from failover.core.team_changes import Elections
from failover.core.types import ENDED, ComponentView, PeerView, Protection, State, StatusView

JOINING = Robot(("127.0.0.1:7490",), "127.0.0.1:7491")


def robot(number: int, role: Role = "robot") -> Robot:
    return Robot((f"127.0.0.1:74{number}0",), f"127.0.0.1:74{number}1", role)


class Member:
    """One robot: the lines of `TeamChanges` as the test wants them."""

    def __init__(self, town: Town, name: str, place: Path) -> None:
        self.town, self.name = town, name
        team.write(place / "team", town.team)
        path = place / "agent.toml"
        places = "".join(f'{part}_directory = "{place / part}"\n' for part in ("team", "state", "runtime"))
        path.write_text(f'robot = "{name}"\ninsecure = {"false" if town.secrets else "true"}\n{places}')
        if town.secrets:
            team.write_secret_key(place / "team", name, town.secrets[name])
        self.place = place / "team"
        self.begin(path)

    def begin(self, path: Path) -> None:
        """As its agent starts: with what is on the disk."""
        self.settings = configuration.load(path)
        self.changes = TeamChanges(self)
        self.runs: list[ComponentView] = []
        self.stopped: list[str] = []
        self.taken: list[Team] = []
        self.secrets: list[str] = []
        self.errands: Any = self

    @property
    def on_disk(self) -> list[str]:
        return sorted(team.read(self.place).robots)

    async def ask(self, what: Any) -> Told:
        peers = tuple(
            PeerView(peer, "dead" if self.town.is_cut(self.name, peer) else "alive", 1, 10**12, True, 0)
            for peer in self.settings.peers
        )
        ended = frozenset(one.name for one in self.runs if one.state in ENDED)
        known = Elections({one.name: one.epoch for one in self.runs}, ended)
        status = StatusView(self.name, 1, "pair", "", True, peers, tuple(self.runs))
        return Told(1, 0, elections=known) if what == "elections" else Told(1, 0, status=status)

    async def command(self, make: Callable[[int], events.Command]) -> acts.Answer:
        order = make(1)
        assert isinstance(order, events.Stop)
        self.stopped.append(order.component)
        return acts.Answer(1, True, "")

    def hindrance(self, peer: str) -> str:
        return "it is away" if self.town.is_cut(self.name, peer) else ""

    async def take_team(self, after: Team) -> None:
        await asyncio.sleep(0)
        self.taken.append(after)
        self.settings = self.settings.with_team(after)

    async def take_secret(self, secret: str) -> None:
        self.settings = self.settings.with_secret(secret)
        self.secrets.append(secret)

    async def send(self, peer: str, verb: str, arguments: dict[str, Any], by: int = 0, patience_s: float = 0) -> dict[str, Any]:
        """As `Errands.send`."""
        if self.hindrance(peer):
            raise RefusedError("cannot ask it")
        await self.town.before(self.name, peer, verb)
        answer = await self.town.members[peer].changes.orders()[verb](self.name, arguments)
        await self.town.after(self.name, peer, verb)
        return answer

    async def change(self, act: str, name: str, member: Robot | None = None) -> dict[str, Any]:
        """As a person gives the command there."""
        said: Any = SimpleNamespace(caller=SimpleNamespace(uid=0))
        arguments: dict[str, Any] = {"act": act, "robot": name}
        return await self.changes.verb(said, arguments | ({"member": member} if member else {}))


async def _nothing(_one: str, _other: str, _verb: str) -> None:
    await asyncio.sleep(0)


class Town:
    """The members, and who cannot reach whom."""

    def __init__(
        self,
        place: Path,
        *names: str,
        roles: dict[str, Role] | None = None,
        keyed: bool = False,
        sites: dict[str, str] | None = None,
    ) -> None:
        pairs = {name: new_keys() for name in names} if keyed else {}
        self.secrets = {name: secret for name, (_, secret) in pairs.items()}
        self.team = Team("lab", {name: robot(number, (roles or {}).get(name, "robot")) for number, name in enumerate(names, 1)})
        self.team = replace(members.joined(self.team, "z", robot(8)), change=0)
        self.team = replace(self.team, robots={name: one for name, one in self.team.robots.items() if name != "z"})
        known = {name: replace(one, public_key=pairs[name][0] if pairs else "") for name, one in self.team.robots.items()}
        self.team = replace(self.team, robots={name: one.at((sites or {}).get(name, "")) for name, one in known.items()})
        self.cuts: set[frozenset[str]] = set()
        self.before: Callable[[str, str, str], Awaitable[None]] = _nothing
        self.after: Callable[[str, str, str], Awaitable[None]] = _nothing
        self.members = {name: Member(self, name, place / name) for name in names}

    def is_cut(self, one: str, other: str) -> bool:
        return not {one, other} <= set(self.members) or frozenset((one, other)) in self.cuts

    def cut_off(self, name: str) -> None:
        self.cuts |= {frozenset((name, other)) for other in self.members if other != name}

    def loses(self, verb: str, to: str) -> Callable[[str, str, str], Awaitable[None]]:
        async def lose(_one: str, other: str, what: str) -> None:
            if (what, other) == (verb, to):
                raise RefusedError("lost")

        return lose

    def __getitem__(self, name: str) -> Member:
        return self.members[name]


def view(name: str, primary: str, standby: str = "", state: State = State.PRIMARY, epoch: int = 1) -> ComponentView:
    return ComponentView(name, state, epoch, primary, standby, Protection.PROTECTED, 0, 0, (), "")


@pytest.fixture(autouse=True)
def ended(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Agents that would have ended."""
    ends: list[str] = []
    monkeypatch.setattr(team_changes, "end_agent", lambda: ends.append("an agent"))
    monkeypatch.setattr(team_changes, "LEAVE_S", 0)
    return ends


def test_all_take_a_change_that_all_grant(tmp_path: Path) -> None:
    town = Town(tmp_path, "a", "b", "c")
    answer = asyncio.run(town["a"].change("add", "d", JOINING))
    assert answer == {"team": "lab", "robots": ["a", "b", "c", "d"], "change": 1, "waiting": []}
    assert all(member.on_disk == ["a", "b", "c", "d"] and len(member.taken) == 1 for member in town.members.values())


def test_a_member_that_is_away_prevents_a_change_of_the_others(tmp_path: Path) -> None:
    """Else it would fall behind by two, and its old majority have no member in common with the new one."""
    town = Town(tmp_path, "a", "b", "c")
    town.cut_off("c")
    with pytest.raises(RefusedError, match="c cannot be reached; nothing has changed"):
        asyncio.run(town["a"].change("add", "d", JOINING))
    assert town["a"].on_disk == town["b"].on_disk == ["a", "b", "c"]


def test_a_member_one_change_behind_is_told_before_it_is_asked_for_the_next(tmp_path: Path) -> None:
    async def live() -> None:
        town = Town(tmp_path, "a", "b", "c", "d")
        town.cut_off("d")
        town.before = town.loses("team_taken", "c")
        assert (await town["a"].change("remove", "d"))["waiting"] == ["c"]
        with pytest.raises(RefusedError, match="c: it has change 0 of the team, and a has 1"):
            await town["a"].change("add", "e", robot(7))
        town.before = _nothing
        assert (await town["a"].change("add", "e", robot(7)))["waiting"] == []
        assert town["c"].on_disk == ["a", "b", "c", "e"]

    asyncio.run(live())


def test_of_two_that_change_the_team_at_once_at_most_one_does(tmp_path: Path) -> None:
    async def live() -> None:
        town = Town(tmp_path, "a", "b", "c")
        await asyncio.gather(
            town["a"].change("add", "d", JOINING), town["b"].change("add", "e", robot(7)), return_exceptions=True
        )
        assert len({tuple(member.on_disk) for member in town.members.values()}) == 1
        await town["c"].change("add", "d", JOINING)  # no grant is left over
        assert all("d" in member.on_disk for member in town.members.values())

    asyncio.run(live())


def test_a_command_that_fails_at_a_robot_leaves_the_grant_that_it_gave_to_another(tmp_path: Path) -> None:
    async def live() -> None:
        town = Town(tmp_path, "a", "b", "c")

        async def meanwhile(one: str, other: str, verb: str) -> None:
            if (one, other, verb) == ("a", "c", "team_grant"):
                for wrong in ("nobody", "b"):
                    with pytest.raises(RefusedError):
                        await town["b"].change("remove", wrong)
                assert town["b"].changes._grants.proposer == "a"

        town.after = meanwhile
        assert (await town["a"].change("add", "d", JOINING))["waiting"] == []

    asyncio.run(live())


def test_a_member_frees_its_own_grant_alone(tmp_path: Path) -> None:
    async def live() -> None:
        town = Town(tmp_path, "a", "b", "c")
        grants = town["b"].changes._grants
        assert grants.ask(0, 0, "a", 1) == ""
        await town["b"].changes.orders()["team_let_go"]("c", {})
        assert grants.proposer == "a"
        await town["b"].changes.orders()["team_let_go"]("a", {})
        assert grants.proposer == ""

    asyncio.run(live())


def test_a_lost_grant_frees_the_others_and_nothing_changes(tmp_path: Path) -> None:
    async def live() -> None:
        town = Town(tmp_path, "a", "b", "c")
        town.after = town.loses("team_grant", "c")
        with pytest.raises(RefusedError, match="c cannot be reached"):
            await town["a"].change("add", "d", JOINING)
        town.after = _nothing
        assert {member.changes._grants.proposer for member in town.members.values()} == {""}
        await town["b"].change("add", "d", JOINING)

    asyncio.run(live())


def test_a_file_that_cannot_be_written_frees_every_grant(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: Any) -> None:
        raise OSError(30, "Read-only file system")

    async def live() -> None:
        town = Town(tmp_path, "a", "b")
        with monkeypatch.context() as patch:
            patch.setattr(team, "write", fail)
            with pytest.raises(RefusedError, match="Read-only"):
                await town["a"].change("add", "d", JOINING)
        assert town["b"].changes._grants.proposer == ""
        assert (await town["b"].change("add", "d", JOINING))["waiting"] == []

    asyncio.run(live())


def test_a_change_goes_on_when_its_client_hangs_up(tmp_path: Path) -> None:
    async def live() -> None:
        town = Town(tmp_path, "a", "b", "c")
        asked = asyncio.Event()

        async def notice(_one: str, _other: str, verb: str) -> None:
            if verb == "team_taken":
                asked.set()
                await asyncio.sleep(0.01)

        town.before = notice
        client = asyncio.create_task(town["a"].change("add", "d", JOINING))
        await asked.wait()
        client.cancel()
        await asyncio.gather(*town["a"].changes._work, return_exceptions=True)
        assert all(member.on_disk == ["a", "b", "c", "d"] for member in town.members.values())
        assert not town["a"].changes._busy.locked()

    asyncio.run(live())


def test_an_older_change_that_comes_late_overwrites_no_newer_one(tmp_path: Path) -> None:
    async def live() -> None:
        town = Town(tmp_path, "a", "b")
        first = members.joined(town.team, "d", JOINING)
        second = members.joined(first, "e", robot(7))
        town["a"].settings = town["a"].settings.with_team(first)
        new = asyncio.create_task(town["b"].changes.orders()["team_taken"]("a", told_of(second)))
        old = asyncio.create_task(town["b"].changes.orders()["team_taken"]("a", told_of(first)))
        await asyncio.gather(old, new, return_exceptions=True)
        assert (town["b"].settings.team.change, town["b"].on_disk) == (2, ["a", "b", "d", "e"])
        assert [one.change for one in town["b"].taken] == [2]

    asyncio.run(live())


# --- What was elected -------------------------------------------------------------------------------------------------


def four_that_know(tmp_path: Path, *epochs: int) -> Town:
    """a, b, c and d, each of which knows that a was elected to run /x in such an epoch."""
    town = Town(tmp_path, "a", "b", "c", "d")
    for name, epoch in zip("abcd", epochs, strict=True):
        town[name].runs = [view("/x", "a", epoch=epoch)]
    return town


def test_a_change_waits_until_the_members_after_it_know_what_was_elected(tmp_path: Path) -> None:
    """Else they could elect another primary with the same epoch: those that elected the first one have left, or are lost."""

    async def live() -> None:
        town = four_that_know(tmp_path, 3, 2, 3, 2)
        asked = 0

        async def hear(_one: str, other: str, verb: str) -> None:
            nonlocal asked
            if (verb, other) == ("team_grant", "b"):
                asked += 1
                assert town["a"].on_disk == ["a", "b", "c", "d"]
                if asked == 3:
                    town["b"].runs = [view("/x", "a", epoch=3)]

        town.before = hear
        assert (await town["a"].change("remove", "c"))["waiting"] == [] and asked == 3
        assert town["d"].on_disk == ["a", "b", "d"]

    asyncio.run(live())


def test_a_change_that_waits_too_long_says_for_whom_and_frees_all_grants(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(team_changes, "AWARE_PATIENCE_NS", 0)
    town = four_that_know(tmp_path, 3, 2, 2, 3)
    with pytest.raises(RefusedError, match="b, c: not told yet which robot runs /x in epoch 3; nothing has changed"):
        asyncio.run(town["a"].change("remove", "d"))
    assert {member.changes._grants.proposer for member in town.members.values()} == {""}
    assert town["a"].on_disk == ["a", "b", "c", "d"]


def test_no_change_waits_for_a_component_that_has_ended(tmp_path: Path) -> None:
    town = Town(tmp_path, "a", "b", "c", "d")
    for name, state, epoch in zip("abcd", ("finished", "standby", "standby", "released"), (3, 2, 2, 3), strict=True):
        town[name].runs = [view("/x", "", state=State(state), epoch=epoch)]
    asyncio.run(town["a"].change("remove", "d"))
    assert town["b"].on_disk == ["a", "b", "c"]


def answers_as_an_older_release(town: Town, name: str, monkeypatch: pytest.MonkeyPatch, *known: str) -> None:
    """A member's grants tell these alone."""
    granted = town[name].changes._granted

    async def by_the_release_before(peer: str, arguments: dict[str, Any]) -> dict[str, Any]:
        answer = await granted(peer, arguments)
        return {key: answer[key] for key in known}

    orders = {**town[name].changes.orders(), "team_grant": by_the_release_before}
    monkeypatch.setattr(town[name].changes, "orders", lambda: orders)


def test_no_change_waits_for_a_member_whose_release_tells_no_elections(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(team_changes, "AWARE_PATIENCE_NS", 0)
    town = four_that_know(tmp_path, 3, 2, 3, 2)
    with pytest.raises(RefusedError, match="b, d: not told yet"):
        asyncio.run(town["a"].change("remove", "c"))
    answers_as_an_older_release(town, "b", monkeypatch, "refusal", "sees", "members")
    asyncio.run(town["a"].change("remove", "c"))
    assert town["b"].on_disk == ["a", "b", "d"]


def test_keys_are_replaced_without_a_wait_for_elections(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(team_changes, "AWARE_PATIENCE_NS", 0)
    town = Town(tmp_path, "a", "b", "c", keyed=True)
    for name, epoch in (("a", 2), ("b", 3), ("c", 3)):
        town[name].runs = [view("/x", "b", epoch=epoch)]
    asyncio.run(town["a"].change("rotate", ""))
    told = {name: Answer(True, rule="etcd", elections=Elections({"/x": epoch})) for name, epoch in (("a", 3), ("b", 2), ("c", 2))}
    assert team_changes._waits(town.team, members.with_next_key(town.team, "a", new_keys()[0]), told) == ""
    assert team_changes._waits(town.team, members.left(town.team, "c", "a"), told), "etcd and b would be a majority"


@pytest.mark.parametrize("names", ["a b", "a"])
def test_members_that_elect_nothing_wait_for_no_election(tmp_path: Path, names: str) -> None:
    town = Town(tmp_path, *names.split())
    town["a"].runs = [view("/x", "a", epoch=3)]
    if names == "a":
        asyncio.run(town["a"].change("add", "b", JOINING))
        assert town["a"].on_disk == ["a", "b"]
    else:
        town.cut_off("b")
        asyncio.run(town["a"].change("remove", "b"))
        assert town["a"].on_disk == ["a"]


# --- What one robot says ----------------------------------------------------------------------------------------------


def test_one_robots_word_dissolves_no_team(tmp_path: Path) -> None:
    async def live() -> None:
        town = Town(tmp_path, "a", "b", "c")
        for change in (1, 7, 1 << 39):
            alone = replace(town.team, robots={"c": town.team.robots["c"]}, change=change)
            with pytest.raises(RefusedError, match="a does not have change"):
                await town["b"].changes.orders()["team_taken"]("c", told_of(alone))
        assert town["b"].on_disk == ["a", "b", "c"] and not town["b"].taken

    asyncio.run(live())


def test_a_number_beyond_all_is_refused(tmp_path: Path) -> None:
    town = Town(tmp_path, "a", "b")
    beyond = replace(members.joined(town.team, "d", JOINING), change=1 << 63)
    with pytest.raises(RefusedError, match="cannot be right"):
        asyncio.run(town["b"].changes.orders()["team_taken"]("a", told_of(beyond)))


def test_a_robot_that_is_reached_by_too_few_believes_nothing(tmp_path: Path) -> None:
    town = Town(tmp_path, "a", "b", "c", "d", "e")
    town.cut_off("b")
    town.cuts.discard(frozenset(("a", "b")))
    told = told_of(members.joined(town.team, "f", robot(7)))
    with pytest.raises(RefusedError, match="too few other members"):
        asyncio.run(town["b"].changes.orders()["team_taken"]("a", told))


def test_a_grant_is_for_one_team_and_one_robot(tmp_path: Path) -> None:
    async def live() -> None:
        town = Town(tmp_path, "a", "b", "c")
        asked = told_of(members.joined(town.team, "d", JOINING)) | {"proposer": "a", "have": 0}
        orders = town["b"].changes.orders()
        assert "other members" in (await orders["team_grant"]("c", asked))["refusal"], "in another robot's name"
        assert (await orders["team_grant"]("a", asked))["refusal"] == ""
        other = told_of(members.joined(town.team, "e", robot(7)))
        with pytest.raises(RefusedError, match="does not have change 1"):
            await orders["team_taken"]("a", other)
        await orders["team_taken"]("a", asked)
        assert town["b"].on_disk == ["a", "b", "c", "d"]

    asyncio.run(live())


def test_a_witness_passes_a_change_on_and_is_not_believed_alone(tmp_path: Path) -> None:
    async def live() -> None:
        town = Town(tmp_path, "a", "b", "w", roles={"w": "witness"})
        after = members.joined(town.team, "d", JOINING)
        told = town["b"].changes.orders()["team_taken"]
        town.cut_off("a")
        with pytest.raises(RefusedError, match="only w tells"):
            await told("w", told_of(after))
        town.cuts.clear()
        town["a"].settings = town["a"].settings.with_team(after)
        await told("w", told_of(after))
        assert town["b"].on_disk == ["a", "b", "d", "w"]

    asyncio.run(live())


# --- Members that leave -----------------------------------------------------------------------------------------------


def test_a_member_that_lives_is_asked_and_ends(tmp_path: Path, ended: list[str]) -> None:
    async def live() -> None:
        town = Town(tmp_path, "a", "b", "c")
        assert (await town["a"].change("remove", "c"))["waiting"] == []
        await asyncio.sleep(0.01)
        assert all(member.on_disk == ["a", "b"] for member in town.members.values()) and ended

    asyncio.run(live())


def test_two_that_take_each_other_out_at_once_do_not_both_leave(tmp_path: Path, ended: list[str]) -> None:
    async def live() -> None:
        town = Town(tmp_path, "a", "b")
        await asyncio.gather(town["a"].change("remove", "b"), town["b"].change("remove", "a"), return_exceptions=True)
        await asyncio.sleep(0.01)
        assert len(ended) <= 1
        assert any(name in town[name].on_disk for name in "ab")

    asyncio.run(live())


def test_a_member_that_one_of_the_others_hears_is_not_taken_out_as_lost(tmp_path: Path) -> None:
    """Also where it runs nothing: from three to two the rule goes over to pair, and it would act for ever."""
    town = Town(tmp_path, "a", "b", "c")
    town.cuts.add(frozenset(("a", "c")))
    with pytest.raises(RefusedError, match="c lives, as b sees"):
        asyncio.run(town["a"].change("remove", "c"))
    town["b"].runs = [view("/x", "c")]
    with pytest.raises(RefusedError, match="b: c runs /x"):
        asyncio.run(town["a"].change("remove", "c"))


def test_with_etcd_a_robot_that_nobody_hears_stays_in_a_team_of_two_where_etcds_vote_lets_it_act(tmp_path: Path) -> None:
    """Else a third one joins, and is a majority with the second one that shares no vote with that of the first one and etcd."""
    for names, is_refused in (("ab", True), ("abc", False)):
        town = Town(tmp_path / names, *names)
        etcd = CoordinatorConfig(["http://127.0.0.1:2379"])
        for member in town.members.values():
            config = replace(member.settings.config, rule="etcd", lease_ms=1_800, coordinator=etcd)
            member.settings = replace(member.settings, config=config)
        town.cut_off("a")
        if is_refused:
            with pytest.raises(RefusedError, match="nobody hears a, which may act by etcd's vote"):
                asyncio.run(town["b"].change("remove", "a"))
            assert town["b"].on_disk == ["a", "b"]
        else:
            asyncio.run(town["b"].change("remove", "a"))
            assert town["b"].on_disk == ["b", "c"]


def test_a_robot_that_was_lost_hears_that_it_is_out_stops_its_copy_and_ends(tmp_path: Path, ended: list[str]) -> None:
    async def live() -> None:
        town = Town(tmp_path, "a", "b", "c")
        town.cut_off("c")
        await town["a"].change("remove", "c")
        assert list(team.read(town["a"].place).former) == ["c"]
        town["c"].runs = [view("/x", "c")]
        town.cuts.clear()
        town["a"].changes.heard("c", 0, 0)  # it greets
        await town["a"].changes._tell_who_is_behind()
        await asyncio.sleep(0.01)
        assert town["c"].stopped == ["/x"] and ended and town["c"].on_disk == ["a", "b"]

    asyncio.run(live())


def test_a_lost_answer_of_the_one_that_leaves_ends_nothing_half_way(tmp_path: Path) -> None:
    async def live() -> None:
        town = Town(tmp_path, "a", "b", "c")
        town.before = town.loses("team_taken", "c")
        await town["a"].change("remove", "c")
        assert town["a"].on_disk == town["b"].on_disk == ["a", "b"]
        assert "c" in town["a"].changes._behind, "it is told when it can be"

    asyncio.run(live())


@pytest.mark.parametrize(
    ("shown", "is_away", "said"),
    [
        (view("/x", "c"), False, "c runs /x"),
        (view("/x", "a", "c"), False, "holds the newest checkpoint of /x"),
        (view("/x", "c"), True, "alone may hold the newest checkpoint of /x"),
    ],
)
def test_the_only_holder_of_a_newest_checkpoint_is_not_taken_out(
    tmp_path: Path, shown: ComponentView, is_away: bool, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    town = Town(tmp_path, "a", "b", "c")
    town["a"].runs = [shown]
    if is_away:
        town.cut_off("c")

    async def seen(_what: Any) -> Told:
        peers = (PeerView("b", "alive", 1, 0, True, 0), PeerView("c", "dead" if is_away else "alive", 1, 10**9, True, 0))
        return Told(1, 0, status=StatusView("a", 1, "majority", "", True, peers, (shown,)))

    monkeypatch.setattr(town["a"], "ask", seen)
    with pytest.raises(RefusedError, match=said):
        asyncio.run(town["a"].change("remove", "c"))
    town["a"].runs = [changed(shown, state=State.FINISHED)]


def test_a_robot_that_was_not_heard_since_the_start_may_be_starting_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    town = Town(tmp_path, "a", "b")
    town.cut_off("b")
    silent_ns = 10**9

    async def seen(_what: Any) -> Told:
        return Told(1, 0, status=StatusView("a", 1, "pair", "", True, (PeerView("b", "unheard", 0, silent_ns, False, 0),), ()))

    monkeypatch.setattr(town["a"], "ask", seen)
    with pytest.raises(RefusedError, match="b lives and cannot be told"):
        asyncio.run(town["a"].change("remove", "b"))
    silent_ns = team_changes.UNHEARD_NS
    asyncio.run(town["a"].change("remove", "b"))
    assert town["a"].on_disk == ["a"]


def test_a_robot_whose_agent_restarts_lives() -> None:
    assert team_changes._may_live(PeerView("r2", "restarting", 1, 3_000_000_000, False, 0, awaited_ns=10_000_000_000))
    assert not team_changes._may_live(PeerView("r2", "dead", 1, 3_000_000_000, False, 0))


# --- Robots of other sites --------------------------------------------------------------------------------------------


def with_a_far_robot(place: Path, *rules: str) -> Town:
    """``c`` is alone at the site hall. ``rules``: those of a, b and c."""
    town = Town(place, "a", "b", "c", sites={"c": "hall"})
    for member, rule in zip(town.members.values(), rules, strict=False):
        config = replace(
            member.settings.config, rule=rule, coordinator=CoordinatorConfig(("http://10.0.0.1:2379",)), lease_ms=1_800
        )
        member.settings = replace(member.settings, config=config)
    return town


@pytest.mark.parametrize("rule", ["auto", "etcd"])
def test_a_robot_that_is_alone_at_its_site_is_asked_before_it_is_taken_out(tmp_path: Path, rule: str, ended: list[str]) -> None:
    town = with_a_far_robot(tmp_path, *([rule, rule] if rule == "etcd" else []))
    town["c"].runs = [view("/x", "c")]
    with pytest.raises(RefusedError, match="c: it runs /x: move them first"):
        asyncio.run(town["a"].change("remove", "c"))
    town.cuts = {frozenset("ac")}
    with pytest.raises(RefusedError, match="c lives, as b sees"):
        asyncio.run(town["a"].change("remove", "c"))
    assert not town["c"].stopped and not ended and town["a"].on_disk == ["a", "b", "c"]
    town.cuts.clear()
    town["c"].runs = []
    asyncio.run(town["a"].change("remove", "c"))
    assert town["a"].on_disk == town["b"].on_disk == ["a", "b"]


@pytest.mark.parametrize("rule", ["auto", "etcd"])
def test_a_robot_of_another_site_that_nobody_reaches_is_taken_out_by_whatever_rule_there_is_here(
    tmp_path: Path, rule: str
) -> None:
    town = with_a_far_robot(tmp_path, *([rule, rule] if rule == "etcd" else []))
    town.cut_off("c")
    asyncio.run(town["a"].change("remove", "c"))
    assert town["a"].on_disk == town["b"].on_disk == ["a", "b"]


def test_a_member_whose_release_knows_no_sites_grants_no_change_of_a_team_that_has_some(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    town = Town(tmp_path, "a", "b")
    answers_as_an_older_release(town, "b", monkeypatch, "refusal", "sees")
    with pytest.raises(RefusedError, match="it has sites, and the release of b knows none"):
        asyncio.run(town["a"].change("add", "d", JOINING.at("hall")))
    assert town["a"].on_disk == town["b"].on_disk == ["a", "b"]
    asyncio.run(town["a"].change("add", "d", JOINING))
    assert town["b"].on_disk == ["a", "b", "d"], "a team without sites goes on as before"


# --- Keys that are replaced -------------------------------------------------------------------------------------------


class PowerCutError(Exception):
    """The machine ends here."""


def knows(town: Town, whose: str) -> None:
    """Each member knows the key that this robot uses now, on its disk and as it works."""
    used = public_key_of(town[whose].settings.secret_key)
    assert used == public_key_of(team.read_secret_key(town[whose].place, whose))
    for member in town.members.values():
        assert used in member.settings.team.robots[whose].keys and used in team.read(member.place).robots[whose].keys


def test_a_robot_gets_other_keys_and_keeps_nothing_of_the_old_one(tmp_path: Path) -> None:
    async def live() -> None:
        town = Town(tmp_path, "a", "b", "c", keyed=True)

        async def look(*_: str) -> None:
            knows(town, "a")

        town.before = town.after = look
        answer = await town["a"].change("rotate", "")
        knows(town, "a")
        assert (answer["robot"], answer["change"], answer["waiting"]) == ("a", 2, [])
        assert town["a"].secrets == [town["a"].settings.secret_key] and not town["b"].secrets
        for member in town.members.values():
            assert member.settings.team.robots["a"].keys == (answer["public_key"],) != town.team.robots["a"].keys
            assert member.taken[0].robots["a"].keys[0] == town.team.robots["a"].public_key
        assert [path.name for path in (town["a"].place / "keys").iterdir()] == ["a.secret"]
        assert town["a"].changes.notes() == []

    asyncio.run(live())


def test_another_robot_has_it_done_and_hears_how_it_went(tmp_path: Path) -> None:
    async def live() -> None:
        town = Town(tmp_path, "a", "b", "c", keyed=True)
        answer = await town["b"].change("rotate", "a")
        assert answer["robot"] == "a" and town["c"].settings.team.robots["a"].keys == (answer["public_key"],)
        town.cut_off("c")
        with pytest.raises(RefusedError, match="c cannot be reached; nothing has changed"):
            await town["b"].change("rotate", "a")
        assert town["b"].settings.team.robots["a"].keys == (answer["public_key"],)
        with pytest.raises(RefusedError, match="cannot ask"):
            await town["b"].change("rotate", "c")

    asyncio.run(live())


def test_a_member_that_goes_away_between_keeps_the_old_key_valid_and_the_command_goes_on_later(tmp_path: Path) -> None:
    async def live() -> None:
        town = Town(tmp_path, "a", "b", "c", keyed=True)

        async def goes(_one: str, other: str, verb: str) -> None:
            if (other, verb) == ("c", "team_taken"):
                town.cut_off("c")
                raise RefusedError("lost")

        town.before = goes
        with pytest.raises(RefusedError, match="two keys of a count, the old one still: failover team rotate a goes on"):
            await town["a"].change("rotate", "")
        knows(town, "a")
        assert "two keys of a count" in town["a"].changes.notes()[0]
        assert not town["a"].secrets, "c knows the old one alone"
        town.cuts.clear()
        town.before = _nothing
        prepared = public_key_of(team.read_next_key(town["a"].place, "a"))
        answer = await town["a"].change("rotate", "")
        assert answer["public_key"] == prepared
        assert all(member.settings.team.robots["a"].keys == (prepared,) for member in town.members.values())

    asyncio.run(live())


def test_at_whatever_moment_its_power_fails_every_member_knows_the_key_that_it_uses_and_the_command_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It ends before and after each message, and before and after each file that it writes."""
    moments = 0

    async def live(place: Path, fails_at: int) -> bool:
        town = Town(place, "a", "b", "c", keyed=True)
        passed = 0

        def pass_on() -> None:
            nonlocal passed
            passed += 1
            if passed > fails_at:
                raise PowerCutError

        async def look(one: str, *_: str) -> None:
            if one == "a":
                pass_on()
                knows(town, "a")

        def fragile(write: Callable[..., None]) -> Callable[..., None]:
            def written(directory: Path, *rest: Any) -> None:
                is_here = directory == town["a"].place
                if is_here:
                    pass_on()
                write(directory, *rest)
                if is_here:
                    pass_on()

            return written

        with monkeypatch.context() as patch:
            for name in ("write", "write_next_key", "use_next_key"):
                patch.setattr(team, name, fragile(getattr(team, name)))
            town.before = town.after = look
            try:
                await town["a"].change("rotate", "")
            except (PowerCutError, RefusedError):
                pass
            else:
                assert fails_at >= passed
                return False
        town.before = town.after = _nothing
        town["a"].begin(place / "a" / "agent.toml")
        knows(town, "a")
        for peer in "bc":  # it greets
            mine = town["a"].settings.team
            town[peer].changes.heard("a", mine.change, team_changes.digest(mine.robots))
            theirs = town[peer].settings.team
            town["a"].changes.heard(peer, theirs.change, team_changes.digest(theirs.robots))
            town[peer].changes._grants.until_ns = 0  # a minute later
        for member in town.members.values():
            await member.changes._tell_who_is_behind()
        knows(town, "a")
        answer = await town["a"].change("rotate", "")
        for member in town.members.values():
            assert member.settings.team.robots["a"].keys == (answer["public_key"],)
            assert not member.changes.conflicts
        knows(town, "a")
        assert answer["public_key"] != town.team.robots["a"].public_key
        return True

    while True:
        place = tmp_path / str(moments)
        if not asyncio.run(live(place, moments)):
            break
        moments += 1
    assert moments > 20


def test_a_key_whose_secret_half_was_lost_is_taken_out_and_another_one_comes(tmp_path: Path) -> None:
    async def live() -> None:
        town = Town(tmp_path, "a", "b", keyed=True)
        town.before = town.loses("team_taken", "b")
        with pytest.raises(RefusedError, match="two keys of a count"):
            await town["a"].change("rotate", "")
        town.before = _nothing
        lost = town["a"].settings.me.next_key
        team.next_key_path(town["a"].place, "a").write_text("x" * 20)
        answer = await town["a"].change("rotate", "")
        assert answer["change"] == 4 and answer["public_key"] not in (lost, town.team.robots["a"].public_key)
        knows(town, "a")

    asyncio.run(live())


def test_a_disk_that_has_the_new_key_though_it_refused_is_believed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Else the new key would be taken out of the team, and this robot be shut out at its next start."""
    use = team.use_next_key

    def fails(*where: Any) -> None:
        use(*where)
        raise OSError(5, "Input/output error")

    async def live() -> None:
        town = Town(tmp_path, "a", "b", keyed=True)
        with monkeypatch.context() as patch:
            patch.setattr(team, "use_next_key", fails)
            with pytest.raises(RefusedError, match=r"Input/output error.*two keys of a count"):
                await town["a"].change("rotate", "")
        answer = await town["a"].change("rotate", "")
        knows(town, "a")
        assert answer["change"] == 2

    asyncio.run(live())


def test_no_other_robot_changes_a_members_keys_and_none_its_own_address(tmp_path: Path) -> None:
    async def live() -> None:
        town = Town(tmp_path, "a", "b", "c", keyed=True)
        grant = town["b"].changes.orders()["team_grant"]
        stolen = members.with_next_key(town.team, "a", new_keys()[0])
        asked = {"proposer": "c", "have": 0}
        assert "a alone may replace its key" in (await grant("c", told_of(stolen) | asked))["refusal"]
        entry = replace(town.team.robots["c"], bulk="127.0.0.1:7999")
        moved = replace(town.team, robots={**town.team.robots, "c": entry}, change=1)
        assert "nothing else of its entry" in (await grant("c", told_of(moved) | asked))["refusal"]
        at_once = members.with_one_key(town.team, "c", new_keys()[0])
        assert "c alone may replace its key" in (await grant("c", told_of(at_once) | asked))["refusal"]
        own = members.with_next_key(town.team, "c", new_keys()[0])
        assert (await grant("c", told_of(own) | asked))["refusal"] == ""

    asyncio.run(live())


def test_without_keys_there_is_none_to_replace_and_one_that_does_not_fit_is_not_replaced(tmp_path: Path) -> None:
    async def live() -> None:
        with pytest.raises(RefusedError, match="runs without keys"):
            await Town(tmp_path / "open", "a", "b")["a"].change("rotate", "")
        town = Town(tmp_path / "keyed", "a", "b", keyed=True)
        team.secret_key_path(town["a"].place, "a").write_text(new_keys()[1])
        with pytest.raises(RefusedError, match="does not belong to its public key"):
            await town["a"].change("rotate", "")

    asyncio.run(live())
