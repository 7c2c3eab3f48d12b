"""From nothing to a protected team: create, invite, join, remove, with real agents, none of which is restarted."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
import zmq
from msgspec.structs import replace
from zmq.utils.monitor import parse_monitor_message

from failover.config.invitation import SECRET_SIZE, read
from tests.e2e import robots
from tests.e2e.growing import GrowingStage, machines, together
from tests.e2e.test_orders import COUNTING

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]


def agents(stage: GrowingStage, *names: str) -> list[tuple[int, int]]:
    """Process and life of each agent: others, if one was restarted."""
    return [(status["pid"], status["life"]) for status in (stage.machine(name).status() for name in names)]


def test_a_team_grows_by_one_line_a_robot_protects_a_program_and_goes_on_without_the_first(tmp_path: Path) -> None:
    with machines(tmp_path, 3) as stage:
        stage.create("robot1")
        first, second = stage.machine("robot1"), stage.machine("robot2")
        robots.run(first, "count", *COUNTING)
        pid = robots.component(first, "count")["pid"]
        before = agents(stage, "robot1")
        stage.brought("robot1", "robot2")
        together(stage, "robot1", "robot2")
        robots.until_protected(first)
        before += agents(stage, "robot2")
        stage.brought("robot2", "robot3")
        together(stage, "robot1", "robot2", "robot3")
        assert agents(stage, "robot1", "robot2") == before, "no agent was restarted"
        assert {stage.machine(name).status()["rule"] for name in stage.names} == {"majority"}
        counting = robots.component(first, "count")
        assert (counting["pid"], counting["epoch"], counting["restores"]) == (pid, 1, 0), "the program never moved"
        assert len({(stage.place(name) / "team.toml").read_text() for name in stage.names}) == 1
        assert [path.name for path in (stage.place("robot2") / "keys").iterdir()] == ["robot2.secret"], (
            "no secret key has travelled"
        )
        robots.until_protected(first)
        first.cut_power()
        heir = robots.until(lambda: acting(stage, "robot2", "robot3"), "another robot to resume it")
        robots.until(lambda: len(robots.numbers(stage.machine(heir))) > 100, "it to go on")
        counted = robots.numbers(stage.machine(heir))
        assert counted == list(range(len(counted)))
        ran = stage.typed("robot2", "remove", "robot1")
        assert ran.returncode == 0, ran.stderr
        together(stage, "robot2", "robot3")
        assert sorted(stage.members("robot3").robots) == ["robot2", "robot3"]
        listed = stage.typed("robot3", "list").stdout
        assert "robot2" in listed and "live" in listed and "here" in listed and "robot1" not in listed
        assert second.status()["life"] == before[1][1]


def acting(stage: GrowingStage, *names: str) -> str:
    """The robot that runs the component and has resumed it; "" for none."""
    for name in names:
        shown = robots.component(stage.machine(name), "count")
        if shown.get("role") == "primary" and shown.get("restores"):
            return name
    return ""


def test_no_team_changes_while_a_member_is_away_and_one_that_is_lost_is_taken_out_first(tmp_path: Path) -> None:
    with machines(tmp_path, 4) as stage:
        stage.create("robot1")
        stage.brought("robot1", "robot2")
        together(stage, "robot1", "robot2")
        stage.brought("robot1", "robot3")
        together(stage, "robot1", "robot2", "robot3")
        stage.machine("robot3").cut_power()
        robots.until(
            lambda: state_at(stage, "robot1", "robot3") == state_at(stage, "robot2", "robot3") == "dead", "robot3 to be dead"
        )
        before = (stage.place("robot1") / "team.toml").read_text()
        with stage.invited("robot1", "robot4") as (line, _):
            ran = stage.typed("robot4", "join", line, *stage.own_addresses("robot4"))
        assert ran.returncode == 1 and "robot3 cannot be reached" in ran.stderr
        assert (stage.place("robot1") / "team.toml").read_text() == before
        assert not stage.place("robot4").exists()
        ran = stage.typed("robot1", "remove", "robot3")
        assert ran.returncode == 0, ran.stderr
        stage.brought("robot1", "robot4", "--role", "witness")
        together(stage, "robot1", "robot2", "robot4")
        stage.switch_on("robot3", answers=False)
        robots.until(lambda: "robot3" not in stage.members("robot3").robots, "robot3 to hear that it is out")
        robots.until(lambda: not robots.answers(stage.machine("robot3")), "its agent to end")
        assert "robot3 was taken out of team lab" in stage.machine("robot3").log.read_text()


def state_at(stage: GrowingStage, at: str, of: str) -> str:
    return next((str(peer["state"]) for peer in stage.machine(at).status()["peers"] if peer["name"] == of), "")


def test_a_robot_that_runs_a_program_is_not_taken_out_and_one_that_runs_none_ends_its_agent(tmp_path: Path) -> None:
    with machines(tmp_path, 2) as stage:
        stage.create("robot1")
        stage.brought("robot1", "robot2")
        together(stage, "robot1", "robot2")
        robots.run(stage.machine("robot2"), "count", *COUNTING)
        robots.until_protected(stage.machine("robot2"))
        ran = stage.typed("robot1", "remove", "robot2")
        assert ran.returncode == 1 and "robot2 runs /lab/robot2/count: move them first" in ran.stderr
        ran = stage.typed("robot1", "remove", "robot1")
        assert ran.returncode == 1 and "cannot take itself out" in ran.stderr
        moved = robots.failover(stage.machine("robot2"), "handover", "count")
        assert moved.returncode == 0, moved.stderr
        agent = robots.host_pid(stage.machine("robot2"), stage.machine("robot2").status()["pid"])
        robots.keep_on(stage.machine("robot2"))
        ran = stage.typed("robot1", "remove", "robot2")
        assert ran.returncode == 0, ran.stderr
        robots.until(lambda: robots.has_ended(agent), "the agent of robot2 to end")
        assert sorted(stage.members("robot1").robots) == ["robot1"] == sorted(stage.members("robot2").robots)
        robots.start_agent(stage.machine("robot2"))
        log = stage.machine("robot2").log
        robots.until(lambda: "robot 'robot2' is not in" in log.read_text(), "an agent there to say why it does not begin")
        shown = robots.component(stage.machine("robot1"), "count")
        assert shown["role"] == "primary"


# --- Keys that are replaced -------------------------------------------------------------------------------------------


class Watch:
    """What the status of some robots says again and again, until it is told to end."""

    def __init__(self, stage: GrowingStage, *names: str) -> None:
        self._machines = [stage.machine(name) for name in names]
        self._is_over = threading.Event()
        self.components: set[tuple[object, ...]] = set()
        self.looks = self.protected = 0

    def _look(self) -> None:
        while not self._is_over.wait(0.02):
            for machine in self._machines:
                status = machine.status()
                for one in status["components"]:
                    self.components.add((machine.name, one["primary"], one["epoch"], one["restores"]))
                    self.protected += one["protection"] == "protected"
            self.looks += 1

    def __enter__(self) -> Watch:
        self._looking = threading.Thread(target=self._look)
        self._looking.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._is_over.set()
        self._looking.join()


def knocks(address: str, server_key: str, secret: str) -> str:
    """How a robot answers to one who connects with this secret key: the name of ZeroMQ's event."""
    with zmq.Context() as context, context.socket(zmq.DEALER) as link:
        link.setsockopt(zmq.LINGER, 0)
        link.curve_secretkey, link.curve_publickey = secret.encode(), zmq.curve_public(secret.encode())
        link.curve_serverkey = server_key.encode()
        monitor = link.get_monitor_socket(
            zmq.EVENT_HANDSHAKE_SUCCEEDED | zmq.EVENT_HANDSHAKE_FAILED_AUTH | zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
        )
        link.connect(f"tcp://{address}")
        assert monitor.poll(robots.PATIENCE_S * 1_000)
        event = parse_monitor_message(monitor.recv_multipart())["event"]
        link.disable_monitor()
        return str(event.name)


