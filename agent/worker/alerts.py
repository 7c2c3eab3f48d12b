"""Tells an operator, by his own commands, of takeovers, splits, trouble and recoveries. The rule: `failover.core.alerts`.

A command (``on_takeover`` … in ``[alerts]`` of agent.toml) runs as the user that this table names, in ``/``, in a session of its
own that is killed at its time limit; under systemd in a service of its own. No shell reads it. It is told in its environment

    FAILOVER_ALERT                       takeover, split, degraded or recovered
    FAILOVER_TEAM, FAILOVER_ROBOT        this team; the robot that tells
    FAILOVER_COMPONENT, FAILOVER_EPOCH   which component, and its epoch
    FAILOVER_REASON, FAILOVER_TIME       a sentence; when it happened (RFC 3339, UTC)
    FAILOVER_LEFT_OUT                    so many like this one were not told since the last

and the same as one JSON object on its standard input, with an ``id`` that no other alert has.

An alert that waits is on the disk until its command begins, and trouble that was told is there until it is over: after a restart
of the agent nothing is told twice.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
from collections import deque
from collections.abc import Callable, Collection, Coroutine, Iterable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import msgspec
from msgspec import Struct, field

from agent.config import Settings
from agent.errors import TROUBLE
from agent.system import clock
from agent.system.crash import end_worker_on_mistake
from agent.system.permissions import without_output
from agent.worker.components.hooks import PATH, Hook, Hooks
from agent.worker.control.queries import Questions
from checkpoint.errors import UNDECODABLE
from checkpoint.linux.spawn.inherited_limits import Inheritance
from checkpoint.sentences import in_words
from checkpoint.store.whole_file import write_whole
from failover.client.health import OVER_STATES, is_unwell, sight, sights
from failover.config.accounts import account_of
from failover.core import acts, events
from failover.core.alerts import REASON_MAX, Alert, Kind, Sight, Terms, Trouble, Watch, teller, why_taken_over
from failover.core.event_log.decisions import Decision
from failover.core.types import Resumption

FILE_NAME: Final = "alerts"
"""Below the state directory."""

LOOK_S: Final = 2.0
"""Between two looks at how the components stand."""

AT_ONCE: Final = 4
"""Commands that run at the same time."""

WAITING_MAX: Final = 256
"""Alerts that wait for their command; a team that loses a robot takes over all that ran there. The rest is counted."""

KEPT_S: Final = 3_600
"""An alert that waits for longer, because the agent was off, is of no use any more."""

SETTLED_NS: Final = 10 * 10**9
"""After a start the peers have been heard by then: a component that no robot knows is over."""

NOTES_SHOWN: Final = 3
"""Of a component, in a reason."""

NOT_LOOKED: Final = "alerts: how the components stand could not be asked: {}"

log = logging.getLogger("failover.alerts")


class Due(Struct, frozen=True):
    """An alert that waits for its command.

    Attributes:
        at_s: when it happened, seconds since 1970.
    """

    id: str
    at_s: float
    alert: Alert


class Kept(Struct):
    """What is on the disk."""

    told: dict[str, Trouble] = field(default_factory=dict)
    due: list[Due] = field(default_factory=list)


class Alerts:
    """The alerts of one robot. Lives in the worker's loop.

    Attributes:
        complaints: kind → why the last command of that kind failed; a sentence for the status.
    """

    def __init__(self, settings: Settings, questions: Questions, tell: Callable[[events.Event], None], hooks: Hooks) -> None:
        config = settings.config.alerts
        self.complaints: dict[str, str] = {}
        self._config, self._questions, self._tell, self._hooks = config, questions, tell, hooks
        self._team, self._robot = settings.team.team, settings.config.robot
        self._path = Path(settings.config.state_directory) / FILE_NAME
        self._user = user_of(config.user)
        spans = (config.degraded_after_s * 10**9, config.recovered_after_s * 10**9)
        self._watch = Watch(Terms(*spans, config.per_hour))
        self._due: deque[Due] = deque()
        self._saved = b""
        self._running = 0
        self._news = asyncio.Event()
        self._began_ns = clock.now_ns()
        self._taken_over: dict[str, int] = {}
        self._tasks: set[asyncio.Task[None]] = set()

    def begin(self) -> None:
        """Go on where the life before ended."""
        kept = self._read()
        self._watch.troubles = {name: msgspec.structs.replace(one, well_ns=0, is_told=True) for name, one in kept.told.items()}
        now_s = clock.wall_ns(clock.now_ns()) / 1e9
        self._due.extend(one for one in kept.due if abs(now_s - one.at_s) <= KEPT_S)
        self._task(self._look())
        self._task(self._run_due())

    async def close(self) -> None:
        """Let go; a command that runs is not waited for."""
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    # --- what happens ---

    def ordered(self, act: acts.Act) -> None:
        """The core has ordered something."""
        if isinstance(act, acts.Restore) and act.why is Resumption.TAKEN_OVER:
            self._taken_over[act.component] = act.epoch
        elif isinstance(act, acts.KeepAside):
            reason = f"another robot ran it too, or instead: {act.reason}; failover lost inspect {act.component} shows what lost"
            self._happened("split", act.component, act.epoch, reason)

    def heard(self, event: events.Event) -> None:
        """The core is told of something."""
        if isinstance(event, events.Restored) and self._taken_over.get(event.component) == event.epoch:
            del self._taken_over[event.component]
            self._task(self._took_over(event.component, event.epoch))

    async def _took_over(self, component: str, epoch: int) -> None:
        """The core hears of it first, so its own sentence about it is there when it is asked."""
        at_s, reason = clock.wall_ns(clock.now_ns()) / 1e9, ""
        with contextlib.suppress(*TROUBLE):
            lines, _ = await self._questions.telling.own_lines(component, 0)
            reason = why_taken_over(map(_without_output, (line.decision for line in lines)), component, epoch)
        self._happened("takeover", component, epoch, reason or f"{self._robot} runs it now", at_s)

    def _happened(self, kind: Kind, component: str, epoch: int, reason: str, at_s: float | None = None) -> None:
        if self._config.command(kind):
            told = self._watch.happened(kind, component, epoch, _spoken(reason), clock.now_ns())
            self._take(filter(None, (told,)), at_s)

    # --- what lasts ---

    async def _look(self) -> None:
        """Look again and again how the components stand that this robot tells of."""
        while True:
            try:
                seen = await self._sights()
            except TROUBLE as trouble:
                log.warning("%s", NOT_LOOKED.format(trouble))
            else:
                self._take(self._watch.look(seen, clock.now_ns()))
            await asyncio.sleep(LOOK_S)

    async def _sights(self) -> dict[str, Sight]:
        """How those stand of which this robot tells: with the word of the robots that stand by, and of those that run what this
        robot told of and does not run any more.
        """
        ours = await self._questions.joined(())
        if ours["rule"] is None:
            return {}  # the agent is starting
        peers = {peer["name"] for peer in ours["peers"]}
        living = {self._robot, *(peer["name"] for peer in ours["peers"] if peer["state"] != "dead")}
        asked: set[str] = set()
        for one in ours["components"]:
            if one["role"] == "primary":
                asked.add(one["standby"])
            elif one["state"] not in OVER_STATES and (one["name"] in self._watch.troubles or one["primary"] not in living):
                asked |= peers
        asked &= peers
        view = await self._questions.joined(asked) if asked else ours
        told = {one["name"]: _sight_of(one) for one in view["components"] if self._tells_of(one, living)}
        if clock.now_ns() - self._began_ns < SETTLED_NS:
            return told
        others = (name for name in self._watch.troubles if name not in told)
        return told | {name: Sight(self._watch.troubles[name].epoch, is_over=True) for name in others}

    def _tells_of(self, component: Mapping[str, Any], living: Collection[str]) -> bool:
        """Whether this robot tells of it: it has told of its trouble, or is the one that does."""
        if (trouble := self._watch.troubles.get(component["name"])) is not None and trouble.is_told:
            return True
        answers = {self._robot: component, **component["elsewhere"]}
        holders = [robot for robot, seen in answers.items() if seen.get("role") == "standby"]
        return teller(str(sight(component).get("primary") or ""), holders, answers, living) == self._robot

    # --- telling ---

    def _take(self, told: Iterable[Alert], at_s: float | None = None) -> None:
        now_s = clock.wall_ns(clock.now_ns()) / 1e9
        for alert in told:
            log.warning("%s: %s: %s", alert.component, alert.kind, alert.reason, extra={"epoch": alert.epoch})
            if not self._config.command(alert.kind):
                continue
            if len(self._due) < WAITING_MAX:
                self._due.append(Due(f"{self._robot}-{os.urandom(6).hex()}", now_s if at_s is None else at_s, alert))
            else:
                self._complain(alert, f"{WAITING_MAX} others wait for their commands")
        self._news.set()

    async def _run_due(self) -> None:
        """Begin the commands of what waits, so many at once, each when it is on the disk that it was begun."""
        while True:
            await self._news.wait()
            self._news.clear()
            begun = [self._due.popleft() for _ in range(min(AT_ONCE - self._running, len(self._due)))]
            await self._save()
            self._running += len(begun)
            for due in begun:
                self._task(self._run(due))

    async def _run(self, due: Due) -> None:
        """Run the command of one, and say how that went."""
        alert = due.alert
        try:
            facts = self._facts(due)
            told = {f"FAILOVER_{key.upper()}": str(value) for key, value in facts.items() if key != "id"}
            hook = Hook(self._config.command(alert.kind), self._config.limit_s, self._user, msgspec.json.encode(facts) + b"\n")
            began_ns = clock.now_ns()
            failure, said = await self._hooks.carry_out(hook, {"PATH": PATH, **told})
            took_ms = (clock.now_ns() - began_ns) / 1e6
        finally:
            self._running -= 1
            self._news.set()
        for line in said.decode(errors="replace").splitlines():
            log.info("%s: on_%s said: %s", alert.component, alert.kind, line)
        if failure:
            self._complain(alert, failure)
            return
        self.complaints.pop(alert.kind, None)
        sentence = f"on_{alert.kind} ({' '.join(hook.command)}) was told, and ended well after {took_ms:.0f} ms"
        self._tell(events.Noticed(alert.component, sentence))

    def _facts(self, due: Due) -> dict[str, str | int]:
        alert = due.alert
        return {
            "alert": alert.kind,
            "id": due.id,
            "team": self._team,
            "robot": self._robot,
            "component": alert.component,
            "epoch": alert.epoch,
            "reason": alert.reason,
            "time": datetime.fromtimestamp(due.at_s, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z"),
            "left_out": alert.left_out,
        }

    def _complain(self, alert: Alert, failure: str) -> None:
        """For the status, the event log and the log."""
        sentence = f"on_{alert.kind} ({' '.join(self._config.command(alert.kind))}) did not tell of {alert.component}: {failure}"
        log.warning("%s", sentence)
        self.complaints[alert.kind] = sentence
        self._tell(events.Noticed(alert.component, sentence))

    # --- the file ---

    def _read(self) -> Kept:
        try:
            return msgspec.json.decode(self._path.read_bytes(), type=Kept)
        except FileNotFoundError:
            return Kept()
        except (OSError, *UNDECODABLE) as error:
            log.warning("%s cannot be used, so what was told before may be told again: %s", self._path, in_words(error))
            return Kept()

    async def _save(self) -> None:
        """What was told, and what waits, as it is now; where it cannot be written it may be told again."""
        troubles = {name: one for name, one in self._watch.troubles.items() if one.is_told}
        told = {name: msgspec.structs.replace(one, bad_ns=0, well_ns=0) for name, one in troubles.items()}
        content = msgspec.json.encode(Kept(told, list(self._due)))
        if content == self._saved:
            return
        try:
            await asyncio.to_thread(write_whole, self._path, content)
        except OSError as error:
            self.complaints["file"] = f"alerts may be told again after a restart: cannot write {self._path}: {error.strerror}"
            return
        self._saved = content
        self.complaints.pop("file", None)

    def _task(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        task.add_done_callback(end_worker_on_mistake)


def user_of(name: str) -> Inheritance | None:
    """Whose rights the commands have; None: the agent's own user's.

    Raises:
        KeyError: this machine has no such user.
    """
    if not name:
        return None
    account = account_of(name)
    return Inheritance(account.pw_uid, account.pw_gid, tuple(os.getgrouplist(account.pw_name, account.pw_gid)))


def _without_output(decision: Decision) -> Decision:
    """What a program wrote is for its owner, and not for the user of the commands."""
    return msgspec.structs.replace(decision, sentence=without_output(decision.sentence))


def _sight_of(component: Mapping[str, Any]) -> Sight:
    """How a component stands, from the words of the robots that were asked."""
    seen = sight(component)
    epoch, is_over = int(seen.get("epoch") or 0), seen.get("state") in OVER_STATES
    if not is_unwell(component):
        return Sight(epoch, is_over=is_over)
    seen_by_all = (seen, *sights(component))
    notes = [str(note) for one in seen_by_all for key in ("notes", "reasons", "lacks") for note in one.get(key) or ()]
    told = [without_output(note) for note in dict.fromkeys(notes)][:NOTES_SHOWN]
    promise = str(seen.get("promise") or "no robot that answered runs it")
    if not seen.get("standby"):
        told.insert(0, f"no other robot holds a checkpoint of it: {promise}")
    return Sight(epoch, _spoken("; ".join(told) or promise), is_over)


def _spoken(text: str) -> str:
    """As one line of text that can be sent anywhere, and not without end."""
    told = text[:REASON_MAX].encode(errors="replace").decode()
    return "".join(one if one.isprintable() else " " for one in told)
