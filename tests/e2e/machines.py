"""A machine whose PID 1 is a real systemd, in namespaces of its own: it boots in about a second and leaves no trace.

Its root consists of this machine's own /usr (an overlay: nothing of it can be changed), this checkout, the Python that runs the
tests, and an /etc and /var of its own; or of another system, which lies in a folder. It has its own network, PIDs, hostname and
cgroups. Needs root, systemd and overlayfs.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

SYSTEMD: Final = Path("/usr/lib/systemd/systemd")
CHECKOUT: Final = Path(__file__).resolve().parents[2]
PATIENCE_S: Final = 180.0
POLL_S: Final = 0.02

COPIED: Final = (
    "passwd",
    "group",
    "ld.so.cache",
    "ld.so.conf",
    "ld.so.conf.d",
    "nsswitch.conf",
    "alternatives",
    "pam.d",
    "os-release",
)
"""Of /etc: who there is, and where libraries are."""

DEVICES: Final = ("null", "zero", "full", "random", "urandom", "tty", "userfaultfd", "kmsg")

LAY: Final = r"""
set -e
root=$1; shift
mount -t tmpfs -o mode=755 tmpfs "$root"
if [ -n "$BASE" ]; then
    mkdir "$root/up" "$root/work" "$root/all"
    mount -t overlay overlay -o "lowerdir=$BASE,upperdir=$root/up,workdir=$root/work" "$root/all"
    root=$root/all; cd "$root"
else
    cd "$root"
    mkdir -p etc var/lib var/log var/tmp usr proc sys dev run tmp root overlay/up overlay/work
    mount -t overlay overlay -o "lowerdir=/usr,upperdir=$root/overlay/up,workdir=$root/overlay/work" usr
    for name in bin sbin lib lib64; do ln -s "usr/$name" "$name"; done
