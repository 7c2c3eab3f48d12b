"""One robot's rules as one object: events in, obligations out.

The agent feeds it one event at a time with the instant of its own clock and carries out ``Ready``: persist → send → act. The
simulator (``tests/simulation``) does the same with many nodes. There is no socket, clock, thread, random number or file in here.
"""

from __future__ import annotations

from msgspec.structs import replace

from checkpoint.model import Position
from failover.core import acts, commands
from failover.core.acts import Ready
from failover.core.beat_builder import Speaker, entry_of
from failover.core.beat_pace import BeatPace
from failover.core.component import Cause, Component, Turn
from failover.core.election import lease, majority, pair, sites, votes
from failover.core.election.coordinator import Word
from failover.core.events import (
    ActFailed,
    Archived,
    Captured,
    CaptureFailed,
    Command,
    Committed,
    Damaged,
    Drain,
    Event,
    Exited,
    Failback,
    Fetched,
    Handover,
    Inquired,
    Leased,
    Leave,
    Looked,
    NothingToCapture,
    Noticed,
    Prefer,
    Promote,
    Received,
    Recovered,
    Release,
    Restored,
    Run,
    ShipEnded,
    SitesHeard,
    Started,
    Stop,
    Stopped,
    Stored,
    StoreFailed,
    TeamChanged,
    Tick,
    Unchanged,
    UnderWay,
    Unread,
    Warmed,
)
from failover.core.membership import Membership
from failover.core.peer_claims import Testimony
from failover.core.replication import archived, servers, standby, warm_standby
from failover.core.status import guarantee, view
from failover.core.status.observations import Watch
from failover.core.transitions import drain, exits, failback, handover, promotion, restarts
from failover.core.types import (
    COMPONENTS_MAX,
    ENDED,
    HOLDING,
    MS,
    ComponentSpec,
    Config,
    Found,
    Held,
    Resumption,
    Rules,
    State,
    StatusView,
    VoteRecord,
)
from failover.core.wire.messages import RETURNED, Beat, Entry

NS_PER_S = 1_000 * MS

LATE_NS = 5 * MS
"""A step this much after the instant asked for is our own lateness, taken back from the peers' silence. Less than the margin."""

REST_NS = MS
"""Between two deadlines: the core looks again at work that waits for another process, after a pause."""

LEAVE_NS = 2_000 * MS
"""An agent that restarts waits no longer for its peers' promises: without them it ends all the same, and is replaced."""

LIVES_MAX = 1 << 40
"""A peer that speaks of so many lives of this robot is not believed."""


