"""archive key, list, fetch: checkpoints in an object store, for a machine that has nothing but the team's keys."""

from __future__ import annotations

import argparse
import contextlib
import os
import shutil
import tomllib
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import BinaryIO, Final

import msgspec

from checkpoint.errors import UNDECODABLE
from checkpoint.sentences import visible
from checkpoint.snapshot import format
from checkpoint.snapshot.required_files import Need, needs
from checkpoint.store.content_store import CONTENT_MODE, digest_of_file, path_in
from failover.archive import keys, signature
from failover.archive.archive import Archive, Copy, object_store
from failover.cli.output import render, team_tree
from failover.config import team as team_directory
from failover.config.store import StoreConfig
from failover.errors import ArchiveError

CONFIG: Final = Path("/etc/failover/agent.toml")
CONTENTS_SUFFIX: Final = ".contents"
CLOCK_S: Final = 60.0
NAMED: Final = 3
"""Files that a sentence names."""


def key(arguments: argparse.Namespace) -> int:
    """Make the team's archive key, its recovery key, and the public half by which a witness proves what it keeps."""
    team = Path(arguments.directory)
    path, recovery = keys.key_path(team), keys.recovery_path(team)
    if not path.exists() or signature.public_path(team).exists():
        path = keys.new_key(team)  # refuses where there is one
    signature.write_public(team, keys.read_key(team))
    public = signature.public_path(team)
    if arguments.json:
        render.as_json({"file": str(path), "recovery": str(recovery) if recovery.exists() else "", "public": str(public)})
    else:
        print(f"{path} is the archive key: carry it to the same place at every robot and server, and keep a copy elsewhere")
        if recovery.exists():
            print(f"{recovery} opens each copy when no robot's own key is left: move it, with that copy, to where no robot is")
        print(f"{public} opens nothing: carry it to the same place at a witness that is to keep sealed copies")
    return 0


def listed(arguments: argparse.Namespace) -> int:
    """List the copies, the newest of each component first."""
    place, archive = _archive(arguments)
    copies = archive.named(arguments.name) if arguments.name else archive.copies()
    if arguments.json:
        render.as_json({"place": place, "copies": [_told(copy) for copy in copies]})
        return 0
    if not copies:
        of_name = f" of {arguments.name}" if arguments.name else ""
        print(f"no checkpoint{of_name} is in the archive {place}")
        return 0
    lines = [
        (visible(copy.component), str(copy.epoch), str(copy.sequence), _when(copy.at_s), team_tree.size(copy.size))
        for copy in copies
    ]
    render.table(("component", "epoch", "number", "archived", "size"), lines)
    return 0


def fetch(arguments: argparse.Namespace) -> int:
    """Bring one copy here, and the files that its program needs and this machine lacks."""
    place, archive = _archive(arguments)
    copy = _meant(archive, place, arguments)
    output = Path(arguments.output)
    contents = output.with_name(output.name + CONTENTS_SUFFIX)
    with _told_of(output), new_file(output) as file:
        label = archive.fetch(copy, file)
        outline = format.read_outline(file.fileno())
        brought, missing = _bring(archive, needs(outline), contents)
    if arguments.json:
        told = {
            "component": outline.component,
            "file": str(output),
            "robot": label.robot,
            "brought": brought,
            "missing": missing,
            "at": label.at_s,
        }
        render.as_json(_told(copy) | told | {"contents": str(contents) if brought else ""})
        return 0
    print(f"{output} holds {outline.component} as {label.robot} archived it at {_when(label.at_s)}")
    if copy.at_s - label.at_s > CLOCK_S:
        print(f"the clock of {label.robot} was wrong: its name says {_when(copy.at_s)}, as the copy before it was no older")
    if brought:
        print(f"{contents} holds {len(brought)} of its files that this machine lacks: {', '.join(brought[:NAMED])}")
    for path in missing:
        print(f"it needs {path}, which is neither here nor whole in the archive: install it first")
    print(f"failover restore {output}{f' --contents {contents}' if brought else ''} starts it")
    return 0


