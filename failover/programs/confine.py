"""A version's process gives up what its program does not need, before it loads any of it: user, network, files, processes.

As root: a user of its own; namespaces of network, mounts, processes and IPC. As an ordinary user: the same namespaces inside a
user namespace where the kernel allows one, and the host's user. What could not be done is told, never passed over.

Files are read-only but /tmp; /root, /home, /run, /var, /srv, /mnt, /media and /etc/failover are empty but for what Python itself
needs; in /dev are null, zero, full, random, urandom and the devices that the manifest names.

Source: unshare(2), mount(2), mount_setattr(2), user_namespaces(7), pid_namespaces(7), prctl(2), capabilities(7).
"""

from __future__ import annotations

import ctypes
import os
import resource
import signal
import struct
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Final

from failover.errors import ProgramError
from failover.programs.channel import Confinement

_NEWNS: Final = 0x0002_0000
_NEWIPC: Final = 0x0800_0000
_NEWUSER: Final = 0x1000_0000
_NEWPID: Final = 0x2000_0000
_NEWNET: Final = 0x4000_0000

_MS_NOSUID: Final = 2
_MS_NODEV: Final = 4
_MS_BIND: Final = 4096
_MS_REC: Final = 16384
_MS_PRIVATE: Final = 1 << 18

_AT_FDCWD: Final = -100
_AT_RECURSIVE: Final = 0x8000
_MOUNT_ATTR_RDONLY: Final = 1
_MOUNT_ATTR_NOSUID: Final = 2
_MOUNT_SETATTR: Final = 442
_CAPSET: Final = {"x86_64": 126, "aarch64": 91}

_PR_SET_PDEATHSIG: Final = 1
_PR_SET_NO_NEW_PRIVS: Final = 38

DEVICES: Final = ("/dev/null", "/dev/zero", "/dev/full", "/dev/random", "/dev/urandom")
HIDDEN: Final = ("/root", "/home", "/var", "/srv", "/mnt", "/media", "/etc/failover", "/tmp")
"""Empty for a program; /run too, which holds what is bound."""

PROGRAM: Final = "/run/program"
"""Where a confined program finds its own files."""

FILES_MAX: Final = 1_024
"""Open files of one program."""

PROCESSES_MAX: Final = 256
"""Of one program's user: threads count."""

_libc = ctypes.CDLL(None, use_errno=True)


class Confined:
    """What became of it. ``directory``: where the program's files are now."""

    def __init__(self, directory: str) -> None:
        self.directory = directory
        self.enforced: list[str] = []
        self.not_enforced: list[str] = []


def die_with_parent() -> None:
    """End when the process that started this one ends."""
    _prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)


def confine(said: Confinement, directory: str) -> Confined:
    """Give up all that is not permitted. Returns in the process that is to run the program: a child of the caller, which waits.

    Raises:
        ProgramError: root cannot do it; then nothing may run.
    """
    found = Confined(directory)
    if said.is_trusted:
        found.not_enforced.append("it runs from a directory as this user, with all that this user may do")
        return found
    is_root = os.geteuid() == 0
    try:
        _unshare(_NEWNS | _NEWIPC | _NEWPID | (0 if said.network else _NEWNET), is_root)
    except OSError as error:
        if is_root:
            raise ProgramError(f"cannot confine the program: {error.strerror}; run it where root may make namespaces") from error
        what = f"the network, the files and the processes of uid {os.geteuid()}"
        found.not_enforced.append(f"it has {what}: this system gives users no namespaces ({error.strerror})")
    else:
        _fork_and_wait()
        found.enforced.append("network of this robot" if said.network else "no network")
        _mount_all(said, found)
    _limit(said, found)
    _become(said.uid if is_root else 0, said.devices, found)
    return found


def _unshare(flags: int, is_root: bool) -> None:
    uid, gid = os.geteuid(), os.getegid()
    _check(_libc.unshare(flags | (0 if is_root else _NEWUSER)))
    if not is_root:
        Path("/proc/self/setgroups").write_text("deny")
        Path("/proc/self/uid_map").write_text(f"{uid} {uid} 1")
        Path("/proc/self/gid_map").write_text(f"{gid} {gid} 1")


def _fork_and_wait() -> None:
    """Go on in a child, the first process of the new namespace; this one ends as the child does."""
    pid = os.fork()
    if not pid:
        die_with_parent()
        return
    os.closerange(3, FILES_MAX)  # the connection is the child's: its end must be seen
    _, status = os.waitpid(pid, 0)
    os._exit(os.waitstatus_to_exitcode(status) & 0xFF)


def _mount_all(said: Confinement, found: Confined) -> None:
    try:
        _mounts(said, found)
    except OSError as error:
        raise ProgramError(f"cannot confine the program: {error}") from error


