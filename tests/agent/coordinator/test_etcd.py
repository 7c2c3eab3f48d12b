"""The client against a real etcd: leases, compare-and-set, accounts, certificates, and a server that does not answer."""

from __future__ import annotations

import http.server
import subprocess
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from agent.coordinator.etcd import Etcd
from agent.coordinator_config import CoordinatorConfig
from agent.errors import CoordinatorError
from failover.cli.demo.robots import free_ports
from failover.core.election.coordinator import VOTES_MAX, Grant, KeepAlive, Leased, Put, Swap, Swapped
from tests.agent.coordinator.etcd_server import EtcdServer, three_members, why_not

pytestmark = pytest.mark.skipif(bool(why_not()), reason=why_not() or "etcd is here")

PREFIX = "failover/lab/"
PATIENCE_S = 60
ROOT = "of root"


@pytest.fixture
def server(tmp_path: Path) -> Iterator[EtcdServer]:
    one = EtcdServer(tmp_path / "etcd", "127.0.0.1", *free_ports(2))
    one.start()
    yield one
    one.kill()


def until_answers(etcd: Etcd) -> str:
    deadline = time.monotonic() + PATIENCE_S
    while True:
        try:
            return etcd.version()
        except CoordinatorError:
            assert time.monotonic() < deadline
            time.sleep(0.05)


def opened(server: EtcdServer, **keys: str) -> Etcd:
    etcd = Etcd(CoordinatorConfig([server.endpoint], **keys), PATIENCE_S)
    assert until_answers(etcd).startswith("3.")
    return etcd


def swap(etcd: Etcd, compared: dict[str, int], puts: dict[str, bytes], lease: int = 0) -> Swapped:
    told = etcd.answer(Swap(PREFIX, tuple(Put(key, value, tuple(compared.items()), lease) for key, value in puts.items())))
    assert isinstance(told, Swapped)
    return told


def granted(etcd: Etcd, ttl_ms: int) -> int:
    told = etcd.answer(Grant(ttl_ms))
    assert isinstance(told, Leased) and told.lease
    return told.lease


def test_a_key_is_put_only_on_top_of_the_revision_that_was_compared(server: EtcdServer) -> None:
    etcd, key = opened(server), f"{PREFIX}component/lab/mapper"
    first = swap(etcd, {key: 0}, {key: b"one"})
    value, revision = first.found[key]
    assert first.is_done and value == b"one" and revision == first.revision

    again = swap(etcd, {key: 0}, {key: b"two"})
    assert not again.is_done and again.found[key] == (b"one", revision)

    third = swap(etcd, {key: revision, f"{PREFIX}word/r2": 0}, {key: b"", f"{PREFIX}word/r1": b"\0"})
    assert third.is_done and third.found == {key: (b"", third.revision), f"{PREFIX}word/r1": (b"\0", third.revision)}


def test_as_many_as_are_asked_for_at_once_are_put_each_for_itself(server: EtcdServer) -> None:
    etcd, keys = opened(server), [f"{PREFIX}component/lab/part{number}" for number in range(VOTES_MAX)]
    swap(etcd, {}, {keys[3]: b"before"})
    word, alive = (f"{PREFIX}word/r1", 0), (f"{PREFIX}alive/r1", 0)
    told = etcd.answer(Swap(PREFIX, tuple(Put(key, b"mine", ((key, 0), word, alive)) for key in keys)))
    assert isinstance(told, Swapped) and not told.is_done
    assert {key for key, (value, _) in told.found.items() if value == b"mine"} == {*keys} - {keys[3]}


def test_only_what_is_below_the_prefix_is_read(server: EtcdServer) -> None:
    etcd = opened(server)
    swap(etcd, {}, {"failover/lab": b"", "failover/lab0": b"", "failover/other/word/r1": b""})
    assert not swap(etcd, {}, {}).found


def test_a_key_lives_as_long_as_its_lease_which_can_be_lengthened(server: EtcdServer) -> None:
    etcd, key = opened(server), f"{PREFIX}alive/r1"
    kept, left = granted(etcd, 1_000), granted(etcd, 1_000)
    swap(etcd, {}, {key: b"", f"{PREFIX}alive/r2": b""}, kept)
    swap(etcd, {}, {f"{PREFIX}alive/r2": b""}, left)
    deadline = time.monotonic() + PATIENCE_S
    while f"{PREFIX}alive/r2" in swap(etcd, {}, {}).found:
        assert etcd.answer(KeepAlive(kept)) == Leased(kept)
        assert time.monotonic() < deadline
    assert key in swap(etcd, {}, {}).found
    assert etcd.answer(KeepAlive(left)) == Leased(0)
    assert etcd.answer(Swap(PREFIX, (Put(key, b"", (), left),))) == Leased(0)