class Node:
    """The rules of one robot.

    Args:
        boot: count of this agent's starts, durable already; grows with every start.
        vote_record: what the last ``Ready.persist`` made durable.
        held: what this robot's snapshot store can restore.
        found: components whose guards outlived the last agent.
    """

    def __init__(
        self,
        config: Config,
        boot: int,
        vote_record: VoteRecord,
        now_ns: int,
        held: tuple[Held, ...] = (),
        found: tuple[Found, ...] = (),
    ) -> None:
        self._config = config
        self._boot = boot
        self._now_ns = now_ns
        self._asked_ns = now_ns
        self._pace = BeatPace(now_ns, now_ns)
        self._durable = vote_record
        self._drained = vote_record.drained
        self._team = Membership(config, boot, now_ns, vote_record.awaited)
        self._speaker = Speaker(config.robot, boot, config.rule, len(config.peers) + 1)
        self._watch = Watch()
        self._testimony = Testimony()
        self._outlivers: set[str] = set()
        self._components = {record.name: Component.remembered(record) for record in vote_record.records}
        self._found = {one.component: one for one in found}
        self._begun = False
        self._leaving_ns = self._asked_grace_ns = self._strays_ns = 0
        self._dependents: dict[str, int] = {}
        self._load = 0
        self._waiting: Beat | None = None
        self._promise = ""
        self._grounds: tuple[tuple[str, ...], ...] | None = None
        self._configure(held)

    def step(self, event: Event, now_ns: int) -> Ready:
        """Take in one event at ``now_ns`` (our own clock, which counts sleep) and say what must be done about it."""
        self._now_ns = now_ns = max(now_ns, self._now_ns)
        late_ns = now_ns - self._asked_ns
        if late_ns > LATE_NS:
            self._team.forgive(late_ns, now_ns)
        self._watch.late(late_ns, self._config.loyalty_ns, now_ns)
        before = self._config.peers
        if isinstance(event, TeamChanged):
            self._change_team(event.config, now_ns)
        turn = self._turn(now_ns)
        self._watch.look(turn, event)
        begins = not self._begun
        if begins:
            self._begin(turn)
        if self._leaving_ns:
            self._wait_for_those_that_restart(turn)
        touched = self._take(event, turn)
        if isinstance(event, TeamChanged):
            _say_who_belongs(turn, before)
        if isinstance(event, Tick):
            self._note_promise(turn)
            self._pace.tick(now_ns)
        for component in touched:
            lease.forget_former(component, turn)
            _review(component, turn)
        changed = begins or bool(touched) or self._is_undurable(now_ns)
        persist = self._persist() if changed else None
        send = self._speak(turn) if changed or now_ns >= self._pace.next_ns else ()
        if isinstance(event, Received) and event.paces and self._team.is_first(event.beat.sender, now_ns):
            self._pace.follow(now_ns, self._config.beat_ns)
        self._asked_ns = self._deadline_ns()
        return Ready(persist, send, tuple(turn.acts), tuple(turn.said))

    def outlived_by(self, beat: Beat) -> int:
        """A life of this robot that the sender has heard and that is not an earlier one of ours; 0 for none.

        Our vote record was lost, or is an old copy: a peer that remembers that life believes no beat of ours before a later one.
        It is a lie where at least as many others have heard this life of ours.
        """
        life = self._life_told(beat)
        if not life and not self._outlivers:
            return 0
        self._outlivers.discard(beat.sender)
        if life and beat.sender in self._team.peers:
            self._outlivers.add(beat.sender)
        if not self._outlivers:
            return 0
        others = [peer for peer in self._team.living(self._now_ns) if peer.robot not in self._outlivers]
        return life if len(self._outlivers) > sum(peer.heard_us > 0 for peer in others) else 0

    def _life_told(self, beat: Beat) -> int:
        me, ours = self._config.robot, (self._boot, self._speaker.counter)
        for echo in beat.echoes:
            if echo.robot == me and (echo.boot, abs(echo.counter)) > ours and echo.boot < LIVES_MAX:
                return echo.boot
        return 0

    def may_go(self, now_ns: int) -> bool:
        """After `Leave`: whether this agent may end now: what runs here may act without it, or waiting longer is in vain.

        It ends only after all orders so far were carried out, those of the worker included: the guards know their leases then.
        """
        told = all(
            robot not in self._team.peers or self._team.peers[robot].heard_us >= at for robot, at in self._dependents.items()
        )
        return self._leaving_ns > 0 and (now_ns >= self._leaving_ns or (told and not self.exposed(now_ns)))

    def left_without_promises(self, counter: int) -> None:
        """That beat of ours left while this robot's disk was slow: its promises come with a later one, and so `may_go` waits."""
        self._dependents = {robot: max(at, counter + 1) for robot, at in self._dependents.items()}

    def exposed(self, now_ns: int) -> tuple[str, ...]:
        """The components here that stand still soon after this agent ends, and are taken over, unless it is back at once."""
        turn = self._turn(now_ns)
        held = (component for component in self._components.values() if component.state in HOLDING - {State.FROZEN})
        running = [component for component in held if not restarts.waits(component)]
        return tuple(one.name for one in running if one.state is not State.PRIMARY or not lease.outlasts(one, turn))

    def waits(self, beat: Beat | None) -> None:
        """The newest beat waits for a slot on each link; None: it is on its way. One that waits when the next is made is lost."""
        self._waiting = beat

    def rests(self, now_ns: int) -> bool:
        """Nothing runs or waits anywhere, as far as we know, and no member is missing: what peers say may wait a little."""
        idle = self._begun and all(component.state in ENDED for component in self._components.values())
        return idle and self._team.steady(now_ns)

    def next_deadline_ns(self) -> int:
        """The instant at which a Tick is due."""
        return self._asked_ns

    def status(self, now_ns: int) -> StatusView:
        """The team as this robot sees it."""
        return view.status(self._components, self._turn(max(now_ns, self._now_ns)), self._boot, self._testimony)

    def primaries(self) -> dict[str, tuple[str, int]]:
        """Component → its primary, as far as this robot knows, and the epoch."""
        return {name: (one.primary, one.epoch) for name, one in self._components.items() if one.primary and one.epoch}

    def word(self) -> Word:
        """For etcd: all that this robot holds, once the last ``Ready.persist`` is durable, and its newest heartbeat."""
        return Word(self._boot, self._speaker.counter, tuple(self._entries().values()))

    def _turn(self, now_ns: int) -> Turn:
        counter, leaving = self._speaker.counter + 1, self._leaving_ns > 0
        facts = self._watch.late_ns, self._load, leaving, self._drained, self._testimony.denied_ns
        return Turn(now_ns, self._config, self._team, counter, self._durable, *facts)

    def _note_promise(self, turn: Turn) -> None:
        """The journal has the team's promise at each change, and a component's while it differs from that."""
        grounds = guarantee.grounds(turn)
        if grounds != self._grounds:
            self._grounds = grounds
            sentence = guarantee.team(turn)
            if sentence != self._promise:
                self._promise = sentence
                turn.say_of_robot(sentence)
        for component in self._components.values():
            sentence = guarantee.exception(component, turn)
            if sentence and sentence != component.promise:
                component.promise = sentence
                turn.say(component, sentence)

    # Birth

    def _configure(self, held: tuple[Held, ...]) -> None:
        for spec in self._config.components:
            component = self._components.setdefault(spec.name, Component(spec.name, spec=spec))
            component.spec = _as_declared(component.spec or spec, spec.rules)
            component.autostart = True
        for component in self._components.values():
            component.elects = self._config.by_majority
        for one in held:
            if one.component in self._components:
                component = self._components[one.component]
                component.keeps_state = one.keeps_state
                component.held = [position for position in one.positions if self._may_resume(component, position)]
                standby.remember(component, self._config)
                archived.remember(component, self._config)

    def _change_team(self, config: Config, now_ns: int) -> None:
        """Between two turns: who is a peer, how many are a majority. Leases that were granted and votes that were given stay."""
        self._config = config
        self._team.change(config, now_ns)
        self._speaker.speak_for(config.rule, len(config.peers) + 1)
        for component in self._components.values():
            component.elects = config.by_majority

    def _may_resume(self, component: Component, position: Position) -> bool:
        """Not from a line that lost; nor, where the program that was started anew is still there, from the one before it."""
        is_older = (position.generation, position.sequence) <= component.ended
        return position.generation not in component.lost and not (is_older and component.name in self._found)

    def _begin(self, turn: Turn) -> None:
        """The first step of this life: take over what the last one left running, clear away what it should not have left."""
        self._begun = True
        turn.say_of_robot(f"the agent of {turn.me} begins, life {self._boot}")
        for component in self._components.values():
            found = self._found.pop(component.name, None)
            component.borrowed_ns = found.lease_ns if found is not None else 0
            if component.state is State.PRIMARY:
                _take_up(component, turn, found)
            elif found is not None and component.state not in ENDED:
                component.state = State.STOPPING
                turn.order(acts.Stop(component.name, component.epoch))
            if found is None and not component.held and component.is_to_hold_all(turn.me):
                component.bare = component.has_begun
        for stray in self._found.values():
            self._strays_ns = max(self._strays_ns, stray.lease_ns)
            turn.order(acts.Stop(stray.component, stray.epoch))
        self._found.clear()

    # One event

    def _take(self, event: Event, turn: Turn) -> list[Component]:
        """Take the event in; returns the components that it may have changed."""
        if isinstance(event, Received):
            return self._hear(event, turn)
        if isinstance(event, Leave):
            self._leave(turn)
        if isinstance(event, Drain):
            self._drain(event, turn)
        if isinstance(event, SitesHeard):
            self._team.sites_heard = True
        if isinstance(event, Tick | TeamChanged | Leave | Drain | SitesHeard):
            return list(self._components.values())
        if isinstance(event, Noticed):
            self._note(event, turn)
            return []
        if isinstance(event, Unread):
            self._fail_to_read(event, turn)
            return []
        if isinstance(event, Looked):
            for one in self._components.values():
                archived.looked(one, event)
            return list(self._components.values())
        name = event.spec.name if isinstance(event, Run) else event.component
        component = self._known(name) if isinstance(event, Run | Stored | Fetched) else self._components.get(name)
        if component is None:
            if isinstance(event, Command):
                turn.order(
                    acts.Answer(event.request, False, f"{name} is not known at {turn.me}; failover status lists the components")
                )
            return []
        if isinstance(event, Recovered):
            return [component] if sites.recovered(component, turn, event) else []
        _tell(component, turn, event)
        return [component]

    def _drain(self, event: Drain, turn: Turn) -> None:
        if event.is_on and not turn.config.runs(turn.me):
            turn.order(acts.Answer(event.request, False, f"cannot drain {turn.me}: it runs nothing anyway"))
            return
        self._drained = turn.drained = event.is_on
        for component in self._components.values():
            component.drain_ns, component.unfit = turn.now_ns, ()
        is_so = "is drained: what it runs moves to others" if event.is_on else "is drained no more: it may run components again"
        turn.say_of_robot(f"{turn.me} {is_so}, as an operator ordered")
        turn.order(acts.Answer(event.request, True, f"{turn.me} {is_so}"))

    def _leave(self, turn: Turn) -> None:
        """Ask the peers to wait; for their promises wait only where there is something that they could take over."""
        if self._leaving_ns:
            return
        grace_ms = turn.config.restart_grace_ms
        self._asked_grace_ns = turn.now_ns
        self._dependents = self._depend_on_us(turn) if grace_ms else {}
        for robot in self._dependents:
            self._team.promise_unasked(robot, turn.now_ns)
        needs_time = grace_ms and (self._dependents or self.exposed(turn.now_ns))
        self._leaving_ns = turn.now_ns + (LEAVE_NS if needs_time else 0)
        turn.leaving, self._pace.next_ns = True, turn.now_ns
        how = f"it asks its peers to wait {grace_ms / 1_000:g} s for the next one" if grace_ms else "no robot is asked to wait"
        turn.say_of_robot(f"the agent of {turn.me} is about to restart: {how}")

    def _depend_on_us(self, turn: Turn) -> dict[str, int]:
        """Primaries whose lease ends without our echoes, and the beat of ours that each must have heard before we go."""
        living = {peer.robot for peer in turn.team.living(turn.now_ns)}
        is_needed = turn.config.by_majority and len(living) < turn.config.quorum
        held = (one for one in self._components.values() if one.primary in living and (is_needed or one.freezes))
        return {component.primary: turn.next_counter for component in held}

    def _wait_for_those_that_restart(self, turn: Turn) -> None:
        """Where all agents of a team are upgraded at once: one whose peer has just gone leaves after that one is back."""
        limit_ns = self._asked_grace_ns + turn.config.restart_grace_ms * MS
        if turn.now_ns < limit_ns and any(turn.team.awaited_ns(robot, turn.now_ns) for robot in turn.team.peers):
            self._leaving_ns = max(self._leaving_ns, turn.now_ns + LEAVE_NS)

    def _note(self, event: Noticed, turn: Turn) -> None:
        component = self._components.get(event.component)
        if component is not None:
            turn.say(component, event.sentence, event.output_pending)
        elif not event.component:
            turn.say_of_robot(event.sentence)

    def _fail_to_read(self, event: Unread, turn: Turn) -> None:
        sentence = self._team.unreadable(event.robot, event.why, turn.now_ns)
        if sentence:
            turn.say_of_robot(sentence)

    def _hear(self, event: Received, turn: Turn) -> list[Component]:
        beat, refused = self._testimony.take(event.beat, turn, self._components)
        news = self._team.hear(beat, event.link, event.came_ns or turn.now_ns)
        if event.copies and beat.sender in self._team.peers:
            self._team.peers[beat.sender].carried(event.copies)
        if not news and not self._components:
            return []
        rules = votes if self._config.by_majority else pair
        touched = {name: component for name, component in self._components.items() if component.holding}
        for entry in news:
            is_hearsay = sites.is_hearsay(self._components.get(entry.name), turn, entry)
            component = None if entry.name in refused or is_hearsay else self._known(entry.name, beat.sender)
            if component is None:
                continue
            rules.heard(component, turn, beat.sender, entry)
            pair.heard_of_checkpoints(component, entry)
            standby.acknowledged(component, turn, beat.sender, entry)
            touched[component.name] = component
        return list(touched.values())

    def _known(self, name: str, sender: str = "") -> Component | None:
        """The component, made if there is room. A server fills half of it; a witness, which has nothing of it, makes none."""
        room = COMPONENTS_MAX
        if sender and not self._config.runs(sender):
            room = COMPONENTS_MAX // 2 if self._config.keeps(sender) else 0
        if name not in self._components and len(self._components) < room:
            self._components[name] = Component(name, elects=self._config.by_majority)
        return self._components.get(name)

    # What leaves

    def _speak(self, turn: Turn) -> tuple[Beat, ...]:
        """The beat that is due, or that a component's change makes due."""
        entries = self._entries()
        pressing = self._speaker.pressing(entries)
        if pressing:
            self._pace.press()
        if turn.now_ns < self._pace.next_ns:
            return ()
        if self._waiting is not None:
            self._speaker.unsaid(self._waiting)
            self._waiting = None
        grace_ms = turn.config.restart_grace_ms if turn.leaving else self._returned(turn)
        promises = self._team.promises(self._durable.awaited) if self._durable.awaited else ()
        beat = self._speaker.beat(entries, self._team.echoes(turn.now_ns), grace_ms, promises, drained=self._drained)
        self._load = beat.load
        self._team.asked(beat.counter, turn.now_ns)
        self._pace.left(turn.now_ns, self._config.beat_ns)
        return (beat,)

    def _returned(self, turn: Turn) -> int:
        """Whether what the peers have promised to an earlier life of this agent is void, in the words of a beat."""
        is_back = not any(lease.borrows(component, turn) for component in self._components.values())
        return RETURNED if is_back and turn.now_ns >= self._strays_ns else 0

    def _entries(self) -> dict[str, Entry]:
        starts = self._config.by_majority
        known = (component for component in self._components.values() if component.epoch or (starts and component.autostart))
        return {component.name: entry_of(component) for component in known}

    def _persist(self) -> VoteRecord | None:
        records = tuple(component.record() for component in self._components.values() if component.epoch)
        vote_record = VoteRecord(records, self._team.awaited(self._now_ns), self._drained)
        if vote_record == self._durable:
            return None
        self._durable = vote_record
        return vote_record

    def _is_undurable(self, now_ns: int) -> bool:
        """Whether something of the robot as a whole is to be remembered, and is not on the disk."""
        return (self._team.awaited(now_ns), self._drained) != (self._durable.awaited, self._durable.drained)

    def _deadline_ns(self) -> int:
        if self._pace.follows:
            return self._now_ns
        instants = [self._pace.next_ns]
        death_ns = self._team.next_death_ns(self._now_ns)
        if death_ns is not None:
            instants.append(death_ns)
        for component in self._components.values():
            instants += _instants(component)
        return max(min(instants), self._now_ns + REST_NS)


