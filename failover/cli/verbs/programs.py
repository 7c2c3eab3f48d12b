"""program key, pack, sign, verify, send, receive, run, list, switch, rollback, log: programs that are sent to running robots."""

from __future__ import annotations

import argparse
import sys
import time
from datetime import UTC, date, datetime
from pathlib import Path
from typing import Any, Final

import msgspec
from msgspec import Struct

from checkpoint.store.whole_file import write_whole
from failover.cli.output import render
from failover.core.naming.tree import Place as NamedPlace
from failover.core.programs import bundle, states
from failover.core.programs.states import Shelf, Standing
from failover.drivers.here import here, lives
from failover.drivers.lookup import lookup
from failover.drivers.proxy import Proxy
from failover.errors import CallRefusedError, DriverError, NameUnknownError, NoAnswerError, ProgramError
from failover.programs import keys, packing
from failover.programs.admission import admit
from failover.programs.store import Store, default_place

POLL_S: Final = 0.05
SWITCH_MAX_S: Final = 120.0
"""A version may import for a minute; on a busy machine it takes turns."""


def key(arguments: argparse.Namespace) -> int:
    """Make a key pair; print the public half and the lines for programs.toml."""
    path = Path(arguments.file)
    public = keys.new_pair(path)
    if arguments.json:
        render.as_json({"file": str(path), "public": public})
    else:
        print(f'[[keys]]\nowner = "{arguments.owner}"\npublic = "{public}"', flush=True)
        print(
            f"{path} is the secret key and stays with you; the lines above go into programs.toml of the team directory",
            file=sys.stderr,
        )
    return 0


def pack(arguments: argparse.Namespace) -> int:
    """A directory becomes a bundle, signed if a key is named."""
    content = packing.pack(Path(arguments.source))
    if arguments.key:
        content = packing.sign(content, keys.read_secret(Path(arguments.key)), _until(arguments.until))
    return _written(arguments, Path(arguments.output), content)


def sign(arguments: argparse.Namespace) -> int:
    """Sign a bundle, in place of the signature that it may have."""
    path = Path(arguments.file)
    content = packing.sign(packing.read_file(path), keys.read_secret(Path(arguments.key)), _until(arguments.until))
    return _written(arguments, path, content)


def _until(day: str | None) -> int:
    """The end of a day; 0: none was named."""
    if day is None:
        return 0
    try:
        found = date.fromisoformat(day)
    except ValueError as error:
        raise ProgramError(f"{day!r} is no day; write 2027-12-31") from error
    return int(datetime(found.year, found.month, found.day, 23, 59, 59, tzinfo=UTC).timestamp())


def _written(arguments: argparse.Namespace, path: Path, content: bytes) -> int:
    program = bundle.read(bundle.split(content)[1])
    try:
        write_whole(path, content, mode=0o666, lasts="process")
    except OSError as error:
        raise ProgramError(f"cannot write {path}: {error.strerror}") from error
    said = program.manifest
    told = {"file": str(path), "name": said.name, "version": said.version, "digest": program.digest, "bytes": len(content)}
    sentence = f"{path}: {said.name} {said.version}, {len(program.files)} files, {len(content)} bytes, {program.digest[:12]}"
    return _told(arguments, told, sentence)


def verify(arguments: argparse.Namespace) -> int:
    """Would this robot take a bundle; nothing is changed."""
    found = admit(packing.read_file(Path(arguments.file)), Path(arguments.directory))
    said = found.program.manifest
    told = {"name": said.name, "version": said.version, "path": said.path, "digest": found.program.digest, "owner": found.owner}
    return _told(
        arguments, told | {"because": found.because}, f"{said.name} {said.version} is signed by {found.owner}; {found.because}"
    )


def send(arguments: argparse.Namespace) -> int:
    """Check a bundle and keep it here, ready to be switched to."""
    if arguments.to:
        return _sent_to(arguments)
    store = _store(arguments).open()
    found = store.take(packing.read_file(Path(arguments.file)), Path(arguments.directory))
    said = found.program.manifest
    told = {"name": said.name, "version": said.version, "digest": found.program.digest, "owner": found.owner}
    is_running = lives(here(), said.path)
    then = f"failover program switch {said.name} {said.version}" if is_running else f"failover program run {said.name}"
    return _told(arguments, told, f"{said.name} {said.version} is staged, signed by {found.owner}; {then}")


def _sent_to(arguments: argparse.Namespace) -> int:
    from failover.programs import receiver

    content = packing.read_file(Path(arguments.file))
    bundle.split(content)
    try:
        proxy = _host(receiver.path_of(arguments.to))
    except NameUnknownError as error:
        raise NameUnknownError(f"{arguments.to} takes no bundles: {error}; run there: failover program receive") from error
    with proxy:
        told = receiver.send(proxy, content)
    sentence = f"{told.name} {told.version} is staged on {arguments.to}, signed by {told.owner}"
    return _told(arguments, msgspec.to_builtins(told), sentence)


def receive(arguments: argparse.Namespace) -> int:
    """Take bundles from other robots, until SIGTERM or Ctrl-C."""
    from failover.drivers import server
    from failover.programs.receiver import receiver

    server.run(receiver(_store(arguments).open(), Path(arguments.directory), here().robot))
    return 0