def test_the_next_endpoint_is_asked_when_one_does_not_answer(server: EtcdServer) -> None:
    (nobody,) = free_ports(1)
    etcd = Etcd(CoordinatorConfig([f"http://127.0.0.1:{nobody}", server.endpoint]), 5.0)
    assert until_answers(etcd).startswith("3.")


def test_a_server_that_is_gone_is_named_and_found_again(server: EtcdServer) -> None:
    etcd, key = opened(server), f"{PREFIX}word/r1"
    swap(etcd, {}, {key: b"here"})
    server.kill()
    with pytest.raises(CoordinatorError, match=r"no etcd answers \(http://127.*check \[coordinator\] endpoints"):
        etcd.version()
    server.start()
    until_answers(etcd)
    assert swap(etcd, {}, {}).found[key][0] == b"here"


def test_a_server_that_stands_still_is_not_waited_for(server: EtcdServer) -> None:
    etcd = Etcd(CoordinatorConfig([server.endpoint]), 0.3)
    until_answers(etcd)
    server.stop()
    with pytest.raises(CoordinatorError, match="timed out"):
        etcd.version()
    server.go_on()
    until_answers(etcd)


def test_an_account_of_etcd_is_used_and_its_token_renewed(server: EtcdServer, tmp_path: Path) -> None:
    plain = opened(server)
    for method, body in (
        ("auth/user/add", {"name": "root", "password": ROOT}),
        ("auth/user/grant", {"user": "root", "role": "root"}),
        ("auth/enable", {}),
    ):
        plain._ask(method, body)
    with pytest.raises(CoordinatorError, match=r"refuses kv/txn"):
        swap(plain, {}, {f"{PREFIX}word/r1": b""})

    password = tmp_path / "password"
    password.write_text("wrong\n")
    keys = {"user": "root", "password_file": str(password)}
    with pytest.raises(CoordinatorError, match=r"refuses .*authentication failed"):
        swap(Etcd(CoordinatorConfig([server.endpoint], **keys), PATIENCE_S), {}, {})
    password.write_text(ROOT + "\n")
    etcd = Etcd(CoordinatorConfig([server.endpoint], **keys), PATIENCE_S)
    assert swap(etcd, {}, {f"{PREFIX}word/r1": b""}).is_done
    etcd._token = "over"
    assert swap(etcd, {}, {f"{PREFIX}word/r1": b""}).is_done


def test_a_change_of_etcds_accounts_costs_a_new_token_and_no_vote(tmp_path: Path) -> None:
    signed, key = certificate(tmp_path, "token")
    public = tmp_path / "public.pem"
    public.write_bytes(
        subprocess.run(["openssl", "x509", "-in", signed, "-pubkey", "-noout"], check=True, capture_output=True).stdout
    )
    tokens = f"jwt,pub-key={public},priv-key={key},sign-method=RS256,ttl=10m"
    server = EtcdServer(tmp_path / "etcd", "127.0.0.1", *free_ports(2), options=("--auth-token", tokens))
    server.start()
    try:
        plain, password = opened(server), tmp_path / "password"
        password.write_text(ROOT)
        plain._ask("auth/user/add", {"name": "root", "password": ROOT})
        plain._ask("auth/user/grant", {"user": "root", "role": "root"})
        plain._ask("auth/enable", {})
        etcd = Etcd(CoordinatorConfig([server.endpoint], user="root", password_file=str(password)), 5.0)
        assert swap(etcd, {}, {f"{PREFIX}word/r1": b""}).is_done
        etcd._ask("auth/user/add", {"name": "another", "password": "of another"})
        assert swap(etcd, {}, {f"{PREFIX}word/r1": b""}).is_done
    finally:
        server.kill()


class Endpoint(http.server.ThreadingHTTPServer):
    """Answers all alike, as a proxy in front of etcd may. ``asked``: how often each method; ``hangs_up``: after each answer."""

    def __init__(self, status: int, content: bytes, *, hangs_up: bool = False) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.status, self.content, self.hangs_up = status, content, hangs_up
        self.asked: Counter[str] = Counter()
        self.url = f"http://127.0.0.1:{self.server_port}"


