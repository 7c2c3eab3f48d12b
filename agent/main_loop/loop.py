"""The main loop: sends heartbeats and decides. Start reading the agent here.

One thread, one process, nothing else in it. A turn is: sleep until an input arrives or the core's deadline passes, read the clock
once, step the node, carry out its orders: persist → send → act. All slow work is elsewhere: the disk in a thread
(`agent.main_loop.vote_record_writer`), programs, snapshots and users' requests in the worker process (`agent.worker.process`).
The same turn feeds systemd's watchdog, so the watchdog proves this loop and nothing beside it.
"""

from __future__ import annotations

import gc
import logging
import os
import select
import signal
import socket
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

from msgspec import structs

from agent.config import Settings
from agent.core_config import node_config, team_config
from agent.errors import AgentError
from agent.main_loop import messages, starvation, vote_record
from agent.main_loop.beat_sockets import NOT_CAST, TURN_LIMIT, BeatLane
from agent.main_loop.departure import COMES_BACK, Departure, Next
from agent.main_loop.duplicate_beats import Copies
from agent.main_loop.event_log_writer import EventLogWriter
from agent.main_loop.media import Link, Media
from agent.main_loop.messages import (
    Alive,
    BeatCounts,
    Ends,
    Farewell,
    Happened,
    HearKey,
    Inventory,
    IsRestart,
    Life,
    LinkNow,
    LinksAre,
    SpeakKey,
    TeamIs,
    Told,
    ToMainLoop,
    ToWorker,
)
from agent.main_loop.outbox import NOTHING, Due, Outbox
from agent.main_loop.unauthenticated_beats import UnreadBeats
from agent.main_loop.vote_record_writer import VoteRecordWriter
from agent.main_loop.worker_process import WorkerProcess
from agent.system import clock, syscalls, timers
from agent.system.sd_notify import Notifier, watchdog_period_ns
from checkpoint.keeper.messages import ChannelClosedError, ChannelError
from failover.config.team import Robot
from failover.core import vote_record as core_vote_record
from failover.core.acts import Act
from failover.core.events import Event, Leave, Received, TeamChanged, Tick
from failover.core.frames.frame import Part, Portion, Reason, Refused
from failover.core.frames.lane import FrameLane
from failover.core.frames.lanes import FrameLanes, medium_of
from failover.core.frames.roster import Roster
from failover.core.node import Node
from failover.core.team_changes import elections
from failover.core.types import COORDINATOR
from failover.core.types import Config as CoreConfig
from failover.core.wire.messages import OTHER_SITES, Beat
from failover.errors import FailoverError

if TYPE_CHECKING:
    from agent.main_loop.board_link import BoardLink
    from agent.main_loop.coordinator_link import CoordinatorLink

NANOSECONDS_A_SECOND: Final = 1_000_000_000
SLEEP_LIMIT_S: Final = 0.5
"""The loop turns at least so often, whatever the core's deadline."""

PERSIST_PATIENCE_S: Final = 2.0
"""How long an orderly end waits for the disk."""

SIGNALS_MAX: Final = 64
"""Read at once; more of them say nothing new."""

GAP_BEATS: Final = 3
"""Periods of silence that count as a gap: one lost beat is none, and a lease is longer."""

REST_SHARE: Final = 3
"""While the main loop rests it reads beats so often in a lease: its echoes are fresh enough for one to be granted at once."""

REST_NS_MAX: Final = NANOSECONDS_A_SECOND // 20
"""With a longer lease, too: robots that are well are not to look suspect in the status."""

WORKER_SILENCE_NS: Final = 4 * NANOSECONDS_A_SECOND
"""How long the worker may say nothing; then another one takes its place. Meanwhile the guards' leases are not renewed."""

WORKER_LOOK_NS: Final = NANOSECONDS_A_SECOND
"""Between two looks at a worker that says nothing: longer than between two signs of life, which one that works gives."""

TURNS_NS: Final = NANOSECONDS_A_SECOND // 20
"""Turns within this time count as one: it is the sum that tells of a worker's silence."""

WORKER_BIRTH_NS: Final = 30 * NANOSECONDS_A_SECOND
"""The same before its first word: an interpreter starts."""

WORKER_TRIES: Final = 5
"""Workers that may die before their first word; then something is wrong that no restart cures."""