def _say_who_belongs(turn: Turn, before: tuple[str, ...]) -> None:
    joined, left = sorted(set(turn.config.peers) - set(before)), sorted(set(before) - set(turn.config.peers))
    news = [f"{robot} joins the team" for robot in joined] + [f"{robot} leaves the team" for robot in left]
    together = len(turn.config.peers) + 1
    how = f"{turn.config.quorum} are a majority" if turn.config.by_majority else "by rule = pair"
    turn.say_of_robot(f"{'; '.join(news) or 'an entry of the team changes'}: now {together} {how}")


def _as_declared(spec: ComponentSpec, said: Rules) -> ComponentSpec:
    """What agent.toml says of its restarts now, also where the vote record remembers it from an earlier life."""
    window_ms = said.restart_window_ms
    rules = replace(spec.rules, restart=said.restart, restart_limit=said.restart_limit, restart_window_ms=window_ms)
    return replace(spec, rules=rules)


def _instants(component: Component) -> list[int]:
    """When something is due for a component before the next beat, perhaps."""
    match component.state:
        case State.PRIMARY:
            due = [] if component.flight or component.unprotected else [component.due_ns]
            return [*due, *([component.lease_ns] if component.lease_ns else [])]
        case _:
            return []


def _take_up(component: Component, turn: Turn, found: Found | None) -> None:
    """The last life of this agent held the primacy: its program runs on, has ended, or is gone with the machine."""
    if found is None:
        component.state = State.STANDBY
        return
    component.born = min(found.epoch, component.epoch)
    component.state = State.FROZEN
    component.stood = True
    component.standby = component.entrusted[0] if component.entrusted else ""
    pair.open_line(component, turn)
    if found.running and lease.inherit(component, turn, found.lease_ns):
        component.move(Cause.LEASE_BACK)
        left_s = (found.lease_ns - turn.now_ns) / NS_PER_S
        turn.say(
            component, f"the agent of {turn.me} is back; it has run on, and may for {left_s:.1f} s more, until a peer is heard"
        )
    elif not found.running:
        status, keeps_state = found.status, component.keeps_state
        exits.exited(component, turn, Exited(component.name, component.epoch, status, keeps_state=keeps_state))
    elif lease.on_lease(component, turn):
        turn.order(acts.Freeze(component.name, component.epoch))
        turn.say(component, f"{turn.me} is back, and freezes it until a robot hears {turn.me}, or no other one runs it")
    else:
        component.move(Cause.LEASE_BACK)