def test_a_robot_gets_other_keys_while_its_program_runs_on_protected(tmp_path: Path) -> None:
    with machines(tmp_path, 2) as stage:
        stage.create("robot1")
        stage.brought("robot1", "robot2")
        together(stage, "robot1", "robot2")
        first, second = stage.machine("robot1"), stage.machine("robot2")
        robots.run(first, "count", *COUNTING)
        robots.until_protected(first)
        pid, before = robots.component(first, "count")["pid"], agents(stage, "robot1", "robot2")
        key = stage.place("robot1") / "keys" / "robot1.secret"
        old, leaked = stage.members("robot1").robots["robot1"], key.read_text().strip()
        there = stage.members("robot1").robots["robot2"]
        assert knocks(there.bulk, there.public_key, leaked) == "HANDSHAKE_SUCCEEDED"
        with Watch(stage, "robot1", "robot2") as watch:
            ran = stage.typed("robot1", "rotate")
            assert ran.returncode == 0 and "robot1 has new keys" in ran.stdout, ran.stderr
            assert knocks(there.bulk, there.public_key, leaked) == "HANDSHAKE_FAILED_AUTH", "at once"
            assert knocks(old.bulk, old.public_key, leaked) == "HANDSHAKE_FAILED_NO_DETAIL", "it proves the old one no more"
            ran = stage.typed("robot1", "rotate", "robot2")
            assert ran.returncode == 0 and "robot2 has new keys" in ran.stdout, ran.stderr
            looks = watch.looks
            robots.until(lambda: watch.looks > looks + 50, "some more looks")
        assert watch.components == {("robot1", "robot1", 1, 0), ("robot2", "robot1", 1, 0)}, "it never moved"
        assert watch.protected > watch.looks // 2, "but where a busy machine holds beats up"
        assert robots.component(first, "count")["pid"] == pid and agents(stage, "robot1", "robot2") == before
        together(stage, "robot1", "robot2")
        now = stage.members("robot1")
        assert now == stage.members("robot2") and now.change == 5
        for name in stage.names:
            assert now.robots[name].next_key == "" and len(list((stage.place(name) / "keys").iterdir())) == 1
        assert {now.robots[name].public_key for name in stage.names}.isdisjoint({old.public_key, there.public_key})
        assert key.stat().st_mode & 0o777 == 0o600
        robots.counts_on_elsewhere(first, second, 20)


