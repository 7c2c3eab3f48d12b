"""Cache socket descriptions between captures: each capture queries all sockets, and decodes only those with other answers.

Decoding a socket takes much longer than querying it: the answers are many. So one table of calls asks all questions
(`checkpoint.linux.net.socket_queries`). Where the answers are equal to the last ones, byte by byte, their meaning is the same,
too. The cache never relies on a number alone, because the kernel may have given it to another socket.

These queries do not cover data that waits in a socket, so a socket with waiting data is always decoded.
"""

from __future__ import annotations

import operator
import select
import socket
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Final

from msgspec import Struct, field
from msgspec.structs import replace

from checkpoint.linux.net import socket_queries
from checkpoint.linux.net.socket_queries import WORTH_SHARING, Asking, Subject, Told, events
from checkpoint.linux.procfs.descriptors import Copier, copy_of
from checkpoint.linux.syscall_thread import SecondThread
from checkpoint.model import Fact
from checkpoint.resources.ipc import pipes
from checkpoint.resources.kernel_listings import Group
from checkpoint.resources.open_file import Opened, OpenFile, Recalled
from checkpoint.resources.restore_context import number_of
from checkpoint.resources.sockets import inet, inet_addresses, sockets, tcp, unix, unix_names
from checkpoint.runtime.identity_memo import Memo

COPIES_MAX: Final = 128
"""Sockets that are asked at a time: we may have 1,024 descriptors ourselves (RLIMIT_NOFILE)."""
OF_SETTINGS: Final = ("socket", "family", "type", "protocol", "user", "options", "filter", "filter_locked")
"""Facts that follow from what a program has set."""


class _Known(Struct):
    """One socket as it was at the last look.

    Attributes:
        asking: None until the program runs again.
        groups: multicast groups of the machine that it was asked about.
        settings, state: what it answered; ``state`` None where that says nothing of the next time.
        listed: the entries of the kernel's lists about it.
        facts: the meaning of those answers.
        seen: the open file, and the same with all that was observed.
        again: the resource to tell where it answers as before; None if that must be worked out.
    """

    inode: int
    facts: Mapping[str, Fact]
    groups: tuple[Group, ...]
    asking: Asking | None = None
    settings: bytes | None = None
    state: bytes | None = None
    listed: object = None
    seen: tuple[OpenFile, OpenFile] | None = None
    again: Recalled | None = None


class _Alike(Struct):
    """Sockets of one kind that are asked in one go.

    Attributes:
        places: of their descriptors among those that are asked at a time.
        heard: the answers of all at the last look; b"" where one of them had something new to say, or could not be asked.
        again: the resources to tell where they answer as before, by their descriptors.
        listed: those that the kernel's lists name.
    """

    asking: Asking
    members: list[tuple[OpenFile, _Known]] = field(default_factory=list)
    places: list[int] = field(default_factory=list)
    heard: bytes = b""
    again: Mapping[int, Recalled] = field(default_factory=dict)
    listed: list[tuple[OpenFile, _Known]] = field(default_factory=list)


class _AtATime(Struct, frozen=True):
    """Sockets that are asked at a time, by their descriptors."""

    pid: int
    copier: Copier
    kinds: list[_Alike]

    @classmethod
    def of(cls, some: Sequence[tuple[OpenFile, _Known]]) -> _AtATime:
        """Sockets at a time, those of a kind together."""
        kinds: dict[Asking, _Alike] = {}
        for place, (one, known) in enumerate(some):
            if known.asking is not None:
                alike = kinds.setdefault(known.asking, _Alike(known.asking))
                alike.members.append((one, known))
                alike.places.append(place)
        return cls(some[0][0].pid, Copier([one.first.number for one, _ in some]), list(kinds.values()))


class _Round(Struct, frozen=True):
    """The sockets to ask, as long as the open files are the very same.

    Attributes:
        opened: all open files.
        numbers: descriptors of sockets among them.
        asked: those that are asked, by `COPIES_MAX` at a time.
        groups: multicast groups of the machine, by process and family.
    """

    opened: tuple[OpenFile, ...] = ()
    numbers: frozenset[int] = frozenset()
    asked: tuple[_AtATime, ...] = ()
    groups: Mapping[tuple[int, int], tuple[Group, ...]] = field(default_factory=dict)

    def holds(self, opened: Opened) -> bool:
        """Whether nothing has come, gone or changed its form."""
        if len(opened) != len(self.opened) or not all(map(operator.is_, opened, self.opened)):
            return False
        return all(opened.listings.groups(*key) == groups for key, groups in self.groups.items())