def _mounts(said: Confinement, found: Confined) -> None:
    _mount("none", "/", "", _MS_REC | _MS_PRIVATE)
    program = os.open(found.directory, os.O_PATH | os.O_CLOEXEC)
    kept = {path: os.open(path, os.O_PATH | os.O_CLOEXEC) for path in _needed()}
    devices = {path: os.open(path, os.O_PATH | os.O_CLOEXEC) for path in (*DEVICES, *said.devices) if os.path.exists(path)}
    missing = [path for path in said.devices if path not in devices]
    if missing:
        raise ProgramError(f"the program's device {missing[0]} is not here: plug it in, and start the program again")
    _mount("tmpfs", "/run", "tmpfs", _MS_NOSUID, "mode=755,size=16m")
    _bind(program, PROGRAM, is_folder=True)
    for path, descriptor in devices.items():
        _bind(descriptor, f"/run{path}", is_folder=False)
    os.makedirs("/run/dev/shm", exist_ok=True)
    _mount("tmpfs", "/run/dev/shm", "tmpfs", _MS_NOSUID | _MS_NODEV, "mode=1777,size=64m")
    for path in HIDDEN:
        if os.path.isdir(path) and not os.path.islink(path):
            _mount("tmpfs", path, "tmpfs", _MS_NOSUID | _MS_NODEV, f"mode={'1777' if path == '/tmp' else '755'},size=64m")
    for path, descriptor in kept.items():
        if not os.path.exists(path):
            _bind(descriptor, path, is_folder=True)
    _mount("/run/dev", "/dev", "", _MS_BIND | _MS_REC)
    for descriptor in (program, *kept.values(), *devices.values()):
        os.close(descriptor)
    try:
        _mount("proc", "/proc", "proc", _MS_NOSUID | _MS_NODEV)
    except OSError:
        found.not_enforced.append("it sees in /proc which processes run")
    try:
        _set("/", _MOUNT_ATTR_RDONLY | _MOUNT_ATTR_NOSUID, 0)
        for path in ("/tmp", "/dev/shm"):
            _set(path, 0, _MOUNT_ATTR_RDONLY, 0)  # not what is bound below it
        found.enforced.append("files read-only but /tmp")
    except OSError as error:
        found.not_enforced.append(f"it may write where its user may: mount_setattr: {error.strerror}")
    found.enforced.append(f"devices {', '.join(said.devices)} alone" if said.devices else "no devices")
    found.directory = PROGRAM
    os.chdir("/tmp")


def _needed() -> Iterator[str]:
    """The folders from which Python loads, where they are among the hidden ones; those above others first."""
    package = Path(__file__).parents[2]
    folders = {
        os.path.realpath(one) for one in (sys.prefix, sys.base_prefix, str(package), *sys.path) if one and os.path.isdir(one)
    }
    folders |= {one for one in (sys.prefix, sys.base_prefix, *sys.path) if one and os.path.isdir(one)}
    above: list[str] = []
    for folder in sorted(folders):
        if folder.startswith((*(f"{one}/" for one in HIDDEN), "/run/")) and not folder.startswith(
            tuple(f"{one}/" for one in above)
        ):
            above.append(folder)
            yield folder


def _bind(descriptor: int, path: str, *, is_folder: bool) -> None:
    os.makedirs(path if is_folder else os.path.dirname(path), mode=0o755, exist_ok=True)
    if not is_folder:
        os.close(os.open(path, os.O_WRONLY | os.O_CREAT, 0o644))
    _mount(f"/proc/self/fd/{descriptor}", path, "", _MS_BIND | _MS_REC)


def _limit(said: Confinement, found: Confined) -> None:
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    _lower(resource.RLIMIT_NOFILE, FILES_MAX)
    if said.memory_mb:
        _lower(resource.RLIMIT_DATA, said.memory_mb << 20)
        found.enforced.append(f"{said.memory_mb} MB of memory a process")
    found.not_enforced.append("its share of the processor has no limit")


def _lower(what: int, most: int) -> None:
    _, hard = resource.getrlimit(what)
    most = most if hard == resource.RLIM_INFINITY else min(most, hard)
    resource.setrlimit(what, (most, most))


def _become(uid: int, devices: Iterable[str], found: Confined) -> None:
    if uid:
        groups = sorted({os.stat(device).st_gid for device in devices} - {0})
        os.setgroups(groups)
        os.setresgid(uid, uid, uid)
        os.setresuid(uid, uid, uid)
        _lower(resource.RLIMIT_NPROC, PROCESSES_MAX)
        found.enforced.append(f"uid {uid} of its own")
    else:
        found.not_enforced.append(f"it runs as the host's user, uid {os.geteuid()}")
        _drop_capabilities()
    _prctl(_PR_SET_NO_NEW_PRIVS, 1)
    found.enforced.append("no new privileges")
    die_with_parent()  # a change of the user has ended that


def _drop_capabilities() -> None:
    number = _CAPSET.get(os.uname().machine)
    if number is not None:
        header, nothing = struct.pack("II", 0x2008_0522, 0), bytes(24)
        _check(_libc.syscall(ctypes.c_long(number), header, nothing))


def _mount(source: str, target: str, kind: str, flags: int, terms: str = "") -> None:
    words = [one.encode() for one in (source, target, kind, terms)]
    if _libc.mount(words[0], words[1], words[2] or None, ctypes.c_ulong(flags), words[3] or None):
        number = ctypes.get_errno()
        raise OSError(number, f"mount {target}: {os.strerror(number)}")


def _set(path: str, add: int, remove: int, flags: int = _AT_RECURSIVE) -> None:
    """mount_setattr(2), since Linux 5.12."""
    terms = struct.pack("QQQQ", add, remove, 0, 0)
    _check(
        _libc.syscall(
            ctypes.c_long(_MOUNT_SETATTR),
            ctypes.c_int(_AT_FDCWD),
            path.encode(),
            ctypes.c_uint(flags),
            terms,
            ctypes.c_size_t(len(terms)),
        )
    )


def _prctl(what: int, value: int) -> None:
    _check(_libc.prctl(ctypes.c_int(what), ctypes.c_ulong(value), ctypes.c_ulong(0), ctypes.c_ulong(0), ctypes.c_ulong(0)))


def _check(result: int) -> None:
    if result:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
