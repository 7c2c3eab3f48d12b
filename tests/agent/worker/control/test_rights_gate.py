"""The rules of rights at the control socket: asked for each verb, read again when they change, and without them as before."""

from __future__ import annotations

import asyncio
import os
import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from agent.errors import RefusedError
from agent.worker.control.queries import Lines, Questions
from agent.worker.control.rights_gate import RIGHT_OF, RightsGate
from agent.worker.control.verbs import Verbs
from failover.config.rights import RIGHTS_FILE
from failover.core.event_log.decisions import SAID
from failover.core.types import State

NOBODY = 65_534
"""The user ``nobody``, who is in the groups that the tests give."""

WORDS = f"it ended{SAID}swordfish"
RULES = """
[rights.groups]
watchers = ["nobody"]

[[rights.rules]]
groups = ["watchers"]
verbs = ["see"]
paths = ["lab", "lab/*", "lab/*/open"]

[[rights.rules]]
groups = ["@owner"]
verbs = ["see", "read", "operate"]
paths = ["**"]
"""
COMPONENTS: list[dict[str, Any]] = [
    {"name": "/lab/robot1/open", "owner": 7, "notes": [WORDS]},
    {"name": "/lab/robot1/secret", "owner": 7, "notes": [WORDS]},
    {"name": "/lab/robot1/mine", "owner": NOBODY, "notes": [WORDS]},
]


class Robot:
    """What the questions need of the rest: one robot with three components."""

    errands = None
    settings = SimpleNamespace(
        team=SimpleNamespace(team="lab"),
        config=SimpleNamespace(robot="robot1", state_directory="nowhere", insecure=False),
    )

    async def ask(self, _what: str) -> Any:
        components = [SimpleNamespace(name=one["name"], state=State.PRIMARY, owner=one["owner"]) for one in COMPONENTS]
        return SimpleNamespace(status=SimpleNamespace(components=components))

    def hindrance(self, _peer: str) -> str:
        return ""

    def picture(self, _told: Any) -> dict[str, Any]:
        return {"peers": [], "components": [dict(one) for one in COMPONENTS]}


Asked = Callable[..., dict[str, Any]]


@pytest.fixture
def asked(tmp_path: Path) -> Iterator[Asked]:
    """Ask as a user, by the rules that lie in ``tmp_path`` now: verb, uid, arguments."""
    gate = RightsGate(tmp_path, tmp_path)
    verbs = Questions(cast(Lines, Robot()), gate).gated()

    def ask(verb: str, uid: int = NOBODY, **arguments: Any) -> dict[str, Any]:
        say = SimpleNamespace(caller=SimpleNamespace(uid=uid))
        return asyncio.run(cast(Any, verbs[verb](cast(Any, say), arguments)))

    yield ask
    gate.close()


def shown(answer: dict[str, Any]) -> dict[str, bool]:
    """Component → whether its output may be read."""
    return {one["name"].rpartition("/")[2]: "swordfish" in str(one["notes"]) for one in answer["components"]}


def test_every_verb_of_the_socket_needs_a_right() -> None:
    robot = cast(Any, Robot())
    assert set(Questions(robot).table()) == set(RIGHT_OF)
    assert set(Verbs(robot).table()) == set(RIGHT_OF)


def test_without_a_file_all_is_as_before(asked: Asked) -> None:
    assert shown(asked("status")) == {"open": False, "secret": False, "mine": True}
    assert asked("ping")["robot"] == "robot1"


def answers(asked: Asked, right: str, *names: str) -> list[bool]:
    """Whether NOBODY has the right at each path."""
    paths = [f"/lab/robot1/{name}" for name in names]
    told = asked("may", rights=[right], paths=paths)["answers"][right]
    assert list(told) == paths
    return [because == "" for because in told.values()]


def test_a_user_asks_for_all_its_rights_at_once(asked: Asked, tmp_path: Path) -> None:
    assert answers(asked, "operate", "open", "secret", "mine", "ball") == [False, False, True, False]
    assert answers(asked, "read", "mine", "ball") == [True, False]
    assert answers(asked, "call", "mine", "arm") == [True, False], "a driver that no component is: root and the agent's user"
    assert answers(asked, "see", "open", "secret", "mine") == [True, True, True]
    assert answers(asked, "program", "mine") == [False]
    (tmp_path / RIGHTS_FILE).write_text(RULES)
    assert answers(asked, "see", "open", "secret", "mine") == [True, False, True]
    assert answers(asked, "operate", "open", "secret", "mine") == [False, False, True]
    assert answers(asked, "call", "open") == [False]
    assert asked("may", uid=os.geteuid(), rights=["call"], paths=["/lab/robot1/arm"])["answers"]["call"]["/lab/robot1/arm"] == ""
    with pytest.raises(RefusedError, match="may: its arguments are not right"):
        asked("may", rights=["see"] * 9, paths=[])


