"""check without a PID: what this machine offers to a protected program, what it lacks, and what to change."""

from __future__ import annotations

import argparse
import os
import platform
import resource
import shutil
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final, Literal

from msgspec import Struct

from checkpoint.arch import EMULATED, cpu
from checkpoint.errors import CheckpointError
from checkpoint.keeper.messages import Capture, Captured, Protect, Protected, Release, Released
from checkpoint.linux.spawn import vessel
from checkpoint.linux.spawn.cpuid import why_unsupported
from checkpoint.linux.spawn.vessel import Birth
from failover.cli.connection import connect
from failover.cli.keeper_client import Keeper
from failover.cli.output import render
from failover.errors import FailoverError

STAND_IN = ("sleep", "60")
"""An ordinary program, to be looked into and ended."""


LOCKED_OR_FIRST: Final = ("beats run at ", "the main loop's memory ")
"""How an agent's notes begin that tell of refused real-time priority and locked memory (`agent.system.clock`)."""


class Offer(Struct, frozen=True):
    """One thing looked at: ``missing`` means that nothing works without it, ``lesser`` that something works less well."""

    verdict: Literal["good", "lesser", "missing"]
    what: str
    text: str


def check_machine(arguments: argparse.Namespace) -> int:
    """Show what this machine offers; 1 when something is missing that nothing works without."""
    status = _status(arguments)
    offers = [
        _architecture(),
        *_looking_into(),
        _isolation(),
        _chosen_pids(),
        *([_real_time(), _memory_lock()] if status is None else _of_agent(status)),
        _watchdog(),
        _network(),
        *([] if status is None else [*_coordinator(status), *_standing_by(status)]),
    ]
    able = all(offer.verdict != "missing" for offer in offers)
    if arguments.json:
        render.as_json({"able": able, "offers": [{"verdict": o.verdict, "what": o.what, "text": o.text} for o in offers]})
    else:
        render.table(("", "what", "finding"), [(offer.verdict, offer.what, offer.text) for offer in offers])
        print("this machine can protect programs" if able else "this machine cannot protect programs: see what is missing above")
    return 0 if able else 1


def _status(arguments: argparse.Namespace) -> Mapping[str, Any] | None:
    """The status that the agent gives of itself; None where none answers."""
    try:
        with connect(arguments) as agent:
            return agent.ask("status")
    except FailoverError:
        return None


def _of_agent(status: Mapping[str, Any]) -> list[Offer]:
    """The grants and refusals that the running agent got: a shell is often allowed more, or less, than a service."""
    refused = [note for note in status["notes"] if note.startswith(LOCKED_OR_FIRST)]
    if refused:
        return [Offer("lesser", "real-time priority", f"the agent says: {note}") for note in refused]
    if not status["realtime"]:
        return [Offer("lesser", "real-time priority", "the agent does not ask for it: agent.toml says realtime = false")]
    return [Offer("good", "real-time priority", "the agent's main loop has it, and its memory is locked")]


def _coordinator(status: Mapping[str, Any]) -> list[Offer]:
    """Whether etcd is reached, where it has a vote."""
    etcd = status.get("coordinator")
    if etcd is None:
        return []
    if etcd["state"] == "live":
        return [Offer("good", "etcd", f"answered {etcd['last_heard_ms'] / 1_000:.1f} s ago")]
    why = [note for note in status["notes"] if "etcd" in note]
    return [Offer("lesser", "etcd", why[0] if why else "it has not answered yet; see failover status")]


def _standing_by(status: Mapping[str, Any]) -> list[Offer]:
    """The needs that this robot does not meet, of components that it stands by for."""
    held = [one for one in status["components"] if one["role"] == "standby" and one["lacks"] is not None]
    lacking = [(one, lack) for one in held for lack in one["lacks"]]
    if lacking:
        return [Offer("lesser", one["name"], _what_is_lacking(one, lack)) for one, lack in lacking]
    return [Offer("good", "standing by", f"this robot has all that {one['name']} needs") for one in held]


def _what_is_lacking(component: Mapping[str, Any], lack: str) -> str:
    brought = component.get("prepared_first")
    return f"its hook before_resume must bring what is missing now: {lack}" if brought else f"could not resume here: {lack}"