# --- Invitations that are refused --------------------------------------------------------------------------------------


@contextmanager
def two(tmp_path: Path) -> Iterator[GrowingStage]:
    """Robot1 is alone in its team, without an agent; robot2 has none."""
    with machines(tmp_path, 2) as stage:
        assert stage.typed("robot1", "create", "lab", *stage.own_addresses("robot1")).returncode == 0
        yield stage


def is_refused(stage: GrowingStage, line: str, *sentences: str, words: tuple[str, ...] = (), apart: bool = False) -> None:
    """Whoever types this line is refused, in a sentence, and nothing is left behind; nor does the team know it."""
    before = (stage.place("robot1") / "team.toml").read_text()
    ran = stage.typed("robot2", "join", line, *(words or stage.own_addresses("robot2")), apart=apart)
    assert ran.returncode == 1 and len(ran.stderr.splitlines()) == 2, ran.stderr  # the first: give no secret as an argument
    assert any(sentence in ran.stderr for sentence in sentences), ran.stderr
    assert not stage.place("robot2").exists(), sorted(stage.place("robot2").rglob("*"))
    assert (stage.place("robot1") / "team.toml").read_text() == before


def test_an_invitation_works_once(tmp_path: Path) -> None:
    with two(tmp_path) as stage:
        with stage.invited("robot1", "robot2") as (line, invites):
            ran = stage.typed("robot2", "join", line, *stage.own_addresses("robot2"))
            assert ran.returncode == 0, ran.stderr
            invites.wait(robots.PATIENCE_S)
        ran = stage.typed("robot2", "join", line, *stage.own_addresses("robot2"))
        assert ran.returncode == 1 and "has robot2 in team lab already" in ran.stderr
        (stage.place("robot2")).rename(tmp_path / "aside")
        is_refused(stage, line, "no invitation is open")