class _Answer(Struct, frozen=True):
    settings: bytes
    state: bytes
    listed: object


class Recollection:
    """The known facts of the sockets of one process that is looked at again and again."""

    def __init__(self) -> None:
        self._known: dict[int, _Known] = {}
        self._pipes: dict[int, OpenFile] = {}
        self._copiers: list[Copier] = []
        self._askings: dict[Subject, Asking] = {}
        self._round: _Round | None = None
        self._second: SecondThread | None = None
        self._are_plain = Memo[bool]()

    def close(self) -> None:
        """End what it has running."""
        if self._second is not None:
            self._second.close()
            self._second = None

    def prepare(self) -> None:
        """Do what need not be done while the program stands still."""
        wanted: dict[Subject, Asking] = {}
        for known in self._known.values():
            if known.asking is None:
                try:
                    subject = _subject(known.facts, known.groups)
                except OSError:  # we have no descriptor left: the look into it reports the cause
                    continue
                self._round = None
                known.asking = wanted.get(subject) or self._askings.get(subject) or Asking(subject)
            wanted[known.asking.subject] = known.asking
        counts = Counter(known.asking for known in self._known.values() if known.asking)
        self._be_two(max(counts.values(), default=0) >= WORTH_SHARING)
        for asking, count in counts.items():
            asking.reserve(min(count, COPIES_MAX), is_shared=self._second is not None)
            asking.prepare(self._second)
        self._askings = wanted  # a machine may have other multicast groups every minute

    def _be_two(self, is_worth_it: bool) -> None:
        """Have a second thread where there is much to ask, and only there."""
        if not is_worth_it:
            self.close()
        elif self._second is None:
            self._second = SecondThread.where_it_gains()

    def are_plain(self, opened: Opened, is_plain: Callable[[OpenFile], bool]) -> bool:
        """Whether we need not look into any of these, nor had to before; asked once about open files that are the very same.

        Args:
            is_plain: tells it of one; the answer follows from facts of it that never change.
        """
        if self._known or self._pipes:
            return False
        return self._are_plain.of(*opened, make=lambda: all(map(is_plain, opened)))

    def recall(self, opened: Opened) -> dict[int, _Answer]:
        """Ask every socket that was there last time; ``opened`` learns the unchanged ones. The process stands still.

        Returns:
            The answers of those that have something new to say, for `remember`.
        """
        if self._round is None or not self._round.holds(opened):
            self._round = self._round_of(opened)
        changed: dict[int, _Answer] = {}
        for some in self._round.asked:
            with some.copier.taken(some.pid) as copies:
                for alike in some.kinds:
                    _recall_alike(alike, [copies[place] for place in alike.places], self._second, opened, changed)
        if len(self._known) > sum(len(some.copier.numbers) for some in self._round.asked):
            self._known = {number: known for number, known in self._known.items() if number in self._round.numbers}
        return changed

    def _round_of(self, opened: Opened) -> _Round:
        """The sockets to ask now. Their resources are worked out anew, for they may have followed from other sockets."""
        held = [one for one in opened if sockets.is_socket(one.first) and not one.is_echo]
        asked = tuple((one, known) for one in held if (known := self._asked_of(one, opened)) is not None)
        for _, known in asked:
            known.again = None
        groups = {(one.pid, number_of(known.facts["family"])): known.groups for one, known in asked if _may_join(known.facts)}
        some = tuple(_AtATime.of(asked[first : first + COPIES_MAX]) for first in range(0, len(asked), COPIES_MAX))
        return _Round(tuple(opened), frozenset(one.first.number for one in held), some, groups)

    def empty_pipes(self, opened: Iterable[OpenFile]) -> dict[int, OpenFile]:
        """Pipes in which nothing waits, with all that must be known of them, by their first descriptors."""
        asked = [one for one in opened if one.both_ends and not one.is_echo and one.lent is None and pipes.is_pipe(one.first)]
        known = {}
        for turn, first in enumerate(range(0, len(asked), COPIES_MAX)):
            some = asked[first : first + COPIES_MAX]
            with self._copier_of_pipes(turn, tuple(one.first.number for one in some)).taken(some[0].pid) as copies:
                for one, capacity in zip(some, pipes.capacities_of_empty(copies), strict=True):
                    if capacity:
                        known[one.first.number] = self._as_it_was(one, capacity)
        self._pipes = known
        return known

    def _copier_of_pipes(self, turn: int, numbers: tuple[int, ...]) -> Copier:
        """They are the same from one look to the next, as a rule."""
        if turn == len(self._copiers):
            self._copiers.append(Copier(numbers))
        elif self._copiers[turn].numbers != numbers:
            self._copiers[turn] = Copier(numbers)
        return self._copiers[turn]

    def _as_it_was(self, one: OpenFile, capacity: int) -> OpenFile:
        before = self._pipes.get(one.first.number)
        if before is not None and before.descriptors is one.descriptors and before.capacity == capacity and before.kin is one.kin:
            return before
        return pipes.with_content(one, capacity, [])

    def _asked_of(self, one: OpenFile, opened: Opened) -> _Known | None:
        known = self._known.get(one.first.number)
        if known is None or known.asking is None or known.inode != one.first.inode:
            return None
        return known if known.groups == _groups_of(one, known.facts, opened) else None

    def remember(self, looked_at: Iterable[OpenFile], answers: Mapping[int, _Answer], opened: Opened) -> None:
        """Keep what a socket was found to be together with what it had answered; the process still stands."""
        for one in looked_at:
            recalled = opened.recalled.get(one.first.number)
            if one.lent or not one.observed or (recalled and recalled.whole is not None):
                continue
            known, answer = self._known.get(one.first.number), answers.get(one.first.number)
            if known is None or known.asking is None or known.inode != one.first.inode or answer is None:
                if "family" in one.observed:
                    groups = _groups_of(one, one.observed, opened)
                    self._known[one.first.number] = _Known(one.first.inode, one.observed, groups)
                    self._round = None
                continue
            if any(known.facts.get(name) != one.observed.get(name) for name in ("family", "type")):
                self._round = None
            known.facts, known.listed, known.again = one.observed, answer.listed, None
            known.settings = None if "filter" in one.observed else answer.settings  # of which the length alone was asked
            known.state = answer.state if _is_quiet(one.observed) and _answers_again(one, known.asking, answer) else None


