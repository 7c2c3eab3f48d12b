"""Messages between the main loop and the worker process, over a `checkpoint.keeper.messages` between the two processes.

The core's acts and events are plain Structs; each travels as its class name and its msgpack.
"""

from __future__ import annotations

from typing import Any, Final, Literal, get_args

import msgspec

from agent.errors import AgentError
from failover.config.team import Robot
from failover.core import acts, events
from failover.core.acts import Act
from failover.core.event_log.decisions import Line
from failover.core.events import Event
from failover.core.frames.terms import SlotsView
from failover.core.team_changes import Elections
from failover.core.types import Found, Held, StatusView

ACTS: Final[dict[str, Any]] = {
    kind.__name__: kind
    for kind in (
        acts.Start,
        acts.Restore,
        acts.Capture,
        acts.Ship,
        acts.CancelShip,
        acts.Accept,
        acts.Discard,
        acts.Show,
        acts.Acknowledge,
        acts.Admit,
        acts.Freeze,
        acts.Thaw,
        acts.SetLease,
        acts.KeepAside,
        acts.Forget,
        acts.End,
        acts.Stop,
        acts.LetGo,
        acts.Warm,
        acts.Cool,
        acts.Inquire,
        acts.Look,
        acts.Prune,
        acts.Drop,
        acts.ReportExit,
        acts.Answer,
    )
}
EVENTS: Final[dict[str, Any]] = {
    kind.__name__: kind
    for kind in get_args(events.Event)
    if kind not in (events.Tick, events.Received, events.TeamChanged, events.Leave)
}

_encoder = msgspec.msgpack.Encoder()
_act_decoders = {name: msgspec.msgpack.Decoder(kind) for name, kind in ACTS.items()}
_event_decoders = {name: msgspec.msgpack.Decoder(kind) for name, kind in EVENTS.items()}


class Order(msgspec.Struct, frozen=True, tag=True):
    """Main loop to worker: an act of the core, to be carried out."""

    kind: str
    body: bytes


class Happened(msgspec.Struct, frozen=True, tag=True):
    """Worker to main loop: an event for the core."""

    kind: str
    body: bytes


class Life(msgspec.Struct, frozen=True, tag=True):
    """Main loop to worker, first of all: which life of the agent this is, and what the main loop was refused."""

    boot: int
    main_loop: int
    notes: tuple[str, ...]


class Inventory(msgspec.Struct, frozen=True, tag=True):
    """Worker to main loop, first of all: what this robot's store holds and whose guards were found alive."""

    held: tuple[Held, ...]
    found: tuple[Found, ...]


class SpeakKey(msgspec.Struct, frozen=True, tag=True):
    """Worker to main loop: the peer has been told this key; seal beats to it with it."""

    peer: str
    key: bytes


class Alive(msgspec.Struct, frozen=True, tag=True):
    """Worker to main loop, from time to time: this process turns."""


class HearKey(msgspec.Struct, frozen=True, tag=True):
    """Worker to main loop: the peer says that it seals its beats to us with this key.

    Attributes:
        knows_other_sites: than we: its beats prove that it lives, and nothing else that they say counts.
    """

    peer: str
    key: bytes
    knows_other_sites: bool = False


class LinkNow(msgspec.Struct, frozen=True, array_like=True):
    """One of this robot's links, as the kernel has it now.

    Attributes:
        name, index: of the interface that has its beat address; "" and 0 while none has it.
    """

    name: str = ""
    index: int = 0
    is_wireless: bool = False
    is_loopback: bool = False


class LinksAre(msgspec.Struct, frozen=True, tag=True):
    """Worker to main loop, at each change: this robot's links, in the order of its beat addresses."""

    links: tuple[LinkNow, ...]


class TeamIs(msgspec.Struct, frozen=True, tag=True):
    """Worker to main loop, before its inventory and at each change: the members, as team.toml has them now."""

    robots: dict[str, Robot]