def _architecture() -> Offer:
    machine, kernel = platform.machine(), platform.release()
    if reason := why_unsupported():
        return Offer("missing", "processor", reason)
    seen = "; failover was tested on such processors in emulation only (docs/machines.md)" if machine in EMULATED else ""
    return Offer("good", "processor", f"{machine}, Linux {kernel}{seen}")


def _looking_into() -> list[Offer]:
    """Protect and capture a stand-in, and make a vessel to restore into: only a trial shows what a system forbids."""
    with subprocess.Popen(STAND_IN, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as stand_in:
        try:
            notes = _captured_once(stand_in.pid)
        except CheckpointError as error:
            return [Offer("missing", "looking into programs", f"cannot capture a program that was started here: {error}")]
        finally:
            stand_in.kill()
    try:
        vessel.discard(vessel.spawn_vessel(Birth()))
    except CheckpointError as error:
        return [Offer("missing", "restoring", str(error))]
    return [Offer("good", "looking into programs", _ptrace_scope()), _tracking(notes)]


def _captured_once(pid: int) -> tuple[str, ...]:
    """The keeper's notes on a process that it captures once and lets go."""
    with Keeper.spawn() as keeper:
        protected, _ = keeper.ask(Protect(pid, "/check", verb="capture"), Protected)
        captured, (content,) = keeper.ask(Capture(base=True, generation=1, sequence=1), Captured)
        os.close(content)
        keeper.ask(Release(), Released)
    return protected.notes + captured.notes


def _ptrace_scope() -> str:
    try:
        scope = Path("/proc/sys/kernel/yama/ptrace_scope").read_text().strip()
    except OSError:
        return "allowed (no Yama on this kernel)"
    return f"allowed; kernel.yama.ptrace_scope is {scope}" + ("" if scope == "0" else ", so protect PID needs CAP_SYS_PTRACE")


def _tracking(notes: tuple[str, ...]) -> Offer:
    slower = [note for note in notes if note.startswith("written pages")]
    if slower:
        cure = f"use Linux {cpu.WRITE_PROTECTION_SINCE} or later, and let programs call userfaultfd(2)"
        return Offer("lesser", "written pages", f"{slower[0]}; {cure}")
    return Offer("good", "written pages", "found by write protection")


def _isolation() -> Offer:
    born = vessel.spawn_vessel(Birth(isolate=True))
    vessel.discard(born)
    if born.isolated:
        return Offer("good", "PIDs of its own", "a program gets a PID namespace, so its PID is free everywhere")
    return Offer("lesser", "PIDs of its own", "; ".join(born.notes) or "not available")


def _chosen_pids() -> Offer:
    if os.geteuid() == 0:
        return Offer("good", "the old PID", "can be chosen on restore")
    text = "outside a namespace of its own a restored program gets a new PID; CAP_CHECKPOINT_RESTORE lets this user choose"
    return Offer("lesser", "the old PID", text)


def _real_time() -> Offer:
    if os.geteuid() == 0 or resource.getrlimit(resource.RLIMIT_RTPRIO)[1] > 0:
        return Offer("good", "real-time priority", "an agent that is started from here can have it")
    text = "not for this user: a busy machine may look dead; set LimitRTPRIO=, see systemd/failover-agent.service"
    return Offer("lesser", "real-time priority", text)


def _memory_lock() -> Offer:
    limit = resource.getrlimit(resource.RLIMIT_MEMLOCK)[1]
    if os.geteuid() == 0 or limit == resource.RLIM_INFINITY:
        return Offer("good", "locked memory", "the main loop of an agent that is started from here is never swapped out")
    return Offer("lesser", "locked memory", f"limited to {limit >> 20} MiB for this user; set LimitMEMLOCK=infinity")


def _watchdog() -> Offer:
    if Path("/dev/watchdog").exists():
        return Offer("good", "hardware watchdog", "there; systemd's RuntimeWatchdogSec= resets a hung machine")
    return Offer("lesser", "hardware watchdog", "none: nothing resets a robot whose kernel hangs halfway")


def _network() -> Offer:
    if shutil.which("ip") or Path("/usr/sbin/ip").exists():
        return Offer("good", "ip", "there")
    return Offer("lesser", "ip", "iproute2 is not installed: the demo uses loopback ports instead of networks")
