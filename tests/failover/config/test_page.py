"""page.toml: every key in the sample with its default, and where the page may not listen."""

from __future__ import annotations

import dataclasses
import re
import tomllib
from pathlib import Path

import pytest

from failover.config.page import PageConfig, UserConfig, hashed, read
from failover.errors import FileMistakeError, PageError

SAMPLE = Path(__file__).parents[3] / "systemd" / "page.toml"
LOOPBACK = ("127.0.0.1:7480", "[::1]:7480", "127.0.0.2:0")
TLS = {"certificate": "/a.pem", "key": "/a.key"}


def test_every_key_and_its_default_stand_in_the_sample() -> None:
    documented = tomllib.loads(re.sub(r"^#(\w+ = |\[)", r"\1", SAMPLE.read_text(), flags=re.MULTILINE))
    (user,) = documented.pop("users").values()
    assert documented | {"users": {}} == dataclasses.asdict(PageConfig())
    assert set(user) == {one.name for one in dataclasses.fields(UserConfig)}
    assert read(SAMPLE) == PageConfig()


@pytest.mark.parametrize("listen", LOOPBACK)
def test_on_the_loopback_neither_tls_nor_users_are_needed(listen: str) -> None:
    PageConfig(listen=listen).check()


@pytest.mark.parametrize("listen", ["0.0.0.0:7480", "[::]:7480", "192.168.7.11:7480"])
def test_elsewhere_both_are_needed_and_the_refusal_names_what_lacks(listen: str) -> None:
    users = {"anna": UserConfig(hashed("x"))}
    PageConfig(listen=listen, users=users, **TLS).check()
    for config, lacks in (
        (PageConfig(listen=listen, **TLS), r"needs a login \(\[users\]\) in"),
        (PageConfig(listen=listen, users=users), r"needs TLS \(certificate, key\) in"),
        (PageConfig(listen=listen), r"needs TLS .* and a login"),
    ):
        with pytest.raises(PageError, match=lacks):
            config.check()


@pytest.mark.parametrize(
    "listen", ["", "7480", "127.0.0.1", "127.0.0.1:", "127.0.0.1:65536", "127.0.0.1:-1", "robot1:7480", "[::1:7480"]
)
def test_what_is_no_address_is_told(listen: str) -> None:
    with pytest.raises(PageError, match=r"is no address with a port|needs TLS"):
        PageConfig(listen=listen).check()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('lisen = "x"', "lisen"),
        ('certificate = "/a.pem"', "certificate and key belong together"),
        ('[users.anna]\npassword = "swordfish"', "failover page --password"),
        ("[users.anna]\naccount = 1", "account"),
        (f'[users."an na"]\npassword = "{hashed("x")}"', "is no name"),
    ],
)
def test_a_mistake_is_named_with_its_line(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "page.toml"
    path.write_text(text)
    with pytest.raises(FileMistakeError, match=words) as told:
        read(path)
    assert str(path) in str(told.value)


def test_a_file_that_was_named_must_be_there(tmp_path: Path) -> None:
    with pytest.raises(FileMistakeError, match="there is no such file"):
        read(tmp_path / "missing.toml")