def test_a_question_for_many_rights_is_bounded_and_others_have_their_turn(asked: Asked) -> None:
    told = asked("may", rights=["see", "read"], paths=[f"/lab/robot1/{number}" for number in range(256)])
    assert len(told["answers"]["read"]) == 256
    with pytest.raises(RefusedError, match="2 rights at 257 paths; ask 512 at a time"):
        asked("may", rights=["see", "read"], paths=[f"/lab/robot1/{number}" for number in range(257)])
    with pytest.raises(RefusedError, match="may: its arguments are not right"):
        asked("may", rights=["see"], paths=["/" + "x" * 300])


def test_the_rules_say_what_a_user_sees_and_reads(asked: Asked, tmp_path: Path) -> None:
    (tmp_path / RIGHTS_FILE).write_text(RULES)
    assert shown(asked("status")) == {"open": False, "mine": True}
    assert shown(asked("status", uid=os.geteuid())) == {"open": True, "secret": True, "mine": True}
    with pytest.raises(RefusedError, match=r"uid:99999 may not see /lab/robot1: no rule allows it to no group"):
        asked("status", uid=99_999)


@pytest.mark.parametrize(("verb", "name"), [("stop", "open"), ("logs", "/lab/robot1/open"), ("run", "new"), ("protect", "")])
def test_an_order_is_refused_with_the_sentence_why(asked: Asked, tmp_path: Path, verb: str, name: str) -> None:
    (tmp_path / RIGHTS_FILE).write_text(RULES)
    whole = "/lab/robot1" if not name else f"/lab/robot1/{name.rpartition('/')[2]}"
    with pytest.raises(
        RefusedError, match=rf"uid:{NOBODY} may not {RIGHT_OF[verb]} {whole}: no rule allows it to .*watchers"
    ) as refused:
        asked(verb, name=name)
    assert refused.value.kind == "PermissionError"
    with pytest.raises(RefusedError, match="is a witness"):  # it was let through
        asked("stop", name="mine")


def test_a_program_without_a_name_is_decided_by_the_name_that_it_gets(asked: Asked, tmp_path: Path) -> None:
    (tmp_path / RIGHTS_FILE).write_text(RULES)
    with pytest.raises(RefusedError, match=rf"uid:{NOBODY} may not start /lab/robot1/mapper: no rule"):
        asked("run", argv=["/usr/bin/mapper"])


def test_a_refusal_tells_no_names_to_a_user_who_may_not_see_them(asked: Asked, tmp_path: Path) -> None:
    (tmp_path / RIGHTS_FILE).write_text(RULES)
    with pytest.raises(RefusedError, match=r"may not operate /lab/robot1/unknown") as refused:
        asked("stop", name="unknown")
    assert "secret" not in str(refused.value)


def test_a_change_of_the_file_holds_from_the_next_question_on(asked: Asked, tmp_path: Path) -> None:
    path = tmp_path / RIGHTS_FILE
    path.write_text(RULES)
    assert asked("ping")["robot"] == "robot1"
    path.write_text(RULES.replace("watchers = ", "others = "))
    with pytest.raises(RefusedError, match="may not see"):
        asked("ping")
    path.write_text(RULES.replace("[rights.groups]", "[rights.grups]"))
    with pytest.raises(RefusedError, match=re.escape(f"no right can be given: {path}:2: unknown key 'grups'")):
        asked("ping")
    assert asked("ping", uid=os.geteuid())["robot"] == "robot1"  # can mend it
    path.unlink()
    assert asked("ping")["robot"] == "robot1"


def test_the_status_says_by_which_rules_and_what_is_wrong_with_them(asked: Asked, tmp_path: Path) -> None:
    path = tmp_path / RIGHTS_FILE
    root = os.geteuid()
    assert asked("status", uid=root)["rights"] == ""
    path.write_text(RULES)
    assert asked("status", uid=root)["rights"] == f"2 rules of {path}; groups of this machine"
    path.write_text(RULES.replace("[rights.groups]", "[rights.grups]"))
    told = asked("status", uid=root)["rights"]
    assert re.match(rf"no user but root has any: {re.escape(str(path))}:2: unknown key 'grups'.*; mend the file", told), told


def test_why_is_answered_with_the_rule_that_decides(asked: Asked, tmp_path: Path) -> None:
    own = {"user": "nobody", "right": "read", "path": "/lab/robot1/mine"}
    with pytest.raises(RefusedError, match=r"has no rights\.toml"):
        asked("rights", **own)
    (tmp_path / RIGHTS_FILE).write_text(RULES)
    answer = asked("rights", **own)
    assert answer["allow"] and answer["place"] == f"{tmp_path / RIGHTS_FILE}:10" and "watchers" in answer["groups"]
    assert not asked("rights", **own | {"path": "/lab/robot1/open"})["allow"]
    with pytest.raises(RefusedError, match="may not grant"):
        asked("rights", **own | {"user": "root"})
    with pytest.raises(RefusedError, match="has no user 'no-such-user'"):
        asked("rights", uid=os.geteuid(), **own | {"user": "no-such-user"})