def _tell(component: Component, turn: Turn, event: Event) -> None:
    match event:
        case Started() | Restored():
            _runs(component, turn, event)
        case Captured():
            standby.captured(component, turn, event)
        case Unchanged():
            standby.unchanged(component, turn, event)
        case UnderWay():
            standby.under_way(component, turn, event)
        case CaptureFailed():
            standby.capture_failed(component, turn, event)
        case NothingToCapture():
            standby.nothing_to_capture(component, turn, event)
        case Committed():
            standby.committed(component, turn, event)
        case ShipEnded():
            standby.ship_ended(component, turn, event)
            servers.ship_ended(component, turn, event)
        case Stored():
            standby.stored(component, turn, event)
        case StoreFailed():
            standby.store_failed(component, turn, event)
        case Fetched():
            archived.fetched(component, turn, event)
        case Damaged():
            archived.damaged(component, turn, event)
        case Archived():
            archived.archived(component, event)
        case ActFailed():
            exits.failed(component, turn, event)
        case Exited():
            exits.exited(component, turn, event)
        case Warmed():
            warm_standby.warmed(component, turn, event)
        case Inquired():
            failback.inquired(component, turn, event)
        case Leased():
            component.borrowed_ns = 0
        case Stopped():
            if component.state is State.STOPPING:
                component.move(Cause.CLEARED)
        case Run() | Release() | Stop() | Handover() | Promote() | Failback() | Prefer():
            commands.obey(component, turn, event)