def test_an_invitation_ends_with_its_time_and_with_its_command(tmp_path: Path) -> None:
    with two(tmp_path) as stage:
        with stage.invited("robot1", "robot2", "--for", "1s") as (line, invites):
            _, said = invites.communicate(timeout=robots.PATIENCE_S)
            assert invites.returncode == 1 and "is over after 1s, and was not used" in said
            is_refused(stage, line, "no invitation is open")
        with stage.invited("robot1", "robot2") as (line, invites):
            invites.terminate()
            invites.wait(robots.PATIENCE_S)
            is_refused(stage, line, "no invitation is open")


def test_another_secret_or_another_name_is_refused_and_the_invitation_stays_open(tmp_path: Path) -> None:
    with two(tmp_path) as stage, stage.invited("robot1", "robot2") as (line, invites):
        given = read(line)
        is_refused(stage, replace(given, secret=bytes(SECRET_SIZE)).line, "does not know this invitation")
        (stage.directory / "robot2" / "agent.toml").write_text("")
        is_refused(stage, replace(given, robot="robot3").line, "does not know this invitation")
        is_refused(stage, line[:-1], "copy the line")
        is_refused(stage, line, "is no address of this machine", words=("--address", "203.0.113.9"))
        is_refused(stage, line, "a multicast address", words=("--address", "239.1.1.1"))
        taken = stage.members("robot1").robots["robot1"]
        twice = ("--address", taken.beats[0], "--bulk", taken.bulk)
        is_refused(stage, line, "robot1 has the beat address", words=twice)
        assert invites.poll() is None
        ran = stage.typed("robot2", "join", line, *stage.own_addresses("robot2"))
        assert ran.returncode == 0, ran.stderr
        assert 'robot = "robot2"' in (stage.directory / "robot2" / "agent.toml").read_text()


class Between:
    """A machine through which the joining side's connections go: it keeps every byte, and changes one if it is told to."""

    def __init__(self, port: int) -> None:
        self._to = ("127.0.0.1", port)
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        self.seen = bytearray()
        self.sent: list[bytes] = []
        self.change_at = -1
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        while True:
            try:
                near, _ = self._listener.accept()
                far = socket.create_connection(self._to)
            except OSError:
                return
            for ends in ((near, far, True), (far, near, False)):
                threading.Thread(target=self._pass_on, args=ends, daemon=True).start()

    def _pass_on(self, one: socket.socket, other: socket.socket, from_joiner: bool) -> None:
        passed = 0
        try:
            while content := bytearray(one.recv(65_536)):
                self.seen += content
                if from_joiner:
                    self.sent.append(bytes(content))
                    if passed <= self.change_at < passed + len(content):
                        content[self.change_at - passed] ^= 1
                passed += len(content)
                other.sendall(content)
        except OSError:
            pass
        for end in (one, other):
            end.close()

    def close(self) -> None:
        self._listener.close()


def test_who_listens_learns_no_key_and_joins_with_nothing_that_was_heard(tmp_path: Path) -> None:
    with two(tmp_path) as stage:
        with stage.invited("robot1", "robot2") as (line, invites):
            given = read(line)
            between = Between(given.port)
            ran = stage.typed("robot2", "join", replace(given, port=between.port).line, *stage.own_addresses("robot2"))
            assert ran.returncode == 0, ran.stderr
            invites.wait(robots.PATIENCE_S)
            between.close()
        keys = [robot.public_key for robot in stage.members("robot2").robots.values()]
        secrets = [path.read_text().strip() for path in stage.directory.glob("*/team/keys/*.secret")]
        assert len(keys) == 2 and len(secrets) == 2 and len(between.seen) > 500
        for word in (*map(str.encode, (*keys, *secrets, "robot1", "lab")), given.secret):
            assert word not in between.seen
        before = (stage.place("robot1") / "team.toml").read_text()
        with stage.invited("robot1", "robot3") as (line, invites):
            with socket.create_connection(("127.0.0.1", read(line).port)) as replayed:
                replayed.settimeout(robots.PATIENCE_S)
                with suppress(ConnectionResetError, BrokenPipeError):  # the inviter may end it before it has heard all
                    for content in between.sent:
                        replayed.sendall(content)
                    while replayed.recv(65_536):  # until it is ended
                        pass
            assert invites.poll() is None
            assert (stage.place("robot1") / "team.toml").read_text() == before