def test_root_is_never_shut_out_of_the_robots_own_console(asked: Asked, tmp_path: Path) -> None:
    everything = '[[rights.rules]]\ngroups = ["@all"]\ndeny = true\nverbs = ["*"]\npaths = ["**"]\n'
    away = '[rights]\nsource = "ldap"\n[rights.ldap]\nserver = "ldap://127.0.0.1:1"\nbase = "dc=x"\ntls = "none"\n'
    for text in (everything, away):
        (tmp_path / RIGHTS_FILE).write_text(text)
        assert len(asked("status", uid=os.geteuid())["components"]) == 3
        with pytest.raises(RefusedError):
            asked("status")


OPERATE_ABOVE = """
[[rights.rules]]
groups = ["uid:65534"]
verbs = ["operate"]
paths = ["lab/robot1", "lab/robot1/mine"]
"""


@pytest.mark.parametrize(
    ("rules", "path", "because"),
    [
        ("", "/lab/robot1/mine", ""),
        ("", "/lab/robot1/open", "only its owner and root may"),
        ("", "/lab/robot1", "all below a path only root"),
        ("", "/lab", "all below a path only root"),
        ("", "/lab/robot2/none", "only its owner and root may"),
        (RULES, "/lab/robot1/mine", ""),
        (RULES, "/lab/robot1", "no rule allows it"),
        (RULES + OPERATE_ABOVE, "/lab/robot1", "do not let you operate each component below it"),
    ],
)
def test_a_user_reserves_what_he_may_give_orders_about(tmp_path: Path, rules: str, path: str, because: str) -> None:
    if rules:
        (tmp_path / RIGHTS_FILE).write_text(rules)
    said = reserved(tmp_path, path, NOBODY)
    assert because in said and bool(because) == (not said.startswith(f"{path} is reserved by nobody")), said
    assert reserved(tmp_path, "/lab", os.geteuid()).startswith(
        "/lab is reserved by" if because else "cannot reserve /lab: /lab/r"
    )


def test_no_component_named_like_a_robot_lets_a_user_reserve_all_below_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, others in (("/lab", []), ("/lab/robot1", []), ("/lab/robot1/part", [{"name": "/lab/robot1/part/x", "owner": 7}])):
        monkeypatch.setattr(sys.modules[__name__], "COMPONENTS", [{"name": name, "owner": NOBODY}, *others])
        assert "all below a path only root" in reserved(tmp_path, name, NOBODY)


def verbs_at(place: Path, gate: RightsGate | None = None, **peers: str) -> Verbs:
    """Of robot1, which hears these peers: name → role."""
    robot, told = cast(Any, Robot()), []

    async def send(peer: str, *_what: Any, **_how: Any) -> dict[str, Any]:
        told.append(peer)
        return {}

    team = SimpleNamespace(team="lab", robots={name: SimpleNamespace(role=role) for name, role in peers.items()})
    config = SimpleNamespace(robot="robot1", state_directory=str(place), insecure=False)
    robot.settings = SimpleNamespace(team=team, near=team.robots, config=config)
    robot.errands = SimpleNamespace(send=send, told=told)
    picture = {"peers": [{"name": name, "state": "live"} for name in peers], "components": []}
    robot.picture = lambda _told: picture | {"components": [dict(one) for one in COMPONENTS]}
    return Verbs(robot, gate)


def test_a_witness_is_told_of_no_reservation(tmp_path: Path) -> None:
    verbs = verbs_at(tmp_path, robot2="robot", gate="witness", store="server")
    answer = asyncio.run(verbs.reservations.begin("/lab/robot1", os.geteuid(), 60_000, ""))
    told = cast(Any, verbs.reservations)._errands().told
    assert (sorted(told), answer["untold"]) == (["robot2", "store"], [])


def test_a_name_that_is_no_path_and_so_is_in_no_reservation_is_refused(tmp_path: Path) -> None:
    rights = SimpleNamespace(as_user=lambda *_: rights)
    say = SimpleNamespace(caller=SimpleNamespace(uid=os.geteuid(), inheritance=rights))
    order = verbs_at(tmp_path).table()["run"](cast(Any, say), {"name": "/lab" + 16 * "/x", "argv": ["/bin/true"], "wait": False})
    with pytest.raises(RefusedError, match="is no path: at most 200 bytes and 16 steps"):
        asyncio.run(cast(Any, order))


def reserved(place: Path, path: str, uid: int) -> str:
    """What a user is told who reserves a path."""
    gate = RightsGate(place, place)
    say = SimpleNamespace(caller=SimpleNamespace(uid=uid))
    try:
        order = verbs_at(place, gate).gated()["reserve"](cast(Any, say), {"name": path, "span_ms": 60_000})
        return str(asyncio.run(cast(Any, order))["sentence"])
    except RefusedError as refusal:
        return str(refusal)
    finally:
        gate.close()
