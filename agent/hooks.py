"""Commands of the operator's that a robot runs before a program runs here, and after it was resumed.

What no snapshot carries is theirs: a device is opened, an address taken over, the places of this robot's own wheels written where
the program looks for them. They are told in their environment which robot this is now, and why:

    FAILOVER_HOOK        before_start or on_resume
    FAILOVER_COMPONENT   the component's name
    FAILOVER_ROBOT       this robot
    FAILOVER_EPOCH       the fencing token of the program that begins, or goes on
    FAILOVER_WHY         started, restarted (here, after a crash), taken over, handed over
    FAILOVER_FROM        the robot whose checkpoint it goes on from; not where it is started
    FAILOVER_AGE_MS      how old that checkpoint is; likewise

Standard output and error go to the agent's log, under systemd to the journal. No shell reads the command.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import secrets
import signal
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, Literal

from agent.units import in_a_unit
from checkpoint.linux.inheritance import Inheritance

Kind = Literal["before_start", "on_resume"]

STARTED: Final = "started"
OUTPUT_MAX: Final = 4_096
"""Bytes of what a hook said that stand in the log: the last ones."""

END_S: Final = 2.0
"""How long the end of a hook that took too long is waited for."""

SYSTEMD_S: Final = 2.0
"""How much later than that systemd tells of a hook that it has ended."""

PATH: Final = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"

log = logging.getLogger("failover.component")


@dataclass(frozen=True, slots=True)
class Hook:
    """One command, and whose rights it has.

    Attributes:
        command: the first word names the program; () for none.
        limit_s: it is ended after that.
        user: None: the agent's own user, for what its operator wrote; else the program's, for what came with it.
    """

    command: tuple[str, ...]
    limit_s: float
    user: Inheritance | None = None


@dataclass(frozen=True, slots=True)
class Occasion:
    """Why a hook is run. ``source`` is "" and ``age_ns`` 0 where the program begins."""

    component: str
    robot: str
    epoch: int
    why: str
    source: str = ""
    age_ns: int = 0

    def environment(self, kind: Kind) -> dict[str, str]:
        """As the hook is told."""
        told = {
            "FAILOVER_HOOK": kind,
            "FAILOVER_COMPONENT": self.component,
            "FAILOVER_ROBOT": self.robot,
            "FAILOVER_EPOCH": str(self.epoch),
            "FAILOVER_WHY": self.why,
        }
        if self.source:
            told |= {"FAILOVER_FROM": self.source, "FAILOVER_AGE_MS": str(self.age_ns // 1_000_000)}
        return {"PATH": PATH, **told}


@dataclass(frozen=True, slots=True)
class Hooks:
    """Runs them. Lives in one loop.

    Attributes:
        starter: of services of their own (`agent.units`), so that a hook is not shut in as the agent is; "": it is our child.
    """

    starter: str = ""

    async def run(self, kind: Kind, hook: Hook, occasion: Occasion) -> str:
        """Run one and wait for its end; why it failed, "" if it did not, or if there is none."""
        if not hook.command:
            return ""
        name = secrets.token_hex(4)
        try:
            process = await self._begun(name, hook, occasion.environment(kind))
        except (OSError, ValueError) as error:  # a command that came from another robot may hold a zero byte
            return self._told(kind, hook, occasion, f"cannot be started: {error}")
        try:
            said, _ = await asyncio.wait_for(process.communicate(), hook.limit_s + (SYSTEMD_S if self.starter else 0))
        except TimeoutError:
            await _end(process)
            return self._told(kind, hook, occasion, f"took longer than {hook.limit_s:g} s and was ended")
        _log_output(kind, occasion, said)
        if not process.returncode:
            return ""
        return self._told(kind, hook, occasion, self._failure(name, process.returncode))

    def _failure(self, name: str, status: int) -> str:
        if self.starter:
            return f"journalctl --unit failover-hook-{name} tells how"
        return f"exit status {status}" if status > 0 else f"signal {-status}"

    async def _begun(self, name: str, hook: Hook, environment: Mapping[str, str]) -> asyncio.subprocess.Process:
        wanted = _user_of(hook.user)
        command, variables = list(hook.command), dict(environment)
        if self.starter:
            options = [f"--setenv={variable}={value}" for variable, value in environment.items()]
            options += [f"--property=TimeoutStartSec={hook.limit_s:g}s"]
            options += [f"--uid={wanted['user']}", f"--gid={wanted['group']}"] if wanted else []
            way = in_a_unit(self.starter, "hook", name)
            command, variables, wanted = [*way[:-1], *options, "--", *command], dict(os.environ), {}
        return await asyncio.create_subprocess_exec(
            *command,
            env=variables,
            cwd="/",
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.STDOUT,
            start_new_session=True,
            **wanted,
        )

    def _told(self, kind: Kind, hook: Hook, occasion: Occasion, why: str) -> str:
        sentence = f"{kind} ({' '.join(hook.command)}) failed on {occasion.robot}, {occasion.why}: {why}"
        log.warning("%s: %s", occasion.component, sentence)
        return sentence


def _user_of(user: Inheritance | None) -> dict[str, Any]:
    """What subprocess is told to become, where we can become somebody."""
    if user is None or os.geteuid() != 0 or user.uid == 0:
        return {}
    return {"user": user.uid, "group": user.gid, "extra_groups": list(user.groups)}


async def _end(process: asyncio.subprocess.Process) -> None:
    """End a hook and whatever it started in its session."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    with contextlib.suppress(TimeoutError):
        await asyncio.wait_for(process.wait(), END_S)


def _log_output(kind: Kind, occasion: Occasion, said: bytes) -> None:
    for line in said[-OUTPUT_MAX:].decode(errors="replace").splitlines():
        log.info("%s: %s said: %s", occasion.component, kind, line)