def _runs(component: Component, turn: Turn, event: Started | Restored) -> None:
    expected = component.state in (State.STARTING, State.TAKING_OVER, State.RECOVERING)
    if not expected or event.epoch != component.epoch:
        return
    if restarts.waits(component):  # a start that took too long: the next one begins with nothing left of it
        turn.order(acts.Stop(component.name, component.epoch))
        return
    lost = ""
    how = "it runs" if isinstance(event, Started) else f"it resumes from checkpoint {event.position.sequence}"
    if isinstance(event, Restored) and event.age_ns >= 0 and not archived.gave(component, event.position):
        component.lost_ns = event.age_ns if event.lost_ns < 0 else event.lost_ns
        component.resumed_ns = turn.now_ns - component.lost_ns
        lost = f"; it lost {component.lost_ns / NS_PER_S:.1f} s of its work"
    component.move(Cause.RUNS)
    component.resumption = Resumption.RESTARTED  # of what comes next, if that is here
    component.due_ns = turn.now_ns
    component.return_ns = turn.now_ns + failback.PAUSE * turn.config.retry_ms * MS
    turn.say(component, f"{how} at {turn.me}, epoch {component.epoch}{lost}")
    if component.request:
        turn.order(acts.Answer(component.request, True, f"{component.name} runs at {turn.me}"))
        component.request = 0
    if component.end_signal:
        turn.order(acts.End(component.name, component.epoch, component.end_signal))
        component.end_signal = 0


