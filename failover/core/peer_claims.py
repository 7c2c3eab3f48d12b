"""Checks each word of a member on a component: by its role, by the growth of epochs, by the word of the robot that it names.

Every member holds a key of the team, and one key may be stolen. So each entry is checked before the rules see it:

* A witness votes; it neither runs, keeps nor ends a component. A server keeps checkpoints, too. Both repeat what robots decided.
* No member tells that another robot has ended a component, or has opened an epoch, while that robot lives and says otherwise.
* The words of others raise an epoch by at most ``epoch_max``.

An entry beyond that counts as not said: it moves no component and stands for no vote. The robot counts it, and the status and the
event log tell which member sent it.
"""

from __future__ import annotations

import enum
from collections.abc import Mapping

from msgspec import Struct, field
from msgspec.structs import replace

from failover.core.component import Component, Turn
from failover.core.election import majority
from failover.core.election.consent import STATES, state_of
from failover.core.types import ENDED, EPOCH_SAID_MAX, HOLDING, MS, PEERS_MAX, Config, State
from failover.core.wire.messages import BARE, BEGUN, FREE, HOLDS, NEEDS_BASE, OPEN, Beat, Entry

EPOCHS_AWAY_MAX = 1 << 26
"""Epochs that may have passed while this robot was away: one each second for two years, or 1,023 recoveries at another site."""

MANY = 10
"""The event log tells of the first entry that was refused, and of each that makes so many times as many."""

RECENT_NS = 60_000 * MS
"""For so long after the last such entry the status counts this robot's sight of the team as not healthy."""

DENIED_LOYALTIES = 2
"""A word that the named robot denies counts once it is denied for so long: its own word may come later than that of others."""

_VOTES = FREE | OPEN | HOLDS | BEGUN
_SAYS = {State.ABSENT, State.STANDBY, *ENDED}


class Beyond(enum.StrEnum):
    """A way in which a member says more than it may."""

    RUNS = "runs"
    KEEPS = "keeps"
    ENDS = "ends"
    ORDERS = "orders"
    NAMES = "names"
    EPOCH = "epoch"
    DENIED = "denied"


class Refusal(Struct):
    """Entries of one member that were refused for the same reason. ``sentence`` tells of the last one."""

    sentence: str = ""
    count: int = 0
    last_ns: int = 0

    def told(self, now_ns: int) -> str:
        """For the status."""
        times = "once" if self.count == 1 else f"{self.count} times"
        return f"not believed, {times}, last {(now_ns - self.last_ns) / (1_000 * MS):.0f} s ago: {self.sentence}"


class Testimony(Struct):
    """The words of peers that were refused in this life of ours.

    Attributes:
        denied_ns: since when a member has been saying a word on a component that the named robot denies.
    """

    refusals: dict[tuple[str, Beyond], Refusal] = field(default_factory=dict)
    denied_ns: dict[tuple[str, str], int] = field(default_factory=dict)

    def take(self, beat: Beat, turn: Turn, components: Mapping[str, Component]) -> tuple[Beat, frozenset[str]]:
        """The beat as the rules may see it, and the components of which it said more than it may."""
        if beat.sender not in turn.team.peers or not beat.entries:
            return beat, frozenset()
        entries, refused = [], set()
        for entry in beat.entries:
            component = components.get(entry.name) or Component(entry.name)
            beyond = self._judge(component, turn, beat.sender, entry)
            if beyond:
                refused.add(entry.name)
                entry = _unsaid(entry, beat.sender, turn.config)
            entries.append(entry)
        if not refused:
            return beat, frozenset()
        return replace(beat, entries=tuple(entries)), frozenset(refused)

    def told(self, robot: str, now_ns: int) -> tuple[str, ...]:
        """For the status: a sentence for each reason for which words of this member were refused."""
        return tuple(one.told(now_ns) for (whose, _), one in self.refusals.items() if whose == robot)

    def is_recent(self, robot: str, now_ns: int) -> bool:
        """Whether something of this member was refused lately."""
        return any(whose == robot and now_ns < one.last_ns + RECENT_NS for (whose, _), one in self.refusals.items())

    def count(self, turn: Turn, robot: str, beyond: Beyond, sentence: str) -> None:
        """Note one that was refused."""
        one = self.refusals.setdefault((robot, beyond), Refusal())
        one.count, one.last_ns, one.sentence = one.count + 1, turn.now_ns, sentence
        if _is_told(one.count):
            turn.say_of_robot(f"{sentence}; not believed" + (f", {one.count} times so far" if one.count > 1 else ""))

    def _judge(self, component: Component, turn: Turn, sender: str, entry: Entry) -> bool:
        """Whether the entry is more than its sender may say."""
        found = _too_far(component, turn, sender, entry) or _beyond_role(turn.config, sender, entry)
        if found:
            self.count(turn, sender, *found)
            return True
        denier = _denier(component, turn, sender, entry)
        if not denier:
            self.denied_ns.pop((sender, entry.name), None)
            return False
        since_ns = self.denied_ns.setdefault((sender, entry.name), turn.now_ns)
        if turn.now_ns - since_ns >= DENIED_LOYALTIES * turn.config.loyalty_ns:
            said = f"is {state_of(entry)}" if state_of(entry) in ENDED else f"is {entry.primary}'s"
            sentence = f"{_who(turn.config, sender)} says that {entry.name} {said} in epoch {entry.epoch}, which {denier} denies"
            self.count(turn, sender, Beyond.DENIED, sentence)
        return True


