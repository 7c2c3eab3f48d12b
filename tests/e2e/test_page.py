"""The operators' page beside real agents: what it shows and carries out, and what it refuses without the agents noticing."""

from __future__ import annotations

import base64
import contextlib
import grp
import json
import os
import pwd
import signal
import socket
import ssl
import subprocess
import sys
import uuid
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from failover.boards.board import Board
from failover.config.page import hashed
from page.limits import BODY_SIZE_MAX, CONNECTIONS_OF_ONE_MAX, LIVE_SIZE_MAX, ORDERS_AT_ONCE, SESSIONS_OF_USER_MAX
from tests.e2e import pages, robots
from tests.e2e.pages import COUNT, Served, served
from tests.e2e.robots import RobotMachine, until
from tests.e2e.test_board import TEAM, two_with_boards
from tests.page import prometheus_text

pytestmark = [pytest.mark.skipif(bool(pages.why_not()), reason=pages.why_not() or "-"), pytest.mark.timeout(300)]

ROOT = os.geteuid() == 0
MEMBER = "nobody"
STRANGER = 54_321
SETTINGS = f'group = "{grp.getgrgid(pwd.getpwnam(MEMBER).pw_gid).gr_name}"\n' if ROOT else ""
NAME = f"/{TEAM}/robot1/count"

Pair = tuple[RobotMachine, RobotMachine]


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Pair]:
    """Two robots with a board; the first runs a protected program that counts."""
    with pytest.MonkeyPatch.context() as patched, two_with_boards(tmp_path_factory.mktemp("pair"), patched, SETTINGS) as both:
        robots.run(both[0], "count", "/usr/bin/env", "python3", "-c", COUNT)
        robots.until_protected(both[0])
        yield both