def _review(component: Component, turn: Turn) -> None:
    """What the passing of time, or what was just heard, makes due for one component."""
    exits.overdue(component, turn)
    if component.wanted is not None:
        promotion.advance(component, turn)
    if turn.config.by_majority:
        majority.look(component, turn)
    if turn.config.copies_ms:
        archived.review(component, turn)
    if component.state in (State.ABSENT, State.STANDBY):
        _review_idle(component, turn)
    standby.show(component, turn)
    if component.state is State.CLAIMING:
        (votes if turn.config.by_majority else pair).advance(component, turn)
    if component.holding and component.state is not State.CLAIMING:
        _review_held(component, turn)
    if component.state in ENDED:
        exits.report(component, turn)
    warm_standby.review(component, turn)


def _review_idle(component: Component, turn: Turn) -> None:
    exits.retry(component, turn)
    servers.admit_a_return(component, turn)
    if not sites.waits_ns(component, turn):
        (votes if turn.config.by_majority else pair).consider(component, turn)
    if component.state in (State.ABSENT, State.STANDBY):
        servers.give_back(component, turn)


def _review_held(component: Component, turn: Turn) -> None:
    sites.settle(component, turn)
    lease.watch(component, turn)
    if component.crashed:
        exits.crashed(component, turn, component.crashed)
    standby.overdue(component, turn)
    standby.confirm(component, turn)
    if component.state is State.PRIMARY:
        standby.choose_standby(component, turn)
        standby.capture(component, turn)
        servers.advance(component, turn)
        (drain if turn.drained else failback).review(component, turn)
    handover.advance(component, turn)
