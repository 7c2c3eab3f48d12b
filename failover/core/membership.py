"""Membership: which robots live, which hear each other, and for how long a heartbeat lets its sender act.

A peer is *suspect* when heartbeats are missing. It is *dead* when it was silent on all links for longer than any lease it may
still act on, and for as much longer as its heartbeats have lately come late. Invariants: a peer's counter and boot only grow; a
lease counts from the question (the instant this robot's heartbeat left), never from the answer; lateness of this robot's own loop
makes peers look silent and is subtracted before any peer is judged; a promise to wait for a peer whose agent restarts is kept to
its end, whatever is heard since.
"""

from __future__ import annotations

from collections import deque

from msgspec import Struct, field

from failover.core.event_log.decisions import Sighting
from failover.core.types import COMPONENTS_MAX, MS, Awaited, Config, PeerView, State
from failover.core.wire.messages import RETURNED, RULES, Beat, Echo, Entry, Promise
from failover.core.wire.names import weight

ASKED_MAX = 512
"""Beats of ours whose instant of leaving is remembered; ten seconds of them at 20 ms."""

AWAY_LOYALTIES = 2
"""A silence of so many loyalties is no lateness of a beat."""

DEAF_LOYALTIES = 2
"""Loyalties for which a peer that we hear may show no sign of hearing us."""

UNSTEADY_BEATS = 512
"""Beats after which a lateness that was seen counts for a third still: five seconds at 10 ms."""

UNSTEADY_FACTOR = 2
"""The margin is so many times the lateness that was seen: the next one may be longer."""

UNREAD_NS = 10_000 * MS
"""A sign of a member that cannot be authenticated proves for so long that its robot lives: its agent connects every 2 s."""

LATE_BEATS = 64
"""A beat that is older than the newest one by so many is of another day: as many as one medium's window of counters lets come.

Each medium has a window of its own, so a recorded frame of a medium that this robot never heard is authentic, and new there.
"""

PROMISES_MAX = 8
"""In one beat: agents that restart at once beyond that are not waited for."""

SUSPECT_BEATS = 3
"""Beats that may be missing before a peer is called suspect."""


UNREAD = "its beats are sealed with a key that this robot was not given"
"""Why, where nothing else is known."""


class _Known(Struct):
    """The entry of one component in one beat."""

    entry: Entry
    counter: int


