"""Events of a node. Events about a component carry the epoch of the act that caused them; a node drops older ones."""

from __future__ import annotations

from msgspec import Struct

from checkpoint.model import Position
from failover.core.types import ComponentSpec, Config
from failover.core.wire.messages import Beat


class Tick(Struct, frozen=True):
    """The instant that ``next_deadline_ns`` asked for has come (or nothing else has happened)."""


class Received(Struct, frozen=True):
    """A beat that passed ``frames.frame.Receiver``: whole, authentic, of our team and version, not seen before.

    Attributes:
        link: name of the link it came over.
        copies: (link, instant) of the latest copy of a beat of this sender that came over each other link. They say nothing but
            that the link carries.
        came_ns: when it came, if it is taken in later because this robot rested; 0: now.
        paces: it has just come over a wire, so that this robot may beat right after it. On a radio frames would meet.
    """

    beat: Beat
    link: str = ""
    copies: tuple[tuple[str, int], ...] = ()
    came_ns: int = 0
    paces: bool = True


class Unread(Struct, frozen=True):
    """Something came from a member that proves nothing of whom it is: a beat under an unknown key, a refusal of our own key.

    Attributes:
        robot: the member whose address it came from; "": an address that is no member's.
        why: what is wrong, for the status; "": the receiver cannot tell.
    """

    robot: str
    why: str = ""


class TeamChanged(Struct, frozen=True):
    """One member has joined the team or left it, or has other keys: this robot's configuration from now on, without components.

    A member that joins counts as silent until it is heard: no takeover waits for it.
    """

    config: Config


class Leave(Struct, frozen=True):
    """This agent is to end, and another one starts at once: its peers are asked to wait. `Node.may_go` says when to end."""


class Started(Struct, frozen=True):
    """The act Start is done: the program runs (or, adopted, has been running) and its keeper is ready."""

    component: str
    epoch: int


class Leased(Struct, frozen=True):
    """The act SetLease that asked for it is done: the guard has no longer lease than that one."""

    component: str
    epoch: int
    until_ns: int


class Captured(Struct, frozen=True):
    """The act Capture is done. The snapshot is durable in this robot's own store and can be shipped and restored from.

    Attributes:
        size: bytes of the encoded snapshot.
        age_ns: how old the state in it was by then: of a program that commits, since its commit.
        cpu_us: processor time that it took, in µs.
    """

    component: str
    epoch: int
    position: Position
    parent: Position | None
    size: int = 0
    freeze_us: int = 0
    age_ns: int = 0
    cpu_us: int = 0


class Unchanged(Struct, frozen=True):
    """The act Capture found what was acknowledged at ``position``: the program rests, or has committed nothing since.

    Attributes:
        sequence: as ordered; no snapshot was made under this number.
        is_current: the program was looked at; else the state is as old as the commit.
    """

    component: str
    epoch: int
    sequence: int
    position: Position
    is_current: bool = False


class UnderWay(Struct, frozen=True):
    """The act Capture or Ship is carried out still; told every few seconds, so that what takes long is not begun anew.

    Attributes:
        position: None: it is being taken.
        to: the robot or server that it is sent to; "" while it is being taken.
    """

    component: str
    epoch: int
    position: Position | None = None
    to: str = ""


class CaptureFailed(Struct, frozen=True):
    """The act Capture came to nothing; the program runs on and nothing was forgotten.

    Attributes:
        unsupported: the program holds something that cannot be preserved (checkpoint.errors.UnsupportedError).
        needs_base: the keeper lost its place (a new keeper): only a base can follow.
    """

    component: str
    epoch: int
    message: str
    unsupported: bool = False
    needs_base: bool = False


class NothingToCapture(Struct, frozen=True):
    """The act Capture came too early: the program keeps its state itself and has committed nothing yet. `Committed` follows."""

    component: str
    epoch: int
    message: str


