"""The operators' page as a service: without rights of its own, it gives orders for the users who connect, by their rights.

On a booted machine with the units as they are shipped, two users of the agent's group, and one who is no member of it.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import pytest

from tests.e2e import machines, pages, robots
from tests.e2e import service as services
from tests.e2e.machines import CHECKOUT, Machine
from tests.e2e.service import COUNT, SERVICE, as_user, component, robot_with_users
from tests.page import prometheus_text

WHY_NOT = pages.why_not() or machines.why_not()
pytestmark = [pytest.mark.root, pytest.mark.slow, pytest.mark.skipif(bool(WHY_NOT), reason=WHY_NOT or "-")]

PAGE = "failover-page.service"
STRANGER = "7003"

ASK = """
import http.client, json, sys
def ask(method, path, body=None, **headers):
    link = http.client.HTTPConnection("127.0.0.1", 7480)
    link.request(method, path, body, headers)
    answer = link.getresponse()
    return answer.status, answer.getheader("set-cookie", ""), answer.read().decode()
method, path, body = sys.argv[1:]
headers = {}
if method == "POST":
    _, cookie, session = ask("GET", "/session")
    body = json.dumps({"boot": json.loads(session)["boot"], **json.loads(body)})
    headers = {"Cookie": cookie.partition(";")[0], "x-failover-token": json.loads(session)["token"]}
    headers |= {"Origin": "http://127.0.0.1:7480", "Content-Type": "application/json"}
status, _, said = ask(method, path, body or None, **headers)
print(json.dumps([status, said]))
"""


@pytest.fixture(scope="module")
def machine(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Machine]:
    with robot_with_users(tmp_path_factory.mktemp("machines"), alice=7001, bob=7002) as booted:
        (booted.root / "etc/ask.py").write_text(ASK)
        (booted.root / "etc/count.py").write_text(COUNT)
        booted.run("install", "-m644", str(CHECKOUT / "systemd" / PAGE), "/etc/systemd/system/")
        booted.run("sed", "-i", 's/^#page_user = .*/page_user = "failover-page"/', "/etc/failover/agent.toml")
        booted.run("systemctl", "daemon-reload")
        try:
            booted.run("systemctl", "start", SERVICE, PAGE)
            robots.until(lambda: ask(booted, "root", "GET", "/healthz")[0] == 200, "the page to reach its agent")
            yield booted
        finally:
            print(booted.run("journalctl", "--unit", PAGE, "--no-pager", "--lines=60", check=False).stdout)


def ask(machine: Machine, user: str, method: str, path: str, body: Any = None) -> tuple[int, str]:
    """One request of a user's program there: status and body; status 0 while nothing listens."""
    code, said = as_user(machine, user, "python3", "-S", "/etc/ask.py", method, path, "" if body is None else json.dumps(body))
    if code:
        return 0, said
    status, told = json.loads(said)
    return int(status), str(told)


def test_it_runs_as_its_own_user_without_rights(machine: Machine) -> None:
    pid = machine.property(PAGE, "MainPID")
    told = dict(line.split(":\t", 1) for line in machine.run("cat", f"/proc/{pid}/status").stdout.splitlines() if ":\t" in line)
    uid = machine.run("id", "-u", "failover-page").stdout.strip()
    assert told["Uid"].split() == [uid] * 4
    assert {told[name] for name in ("CapInh", "CapPrm", "CapEff", "CapBnd", "CapAmb")} == {"0" * 16}
    assert told["NoNewPrivs"].strip() == "1" and told["Seccomp"].strip() == "2"


def test_the_kernel_tells_who_connects_and_the_agent_what_that_user_may(machine: Machine) -> None:
    for user in ("alice", "bob"):
        status, said = ask(machine, user, "GET", "/session")
        assert status == 200 and json.loads(said)["user"] == user
        status, said = ask(machine, user, "GET", "/metrics")
        assert status == 200 and prometheus_text.read(said)["failover_healthy"] == {(): 1}
    for path in ("/session", "/metrics"):
        status, said = ask(machine, STRANGER, "GET", path)
        assert status == 409 and "add it to the group failover" in json.loads(said)["error"]


def test_an_order_has_the_rights_of_the_user_who_gives_it(machine: Machine) -> None:
    code, said = as_user(
        machine, "alice", "failover", "run", "--name", "alices", "--detach", "--", "python3", "-S", "/etc/count.py"
    )
    assert code == 0, said
    name = component(machine, "alices")["name"]
    for number, user in enumerate(("bob", "root", "alice")):
        wish = {"id": f"order-of-{number}", "verb": "stop", "name": name, "epoch": component(machine, "alices")["epoch"]}
        status, said = ask(machine, user, "POST", "/orders", wish)
        assert status == 202, said
        journal = robots.until(lambda number=number: ended(machine, number + 1), f"the order of {user}")  # type: ignore[misc]
        if user != "alice":
            assert "is refused" in journal, journal
            assert component(machine, "alices")["state"] in ("running", "degraded"), user
    assert "is done" in journal
    assert component(machine, "alices")["state"] == "ended"


def ended(machine: Machine, number: int) -> str:
    """The line of the page's journal that tells the end of an order; "" while there is none."""
    journal = journal_of(machine)
    return next((line for line in journal.splitlines() if f"order {number} is " in line), "")


def journal_of(machine: Machine) -> str:
    return machine.run("journalctl", "--unit", PAGE, "--no-pager", "--output=cat").stdout


def test_it_comes_back_when_it_is_killed_and_the_agent_notices_nothing(machine: Machine) -> None:
    before, life = machine.property(PAGE, "MainPID"), services.status(machine)["life"]
    machine.run("systemctl", "kill", "--signal=KILL", PAGE)
    robots.until(lambda: machine.property(PAGE, "MainPID") not in ("0", before), "another page")
    robots.until(lambda: ask(machine, "alice", "GET", "/healthz")[0] == 200, "the page to answer again")
    assert services.status(machine)["life"] == life
