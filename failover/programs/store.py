"""What a robot keeps of programs that were sent to it: bundles by their content, states of versions, a log, and kept states.

::

    bundles/DIGEST.bundle   as it came, checked anew before each start
    bundles/DIGEST/         its files, read-only
    NAME.json               the versions of one program, and their states
    NAME.log                what was done and why, a JSON object a line
    PATH.kept.0, .1         mailbox and state of what runs under a path: written in turn, the newer whole one counts
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final

import msgspec
from blake3 import blake3
from msgspec import Struct

from checkpoint.errors import UNDECODABLE
from checkpoint.store.whole_file import write_whole
from failover.core.messaging.mailbox import Stream
from failover.core.programs import manifest, states, versions
from failover.core.programs.archive import Member
from failover.core.programs.bundle import Program
from failover.core.programs.manifest import Manifest
from failover.core.programs.states import Shelf, State, Version
from failover.errors import BundleRefusedError, ProgramError
from failover.programs import packing
from failover.programs.admission import Admitted, admit
from failover.programs.channel import State as KeptState

PLACE: Final = "FAILOVER_PROGRAMS"
LOG_SIZE_MAX: Final = 1 << 20
"""Bytes of one log; then the older half goes."""

UID_FIRST: Final = 61_184
UIDS: Final = 4_336
"""Users of their own for programs: those that systemd calls dynamic. Source: systemd.io/UIDS-GIDS."""

_CHECK_SIZE: Final = 32


class Kept(Struct, frozen=True):
    """What outlives a host. ``number``: of this writing; ``at_s``: when, in seconds since 1970."""

    number: int
    version: str
    state: KeptState | None
    streams: dict[str, Stream]
    at_s: float = 0.0


def default_place() -> Path:
    """Where programs are kept: `$FAILOVER_PROGRAMS`; else below /var/lib/failover for root, and in the user's own folder."""
    if found := os.environ.get(PLACE):
        return Path(found)
    if os.geteuid() == 0:
        return Path("/var/lib/failover/programs")
    return Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local/state") / "failover/programs"