class Ask(msgspec.Struct, frozen=True, tag=True):
    """Worker to main loop: show me the team, decisions that are not on the disk yet, or elections that are. Answer: `Told`."""

    number: int
    what: Literal["status", "why", "elections"]


class BeatCounts(msgspec.Struct, frozen=True):
    """What the heartbeats' sockets have seen.

    Attributes:
        refused: frames not believed, by reason.
        late_us_max: the longest that a turn of the loop came after its deadline.
        gap_us_max: the longest between two beats of one peer.
        gaps: how many were longer than `agent.main_loop.loop.GAP_BEATS` periods.
        lost: parts of each peer's frames that did not arrive, in this life of ours.
        items: values of the board that were not taken, by reason; those that waited for room in a frame.
    """

    sent: int = 0
    heard: int = 0
    unsent: int = 0
    refused: dict[str, int] = {}
    late_us_max: int = 0
    gap_us_max: int = 0
    gaps: int = 0
    lost: dict[str, int] = {}
    items: dict[str, int] = {}


class MediumView(msgspec.Struct, frozen=True):
    """How frames leave over one link.

    Attributes:
        link: its interface, "" while it has none.
        cast: multicast, broadcast or unicast; ``because``: why not multicast, or "".
        by_unicast: the members that get frames by unicast besides: they did not say that they hear the cast.
        period_ms: between two frames.
        no_slots: why it has none though it is a radio, or "".
        slots: None where frames leave at once.
        bytes: of frames: member → that came from it, this robot → that left.
    """

    link: str
    cast: str
    because: str
    by_unicast: tuple[str, ...]
    period_ms: int
    no_slots: str = ""
    slots: SlotsView | None = None
    bytes: dict[str, int] = {}


class Told(msgspec.Struct, frozen=True, tag=True):
    """Main loop to worker: the answer to `Ask`.

    Attributes:
        unwritten: lines of the event log that are not on the disk yet; the worker reads the others itself.
        troubles: sentences: why a vote record, or the event log, cannot be written.
    """

    number: int
    now_ns: int
    status: StatusView | None = None
    unwritten: tuple[Line, ...] = ()
    beats: BeatCounts = BeatCounts()
    troubles: tuple[str, ...] = ()
    media: tuple[MediumView, ...] = ()
    elections: Elections = Elections()


class IsRestart(msgspec.Struct, frozen=True, tag=True):
    """Main loop to worker: the service is told to end; does systemd start it again at once? Answer: `Ends`."""


class Ends(msgspec.Struct, frozen=True, tag=True):
    """Worker to main loop: the answer to `IsRestart`."""

    is_restart: bool


class Farewell(msgspec.Struct, frozen=True, tag=True):
    """Main loop to worker: the agent ends; components live on."""


ToWorker = Order | Life | Told | IsRestart | Farewell
ToMainLoop = Happened | Inventory | SpeakKey | HearKey | LinksAre | TeamIs | Alive | Ask | Ends


def order(act: Act) -> Order:
    """An act, packed."""
    return Order(type(act).__name__, _encoder.encode(act))


def happened(event: Event) -> Happened:
    """An event, packed."""
    return Happened(type(event).__name__, _encoder.encode(event))


def act_of(message: Order) -> Act:
    """The act inside.

    Raises:
        AgentError: there is none; main loop and worker are of different versions.
    """
    return _unpacked(_act_decoders, message)  # type: ignore[no-any-return]


def event_of(message: Happened) -> Event:
    """The event inside.

    Raises:
        AgentError: there is none.
    """
    return _unpacked(_event_decoders, message)  # type: ignore[no-any-return]


def _unpacked(decoders: dict[str, Any], message: Order | Happened) -> Any:
    try:
        return decoders[message.kind].decode(message.body)
    except (KeyError, msgspec.MsgspecError) as error:
        raise AgentError(
            f"main loop and worker process do not understand each other: {message.kind}: {error}; restart the agent"
        ) from error
