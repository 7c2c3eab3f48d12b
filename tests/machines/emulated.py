"""A machine with another processor, under software emulation: made once, booted for tests, spoken to over loopback.

Debian for that processor with a newer kernel (backports), as files in one directory; nothing outside of it is changed. It takes
root, and the packages in `PACKAGES`. An emulated machine is some twenty times slower than a real one: what must be in time on
a robot is not measured here.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import lzma
import os
import shutil
import subprocess
import tarfile
import time
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).parents[2]
COMMANDS: Final = (
    *("mmdebstrap", "qemu-system-aarch64", "qemu-aarch64-static", "aarch64-linux-gnu-gcc", "update-binfmts", "mke2fs"),
    *("ssh", "ssh-keygen", "dpkg-deb", "cpio"),
)
PACKAGES: Final = (
    "mmdebstrap qemu-user-static binfmt-support arch-test qemu-system-arm gcc-aarch64-linux-gnu libc6-dev-arm64-cross "
    "e2fsprogs openssh-client cpio"
)
INCLUDED: Final = "systemd,systemd-sysv,dbus,udev,python3,procps,iproute2,kmod,openssh-server,gcc,libc6-dev,bc"
MODULES: Final = (
    *("drivers/block/virtio_blk", "crypto/crc32c_generic", "lib/crc16", "fs/mbcache", "fs/jbd2/jbd2", "fs/ext4/ext4"),
    *("net/core/failover", "drivers/net/net_failover", "drivers/net/virtio_net"),
)
"""Of the kernel, what it takes to reach disk and network, each after those that it needs."""
FOR_TESTS: Final = ("pytest", "pytest-timeout", "hypothesis")
WHEELS: Final = ("manylinux2014", "manylinux_2_17", "manylinux_2_26", "manylinux_2_27", "manylinux_2_28")
DISK_SIZE: Final = "3G"
MEMORY_MB: Final = 1536
BOOT_S: Final = 600.0
SENT: Final = ("checkpoint", "failover", "agent", "tests", "pyproject.toml", "include", "examples", "docs", "README.md")


def lacking() -> str:
    """Why such a machine cannot be made or run here; "": it can."""
    missing = [command for command in COMMANDS if shutil.which(command) is None]
    if missing:
        return f"needs {', '.join(missing)}: apt-get install {PACKAGES}"
    return "" if os.geteuid() == 0 else "needs root, to make its disk"


@dataclass
class Machine:
    """An aarch64 machine.

    Attributes:
        directory: that holds all of it.
        port: of loopback, by which its ssh is reached.
        processor: that QEMU plays; ``max,pauth-impdef=on`` has SVE and pointer authentication.
    """

    directory: Path
    port: int
    processor: str = "cortex-a72"

    # Making

    def make(self) -> None:
        """Make it, unless it has been made by this very recipe before."""
        recipe, made = self._recipe(), self.directory / "recipe"
        if made.exists() and made.read_text() == recipe:
            return
        shutil.rmtree(self.directory, ignore_errors=True)
        self.directory.mkdir(parents=True)
        _run("update-binfmts", "--enable", "qemu-aarch64")
        _run("ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", self.directory / "key")
        self._lay_system()
        self._take_kernel()
        self._lay_settings()
        self._lay_packages()
        _run("mke2fs", "-q", "-t", "ext4", "-d", self._system, self.directory / "disk", DISK_SIZE)
        shutil.rmtree(self._system)
        made.write_text(recipe)

    @property
    def _system(self) -> Path:
        return self.directory / "system"

    def _recipe(self) -> str:
        files = (Path(__file__), Path(__file__).with_name("first.c"), ROOT / "pyproject.toml")
        return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()

    def _lay_system(self) -> None:
        """Debian, and in /kernel the newest one of backports, unpacked: its scripts would take ten minutes under emulation."""
        sources = Path("/etc/apt/sources.list.d/debian.sources").read_text()
        listed = self.directory / "debian.sources"
        listed.write_text(sources.replace("bookworm-updates", "bookworm-updates bookworm-backports"))
        newest = "apt-cache depends -t bookworm-backports linux-image-arm64 | awk '/Depends:/ { print $2; exit }'"
        fetch = f"cd /tmp && apt-get update -qq && apt-get download -qq -t bookworm-backports $({newest})"
        unpack = 'for one in "$1"/tmp/linux-image-*.deb; do dpkg-deb -x "$one" "$1/kernel"; rm "$one"; done'
        self._system.mkdir()
        _run(
            *("mmdebstrap", "--quiet", "--architectures=arm64", "--variant=minbase", f"--include={INCLUDED}"),
            *(f"--customize-hook=chroot \"$1\" sh -c '{_quoted(fetch)}'", f"--customize-hook={unpack}"),
            *("bookworm", self.directory / "system.tar", listed),
        )
        _run("tar", "-C", self._system, "-xpf", self.directory / "system.tar")
        (self.directory / "system.tar").unlink()

    def _take_kernel(self) -> None:
        """The kernel, and what it begins with: our first program, and the modules in order."""
        unpacked, beginning = self._system / "kernel", self.directory / "beginning"
        shutil.copy(next((unpacked / "boot").glob("vmlinuz-*")), self.directory / "kernel")
        beginning.mkdir()
        first = Path(__file__).with_name("first.c")
        _run("aarch64-linux-gnu-gcc", "-O1", "-static", "-o", beginning / "init", first)
        modules = next((unpacked / "lib/modules").iterdir()) / "kernel"
        for number, name in enumerate(MODULES):
            (beginning / f"{number}.ko").write_bytes(lzma.decompress((modules / f"{name}.ko.xz").read_bytes()))
        _run("sh", "-c", "find . | cpio -o -H newc --quiet > ../initrd", cwd=beginning)
        shutil.rmtree(unpacked)

    def _lay_settings(self) -> None:
        key = self._system / "root/.ssh/authorized_keys"
        key.parent.mkdir(mode=0o700, exist_ok=True)
        shutil.copy(self.directory / "key.pub", key)
        (self._system / "etc/hostname").write_text("robot-aarch64\n")
        (self._system / "etc/fstab").write_text("/dev/vda / ext4 defaults 0 1\n")
        (self._system / "etc/systemd/network/10.network").write_text("[Match]\nName=e*\n[Network]\nDHCP=yes\n")
        _run("systemctl", f"--root={self._system}", "-q", "enable", "systemd-networkd")
        unwanted = ("systemd-networkd-wait-online.service", "apt-daily.timer", "apt-daily-upgrade.timer")
        _run("systemctl", f"--root={self._system}", "-q", "mask", *unwanted)

    def _lay_packages(self) -> None:
        """What we depend on, built for that processor, in /opt/site."""
        dependencies = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
        platforms = [word for kind in WHEELS for word in ("--platform", f"{kind}_aarch64")]
        tags = ("--implementation", "cp", "--python-version", "3.11", "--abi", "cp311", "--abi", "abi3", "--abi", "none")
        into = ("--target", self._system / "opt/site", "--only-binary=:all:")
        _run("python3", "-m", "pip", "install", "-q", *into, *tags, *platforms, *dependencies, *FOR_TESTS)

    # Running

    @contextlib.contextmanager
    def booted(self) -> Iterator[Machine]:
        """Let it run for the body, with our sources in /root/failover.

        Raises:
            TimeoutError: it does not answer; its console says why.
        """
        console = (self.directory / "console").open("wb")
        # -snapshot: what it writes is gone afterwards
        command = (
            *("qemu-system-aarch64", "-M", "virt", "-cpu", self.processor, "-accel", "tcg,thread=multi", "-smp", "2"),
            *("-m", str(MEMORY_MB), "-nographic", "-no-reboot", "-kernel", "kernel", "-initrd", "initrd", "-snapshot"),
            *("-append", "console=ttyAMA0 quiet loglevel=4 mitigations=off panic=-1"),
            *("-drive", "file=disk,format=raw,if=none,id=disk,cache=unsafe", "-device", "virtio-blk-pci,drive=disk"),
            *("-netdev", f"user,id=net,restrict=on,hostfwd=tcp:127.0.0.1:{self.port}-:22"),
            *("-device", "virtio-net-pci,netdev=net,romfile="),
        )
        with (
            console,
            subprocess.Popen(command, cwd=self.directory, stdin=subprocess.DEVNULL, stdout=console, stderr=console) as emulator,
        ):
            try:
                self._await(emulator)
                self.send()
                yield self
            finally:
                emulator.kill()

    def _await(self, emulator: subprocess.Popen[bytes]) -> None:
        deadline = time.monotonic() + BOOT_S
        while self.run("true", timeout_s=20).returncode:
            if emulator.poll() is not None or time.monotonic() > deadline:
                raise TimeoutError(f"it does not answer, see {self.directory / 'console'}")
            time.sleep(1)

    def send(self) -> None:
        """Lay our sources in /root/failover."""
        packed = io.BytesIO()
        with tarfile.open(fileobj=packed, mode="w:gz", compresslevel=1) as archive:
            for name in SENT:
                archive.add(ROOT / name, name, filter=lambda one: None if "__pycache__" in one.name else one)
        done = self.run("mkdir -p /root/failover && tar -C /root/failover -xz --no-same-owner", content=packed.getvalue())
        assert done.returncode == 0, done.stdout.decode(errors="replace")

    def run(self, command: str, *, content: bytes = b"", timeout_s: float = 600) -> subprocess.CompletedProcess[bytes]:
        """Run a shell command in it.

        Returns:
            Its exit status (255: it does not answer), and all that it wrote as ``stdout``.
        """
        options = [f"-o{one}" for one in ("StrictHostKeyChecking=no", "UserKnownHostsFile=/dev/null", "ConnectTimeout=10")]
        words = ("ssh", "-q", "-i", str(self.directory / "key"), "-p", str(self.port), *options, "root@127.0.0.1", command)
        try:
            return subprocess.run(
                words, input=content, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, check=False, timeout=timeout_s
            )
        except subprocess.TimeoutExpired as error:
            return subprocess.CompletedProcess(words, 255, error.stdout or b"")


def _run(*words: str | Path, cwd: Path | None = None) -> None:
    subprocess.run([str(word) for word in words], check=True, cwd=cwd, stdin=subprocess.DEVNULL)


def _quoted(command: str) -> str:
    """Inside of single quotes."""
    return command.replace("'", "'\\''")