@pytest.fixture(scope="module")
def page(pair: Pair, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    with served(pair[0], tmp_path_factory.mktemp("page")) as found:
        found.begin()
        yield found


class Client:
    """One WebSocket, and the table that its messages make, as page.js has it."""

    def __init__(self, page: Served) -> None:
        from websockets.sync.client import connect

        self.link = connect(
            f"{page.url.replace('http', 'ws')}live",
            origin=page.origin,  # type: ignore[arg-type]
            additional_headers={"Cookie": page.cookie},
            max_size=None,
        )
        self.table: dict[str, dict[str, Any]] = {}
        self.messages: list[dict[str, Any]] = []

    def until(self, condition: Callable[[], Any], what: str) -> Any:
        """Take messages until the condition holds."""

        def holds() -> Any:
            self.take(json.loads(self.link.recv(pages.PATIENCE_S)))
            return condition()

        return condition() or until(holds, what)

    def take(self, message: dict[str, Any]) -> None:
        self.messages.append(message)
        for key, fields in message.get("set", {}).items():
            self.table[key] = {**self.table.get(key, {}), **fields}
        for key, names in message.get("without", {}).items():
            for name in names:
                del self.table[key][name]
        for key in message.get("gone", []):
            del self.table[key]

    def say(self, messages: Sequence[str | bytes]) -> None:
        """Send all of them, and listen on."""
        for message in messages:
            self.link.send(message)
        while True:
            self.link.recv(pages.PATIENCE_S)

    def component(self) -> dict[str, Any]:
        return self.table.get(f"component:{NAME}", {})

    def order(self, wish: str) -> dict[str, Any]:
        """The order of that ID as the log has it."""
        return next((one for key, one in self.table.items() if key.startswith("order:") and one["id"] == wish), {})

    def ended(self, wish: str) -> dict[str, Any]:
        """The same, once it is done or refused."""
        self.until(lambda: self.order(wish).get("state") in ("done", "refused"), f"order {wish} to end")
        return self.order(wish)


@pytest.fixture
def client(page: Served) -> Iterator[Client]:
    found = Client(page)
    with found.link:
        found.until(lambda: found.component().get("word") == "protected", "the component")
        yield found


def give(page: Served, verb: str, **fields: Any) -> str:
    """An order of our own page; its ID."""
    wish = str(uuid.uuid4())
    status, said = page.post("/orders", {"id": wish, "verb": verb, "name": NAME, **fields})
    assert status == 202, said
    return wish


# --- What it shows -----------------------------------------------------------------------------------------------------


def test_the_whole_team_comes_once_and_then_what_changes(client: Client) -> None:
    assert client.table["team"]["team"] == TEAM and client.table["team"]["away"] == ""
    assert client.table["robot:robot1"]["here"] and client.table["robot:robot2"]["state"] == "live"
    one = client.component()
    assert (one["primary"], one["standby"], one["word"]) == ("robot1", "robot2", "protected")
    before = len(client.messages)
    client.until(lambda: len(client.messages) > before + 5, "changes")
    changed = [message.get("set", {}).get(f"component:{NAME}") for message in client.messages[before:]]
    later = [fields for fields in changed if fields]
    still = [fields for fields in later if "promise" not in fields and "orders" not in fields]
    assert still, "what stands still is not sent; on a busy machine it may change once"


def test_who_looks_at_a_component_gets_its_story_its_output_and_its_last_minutes(client: Client) -> None:
    client.link.send(json.dumps({"look": f"component:{NAME}"}))

    def has(kind: str) -> Any:
        return next((message[kind] for message in client.messages if kind in message), None)

    client.until(lambda: has("story") and has("output") and has("past"), "story, output and points")
    assert has("story")["name"] == NAME and any(line["robot"] == "robot1" and line["epoch"] for line in has("story")["lines"])
    assert has("past")["key"] == f"component:{NAME}"
    counted = [int(line) for line in has("output")["text"]["1"].split()[1:-1]]
    assert counted == list(range(counted[0], counted[0] + len(counted))), "a piece of the output, without gap"
    client.until(lambda: sum("output" in message for message in client.messages) > 3, "more of it")


def test_the_board_is_shown_with_ages_beside_bounds(client: Client, pair: Pair) -> None:
    with Board(pair[1].socket.parent / "board", "test") as there:
        there.item("alarm").put(41)
        key = "item:robot2/alarm"
        client.until(lambda: client.table.get(key, {}).get("value") == 41, "the value of the other robot")
        assert client.table[key]["age_ms"] >= 0 and client.table[key]["type"] == "u8"


def test_people_see_each_other(client: Client, page: Served) -> None:
    other = Client(page)
    with other.link:
        other.until(lambda: other.component(), "the team")
        other.link.send(json.dumps({"look": f"component:{NAME}"}))
        people = lambda: [one for key, one in client.table.items() if key.startswith("person:")]  # noqa: E731
        client.until(lambda: any(not one["me"] and one["looks"] == f"component:{NAME}" for one in people()), "the other one")
    client.until(lambda: len(people()) == 1, "the other one to be gone")


def test_metrics_are_of_the_format_and_right(page: Served) -> None:
    status, headers, body = page.ask("GET", "/metrics")
    assert status == 200 and headers["content-type"].startswith("text/plain; version=0.0.4")
    found = prometheus_text.read(body.decode())
    assert found["failover_component_protected"] == {(("component", NAME),): 1}
    assert found["failover_component_epoch"][(("component", NAME),)] >= 1
    assert found["failover_component_checkpoint_age_seconds"][(("component", NAME),)] > 0
    assert found["failover_peer_live"] == {(("peer", "robot2"), ("role", "robot")): 1}
    assert (("item", "alarm"), ("of", "robot2")) in found["failover_board_item_puts_total"]
    assert {process for ((_, process),) in found["failover_open_descriptors"]} == {"main_loop", "worker"}
    status, _, body = page.ask("GET", "/healthz")
    assert (status, json.loads(body)) == (200, {"agent": True})


# --- Orders ------------------------------------------------------------------------------------------------------------


def test_an_order_is_carried_out_and_one_of_an_older_epoch_is_refused_with_what_changed(client: Client, page: Served) -> None:
    epoch = client.component()["epoch"]
    first = client.ended(give(page, "handover", to="robot2", epoch=epoch))
    assert first["state"] == "done", first
    stale = client.ended(give(page, "stop", epoch=epoch))
    assert stale["state"] == "refused"
    assert f"epoch {epoch} then" in stale["says"] and "at robot2" in stale["says"] and "nothing was done" in stale["says"]
    client.until(lambda: client.component()["primary"] == "robot2" and client.component()["word"] == "protected", "the move")
    back = client.ended(give(page, "failback", epoch=client.component()["epoch"]))
    assert back["state"] == "done", back
    client.until(lambda: client.component()["primary"] == "robot1" and client.component()["word"] == "protected", "the way back")


def test_an_order_that_is_sent_again_is_carried_out_once(client: Client, page: Served) -> None:
    wish = {"id": str(uuid.uuid4()), "verb": "prefer", "name": NAME, "to": "robot1", "epoch": client.component()["epoch"]}
    numbers = {page.post("/orders", wish)[1]["number"] for _ in range(3)}
    assert len(numbers) == 1
    assert client.ended(wish["id"])["says"] == "it prefers robot1"


def test_what_the_agent_refuses_is_said_in_its_words(client: Client, page: Served) -> None:
    epoch = client.component()["epoch"]
    assert "knows robot1, robot2" in client.ended(give(page, "prefer", to="robot9", epoch=epoch))["says"]
    assert client.ended(give(page, "start"))["state"] == "refused"
    status, said = page.post("/risks", {"name": NAME, "robot": "robot2"})
    assert status == 409 and "robot1 lives and has it" in said["error"], said


def test_too_many_orders_at_once_are_told_when_to_come_again(client: Client, page: Served) -> None:
    wishes = [{"id": str(uuid.uuid4()), "verb": "prefer", "name": "/no/such", "to": "robot1"} for _ in range(3 * ORDERS_AT_ONCE)]
    with ThreadPoolExecutor(16) as pool:
        answers = list(pool.map(lambda wish: page.post("/orders", wish), wishes))
    assert {status for status, _ in answers} == {202, 429}
    assert all(said["again_ms"] > 0 for status, said in answers if status == 429)
    taken = [wish["id"] for wish, (status, _) in zip(wishes, answers, strict=True) if status == 202]
    assert {client.ended(wish)["state"] for wish in taken} == {"refused"}


DRIVER = """
import failover

@failover.driver("Lab/robot1/Arm", alias="arm")
class Arm:
    @failover.query
    def secret(self) -> str:
        return "swordfish"

failover.run(Arm)
"""


def test_a_driver_is_called_by_its_path_alone_for_which_the_rules_are(pair: Pair, tmp_path: Path) -> None:
    drivers = tmp_path / "drivers"
    drivers.mkdir(mode=0o700)
    environment = {"FAILOVER_DRIVERS": str(drivers), "FAILOVER_ROBOT": "robot1"}
    driver = subprocess.Popen([sys.executable, "-c", DRIVER], env={**os.environ, **environment})
    try:
        with served(pair[0], tmp_path / "page", **environment) as page:
            page.begin()
            client = Client(page)
            with client.link:
                client.until(lambda: "driver:Lab/robot1/Arm" in client.table, "the driver")
                refused = client.ended(give(page, "call", name="arm", call="secret"))
                assert refused["state"] == "refused" and "call it by its path, Lab/robot1/Arm" in refused["says"], refused
                done = client.ended(give(page, "call", name="Lab/robot1/Arm", call="secret"))
                assert (done["state"], done["says"]) == ("done", '"swordfish"')
            log = page.log.read_text()
        assert "is done" in log and "swordfish" not in log
    finally:
        driver.kill()
        driver.wait()


def test_an_order_for_a_page_that_was_started_again_is_not_carried_out_twice(client: Client, page: Served) -> None:
    wish = {"id": str(uuid.uuid4()), "verb": "prefer", "name": NAME, "to": "robot1", "boot": "of-a-page-before"}
    status, said = page.post("/orders", wish)
    assert status == 409 and "is not known" in said["error"] and not said["again_ms"]


# --- What it refuses -----------------------------------------------------------------------------------------------------

WISH = {"id": "12345678-of-an-attacker", "verb": "stop", "name": NAME, "epoch": 0}
JUNK: tuple[bytes, ...] = (
    *(b"", b"{", b"null", b"[]", b"\xff\xfe", b"[" * 50_000, b'{"id": 1}', b'{"verb": "run"}', b'{"a":' * 9_999),
    json.dumps({**WISH, "verb": "run"}).encode(),
    json.dumps({**WISH, "more": 1}).encode(),
    json.dumps({**WISH, "name": "x" * 301}).encode(),
    json.dumps({**WISH, "epoch": -1}).encode(),
)


def alive(pair: Pair) -> list[tuple[int, int]]:
    """What would differ if an agent had noticed: its process and its life."""
    return [(one["pid"], one["life"]) for one in (robot.status() for robot in pair)]


def test_a_request_of_another_site_is_refused_and_the_agents_notice_nothing(page: Served, pair: Pair) -> None:
    before, elsewhere = alive(pair), "http://attacker.example"
    refusals = {
        "another site": ({"Origin": elsewhere}, 403),
        "no origin": ({"Origin": ""}, 403),
        "a sandboxed frame": ({"Origin": "null"}, 403),
        "another port of this machine": ({"Origin": "http://127.0.0.1:1"}, 403),
        "no session": ({"Cookie": ""}, 401),
        "a session that there is not": ({"Cookie": f"failover-{page.port}=xxxx"}, 401),
        "no token": ({"x-failover-token": ""}, 403),
        "a token that is wrong": ({"x-failover-token": "wrong"}, 403),
        "a form": ({"Content-Type": "application/x-www-form-urlencoded"}, 415),
        "plain text, which needs no leave": ({"Content-Type": "text/plain"}, 415),
        "localhost, which may be another user's": ({"Host": f"localhost:{page.port}"}, 421),
        "a name that another site has point here": ({"Host": f"attacker.example:{page.port}"}, 421),
    }
    for what, (changed, status) in refusals.items():
        assert page.post("/orders", WISH, **changed)[0] == status, what
        assert page.post("/risks", {"name": NAME}, **changed)[0] == status, what
    for path in ("/", "/session", "/metrics", "/healthz"):
        assert page.ask("GET", path, Host=f"attacker.example:{page.port}")[0] == 421
    assert alive(pair) == before and robots.component(pair[0], "count")["state"] == "running"


def test_a_websocket_of_another_site_hears_nothing(page: Served) -> None:
    from websockets.exceptions import ConnectionClosed
    from websockets.sync.client import connect

    for origin, cookie in (
        ("http://attacker.example", page.cookie),
        (None, page.cookie),
        (page.origin, ""),
        (page.origin, f"failover-{page.port}=x"),
    ):
        headers = {"Cookie": cookie} if cookie else {}
        with connect(f"ws://127.0.0.1:{page.port}/live", origin=origin, additional_headers=headers) as link:  # type: ignore[arg-type]
            with pytest.raises(ConnectionClosed) as closed:
                link.recv(pages.PATIENCE_S)
            assert closed.value.rcvd is not None and closed.value.rcvd.code == 1008


def test_what_no_page_of_ours_posts_is_refused_in_words(page: Served, pair: Pair) -> None:
    before = alive(pair)
    for junk in JUNK:
        status, said = page.post("/orders", junk)
        assert status == 400 and len(said["error"]) > 20, (junk[:40], said)
    status, said = page.post("/orders", b" " * (BODY_SIZE_MAX + 1))
    assert (status, said["error"]) == (413, f"more than {BODY_SIZE_MAX} bytes")
    for path in ("/nowhere", "/assets/../app.py", "/assets/%2e%2e/app.py", "/orders"):
        assert page.ask("GET", path)[0] in (404, 405)
    with socket.create_connection(("127.0.0.1", page.port), pages.PATIENCE_S) as link:
        with contextlib.suppress(ConnectionError):  # it may hang up before it has heard all
            link.sendall(b"GET / HTTP/1.1\r\nHost: x\r\n" + b"X-Long: " + b"x" * 100_000)
        assert b"400" in link.recv(1000).split(b"\r\n")[0]
    with socket.create_connection(("127.0.0.1", page.port), pages.PATIENCE_S) as link:
        link.sendall(bytes(range(256)) * 40)
        assert b" 400 " in link.recv(1000)
    assert alive(pair) == before and page.ask("GET", "/healthz")[0] == 200


@pytest.mark.parametrize(
    "messages",
    [["junk"], [b"bytes"], ["{}"], ['{"look": 1}'], ['{"look": "x", "more": 1}'], ["x" * (LIVE_SIZE_MAX + 1)], ["[" * 4000]]
    + [['{"look": ""}'] * 200, ["x" * 1_000_000]],
    ids=lambda messages: repr(messages[0][:20]),
)
def test_a_client_that_says_what_no_page_of_ours_says_is_hung_up_on(page: Served, messages: list[str | bytes]) -> None:
    from websockets.exceptions import ConnectionClosed

    other = Client(page)
    with other.link:
        with pytest.raises(ConnectionClosed) as closed:
            other.say(messages)
        assert closed.value.rcvd is not None and closed.value.rcvd.code in (1008, 1009)
    assert page.ask("GET", "/healthz")[0] == 200


def test_every_answer_has_the_headers_of_security_and_nothing_comes_from_elsewhere(page: Served) -> None:
    status, _, index = page.ask("GET", "/")
    assert status == 200
    assets = {path.split('"')[0] for path in index.decode().split('"/assets/')[1:]}
    assert len(assets) == 3
    for path in ("/", "/session", "/metrics", "/nowhere", *(f"/assets/{name}" for name in assets)):
        status, headers, body = page.ask("GET", path)
        policy = headers["content-security-policy"]
        assert "default-src 'none'" in policy and "unsafe" not in policy and "frame-ancestors 'none'" in policy
        assert headers["x-content-type-options"] == "nosniff" and headers["referrer-policy"] == "no-referrer"
        assert "server" not in headers
        assert ("immutable" in headers["cache-control"]) is path.startswith("/assets/")
        if path.endswith((".js", ".css")) or path == "/":
            links = body.replace(b"http://www.w3.org/2000/svg", b"")
            assert b"http://" not in links and b"https://" not in links and b" style=" not in links and b"<script>" not in links
    _, headers, _ = page.ask("GET", "/session")
    for word in ("HttpOnly", "SameSite=strict", "Path=/"):
        assert word in headers["set-cookie"]


# --- Other users -----------------------------------------------------------------------------------------------------------


@pytest.mark.root
def test_a_session_is_of_the_user_whose_program_has_connected(page: Served) -> None:
    """The connection is another user's: not the session's, and without a right of its own to stop what it does not own."""
    uid = pwd.getpwnam(MEMBER).pw_uid
    os.seteuid(uid)
    try:
        assert page.post("/orders", WISH)[0] == 403, "with root's cookie"
        other = Served(page.url, page.process, page.log)
        other.begin()
        assert json.loads(other.ask("GET", "/session", Cookie=other.cookie)[2])["user"] == MEMBER
        client = Client(other)
        with client.link:
            client.until(lambda: client.component().get("orders"), "the component")
            assert "its owner and root may give orders" in client.component()["orders"]["stop"]["why_not"]
            refused = client.ended(give(other, "stop", epoch=client.component()["epoch"]))
            assert refused["state"] == "refused" and "its owner and root" in refused["says"] and refused["user"] == MEMBER
    finally:
        os.seteuid(0)


@pytest.mark.root
def test_no_session_begins_for_a_user_whom_the_agent_refuses(page: Served) -> None:
    os.seteuid(STRANGER)
    try:
        status, _, body = page.ask("GET", "/session")
    finally:
        os.seteuid(0)
    assert status == 409 and "may not use the agent's socket" in json.loads(body)["error"]


def test_a_user_has_so_many_windows(page: Served) -> None:
    from websockets.exceptions import ConnectionClosed

    others = [Client(page) for _ in range(SESSIONS_OF_USER_MAX)]
    try:
        for other in others:
            other.until(lambda other=other: other.component(), "the team")  # type: ignore[misc]
        with Client(page).link as last, pytest.raises(ConnectionClosed) as closed:
            last.recv(pages.PATIENCE_S)
        assert closed.value.rcvd is not None and "16 windows" in closed.value.rcvd.reason
    finally:
        for other in others:
            other.link.close()


def test_a_client_that_sends_no_request_is_hung_up_on_and_holds_so_many_connections(page: Served) -> None:
    links = [socket.create_connection(("127.0.0.1", page.port), pages.PATIENCE_S) for _ in range(CONNECTIONS_OF_ONE_MAX + 8)]
    try:
        links[0].sendall(b"GET / HTTP/1.1\r\nX-Slow: ")
        ends = [until(lambda link=link: hung_up(link), "the page to hang up") for link in (links[-1], links[1], links[0])]  # type: ignore[misc]
        assert all(ends)
    finally:
        for link in links:
            link.close()
    until(lambda: page.ask("GET", "/healthz")[0] == 200, "the page to answer")


def hung_up(link: socket.socket) -> bool:
    """Whether the other end has closed a connection."""
    link.setblocking(False)
    try:
        return link.recv(1) == b""
    except BlockingIOError:
        return False
    except ConnectionError:
        return True


@pytest.mark.command("openssl")
def test_people_log_in_with_a_password_over_tls(pair: Pair, tmp_path: Any) -> None:
    key, certificate = tmp_path / "key.pem", tmp_path / "certificate.pem"
    made = ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-keyout", key, "-out", certificate, "-days", "2"]
    subprocess.run([*made, "-subj", "/CN=localhost", "-addext", "subjectAltName=IP:127.0.0.1"], check=True, capture_output=True)
    users = f'[users.anna]\npassword = "{hashed("swordfish")}"\n'
    config = f'certificate = "{certificate}"\nkey = "{key}"\n{users}'
    with served(pair[0], tmp_path / "page", config) as page:
        assert page.url.startswith("https://")
        context = ssl.create_default_context(cafile=certificate)

        def ask(method: str, path: str, body: Any = None, **headers: str) -> tuple[int, dict[str, str], bytes]:
            import http.client

            link = http.client.HTTPSConnection("127.0.0.1", page.port, timeout=pages.PATIENCE_S, context=context)
            content = None if body is None else json.dumps(body)
            link.request(method, path, content, {name.replace("_", "-"): value for name, value in headers.items()})
            answer = link.getresponse()
            found = answer.status, {name.lower(): value for name, value in answer.getheaders()}, answer.read()
            link.close()
            return found

        post = {"Origin": page.origin, "Content-Type": "application/json"}
        assert ask("GET", "/session")[0] == 401
        assert ask("POST", "/login", {"name": "anna", "password": "swordfisch"}, **post)[0] == 403
        assert ask("POST", "/login", {"name": "ben", "password": "swordfish"}, **post)[0] == 403
        assert ask("POST", "/login", {"name": "anna", "password": "swordfish"}, Content_Type="application/json")[0] == 403
        status, headers, body = ask("POST", "/login", {"name": "anna", "password": "swordfish"}, **post)
        assert status == 200 and headers["set-cookie"].startswith("__Host-failover-") and "Secure" in headers["set-cookie"]
        assert "max-age" in headers["strict-transport-security"]
        cookie, token = headers["set-cookie"].partition(";")[0], json.loads(body)["token"]
        assert json.loads(ask("GET", "/session", Cookie=cookie)[2])["user"] == "anna"
        assert ask("GET", "/metrics")[0] == 401
        basic = base64.b64encode(b"anna:swordfish").decode()
        status, _, body = ask("GET", "/metrics", Authorization=f"Basic {basic}")
        assert status == 200 and prometheus_text.read(body.decode())["failover_healthy"]
        assert ask("POST", "/logout", {}, Cookie=cookie, x_failover_token=token, **post)[0] == 200
        assert ask("GET", "/session", Cookie=cookie)[0] == 401
        with ThreadPoolExecutor(8) as pool:
            guesses = [pool.submit(ask, "POST", "/login", {"name": "anna", "password": str(one)}, **post) for one in range(40)]
        statuses = [one.result()[0] for one in guesses]
        assert set(statuses) == {403, 429} and statuses.count(403) < 10, "parallel guesses are counted, too"


# --- An agent that is away -------------------------------------------------------------------------------------------------


def test_while_the_agent_is_away_the_page_says_so_and_then_goes_on_by_itself(client: Client, page: Served, pair: Pair) -> None:
    robots.stop_agent(pair[0])
    client.until(lambda: client.table["team"]["away"], "the page to see it")
    assert "start failover-agent" in client.table["team"]["away"]
    assert client.component(), "what was known is still shown"
    until(lambda: page.ask("GET", "/healthz")[0] == 503, "its health to be told")
    assert page.ask("GET", "/metrics")[0] == 503
    lost = client.ended(give(page, "stop", epoch=client.component()["epoch"]))
    assert lost["state"] == "refused" and "cannot reach the agent" in lost["says"]
    robots.start_agent(pair[0])
    client.until(lambda: client.table["team"]["away"] == "" and client.component().get("word") == "protected", "the agent again")


def test_an_agent_that_hangs_is_told_and_is_not_shown_as_alive(client: Client, page: Served, pair: Pair) -> None:
    """The last test: the worker of robot1 stands still, with all its connections open."""
    worker = robots.host_pid(pair[0], pair[0].status()["lanes_pid"])
    os.kill(worker, signal.SIGSTOP)
    try:
        client.until(lambda: client.table["team"].get("old_s", 0) >= 3, "the age of the picture")
    finally:
        os.kill(worker, signal.SIGCONT)
    client.until(lambda: client.table["team"]["away"] == "" and "old_s" not in client.table["team"], "the agent again")