def _recall_alike(
    alike: _Alike, copies: Sequence[int], second: SecondThread | None, opened: Opened, changed: dict[int, _Answer]
) -> None:
    """Ask all, in one go; what one answers that cannot be asked is not known. See `Recollection.recall`."""
    members = alike.members
    if can_all := min(copies) >= 0:
        asked = copies
    else:
        members = [member for member, copy in zip(members, copies, strict=True) if copy >= 0]
        asked = [copy for copy in copies if copy >= 0]
    heard = alike.asking.hear(asked, second)
    if can_all and heard == alike.heard and all(_listed(one, known.facts, opened) == known.listed for one, known in alike.listed):
        opened.recalled.update(alike.again)
        return
    alike.heard = b""
    is_new = not can_all
    for (one, known), told in zip(members, alike.asking.told(heard), strict=True):
        if (answer := _recalled(one, known, told, opened)) is not None:
            changed[one.first.number] = answer
        is_new |= known.again is None or answer is not None
    if not is_new:
        alike.heard, alike.listed = heard, [(one, known) for one, known in members if _is_listed(known.facts)]
        alike.again = {one.first.number: known.again for one, known in members if known.again}


def _recalled(one: OpenFile, known: _Known, told: Told, opened: Opened) -> _Answer | None:
    """The answer of a socket, unless it is known."""
    settings, state = told
    listed = _listed(one, known.facts, opened)
    if known.again is not None and told == (known.settings, known.state) and listed == known.listed:
        opened.recalled[one.first.number] = known.again
        return None
    if settings != known.settings:
        return _Answer(settings, state, listed)
    if state != known.state or listed != known.listed or _may_hold_something(state, known.facts):
        opened.recalled[one.first.number] = Recalled({name: known.facts[name] for name in OF_SETTINGS if name in known.facts})
        return _Answer(settings, state, listed)
    facts = known.facts
    if facts["family"] == socket.AF_UNIX:
        try:
            facts = unix.again(one, facts, opened)
        except OSError:  # the next look into it reports the cause
            return _Answer(settings, state, listed)
    if known.seen is None or known.seen[0] is not one or facts is not known.seen[1].observed:
        known.seen = one, replace(one, observed=facts)
    recalled = opened.recalled[one.first.number] = Recalled(facts, known.seen[1])
    known.again = recalled if _has_no_path(facts) else None
    return None