class Committed(Struct, frozen=True):
    """A program that keeps its state has made its first commit, or the first to another segment: a capture finds it now."""

    component: str
    epoch: int


class ShipEnded(Struct, frozen=True):
    """The transfer ordered by the act Ship has ended: ``ok`` when the last byte was taken by the other side.

    The acknowledgement itself comes with the standby's beats.
    """

    component: str
    epoch: int
    position: Position
    to: str
    ok: bool
    reason: str = ""


class Stored(Struct, frozen=True):
    """On the standby: a snapshot that was admitted is verified, fits the chain, and is durable in this robot's store.

    Attributes:
        keeps_state: to go on from it is to start the program again, which keeps its state itself.
        acknowledged: what the sender said of its line, see `acts.Ship`.
    """

    component: str
    epoch: int
    position: Position
    sender: str
    spec: ComponentSpec
    keeps_state: bool = False
    acknowledged: Position | None = None


class StoreFailed(Struct, frozen=True):
    """On the standby: a snapshot did not fit, or could not be written. What the store already held is intact.

    Attributes:
        needs_base: its parent is not our newest position, or our chain is damaged.
    """

    component: str
    epoch: int
    sender: str
    message: str
    needs_base: bool


class Looked(Struct, frozen=True):
    """The archive was asked which copies it has, from ``begun_ns`` on: of each component this robot's store has the newest one.

    Attributes:
        behind: components of which it has not: one is on its way, or was refused.
        skipped: components that were not compared: this robot runs them, or heard their primary.
    """

    begun_ns: int
    behind: tuple[str, ...] = ()
    skipped: tuple[str, ...] = ()


class Fetched(Struct, frozen=True):
    """A checkpoint from the archive, the newest copy that it had at ``begun_ns``, is verified and durable in this robot's store.

    Attributes:
        epoch: under which it was taken.
        begun_ns: 0 where the archive had a newer one that did not come.
        age_ns: how old the copy is, by the clock of the robot that made it.
    """

    component: str
    epoch: int
    position: Position
    spec: ComponentSpec
    begun_ns: int
    age_ns: int = 0
    keeps_state: bool = False


class Damaged(Struct, frozen=True):
    """A checkpoint that counts as held here cannot be restored: this robot's store found it damaged, or what it needs."""

    component: str
    epoch: int
    position: Position


class Archived(Struct, frozen=True):
    """The archive has a copy of the component that runs here, as it was at ``begun_ns`` or a moment before; None: no more."""

    component: str
    epoch: int
    position: Position | None
    begun_ns: int


class Recovered(Struct, frozen=True):
    """A robot of another site says that an operator recovered the component there: it holds this epoch, or ended it."""

    component: str
    epoch: int
    robot: str


class SitesHeard(Struct, frozen=True):
    """A robot of each other site has told in this life of ours what was recovered there."""


class Restored(Struct, frozen=True):
    """The act Restore is done: the program runs from ``position``, which was captured ``age_ns`` ago (-1: not known).

    Attributes:
        lost_ns: for how long it worked on after that, at most: without the time in which it stood still, or its robot was off.
            -1: not known, so that all of the age may be lost.
    """

    component: str
    epoch: int
    position: Position
    age_ns: int = -1
    lost_ns: int = -1


class ActFailed(Struct, frozen=True):
    """Start or Restore came to nothing and left nothing behind. ``message`` says what to do about it.

    Attributes:
        damaged: the checkpoint, where it cannot be read: it is lost here.
    """

    component: str
    epoch: int
    message: str
    damaged: Position | None = None


class Stopped(Struct, frozen=True):
    """The act Stop is done: no process of this component is left on this robot (asked or not, its keeper and guard are gone)."""

    component: str
    epoch: int


class Warmed(Struct, frozen=True):
    """How it stands with the act Warm, each time that this changes: it waits and is ready, or ``message`` says why not."""

    component: str
    epoch: int
    ready: bool
    message: str = ""