STARTED: Final = "protecting this robot and its neighbours"

NOT_AWAITED: Final = (
    "%s: the other robots have not promised to wait for the next agent: it stands still when its lease is over, and is taken "
    "over as after a loss"
)

UNLIKE: Final = (
    "{} has another team.toml: its heartbeats are read, and items of its board are not; copy the same file to both, and start "
    "their agents again"
)

OUTLIVED: Final = (
    "%s remembers life %d of %s, and %s counts %d: its state directory is new, or an old copy. Its votes and checkpoints since "
    "then are lost; it begins again as life %d"
)

log = logging.getLogger("failover.heart")


class MainLoop:
    """One life of one robot's agent."""

    def __init__(self, settings: Settings, record_file: vote_record.VoteRecordFile, notifier: Notifier) -> None:
        """Bind the beat sockets; nothing runs yet.

        Raises:
            LaneError: a beat address cannot be had.
        """
        self._settings = settings
        self._me = settings.config.robot
        self._record_file = record_file
        self._notifier = notifier
        self._beats = BeatLane(settings.me, settings.peers, settings.team.team)
        has_board, members = bool(settings.team.board.items), settings.team.roster_of_site(settings.me.site)
        self._frames = FrameLanes(self._lanes_for(members))
        self._media = Media(settings, self._beats, self._frames, members)
        self._links: tuple[LinkNow, ...] = ()
        self._beat: Beat | None = None
        self._has_board = has_board and settings.me.role == "robot"
        self._board: BoardLink | None = None
        self._etcd: CoordinatorLink | None = None
        self._round = self._round_ns = self._sent_ns = 0
        self._urgent_ns: int | None = None
        self._is_told = False
        self._unread = UnreadBeats({name: robot.beats for name, robot in settings.peers.items()})
        self._worker = WorkerProcess(settings)
        self._node: Node | None = None
        durable = core_vote_record.decode(record_file.record.core)
        self._outbox = Outbox(durable, settings.config.beat_ms * NANOSECONDS_A_SECOND // 1_000)
        self._persister = VoteRecordWriter(lambda wanted: record_file.keep(core_vote_record.encode(wanted)))
        self._event_log = EventLogWriter(Path(settings.config.state_directory), self._me, record_file.record.boot)
        self._poll = select.epoll()
        self._inputs: dict[int, Callable[[], None]] = {}
        self._alarm = timers.Alarm()
        self._wake, self._signalled = socket.socketpair(
            socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK | socket.SOCK_CLOEXEC
        )
        self._ending = self._rests = False
        self._departure = Departure(settings.config.restart_grace_s * NANOSECONDS_A_SECOND)
        self._listens = True
        self._deaf_until_ns = 0
        self._read_ns = 0
        self._rest_ns = min(settings.config.lease_ms * NANOSECONDS_A_SECOND // 1_000 // REST_SHARE, REST_NS_MAX)
        self._worker_deaths = 0
        self._turned_ns = clock.now_ns()
        self._worker_silent_ns = self._worker_unseen_ns = 0
        self._worker_allowed_ns = WORKER_BIRTH_NS
        self._worker_turns: starvation.Turns | None = None
        self._refused: Counter[str] = Counter()
        self._sent = self._heard = self._late_us_max = self._gap_us_max = self._gaps = 0
        self._heard_at: dict[str, int] = {}
        self._copies = Copies()
        self._newest_part: dict[tuple[str, int], tuple[int, int]] = {}
        self._unlike: set[str] = set()
        self._other_sites: set[str] = set()
        self._lost: Counter[str] = Counter()
        self._notes: tuple[str, ...] = ()
        self._remembered = 0

    def _lanes_for(self, members: Roster) -> Callable[[int], FrameLane]:
        settings, boot = self._settings, self._record_file.record.boot
        round_us, has_board = settings.config.beat_ms * 1_000, bool(settings.team.board.items)
        return lambda medium: FrameLane(self._me, settings.team.team, members, boot, round_us, medium, bounds_ways=has_board)

    def run(self) -> int:
        """Beat until SIGTERM, SIGINT or `COMES_BACK`. Components live on; where another agent starts at once, they also act on.

        Returns:
            0; or the life of this robot that the team remembers and its vote record does not: another one above it must begin.

        Raises:
            AgentError: the worker cannot be started at all.
        """
        self._begin()
        watchdog_ns = watchdog_period_ns()
        fed_ns = clock.now_ns()
        while not self._ending:
            self._turn()
            now_ns = clock.now_ns()
            if watchdog_ns and now_ns - fed_ns >= watchdog_ns and self._node is not None:
                self._notifier.alive()
                fed_ns = now_ns
            if self._departure.is_restart and (needs_s := self._departure.needs_s(now_ns)):
                self._notifier.needs(needs_s)
        if not self._remembered:
            self._notifier.stopping()
        self._end()
        return self._remembered

    def _begin(self) -> None:
        for number in (signal.SIGTERM, signal.SIGINT, COMES_BACK):
            signal.signal(number, lambda *_: None)
        signal.set_wakeup_fd(self._signalled.fileno(), warn_on_full_buffer=False)
        self._attend(self._beats.fileno(), self._hear)
        self._attend(self._persister.fileno(), self._note_persisted)
        self._attend(self._wake.fileno(), self._heed_signals)
        self._poll.register(self._alarm.fileno(), select.EPOLLIN)
        gc.collect()
        syscalls.give_back()  # before memory is locked: then it would stay
        if self._settings.config.realtime:
            self._notes = clock.become_realtime()
        self._start_worker()  # told what was refused
        gc.freeze()
        gc.disable()  # what a turn makes is freed by reference counts; a collection would be a pause of milliseconds

    def _attend(self, descriptor: int, input_: Callable[[], None]) -> None:
        """Call that whenever the descriptor is readable."""
        self._poll.register(descriptor, select.EPOLLIN)
        self._inputs[descriptor] = input_

    def _neglect(self, descriptor: int) -> None:
        self._poll.unregister(descriptor)
        del self._inputs[descriptor]

    def _heed_signals(self) -> None:
        numbers = self._wake.recv(SIGNALS_MAX)
        self._depart(Next.END if self._node is None else self._departure.signalled(numbers, clock.now_ns()))

    def _depart(self, step: Next) -> None:
        match step:
            case Next.ASK:
                self._worker.send(IsRestart())
            case Next.ANNOUNCE:
                self._step(Leave())
            case Next.END:
                self._ending = True

    def _may_end(self, node: Node) -> bool:
        """Whether an end that was asked for need not wait any more; what stands still then is named."""
        now_ns, is_restart = clock.now_ns(), self._departure.is_restart
        if not self._departure.may_end(is_restart and node.may_go(now_ns), self._outbox.waiting, now_ns):
            return False
        exposed = dict.fromkeys((*node.exposed(now_ns), *self._outbox.unleased)) if is_restart else {}
        if exposed:
            log.warning(NOT_AWAITED, ", ".join(exposed))
        return True

    def _open_board(self) -> None:
        """Map the board that the worker has made; a robot without its board still protects its programs."""
        self._close_board()
        if not self._has_board:
            return
        from agent.main_loop.board_link import BoardLink  # here: a team without a board does not load it
        from failover.boards.directory import agents_place

        try:
            self._board = BoardLink.open(
                agents_place(self._settings.team.team, self._me), self._media.round_ns, self._settings.far
            )
        except (FailoverError, OSError) as error:
            log.warning("frames carry no items: %s", error)  # the worker says in status why there is no board
            return
        if self._board.wakes.fileno() >= 0:
            self._attend(self._board.wakes.fileno(), self._note_urgent)

    def _close_board(self) -> None:
        if self._board is not None:
            if self._board.wakes.fileno() >= 0:
                self._neglect(self._board.wakes.fileno())
            self._board.close()
        self._board, self._urgent_ns, self._is_told = None, None, False

    def _start_worker(self) -> None:
        """Start the other process; the node is born, or told what was lost, when its inventory comes."""
        self._worker.start()
        self._expect_worker()

    def _expect_worker(self) -> None:
        self._worker_spoke(WORKER_BIRTH_NS << self._worker_deaths)  # a machine so busy gets no busier
        self._attend(self._worker.fileno(), self._listen_to_worker)
        self._worker.send(Life(self._record_file.record.boot, os.getpid(), self._notes))

    def _turn(self) -> None:
        """Sleep, then one round of everything that came, then the core's deadline."""
        self._worker.flush()
        self._rest()
        self._alarm.set(self._wakes_ns())
        came = self._poll.poll(SLEEP_LIMIT_S)
        if self._rests and clock.now_ns() >= self._read_ns + self._rest_ns:
            self._hear()
        for descriptor, _ in came:
            if descriptor in self._inputs:  # not the alarm, nor what was closed in this turn
                self._inputs[descriptor]()
        if self._urgent_ns is not None and self._board is not None and clock.now_ns() >= self._urgent_ns:
            self._send_urgent(self._board, clock.now_ns())
        if self._media.is_slotted:
            self._take_slots()
        now_ns = clock.now_ns()
        if now_ns - self._turned_ns >= TURNS_NS:
            self._watch_worker(now_ns)
        if self._node is not None:
            late_ns = now_ns - self._node.next_deadline_ns()
            if late_ns >= 0:
                self._late_us_max = max(self._late_us_max, late_ns // 1_000)
                self._step(Tick())
        if self._etcd is not None and self._node is not None:
            self._ask_etcd(self._etcd, self._node, now_ns)
        if self._departure.is_begun and self._node is not None:
            self._ending = self._ending or self._may_end(self._node)

    def _open_etcd(self, config: CoreConfig) -> None:
        """Begin to ask etcd, or tell its process of a team that has changed."""
        if self._etcd is not None:
            self._etcd.change(config)
        elif config.coordinator:
            from agent.main_loop.coordinator_link import CoordinatorLink  # here: a team that does not need it does not load it

            self._etcd = CoordinatorLink(self._settings, config)
            self._start_etcd(self._etcd)

    def _start_etcd(self, etcd: CoordinatorLink) -> None:
        if etcd.start(clock.now_ns()):
            self._attend(etcd.fileno(), self._hear_etcd)

    def _ask_etcd(self, etcd: CoordinatorLink, node: Node, now_ns: int) -> None:
        """Begin a round with all that this robot holds, once it is on the disk."""
        if etcd.is_hung(now_ns):
            self._neglect(etcd.fileno())
            etcd.stop(now_ns)
        if etcd.is_over(now_ns):
            self._start_etcd(etcd)
        if etcd.wants_word and not self._outbox.waiting:
            etcd.look(node.word(), now_ns)

    def _hear_etcd(self) -> None:
        etcd, now_ns = self._etcd, clock.now_ns()
        if etcd is None:
            return
        descriptor = etcd.fileno()
        beat = etcd.receive(now_ns)
        if etcd.has_ended:
            self._neglect(descriptor)
        if beat is not None:
            self._step(Received(beat, COORDINATOR, paces=False))

    def _rest(self) -> None:
        """While there is no component anywhere, what peers say is read a few times a lease only: half the turns, less in each.

        In a flood of what is refused the main loop leaves half of the time to others: it runs before all ordinary processes.
        """
        if self._board is not None and self._listens and not self._rests and self._deaf_until_ns <= self._read_ns:
            return  # it has no leisure, and stays as it is
        now_ns = clock.now_ns()
        has_leisure = self._node is not None and self._board is None and not self._media.is_slotted
        self._rests = has_leisure and self._node is not None and self._node.rests(now_ns)
        listens = not self._rests and now_ns >= self._deaf_until_ns
        if listens != self._listens:
            self._listens = listens
            self._poll.modify(self._beats.fileno(), select.EPOLLIN if listens else 0)

    def _watch_worker(self, now_ns: int) -> None:
        """Count how long the worker says nothing.

        A turn of our own that took long proves nothing about it, and neither does a time in which the kernel kept it from
        running: another one in its place would say as little.
        """
        self._worker_unseen_ns += min(now_ns - self._turned_ns, int(SLEEP_LIMIT_S * NANOSECONDS_A_SECOND))
        self._turned_ns = now_ns
        if self._worker_unseen_ns < WORKER_LOOK_NS:
            return
        before, self._worker_turns = self._worker_turns, starvation.look(self._worker.pid)
        self._worker_silent_ns += starvation.had_ns(before, self._worker_turns, self._worker_unseen_ns)
        self._worker_unseen_ns = 0
        if self._worker_silent_ns > self._worker_allowed_ns:
            self._replace_worker(f"it was silent for {self._worker_silent_ns / NANOSECONDS_A_SECOND:.0f} s of processor time")

    def _worker_spoke(self, allowed_ns: int) -> None:
        """The worker's silence counts from now on, and may last so long."""
        self._worker_silent_ns = self._worker_unseen_ns = 0
        self._worker_turns, self._worker_allowed_ns = None, allowed_ns

    def _wakes_ns(self) -> int | None:
        """When the next turn is due, whatever comes; None while the node is not born yet."""
        if self._node is None:
            return None
        deadline_ns = self._node.next_deadline_ns()
        if self._urgent_ns is not None:
            deadline_ns = min(deadline_ns, self._urgent_ns)
        if self._etcd is not None and not self._outbox.waiting:  # while something waits for the disk, no word leaves
            deadline_ns = min(deadline_ns, self._etcd.next_ns())
        slot_ns = self._media.wakes_ns()
        if slot_ns is not None and self._beat is not None:
            deadline_ns = min(deadline_ns, slot_ns)
        return deadline_ns if self._listens or self._rests else min(deadline_ns, self._deaf_until_ns)

    # --- events in ---

    def _step(self, event: Event) -> None:
        if self._node is not None:
            now_ns = clock.now_ns()
            ready = self._node.step(event, now_ns)
            due = self._outbox.take(ready, now_ns)
            if due is not NOTHING:
                if self._departure.is_restart and due.beats and self._outbox.waiting:
                    self._node.left_without_promises(due.beats[-1].counter)
                self._obey(due)
            if ready.told:
                self._event_log.note(ready.told)

    def _hear(self) -> None:
        self._read_ns = clock.now_ns()
        taken = refused = 0
        for frame, link, wall_ns, sender, place in self._beats.receive():
            taken += 1
            now_ns, came_ns = clock.now_and_arrival_ns(wall_ns)
            opened, is_cast = self._frames.open(frame, came_ns), place != NOT_CAST
            if not isinstance(opened, Refused):
                if self._board is not None:
                    self._board.take(opened, came_ns)  # first: programs wait for it
                self._copies.heard(opened.part, link, cast=is_cast)
                self._note_way(opened.part, link, place, len(frame), came_ns)
                counts_ns = self._counts_from_ns(now_ns, came_ns) if self._rests else 0
                self._take_part(opened.part, link, now_ns, counts_ns)
            elif self._copies.admit(opened, link, now_ns, medium=medium_of(frame), cast=is_cast):
                self._note_way_of_copy(opened, link, place, frame)
            else:
                self._refused[str(opened.reason)] += 1
                refused += 1
                if sign := self._unread.of_beat(opened, sender, clock.now_ns()):
                    self._step(sign)
        if taken >= TURN_LIMIT and refused > taken // 2:
            self._deaf_until_ns = 2 * clock.now_ns() - self._read_ns

    def _note_way(self, part: Part, link: str, place: int, size: int, came_ns: int) -> None:
        """By which link a part came, and whether it was cast; what it says of slots."""
        self._media.heard(part.sender, link, size, came_ns)
        if place != NOT_CAST:
            self._media.heard_cast(place, part.medium, part.rank, part.boot, part.counter)
        if part.slots is not None and part.medium:
            self._media.heard_slots(part, link, came_ns)

    def _note_way_of_copy(self, copy: Refused, link: str, place: int, frame: bytes) -> None:
        """The same of a copy of a part that was believed."""
        self._media.heard(copy.sender, link, len(frame), self._read_ns)
        if place != NOT_CAST:
            self._media.heard_cast_copy(place, medium_of(frame), copy.sender, copy.counter)

    def _take_part(self, part: Part, link: str, now_ns: int, came_ns: int) -> None:
        self._count_part(part)
        beat = part.beat
        if beat is not None:
            self._count_beat(beat, came_ns or now_ns)
            self._mind_earlier_lives(beat)
            if beat.sender in self._other_sites:
                beat = structs.replace(beat, rule=OTHER_SITES)
            paces = not came_ns and link not in self._media.wireless
            self._step(Received(beat, link, self._copies.take(beat.sender), came_ns, paces))

    def _counts_from_ns(self, now_ns: int, came_ns: int) -> int:
        """When a beat came that waited because this main loop rests: its sender was not late. 0: now, or a stall of ours."""
        return came_ns if now_ns - came_ns <= self._rest_ns + self._outbox.beat_ns else 0

    def _mind_earlier_lives(self, beat: Beat) -> None:
        """A peer that remembers a later life of ours believes none of our beats: begin one above that."""
        life = self._node.outlived_by(beat) if self._node is not None else 0
        if life:
            told = (beat.sender, life, self._me, vote_record.FILE_NAME, self._record_file.record.boot, life + 1)
            log.warning(OUTLIVED, *told)
            self._remembered, self._ending = life, True

    def _count_part(self, part: Part) -> None:
        """Note how many parts of the peer's frames were lost before this one, and whether its ranks are ours."""
        peer, lane = part.sender, (part.sender, part.medium)
        boot, counter = self._newest_part.get(lane, (part.boot, part.counter - 1))
        missing = part.counter - counter - 1 if part.boot == boot else 0
        if missing:
            self._lost[peer] += max(missing, -1)  # one that comes late was counted as lost
        if part.boot != boot or missing >= 0:
            self._newest_part[lane] = (part.boot, part.counter)
        if not part.alike:
            self._unlike.add(peer)
        elif self._unlike:
            self._unlike.discard(peer)

    def _count_beat(self, beat: Beat, now_ns: int) -> None:
        """Note how long the peer was silent before this beat."""
        peer = beat.sender
        gap_us = (now_ns - self._heard_at.get(peer, now_ns)) // 1_000
        self._heard_at[peer] = now_ns
        self._heard += 1
        self._gap_us_max = max(self._gap_us_max, gap_us)
        self._gaps += gap_us > GAP_BEATS * self._settings.config.beat_ms * 1_000

    def _note_persisted(self) -> None:
        for number, durable in self._persister.finished():
            self._obey(self._outbox.kept(number, durable, clock.now_ns()))

    def _note_urgent(self) -> None:
        """A program told of an urgent put. Until that is seen to, it may tell as often as it likes: the loop does not listen."""
        board, now_ns = self._board, clock.now_ns()
        if board is None:
            return
        due_ns = board.urgent_due_ns(self._sent_ns)
        if now_ns >= due_ns:
            self._send_urgent(board, now_ns)
            return
        board.wakes.heed()
        self._urgent_ns = due_ns
        self._poll.modify(board.wakes.fileno(), 0)
        self._is_told = True

    def _listen_to_worker(self) -> None:
        try:
            for message in self._worker.receive():
                self._worker_spoke(WORKER_SILENCE_NS)
                self._heed(message)
        except (ChannelClosedError, ChannelError) as error:
            self._replace_worker(str(error))

    def _heed(self, message: ToMainLoop) -> None:
        match message:
            case Happened():
                event = messages.event_of(message)
                self._worker.answered(event)
                self._step(event)
            case Inventory():
                self._take_inventory(message)
            case SpeakKey(peer, key):
                self._frames.speak(peer, key)
            case HearKey(peer, key, knows_other_sites):
                self._frames.hear(peer, key)
                (self._other_sites.add if knows_other_sites else self._other_sites.discard)(peer)
            case LinksAre(links):
                self._links = links
                self._media.take(links, clock.now_ns())
            case TeamIs(robots):
                self._take_team(robots)
            case Ends(is_restart):
                self._depart(self._departure.answered(is_restart, clock.now_ns()))
            case Alive():
                pass
            case _:
                self._worker.send(self._told(message))

    def _take_team(self, robots: dict[str, Robot]) -> None:
        """Between two turns: send to these members, hear these, and decide with these."""
        before = self._settings.team.robots
        if robots == before or self._me not in robots:
            return
        settings = self._settings = self._settings.with_robots(robots)
        for name in settings.peers:
            if name in before and set(before[name].keys) - set(robots[name].keys):
                self._frames.forget_older(name)
        if {name: robot.keyless for name, robot in robots.items()} == {name: robot.keyless for name, robot in before.items()}:
            if self._board is not None:
                self._open_board()  # the worker has looked at each file, and made anew what a user had damaged
            return  # other keys of the connections, which are the worker's
        members = settings.team.roster_of_site(settings.me.site)
        self._beats.know(settings.peers)
        self._frames.change(members, self._lanes_for(members))
        self._media = Media(settings, self._beats, self._frames, members)
        self._media.take(self._links, clock.now_ns())
        self._unread = UnreadBeats({name: robot.beats for name, robot in settings.peers.items()})
        self._unlike.intersection_update(robots)
        self._other_sites.intersection_update(robots)
        if self._board is not None:
            self._open_board()  # the worker has made the files of those that came
        changed = team_config(settings)
        self._step(TeamChanged(changed))
        self._open_etcd(changed)
        log.info("the team is %s now", ", ".join(sorted(robots)))

    def _take_inventory(self, inventory: Inventory) -> None:
        """The node is born with what was found; a node that lives already is told what the old worker took with it."""
        self._worker_deaths = 0
        self._open_board()
        if self._node is not None:
            for event in self._worker.lost(inventory):
                self._step(event)
            return
        self._worker.ready()
        boot = self._record_file.record.boot
        config = node_config(self._settings)
        durable = self._outbox.durable
        self._node = Node(config, boot, durable, clock.now_ns(), inventory.held, inventory.found)
        self._open_etcd(config)
        self._notifier.ready(STARTED)
        log.info("robot %s sends heartbeats, life %d", self._me, boot)

    def _replace_worker(self, why: str) -> None:
        """Start another worker; one that never gets as far as an inventory is not tried for ever.

        Raises:
            AgentError: `WORKER_TRIES` of them died at once.
        """
        self._worker_deaths += 1
        if self._worker_deaths > WORKER_TRIES:
            raise AgentError(f"the worker process ended {WORKER_TRIES} times at once ({why}); its last words stand above")
        log.error("the worker process is gone (%s); guards and programs run on, and another worker starts", why)
        self._neglect(self._worker.fileno())
        self._worker.replace()
        self._expect_worker()

    # --- obligations out ---

    def _obey(self, due: Due) -> None:
        """Persist, send, act: what is due of each."""
        if due.persist is not None:
            self._persister.submit(*due.persist)
        for beat in due.beats:
            self._send(beat)
            self._sent += 1
        for act in due.acts:
            self._act(act)

    def _send(self, beat: Beat) -> None:
        """A beat, and the items whose round it is: a beat that leaves earlier, because something changed, begins no round.

        Where robots take turns the beat waits for this robot's slot; a newer one takes its place. To the others it is as late as
        one that the network held up.
        """
        now_ns = clock.now_ns()
        self._beat = beat
        if self._node is not None and self._media.all_wait(now_ns):
            self._node.waits(beat)
        if self._board is None or now_ns - self._round_ns <= self._outbox.beat_ns // 2 or not self._media.paces(now_ns):
            self._send_frame(beat, (), now_ns)
            return
        self._begin_round(self._board, now_ns)
        items = self._board.due(self._round, now_ns)
        if not self._media.at_once:
            items += self._urgent_besides(self._board, items, now_ns)
        self._board.placed(items, self._send_frame(beat, items, now_ns))
        if self._urgent_ns is None and self._media.at_once and self._board.has_urgent():  # its wake-up was lost
            self._urgent_ns = self._board.urgent_due_ns(self._sent_ns)

    def _begin_round(self, board: BoardLink, now_ns: int) -> None:
        self._round, self._round_ns = self._round + 1, now_ns
        lease_ns = self._settings.config.lease_ms * NANOSECONDS_A_SECOND // 1_000
        board.tell_states(now_ns, lease_ns, lambda peer: self._media.round_of(peer, now_ns))
        board.tell_primaries(self._node.primaries() if self._node is not None else {}, now_ns)

    def _send_urgent(self, board: BoardLink, now_ns: int) -> None:
        """Items that cannot wait for their round, without a beat. Where robots take turns they wait for this robot's slot.

        They leave first; what is to be noted for the next put is noted afterwards.
        """
        self._urgent_ns = None
        if self._media.at_once:
            items = board.urgent(now_ns)
            if items:
                board.went(items[: self._send_frame(None, items, now_ns)])
        else:
            board.leave_for_slot(now_ns)
        if board.seen_to():
            self._urgent_ns = board.urgent_due_ns(self._sent_ns)
        if self._is_told:
            self._is_told = False
            self._poll.modify(board.wakes.fileno(), select.EPOLLIN)

    def _send_frame(self, beat: Beat | None, items: Sequence[Portion], now_ns: int) -> int:
        """One frame, to everybody over every link where none waits for a slot; how many of the items are in it."""
        patience_ns = self._rest_ns if self._rests else 0
        self._sent_ns = now_ns
        return self._media.send(beat, items, now_ns, self._round, patience_ns=patience_ns)

    def _take_slots(self) -> None:
        """Send where it is this robot's turn; what has come before may move the turn, so it is read first."""
        slot_ns = self._media.wakes_ns()
        if slot_ns is None or self._beat is None or clock.now_ns() < slot_ns:
            return
        self._hear()
        for link in self._media.due():
            self._send_in_slot(link, self._beat)
            if self._node is not None:
                self._node.waits(None)

    def _send_in_slot(self, link: Link, beat: Beat) -> None:
        """The newest beat, and the items whose round was since the last slot here."""
        if self._board is None:
            self._media.send_in_slot(link, beat, (), self._round)
            return
        now_ns = clock.now_ns()
        if not self._media.at_once and self._media.is_first(link):
            self._begin_round(self._board, now_ns)
        items = self._board.due(self._round, now_ns, link.number, link.turned)
        items += self._urgent_besides(self._board, items, now_ns, link.number)
        link.turned = self._round
        self._board.placed(items, self._media.send_in_slot(link, beat, items, self._round), link.number)

    def _urgent_besides(self, board: BoardLink, items: Sequence[Portion], now_ns: int, medium: int = 0) -> list[Portion]:
        """Urgent items that waited for this frame, besides those that are due."""
        numbers = {item.number for item in items}
        return [item for item in board.urgent(now_ns, medium) if item.number not in numbers]

    def _act(self, act: Act) -> None:
        self._worker.order(act)

    def _told(self, question: messages.Ask) -> ToWorker:
        now_ns = clock.now_ns()
        if question.what == "elections":
            return Told(question.number, now_ns, elections=elections(self._outbox.durable))
        refused = Counter(self._refused)
        refused[str(Reason.NOT_OURS)] += self._beats.dropped()
        counts = BeatCounts(
            self._sent,
            self._heard,
            self._beats.unsent,
            dict(+refused),
            self._late_us_max,
            self._gap_us_max,
            self._gaps,
            dict(self._lost),
            self._items_left_out(),
        )
        unlike = map(UNLIKE.format, sorted(self._unlike))
        etcd = self._etcd.trouble if self._etcd is not None else ""
        sentences = (self._persister.trouble, self._event_log.trouble, etcd, *unlike, *self._media.troubles())
        troubles = tuple(filter(None, sentences))
        if question.what == "why":
            return Told(question.number, now_ns, unwritten=self._event_log.unwritten(), beats=counts, troubles=troubles)
        status = self._node.status(now_ns) if self._node is not None else None
        return Told(question.number, now_ns, status, beats=counts, troubles=troubles, media=self._media.views())

    def _items_left_out(self) -> dict[str, int]:
        """Values that were not taken, by reason, and those that waited."""
        left_out = self._board.left_out() if self._board is not None else Counter()
        return dict(sum((lane.assembly.dropped for lane in self._frames.all()), left_out))

    def _end(self) -> None:
        self._worker.send(Farewell())
        self._worker.flush()
        self._persister.close(PERSIST_PATIENCE_S)
        self._event_log.close(PERSIST_PATIENCE_S)
        self._worker.wait()
        self._beats.close()
        if self._etcd is not None:
            self._etcd.close()
        self._close_board()
        self._alarm.close()
        self._poll.close()
        signal.set_wakeup_fd(-1)
        log.info("robot %s %s; its components live on", self._me, "restarts" if self._departure.is_restart else "ends")


def beat(settings: Settings, notifier: Notifier) -> None:
    """Live one life, from the vote record to the farewell; and another, if the team remembers a later one than it does.

    Raises:
        AgentError: what is needed to begin cannot be had.
    """
    directory = Path(settings.config.state_directory)
    try:
        directory.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        raise AgentError(
            f"cannot use the state directory {directory}: {error.strerror}; name another in state_directory"
        ) from error
    record_file = vote_record.VoteRecordFile(directory, settings.config.robot)
    record_file.open()
    while remembered := MainLoop(settings, record_file, notifier).run():
        record_file.outlive(remembered)
        record_file.open()