class Store:
    """One place. Several processes may use it at once."""

    def __init__(self, place: Path) -> None:
        self.place = place

    def open(self) -> Store:
        """Make the folders, if need be.

        Raises:
            ProgramError: they cannot be made, or others may write there.
        """
        try:
            for folder in (self.place, self.place / "bundles"):
                folder.mkdir(mode=0o711, parents=True, exist_ok=True)
                found = folder.lstat()
                if found.st_uid != os.geteuid() or found.st_mode & 0o022:
                    raise ProgramError(
                        f"{folder} is another user's, or others may write to it: chmod 711, or name another place in {PLACE}"
                    )
        except OSError as error:
            raise ProgramError(f"cannot keep programs in {self.place}: {error.strerror}; {PLACE} names another place") from error
        return self

    @contextlib.contextmanager
    def locked(self) -> Iterator[None]:
        """Change shelves alone."""
        descriptor = os.open(self.place / ".lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX)
            yield
        finally:
            os.close(descriptor)

    # --- Bundles ----------------------------------------------------------------------------------------------------------

    def take(self, content: bytes, team: Path) -> Admitted:
        """Check a bundle and unpack it: received → verified → staged. A refused one leaves nothing.

        Raises:
            BundleRefusedError: it may not run here.
        """
        admitted = admit(content, team)
        said, digest = admitted.program.manifest, admitted.program.digest
        with self.locked():
            shelf = self.find(said.name) or Shelf(said.name, said.path)
            self._check(shelf, admitted)
            known = shelf.find(said.version)
            self._unpack(admitted.program, content)  # also one that is here: its signature may be newer, its files damaged
            if known is None or known.state is State.REFUSED:
                one = states.stage(states.verify(Version(said.version, digest), admitted.owner))
                self.put(states.put(shelf, one))
                self.log(said.name, f"{said.version} staged as {digest[:12]}: signed by {admitted.owner}; {admitted.because}")
        return admitted

    @staticmethod
    def _check(shelf: Shelf, admitted: Admitted) -> None:
        said = admitted.program.manifest
        if shelf.path != said.path:
            raise ProgramError(
                f"{said.name} speaks for {shelf.path} here, and this bundle for {said.path}: give the program another name"
            )
        known = [(one.version, one.digest) for one in shelf.versions if one.digest]
        versions.check_no_downgrade(said.name, said.version, admitted.program.digest, shelf.floor, known)

    def _unpack(self, program: Program, content: bytes) -> None:
        """Aside, then renamed: what is there is whole."""
        folder, aside = self.tree(program.digest), self.place / "bundles" / f"{program.digest}.new"
        shutil.rmtree(aside, ignore_errors=True)
        try:
            aside.mkdir(mode=0o755)
            for one in program.files:
                _write_new(aside, one)
            write_whole(self._bundle(program.digest), content)
            if not _is_whole(folder, program):
                shutil.rmtree(folder, ignore_errors=True)
                aside.rename(folder)
        except OSError as error:
            raise ProgramError(f"cannot unpack {program.manifest.name}: {error.strerror}; nothing was changed") from error
        finally:
            shutil.rmtree(aside, ignore_errors=True)

    def bring(self, digest: str, content: bytes, team: Path, check: Callable[[Manifest], None]) -> None:
        """Check a bundle that came with a program's state, and unpack it; the shelf is not changed.

        Args:
            check: raises BundleRefusedError for a manifest of another program or version than was said.

        Raises:
            BundleRefusedError: it may not run here.
            ProgramError: it cannot be unpacked.
        """
        found = admit(content, team)
        if found.program.digest != digest:
            other = found.program.digest
            raise BundleRefusedError(f"the bundle {digest[:12]} that came with the state has the content of {other[:12]}")
        check(found.program.manifest)
        with self.locked():
            self._unpack(found.program, content)

    def tree(self, digest: str) -> Path:
        """Where a bundle's files are."""
        return self.place / "bundles" / digest

    def has(self, digest: str) -> bool:
        """Whether a bundle is here; `admitted` says whether it may run."""
        return bool(digest) and self._bundle(digest).exists()

    def bundle(self, digest: str) -> bytes:
        """A bundle's bytes.

        Raises:
            ProgramError: it cannot be read.
        """
        return packing.read_file(self._bundle(digest))

    def _bundle(self, digest: str) -> Path:
        return self.tree(digest).with_suffix(".bundle")

    def admitted(self, digest: str, team: Path) -> Admitted:
        """A staged bundle, once everything about it was checked anew, and its files are those of the bundle.

        Raises:
            BundleRefusedError: it may not run any more.
            ProgramError: its files were changed.
        """
        content = self.bundle(digest)
        found = admit(content, team)
        if found.program.digest != digest:
            raise ProgramError(f"the bundle {digest[:12]} was replaced in {self.place}; send it again")
        for one in found.program.files:
            if not _is_as_unpacked(self.tree(digest), one):
                raise ProgramError(f"{self.tree(digest) / one.path} was changed since it was unpacked; send the bundle again")
        return found

    # --- Shelves and their log --------------------------------------------------------------------------------------------

    def find(self, name: str) -> Shelf | None:
        """The versions of a program; None: it is not here.

        Raises:
            ProgramError: the name cannot be one, or the file is damaged.
        """
        manifest.check_name(name)
        path = self.place / f"{name}.json"
        try:
            return msgspec.json.decode(path.read_bytes(), type=Shelf)
        except FileNotFoundError:
            return None
        except (OSError, *UNDECODABLE) as error:
            raise ProgramError(f"{path} cannot be read: {error}") from error

    def shelf(self, name: str) -> Shelf:
        """The versions of a program.

        Raises:
            ProgramError: it is not here.
        """
        found = self.find(name)
        if found is None:
            known = ", ".join(one.name for one in self.shelves())
            there = f"here are {known}" if known else "none is here"
            raise ProgramError(f"no program {name!r} is here ({there}); failover program send brings one")
        return found

    def shelves(self) -> list[Shelf]:
        """All programs."""
        names = sorted(path.stem for path in self.place.glob("*.json"))
        return [found for name in names if (found := self.find(name)) is not None]

    def put(self, shelf: Shelf, *, is_lasting: bool = True) -> None:
        """Keep it; to be called in `locked`. ``is_lasting``: it outlives a power cut; else only after `settle`."""
        if not shelf.uid:
            shelf = msgspec.structs.replace(shelf, uid=self._free_uid(shelf.name))
        content = msgspec.json.format(msgspec.json.encode(shelf)) + b"\n"
        write_whole(self.place / f"{shelf.name}.json", content, lasts="content" if is_lasting else "process")

    def settle(self, name: str) -> None:
        """Have the disk keep what was put."""
        with contextlib.suppress(OSError):
            descriptor = os.open(self.place / f"{name}.json", os.O_RDONLY | os.O_CLOEXEC)
            try:
                os.fsync(descriptor)
            finally:
                os.close(descriptor)

    def _free_uid(self, name: str) -> int:
        import pwd

        taken = {one.uid for one in self.shelves()}
        first = int.from_bytes(blake3(name.encode()).digest(4), "big")
        for number in range(UIDS):
            uid = UID_FIRST + (first + number) % UIDS
            if uid in taken:
                continue
            try:
                pwd.getpwuid(uid)
            except KeyError:
                return uid
        raise ProgramError(f"all {UIDS} users for programs are taken")

    def log(self, name: str, what: str) -> None:
        """Add a line."""
        path = self.place / f"{name}.log"
        line = json.dumps({"at": round(time.time(), 3), "what": what}, ensure_ascii=False) + "\n"
        with contextlib.suppress(OSError):
            with path.open("a") as file:
                file.write(line)
            if path.stat().st_size > LOG_SIZE_MAX:
                write_whole(path, path.read_bytes()[-LOG_SIZE_MAX // 2 :].partition(b"\n")[2])

    def lines(self, name: str) -> list[dict[str, object]]:
        """The log, oldest first.

        Raises:
            ProgramError: there is none.
        """
        self.shelf(name)
        try:
            text = (self.place / f"{name}.log").read_text(errors="replace")
        except OSError:
            return []
        return [json.loads(line) for line in text.splitlines() if line.startswith("{") and line.endswith("}")]

    # --- Kept states ------------------------------------------------------------------------------------------------------

    def keep(self, path: str, kept: Kept, *, is_lasting: bool = False) -> None:
        """Write it in place of the one before the last; ``is_lasting``: it outlives a power cut too.

        Raises:
            ProgramError: it cannot be written.
        """
        body = msgspec.msgpack.encode(kept)
        file = self._kept(path, kept.number % 2)
        try:
            write_whole(file, blake3(body).digest(_CHECK_SIZE) + body, lasts="content" if is_lasting else "process")
        except OSError as error:
            raise ProgramError(f"cannot keep the state of {path} in {file}: {error.strerror}") from error

    def kept(self, path: str) -> Kept | None:
        """The newest whole one."""
        found: list[Kept] = []
        for turn in (0, 1):
            with contextlib.suppress(OSError, *UNDECODABLE):
                content = self._kept(path, turn).read_bytes()
                if blake3(content[_CHECK_SIZE:]).digest(_CHECK_SIZE) == content[:_CHECK_SIZE]:
                    found.append(msgspec.msgpack.decode(content[_CHECK_SIZE:], type=Kept))
        return max(found, key=lambda one: one.number, default=None)

    def _kept(self, path: str, turn: int) -> Path:
        return self.place / f"{blake3(path.encode()).hexdigest(8)}.kept.{turn}"


def _write_new(folder: Path, one: Member) -> None:
    path = folder / one.path
    path.parent.mkdir(mode=0o755, parents=True, exist_ok=True)
    mode = 0o555 if one.is_executable else 0o444
    with open(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, mode), "wb") as file:
        file.write(one.content)


def _is_whole(folder: Path, program: Program) -> bool:
    return all(_is_as_unpacked(folder, one) for one in program.files)


def _is_as_unpacked(folder: Path, one: Member) -> bool:
    path = folder / one.path
    try:
        return not path.is_symlink() and packing.read_file(path) == bytes(one.content)
    except ProgramError:
        return False
