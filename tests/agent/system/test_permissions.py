"""Which user asks, what a program inherits from that user, and what that user may do."""

from __future__ import annotations

import grp
import os
import pwd
import resource
import select
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from msgspec.structs import replace

from agent.errors import RefusedError
from agent.system import permissions
from agent.system.permissions import NOBODY, Caller, caller_of, check_right, guest_of, inheritance_for, may, spoken_for, uid_named
from agent.worker.components.restore_limits import check_rights
from checkpoint.errors import FormatError, MismatchError
from checkpoint.linux.spawn.inherited_limits import Inheritance
from checkpoint.linux.spawn.vessel import Birth, spawn_program
from checkpoint.model import Credentials, Fact, Member, Resource, Snapshot
from checkpoint.snapshot.credentials import CONFINED, KIND
from tests.samples.make import sample, tree_sample

SOMEBODY = 7001
OTHER = 7002
GIVEN = 7003
"""A group that he is a member of."""
BOUND_S = 60.0
SELF_PORTRAIT = "grep -E '^(Uid|Gid|Groups|CapEff|CapBnd|NoNewPrivs)' /proc/self/status; ulimit -n; nice; ionice; cat $OOM"
as_root = pytest.mark.skipif(os.geteuid() != 0, reason="needs root: it becomes another user")


def credentials(uid: int, *, effective: int | None = None, capabilities: int = 0) -> Credentials:
    seen = uid if effective is None else effective
    return Credentials((uid, seen, seen, seen), (uid,) * 4, (), (0, capabilities, capabilities, 0, 0))


def running_as(first: Credentials, second: Credentials | None = None) -> Snapshot:
    """A program whose threads have these rights."""
    state = sample()
    thread = state.threads[0]
    told = [list(words) for words in (second.uids, second.gids, second.groups, second.capabilities)] if second else []
    odd = Resource(KIND, "rights of threads", {"descriptors": [], "threads": [[thread.tid + 1, *told, False]]})
    return replace(
        state,
        process=replace(state.process, credentials=first),
        threads=(thread, replace(thread, tid=thread.tid + 1)),
        resources=(odd,) if second else (),
        members=(),
    )


def a_member(of: Credentials) -> Member:
    """Another process of a program, with these rights."""
    member = tree_sample().members[0]
    return replace(member, process=replace(member.process, credentials=of), resources=())


@pytest.fixture
def connection() -> Iterator[tuple[socket.socket, socket.socket]]:
    ours, theirs = socket.socketpair()
    with ours, theirs:
        yield ours, theirs


def test_the_kernel_says_who_calls_and_what_he_hands_down(connection: tuple[socket.socket, socket.socket]) -> None:
    found = caller_of(connection[0])
    assert (found.uid, found.gid, set(found.groups)) == (os.geteuid(), os.getegid(), set(os.getgroups()))
    assert found.inheritance.limits[resource.RLIMIT_NOFILE] == resource.getrlimit(resource.RLIMIT_NOFILE)
    assert found.inheritance.affinity == tuple(sorted(os.sched_getaffinity(0)))
    assert found.inheritance.oom_score_adj == int(Path("/proc/self/oom_score_adj").read_text())


@as_root
def test_a_program_is_born_as_somebody_else_with_less(tmp_path: Path) -> None:
    limits = {resource.RLIMIT_NOFILE: (50, 60)}
    kept = Inheritance(SOMEBODY, OTHER, (OTHER,), 1 << 5, True, limits, nice=7, io_priority=2 << 13 | 6, oom_score_adj=77)
    report = tmp_path / "report"
    report.touch()
    report.chmod(0o666)
    tmp_path.chmod(0o755)
    with report.open("wb") as out, open(os.devnull, "rb") as nothing:
        birth = Birth(stdio=(nothing.fileno(), out.fileno(), out.fileno()), inheritance=kept)
        born = spawn_program(
            ["/bin/sh", "-c", SELF_PORTRAIT], {"PATH": "/usr/bin:/bin", "OOM": "/proc/self/oom_score_adj"}, "/", 0o022, birth
        )
        os.waitpid(born.pid, 0)
    words = report.read_text().split()
    assert words == [
        *("Uid:", *["7001"] * 4, "Gid:", *["7002"] * 4, "Groups:", "7002"),
        *("CapEff:", "0" * 16, "CapBnd:", "0" * 14 + "20", "NoNewPrivs:", "1", "50", "7", "best-effort:", "prio", "6", "77"),
    ]