class Handler(http.server.BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def do_POST(self) -> None:
        assert isinstance(self.server, Endpoint)
        self.rfile.read(int(self.headers["Content-Length"]))
        method = self.path.removeprefix("/v3/")
        self.server.asked[method] += 1
        is_login = method == "auth/authenticate"
        status, content = (200, b'{"token":"one"}') if is_login else (self.server.status, self.server.content)
        self.send_response(status)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)
        self.close_connection = self.server.hangs_up  # without a word of it, as after a while in which nothing was asked

    def log_message(self, *_: object) -> None:
        """Say nothing."""


@pytest.fixture
def endpoint() -> Iterator[Callable[..., Endpoint]]:
    made: list[Endpoint] = []

    def make(*terms: Any, **more: Any) -> Endpoint:
        made.append(Endpoint(*terms, **more))
        threading.Thread(target=made[-1].serve_forever, daemon=True).start()
        return made[-1]

    yield make
    for one in made:
        one.shutdown()
        one.server_close()


@pytest.mark.parametrize("status", [429, 500, 503])
def test_an_endpoint_in_trouble_is_left_for_the_next(endpoint: Callable[..., Endpoint], status: int) -> None:
    bad, good = endpoint(status, b'{"error":"etcdserver: no leader"}'), endpoint(200, b'{"ID":"7"}')
    etcd = Etcd(CoordinatorConfig([bad.url, good.url]), 5.0)
    assert [etcd.answer(Grant(1_000)) for _ in range(3)] == [Leased(7)] * 3
    assert bad.asked.total() == 1
    with pytest.raises(CoordinatorError, match=r"no etcd answers .*no leader"):
        Etcd(CoordinatorConfig([bad.url]), 5.0).answer(Grant(1_000))


def test_a_token_that_is_never_taken_is_renewed_once(endpoint: Callable[..., Endpoint], tmp_path: Path) -> None:
    (tmp_path / "password").write_text(ROOT)
    stern = endpoint(401, b'{"error":"no"}')
    etcd = Etcd(CoordinatorConfig([stern.url], user="root", password_file=str(tmp_path / "password")), 5.0)
    for _ in range(2):
        with pytest.raises(CoordinatorError, match=r"refuses lease/grant: no \(status 401\)"):
            etcd.answer(Grant(1_000))
    assert stern.asked["lease/grant"] <= 4


@pytest.mark.parametrize("content", [b"{}", b"[]", b'{"ID":"x","responses":[{}]}', b"no JSON"])
def test_what_is_no_answer_of_etcd_is_said_to_be_none(endpoint: Callable[..., Endpoint], content: bytes) -> None:
    etcd = Etcd(CoordinatorConfig([endpoint(200, content).url]), 5.0)
    for request in (Grant(1_000), Swap(PREFIX, ())):
        with pytest.raises(CoordinatorError, match=r"does not answer as etcd does|no etcd answers"):
            etcd.answer(request)


def test_a_connection_that_was_closed_while_nothing_was_asked_is_made_anew(endpoint: Callable[..., Endpoint]) -> None:
    etcd = Etcd(CoordinatorConfig([endpoint(200, b'{"ID":"7"}', hangs_up=True).url]), 5.0)
    assert [etcd.answer(Grant(1_000)) for _ in range(3)] == [Leased(7)] * 3


def test_a_file_that_is_missing_is_named(endpoint: Callable[..., Endpoint], tmp_path: Path) -> None:
    url, missing = endpoint(200, b"{}").url, str(tmp_path / "nobody")
    for keys in ({"user": "root", "password_file": missing}, {"ca": missing}):
        etcd = Etcd(CoordinatorConfig([url.replace("http:", "https:") if "ca" in keys else url], **keys), 5.0)
        with pytest.raises(CoordinatorError, match=f"{missing}.*No such file"):
            etcd.answer(Grant(1_000))


def certificate(place: Path, name: str, signer: str = "") -> tuple[str, str]:
    """A certificate and its key, signed by another one, or by itself."""
    paths = str(place / f"{name}.crt"), str(place / f"{name}.key")
    signed = ["-CA", str(place / f"{signer}.crt"), "-CAkey", str(place / f"{signer}.key")] if signer else []
    subject = ["-subj", f"/CN={name}", "-addext", "subjectAltName=IP:127.0.0.1"]
    command = ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2", "-out", paths[0], "-keyout", paths[1]]
    subprocess.run([*command, *subject, *signed], check=True, capture_output=True)
    return paths