def _has_no_path(facts: Mapping[str, Fact]) -> bool:
    """Whether a socket has no name, or an abstract one: a path may lead elsewhere by now."""
    name = facts.get("name", b"")
    return isinstance(name, bytes) and name[:1] in (b"", b"\0")


def _subject(facts: Mapping[str, Fact], groups: Sequence[Group]) -> Subject:
    form = sockets.Form(*(number_of(facts[name]) for name in ("family", "type", "protocol")))
    packed = tuple((interface, inet_addresses.sockaddr([group, 0, 0, 0])) for interface, group in groups)
    options = socket_queries.sized(sockets.fresh_options(form))
    if inet.may_tell_segment(facts):
        options += ((socket.IPPROTO_TCP, socket.TCP_MAXSEG, socket_queries.NUMBER_SIZE),)
    return Subject(form.family, form.type, form.protocol, options, packed)


def _groups_of(one: OpenFile, facts: Mapping[str, Fact], opened: Opened) -> tuple[Group, ...]:
    """Multicast groups that it may be in."""
    if not _may_join(facts):
        return ()
    return opened.listings.groups(one.pid, number_of(facts["family"]))


def _may_join(facts: Mapping[str, Fact]) -> bool:
    """Whether it may be in multicast groups."""
    return facts["family"] in inet.FAMILIES and facts["type"] != socket.SOCK_STREAM


def _listed(one: OpenFile, facts: Mapping[str, Fact], opened: Opened) -> object:
    """The facts about a socket that only the kernel's lists tell."""
    if not _is_listed(facts):
        return 0
    if facts["family"] == socket.AF_UNIX:
        return opened.listings.unix_answer(one.first.inode)
    return opened.listings.shut_down(number_of(facts["family"]), number_of(facts["protocol"])).get(one.first.inode, 0)


def _is_listed(facts: Mapping[str, Fact]) -> bool:
    """Whether the kernel's lists say more of such a socket."""
    if facts["family"] == socket.AF_UNIX:
        return True
    return facts["protocol"] in inet.DATAGRAMS and bool(facts.get("address"))


def _may_hold_something(state: bytes, facts: Mapping[str, Fact]) -> bool:
    """Whether something may wait in it: what poll(2) says of one that was shut down it says of one with content, too."""
    seen = events(state)
    if seen & (select.POLLPRI | select.POLLERR):
        return True
    return bool(seen & select.POLLIN) and not (seen & select.POLLRDHUP and facts["type"] == socket.SOCK_STREAM)


def _is_quiet(facts: Mapping[str, Fact]) -> bool:
    """Whether a socket is of a kind whose every fact follows from its answers, as long as nothing waits in it."""
    if any(facts.get(name) for name in ("queue", "urgent", "too_long", "failed", "lost", "groups", "unread", "waiting", "corks")):
        return False
    if facts["family"] == socket.AF_UNIX:
        return facts["not_accepted"] == unix_names.NOT_WAITING
    if facts["family"] not in inet.FAMILIES or facts["type"] == socket.SOCK_RAW:
        return False
    if facts["protocol"] == socket.IPPROTO_TCP:
        return facts["state"] != tcp.SYN_SENT
    return facts["protocol"] in inet.DATAGRAMS


def _answers_again(one: OpenFile, asking: Asking, answer: _Answer) -> bool:
    """Whether nothing has come from outside since it was asked: then what was found since goes with what it had answered."""
    try:
        with copy_of(one.pid, one.first.number) as copy:
            return asking.ask(copy) == (answer.settings, answer.state)
    except OSError:
        return False
