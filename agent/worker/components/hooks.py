"""Runs a robot's hooks: commands before a program begins here, before it is captured, and before and after it resumes here.

Hooks prepare what no snapshot carries: they open a device, take over an address, or write the settings of this robot's own wheels
where the program looks for them. Their environment tells them which robot this is now, and why:

    FAILOVER_HOOK        before_start, before_capture, before_resume or after_resume
    FAILOVER_COMPONENT   the component's name
    FAILOVER_ROBOT       this robot
    FAILOVER_EPOCH       the fencing token of the program that begins, is captured, or resumes
    FAILOVER_GENERATION  of the snapshots that are taken of it here
    FAILOVER_WHY         started, captured, restarted (here, after a crash), taken over, handed over
    FAILOVER_PID         the program's, as this robot knows it; not before it is there (before_start, before_resume)
    FAILOVER_FROM        the robot whose checkpoint it resumes from; not where it is started or captured
    FAILOVER_AGE_MS      how old that checkpoint is; likewise

Standard output and error go to the agent's log, under systemd to the journal, and the last line to ``failover why``: the
component's own output is the program's alone. No shell reads the command.

An after_resume of the one word ``signal:SIGUSR2`` runs no command: the program itself gets that signal before its next
instruction, with the generation as its value (``epoch × 64 + the robot's place in the order of names``), and its handler is the
hook.
"""

from __future__ import annotations

import asyncio
import base64
import contextlib
import logging
import os
import secrets
import signal
from collections.abc import Mapping
from typing import Any, Final

from msgspec import Struct

from agent.hook_kinds import Kind
from agent.system.systemd_units import in_a_unit
from checkpoint.linux.spawn.inherited_limits import Inheritance
from checkpoint.sentences import in_words

STARTED: Final = "started"
CAPTURED: Final = "captured"
OUTPUT_MAX: Final = 4_096
"""Bytes of a hook's output that stand in the log: the last ones."""

CHUNK: Final = 1 << 16
"""Bytes of it that are read at a time."""

LINE_MAX: Final = 300
"""Characters of the last line that ``failover why`` shows."""

REST_S: Final = 0.5
"""How long to wait for the rest of a hook's output once it has ended: another process may have its output open for ever."""

END_S: Final = 2.0
"""How long the end of a hook that took too long is waited for."""

SWEEPS: Final = 5
"""Looks for processes of a hook that is ended: the next look finds processes that were born during one."""

SYSTEMD_S: Final = 2.0
"""How much later than that systemd tells of a hook that it has ended."""

PATH: Final = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"

log = logging.getLogger("failover.component")


class Hook(Struct, frozen=True):
    """One command, and whose rights it has.

    Attributes:
        command: the first word names the program; () for none.
        limit_s: it is ended after that.
        user: None: the agent's own user, for a hook that its operator wrote; else the program's, for one that came with it.
        told: what it reads from its standard input.
    """

    command: tuple[str, ...]
    limit_s: float
    user: Inheritance | None = None
    told: bytes = b""