def test_who_changes_a_byte_on_the_way_puts_no_key_in(tmp_path: Path) -> None:
    with two(tmp_path) as stage, stage.invited("robot1", "robot2") as (line, _):
        given = read(line)

        def changed(change_at: int) -> None:
            between = Between(given.port)
            between.change_at = change_at
            told = "does not know this invitation", "did not answer", "was lost"
            is_refused(stage, replace(given, port=between.port).line, *told, apart=True)
            between.close()

        with ThreadPoolExecutor() as at_once:  # each waits for an answer, for half a minute
            list(at_once.map(changed, [70, 150, 320, 420]))


# --- Addresses that are found out -------------------------------------------------------------------------------------


@pytest.mark.root
@pytest.mark.skipif(not robots.has_cable(), reason="robots have no networks of their own here")
def test_addresses_are_found_out_on_machines_of_their_own(tmp_path: Path) -> None:
    with machines(tmp_path, 2, own_network=True) as stage:
        stage.create("robot1")
        stage.brought("robot1", "robot2")
        together(stage, "robot1", "robot2")
        members = stage.members("robot1").robots
        assert [members[name].beats for name in stage.names] == [("10.71.8.1:7420",), ("10.71.8.2:7420",)]
        assert members["robot2"].bulk == "10.71.8.2:7421"
        robots.run(stage.machine("robot1"), "count", *COUNTING)
        robots.until_protected(stage.machine("robot1"))
        robots.counts_on_elsewhere(stage.machine("robot1"), stage.machine("robot2"), 20)


def test_robots_of_another_site_join_and_each_site_decides_for_itself(tmp_path: Path) -> None:
    with machines(tmp_path, 4) as stage:
        stage.create("robot1")
        stage.brought("robot1", "robot2")
        together(stage, "robot1", "robot2")
        stage.brought("robot1", "robot3", "--site", "hall")
        stage.brought("robot3", "robot4")  # at the site of the robot that invites it
        together(stage, "robot3", "robot4")
        together(stage, "robot1", "robot2")
        sites = {name: member.site for name, member in stage.members("robot1").robots.items()}
        assert sites == {"robot1": "", "robot2": "", "robot3": "hall", "robot4": "hall"}
        for name, others in (("robot1", ["robot3", "robot4"]), ("robot4", ["robot1", "robot2"])):
            machine = stage.machine(name)
            robots.until(
                lambda machine=machine: all(one["lane"] == "connected" for one in machine.status()["far"]),  # type: ignore[misc]
                "the sites to be connected",
            )
            assert sorted(one["name"] for one in machine.status()["far"]) == others
            assert machine.status()["rule"] == "pair", "two robots at each site, and no majority of four"
        stage.machine("robot3").cut_power()
        robots.until(lambda: state_at(stage, "robot4", "robot3") == "dead", "robot3 to be dead at its own site")
        assert [peer["name"] for peer in stage.machine("robot1").status()["peers"]] == ["robot2"]
        assert stage.machine("robot1").status()["healthy"], "a robot that is lost at another site is no trouble here"
        ran = stage.typed("robot1", "remove", "robot3")
        assert ran.returncode == 0, ran.stderr
        robots.until(lambda: "robot3" not in stage.members("robot4").robots, "robot4 to hear of it")
