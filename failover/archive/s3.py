"""Objects in a bucket of S3, or of a server that speaks its protocol. The only ``obstore`` import, of the extra ``s3``.

The keys come from where every such program has them: the environment (AWS_ACCESS_KEY_ID …), the role of a machine, and
``~/.aws/credentials``, which the library leaves to us.

Sources: PutObject with If-None-Match, and the 5 GB that one put takes: S3's API reference; the file: AWS CLI's user guide.
"""

from __future__ import annotations

import configparser
import contextlib
import mmap
import os
import re
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path
from typing import Any, BinaryIO, Final

from failover.archive.objects import Readable, Stored
from failover.errors import ArchiveError

PUT_SIZE_MAX: Final = 5 << 30
CONNECT: Final = timedelta(seconds=10)
SILENT: Final = timedelta(seconds=60)
"""Without a byte from the server, which answers a put only when it has all of it."""
LEAST_RATE: Final = 250_000
"""Bytes each second: a put or a get that is slower fails. 5 GB may take 6 hours."""
TRIES_MAX: Final = 3
TRYING: Final = timedelta(seconds=60)
REGION: Final = "us-east-1"
"""Where no other is named: servers other than S3 have none, and the signature needs one."""

KEYS: Final = {
    "aws_access_key_id": "access_key_id",
    "aws_secret_access_key": "secret_access_key",
    "aws_session_token": "session_token",
}


_WORD: Final = re.compile(r"<Code>([^<]+)</Code>(?:.*?<Message>([^<]*)</Message>)?", re.DOTALL)
_CURES: Final = {
    "NoSuchBucket": "make the bucket, or correct s3 in [store]",
    "403 Forbidden": "look at the keys of the bucket, and at what they may do",
    "401 Unauthorized": "look at the keys of the bucket, and at what they may do",
    "169.254.169.254": "this machine has no keys of the bucket: set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY",
    "NoSuchKey": "it was removed; take another one",
}
"""What shows in the library's words, and the cure. The address is where a machine's role is asked for."""

ELSE: Final = "look at the server, and at the network"