def _archive(arguments: argparse.Namespace) -> tuple[str, Archive]:
    """The archive that is meant: as said, else as agent.toml says."""
    place, endpoint = arguments.place, arguments.endpoint
    if place is None:
        config = StoreConfig()
        try:
            with contextlib.suppress(FileNotFoundError):
                config = msgspec.convert(tomllib.loads(CONFIG.read_text()).get("store", {}), StoreConfig)
        except (OSError, *UNDECODABLE) as error:
            why = (error.strerror if isinstance(error, OSError) else "") or str(error)
            raise ArchiveError(
                f"{CONFIG} does not say where the archive is: {why}; name it by --place s3://BUCKET/PREFIX"
            ) from error
        if config.witness:
            raise ArchiveError(
                f"the copies are at witness {config.witness}, which gives them to agents: failover-agent recover takes one; "
                "or name the folder sealed of its state directory, or a copy of that, by --place"
            )
        place, endpoint = config.s3, endpoint if endpoint is not None else config.s3_endpoint
    try:
        StoreConfig(s3=place, s3_endpoint=endpoint or "")
    except ValueError as error:
        raise ArchiveError(str(error)) from error
    if not place:
        raise ArchiveError(f"no archive is named: {CONFIG} has no s3 in [store]; name it by --place s3://BUCKET/PREFIX")
    directory = Path(arguments.directory)
    team = team_directory.read(directory)
    aside = Path(getattr(arguments, "output", "")).parent
    return place, Archive(object_store(place, endpoint or ""), keys.read_keys(directory, team), team.team, aside)


def _meant(archive: Archive, place: str, arguments: argparse.Namespace) -> Copy:
    fitting = archive.named(arguments.name)
    if arguments.object:
        fitting = [copy for copy in fitting if copy.name == arguments.object]
    if not fitting:
        which = f"{arguments.object} of {arguments.name}" if arguments.object else f"checkpoint of {arguments.name}"
        raise ArchiveError(f"the archive {place} has no {which}; failover archive list shows those there are")
    return fitting[0]


def _bring(archive: Archive, wanted: tuple[Need, ...], contents: Path) -> tuple[list[str], list[str]]:
    """Fetch the files that this machine lacks, or has in another version, as ``--contents`` of failover restore takes them.

    Nothing is laid down at the paths that a snapshot names: whoever ran the program chose them.

    Returns:
        The paths of those that came, and of those that are not whole in the archive.

    Raises:
        ArchiveError: one of them does not arrive whole, or cannot be written.
    """
    lacking = {need.digest: need for need in wanted if need.digest and not _is_here(need)}
    missing = [need.path for digest, need in lacking.items() if not archive.holds_whole(digest)]
    brought = {digest: need for digest, need in lacking.items() if need.path not in missing}
    if brought:
        with _told_of(contents):
            contents.mkdir(mode=0o755)  # nobody else can have put anything there
            try:
                for digest, need in brought.items():
                    with new_file(path_in(contents, digest), CONTENT_MODE) as file:
                        archive.fetch_content(need, file)
            except BaseException:
                shutil.rmtree(contents, ignore_errors=True)
                raise
    return [need.path for need in brought.values()], missing


def _is_here(need: Need) -> bool:
    if not need.exact:
        return os.path.lexists(need.path)
    with contextlib.suppress(OSError):
        return digest_of_file(need.path) == need.digest
    return False


@contextlib.contextmanager
def new_file(path: Path, mode: int = 0o600) -> Iterator[BinaryIO]:
    """A file that was not there before, and is gone again if the body fails. Raises OSError."""
    with open(os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, mode), "w+b") as file:
        try:
            yield file
            os.fsync(file.fileno())
        except BaseException:
            path.unlink(missing_ok=True)
            raise


@contextlib.contextmanager
def _told_of(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise ArchiveError(f"cannot write {path}: {error.strerror}; free some space, or name another place") from error


def _told(copy: Copy) -> dict[str, object]:
    """One copy as JSON."""
    told = {"component": copy.component, "epoch": copy.epoch, "generation": copy.generation, "sequence": copy.sequence}
    return told | {"size": copy.size, "at": copy.at_s, "object": copy.name}


def _when(at_s: float) -> str:
    return f"{datetime.fromtimestamp(at_s, UTC):%Y-%m-%d %H:%M:%S} UTC"
