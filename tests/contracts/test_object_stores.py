"""The contract of the place of an archive, `failover.archive.objects`: one suite for a folder, S3, and a witness."""

from __future__ import annotations

import contextlib
import errno
import os
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from datetime import timedelta
from pathlib import Path
from typing import BinaryIO

import pytest

from failover.archive.archive import object_store
from failover.archive.objects import FolderObjects, ObjectStore, Readable
from failover.archive.witness import WitnessObjects
from failover.errors import ArchiveError
from tests import s3_servers, witnesses

WITNESS = "witness"
KEY = bytes(range(32))
NAME = "lab/@%2Flab%2Fr1%2Fmapper/0001-0002-00ff.base.sealed"


@pytest.fixture(scope="module", params=["folder", *s3_servers.KINDS, WITNESS])
def place(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, str]]:
    """Where the objects lie, and the server's URL; a witness is made for each test."""
    if request.param == WITNESS:
        yield WITNESS, ""
        return
    directory = tmp_path_factory.mktemp("objects") / "place"
    directory.mkdir()
    if request.param == "folder":
        yield str(directory), ""
        return
    with s3_servers.server(request.param, directory) as url:
        yield f"s3://{s3_servers.BUCKET}", url


@pytest.fixture
def objects(place: tuple[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[ObjectStore]:
    """An empty one: each test has a prefix, a folder, or a witness of its own."""
    if place[0] == WITNESS:
        with witnesses.keeping(tmp_path, KEY) as gate:
            yield WitnessObjects(gate, KEY)
        return
    for name, value in s3_servers.environment().items():
        monkeypatch.setenv(name, value)
    where = f"{place[0]}/{tmp_path.name}"
    if not place[1]:
        Path(where).mkdir()
    yield object_store(where, place[1])


@pytest.fixture
def content(tmp_path: Path) -> Iterator[BinaryIO]:
    with (tmp_path / "content").open("w+b") as file:
        file.write(os.urandom(3 << 20))
        file.flush()
        yield file


def whole(source: Readable) -> bytes:
    with closing(source):
        return b"".join(iter(lambda: source.read(1 << 16), b""))


def test_what_was_put_is_given_back_whole_and_from_any_byte_on(objects: ObjectStore, content: BinaryIO) -> None:
    content.seek(0)
    sent = content.read()
    assert objects.size(NAME) is None
    assert objects.put(NAME, content)
    assert objects.size(NAME) == len(sent)
    assert whole(objects.open(NAME)) == sent
    for first in (1, 1 << 20, len(sent) - 1):
        assert whole(objects.open(NAME, first)) == sent[first:]


def test_the_first_put_of_a_name_wins(objects: ObjectStore, content: BinaryIO, tmp_path: Path) -> None:
    assert objects.put(NAME, content)
    with (tmp_path / "other").open("w+b") as other:
        other.write(b"another content")
        other.flush()
        assert not objects.put(NAME, other)
    content.seek(0)
    assert whole(objects.open(NAME)) == content.read()


def test_of_puts_at_the_same_time_one_wins(objects: ObjectStore, tmp_path: Path) -> None:
    won: list[bytes] = []
    ready = threading.Barrier(4)

    def put(content: bytes) -> None:
        with (tmp_path / content.decode()).open("w+b") as file:
            file.write(content * 1000)
            file.flush()
            ready.wait()
            if objects.put(NAME, file):
                won.append(content)

    threads = [threading.Thread(target=put, args=(name.encode(),)) for name in ("one", "two", "three", "four")]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(won) == 1
    assert whole(objects.open(NAME)) == won[0] * 1000


def test_objects_are_listed_by_folder_in_the_order_of_their_names(objects: ObjectStore, content: BinaryIO) -> None:
    assert list(objects.listed("lab")) == []
    for name in ("lab/b/2", "lab/b/1", "lab/a/3", "laboratory/a/4"):
        objects.put(name, content)
    assert [one.name for one in objects.listed("lab")] == ["lab/a/3", "lab/b/1", "lab/b/2"]
    assert [one.name for one in objects.listed("lab/b")] == ["lab/b/1", "lab/b/2"]
    (one,) = objects.listed("lab/a")
    assert one.size == 3 << 20 and one.at_s > 1_000_000_000


def test_what_was_removed_can_be_put_again(objects: ObjectStore, content: BinaryIO) -> None:
    objects.remove(NAME)
    objects.put(NAME, content)
    objects.remove(NAME)
    assert objects.size(NAME) is None and list(objects.listed("lab")) == []
    with pytest.raises(ArchiveError, match="mapper"):
        objects.open(NAME)
    assert objects.put(NAME, content)


def test_a_place_that_is_not_there_is_named_in_one_sentence(
    place: tuple[str, str], content: BinaryIO, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if place[0] == WITNESS:
        pytest.skip("what an agent says without one: tests/e2e/test_sealed_copies.py")
    for name, value in s3_servers.environment().items():
        monkeypatch.setenv(name, value)
    where = "s3://no-such-bucket/x" if place[1] else str(tmp_path / "not-mounted")
    objects = object_store(where, place[1])
    for act in (lambda: objects.put(NAME, content), lambda: list(objects.listed("lab"))):
        with pytest.raises(ArchiveError, match=where) as refusal:
            act()
        assert "\n" not in str(refusal.value)
        assert str(refusal.value).endswith(
            "make the bucket, or correct s3 in [store]" if place[1] else "mount the disk, or make it"
        )


def test_a_server_that_does_not_answer_is_named(content: BinaryIO, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("obstore")
    for name, value in s3_servers.environment().items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr("failover.archive.s3.TRIES_MAX", 0)
    objects = object_store("s3://robots/lab", "http://127.0.0.1:1")
    with pytest.raises(ArchiveError, match=r"s3://robots/lab at http://127\.0\.0\.1:1 did not .*; look at the server") as refusal:
        objects.put(NAME, content)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("said", "told"),
    [
        (
            "Generic: PUT http://x - Server returned non-2xx status code: 403 Forbidden: <Code>AccessDenied</Code>",
            "AccessDenied; look at the keys",
        ),
        (
            "Generic: in 3 ms - HTTP error: error sending request\n\nDebug source",
            "HTTP error: error sending request; look at the server",
        ),
        ("<Error><Code>NoSuchBucket</Code>\n<Message>None.</Message>", "NoSuchBucket: None; make the bucket"),
    ],
)
def test_what_a_server_says_is_told_with_a_cure(said: str, told: str) -> None:
    from failover.archive import s3

    assert s3._in_words(said).startswith(told)


@contextlib.contextmanager
def slow_server(pause_s: float, answers: bool = True) -> Iterator[str]:
    """A server of one connection that pauses before it reads each 64 kB of what is put."""
    with socket.create_server(("127.0.0.1", 0)) as listening:

        def serve() -> None:
            with contextlib.suppress(OSError), listening.accept()[0] as one, one.makefile("rb") as arriving:
                size = 0
                while (line := arriving.readline().lower()) != b"\r\n":
                    size = int(line.partition(b":")[2]) if line.startswith(b"content-length:") else size
                while size > 0:
                    time.sleep(pause_s)
                    size -= len(arriving.read(min(size, 1 << 16)))
                if answers:
                    one.sendall(b'HTTP/1.1 200 OK\r\nETag: "x"\r\nContent-Length: 0\r\nConnection: close\r\n\r\n')
                gone.wait()

        gone = threading.Event()
        thread = threading.Thread(target=serve)
        thread.start()
        try:
            yield f"http://127.0.0.1:{listening.getsockname()[1]}"
        finally:
            gone.set()
            with contextlib.suppress(OSError):
                listening.shutdown(socket.SHUT_RDWR)  # nobody may have come
            thread.join()


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    pytest.importorskip("obstore")
    for name, value in s3_servers.environment().items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr("failover.archive.s3.SILENT", timedelta(seconds=0.5))
    monkeypatch.setattr("failover.archive.s3.TRIES_MAX", 0)
    return monkeypatch


def test_a_put_may_take_longer_than_a_server_may_be_silent(impatient: pytest.MonkeyPatch, content: BinaryIO) -> None:
    content.truncate(16 << 20)  # more than the kernel takes of a connection that nobody reads
    with slow_server(0.01) as url:
        assert object_store("s3://robots/lab", url).put(NAME, content)


def test_a_put_that_is_never_answered_is_told_in_one_sentence(impatient: pytest.MonkeyPatch, content: BinaryIO) -> None:
    impatient.setattr("failover.archive.s3.LEAST_RATE", 1 << 40)
    with slow_server(0.0, answers=False) as url, pytest.raises(ArchiveError, match=r"s3://robots/lab at .* did not take "):
        object_store("s3://robots/lab", url).put(NAME, content)


def test_a_folder_leaves_nothing_aside_and_names_lead_nowhere_else(tmp_path: Path, content: BinaryIO) -> None:
    objects = FolderObjects(tmp_path)
    objects.put("lab/a", content)
    objects.put("lab/a", content)
    assert sorted(path.name for path in (tmp_path / "lab").iterdir()) == ["a"]
    with pytest.raises(ArchiveError, match="names no object"):
        objects.put("lab/../../b", content)


@pytest.mark.parametrize("number", [errno.EROFS, errno.EACCES])
def test_a_folder_that_a_service_may_not_write_is_told_with_the_cure(
    number: int, tmp_path: Path, content: BinaryIO, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*arguments: object, **keywords: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(Path, "mkdir", refuse)
    with pytest.raises(ArchiveError, match=f"{os.strerror(number)}; the agent's service needs ReadWritePaths= for it"):
        FolderObjects(tmp_path).put(NAME, content)


def test_the_keys_are_those_of_the_users_file_where_the_environment_has_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("obstore")
    from failover.archive import s3

    path = tmp_path / "credentials"
    path.write_text("[default]\naws_access_key_id = a\naws_secret_access_key = b%\n[other]\naws_access_key_id = c\n")
    monkeypatch.setenv("AWS_SHARED_CREDENTIALS_FILE", str(path))
    monkeypatch.delenv("AWS_ACCESS_KEY_ID", raising=False)
    assert s3._keys_of_file() == {"access_key_id": "a", "secret_access_key": "b%"}
    monkeypatch.setenv("AWS_PROFILE", "other")
    assert s3._keys_of_file() == {"access_key_id": "c"}
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "mine")
    assert s3._keys_of_file() == {}
    monkeypatch.delenv("AWS_ACCESS_KEY_ID")
    path.write_text("no section")
    with pytest.raises(ArchiveError, match="credentials cannot be read"):
        s3._keys_of_file()