def run(arguments: argparse.Namespace) -> int:
    """Hold a program's name and mailbox, and run its active version, until SIGTERM or Ctrl-C."""
    from failover.drivers import server
    from failover.programs.hosting import Hosting
    from failover.programs.sources import Place, source_of_directory

    store, given = _store(arguments), Path(arguments.program)
    directory = given if "/" in arguments.program or (given / packing.PROGRAM_FILE).exists() else None
    name = source_of_directory(directory).manifest.name if directory is not None else arguments.program
    place = Place(store, Path(arguments.directory), name, directory, arguments.beside)
    with server.stopped_by_signals(lambda: Hosting(place, arguments.version or "")) as hosting, hosting:
        for line in (*hosting.addresses_told(), *hosting.confinement_told()):
            print(line, file=sys.stderr, flush=True)
        hosting.serve()
    return 0


def show(arguments: argparse.Namespace) -> int:
    """The programs of this robot, their versions and states."""
    store = _store(arguments)
    found = [_with_host(shelf) for shelf in store.shelves()]
    if arguments.json:
        render.as_json({"programs": found})
        return 0
    for one in found:
        print(f"{one['name']}  {one['path']}")
        for version in one["versions"]:
            trial = ", on trial" if version["state"] == states.State.ACTIVE and not version["is_committed"] else ""
            print(f"  {version['version']:10} {version['state']}{trial}  {version['digest'][:12]}  {version['why']}")
        host = one["host"]
        print(
            f"  {render.spoken(one['trouble'] or 'no host runs it')}"
            if host is None
            else f"  pid {host['pid']}{one['elsewhere']}; {_enforcement(host)}"
        )
    if not found:
        print(f"no program is in {store.place}; failover program send brings one")
    return 0


def _enforcement(host: dict[str, Any]) -> str:
    return f"enforced: {', '.join(host['enforced']) or 'nothing'}; not enforced: {', '.join(host['not_enforced']) or 'nothing'}"


def _with_host(shelf: Shelf) -> dict[str, Any]:
    """A shelf with what its host tells.

    ``trouble``: why nothing is known of a host that may be there; ``elsewhere``: " on ROBOT" of one on another robot.
    """
    told: dict[str, Any] = msgspec.to_builtins(shelf) | {"elsewhere": ""}
    try:
        with _host(shelf.path) as proxy:
            standing = msgspec.to_builtins(proxy.told("_versions", Standing, timeout=1.0))
            robot = proxy.place.robot
            return told | {"host": standing, "trouble": "", "elsewhere": f" on {robot}" if robot != proxy.here.robot else ""}
    except (NameUnknownError, NoAnswerError):
        return told | {"host": None, "trouble": ""}
    except (CallRefusedError, DriverError) as error:
        return told | {"host": None, "trouble": f"{shelf.path} is no host of failover's: {error}"}


def switch(arguments: argparse.Namespace) -> int:
    """Have another version take over, and wait until its trial is over."""
    given = Path(arguments.version)
    is_directory = "/" in arguments.version or (given / packing.PROGRAM_FILE).exists()
    order = {"directory": str(given.resolve())} if is_directory else {"version": arguments.version}
    with _host(_path(arguments)) as proxy:
        version = proxy.told("_switch", _Ordered, order).version
        end = time.monotonic() + SWITCH_MAX_S
        while (found := _asked(proxy)).is_coming or found.active != version or (arguments.wait and found.on_trial):
            if not found.is_coming and found.active != version and found.said:
                raise ProgramError(found.said)
            if time.monotonic() > end and not found.on_trial:
                raise NoAnswerError(f"{version} has not become active within {SWITCH_MAX_S:g} s; failover program log tells why")
            time.sleep(POLL_S)
    return _told(arguments, msgspec.to_builtins(found), found.said)


class _Ordered(Struct, frozen=True):
    """The answer to ``_switch``: the version that is being started."""

    version: str


def _asked(proxy: Proxy) -> Standing:
    return proxy.told("_versions", Standing, timeout=SWITCH_MAX_S)


def rollback(arguments: argparse.Namespace) -> int:
    """Back to the version before."""
    with _host(_path(arguments)) as proxy:
        proxy.call("_rollback", {"old_state": arguments.old_state})
        found = _asked(proxy)
    return _told(arguments, msgspec.to_builtins(found), found.said)


def lines(arguments: argparse.Namespace) -> int:
    """What was done with a program, and why."""
    found = _store(arguments).lines(arguments.name)
    if arguments.json:
        render.as_json({"log": found})
    for line in found if not arguments.json else ():
        at = datetime.fromtimestamp(float(str(line["at"]))).isoformat(" ", "milliseconds")
        print(f"{at}  {render.spoken(str(line['what']))}")
    return 0


def _path(arguments: argparse.Namespace) -> str:
    """A program's path: what is on this robot's shelf, else NAME itself, a path or an alias."""
    store = _store(arguments)
    if "/" not in arguments.name and store.place.is_dir():
        try:
            return store.shelf(arguments.name).path
        except ProgramError:
            pass
    return str(arguments.name)


def _host(name: str) -> Proxy:
    place = here()
    found: NamedPlace = lookup(place, name)
    return Proxy(place, found)


def _store(arguments: argparse.Namespace) -> Store:
    return Store(Path(arguments.store) if arguments.store else default_place())


def _told(arguments: argparse.Namespace, answer: dict[str, Any], sentence: str) -> int:
    if arguments.json:
        render.as_json(answer)
    else:
        print(render.spoken(sentence), flush=True)
    return 0