class Peer(Struct):
    """All that one peer has told us.

    Attributes:
        heard_ns: when its newest beat came (before the first: of our own birth); an older one that comes later proves no life.
        since_ns: when its present life was heard first.
        echoed: counter of the newest beat of our present life that it lets us act on, 0 for none; ``asked_ns``: when it left.
        heard_us_ns: when the newest beat of ours left that it has heard.
        told_ns: when we last let it act on a beat of its own.
        settled: see ``messages.Beat``.
        unsteady_ns: how late its beats come at worst, lately: silence beyond a period.
        at_odds: number of its rule, where that is not ours, or `OTHER_SITES`: it is known to live, and nothing else it says
            counts.
        unread_ns: when something last came from it that could not be authenticated, 0 for never since its last beat;
            ``unread_why``: what is wrong.
        loyal_until_ns: `Membership.loyal_until_ns`, counted when something of it changes: it is asked for several times a step.
        awaited_until_ns: until when we have promised not to replace it, because its agent restarts; ``awaited_ms``: what we
            granted, without the margin; ``awaited``: (boot, counter) of its newest beat that asked, (boot, 0) if an earlier life
            of ours heard that; ``is_asked``: else our agent restarts, and it acts on our word. promised_ns: until when
            it has promised not to replace us.
    """

    robot: str
    heard_ns: int
    boot: int = 0
    since_ns: int = 0
    asked_ns: int = 0
    heard_us: int = 0
    heard_us_ns: int = 0
    told_ns: int = 0
    counter: int = 0
    echoed: int = 0
    settled: int = 0
    unsteady_ns: int = 0
    at_odds: int = 0
    total: int = 0
    load: int = 0
    drained: bool = False
    unread_ns: int = 0
    unread_why: str = ""
    loyal_until_ns: int = 0
    awaited_until_ns: int = 0
    awaited_ms: int = 0
    awaited: tuple[int, int] = (0, 0)
    is_asked: bool = False
    promised_ns: int = 0
    links: dict[str, int] = field(default_factory=dict)
    entries: dict[str, _Known] = field(default_factory=dict)

    def entry(self, component: str) -> Entry | None:
        """Its entry for a component, if that is fresh enough to act on."""
        known = self.entries.get(component)
        return known.entry if known and known.counter >= self.settled else None

    @property
    def complete(self) -> bool:
        """Every entry that it has is known and fresh: a component missing here is missing there."""
        fresh = sum(known.counter >= self.settled for known in self.entries.values())
        return self.boot > 0 and not self.at_odds and fresh >= self.total

    def take(self, beat: Beat, own: tuple[str, int], link: str, now_ns: int, rule: int = 0) -> tuple[Entry, ...]:
        """Note a beat; returns the entries that are news. ``own``: our name and boot count; ``rule``: ours, 0 for any."""
        if beat.boot < self.boot or (beat.boot == self.boot and beat.counter + LATE_BEATS <= self.counter):
            return ()
        if beat.boot > self.boot:
            self.boot, self.counter, self.echoed, self.heard_us, self.settled = beat.boot, 0, 0, 0, 0
            self.entries.clear()
            self.since_ns = now_ns
        self.links[link] = now_ns
        is_newest = beat.counter > self.counter
        if is_newest:
            self.counter, self.heard_ns = beat.counter, max(self.heard_ns, now_ns)
            self.unread_ns, self.unread_why = 0, ""
        self.at_odds = beat.rule if 0 not in (rule, beat.rule) and beat.rule != rule else 0
        if self.at_odds:
            self.entries.clear()
            return ()
        self._echoes(beat, own)
        if is_newest:
            self.settled, self.total, self.load, self.drained = beat.settled, beat.total, beat.load, beat.drained
        return tuple([entry for entry in beat.entries if self._news(entry, beat.counter)]) if beat.entries else ()

    def timed(self, late_ns: int) -> None:
        """A beat came so much later than a period after the one before; a lateness seldom seen again is forgotten."""
        self.unsteady_ns = max(late_ns, self.unsteady_ns - self.unsteady_ns // UNSTEADY_BEATS - 1, 0)

    def carried(self, copies: tuple[tuple[str, int], ...]) -> None:
        """Links over which copies of its beats came; whether it lives is for the first of each beat to say."""
        for link, at_ns in copies:
            self.links[link] = max(self.links.get(link, at_ns), at_ns)

    def _echoes(self, beat: Beat, own: tuple[str, int]) -> None:
        me, boot = own
        for echo in beat.echoes:
            if echo.robot == me and echo.boot == boot:
                self.echoed = max(self.echoed, echo.counter)
                self.heard_us = max(self.heard_us, abs(echo.counter))

    def _news(self, entry: Entry, counter: int) -> bool:
        known = self.entries.get(entry.name)
        if known is None and len(self.entries) >= COMPONENTS_MAX:
            return False
        if known is not None and known.counter >= counter:
            return False
        self.entries[entry.name] = _Known(entry, counter)
        return True


class Membership:
    """The team, as one robot hears it."""

    def __init__(self, config: Config, boot: int, now_ns: int, awaited: tuple[Awaited, ...] = ()) -> None:
        """
        Args:
            awaited: promises of an earlier life of ours: kept from now on, which is longer.
        """
        self._own = (config.robot, boot)
        self._born_ns = now_ns
        self._configure(config)
        self._asked: deque[tuple[int, int]] = deque(maxlen=ASKED_MAX)
        self._stranger_ns = 0
        self.sites_heard = False
        self._former: dict[str, Peer] = {}
        self.peers = {robot: Peer(robot, now_ns) for robot in config.peers}
        for peer in self.peers.values():
            self._count_loyalty(peer)
        self._awaits = False
        for one in awaited:
            peer = self.peers.get(one.robot) or self._former.setdefault(one.robot, Peer(one.robot, now_ns))
            self._await(peer, one.ms, now_ns)
            peer.awaited, peer.is_asked = (one.boot, 0), one.is_asked

    def _configure(self, config: Config) -> None:
        self._config = config
        self._loyalty_ns, self._grace_ns = config.loyalty_ns, config.grace_ns
        self._elects = config.by_majority
        self._rule = RULES.index(config.rule)
        others = (peer for peer in config.peers if peer != config.coordinator)  # etcd hears no heartbeat and sends none
        lesser = (peer for peer in others if weight(peer) < weight(config.robot))
        self._before_us = tuple(sorted(lesser, key=weight))

    def change(self, config: Config, now_ns: int) -> None:
        """Go on with these peers. A new one is dead until it is heard; a former one is dead once its last lease is over.

        A new member cannot act on anything that this robot told it, so no grace is due to it, and no takeover waits for it. One
        that belonged to the team until just now can: what it was told and promised then holds to its end.
        """
        self._configure(config)
        known = self._former | self.peers
        self.peers = {robot: self.peers.get(robot) or self._newcomer(robot, now_ns) for robot in config.peers}
        self._former = {
            robot: peer for robot, peer in known.items() if robot not in config.peers and _bound_until_ns(peer) > now_ns
        }
        for peer in self.peers.values():
            self._count_loyalty(peer)

    def _newcomer(self, robot: str, now_ns: int) -> Peer:
        peer = Peer(robot, now_ns - self._grace_ns)
        if (former := self._former.get(robot)) is not None:
            peer.awaited_until_ns, peer.awaited_ms = _bound_until_ns(former), former.awaited_ms
            peer.awaited, peer.is_asked = (former.awaited[0], 0), former.is_asked
        return peer

    def hear(self, beat: Beat, link: str, now_ns: int) -> tuple[Entry, ...]:
        """Take in a beat; returns its entries that are news. A stranger's beat is none."""
        peer = self.peers.get(beat.sender)
        if peer is None:
            return ()
        self._time(peer, beat, now_ns)
        before = (peer.echoed, peer.heard_us)
        news = peer.take(beat, self._own, link, now_ns, self._rule)
        self._count_loyalty(peer)
        if beat.grace_ms and not peer.at_odds and (beat.boot, beat.counter) == (peer.boot, peer.counter):
            self._take_grace(peer, beat, now_ns)
        if beat.promises and not peer.at_odds:
            self._take_promises(peer, beat)
        if (peer.echoed, peer.heard_us) != before:
            peer.asked_ns = self._left_ns(peer.echoed)
            peer.heard_us_ns = peer.asked_ns if peer.heard_us == peer.echoed else self._left_ns(peer.heard_us)
        return news

    def _take_grace(self, peer: Peer, beat: Beat, now_ns: int) -> None:
        """A peer asks to be waited for: granted from the hearing, up to what this robot's operator allows; or it is back."""
        if beat.grace_ms == RETURNED and beat.boot > peer.awaited[0]:
            peer.awaited_until_ns = 0
        grace_ms = min(beat.grace_ms, self._config.restart_grace_ms)
        if grace_ms > 0:
            self._await(peer, grace_ms, now_ns)
            peer.awaited, peer.is_asked = (beat.boot, beat.counter), True

    def _await(self, peer: Peer, grace_ms: int, now_ns: int) -> None:
        """Promise it; one that was longer stays."""
        if now_ns < peer.awaited_until_ns:
            grace_ms = max(grace_ms, peer.awaited_ms)
        peer.awaited_ms = grace_ms
        peer.awaited_until_ns = max(peer.awaited_until_ns, now_ns + self._config.awaited_ns(grace_ms))
        self._awaits = True

    def promise_unasked(self, robot: str, now_ns: int) -> None:
        """This agent is about to restart, and a peer acts on its word: that one may go on until the next is there."""
        peer = self.peers[robot]
        peer.is_asked = peer.is_asked and now_ns < peer.awaited_until_ns
        self._await(peer, self._config.restart_grace_ms, now_ns)
        peer.awaited = (peer.boot, peer.counter)

    def _take_promises(self, peer: Peer, beat: Beat) -> None:
        """The promise counts from when our beat left that asked for it."""
        for promise in beat.promises:
            if (promise.robot, promise.boot) == self._own and (left_ns := self._left_ns(promise.counter)):
                grace_ms = min(promise.ms, self._config.restart_grace_ms)
                peer.promised_ns = max(peer.promised_ns, left_ns + grace_ms * MS)

    def awaited(self, now_ns: int) -> tuple[Awaited, ...]:
        """The promises that are not over, for the vote record."""
        if not self._awaits:
            return ()
        promised = (peer for peer in (*self.peers.values(), *self._former.values()) if peer.awaited_ms)
        running = (peer for peer in promised if now_ns < peer.awaited_until_ns)
        kept = tuple([Awaited(peer.robot, peer.awaited[0], peer.awaited_ms, peer.is_asked) for peer in running])
        self._awaits = bool(kept)
        return kept

    def promises(self, kept: tuple[Awaited, ...]) -> tuple[Promise, ...]:
        """Those that may be told: ``kept`` are on the disk, or will be before the beat leaves."""
        told = [self.peers[one.robot] for one in kept if one.robot in self.peers]
        fresh = [peer for peer in told if peer.awaited[0] == peer.boot and peer.awaited[1]]
        return tuple([Promise(peer.robot, *peer.awaited, peer.awaited_ms) for peer in fresh[:PROMISES_MAX]])

    def _time(self, peer: Peer, beat: Beat, now_ns: int) -> None:
        """Learn how late its beats come, as far as that widens the margin: more of it would only be forgotten later.

        A silence of two loyalties was no lateness: it was away.
        """
        silent_ns = now_ns - peer.heard_ns
        if beat.boot == peer.boot and beat.counter > peer.counter and silent_ns < AWAY_LOYALTIES * self._loyalty_ns:
            peer.timed(min(silent_ns - self._config.beat_ns, self._config.lease_ns // UNSTEADY_FACTOR))

    def _left_ns(self, counter: int) -> int:
        """When our beat of that number left, or the one before it; 0 if that is forgotten."""
        for number, at in reversed(self._asked):
            if number <= counter:
                return at
        return 0

    def asked(self, counter: int, now_ns: int) -> None:
        """Remember when our own beat left."""
        self._asked.append((counter, now_ns))

    def forgive(self, late_ns: int, now_ns: int) -> None:
        """Our own loop slept too long by ``late_ns``: words of peers from that time may still wait to be read."""
        for peer in self.peers.values():
            peer.heard_ns = min(peer.heard_ns + late_ns, now_ns)
            peer.told_ns = min(peer.told_ns + late_ns, now_ns)
            peer.heard_us_ns = min(peer.heard_us_ns + late_ns, now_ns)
            peer.since_ns = min(peer.since_ns + late_ns, now_ns)
            peer.unread_ns = min(peer.unread_ns + late_ns, now_ns) if peer.unread_ns else 0
            self._count_loyalty(peer)
            if now_ns - late_ns < peer.awaited_until_ns:
                longest_ns = now_ns + max(self._config.awaited_ns(peer.awaited_ms), self._config.loyalty_ns_max)
                peer.awaited_until_ns = min(peer.awaited_until_ns + late_ns, max(longest_ns, peer.awaited_until_ns))
        self._stranger_ns = min(self._stranger_ns + late_ns, now_ns) if self._stranger_ns else 0
        for peer in self._former.values():
            peer.loyal_until_ns += late_ns
            peer.awaited_until_ns += late_ns if now_ns - late_ns < peer.awaited_until_ns else 0
        self._born_ns += late_ns

    def loyal_until_ns(self, robot: str) -> int:
        """Until when this robot must not be replaced, as far as we know now.

        The lease and a margin: as long as its beats' lateness asks for, at least the configured one, at most another lease.
        """
        return self.peers[robot].loyal_until_ns

    def _count_loyalty(self, peer: Peer) -> None:
        """Packets that cannot be authenticated prove that a robot lives only where it was never heard in this life of ours.

        One that was heard and then falls silent is replaced, even if such packets come from it. Under majority votes decide.
        """
        if peer.boot:
            peer.loyal_until_ns = peer.heard_ns + self._loyalty_ns + self._wider_ns(peer)
            return
        peer.loyal_until_ns = peer.heard_ns + self._grace_ns
        if peer.unread_ns and not self._elects:
            peer.loyal_until_ns = max(peer.loyal_until_ns, peer.unread_ns + UNREAD_NS)

    def _wider_ns(self, peer: Peer) -> int:
        """By how much the margin is to be wider than the configured one."""
        lease_ns = self._config.lease_ns
        return max(min(UNSTEADY_FACTOR * peer.unsteady_ns, lease_ns) - (self._loyalty_ns - lease_ns), 0)

    def next_death_ns(self, now_ns: int) -> int | None:
        """When the next peer counts as silent, or as dead, if it stays silent; None if all do."""
        first_ns: int | None = None
        for peer in self.peers.values():
            until_ns = peer.loyal_until_ns if peer.loyal_until_ns > now_ns else peer.awaited_until_ns
            if until_ns > now_ns and (first_ns is None or until_ns < first_ns):
                first_ns = until_ns
        return first_ns

    def dead(self, robot: str, now_ns: int) -> bool:
        """Silent for longer than any lease that it may still act on. A robot that is no peer at all is dead to us."""
        if robot not in self.peers:
            return robot not in self._former or now_ns >= _bound_until_ns(self._former[robot])
        peer = self.peers[robot]
        return now_ns >= peer.loyal_until_ns and now_ns >= peer.awaited_until_ns

    def alive(self, robot: str, now_ns: int) -> bool:
        """Heard in this life of ours, and not silent for too long. One that is waited for is neither alive nor dead."""
        return robot in self.peers and self.peers[robot].boot > 0 and now_ns < self.peers[robot].loyal_until_ns

    def is_owed(self, robot: str, now_ns: int) -> bool:
        """Whether a later life of a robot is heard than the one that we promised to wait for, and it has not given that back.

        Then a guard of that robot may still act on the promise, although its agent knows nothing of it.
        """
        peer = self.peers[robot]
        return now_ns < peer.awaited_until_ns and peer.boot > peer.awaited[0]

    def awaited_ns(self, robot: str, now_ns: int) -> int:
        """For how long a silent peer is waited for still, because its agent restarts as it announced; 0: it is heard, or dead."""
        peer = self.peers.get(robot)
        return max(peer.awaited_until_ns - now_ns, 0) if peer is not None and now_ns >= peer.loyal_until_ns else 0

    def echoes(self, now_ns: int) -> tuple[Echo, ...]:
        """Whom we hear, for the next beat. Under majority a peer that has not heard us for long may not act on that."""
        heard = (peer for peer in self.peers.values() if peer.boot and peer.robot != self._config.coordinator)
        return tuple(self._echo(peer, now_ns) for peer in heard)

    def _echo(self, peer: Peer, now_ns: int) -> Echo:
        counter = 0 if peer.at_odds else peer.counter
        if self._deaf(peer, now_ns):
            return Echo(peer.robot, peer.boot, -counter)
        peer.told_ns = now_ns
        return Echo(peer.robot, peer.boot, counter)

    def steady(self, now_ns: int) -> bool:
        """Whether each living peer was heard in the last two thirds of a loyalty: none is about to be taken for dead."""
        missing_ns = now_ns - 2 * self._loyalty_ns // 3
        return all(peer.heard_ns > missing_ns or peer.loyal_until_ns <= now_ns or not peer.boot for peer in self.peers.values())

    def gone(self, robot: str, now_ns: int) -> bool:
        """Dead, or so deaf to us that nothing we ever told it lets it act any more."""
        if robot not in self.peers or self.dead(robot, now_ns):
            return self.dead(robot, now_ns)
        peer = self.peers[robot]
        return self._deaf(peer, now_ns) and now_ns >= max(peer.told_ns + self._loyalty_ns, peer.awaited_until_ns)

    def unheard(self, robot: str) -> bool:
        """Whether a robot has said nothing yet in this life of ours: a peer, or one that the team file does not know."""
        return robot not in self.peers or not self.peers[robot].boot

    def unreadable(self, robot: str, why: str, now_ns: int) -> str:
        """Note a packet that could not be authenticated; a sentence for the event log where it is the first, or says more.

        Of a peer that lives it says nothing: any machine may send from its address.
        """
        peer = self.peers.get(robot)
        if peer is None:
            is_news, self._stranger_ns = not self._is_recent(self._stranger_ns, now_ns), now_ns
            return f"{self._own[0]} receives from a robot that its team.toml does not know{why and f': {why}'}" if is_news else ""
        if self.alive(robot, now_ns):
            return ""
        is_news = not self._is_recent(peer.unread_ns, now_ns) or (bool(why) and peer.unread_why == UNREAD)
        peer.unread_ns = now_ns
        peer.unread_why = why or peer.unread_why or UNREAD
        self._count_loyalty(peer)
        return f"{self._own[0]} receives from {robot} and cannot authenticate it: {peer.unread_why}" if is_news else ""

    def unread(self, robot: str, now_ns: int) -> str:
        """Why packets from a peer cannot be authenticated; "" where no such packet came lately."""
        peer = self.peers.get(robot)
        return peer.unread_why if peer is not None and self._is_recent(peer.unread_ns, now_ns) else ""

    def keeps_waiting(self, robot: str, now_ns: int) -> bool:
        """Whether a peer would count as dead, but for packets from it that cannot be authenticated."""
        peer = self.peers[robot]
        is_silent = now_ns >= max(peer.heard_ns + self._grace_ns, peer.awaited_until_ns)
        return not peer.boot and is_silent and now_ns < peer.loyal_until_ns

    def strangers_until_ns(self) -> int:
        """For how long a robot that the team file does not know has proved to live: one that belonged to the team, perhaps."""
        return self._stranger_ns + UNREAD_NS if self._stranger_ns else 0

    def _is_recent(self, at_ns: int, now_ns: int) -> bool:
        return at_ns > 0 and now_ns < at_ns + UNREAD_NS

    def lived_ns(self, now_ns: int) -> int:
        """How long this life of ours has lasted."""
        return now_ns - self._born_ns

    def rested(self, now_ns: int) -> bool:
        """Whether all promises that an earlier life of ours gave are over."""
        return now_ns >= self._born_ns + self._loyalty_ns

    def _deaf(self, peer: Peer, now_ns: int) -> bool:
        if not self._elects or not peer.boot:
            return False
        return now_ns - max(peer.heard_us_ns, peer.since_ns) > DEAF_LOYALTIES * self._loyalty_ns

    def at_odds(self, now_ns: int) -> tuple[str, ...]:
        """The living peers that have another rule than we."""
        return tuple(peer.robot for peer in self.living(now_ns) if peer.at_odds)

    def living(self, now_ns: int) -> tuple[Peer, ...]:
        """The peers that are alive."""
        return tuple([peer for peer in self.peers.values() if peer.boot > 0 and now_ns < peer.loyal_until_ns])

    def is_first(self, robot: str, now_ns: int) -> bool:
        """Whether of all members that live, this one among them, that peer has the least name."""
        for one in self._before_us:
            if one == robot:
                return True
            if self.alive(one, now_ns):
                return False
        return False

    def lease_ns(self, robot: str) -> int:
        """Until when this peer's hearing us lets us act: the newest beat of ours that it echoed, and a lease; or its promise."""
        peer = self.peers.get(robot)
        if peer is None:
            return 0
        return max(peer.asked_ns + self._config.lease_ns if peer.asked_ns else 0, peer.promised_ns)

    def hears_us(self, robot: str, now_ns: int) -> bool:
        """Whether a peer has echoed a beat of ours that left within a lease; a promise to wait for us is no echo."""
        asked_ns = self.peers[robot].asked_ns
        return asked_ns > 0 and asked_ns + self._config.lease_ns > now_ns

    def patience_ns(self, robot: str) -> int:
        """For how long a living peer may not hear us: until it has our key, where its present life has never heard us."""
        return self._loyalty_ns if self.peers[robot].heard_us else self._grace_ns

    def views(self, now_ns: int) -> tuple[PeerView, ...]:
        """For the status."""
        return tuple(self._view(peer, now_ns) for peer in self.peers.values())

    def sightings(self, component: str, now_ns: int) -> tuple[Sighting, ...]:
        """For ``failover why``: every peer, and its word on a component ("" for none)."""
        return tuple(self._sighting(peer, component, now_ns) for peer in self.peers.values())

    def _sighting(self, peer: Peer, component: str, now_ns: int) -> Sighting:
        entry = peer.entry(component)
        says = f"{_state_name(entry.state)}, epoch {entry.epoch}, primary {entry.primary or 'none'}" if entry else ""
        return Sighting(
            peer.robot,
            self._state(peer, now_ns),
            peer.boot,
            peer.counter,
            now_ns - peer.heard_ns,
            self.loyal_until_ns(peer.robot) - peer.heard_ns,
            tuple((link, now_ns - at) for link, at in sorted(peer.links.items())),
            self.hears_us(peer.robot, now_ns),
            says,
        )

    def _state(self, peer: Peer, now_ns: int) -> str:
        if not peer.boot:
            return "unheard"
        if now_ns >= peer.loyal_until_ns:
            return "restarting" if now_ns < peer.awaited_until_ns else "dead"
        is_suspect = now_ns - peer.heard_ns > SUSPECT_BEATS * self._config.beat_ns and peer.robot != self._config.coordinator
        return "suspect" if is_suspect else "alive"

    def _view(self, peer: Peer, now_ns: int) -> PeerView:
        silent_ns = now_ns - peer.heard_ns
        state = self._state(peer, now_ns)
        heard = tuple(link for link, at in sorted(peer.links.items()) if now_ns - at < self._loyalty_ns)
        hears_us = self.hears_us(peer.robot, now_ns)
        return PeerView(
            peer.robot,
            state,
            peer.boot,
            silent_ns,
            hears_us,
            peer.load,
            heard,
            self.unread(peer.robot, now_ns),
            awaited_ns=self.awaited_ns(peer.robot, now_ns),
            drained=peer.drained,
            is_asked=peer.is_asked,
        )


def _bound_until_ns(former: Peer) -> int:
    """Until when a former member must not be replaced: it may act until then on what it was told, or promised."""
    return max(former.loyal_until_ns, former.awaited_until_ns)


def _state_name(number: int) -> str:
    states = tuple(State)
    return states[number] if 0 <= number < len(states) else State.ABSENT