def epoch_max(component: Component, turn: Turn) -> int:
    """Up to which epoch the words of others are believed.

    An epoch is opened by a claim, and a claim takes a beat at least: so many can have passed in this life of ours, and
    ``EPOCHS_AWAY_MAX`` before it. Never more than leaves room to count on.
    """
    passed = turn.team.lived_ns(turn.now_ns) // turn.config.beat_ns
    return min(component.remembered_epoch + EPOCHS_AWAY_MAX + passed, EPOCH_SAID_MAX)


def _too_far(component: Component, turn: Turn, sender: str, entry: Entry) -> tuple[Beyond, str] | None:
    epoch = max(entry.epoch, entry.generation // (PEERS_MAX + 1), entry.born)
    limit = epoch_max(component, turn)
    if epoch <= limit:
        return None
    sentence = (
        f"{_who(turn.config, sender)} says epoch {epoch} of {entry.name}, {epoch - component.epoch} above the one known here; "
        f"later ones than {limit} cannot have been opened yet"
    )
    return Beyond.EPOCH, sentence


def _beyond_role(config: Config, sender: str, entry: Entry) -> tuple[Beyond, str] | None:
    state, who, name = state_of(entry), _who(config, sender), entry.name
    if state not in _SAYS and not config.runs(sender):
        return Beyond.RUNS, f"{who} says that it is {state} of {name}, epoch {entry.epoch}: it runs nothing"
    if entry.primary and not config.runs(entry.primary):
        named = _who(config, entry.primary)
        if entry.primary == sender and state in ENDED:
            return Beyond.ENDS, f"{who} says by itself that {name} is {state}: it ends nothing"
        return Beyond.NAMES, f"{who} says that {name} is {named}'s, which runs nothing"
    if config.runs(sender):
        if state in HOLDING and entry.primary != sender:
            return Beyond.NAMES, f"{who} says that it is {state} of {name}, and names {entry.primary or 'no robot'} as the one"
        return None
    if state in ENDED and not entry.primary:
        return Beyond.ENDS, f"{who} says by itself that {name} is {state}: it ends nothing"
    keeps = config.keeps(sender)
    if not keeps and (entry.position is not None or entry.flags & NEEDS_BASE):
        return Beyond.KEEPS, f"{who} says that it keeps checkpoints of {name}: it keeps none"
    if entry.flags & ~(_VOTES | NEEDS_BASE | BARE) or entry.yields_to:
        return Beyond.ORDERS, f"{who} says of {name} what only a robot may (flags {entry.flags})"
    return None


def _denier(component: Component, turn: Turn, sender: str, entry: Entry) -> str:
    """The robot that the entry names, if it lives and says otherwise: it must know; "" if it does not."""
    named, is_end, runs = entry.primary, state_of(entry) in ENDED, turn.config.runs(sender)
    is_news = entry.epoch >= component.epoch if is_end else not runs and entry.epoch > component.epoch
    if named in ("", sender) or not is_news:
        return ""
    if named == turn.me:
        return named if _acts(component, turn) and (entry.epoch == component.epoch or not runs) else ""
    peer = turn.team.peers.get(named)
    if peer is None or not turn.alive(named):
        return ""
    word = peer.entry(entry.name)
    if word is None:
        return named if not runs and not component.epoch and peer.complete else ""
    if word.epoch > entry.epoch or not word.epoch:
        return ""
    return named if word.epoch < entry.epoch or (is_end and state_of(word) in HOLDING) else ""


def _acts(component: Component, turn: Turn) -> bool:
    """Whether the component is beyond doubt this robot's now; without a lease a later epoch may be one that it has forgotten."""
    if not component.holding or component.state is State.CLAIMING:
        return False
    return not component.elects or majority.leased(component, turn)


def _unsaid(entry: Entry, sender: str, config: Config) -> Entry:
    """The rest of an entry that was refused: nothing, but that a robot says it holds the component, so that none takes it."""
    state = state_of(entry)
    if config.runs(sender) and state in HOLDING:
        return Entry(entry.name, entry.state, 0, sender)
    return Entry(entry.name, STATES.index(State.ABSENT), 0)


def _who(config: Config, member: str) -> str:
    role = "the witness " if member in config.witnesses else "the server " if member in config.servers else ""
    return f"{role}{member}"


def _is_told(count: int) -> bool:
    while count % MANY == 0:
        count //= MANY
    return count == 1
