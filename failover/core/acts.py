"""Acts that a node orders. The agent carries out ``Ready`` in this order: persist → send → act; the acts in the order given.

Every act carries the epoch under which the node decided it. The agent drops an act when it has seen a later epoch for that
component, and returns the epoch with the event that answers the act.
"""

from __future__ import annotations

from msgspec import Struct

from checkpoint.model import Position
from failover.core.event_log.decisions import Decision
from failover.core.types import ComponentSpec, Resumption, VoteRecord
from failover.core.wire.messages import Beat


class Start(Struct, frozen=True):
    """Begin (or adopt) the program. → Started, ActFailed.

    Attributes:
        lease_until_ns: given to the guard before the program runs; 0 = no lease.
        generation: of the snapshots that will be taken of it.
    """

    component: str
    epoch: int
    spec: ComponentSpec
    lease_until_ns: int = 0
    generation: int = 0


class Restore(Struct, frozen=True):
    """Bring the program back from ``position``, which this robot's store holds. → Restored, ActFailed.

    The agent first clears away the remains of the component on this robot (a crashed process, an old guard).

    Attributes:
        lease_until_ns: given to the guard before the program runs; 0 = no lease.
        why: the reason that the program is told.
        generation: of the snapshots that will be taken of it.
    """

    component: str
    epoch: int
    position: Position
    spec: ComponentSpec | None
    lease_until_ns: int = 0
    why: Resumption = Resumption.RESTARTED
    generation: int = 0


class Capture(Struct, frozen=True):
    """Take a snapshot and keep it durably in this robot's store. → Captured, Unchanged, CaptureFailed. One at a time.

    Attributes:
        base: whole; otherwise a delta since the last position that was acknowledged to the keeper, or `Unchanged`.
        hold: leave the program frozen afterwards (the last delta of a handover); the act Thaw or Stop follows. Never `Unchanged`.
        lag_ns: a program that runs tasks of the schedule stands still between two activations: how long to wait for such a moment
            (`failover.core.schedule.slack`); 0: not at all.
    """

    component: str
    epoch: int
    base: bool
    generation: int
    sequence: int
    hold: bool = False
    lag_ns: int = 0


class Ship(Struct, frozen=True):
    """Send the snapshot at ``position`` over the replication link. → ShipEnded.

    Attributes:
        parent: the standby's present position; None for a base.
        whole: the store's chain up to ``position`` folded into one base (a checkpoint that is given back).
        acknowledged: the newest position of its line that counts as acknowledged; None: not known.
    """

    component: str
    epoch: int
    position: Position
    parent: Position | None
    to: str
    spec: ComponentSpec
    whole: bool = False
    acknowledged: Position | None = None


class CancelShip(Struct, frozen=True):
    """Give up the transfer of ``position``; a delta that no member waits for any more. No answer."""

    component: str
    epoch: int
    position: Position
    to: str


class Accept(Struct, frozen=True):
    """The snapshot at ``position``, of which `Stored` told, counts from now on as held here. No answer.

    Until then the agent does nothing with it: no ready copy follows it, no reader sees its output.
    """

    component: str
    epoch: int
    position: Position


class Discard(Struct, frozen=True):
    """The snapshot at ``position``, of which `Stored` told, came too late: the store forgets it. No answer."""

    component: str
    epoch: int
    position: Position


class Show(Struct, frozen=True):
    """The component's output up to ``position``, which is held here, is acknowledged: readers may see it. No answer."""

    component: str
    epoch: int
    position: Position


class Acknowledge(Struct, frozen=True):
    """Tell the keeper that ``position`` is a checkpoint: the next delta counts from here. No answer.

    Attributes:
        is_safe: a standby holds it, or this robot is the whole team: a program that waits for it may go on. False where no other
            member is there just now.
    """

    component: str
    epoch: int
    position: Position
    is_safe: bool


class Admit(Struct, frozen=True):
    """From now on snapshots of this component are taken from ``sender`` at ``epoch`` or later ("": from no robot). No answer."""

    component: str
    epoch: int
    sender: str


class Freeze(Struct, frozen=True):
    """Stop every thread of the component. No answer; the guard does it by itself when the lease has run out."""

    component: str
    epoch: int


