"""A machine with another processor or kernel, under software emulation: made once, booted for tests, spoken to over loopback.

python -m tests.machines.emulated KIND                says which packages it takes to make and emulate that one
python -m tests.machines.emulated KIND DIRECTORY      makes it there, for FAILOVER_TEST_MACHINES_DIRECTORY

Debian for that processor with a kernel of its own choice, as files in one directory; nothing outside of it is changed. It takes
root, and the packages of its kind. An emulated machine is some twenty times slower than a real one: deadlines of a robot are not
measured here.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import lzma
import os
import shutil
import subprocess
import sys
import tarfile
import time
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).parents[2]
COMMANDS: Final = ("mmdebstrap", "mke2fs", "ssh", "ssh-keygen", "dpkg-deb", "cpio", "depmod")
PACKAGES: Final = "mmdebstrap e2fsprogs openssh-client cpio kmod"
INCLUDED: Final = "systemd,systemd-sysv,dbus,udev,python3,procps,iproute2,kmod,openssh-server,gcc,libc6-dev,bc,sqlite3,xz-utils"
MODULES: Final = ("virtio_pci", "virtio_blk", "crc32c_generic", "ext4", "virtio_net")
"""Of the kernel, what it takes to reach disk and network, and what these need; some are part of it."""
FOR_TESTS: Final = ("pytest", "pytest-timeout", "hypothesis")
WHEELS: Final = ("manylinux2014", "manylinux_2_17", "manylinux_2_26", "manylinux_2_27", "manylinux_2_28")
DISK_SIZE: Final = "3G"
MEMORY_MB: Final = 1536
BOOT_S: Final = 600.0
SENT: Final = ("checkpoint", "failover", "agent", "tests", "pyproject.toml", "include", "examples", "docs", "README.md")


@dataclass(frozen=True, slots=True)
class Kind:
    """What is emulated.

    Attributes:
        processor: as uname(2) calls it; ``architecture``: as Debian does.
        system: release of Debian; ``suite``: where its kernel comes from, ``kernel``: the package.
        emulator: its command, as far as it says what machine it is; ``console``: the kernel's name of the serial line.
        compiler: of a static program for it.
        commands, packages: what else it takes.
        given: packages that hold another kernel, as files; with them ``suite`` is only its name.
        variant: of its processor, for the name.
    """

    processor: str
    architecture: str
    system: str
    suite: str
    kernel: str
    emulator: tuple[str, ...]
    console: str
    compiler: str
    commands: tuple[str, ...]
    packages: str
    given: tuple[Path, ...] = ()
    variant: str = ""

    @property
    def name(self) -> str:
        """For files and tests."""
        return f"{self.processor}-{self.suite}{'-16k' * self.kernel.endswith('-16k')}{self.variant and f'-{self.variant}'}"

    @property
    def python(self) -> str:
        """The version of its Python."""
        return {"bookworm": "3.11", "trixie": "3.13"}[self.system]

    def unwanted(self) -> str:
        """Why it is not asked for; "": it is."""
        wanted = os.environ.get("FAILOVER_TEST_MACHINES", "")
        if wanted == "all" or self.name in wanted.split(","):
            return ""
        return f"FAILOVER_TEST_MACHINES={self.name} has this machine emulated, =all has all of them"

    def place(self, otherwise: Path) -> Path:
        """Where it is made, and kept if it is to be kept."""
        return Path(os.environ.get("FAILOVER_TEST_MACHINES_DIRECTORY") or otherwise) / self.name

    def lacking(self) -> str:
        """Why such a machine cannot be made or run here; "": it can."""
        needed = (*COMMANDS, *self.commands, self.emulator[0], self.compiler)
        if missing := [command for command in needed if shutil.which(command) is None]:
            return f"needs {', '.join(missing)}: apt-get install {PACKAGES} {self.packages}"
        return "" if os.geteuid() == 0 else "needs root, to make its disk"


_ARM: Final = Kind(
    processor="aarch64",
    architecture="arm64",
    system="bookworm",
    suite="bookworm-backports",
    kernel="linux-image-arm64",
    emulator=("qemu-system-aarch64", "-M", "virt", "-cpu", "cortex-a72"),
    console="ttyAMA0",
    compiler="aarch64-linux-gnu-gcc",
    commands=("qemu-aarch64-static", "update-binfmts"),
    packages="qemu-user-static binfmt-support arch-test qemu-system-arm gcc-aarch64-linux-gnu libc6-dev-arm64-cross",
)
_OF_DEBIAN: Final = (
    _ARM,  # follows written pages by write protection
    replace(_ARM, suite="bookworm"),  # 6.1: by digests
    replace(  # pages of 16 KiB, and a processor that has them, a Raspberry Pi 5's
        _ARM,
        system="trixie",
        suite="trixie",
        kernel="linux-image-arm64-16k",
        emulator=("qemu-system-aarch64", "-M", "virt", "-cpu", "cortex-a76"),
    ),
    replace(  # a processor with scalable vectors, as a Jetson Thor's has; these are longer: up to 512 bits
        _ARM,
        emulator=("qemu-system-aarch64", "-M", "virt", "-cpu", "max,sve-max-vq=4,sme=off,pauth-impdef=on"),
        variant="sve",
    ),
    Kind(  # 6.1: by the soft-dirty bit
        processor="x86_64",
        architecture="amd64",
        system="bookworm",
        suite="bookworm",
        kernel="linux-image-amd64",
        emulator=("qemu-system-x86_64", "-M", "q35", "-cpu", "max"),
        console="ttyS0",
        compiler="gcc",
        commands=(),
        packages="qemu-system-x86 gcc libc6-dev",
    ),
)


def _with_given_kernel(files: str) -> Iterator[Kind]:
    """A machine with a kernel of somebody else's, a vendor's for one: "" is none.

    Args:
        files: Debian packages that hold it and its modules, with commas between them; the first one has its name.
    """
    given = tuple(Path(file).absolute() for file in files.split(",") if file)
    for first in given[:1]:
        told = subprocess.run(["dpkg-deb", "-f", first, "Package", "Architecture"], capture_output=True, text=True, check=True)
        about = dict(line.split(": ") for line in told.stdout.splitlines())
        alike = next(kind for kind in _OF_DEBIAN if kind.architecture == about["Architecture"])
        yield replace(alike, system="bookworm", suite=about["Package"].removeprefix("linux-image-"), kernel="", given=given)


KINDS: Final = (*_OF_DEBIAN, *_with_given_kernel(os.environ.get("FAILOVER_TEST_KERNEL", "")))


@dataclass
class Machine:
    """One emulated machine.

    Attributes:
        directory: that holds all of it.
        port: of loopback, by which its ssh is reached.
        emulator: while it is `booted`.
    """

    kind: Kind
    directory: Path
    port: int
    emulator: subprocess.Popen[bytes] | None = None

    # Making

    def make(self) -> None:
        """Make it, unless it has been made by this very recipe before."""
        recipe, made = self._recipe(), self.directory / "recipe"
        if made.exists() and made.read_text() == recipe:
            return
        shutil.rmtree(self.directory, ignore_errors=True)
        self.directory.mkdir(parents=True)
        if "update-binfmts" in self.kind.commands:
            _run("update-binfmts", "--enable", f"qemu-{self.kind.processor}")
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

    @property
    def _console(self) -> Path:
        return self.directory / f"console-{self.port}"

    def _recipe(self) -> str:
        files = (Path(__file__), Path(__file__).with_name("first.c"), ROOT / "pyproject.toml")
        return hashlib.sha256(repr(self.kind).encode() + b"".join(file.read_bytes() for file in files)).hexdigest()

    def _lay_system(self) -> None:
        """Debian 12, and in /kernel the one that is wanted, unpacked: its scripts would take ten minutes under emulation."""
        sources = Path("/etc/apt/sources.list.d/debian.sources").read_text().replace("bookworm", self.kind.system)
        listed, suite = self.directory / "debian.sources", self.kind.suite
        if suite != self.kind.system and not self.kind.given:
            sources = sources.replace(f"{self.kind.system}-updates", f"{self.kind.system}-updates {suite}")
        listed.write_text(sources)
        newest = f"apt-cache depends -t {suite} {self.kind.kernel} | awk '/Depends:/ {{ print $2; exit }}'"
        fetch = f"cd /tmp && apt-get update -qq && apt-get download -qq -t {suite} $({newest})"
        unpack = 'for one in "$1"/tmp/linux-image-*.deb; do dpkg-deb -x "$one" "$1/kernel"; rm "$one"; done'
        hooks = (f"--customize-hook=chroot \"$1\" sh -c '{_quoted(fetch)}'", f"--customize-hook={unpack}")
        self._system.mkdir()
        _run(
            *("mmdebstrap", "--quiet", f"--architectures={self.kind.architecture}", "--variant=minbase", f"--include={INCLUDED}"),
            *(() if self.kind.given else hooks),
            *(self.kind.system, self.directory / "system.tar", listed),
        )
        _run("tar", "-C", self._system, "-xpf", self.directory / "system.tar")
        for package in self.kind.given:
            _run("dpkg-deb", "-x", package, self._system / "kernel")
        (self.directory / "system.tar").unlink()

    def _take_kernel(self) -> None:
        """The kernel, and what it begins with: our first program, and the modules in order. All others lie where it looks."""
        unpacked, beginning = self._system / "kernel", self.directory / "beginning"
        shutil.copy(next((unpacked / "boot").glob("vmlinuz-*")), self.directory / "kernel")
        beginning.mkdir()
        first = Path(__file__).with_name("first.c")
        _run(self.kind.compiler, "-O1", "-static", "-o", beginning / "init", first)
        modules = next(path for path in (unpacked / "lib/modules", unpacked / "usr/lib/modules") if path.exists())
        release = next(modules.iterdir()).name
        _run("depmod", "-b", modules.parents[1], release)
        for number, path in enumerate(_in_order(modules / release)):
            content = path.read_bytes()
            (beginning / f"{number}.ko").write_bytes(lzma.decompress(content) if path.suffix == ".xz" else content)
        _run("sh", "-c", "find . | cpio -o -H newc --quiet > ../initrd", cwd=beginning)
        shutil.move(modules, self._system / "usr/lib/modules")
        shutil.rmtree(unpacked)

    def _lay_settings(self) -> None:
        key = self._system / "root/.ssh/authorized_keys"
        key.parent.mkdir(mode=0o700, exist_ok=True)
        shutil.copy(self.directory / "key.pub", key)
        (self._system / "etc/hostname").write_text(f"robot-{self.kind.processor}\n")
        (self._system / "etc/fstab").write_text("/dev/vda / ext4 defaults 0 1\n")
        (self._system / "etc/systemd/network/10.network").write_text("[Match]\nName=e*\n[Network]\nDHCP=yes\n")
        _run("systemctl", f"--root={self._system}", "-q", "enable", "systemd-networkd")
        unwanted = ("systemd-networkd-wait-online.service", "apt-daily.timer", "apt-daily-upgrade.timer")
        _run("systemctl", f"--root={self._system}", "-q", "mask", *unwanted)

    def _lay_packages(self) -> None:
        """What we depend on, built for that processor, in /opt/site."""
        python = self.kind.python
        dependencies = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
        platforms = [word for kind in WHEELS for word in ("--platform", f"{kind}_{self.kind.processor}")]
        tags = (
            "--implementation",
            "cp",
            "--python-version",
            python,
            "--abi",
            f"cp{python.replace('.', '')}",
            "--abi",
            "abi3",
            "--abi",
            "none",
        )
        into = ("--target", self._system / "opt/site", "--only-binary=:all:")
        _run("python3", "-m", "pip", "install", "-q", *into, *tags, *platforms, *dependencies, *FOR_TESTS)

    # Running

    @contextlib.contextmanager
    def booted(self, *wire: str) -> Iterator[Machine]:
        """Let it run for the body, with our sources in /root/failover.

        Args:
            wire: a second network interface of it, as options of the emulator.

        Raises:
            TimeoutError: it does not answer; its console says why.
        """
        console = self._console.open("wb")
        # -snapshot: what it writes is gone afterwards
        command = (
            *(*self.kind.emulator, "-accel", "tcg,thread=multi", "-smp", "2"),
            *("-m", str(MEMORY_MB), "-nographic", "-no-reboot", "-kernel", "kernel", "-initrd", "initrd", "-snapshot"),
            *("-append", f"console={self.kind.console} quiet loglevel=4 mitigations=off panic=-1"),
            *("-drive", "file=disk,format=raw,if=none,id=disk,cache=unsafe", "-device", "virtio-blk-pci,drive=disk"),
            *("-netdev", f"user,id=net,restrict=on,hostfwd=tcp:127.0.0.1:{self.port}-:22"),
            *("-device", "virtio-net-pci,netdev=net,romfile="),
            *wire,
        )
        with (
            console,
            subprocess.Popen(command, cwd=self.directory, stdin=subprocess.DEVNULL, stdout=console, stderr=console) as emulator,
        ):
            self.emulator = emulator
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
                raise TimeoutError(f"it does not answer, see {self._console}")
            time.sleep(1)

    def send(self) -> None:
        """Lay our sources in /root/failover."""
        packed = io.BytesIO()
        with tarfile.open(fileobj=packed, mode="w:gz", compresslevel=1) as archive:
            for name in SENT:
                archive.add(ROOT / name, name, filter=lambda one: None if "__pycache__" in one.name else one)
        done = self.run("mkdir -p /root/failover && tar -C /root/failover -xz --no-same-owner", content=packed.getvalue())
        assert done.returncode == 0, done.stdout.decode(errors="replace")

    def ssh(self, command: str, *more: str) -> list[str]:
        """The command line by which it is told a command; ``more``: options of ssh(1)."""
        options = [f"-o{one}" for one in ("StrictHostKeyChecking=no", "UserKnownHostsFile=/dev/null", "ConnectTimeout=10")]
        return ["ssh", "-q", "-i", str(self.directory / "key"), "-p", str(self.port), *options, *more, "root@127.0.0.1", command]

    def run(self, command: str, *, content: bytes = b"", timeout_s: float = 600) -> subprocess.CompletedProcess[bytes]:
        """Run a shell command in it.

        Returns:
            Its exit status (255: it does not answer), and all that it wrote as ``stdout``.
        """
        words = self.ssh(command)
        try:
            return subprocess.run(
                words, input=content, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, check=False, timeout=timeout_s
            )
        except subprocess.TimeoutExpired as error:
            return subprocess.CompletedProcess(words, 255, error.stdout or b"")


def _run(*words: str | Path, cwd: Path | None = None) -> None:
    subprocess.run([str(word) for word in words], check=True, cwd=cwd, stdin=subprocess.DEVNULL)


def _in_order(modules: Path) -> list[Path]:
    """Those of `MODULES` that are not part of the kernel, each after those that it needs. Source: modules.dep(5)."""
    needs = {}
    for line in (modules / "modules.dep").read_text().splitlines():
        path, _, needed = line.partition(":")
        needs[Path(path).name.partition(".")[0].replace("-", "_")] = [*reversed(needed.split()), path]
    wanted = [path for name in MODULES for path in needs.get(name, [])]
    return [modules / path for path in dict.fromkeys(wanted)]


def _quoted(command: str) -> str:
    """Inside of single quotes."""
    return command.replace("'", "'\\''")


def _main(name: str, *directory: str) -> None:
    kind = next(kind for kind in KINDS if kind.name == name)
    if not directory:
        print(PACKAGES, kind.packages)
        return
    if reason := kind.lacking():
        sys.exit(f"cannot make {name}: it {reason}")
    Machine(kind, Path(*directory) / name, 0).make()


if __name__ == "__main__":
    _main(*sys.argv[1:])