class Inquired(Struct, frozen=True):
    """What robot ``to`` said that it lacks of what the component needs to go on there: nothing, or a sentence for each.

    Attributes:
        has_said: whether it has answered at all.
    """

    component: str
    epoch: int
    to: str
    lacks: tuple[str, ...] = ()
    has_said: bool = True


class Exited(Struct, frozen=True):
    """The program ended by itself.

    Attributes:
        status: waitpid(2)'s: low seven bits the signal (0: none), next byte the exit code.
        refusal: of a program that was started again to keep its state, and ended with an error before it kept any: a sentence. It
            did not go on from what it was given. "" for every other end.
        keeps_state: it keeps its state itself, and has kept some.
        said: to be added to a sentence about its end: the last line of its standard error; "" where there is none.
    """

    component: str
    epoch: int
    status: int
    refusal: str = ""
    keeps_state: bool = False
    said: str = ""


class Noticed(Struct, frozen=True):
    """Something that belongs in the event log and changes nothing: about a component, or ("") about this robot.

    Attributes:
        output_pending: see `failover.core.event_log.decisions.Facts`.
    """

    component: str
    sentence: str
    output_pending: int = -1


class Run(Struct, frozen=True):
    """Operator: start this program here (or, with ``spec.launch.pid``, protect it where it runs). Answered by the act Answer."""

    request: int
    spec: ComponentSpec
    by: int | None = None


class Release(Struct, frozen=True):
    """Operator: let the program run on without protection, and forget its checkpoints everywhere."""

    request: int
    component: str
    by: int | None = None
    decided: int = 0


class Stop(Struct, frozen=True):
    """Operator: end the program with ``signal``; its end is a record like any other."""

    request: int
    component: str
    signal: int = 15
    by: int | None = None
    decided: int = 0


class Handover(Struct, frozen=True):
    """Operator: move the component to robot ``to`` ("" for its standby)."""

    request: int
    component: str
    to: str = ""
    by: int | None = None
    decided: int = 0


class Promote(Struct, frozen=True):
    """Operator: this robot runs components that no other robot is heard to run, without waiting for robots that are silent.

    Attributes:
        is_trial: nothing is done; the answer says what it would be, and what would be at risk.
    """

    request: int
    component: str
    is_trial: bool = False
    by: int | None = None
    decided: int = 0


class Failback(Struct, frozen=True):
    """Operator: move the component back to the robot that is preferred, or else to where it was started.

    ``to``: the robot that the user expects; if it is another one, nothing is done. "": whichever it is.
    """

    request: int
    component: str
    by: int | None = None
    to: str = ""
    decided: int = 0


class Prefer(Struct, frozen=True):
    """Operator: robot ``robot`` runs the component whenever it can ("" for no preference)."""

    request: int
    component: str
    robot: str
    by: int | None = None
    decided: int = 0


class Drain(Struct, frozen=True):
    """Operator: this robot is to run nothing: all that it runs moves to others, and no other comes here; or no longer so."""

    request: int
    is_on: bool = True


Command = Run | Release | Stop | Handover | Promote | Failback | Prefer
"""``by``: uid of the user who gives the order; None: one who may give any. Its right is looked at when it is obeyed.

``decided``: the epoch that the user saw; if it is another one by now, nothing is done. 0: any epoch.
"""

Event = (
    Tick
    | Received
    | Unread
    | TeamChanged
    | Leave
    | Started
    | Leased
    | Captured
    | Unchanged
    | UnderWay
    | CaptureFailed
    | NothingToCapture
    | Committed
    | ShipEnded
    | Stored
    | StoreFailed
    | Looked
    | Fetched
    | Damaged
    | Archived
    | Recovered
    | SitesHeard
    | Restored
    | ActFailed
    | Stopped
    | Warmed
    | Inquired
    | Exited
    | Noticed
    | Drain
    | Command
)