fi
cp -a "$ETC"/. etc/
mount -t proc proc proc; mount -t sysfs sysfs sys
mount -t cgroup2 cgroup2 sys/fs/cgroup
mount -t tmpfs -o mode=755 tmpfs dev
for name in $DEVICES; do if [ -e "/dev/$name" ]; then touch "dev/$name"; mount --bind "/dev/$name" "dev/$name"; fi; done
mkdir dev/pts dev/shm
mount -t devpts -o newinstance,ptmxmode=0666,mode=620 devpts dev/pts
ln -s pts/ptmx dev/ptmx; ln -s /proc/self/fd dev/fd
mount -t tmpfs tmpfs dev/shm; mount -t tmpfs -o mode=755 tmpfs run; mount -t tmpfs -o mode=1777 tmpfs tmp
for place in "$@"; do mkdir -p ".$place"; mount --rbind "$place" ".$place"; done
mkdir run/old; pivot_root . run/old; umount -l /run/old; rmdir /run/old
hostname "$NAME"; ip link set lo up 2>/dev/null || true
exec env -i container=robot PATH=/usr/sbin:/usr/bin:/sbin:/bin /usr/lib/systemd/systemd systemd.log_target=journal
"""


def why_not() -> str:
    """Why no such machine can be had here; "" if it can."""
    if os.geteuid():
        return "needs root: a machine with systemd as PID 1 mounts its own root"
    if not SYSTEMD.exists():
        return "needs systemd: apt-get install systemd"
    if cgroup_root() is None:
        return "needs cgroup v2"
    if subprocess.run(["unshare", "--mount", "--net", "--pid", "--fork", "true"], capture_output=True, check=False).returncode:
        return "needs the right to make namespaces"
    return ""


def cgroup_root() -> Path | None:
    """Where the second version of cgroups is mounted."""
    for line in Path("/proc/self/mounts").read_text().splitlines():
        _, place, kind, *_ = line.split()
        if kind == "cgroup2":
            return Path(place)
    return None


@dataclass(slots=True)
class Machine:
    """One booted machine.

    Attributes:
        pid: of its systemd, seen from here.
    """

    name: str
    process: subprocess.Popen[bytes]
    pid: int
    cgroup: Path

    @property
    def root(self) -> Path:
        """Its file system, seen from here."""
        return Path(f"/proc/{self.pid}/root")

    def run(self, *command: str, check: bool = True) -> subprocess.CompletedProcess[str]:
        """Run a command there and wait for it."""
        ran = subprocess.run([*self.inside(), *command], capture_output=True, text=True, check=False, stdin=subprocess.DEVNULL)
        if check and ran.returncode:
            raise AssertionError(f"{' '.join(command)}: status {ran.returncode}\n{ran.stdout}{ran.stderr}")
        return ran

    def inside(self) -> list[str]:
        """What to put before a command line that is to run there."""
        enter = ["nsenter", f"--target={self.pid}", "--mount", "--uts", "--ipc", "--net", "--pid", "--cgroup", "--root", "--wd"]
        return [
            *enter,
            "env",
            "-i",
            "PATH=/usr/sbin:/usr/bin:/sbin:/bin",
            "LANG=C.UTF-8",
            "SYSTEMD_PAGER=cat",
            "SYSTEMD_COLORS=0",
        ]

    def property(self, unit: str, name: str) -> str:
        """What ``systemctl show`` says of a unit."""
        return self.run("systemctl", "show", "--value", f"--property={name}", unit).stdout.strip()

    def outer(self, pid: int) -> int:
        """The PID here of a process there."""
        for entry in Path("/proc").iterdir():
            with contextlib.suppress(OSError, StopIteration):
                words = next(line for line in (entry / "status").read_text().splitlines() if line.startswith("NSpid:")).split()
                if entry.name.isdecimal() and len(words) > 2 and int(words[2]) == pid and self._holds(int(entry.name)):
                    return int(entry.name)
        raise AssertionError(f"{self.name} has no process {pid}")

    def _holds(self, pid: int) -> bool:
        """By the one namespace that neither a component nor a service has of its own."""
        return os.readlink(f"/proc/{pid}/ns/ipc") == os.readlink(f"/proc/{self.pid}/ns/ipc")

    def stand_still(self) -> None:
        """Freeze every process at once: nothing of what comes next is seen by any of them."""
        (self.cgroup / "cgroup.freeze").write_text("1")
        deadline = time.monotonic() + PATIENCE_S
        while "frozen 1" not in (self.cgroup / "cgroup.events").read_text():
            assert time.monotonic() < deadline, f"{self.name} does not stand still"
            time.sleep(POLL_S)

    def end(self) -> None:
        """Cut its power."""
        with contextlib.suppress(ProcessLookupError):
            os.kill(self.pid, signal.SIGKILL)
        self.process.wait()
        deadline = time.monotonic() + PATIENCE_S
        for place in sorted(self.cgroup.rglob("*"), reverse=True):
            if place.is_dir():
                _remove(place, deadline)
        _remove(self.cgroup, deadline)


def _remove(cgroup: Path, deadline: float) -> None:
    """A cgroup can be removed once the last of its processes has been reaped."""
    while True:
        try:
            cgroup.rmdir()
            return
        except FileNotFoundError:
            return
        except OSError:
            if time.monotonic() > deadline:
                raise
            time.sleep(POLL_S)


@contextmanager
def booted(directory: Path, name: str, base: Path | None = None) -> Iterator[Machine]:
    """A machine that has finished booting; it is gone afterwards.

    Args:
        directory: for its root and its boot log.
        base: its whole system, with systemd in it, of which nothing is changed; None: this machine's /usr.
    """
    machine = _boot(directory, name, base)
    try:
        _wait_until_up(machine, directory / f"{name}.log")
        yield machine
    finally:
        machine.end()


def _boot(directory: Path, name: str, system: Path | None) -> Machine:
    etc, root = directory / f"{name}.etc", directory / f"{name}.root"
    root.mkdir()
    _write_etc(etc, name, COPIED if system is None else ())
    base = cgroup_root()
    assert base is not None
    cgroup = base / f"failover-test-{os.getpid()}-{name}"
    cgroup.mkdir()
    places = sorted({str(CHECKOUT), sys.prefix, sys.base_prefix} - {"/usr"}) if system is None else []
    script = f'echo 0 >{cgroup}/cgroup.procs; exec unshare --cgroup bash -c "$LAY" lay "$@"'
    command = ["unshare", "--mount", "--uts", "--ipc", "--net", "--pid", "--fork", "--kill-child", "--propagation", "private"]
    settings = {"BASE": str(system or ""), "ETC": str(etc), "NAME": name, "DEVICES": " ".join(DEVICES)}
    environment = {**os.environ, "LAY": LAY, **settings}
    with (directory / f"{name}.log").open("wb") as log:
        process = subprocess.Popen(
            [*command, "bash", "-c", script, "boot", str(root), *places],
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            start_new_session=True,
        )
    return Machine(name, process, _first_child(process, directory / f"{name}.log"), cgroup)


def _write_etc(etc: Path, name: str, copied: tuple[str, ...]) -> None:
    etc.mkdir()
    for one in copied:
        source = Path("/etc") / one
        if source.is_dir():
            shutil.copytree(source, etc / one, symlinks=True)
        elif source.exists():
            shutil.copy(source, etc / one)
    (etc / "hostname").write_text(f"{name}\n")
    (etc / "machine-id").write_text(os.urandom(16).hex() + "\n")
    (etc / "systemd" / "system").mkdir(parents=True)


def _first_child(process: subprocess.Popen[bytes], log: Path) -> int:
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        with contextlib.suppress(OSError):
            children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
            if children and Path(f"/proc/{children[0]}/comm").read_text() == "systemd\n":
                return int(children[0])
        if process.poll() is not None:
            break
        time.sleep(POLL_S)
    process.kill()
    process.wait()
    raise AssertionError(f"no systemd came up: {log.read_text(errors='replace')}")


def _wait_until_up(machine: Machine, log: Path) -> None:
    deadline = time.monotonic() + PATIENCE_S
    state = ""
    while time.monotonic() < deadline:
        state = machine.run("systemctl", "is-system-running", check=False).stdout.strip()
        if state in ("running", "degraded"):
            return
        time.sleep(POLL_S)
    raise AssertionError(f"{machine.name} did not boot, it is {state!r}: {log.read_text(errors='replace')}")
