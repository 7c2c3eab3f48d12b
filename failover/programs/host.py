"""Holds the name and the mailbox of one program, while versions of it come and go.

The host is what senders talk to: its sockets, its mailbox with what each sender was answered, its pace. A version is a process of
its own that gets one message at a time, and says with each answer which state it left. So between two messages the host can put
another version in its place: the old one has nothing that the host does not have, and senders notice a pause at most.

    message → mailbox → host → version's process → answer + state → kept → the answer leaves

A switch, all between two messages: the old version is paused and says its last state; the new one, which has waited warm, begins
with it. From then on the new one is on trial (`failover.core.programs.trial`). If it fails, the old one, whose process is still
there, begins with its state at the switch and carries out the commands since then again, without answers; then the message in
hand, with one.

A verb that begins with ``_`` is the host's: ``_versions``, ``_switch``, ``_rollback``.
"""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import msgspec
from msgspec import UNSET, Struct

from failover.core.messaging.envelope import Envelope, Fault, answer, refusal
from failover.core.messaging.mailbox import Mailbox, Stream
from failover.core.messaging.pacing import SECOND, Pace, merged
from failover.core.programs import states, versions
from failover.core.programs.states import Shelf, Standing
from failover.core.programs.trial import Command, Trial, Verdict
from failover.drivers.actor import Actor, Publish, Whose
from failover.drivers.declare import Declaration, Marked, Verb
from failover.drivers.keeping import Keeping
from failover.drivers.server import Hand, Near
from failover.errors import FailoverError, ProgramError
from failover.fencing.epoch import epoch
from failover.kept_state.api import SWITCHED, Resumed
from failover.programs.carried import Carried
from failover.programs.channel import Hello
from failover.programs.running import Answered, Running, Source
from failover.programs.sources import Place, before, source_of_directory, source_of_store, version_of
from failover.programs.starting import Revival, Starter, again
from failover.programs.store import Kept

ROLLBACK_S: Final = 300
"""How long the process of a version that was replaced is kept: a rollback within this time takes no start."""

RESTART_NS: Final = SECOND
"""Between two tries to start a version that has ended by itself."""

ANSWERS_KEPT: Final = 16
"""Of each sender, on disk: one that calls waits for one."""

LOOK_NS: Final = SECOND
"""How often the host looks at clocks although no message comes, while something is due."""

log = logging.getLogger("failover.programs")


class _Unchecked(Struct, frozen=True):
    """The version's own process checks arguments."""


class Described(Declaration, frozen=True):
    """A declaration as a version's process told it."""

    told: Mapping[str, Any] = {}

    @property
    def shown(self) -> list[Verb]:
        """Also those of earlier versions, which that process tells apart."""
        return [one for one in self.verbs.values() if one.name in self.told]

    def schemas(self) -> dict[str, Any]:
        """As that process made them."""
        return dict(self.told)


def declared(hello: Hello, beside: str) -> Described:
    """``beside``: "" or the path under which a second version runs, without aliases."""
    verbs = {
        name: Verb(name, Marked(one.role, one.coalesce, one.rate_hz), _Unchecked)  # type: ignore[arg-type]
        for name, one in hello.verbs.items()
    }
    aliases = () if beside else hello.aliases
    return Described(beside or hello.path, aliases, hello.rate_hz, verbs, hello.labels, told=hello.described)