class Thaw(Struct, frozen=True):
    """Let it go on; ``lease_until_ns`` is given to the guard first (0 = no lease). No answer."""

    component: str
    epoch: int
    lease_until_ns: int = 0


class SetLease(Struct, frozen=True):
    """The guard freezes the component when its clock passes ``until_ns``; 0 = no lease. → Leased, where it is asked for.

    Attributes:
        is_asked: it is shorter than the one that the guard has: the core waits for the word that the guard has taken it.
    """

    component: str
    epoch: int
    until_ns: int
    is_asked: bool = False


class KeepAside(Struct, frozen=True):
    """Keep the state of a copy that lost as a snapshot of its own, for inspection, before the Stop that follows. No answer."""

    component: str
    epoch: int
    reason: str


class Forget(Struct, frozen=True):
    """The snapshots of ``generations`` lost against the present primary: they leave the chain (aside, if they are kept)."""

    component: str
    epoch: int
    generations: tuple[int, ...]


class End(Struct, frozen=True):
    """End the program: with ``signal`` as the operator asked. → Exited."""

    component: str
    epoch: int
    signal: int


class Stop(Struct, frozen=True):
    """Kill this robot's copy at once and clear it away; there may be none. → Stopped. Its exit is not the component's result."""

    component: str
    epoch: int


class LetGo(Struct, frozen=True):
    """Detach keeper and guard; the program runs on unprotected. No answer."""

    component: str
    epoch: int


class Warm(Struct, frozen=True):
    """Have the program wait before its next step, under no epoch and no lease, until Restore uses it. → Warmed.

    One that keeps its state is started in advance; of any other a stopped process holds the newest checkpoint's memory.

    One that waits already is replaced. Whenever one fails or ends, the agent tries again, until `Cool`; Start, Restore and Stop
    end it where they do not use it.
    """

    component: str
    epoch: int
    spec: ComponentSpec


class Cool(Struct, frozen=True):
    """End the program or copy of this component that waits on this robot. No answer."""

    component: str
    epoch: int


class Inquire(Struct, frozen=True):
    """Ask robot ``to`` which needs of the component it does not meet. → Inquired, unless the robot cannot be asked."""

    component: str
    epoch: int
    to: str


class Look(Struct, frozen=True):
    """Look into the archive now, not only when a period is over. → Looked, Fetched, unless the archive does not answer."""

    component: str
    epoch: int


class Prune(Struct, frozen=True):
    """Snapshots that are not needed to restore ``oldest`` or a later position may go."""

    component: str
    epoch: int
    oldest: Position


class Drop(Struct, frozen=True):
    """Forget every snapshot of the component on this robot."""

    component: str
    epoch: int


class ReportExit(Struct, frozen=True):
    """The end of the component is a record: tell the clients that wait for it (``failover run``).

    Attributes:
        status: waitpid's.
        acknowledged: the standby knows it too; False when this robot is alone.
        failed: it did not end by itself: ``reason`` says why no robot runs it any more.
    """

    component: str
    epoch: int
    status: int
    acknowledged: bool
    failed: bool = False
    reason: str = ""


class Answer(Struct, frozen=True):
    """The reply to an operator's command; ``sentence`` says what was done, or why not, and the cure.

    Attributes:
        risks: of a promotion that was only asked about: a sentence for each reason to think before it is ordered.
    """

    request: int
    ok: bool
    sentence: str
    risks: tuple[str, ...] = ()


Act = (
    Start
    | Restore
    | Capture
    | Ship
    | CancelShip
    | Accept
    | Discard
    | Show
    | Acknowledge
    | Admit
    | Freeze
    | Thaw
    | SetLease
    | KeepAside
    | Forget
    | End
    | Stop
    | LetGo
    | Warm
    | Cool
    | Inquire
    | Look
    | Prune
    | Drop
    | ReportExit
    | Answer
)


class Ready(Struct, frozen=True):
    """The obligations after one step, in the order in which they are met.

    Attributes:
        persist: the whole vote record, to be made durable before anything else; None when it has not changed.
        send: beats, each for every peer over every link.
        told: the decisions, for ``failover why``; no step waits for them.
    """

    persist: VoteRecord | None = None
    send: tuple[Beat, ...] = ()
    act: tuple[Act, ...] = ()
    told: tuple[Decision, ...] = ()