class S3Objects:
    """The objects below a prefix of a bucket, as `failover.archive.objects.ObjectStore` says."""

    def __init__(self, bucket: str, prefix: str, endpoint: str = "") -> None:
        """
        Args:
            endpoint: URL of the server; "": what the environment says (AWS_ENDPOINT_URL), else S3 itself.

        Raises:
            ArchiveError: the library is not installed, or cannot use these settings.
        """
        try:
            import obstore
            from obstore import exceptions
        except ImportError as error:
            raise ArchiveError(
                "an archive in S3 needs the library obstore, which is not installed: pip install 'failover[s3]'; "
                "the Debian package has archives in folders and at witnesses only"
            ) from error
        self._library, self._errors = obstore, exceptions
        self._place = f"s3://{bucket}/{prefix}".rstrip("/") + (f" at {endpoint}" if endpoint else "")
        region = os.environ.get("AWS_REGION") or os.environ.get("AWS_DEFAULT_REGION") or REGION
        self._settings: dict[str, Any] = {
            "prefix": prefix or None,
            "region": region,
            "checksum_algorithm": "sha256",
            "disable_bulk_delete": True,  # not every server has it
            "retry_config": {"max_retries": TRIES_MAX, "retry_timeout": TRYING},
            **({"endpoint": endpoint} if endpoint else {}),
            **_keys_of_file(),
        }
        self._bucket = bucket
        self._is_open = (endpoint or os.environ.get("AWS_ENDPOINT_URL", "")).startswith("http://")
        self._store = self._client(PUT_SIZE_MAX, read_timeout=SILENT)

    def _client(self, size: int, **limits: timedelta) -> Any:
        """The library's store, for requests of at most so many bytes."""
        from obstore.store import S3Store

        whole = SILENT + timedelta(seconds=size / LEAST_RATE)
        options: Any = {"allow_http": self._is_open, "connect_timeout": CONNECT, "timeout": whole, **limits}
        with self._told("be used"):
            return S3Store(self._bucket, client_options=options, **self._settings)

    def put(self, name: str, content: BinaryIO) -> bool:
        """See `ObjectStore.put`. The server compares a digest of the content."""
        size = os.fstat(content.fileno()).st_size
        if size > PUT_SIZE_MAX:
            raise ArchiveError(f"{name} has {size} bytes: S3 takes {PUT_SIZE_MAX} at once; use a folder as the archive")
        client = self._client(size)  # of its own: the library's read_timeout would run while the content is sent
        mapped = mmap.mmap(content.fileno(), size, prot=mmap.PROT_READ)
        try:
            with self._told(f"take {name}"):
                self._library.put(client, name, memoryview(mapped), mode="create")  # not copied: the file's own pages
        except _FoundError:
            return False
        finally:
            with contextlib.suppress(BufferError):  # after a timeout the library still has it for a while
                mapped.close()
        return True

    def size(self, name: str) -> int | None:
        """See `ObjectStore.size`."""
        with contextlib.suppress(_MissingError), self._told(f"say whether it has {name}"):
            return int(self._library.head(self._store, name)["size"])
        return None

    def open(self, name: str, first: int = 0) -> Readable:
        """See `ObjectStore.open`."""
        with self._told(f"give {name}"):
            return _Body(self, name, iter(self._library.get(self._store, name, options={"range": {"offset": first}})))

    def listed(self, folder: str) -> Iterator[Stored]:
        """See `ObjectStore.listed`."""
        with self._told("list its objects"):
            found = [
                Stored(one["path"], one["size"], one["last_modified"].timestamp())
                for part in self._library.list(self._store, folder)
                for one in part
            ]
        yield from sorted(found, key=lambda one: one.name)

    def remove(self, name: str) -> None:
        """See `ObjectStore.remove`."""
        with contextlib.suppress(_MissingError), self._told(f"remove {name}"):
            self._library.delete(self._store, name)

    @contextlib.contextmanager
    def _told(self, tried: str) -> Iterator[None]:
        """Turn what the library says into one sentence."""
        try:
            yield
        except (self._errors.BaseError, ValueError, OSError) as error:
            kind = ArchiveError
            if isinstance(error, self._errors.AlreadyExistsError | self._errors.PreconditionError):
                kind = _FoundError
            elif isinstance(error, self._errors.NotFoundError | FileNotFoundError):
                kind = _MissingError
            raise kind(f"the archive {self._place} did not {tried}: {_in_words(str(error))}") from error


def _in_words(said: str) -> str:
    """The server's own word where it gave one, else the library's, and what to do."""
    words = _WORD.search(said)
    first = f"{words[1]}: {words[2] or ''}".rstrip(" :.") if words else said.partition("\n")[0].rpartition(" - ")[2].rstrip(" :")
    return f"{first}; {next((cure for sign, cure in _CURES.items() if sign in said), ELSE)}"


class _FoundError(ArchiveError):
    """There is an object of that name."""


class _MissingError(ArchiveError):
    """There is no object of that name."""


class _Body:
    """An object's content as it arrives."""

    def __init__(self, objects: S3Objects, name: str, parts: Iterator[Any]) -> None:
        self._objects, self._name, self._parts = objects, name, parts
        self._rest = memoryview(b"")

    def read(self, size: int, /) -> bytes:
        """See `failover.archive.objects.Readable`."""
        if not self._rest:
            with self._objects._told(f"give all of {self._name}"):
                self._rest = memoryview(next(self._parts, b""))
        taken, self._rest = self._rest[:size], self._rest[size:]
        return bytes(taken)

    def close(self) -> None:
        """Ask for no more."""
        self._parts = iter(())


def _keys_of_file() -> dict[str, str]:
    """What ``~/.aws/credentials`` says, where the environment says nothing."""
    if os.environ.get("AWS_ACCESS_KEY_ID"):
        return {}
    path = Path(os.environ.get("AWS_SHARED_CREDENTIALS_FILE") or Path.home() / ".aws" / "credentials")
    found = configparser.RawConfigParser()
    try:
        found.read(path)
    except (configparser.Error, UnicodeDecodeError) as error:
        raise ArchiveError(f"{path} cannot be read: {str(error).splitlines()[0]}") from error
    profile = os.environ.get("AWS_PROFILE") or "default"
    return {ours: found[profile][theirs] for theirs, ours in KEYS.items() if found.has_option(profile, theirs)}