def test_a_limit_that_we_may_not_give_becomes_as_high_as_ours() -> None:
    """In a process of its own, whose limits it may spoil, without the right to raise them."""
    script = (
        "import os, resource\nfrom checkpoint.linux.spawn.inherited_limits import take_on, Inheritance\n"
        "resource.setrlimit(resource.RLIMIT_NOFILE, (50, 60))\n"
        f"if os.geteuid() == 0: os.setresuid({SOMEBODY}, {SOMEBODY}, {SOMEBODY})\n"
        "take_on(Inheritance(os.getuid(), os.getgid(), limits={resource.RLIMIT_NOFILE: (55, -1)}))\n"
        "print(*resource.getrlimit(resource.RLIMIT_NOFILE))\n"
    )
    assert subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout == "55 60\n"


@as_root
def test_a_program_of_another_user_ends_with_its_parent_all_the_same() -> None:
    """A change of user takes PR_SET_PDEATHSIG back; it is set afterwards."""
    parent = (
        "import sys\nfrom checkpoint.linux.spawn.inherited_limits import Inheritance\n"
        "from checkpoint.linux.spawn.vessel import Birth, spawn_program\n"
        f"birth = Birth(inheritance=Inheritance({SOMEBODY}, {SOMEBODY}))\n"
        "print(spawn_program(['/bin/sleep', '1000'], {}, '/', 0o022, birth).pid, flush=True)\nsys.stdin.read()\n"
    )
    with subprocess.Popen([sys.executable, "-c", parent], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        pidfd = os.pidfd_open(int(process.stdout.readline()))
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert select.select([pidfd], [], [], BOUND_S)[0]
    os.close(pidfd)


def caller(uid: int) -> Caller:
    return Caller(uid, uid, (), Inheritance(uid, uid))


MEMBER, GROUP = "nobody", grp.getgrgid(pwd.getpwnam("nobody").pw_gid).gr_name


@as_root
def test_one_user_alone_may_ask_for_the_members_of_the_group() -> None:
    uid = pwd.getpwnam(MEMBER).pw_uid
    page = pwd.getpwnam("daemon").pw_uid
    for speaker in (0, page):
        spoken = spoken_for(caller(speaker), uid, uid_named("daemon"), GROUP)
        assert (spoken.uid, spoken.groups, spoken.inheritance.uid) == (uid, (), uid)
    for speaker, wanted, page_user, group, why in (
        (SOMEBODY, uid, "daemon", GROUP, "may not ask for other users"),
        (page, uid, "", GROUP, "may not ask for other users"),
        (page, uid, "no-such-user", GROUP, "may not ask for other users"),
        (NOBODY, uid, "no-such-user", GROUP, "may not ask for other users"),
        (page, 0, "daemon", GROUP, "command failover"),
        (page, SOMEBODY, "daemon", GROUP, f"add it to the group {GROUP}"),
        (page, page, "daemon", GROUP, f"add it to the group {GROUP}"),
        (page, uid, "daemon", "", "name a group in agent.toml"),
        (page, uid, "daemon", "no-such-group", "add it to the group"),
    ):
        with pytest.raises(RefusedError, match=why) as refused:
            spoken_for(caller(speaker), wanted, uid_named(page_user), group)
        assert refused.value.kind == "PermissionError"


@pytest.mark.parametrize(
    ("uid", "owner", "allowed"),
    [(0, SOMEBODY, True), (SOMEBODY, SOMEBODY, True), (OTHER, SOMEBODY, False), (OTHER, None, False), (NOBODY, 0, False)],
)
def test_root_and_the_owner_may_give_orders_and_nobody_else(uid: int, owner: int | None, allowed: bool) -> None:
    assert may(uid, owner) is allowed
    if not allowed:
        with pytest.raises(RefusedError, match="its owner and root may give orders"):
            check_right(uid, "/lab/r1/mapper", owner)


def test_an_agent_without_roots_rights_runs_nobody_elses_programs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(permissions.os, "geteuid", lambda: SOMEBODY)
    stranger = permissions.Caller(OTHER, OTHER, (), Inheritance(OTHER, OTHER))
    with pytest.raises(RefusedError, match="runs programs of uid 7001 alone"):
        inheritance_for(stranger, "")


def test_somebody_elses_process_is_not_ones_own() -> None:
    stranger = permissions.Caller(OTHER, OTHER, (), Inheritance(OTHER, OTHER))
    with pytest.raises(RefusedError, match=f"pid {os.getpid()} is not a process of uid 7002"):
        guest_of(os.getpid(), stranger)


@as_root
@pytest.mark.parametrize(
    ("found", "owner", "allowed"),
    [
        (credentials(SOMEBODY), SOMEBODY, True),
        (credentials(SOMEBODY), 0, True),
        (credentials(SOMEBODY, effective=0), SOMEBODY, False),
        (credentials(SOMEBODY, capabilities=1 << 7), SOMEBODY, False),
        (credentials(OTHER), SOMEBODY, False),
        (replace(credentials(SOMEBODY), gids=(SOMEBODY, 42, 42, 42)), SOMEBODY, False),
        (replace(credentials(SOMEBODY), gids=(GIVEN, GIVEN, SOMEBODY, GIVEN), groups=(GIVEN,)), SOMEBODY, True),
        (replace(credentials(SOMEBODY), groups=(0,)), SOMEBODY, False),
    ],
)
def test_a_snapshot_comes_back_with_the_rights_of_its_owner_or_not_at_all(found: Credentials, owner: int, allowed: bool) -> None:
    started, good = Inheritance(SOMEBODY, SOMEBODY, (GIVEN,), policy=os.SCHED_RR, priority=99, nice=-20), credentials(SOMEBODY)
    of_one, of_all = running_as(found), running_as(good, found)
    for outline in (of_one, of_all, replace(running_as(good), members=(a_member(found),))):
        if allowed:
            check_rights("/lab/r1/mapper", outline, owner, started)
        else:
            with pytest.raises(MismatchError, match="other rights than those of its owner"):
                check_rights("/lab/r1/mapper", outline, owner, started)


def confined(found: Credentials, threads: list[Fact]) -> Snapshot:
    outline = running_as(found)
    return replace(outline, resources=(Resource(CONFINED, "", {"descriptors": [], "filters": [], "threads": threads}),))


@as_root
def test_a_filter_under_which_rights_could_be_gained_is_roots_alone() -> None:
    bound, free = replace(credentials(SOMEBODY), no_new_privs=True), credentials(SOMEBODY)
    tid = running_as(free).threads[0].tid
    check_rights("/lab/r1/mapper", confined(bound, [[tid, False, [0]]]), SOMEBODY, None)
    check_rights("/lab/r1/mapper", confined(free, [[tid, True, []]]), SOMEBODY, None)
    check_rights("/lab/r1/mapper", confined(free, [[tid, False, [0]]]), 0, None)
    with pytest.raises(MismatchError, match="no_new_privs is off"):
        check_rights("/lab/r1/mapper", confined(free, [[tid, False, [0]]]), SOMEBODY, None)


@as_root
@pytest.mark.parametrize(("bits", "allowed"), [(0, True), (1 << 4, True), (1 << 2, False), (0b1111, False)])
def test_securebits_are_roots_alone(bits: int, allowed: bool) -> None:
    outline = running_as(replace(credentials(SOMEBODY), securebits=bits))
    check_rights("/lab/r1/mapper", outline, 0, None)
    if allowed:
        check_rights("/lab/r1/mapper", outline, SOMEBODY, None)
        return
    with pytest.raises(MismatchError, match="it has securebits"):
        check_rights("/lab/r1/mapper", outline, SOMEBODY, None)


@as_root
def test_a_root_directory_in_which_rights_could_be_gained_is_roots_alone() -> None:
    outline, child = running_as(credentials(SOMEBODY)), a_member(credentials(SOMEBODY))
    caged = replace(outline, process=replace(outline.process, root_directory="/home/somebody/cage"))
    of_child = replace(outline, members=(replace(child, process=replace(child.process, root_directory="/home/somebody/cage")),))
    for one in (caged, of_child):
        check_rights("/lab/r1/mapper", one, 0, None)
        with pytest.raises(MismatchError, match=r"a root directory of its own .*: only a program of root may"):
            check_rights("/lab/r1/mapper", one, SOMEBODY, None)


@as_root
@pytest.mark.parametrize(
    ("kind", "threads"),
    [
        (KIND, 7),
        (KIND, [7]),
        (KIND, [[7, [0], [0], [], [0]]]),
        (KIND, [[7, [0], [0], [], [0], True]]),
        (KIND, [[7, ["0"] * 4, [0] * 4, [], [0] * 5, True]]),
        (CONFINED, None),
        (CONFINED, [7]),
        (CONFINED, [[7, False, 0]]),
    ],
)
def test_rights_that_are_told_in_another_way_are_no_mistake_of_ours(kind: str, threads: Fact) -> None:
    outline = running_as(credentials(SOMEBODY))
    told = replace(
        outline,
        threads=(replace(outline.threads[0], tid=7),),
        resources=(Resource(kind, "", {"descriptors": [], "threads": threads}),),
    )
    with pytest.raises(FormatError, match="does not understand the rights of its threads"):
        check_rights("/lab/r1/mapper", told, SOMEBODY, None)


@as_root
def test_where_nobody_told_its_groups_a_program_has_one_by_all_four_names() -> None:
    check_rights("/lab/r1/mapper", running_as(replace(credentials(SOMEBODY), gids=(42,) * 4)), SOMEBODY, None)
    with pytest.raises(MismatchError, match="other rights"):
        check_rights("/lab/r1/mapper", running_as(replace(credentials(SOMEBODY), gids=(42, 43, 43, 43))), SOMEBODY, None)
