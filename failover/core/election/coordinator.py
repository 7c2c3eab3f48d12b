"""The rule ``etcd``: the members vote as under ``majority``, and etcd has one vote more. Here: how etcd votes, and for whom.

etcd keeps, below one prefix, a *seat* for each component (the epoch that it voted in, and for whom), a *word* of each robot (what
that robot holds), and a key that lives as long as the robot's lease at etcd. Each robot carries etcd's vote out for itself, by
compare-and-set; `failover.core.node` hears the result as it hears the heartbeat of a witness. Invariants:

* *One vote an epoch.* A seat's epoch only grows, and in one epoch it names one robot.
* *A grant counts from before the question.* The robot puts its word, and reads its seat in the same transaction. It may act for a
  lease from when the heartbeat left that the word names: that was before the request was sent.
* *Two clocks.* A seat goes to another robot only if the word of the one that has it has not changed for a lease and a margin on
  the asking robot's own clock, *and* that robot's lease at etcd is over. So either clock may jump. The transaction compares both.
  Or the word itself says that its robot runs the component no more.
* *A word is put on top of the robot's own last one.* A request that was given up, and arrives later, changes nothing.
* *What has ended is not run by mistake.* A robot that claimed before it knew of the end puts the end above its claim.
* *An etcd that is new to this robot, or has lost writes, gives no new vote* before a lease and a margin have passed.
"""

from __future__ import annotations

import itertools
from collections.abc import Generator, Iterator
from typing import Final

import msgspec

from checkpoint.errors import UNDECODABLE
from checkpoint.model import Position
from failover.core.election.consent import STATES, kept, state_of
from failover.core.types import COORDINATOR, ENDED, HOLDING, MS, Config, State
from failover.core.wire.codec import is_sound_entry
from failover.core.wire.messages import BARE, FREE, FRESH, OPEN, ORDERED, RULES, Beat, Echo, Entry
from failover.errors import RulesError

ROUNDS_IN_LEASE: Final = 8
"""So often in a lease a robot asks etcd where nothing changes: a few answers may be late or lost."""

TRIES_MAX: Final = 3
"""For a word that is put on top of what an earlier request of this robot left."""

VOTES_MAX: Final = 100
"""In one transaction. etcd allows 128 operations in one, a vote's comparisons and those around it together."""

ROUND_SHARE: Final = 4
"""A round that takes longer than this part of a lease ends, with some votes cast: the next one begins with a newer word."""

STEP_SHARE: Final = 4
"""Between two looks at etcd no more than this part of a lease counts as watched: a clock that leaps ahead proves no silence."""

_BOUND = HOLDING | {State.STOPPING}


class Word(msgspec.Struct, frozen=True, array_like=True):
    """What a robot holds, all of it, as its heartbeats tell it in turn. ``counter``: of its newest heartbeat."""

    boot: int
    counter: int
    entries: tuple[Entry, ...] = ()

    def entry(self, component: str) -> Entry | None:
        """Its entry for a component; None: it knows of none."""
        return next((entry for entry in self.entries if entry.name == component), None)


class Seat(msgspec.Struct, frozen=True, array_like=True):
    """etcd's vote: ``primary`` in ``epoch``. ``state``: STANDBY, or how it ended; ``standby``: whom the primary has entrusted."""

    epoch: int
    primary: str
    standby: str = ""
    state: int = STATES.index(State.STANDBY)
    status: int = 0


class KeepAlive(msgspec.Struct, frozen=True):
    """Lengthen a lease; etcd answers `Leased`, of 0 where that lease is over."""

    lease: int


class Grant(msgspec.Struct, frozen=True):
    """A new lease that lasts so long, or longer; etcd answers `Leased`."""

    ttl_ms: int


class Leased(msgspec.Struct, frozen=True):
    """A lease that is not over, by etcd's own clock."""

    lease: int


class Put(msgspec.Struct, frozen=True):
    """Put a key if all compared ones have these revisions (0: there is none). ``lease``: 0 for a key that stays."""

    key: str
    value: bytes
    compared: tuple[tuple[str, int], ...]
    lease: int = 0


class Swap(msgspec.Struct, frozen=True):
    """One transaction: each of the puts for itself, then read the prefix."""

    prefix: str
    puts: tuple[Put, ...]


class Swapped(msgspec.Struct, frozen=True):
    """The answer: whether all was put, the revision of the store, key → (value, the key's own revision), which etcd."""

    is_done: bool
    revision: int
    found: dict[str, tuple[bytes, int]]
    cluster: int = 0


Request = KeepAlive | Grant | Swap
"""etcd answers a Swap by Swapped, or by Leased(0) where it names a lease that is over."""
Answer = Leased | Swapped
Round = Generator[Request, tuple[Answer, int], "Said"]