class HostActor(Actor):
    """The mailbox of one program, and the versions that carry out its messages."""

    def __init__(
        self,
        place: Place,
        first: Running,
        declaration: Declaration,
        who: str,
        kept: Kept | None,
        keeping: Keeping | None = None,
    ) -> None:
        """
        Args:
            kept: what outlived the last host. keeping: of a host under an agent, its mailbox and `Carried`; else the store keeps.
        """
        super().__init__(object(), declaration, who, keeping)
        self._place = place
        self._running: Running | None = first
        self._old: Running | None = None
        self._old_until_ns = 0
        self._trial: Trial | None = None
        self._number = kept.number if kept is not None else 0
        self._said = ""
        self._last = first.source
        self._why_lost = ""
        self._owed: tuple[Command, ...] = ()
        """What the version that is started anew must carry out before anything else."""
        self._restart_ns = 0
        self._gap_ms = 0.0
        self._state = first.state
        self._is_changed = True
        self._starter = Starter(place, self._resumed, self._say, lambda: self.wake())
        self.wake: Callable[[], None] = lambda: None
        self.renew: Callable[[Declaration], None] = lambda _: None
        self._switched: Kept | None = None
        """State and version before the last switch."""
        self._is_switch_unwritten = False
        self._is_shelf_new = True
        self._is_unsettled = False
        if kept is not None and keeping is None:
            self._mailbox = Mailbox(kept.streams)

    # --- One message ------------------------------------------------------------------------------------------------------

    def handle(self, clock: Callable[[], int]) -> list[Envelope]:
        """Between two messages: switch, if a version has become warm; judge the one on trial. Then the next message.

        While another copy acts, nothing of that: versions that start, switch and carry out commands again act on the device.
        """
        if not self.fence(0):
            self._turn(clock)
        answers = super().handle(clock)
        if self._may_keep:
            self._keep()
        if self._is_unsettled:
            self._settle()
        return answers

    def _handle(self, now_ns: int, clock: Callable[[], int]) -> None:
        """Under an agent, what a message did and that it was handled is one commit."""
        super()._handle(now_ns, clock)
        if self._keeping is not None and self._may_keep:
            self._carry(self._keeping)

    @property
    def _may_keep(self) -> bool:
        """Whether there is something to keep. While a trial's commands are owed, only what was kept before has them."""
        return self._is_changed and not self._owed

    def following(self, now_ns: int) -> Envelope | None:
        """While no version runs, only what is the host's own is carried out."""
        if self._running is None:
            handled = self._mailbox.handled
            self._mailbox.bring_forward(_is_hosts, now_ns)
            self._is_changed |= self._mailbox.handled != handled  # what has expired is kept, then answered
        first = super().following(now_ns)
        return first if first is None or self._running is not None or _is_hosts(first) else None

    def sample(self, publish: Publish, clock: Callable[[], int]) -> None:
        """Streams pause while no version runs."""
        if self._running is None:
            self._samples_ns = dict.fromkeys(self._samples_ns, clock() + LOOK_NS)
        super().sample(publish, clock)

    def wait_ns(self, now_ns: int) -> int | None:
        """Not longer than until something of the versions is due."""
        waits = [one for one in (super().wait_ns(now_ns),) if one is not None]
        if self.fence(0):
            return min(*waits, LOOK_NS) if waits else LOOK_NS
        if self._starter.has_news or self._may_keep:
            waits.append(0)
        if self._trial is not None:
            due = self._trial.wait_ns(now_ns)
            waits.append(LOOK_NS if due is None else due)
        if self._old is not None and self._trial is None:
            waits.append(max(self._old_until_ns - now_ns, 0))
        if self._running is None and not self._starter.is_reviving:
            waits.append(max(self._restart_ns - now_ns, 0))
        return min(waits, default=None)

    def carried_out(self, run: Sequence[Envelope]) -> Envelope:
        """The answer of the active version, or of the one before it if that fails on trial."""
        message = merged(run) if len(run) > 1 else run[0]
        if orders := {"_versions": self._versions, "_switch": self._switch, "_rollback": self._rollback}.get(message.verb):
            try:
                return answer(message, orders(message.body if isinstance(message.body, dict) else {}))
            except (FailoverError, ValueError) as error:  # ValueError: a name of a file with NUL
                return refusal(message, "refused", str(error))
        if _is_hosts(message):
            return super().carried_out(run)
        return self._forwarded(message)

    def refused(self, envelope: Envelope, whose: Whose) -> Fault | None:
        """Orders come from the host's own user or root on this robot, as the kernel says.

        Messages for a version come while one runs: its sender's proxy sends what is refused as busy again. One past its deadline
        is taken, and answered as such: its sender's next ones follow it.
        """
        is_late = envelope.deadline_ms is not None and envelope.deadline_ms <= 0
        if self._running is None and not _is_hosts(envelope) and not is_late:
            version = self._last.manifest.version
            return Fault("busy", f"{self._place.name} {version} is being started anew: {self._why_lost}; send it again")
        if envelope.verb not in ("_switch", "_rollback"):
            return None
        if not isinstance(whose, Near | Hand):
            return Fault("refused", f"give this order on the robot itself: {envelope.sender} is on another one")
        if whose.uid not in (0, os.geteuid()):
            mine = os.geteuid()
            return Fault("refused", f"this order is for uid {mine}, whose host this is, and root: uid {whose.uid} is neither")
        return None

    def called(self, verb: Verb, arguments: Mapping[str, Any], message: Envelope) -> Envelope:
        """A stream's value."""
        return self._forwarded(msgspec.structs.replace(message, verb=verb.name, body=dict(arguments)))

    def _forwarded(self, message: Envelope) -> Envelope:
        message = msgspec.structs.replace(message, rest={})
        if self._running is None:
            text = f"no version of {self._place.name} runs now: {self._why_lost}; {message.verb} may have been carried out"
            return refusal(message, "no_version", text)
        try:
            found = _checked(message, self._running.call(message))
            why = found.answer.error.sentence if found.answer.error is not UNSET and found.answer.error.kind == "failed" else ""
        except FailoverError as error:
            found, why = None, str(error)
        if self._trial is not None and (why or found is None):
            self._fall_back(f"at message {self._trial.messages + 1}, {message.verb}: {why}")
            return self._forwarded(message)
        if found is None:
            self._lost(why)
            text = f"{message.verb} was not finished: {why}; it may have been carried out"
            return refusal(message, "failed", text)
        self._take(message, found)
        return found.answer

    def _take(self, message: Envelope, found: Answered) -> None:
        assert self._running is not None
        verb = self._declaration.verbs.get(message.verb)
        is_command = verb is None or verb.marked.role == "command"
        self._is_changed |= is_command or found.state is not self._running.state
        self._running.state = self._state = found.state
        if found.trouble and found.trouble != self._said:
            self._said = found.trouble
            self._note(f"its state cannot be kept: {found.trouble}")
        if self._trial is not None:
            self._trial.handled(Command(message.verb, message.body), changes=is_command)

    def _keep(self) -> None:
        """State and mailbox to the disk, before an answer leaves."""
        self._is_changed = False
        try:
            self._write()
        except ProgramError as error:
            if str(error) != self._said:
                self._said = str(error)
                log.warning("%s", error)

    def _carry(self, keeping: Keeping) -> None:
        """State and versions into what the next commit takes to the standby."""
        carried: Carried = keeping.instance
        self._is_changed = False
        self._number += 1
        carried.newest = msgspec.msgpack.encode(Kept(self._number, self.version, self._state, {}, time.time()))
        if self._is_shelf_new:
            try:
                carried.take_shelf(self._place.store.shelf(self._place.name), self._place)
            except ProgramError as error:  # tried again with the next message
                why = f"a standby cannot take {self.version} over: {error}"
                if why != self._said:
                    self._say(why)
            else:
                carried.switched = msgspec.msgpack.encode(self._switched) if self._switched is not None else b""
                self._is_shelf_new = False

    def _write(self, *, is_lasting: bool = False) -> None:
        if self._keeping is not None:
            with self._keeping.message():
                self._carry(self._keeping)
            return
        if self._switched is not None and self._is_switch_unwritten:
            self._place.store.keep(before(self._declaration.path), self._switched)
            self._is_switch_unwritten = False
        streams = {sender: _cut(one) for sender, one in self._mailbox.kept().items()}
        kept = Kept(self._number + 1, self.version, self._state, streams, time.time())
        self._place.store.keep(self._declaration.path, kept, is_lasting=is_lasting)
        self._number += 1  # only now: while the disk is full, the newest whole one is never written over

    @property
    def version(self) -> str:
        """The one that carries out messages; "" while none does."""
        return self._running.source.manifest.version if self._running is not None else ""

    @property
    def _state_at_switch(self) -> Any:
        """What the version before the active one left; None: its first one."""
        return self._switched.state if self._switched is not None else None

    # --- Between two messages ---------------------------------------------------------------------------------------------

    def _turn(self, clock: Callable[[], int]) -> None:
        now_ns = clock()
        if self._running is not None and not self._running.lives:
            self._ended()
        if (revival := self._starter.revived()) is not None:
            self._revived(revival)
        coming = self._starter.warmed()
        if self._running is None and coming is None and not self._starter.is_reviving and now_ns >= self._restart_ns:
            self._restart_ns = now_ns + RESTART_NS
            self._starter.revive(self._last, self._state, self._owed)
        if coming is not None:
            self._switch_to(coming, clock)
        if self._trial is not None:
            self._judge(now_ns)
        if self._old is not None and self._trial is None and now_ns >= self._old_until_ns:
            self._let_go()

    def _switch_to(self, new: Running, clock: Callable[[], int]) -> None:
        """The new version takes over, or the old one goes on as if nothing had been.

        No file is written between `pause` and the new version's `begin`, when no version can take a message. Before, the shelf
        is: if the host ends from then on, the next one finds a trial, and goes back to the old version, whose state is the newest
        kept. After, state, mailbox and the state at the switch are, before the first answer of the new version leaves.
        """
        old, version = self._running, new.source.manifest.version
        switched: Kept | None = None
        try:
            earlier = self._record(lambda shelf: states.succeed(shelf, states.warm(version_of(shelf, version)), "on trial"))
        except FailoverError as error:
            new.end()
            self._say(f"{version} could not take over: {error}")
            return
        began_ns = clock()
        try:
            if old is not None:
                old.pause()
                self._state = old.state
                switched = Kept(self._number, old.source.manifest.version, old.state, {}, time.time())
            new.begin(self._state, self._resumed(SWITCHED))
        except FailoverError as error:
            if earlier is not None:
                self._record_anyway(lambda shelf: states.undone(shelf, earlier))
            new.end()
            self._say(f"{version} could not take over: {error}")
            if old is not None:
                self._resume(old, self._state)
            return
        now_ns = clock()
        self._let_go()
        self._running, self._old, self._state = new, old, new.state
        self._switched, self._is_switch_unwritten = switched, switched is not None
        self._trial = Trial(new.source.manifest.health, now_ns)
        self._gap_ms = (now_ns - began_ns) / 1e6
        self._renew(new)
        notes = "".join(f"; {note}" for note in new.notes)
        self._say(f"{version} took over within {self._gap_ms:.1f} ms, on trial{notes}")
        self._is_changed = True

    def _resume(self, old: Running, state: Any) -> bool:
        """A version that was paused goes on with this state; False: its process does not, and it is started anew."""
        self._state = state
        if self._began_with(old, state):
            return True
        old.end()
        self._running, self._last, self._restart_ns = None, old.source, 0
        return False

    def _judge(self, now_ns: int) -> None:
        assert self._trial is not None and self._running is not None
        verdict = self._trial.verdict(now_ns)
        if verdict is Verdict.WAIT:
            return
        health = self._running.source.manifest.health
        if verdict is Verdict.ASK:
            try:
                found = self._running.call(Envelope(verb=health.query)).answer
                why = found.error.sentence if found.error is not UNSET else ""
            except FailoverError as error:
                why = str(error)
            if why:
                self._fall_back(f"its health query {health.query} failed: {why}")
                return
        messages, self._trial = self._trial.messages, None
        self._old_until_ns = now_ns + ROLLBACK_S * SECOND
        self._record_anyway(lambda shelf: states.put(shelf, states.commit(version_of(shelf, self.version), "healthy")))
        self._say(f"{self.version} is committed: {messages} messages without a failure")

    def _fall_back(self, why: str) -> None:
        """The trial has failed: the version before it goes on, with what the new one was told since the switch."""
        assert self._trial is not None and self._running is not None
        failed, trial, old = self._running, self._trial, self._old
        newest, self._trial, self._old = self._state, None, None
        failed.end()
        version = failed.source.manifest.version
        if old is None:
            self._running, self._last, self._why_lost = None, failed.source, why
            self._say(f"{version} failed, and no version was active before it: {why}")
            return
        self._record_anyway(lambda shelf: states.fall_back(shelf, why))
        if failed.source.manifest.on_rollback == "newest" and self._began_with(old, newest):
            told = f"goes on with the state of {version}"
        elif self._resume(old, self._state_at_switch):
            told = f"goes on with its state at the switch, and {self._replayed(trial.replay)} commands since then once more"
        else:
            self._owed = trial.replay
            told = f"is started anew with its state at the switch, and gets {len(self._owed)} commands since then once more"
        if self._running is not None:
            self._state = self._running.state
        self._renew(old)
        self._say(f"{version} is rolled back: {why}; {old.source.manifest.version} {told}")
        self._is_changed = True

    def _began_with(self, old: Running, state: Any) -> bool:
        try:
            old.begin(state, self._resumed(SWITCHED))
        except FailoverError as error:
            self._why_lost = str(error)
            return False
        self._running = old
        return True

    def _replayed(self, commands: Sequence[Command]) -> int:
        """How many commands were carried out again; their answers have left before."""
        assert self._running is not None
        self._state = self._state_at_switch
        for count, command in enumerate(commands):
            try:
                self._running.state = self._state = again(self._running, command)
            except FailoverError as error:
                self._lost(f"at {command.verb}, which is left out: {error}")
                self._owed = tuple(commands[count + 1 :])
                return count
        return len(commands)

    def _let_go(self) -> None:
        old, self._old = self._old, None
        if old is not None:
            self._starter.aside(old.end)  # it may take its time, and no version waits for it

    # --- An end that no person ordered ------------------------------------------------------------------------------------

    def _ended(self) -> None:
        if self._trial is not None:
            self._fall_back("its process ended")
        else:
            self._lost("its process ended")

    def _lost(self, why: str) -> None:
        """The active version is gone, not on trial: it is started anew with its last state."""
        lost, self._running = self._running, None
        self._why_lost = why
        if lost is not None:
            lost.end()
            self._last = lost.source
            self._say(f"{lost.source.manifest.version}: {why}; it is started anew")

    def _revived(self, revival: Revival) -> None:
        """The version that was started anew takes messages, unless it could not, or another one does by now."""
        anew = revival.running
        if anew is None:
            self._why_lost = revival.why or self._why_lost
            return
        if self._running is not None:
            anew.end()
            return
        self._running, self._state, self._owed = anew, anew.state, ()
        self._say(f"{anew.source.manifest.version} goes on: it was started anew as pid {anew.pid}")
        self._is_changed = True

    def _resumed(self, why: str) -> Resumed:
        """Where a state comes from that a version gets from this host."""
        return Resumed(self._who.partition("/")[0], epoch(), self._number, why, 0.0)

    # --- Orders -----------------------------------------------------------------------------------------------------------

    def _versions(self, _: Mapping[str, Any]) -> Any:
        """What there is, and what was said last."""
        shelf = self._place.store.find(self._place.name) if not self._place.directory else None
        running = self._running
        standing = Standing(
            name=self._place.name,
            path=self._declaration.path,
            active=self.version,
            pid=running.pid if running is not None else 0,
            on_trial=self._trial is not None,
            is_coming=self._starter.is_warming,
            said=self._said,
            gap_ms=round(self._gap_ms, 3),
            enforced=running.hello.enforced if running is not None else (),
            not_enforced=running.hello.not_enforced if running is not None else (),
            before=self._old.source.manifest.version if self._old is not None else "",
            versions=shelf.versions if shelf is not None else (),
        )
        return msgspec.to_builtins(standing)

    def _switch(self, body: Mapping[str, Any]) -> Any:
        """Begin to start a version; what comes of it, ``_versions`` tells."""
        version, directory = body.get("version"), body.get("directory")
        if self._starter.is_warming or self._trial is not None:
            raise ProgramError(f"{self._place.name} is in the middle of a switch; wait until its trial is over, or roll it back")
        if self._owed:
            version, count = self._last.manifest.version, len(self._owed)
            raise ProgramError(
                f"{version} is being started anew, and gets {count} commands once more; order the switch after that"
            )
        if isinstance(directory, str) and self._place.directory is not None:
            source = source_of_directory(Path(directory))
            if source.manifest.name != self._place.name or source.manifest.path != self._declaration.path:
                raise ProgramError(
                    f"{directory} is {source.manifest.name} for {source.manifest.path}, and not {self._place.name}"
                )
            self._warm(lambda: source)
            return {"version": source.manifest.version}
        if not isinstance(version, str) or self._place.directory is not None:
            raise ProgramError(
                "say which: a program that runs from a directory is switched to a directory, one of the store to a version"
            )
        one = version_of(self._place.store.shelf(self._place.name), version)
        if versions.order(one.version) == versions.order(self.version or "0") and self._running is not None:
            raise ProgramError(f"{self._place.name} {version} is active already")
        if self.version and versions.order(one.version) < versions.order(self.version):
            raise ProgramError(
                f"{version} is older than {self.version}, which runs: failover program rollback {self._place.name} goes back"
            )
        self._warm(lambda: source_of_store(self._place, one.version))
        return {"version": one.version}

    def _warm(self, source: Callable[[], Source]) -> None:
        self._said = ""
        self._starter.warm(source)

    def _rollback(self, body: Mapping[str, Any]) -> Any:
        """Back to the version before, whose process still waits."""
        old, new = self._old, self._running
        if old is None:
            raise ProgramError(
                f"{self._place.name} cannot be rolled back: the version before is kept for {ROLLBACK_S} s after a switch; "
                "send the older program as a bundle with a higher version"
            )
        if self._trial is not None:
            self._fall_back("a person took it back")
            return {"active": self.version}
        source, newest = (new.source, new.state) if new is not None else (self._last, self._state)
        version = source.manifest.version
        if new is not None:
            try:
                new.pause()
            except FailoverError as error:
                self._note(f"{version} did not let its device go: {error}")
            newest = new.state
        if not self._began_with(old, newest):
            if not body.get("old_state"):
                if new is not None:
                    self._resume(new, newest)
                raise ProgramError(
                    f"{old.source.manifest.version} cannot read the state of {version}; with --old-state it goes "
                    "on with its own state at the switch, and what came since then is lost"
                )
            self._resume(old, self._state_at_switch)
        self._record_anyway(lambda shelf: states.fall_back(shelf, "a person took it back"))
        if new is not None:
            new.end()
        self._old, self._state = None, old.state
        self._renew(old)
        self._say(f"{version} is rolled back by a person; {old.source.manifest.version} goes on")
        self._is_changed = True
        return {"active": self.version}

    # --- What others see --------------------------------------------------------------------------------------------------

    def _renew(self, running: Running) -> None:
        """Verbs, aliases and pace are those of this version."""
        declaration = declared(running.hello, self._declaration.path if self._place.beside else "")
        if declaration.rate_hz != self._declaration.rate_hz:
            self._pace = Pace(declaration.rate_hz)
        self._declaration = declaration
        self._meant.clear()
        try:
            self.renew(declaration)
        except FailoverError as error:
            self._note(f"its names were not told: {error}")

    def _record(self, change: Callable[[Shelf], Shelf]) -> Shelf | None:
        """Change the shelf, for programs that have one; the shelf before that.

        Raises:
            ProgramError: it cannot be written.
        """
        if self._place.directory is not None or self._place.beside:
            return None
        store = self._place.store
        try:
            with store.locked():
                earlier = store.shelf(self._place.name)
                store.put(change(earlier), is_lasting=False)
        except OSError as error:
            raise ProgramError(f"cannot write the versions of {self._place.name} in {store.place}: {error.strerror}") from error
        self._is_shelf_new = self._is_changed = self._is_unsettled = True
        return earlier

    def _settle(self) -> None:
        """Have the disk keep the shelf, without a wait: not between two messages, nor before an answer."""
        self._is_unsettled = False
        self._starter.aside(lambda: self._place.store.settle(self._place.name))

    def _record_anyway(self, change: Callable[[Shelf], Shelf]) -> None:
        """The same where what was done is done; a disk that is full is told."""
        try:
            self._record(change)
        except ProgramError as error:
            self._note(str(error))

    def _say(self, what: str) -> None:
        self._said = what
        self._note(what)

    def _note(self, what: str) -> None:
        log.info("%s: %s", self._place.name, what)
        self._place.store.log(self._place.name, what)

    def close(self) -> None:
        """End all processes; the state stays."""
        self._starter.end_soon()
        if self._running is not None and self._running.lives:
            try:
                self._running.pause()
                self._state = self._running.state
            except FailoverError as error:
                log.warning("%s", error)
        try:
            if not self._owed:
                self._write(is_lasting=True)
        except ProgramError as error:
            log.warning("%s", error)
        for one in (*self._starter.close(), self._running, self._old):
            if one is not None:
                one.end()


def _is_hosts(message: Envelope) -> bool:
    """Whether the host itself answers it."""
    return message.verb.startswith("_")


FAULTS: Final = frozenset(("unknown_verb", "bad_body", "bad_result", "failed"))
"""Kinds of errors that are a version's to say; others mean the host, and a sender obeys them."""


def _checked(message: Envelope, found: Answered) -> Answered:
    """A version says what came of a message; to whom that goes, and as what, is the host's."""
    said = found.answer
    if said.error is UNSET:
        anew = answer(message, None if said.ok is UNSET else said.ok)
    else:
        anew = refusal(message, said.error.kind if said.error.kind in FAULTS else "failed", said.error.sentence)
    return msgspec.structs.replace(found, answer=anew)


def _cut(one: Stream) -> Stream:
    answers = dict(list(one.answers.items())[-ANSWERS_KEPT:])
    return Stream(one.boot, one.last, one.reliable, answers)