def test_certificates_are_checked_on_both_sides(tmp_path: Path) -> None:
    authority, _ = certificate(tmp_path, "authority")
    theirs, ours, strangers = (certificate(tmp_path, name, "authority") for name in ("server", "robot", "other"))
    alone = certificate(tmp_path, "alone")
    options = ("--cert-file", theirs[0], "--key-file", theirs[1], "--trusted-ca-file", authority, "--client-cert-auth")
    server = EtcdServer(tmp_path / "etcd", "127.0.0.1", *free_ports(2), options=options)
    server.start()
    try:
        etcd = opened(server, ca=authority, certificate=ours[0], key=ours[1])
        assert swap(etcd, {}, {f"{PREFIX}word/r1": b""}).is_done
        config = CoordinatorConfig([server.endpoint], ca=alone[0], certificate=strangers[0], key=strangers[1])
        with pytest.raises(CoordinatorError, match=r"certificate verify failed|CERTIFICATE_VERIFY_FAILED"):
            Etcd(config, 5.0).version()
        with pytest.raises(CoordinatorError, match="no etcd answers"):
            Etcd(CoordinatorConfig([server.endpoint], ca=authority), 5.0).version()
    finally:
        server.kill()


@pytest.mark.parametrize(
    "keys",
    [
        {"endpoints": ["10.0.0.5:2379"]},
        {"endpoints": ["https://10.0.0.5"]},
        {"endpoints": ["https://10.0.0.5:2379/v3"]},
        {"endpoints": ["https://u@10.0.0.5:2379"]},
        {"endpoints": ["http://10.0.0.5:2379"] * 17},
        {"certificate": "robot.crt"},
        {"user": "robot"},
        {"endpoints": ["http://10.0.0.5:2379"], "user": "robot", "password_file": "password"},
        {"endpoints": ["http://127.evil.example:2379"], "user": "robot", "password_file": "password"},
    ],
)
def test_what_reaches_no_etcd_is_refused(keys: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=r"write endpoints|at most|belong together|in the clear"):
        CoordinatorConfig(**keys)  # type: ignore[arg-type]


@pytest.fixture
def members(tmp_path: Path) -> Iterator[list[EtcdServer]]:
    three = three_members(tmp_path / "etcd", ["127.0.0.1"] * 3, free_ports(6), [()] * 3)
    for one in three:
        one.start()
    yield three
    for one in three:
        one.kill()


def asks(*servers: EtcdServer, patience_s: float = 5.0) -> Etcd:
    return Etcd(CoordinatorConfig([one.endpoint for one in servers]), patience_s)


def until_answered(etcd: Etcd, compared: dict[str, int], puts: dict[str, bytes]) -> Swapped:
    """A cluster without a leader answers nothing for a while."""
    deadline = time.monotonic() + PATIENCE_S
    while True:
        try:
            return swap(etcd, compared, puts)
        except CoordinatorError:
            assert time.monotonic() < deadline


def test_a_member_that_does_not_reach_the_two_others_gives_no_old_answer(members: list[EtcdServer]) -> None:
    """The last one stands still while a vote is cast, and the others do when it goes on: what it has is old."""
    key = f"{PREFIX}component/lab/mapper"
    until_answered(asks(*members), {}, {key: b"robot1"})
    behind = asks(members[2], patience_s=2.0)
    assert until_answered(behind, {}, {}).found[key][0] == b"robot1"

    members[2].stop()
    until_answered(asks(*members[:2]), {}, {key: b"robot2"})
    for one in members[:2]:
        one.stop()
    members[2].go_on()
    for request in (Swap(PREFIX, ()), Swap(PREFIX, (Put(f"{PREFIX}word/r1", b"mine", ()),))):
        with pytest.raises(CoordinatorError, match="no etcd answers"):
            behind.answer(request)
    for one in members[:2]:
        one.go_on()
    assert until_answered(behind, {}, {}).found[key][0] == b"robot2"


def test_a_request_that_a_frozen_member_did_not_answer_is_carried_out_by_another_one(members: list[EtcdServer]) -> None:
    etcd, key = asks(*members, patience_s=1.0), f"{PREFIX}component/lab/mapper"
    until_answered(etcd, {}, {key: b"robot1"})
    asked = next(one for one in members if one.endpoint == etcd._endpoints[0])
    revision = until_answered(etcd, {}, {}).found[key][1]
    asked.stop()
    until_answered(etcd, {key: revision}, {key: b"robot2"})
    asked.go_on()
    told = until_answered(asks(asked), {key: revision}, {key: b"robot3"})
    assert not told.is_done and told.found[key][0] == b"robot2"