class Occasion(Struct, frozen=True):
    """Why a hook is run. ``source`` is "", ``age_ns`` 0 where it does not go on from a checkpoint; ``pid`` 0 before it runs."""

    component: str
    robot: str
    epoch: int
    generation: int
    why: str
    source: str = ""
    age_ns: int = 0
    pid: int = 0

    def environment(self, kind: Kind) -> dict[str, str]:
        """As the hook is told."""
        told = {
            "FAILOVER_HOOK": kind,
            "FAILOVER_COMPONENT": self.component,
            "FAILOVER_ROBOT": self.robot,
            "FAILOVER_EPOCH": str(self.epoch),
            "FAILOVER_GENERATION": str(self.generation),
            "FAILOVER_WHY": self.why,
        }
        if self.pid:
            told["FAILOVER_PID"] = str(self.pid)
        if self.source:
            told |= {"FAILOVER_FROM": self.source, "FAILOVER_AGE_MS": str(self.age_ns // 1_000_000)}
        return {"PATH": PATH, **told}


class Outcome(Struct, frozen=True):
    """How a hook ended.

    Attributes:
        failure: why it failed, a sentence; "" if it did not.
        last_line: the last line that it wrote; "" if none.
    """

    failure: str = ""
    last_line: str = ""


class Hooks(Struct, frozen=True):
    """Runs them. Lives in one loop.

    Attributes:
        starter: of services of their own (`agent.system.systemd_units`), so that a hook is not shut in as the agent is; "": it
            is our child.
    """

    starter: str = ""

    async def run(self, kind: Kind, hook: Hook, occasion: Occasion) -> Outcome:
        """Run one and wait for its end."""
        failure, said = await self.carry_out(hook, occasion.environment(kind))
        last_line = _log_output(kind, occasion, said)
        if not failure:
            return Outcome(last_line=last_line)
        sentence = f"{kind} ({' '.join(hook.command)}) failed on {occasion.robot}, {occasion.why}: {failure}"
        log.warning("%s: %s", occasion.component, sentence)
        return Outcome(sentence, last_line)

    async def carry_out(self, hook: Hook, environment: Mapping[str, str]) -> tuple[str, bytes]:
        """Run a command and wait for its end: why it failed, "" if it did not, and the last that it wrote."""
        name = secrets.token_hex(4)
        try:
            running = await self._begun(name, hook, environment)
        except (OSError, ValueError) as error:  # a command that came from another robot may hold a zero byte
            return f"cannot be started: {in_words(error)}", b""
        try:
            said = await running.last_said(hook.limit_s + (SYSTEMD_S if self.starter else 0))
        except TimeoutError:
            await _end(running.process)
            return f"took longer than {hook.limit_s:g} s and was ended", running.said
        finally:
            running.output.close()
        status = running.process.returncode
        return self._failure(name, status) if status else "", said

    def _failure(self, name: str, status: int) -> str:
        if self.starter:
            return f"see journalctl --unit failover-hook-{name}"
        return f"exit status {status}" if status > 0 else f"signal {-status}"

    async def _begun(self, name: str, hook: Hook, environment: Mapping[str, str]) -> _Running:
        wanted = _user_of(hook.user)
        command, variables = list(hook.command), dict(environment)
        if self.starter:
            options = [f"--setenv={variable}={value}" for variable, value in environment.items()]
            options += [f"--property=TimeoutStartSec={hook.limit_s:g}s"]
            options += [f"--uid={wanted['user']}", f"--gid={wanted['group']}"] if wanted else []
            if hook.told:
                content = base64.b64encode(hook.told).decode()
                options += ["--property=StandardInput=data", f"--property=StandardInputData={content}"]
            way = in_a_unit(self.starter, "hook", name)
            words = (command[0], *(word.replace("$", "$$") for word in command[1:]))  # systemd would put variables' values there
            command, variables, wanted = [*way[:-1], *options, "--", *words], dict(os.environ), {}
        reading, writing = os.pipe()
        standard_input = asyncio.subprocess.DEVNULL
        try:
            standard_input = _file_of(hook.told)
            process = await asyncio.create_subprocess_exec(
                *command,
                env=variables,
                cwd="/",
                stdin=standard_input,
                stdout=writing,
                stderr=asyncio.subprocess.STDOUT,
                start_new_session=True,
                **wanted,
            )
        except BaseException:
            os.close(reading)
            raise
        finally:
            os.close(writing)
            if standard_input >= 0:
                os.close(standard_input)
        reader = asyncio.StreamReader()
        protocol = asyncio.StreamReaderProtocol(reader)
        output, _ = await asyncio.get_running_loop().connect_read_pipe(lambda: protocol, os.fdopen(reading, "rb", buffering=0))
        return _Running(process, reader, output)


class _Running(Struct):
    """A hook that was begun.

    Attributes:
        reader, output: of the hook's output; closed by the hook's caller. The pipe is ours, not asyncio's, which would take
            a hook for running as long as any process has the other end: one that puts itself in the background keeps it.
    """

    process: asyncio.subprocess.Process
    reader: asyncio.StreamReader
    output: asyncio.ReadTransport
    said: bytes = b""

    async def last_said(self, limit_s: float) -> bytes:
        """Wait for the end of the hook; return the last bytes of its output, which may be without end.

        Raises:
            TimeoutError: it runs for longer than ``limit_s``; the time for the rest of its output does not count.
        """
        reading = asyncio.create_task(self._read())
        try:
            await asyncio.wait_for(self.process.wait(), limit_s)
            done, _ = await asyncio.wait((reading,), timeout=REST_S)
        finally:
            reading.cancel()
        if not done:
            log.info(
                "a process that hook %d left behind still has its output open; the agent does not read that output",
                self.process.pid,
            )
        return self.said

    async def _read(self) -> None:
        while piece := await self.reader.read(CHUNK):
            self.said = (self.said + piece)[-OUTPUT_MAX:]


def _file_of(content: bytes) -> int:
    """A descriptor from which a command can read that, however slowly; of no file, where there is nothing to read."""
    if not content:
        return asyncio.subprocess.DEVNULL
    descriptor = os.memfd_create("told", os.MFD_CLOEXEC)
    os.write(descriptor, content)
    os.lseek(descriptor, 0, os.SEEK_SET)
    return descriptor


def _user_of(user: Inheritance | None) -> dict[str, Any]:
    """The user and groups that subprocess gives the hook, where this process has the right to change them."""
    if user is None or os.geteuid() != 0 or user.uid == 0:
        return {}
    return {"user": user.uid, "group": user.gid, "extra_groups": list(user.groups)}


async def _end(process: asyncio.subprocess.Process) -> None:
    """End a hook and all processes that it started in its session, in every process group."""
    for _ in range(SWEEPS):
        if not sum(_kill_of(process.pid, int(name)) for name in os.listdir("/proc") if name.isdigit()):
            break
    with contextlib.suppress(TimeoutError):
        await asyncio.wait_for(process.wait(), END_S)


def _kill_of(session: int, pid: int) -> bool:
    """Kill a process if it lives and belongs to a session; whether it did."""
    try:
        itself = os.pidfd_open(pid)
    except OSError:
        return False
    try:
        if os.getsid(pid) != session:
            return False
        signal.pidfd_send_signal(itself, signal.SIGKILL)
        return True
    except OSError:  # ended meanwhile
        return False
    finally:
        os.close(itself)


def _log_output(kind: Kind, occasion: Occasion, said: bytes) -> str:
    """Put a hook's output into the log; return its last line."""
    lines = said.decode(errors="replace").splitlines()
    for line in lines:
        log.info("%s: %s said: %s", occasion.component, kind, line)
    return next((line.strip() for line in reversed(lines) if line.strip()), "")[:LINE_MAX]