class Said(msgspec.Struct, frozen=True):
    """How etcd would vote, or has voted, after it took in a word. ``entries``: its seats, as a witness tells them."""

    boot: int
    counter: int
    entries: tuple[Entry, ...] = ()


class Arbiter:
    """Carries etcd's vote out for one robot. ``config``: that robot's; ``team``: whose keys."""

    def __init__(self, config: Config, team: str) -> None:
        self._me = config.robot
        self._quorum, self._lease_ns, self._loyalty_ns = config.quorum, config.lease_ns, config.loyalty_ns
        self._patience_ns = config.patience_ms * MS
        self._members = {config.robot, *config.peers}
        self._prefix = f"failover/{team}/"
        self._lease = self._own_revision = self._revision = self._cluster = self._alive = 0
        self._seats: dict[str, tuple[Seat, int]] = {}
        self._words: dict[str, tuple[Word, int]] = {}
        self._leased: set[str] = set()
        self._looked_ns: int | None = None
        self._watched_ns = 0
        self._since: dict[str, tuple[int, int]] = {}
        self._lives: dict[str, tuple[int, int]] = {}
        self._ends: dict[str, tuple[int, int]] = {}

    def round(self, word: Word) -> Round:
        """Ask etcd once: put the word, read all, vote where this robot may have it. The driver sends each answer and its instant.

        An answer that does not come ends the round; the next one begins with what etcd really has.
        """
        lease, self._lease = self._lease, 0  # known again once etcd has answered
        if lease:
            lease = _leased((yield KeepAlive(lease))[0])
        if not lease:
            lease = _leased((yield Grant(self._loyalty_ns // MS))[0])
        self._lease = lease
        own, alive = self._key("word", self._me), self._key("alive", self._me)
        for _ in range(TRIES_MAX):
            compared = ((own, self._own_revision),)
            puts = [Put(own, msgspec.msgpack.encode(word), compared)]
            if lease != self._alive or self._me not in self._leased:
                puts.append(Put(alive, b"", compared, lease))
            answer, begun_ns = yield Swap(self._prefix, tuple(puts))
            if isinstance(answer, Leased):  # etcd's clock has leapt meanwhile: that lease is over
                self._lease = lease = _leased((yield Grant(self._loyalty_ns // MS))[0])
            elif self._look(answer, begun_ns):
                self._alive = lease
                break
        else:
            return Said(0, 0)
        self._note_ends(word)
        wanted, now_ns = word.entries, begun_ns
        while wanted and now_ns - begun_ns < self._lease_ns // ROUND_SHARE:
            votes = tuple(itertools.islice(filter(None, map(self._vote, wanted)), VOTES_MAX))
            if not votes:
                break
            asked = {vote.key for vote in votes}
            wanted = tuple(entry for entry in wanted if self._key("component", entry.name) not in asked)
            answer, now_ns = yield Swap(self._prefix, votes)
            self._look(answer, now_ns)
            self._note_ends(word)
        return Said(word.boot, word.counter, tuple(self._entries(word)))

    def _vote(self, entry: Entry) -> Put | None:
        """That this robot may have etcd cast for it; a comparison that fails stops no other one."""
        wanted = self._wanted(entry)
        if wanted is None:
            return None
        seat, compared = wanted
        key = self._key("component", entry.name)
        revision = self._seats[entry.name][1] if entry.name in self._seats else 0
        return Put(key, msgspec.msgpack.encode(seat), ((key, revision), *compared))

    def _key(self, kind: str, name: str) -> str:
        return f"{self._prefix}{kind}/{name.removeprefix('/')}"

    # What is there

    def _look(self, answer: Answer, now_ns: int) -> bool:
        """Take in all that etcd has; whether the transaction was done."""
        assert isinstance(answer, Swapped)
        before, revision, cluster = {**self._seats}, self._revision, self._cluster
        words = {robot: at for robot, (_, at) in self._words.items()}
        self._revision, self._cluster = answer.revision, answer.cluster
        if self._looked_ns is not None:
            self._watched_ns += min(max(now_ns - self._looked_ns, 0), self._lease_ns // STEP_SHARE)
        self._looked_ns = now_ns
        self._read(answer.found)
        self._own_revision = self._revision_of(self._me)
        is_other = cluster not in (0, answer.cluster) or answer.revision < revision
        if is_other or self._have_lost(before) or any(self._revision_of(robot) < at for robot, at in words.items()):
            self._begin_anew()
        seated = (robot for seat, _ in self._seats.values() for robot in (seat.primary, seat.standby) if robot)
        for robot in {*self._words, *seated}:
            self._note(self._since, robot, self._revision_of(robot))
            self._note(self._lives, robot, self._words[robot][0].boot if robot in self._words else 0)
        return answer.is_done

    def _read(self, found: dict[str, tuple[bytes, int]]) -> None:
        seats: dict[str, tuple[Seat, int]] = {}
        words: dict[str, tuple[Word, int]] = {}
        for key, (value, revision) in found.items():
            kind, _, name = key.removeprefix(self._prefix).partition("/")
            try:
                if kind == "component":
                    seats[f"/{name}"] = _seat(f"/{name}", value), revision
                elif kind == "word":
                    words[name] = _word(value), revision
            except UNDECODABLE as error:
                raise RulesError(f"etcd has something else than failover's in {key} ({error}); delete that key") from error
        self._seats, self._words = seats, words
        alive = self._key("alive", "")
        self._leased = {key.removeprefix(alive) for key in found if key.startswith(alive)}

    def _have_lost(self, before: dict[str, tuple[Seat, int]]) -> bool:
        """Whether a seat is gone, or is older than this robot knew it."""
        for component, (seat, revision) in before.items():
            now = self._seats.get(component)
            if now is None or now[1] < revision or now[0].epoch < seat.epoch:
                return True
        return False

    def _begin_anew(self) -> None:
        """This etcd has lost writes, or is another one: what was watched proves nothing."""
        self._watched_ns = 0
        self._since.clear()
        self._lives.clear()

    def _note(self, since: dict[str, tuple[int, int]], robot: str, what: int) -> None:
        if robot not in since or since[robot][0] != what:
            since[robot] = what, self._watched_ns

    def _note_ends(self, word: Word) -> None:
        """In which epoch this robot was when it learned of an end: its claim of that epoch may have begun in ignorance."""
        for component, (seat, _) in self._seats.items():
            if STATES[seat.state] in ENDED and self._ends.get(component, (0, 0))[0] != seat.epoch:
                entry = word.entry(component)
                self._ends[component] = seat.epoch, entry.epoch if entry is not None else 0

    def _revision_of(self, robot: str) -> int:
        return self._words[robot][1] if robot in self._words else 0

    def _silent_ns(self, robot: str) -> int:
        """For how long this robot has seen no new word of another one; 0: not at all, or its lease is not over."""
        known = robot in self._since and robot not in self._leased
        return self._watched_ns - self._since[robot][1] if known else 0

    @property
    def _is_rested(self) -> bool:
        return self._watched_ns >= self._loyalty_ns

    # Whom to vote for

    def _wanted(self, entry: Entry) -> tuple[Seat, tuple[tuple[str, int], ...]] | None:
        """The seat that this robot's word asks for, if it may have it, and what must not have changed meanwhile."""
        state = state_of(entry)
        if state in HOLDING:
            wanted = Seat(entry.epoch, self._me, entry.standby)
        elif state in ENDED and entry.primary:
            wanted = Seat(entry.epoch, entry.primary, "", entry.state, entry.status)
        else:
            return None
        seat = self._seats[entry.name][0] if entry.name in self._seats else None
        if seat is not None and (wanted == seat or wanted.epoch < seat.epoch):
            return None
        if seat is not None and wanted.epoch == seat.epoch:
            is_end = STATES[seat.state] in ENDED and STATES[wanted.state] not in ENDED
            return (wanted, ()) if wanted.primary == seat.primary and not is_end else None
        if not self._is_rested:
            return None
        if seat is not None and STATES[seat.state] in ENDED and state in HOLDING and wanted.epoch <= self._ends[entry.name][1]:
            return msgspec.structs.replace(seat, epoch=wanted.epoch), ()
        if seat is None or wanted.primary == seat.primary:
            return wanted, ()
        if self._is_elected(entry.name, wanted):
            return wanted, ()
        compared = self._freed(entry.name, seat)
        is_eligible = state in ENDED or entry.flags & ORDERED or self._is_eligible(entry, seat)
        return (wanted, compared) if compared is not None and is_eligible else None

    def _freed(self, component: str, seat: Seat) -> tuple[tuple[str, int], ...] | None:
        """What proves that the robot which has the seat does not act on it, as comparisons; None: nothing does."""
        robot = seat.primary
        if robot == self._me or STATES[seat.state] in ENDED:
            return ()
        same = (self._key("word", robot), self._revision_of(robot))
        if robot in self._words:
            entry = self._words[robot][0].entry(component)
            settled = self._watched_ns - self._lives[robot][1] >= self._loyalty_ns
            if state_of(entry) not in _BOUND if entry is not None else settled:
                return (same,)
        if self._silent_ns(robot) >= self._loyalty_ns:
            return same, (self._key("alive", robot), 0)
        return None

    def _is_elected(self, component: str, wanted: Seat) -> bool:
        """Whether a majority names that robot without etcd, none of them with a copy that is being stopped."""
        said = (word.entry(component) for robot, (word, _) in self._words.items() if robot in self._members)
        named = (one for one in said if one is not None and state_of(one) is not State.STOPPING)
        return sum((one.epoch, one.primary) == (wanted.epoch, wanted.primary) for one in named) >= self._quorum

    def _is_eligible(self, entry: Entry, seat: Seat) -> bool:
        """Whether nothing that was acknowledged is lost if this robot goes on from its newest checkpoint."""
        lost = self._me if entry.flags & BARE else ""
        sure = [robot for robot in (seat.primary, seat.standby) if robot not in ("", lost)]
        if STATES[seat.state] in ENDED or self._me in sure or self._all_lost(entry.name, sure):
            return True
        if entry.flags & FRESH and seat.standby in ("", self._me):
            return True
        theirs = (self._position_at(entry.name, robot) for robot in sure)
        mine = entry.position
        return mine is not None and any(one is not None and one <= mine for one in theirs)

    def _position_at(self, component: str, robot: str) -> Position | None:
        entry = self._words[robot][0].entry(component) if robot in self._words else None
        return kept(entry) if entry is not None and self._silent_ns(robot) < self._loyalty_ns else None

    def _all_lost(self, component: str, sure: list[str]) -> bool:
        """Whether those that hold all that was acknowledged were waited for long enough, or are back without it."""
        return all(self._is_lost(component, robot) for robot in sure)

    def _is_lost(self, component: str, robot: str) -> bool:
        silent_ns = self._silent_ns(robot)
        if silent_ns >= self._loyalty_ns or robot not in self._words:
            return silent_ns >= self._patience_ns
        entry = self._words[robot][0].entry(component)
        return entry is None or (kept(entry) is None and state_of(entry) not in _BOUND)

    def _entries(self, word: Word) -> Iterator[Entry]:
        """The seats, as a witness would tell of them."""
        for component, (seat, _) in self._seats.items():
            is_free = self._is_rested and self._freed(component, seat) is not None
            sure = [robot for robot in (seat.primary, seat.standby) if robot]
            flags = FREE * is_free | OPEN * (is_free and self._all_lost(component, sure))
            yield _told(component, seat, flags)


def _told(component: str, seat: Seat, flags: int = 0) -> Entry:
    """A seat, as a witness would tell of it."""
    return Entry(component, seat.state, seat.epoch, seat.primary, standby=seat.standby, flags=flags, status=seat.status)


def _seat(component: str, value: bytes) -> Seat:
    """Raises ValueError or RecursionError: it is none."""
    seat = msgspec.msgpack.decode(value, type=Seat)
    if not 0 <= seat.state < len(STATES) or not is_sound_entry(_told(component, seat)):
        raise ValueError("a number or a name in it is none that failover writes")
    return seat


def _word(value: bytes) -> Word:
    """Raises ValueError or RecursionError: it is none."""
    word = msgspec.msgpack.decode(value, type=Word)
    if not (word.boot > 0 and word.counter > 0 and all(map(is_sound_entry, word.entries))):
        raise ValueError("a number or a name in it is none that failover writes")
    return word


def _leased(answer: Answer) -> int:
    assert isinstance(answer, Leased)
    return answer.lease


class Dialogue:
    """The main loop's half: when a robot asks etcd, and etcd's answer as the heartbeat of a witness."""

    def __init__(self, config: Config) -> None:
        self._config = config
        self._period_ns = config.lease_ns // ROUNDS_IN_LEASE
        self._asked_ns = 0
        self._essence: tuple[object, ...] = ()
        self._counter = 0

    def is_due(self, word: Word, now_ns: int) -> bool:
        """Whether to begin a round now with this word: all of it is on the disk. Only one round is under way at a time."""
        essence = tuple([(one.name, one.state, one.epoch, one.primary, one.standby) for one in word.entries])
        if not word.counter:
            self._asked_ns = now_ns  # no heartbeat has left yet: look again a while later
            return False
        if essence == self._essence and now_ns < self._asked_ns + self._period_ns:
            return False
        self._essence, self._asked_ns = essence, now_ns
        return True

    def changed(self, config: Config) -> Dialogue:
        """The same with another team: etcd's heartbeats count on."""
        other = Dialogue(config)
        other._counter = self._counter
        return other

    def next_ns(self) -> int:
        """When the next round is due if nothing changes."""
        return self._asked_ns + self._period_ns

    def beat(self, said: Said) -> Beat | None:
        """What the core hears; None where etcd took nothing in."""
        if not said.counter:
            return None
        self._counter += 1
        return Beat(
            COORDINATOR,
            1,
            self._counter,
            self._counter,
            total=len(said.entries),
            echoes=(Echo(self._config.robot, said.boot, said.counter),),
            entries=said.entries,
            rule=RULES.index(self._config.rule),
        )
