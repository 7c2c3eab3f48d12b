"""The worker process of a robot or a server: snapshots, programs, users' requests; all work that may be slow.

Started as `python -m agent.system.child_main agent.worker.process CONFIG DESCRIPTOR`. One asyncio loop at ordinary priority. The
main loop orders (`agent.main_loop.messages`); this process carries out and answers. If it dies, the main loop starts another;
guards and programs live on and are found again by their sockets. If the main loop dies, this process ends.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
from collections.abc import Coroutine
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from agent.config import Settings
from agent.core_config import fetches, retention
from agent.errors import TROUBLE, AgentError, GuardLostError, LaneError, RefusedError
from agent.main_loop.messages import Inventory, Told, ToWorker
from agent.system import last_alive
from agent.system.crash import end_worker_on_mistake
from agent.system.last_alive import SIGN_S, LastAlive
from agent.system.systemd_units import starter
from agent.worker import schedule_place
from agent.worker.components import launch, prerequisites
from agent.worker.components.context import Surroundings
from agent.worker.components.hooks import Hooks
from agent.worker.components.paths import Places, guard_sockets
from agent.worker.components.process_pool import ProcessPool
from agent.worker.components.resume_order import ResumeOrder
from agent.worker.components.run_records import Records
from agent.worker.components.snapshots import newest_of
from agent.worker.components.statistics import Memory
from agent.worker.components.supervisor import Supervisor
from agent.worker.control.status_view import WorkerView, team_view
from agent.worker.control.verbs import Verbs
from agent.worker.hub import Switchboard, live, make_directory
from agent.worker.network.remote_orders import ITEMS, RECOVERED
from agent.worker.replication.receive_files import Limits, Stock
from agent.worker.replication.receive_snapshots import Deposit
from agent.worker.replication.send_files import Bringing, Sources
from agent.worker.replication.send_snapshots import Dispatch
from agent.worker.replication.transfer import Receiver, Shipper
from checkpoint.engine import COOPERATIVE
from checkpoint.engines.ptrace.facts import memory_limits
from checkpoint.errors import CheckpointError, StoreError
from checkpoint.keeper import messages
from checkpoint.keeper.messages import Channel
from checkpoint.model import Snapshot
from checkpoint.runtime import allocator
from checkpoint.snapshot.required_files import Need, names_of_contents, needs
from checkpoint.store import lost_copies
from checkpoint.store.content_store import FOLDER as CONTENTS_FOLDER
from checkpoint.store.contract import SnapshotStore
from checkpoint.store.store import open_store
from checkpoint.store.xor_cache_budget import PageBudget
from failover.boards import LINK_NAME
from failover.config.quantities import size_bytes
from failover.core import acts, events
from failover.core.types import HISTORY_MAX, ComponentSpec, Found, Held
from failover.core.wire.messages import Belongings, Bulk, Cancel, Chunk, Content, Credit, Lacking, Offer, Refuse, Taken
from failover.errors import FailoverError

if TYPE_CHECKING:
    from agent.worker.alerts import Alerts
    from agent.worker.archiving import Archiving
    from agent.worker.far_items import FarItems
    from agent.worker.fetching import Arrived, Fetching
    from agent.worker.recoveries import Recoveries

BYTES_A_MEGABIT: Final = 125_000
TIDY_S: Final = 900.0
"""Between two looks for brought files that no snapshot needs any more."""

GIVE_BACK_S: Final = 20.0
"""Between two times that free memory goes back to the kernel: a few milliseconds in a thread of its own."""

LOOK_S: Final = 3.0
"""Between two looks whether the files of running programs are still there."""

LACKS_S: Final = 30.0
"""Between two looks what this robot lacks of what its components need; each costs a keeper's start."""

STORE_TRIES: Final = 50
STORE_PAUSE_S: Final = 0.1
"""Between two tries to have the store: it is also what keeps two lives of an agent apart."""

NO_RESUME: Final = (
    'resume = true in [store] has no effect here: it is for robots that vote by rule = "majority"; give two robots a witness, '
    "or remove it, and restart the agent"
)

log = logging.getLogger("failover.lanes")


class Worker(Switchboard):
    """One life of the process."""

    def __init__(self, settings: Settings, main_loop: Channel[ToWorker]) -> None:
        super().__init__(settings, main_loop)
        self.supervisors: dict[str, Supervisor] = {}
        self._inquiries: set[str] = set()
        config = settings.config
        state, runtime = Path(config.state_directory), Path(config.runtime_directory)
        self._store_path = state / "store"
        sockets = runtime / "guards"
        self._starter = starter()
        self._process_pool = ProcessPool(sockets, self._starter)
        contents = str(self._store_path / CONTENTS_FOLDER) if config.bring else ""
        self._alive = LastAlive.found(state / last_alive.FILE_NAME)
        self.places = Places(
            sockets, state / "logs", self._process_pool, "", config.robot, contents, PageBudget(config.xor_cache_size)
        )
        self._shipper = Shipper(self._replication_link, config.link_mbit_s * BYTES_A_MEGABIT)
        verbs = Verbs(self, self.gate)
        self._reservations = verbs.reservations
        self._far_items: FarItems | None = None
        self._recoveries: Recoveries | None = None
        self.connect(verbs, {ITEMS: self._asked_for_items, RECOVERED: self._asked_for_recoveries})
        self._alerts: Alerts | None = None
        self._archiving: Archiving | None = None
        self._fetching: Fetching | None = None

    async def prepare(self) -> Inventory:
        """Open the store, find what outlived the last agent."""
        for directory in (self.places.sockets, self.places.logs):
            make_directory(directory)
        self._board_place: Path | None = None
        await self._provide_board()
        await self._declare_tasks()
        store = self._store = await self._open_store()
        records = Records(self._runtime / "running")
        hooks, here = Hooks(self._starter), self.settings.component
        self._deposit = Deposit(store, self.places, self.tell, self._accepted, runs=self.settings.me.role == "robot", here=here)
        settled = self._deposit.settled
        order = ResumeOrder({name: task.after for name, task in self.settings.config.tasks.items()})
        self._around = Surroundings(
            self.places, store, records, self.tell, self._silence_ns, settled, here, hooks, self._alive, order
        )
        self._sources = Sources(store, self._from_program)
        self._bringing = Bringing(self._shipper, self._replication_link.say, self._sources.open, self._note_bringing)
        self._dispatch = Dispatch(
            store, self._shipper, self.tell, self._links.hindrance, self._bringing, lambda name: here(name).bring_data
        )
        self._receiver = Receiver(self._replication_link, self._store_path, self._deposit)
        self._stock = Stock(store, self._limits(), self.settings.config.robot, self._deposit.hindrance)
        self._contents = Receiver(self._replication_link, self._store_path, self._stock)
        self._tasks: set[asyncio.Task[None]] = set()
        self._new_here = asyncio.Event()
        self._task(self._tidy_contents())
        self._task(self._give_back())
        self._task(self._give_signs())
        self._task(self._reservations.tell_again())
        if self._board_place is not None:
            from agent.worker.kept_items import Keeper  # here: a team without a board does not load it

            self._task(Keeper(self._board_place, Path(self.settings.config.state_directory)).watch())
        self._exchange_far_items()
        self._exchange_recoveries()
        if self.settings.me.role == "robot":
            self._task(self._look_what_is_lacking())
        if self.settings.config.bring:
            self._task(self._keep_what_goes())
        if self.settings.config.alerts.wanted:
            from agent.worker.alerts import Alerts  # here: a robot that tells nobody does not load it

            self._alerts = Alerts(self.settings, self.verbs, self.tell, hooks)
            self._alerts.begin()
        if self.settings.config.store.place:
            from agent.worker.archiving import Archiving  # here: a member without an archive does not load it
            from agent.worker.replication.send_sealed import Courier

            witness = self.settings.config.store.witness
            courier = Courier(self.errands, self._shipper, witness, lambda: self._way_is_shut(witness)) if witness else None
            self._archiving = Archiving(self.settings, store, self._running_here, self._sources.open, self.tell, courier)
            self._task(self._archiving.run())
            if fetches(self.settings):
                from agent.worker.fetching import Fetching  # here: few robots go on from an archive

                listed = self._archiving.listed
                self._fetching = Fetching(
                    self.settings, store, lambda: self.ask("status"), self.tell, self._arrived, listed, courier
                )
                self._task(self._fetching.run())
            elif self.settings.config.store.resume:
                self._own_troubles.append(NO_RESUME)
        found = await self._find_guards(records)
        await self._mend_logs(found)
        if found:
            self._process_pool.begin()
        return Inventory(_held(store), found)

    async def prepare_team(self) -> None:
        """See `agent.worker.hub.Switchboard.prepare_team`: a file of the board for each member."""
        if self._board_place is not None:
            await self._provide_board()
        self._exchange_far_items()
        self._exchange_recoveries()

    def _exchange_recoveries(self) -> None:
        """Hear and tell what operators recovered at which site; a robot that knows no other site loads nothing for that."""
        if self._recoveries is None and self.settings.far:
            from agent.worker.recoveries import Recoveries

            self._recoveries = Recoveries(self)
            self._task(self._recoveries.run())

    async def _asked_for_recoveries(self, _peer: str, _arguments: dict[str, Any]) -> dict[str, Any]:
        if self._recoveries is None:
            raise RefusedError(f"{self.settings.config.robot} knows no other site")
        return await self._recoveries.told()

    def _exchange_far_items(self) -> None:
        """Have the items of other sites, and let them have ours; a robot that knows no other site loads nothing for that."""
        place = self._board_place
        if place is None or (self._far_items is None and not self.settings.far):
            return
        try:
            if self._far_items is not None:
                self._far_items.open(place)
                return
            from agent.worker.far_items import FarItems

            self._far_items = FarItems(self, place, self._life.boot)
        except (FailoverError, OSError) as error:
            log.warning("no items of other sites: %s", error)
            self._board_troubles.append(f"items of other sites cannot be had: {error}")
        else:
            self._task(self._far_items.run())

    async def _asked_for_items(self, peer: str, arguments: dict[str, Any]) -> dict[str, Any]:
        if self._far_items is None:
            raise RefusedError(f"{self.settings.config.robot} has no board, or knows no other site")
        return await self._far_items.told(peer, arguments)

    def notices(self) -> list[str]:
        """See `agent.worker.hub.Switchboard.notices`; besides which users have damaged their files of the board."""
        if self._board_place is None:
            return super().notices()
        from agent.worker import board_directory  # here: a team without a board does not load it

        return [*super().notices(), *board_directory.damaged_files(self._board_place)]

    async def _provide_board(self) -> None:
        self._board_troubles.clear()
        if not self.settings.team.board.items and not os.path.lexists(self._runtime / LINK_NAME):
            self._provide_place_of_schedule()
            return
        from agent.worker import board_directory  # here: a team without a board does not load it

        try:
            place = await asyncio.to_thread(board_directory.provide, self.settings, self._board_troubles.append)
        except (AgentError, FailoverError, OSError) as error:
            log.warning("no board: %s", error)
            self._board_troubles.append(f"programs here have no board of the team: {error}")
        else:
            self._board_place = place
            if place is not None:
                log.info("the board is %s", place)
            else:
                self._provide_place_of_schedule()

    def _provide_place_of_schedule(self) -> None:
        if self.settings.me.role != "robot":
            return
        try:
            schedule_place.provide(self._runtime, self.settings.config.group)
        except (AgentError, OSError) as error:
            log.warning("no schedule: %s", error)
            self._own_troubles.append(f"tasks of different users have no schedule together: {error}")

    async def _declare_tasks(self) -> None:
        if not self.settings.config.tasks:
            return
        from agent.worker import declared_tasks  # here: a robot without tasks does not load them

        try:
            for note in await asyncio.to_thread(declared_tasks.declare, self.settings):
                log.info("%s", note)
        except (FailoverError, OSError) as error:
            log.warning("tasks not declared: %s", error)
            self._own_troubles.append(f"the tasks of agent.toml are not on the schedule: {error}")

    async def _give_signs(self) -> None:
        """While a program runs here, or a checkpoint of one comes here: after a power cut the next life knows when that ended.

        The very first sign comes before any program: it may be cut off within a second.
        """
        if not self._alive.before_ns:
            await asyncio.to_thread(self._alive.sign)
        while True:
            if any(one.component is not None or one.figures.spec is not None for one in self.supervisors.values()):
                await asyncio.to_thread(self._alive.sign)
            await asyncio.sleep(SIGN_S)

    async def stop_work(self) -> None:
        """Give up what is under way; guards and programs live on."""
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        if self._alerts is not None:
            await self._alerts.close()
        await self._dispatch.close()
        await self._bringing.close()
        await asyncio.gather(*(supervisor.close() for supervisor in self.supervisors.values()))

    async def close(self) -> None:
        """Let another life have the store."""
        await self._process_pool.close()
        if self._far_items is not None:
            self._far_items.close()
        self._store.close()

    async def _open_store(self) -> SnapshotStore:
        """Have the store to ourselves; an earlier life of the agent that still ends is waited for."""
        for _ in range(STORE_TRIES):
            try:
                kept = retention(self.settings.config)
                return await asyncio.to_thread(open_store, self._store_path, None, kept, self.places.budget)
            except StoreError as error:
                trouble: StoreError = error
                await asyncio.sleep(STORE_PAUSE_S)
        raise trouble

    def obeys(self, act: acts.Act) -> None:
        """Carry an act of the core out."""
        if self._alerts is not None:
            self._alerts.ordered(act)
        match act:
            case acts.Answer():
                self.answered(act)
            case acts.Admit():
                self._deposit.admit(act)
            case acts.Accept():
                if self._fetching is None or not self._fetching.accepted(act):
                    self._deposit.accept(act)
            case acts.Look():
                if self._fetching is not None:
                    self._fetching.look(act.component)
            case acts.Discard():
                self._task(self._deposit.discard(act))
            case acts.Show():
                self._task(self._deposit.show(act))
            case acts.Ship():
                self._dispatch.ship(act)
            case acts.CancelShip():
                self._dispatch.cancel(act)
            case acts.Inquire():
                self._task(self._inquire(act))
            case _:
                self.supervisor(act.component).order(act)

    def supervisor(self, name: str) -> Supervisor:
        """The component of that name, known or new."""
        if name not in self.supervisors:
            self.supervisors[name] = Supervisor(name, self._around)
            self.supervisors[name].begin()
        return self.supervisors[name]

    def _running_here(self) -> set[str]:
        return {name for name, supervisor in self.supervisors.items() if supervisor.component is not None}

    async def _find_guards(self, records: Records) -> tuple[Found, ...]:
        """Find the guards that outlived the last agent, and supervise their components."""
        found = []
        for path in guard_sockets(self.places):
            try:
                component = await launch.reconnect(path, self.places)
                standing = await component.describe()
            except GuardLostError as error:
                log.info("%s", error)
                continue
            epoch = records.epoch(component.name)
            component.keeper.names = self._names_of_brought(component.name)
            self.supervisor(component.name).adopt(component, epoch)
            running = standing.state in ("running", "frozen")
            lease_ns = standing.lease_until_ns if standing.state == "running" else 0
            found.append(Found(component.name, epoch, running, standing.exit_status or 0, lease_ns))
            log.info("%s: found again, pid %d, %s", component.name, component.pid, standing.state)
        return tuple(found)

    def _names_of_brought(self, name: str) -> dict[str, str]:
        """By which a program that was restored here knows its files: its newest snapshot says it."""
        outline = newest_of(self._around.store, name)
        return names_of_contents(needs(outline), self.places.contents) if outline is not None else {}

    async def _mend_logs(self, found: tuple[Found, ...]) -> None:
        try:
            await asyncio.to_thread(self._deposit.mend_logs, {one.component for one in found})
        except (CheckpointError, OSError) as error:
            log.warning("the output of earlier checkpoints is not complete here: %s", error)

    def hear_of_a_snapshot(self, peer: str, message: Bulk) -> None:
        """A word about a snapshot on the replication link."""
        match message:
            case Offer() if self.votes_only(peer):
                self._replication_link.say(
                    peer, Refuse(message.transfer, f"{peer} is a witness: it votes, and keeps no snapshots")
                )
            case Offer() if hindrance := self._links.hindrance():
                self._replication_link.say(
                    peer, Refuse(message.transfer, f"snapshots wait: at {self.settings.config.robot} {hindrance}")
                )
            case Offer():
                self._receiver.offered(peer, message)
            case Belongings() | Content() if self.votes_only(peer):
                return
            case Belongings():
                self._task(self._compare(peer, message))
            case Lacking():
                self._bringing.heard(peer, message)
            case Content():
                self._contents.offered(peer, message)
            case Chunk():
                self._receiver.chunk(peer, message)
                self._contents.chunk(peer, message)
            case Cancel():
                self._receiver.cancelled(peer, message)
                self._contents.cancelled(peer, message)
            case Credit() | Taken() | Refuse():
                self._shipper.heard(peer, message)

    def _way_is_shut(self, witness: str) -> str:
        """Why no sealed copy can go to its witness now; "" if one can."""
        if hindrance := self._links.hindrance():
            return hindrance
        return f"cannot reach {witness}: {hindrance}" if (hindrance := self.hindrance(witness)) else ""

    def link_lost(self, peer: str) -> None:
        """The bulk lane to a peer is gone, and every transfer on it."""
        self._shipper.lost(peer)
        self._bringing.lost(peer)

    def link_is_new(self, peer: str) -> None:
        """A peer greets on a new replication link: what was half here stays half, and it may have answered on the link before."""
        self._shipper.answers_may_be_lost(peer)
        self._receiver.lost(peer)
        self._contents.lost(peer)
        self._stock.lost(peer)

    # --- files that programs bring along ---

    def _limits(self) -> Limits:
        config = self.settings.config
        return Limits(config.bring, size_bytes(config.bring_size), runs=self.settings.me.role != "server")

    async def _compare(self, peer: str, asked: Belongings) -> None:
        self._replication_link.say(peer, await self._stock.compare(peer, asked))

    async def _from_program(self, component: str, need: Need) -> int:
        """A file that only the running program leads to, through its keeper."""
        running = self.supervisor(component).component
        if running is None:
            raise LaneError(f"{need.path} is not here any more, and the program does not run here")
        _, (descriptor,) = await running.keeper.ask(messages.OpenFile(need.path, need.digest))
        return int(descriptor)

    def _note_bringing(self, component: str, peer: str, sentence: str) -> None:
        on_its_way = self.supervisor(component).figures.bringing
        on_its_way.pop(peer, None)
        if sentence:
            on_its_way[peer] = sentence

    async def _keep_what_goes(self) -> None:
        """Now and then look whether the files of what runs here are still where they were; what is not is kept by content."""
        said: dict[str, str] = {}
        while True:
            await asyncio.sleep(LOOK_S)
            for name, supervisor in list(self.supervisors.items()):
                if supervisor.component is None or supervisor.component.engine == COOPERATIVE:
                    continue
                outline = await asyncio.to_thread(newest_of, self._around.store, name)
                try:
                    await self._sources.keep_what_goes(name, needs(outline) if outline is not None else ())
                except TROUBLE as error:
                    if said.get(name) != str(error):
                        log.warning("%s: %s", name, error)
                    said[name] = str(error)

    async def _tidy_contents(self) -> None:
        """Now and then remove what no snapshot names any more."""
        while True:
            await asyncio.sleep(TIDY_S)
            try:
                freed = await asyncio.to_thread(self._around.store.collect_contents)
            except (CheckpointError, OSError) as error:
                log.warning("brought files are not tidied: %s", error)
                continue
            if freed:
                log.info("removed %d bytes of brought files that no checkpoint needs", freed)

    async def _give_back(self) -> None:
        """Now and then let the kernel have what is free."""
        while True:
            await asyncio.sleep(GIVE_BACK_S)
            await asyncio.to_thread(allocator.give_back)

    def _task(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        task.add_done_callback(end_worker_on_mistake)

    def tell(self, event: events.Event) -> None:
        """See `agent.worker.hub.Switchboard.tell`."""
        if isinstance(event, events.Captured) and self.supervisor(event.component).figures.snapshots == 1:
            self._new_here.set()  # the first one of it: look at once who else writes to its files
        super().tell(event)
        if self._alerts is not None:
            self._alerts.heard(event)

    def _accepted(self, offer: Offer, snapshot: Snapshot) -> None:
        self._stands_by(offer.spec, snapshot, offer.size)

    def _arrived(self, arrived: Arrived) -> None:
        self._stands_by(arrived.spec, arrived.snapshot, arrived.size)

    def _stands_by(self, spec: ComponentSpec, snapshot: Snapshot, size: int) -> None:
        """A checkpoint counts as held here."""
        supervisor = self.supervisor(spec.name)
        if supervisor.figures.spec is None:
            self._new_here.set()  # the first one of it: look at once whether it could go on here
        supervisor.figures.stored(snapshot, size, spec)
        supervisor.copy.accepted(snapshot)

    async def _look_what_is_lacking(self) -> None:
        """Now and then, and when a component is new here: what this robot lacks of what it stands by for, and which files of what
        runs here others write to."""
        while True:
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._new_here.wait(), LACKS_S)
            self._new_here.clear()
            waiting = [one for one in self.supervisors.values() if one.component is None and one.figures.spec is not None]
            found = await prerequisites.look(self._around, waiting)
            for supervisor in waiting:
                supervisor.figures.lacks = found.get(supervisor.name)
            contested = await prerequisites.contested(self._around, tuple(self.supervisors.values()))
            for supervisor in self.supervisors.values():
                supervisor.figures.contested = contested.get(supervisor.name, ())

    async def lacking(self, name: str) -> tuple[str, ...]:
        """What this robot lacks, now, of what a component needs to go on here; nothing where it holds no checkpoint of it.

        Nor where a hook gets it ready first, which may bring what is lacking: then the restore itself tells.
        """
        supervisor = self.supervisor(name)
        if supervisor.is_prepared_first:
            return ()
        found = (await prerequisites.look(self._around, (supervisor,))).get(name)
        if supervisor.figures.spec is not None:
            supervisor.figures.lacks = found
        return found or ()

    async def _inquire(self, act: acts.Inquire) -> None:
        """Ask another robot what it lacks of what a component needs; where it cannot tell, the core decides alone."""
        if act.component in self._inquiries:
            return  # its answer is on its way, as late as it may be
        self._inquiries.add(act.component)
        try:
            found = await prerequisites.asked_of(self.errands, act.to, act.component)
        finally:
            self._inquiries.discard(act.component)
        self.tell(events.Inquired(act.component, act.epoch, act.to, found or (), has_said=found is not None))

    async def _silence_ns(self, component: str) -> int:
        """For how long the robot that last sent this component's snapshots has been silent; 0 if there is none."""
        sender = self._deposit.last_sender(component)
        if not sender or (self._fetching is not None and self._fetching.gave(component)):
            return 0
        told = await self.ask("status")
        peers = told.status.peers if told.status else ()
        return max((peer.silent_ns for peer in peers if peer.robot == sender), default=0)

    def picture(self, told: Told) -> dict[str, Any]:
        """What ``status`` shows."""
        complaints = self._alerts.complaints.values() if self._alerts is not None else ()
        behind = self._archiving.complaints() if self._archiving is not None else ()
        absent = self._fetching.complaints() if self._fetching is not None else ()
        far = self._far_items.notes() if self._far_items is not None else ()
        said = (*far, *complaints, *behind, *absent, *self._lost())
        notices = [*self.notices(), *said, *self._around.store.notices[-NOTICES_SHOWN:]]
        links, interfaces = self._replication_link.links, self._links.shown()
        ours = WorkerView(
            links,
            notices,
            interfaces,
            self.supervisors,
            self._around.store,
            self._memory(),
            self._arriving,
            self._archiving.sealed if self._archiving is not None else lambda _: None,
            self._far_items.heard_ms if self._far_items is not None else lambda _: None,
        )
        return team_view(self.settings, self._life, told, ours)

    def _arriving(self, component: str) -> list[dict[str, Any]]:
        """What of a component is on its way to other robots, as the status shows it."""
        kinds = {"checkpoint": self._shipper.on_their_way(component), "files": self._bringing.on_their_way(component)}
        return [
            {"to": one.peer, "what": what, "arrived": one.arrived, "size": one.size}
            for what, going in kinds.items()
            for one in going
        ]

    def _lost(self) -> list[str]:
        """Two copies of a component ran, and no person has looked yet at the state of the one that lost."""
        with contextlib.suppress(OSError):
            directory = Path(self.settings.config.state_directory) / lost_copies.FOLDER
            copies = [one for one in lost_copies.found(directory) if not one.seen]
            return [LOST.format(one.component, one.epoch) for one in copies[:NOTICES_SHOWN]]
        return []

    def _memory(self) -> Memory:
        keepers = {one.component.keeper.pid for one in self.supervisors.values() if one.component is not None}
        budget = self.places.budget
        ours = (self._life.main_loop, os.getpid())
        return Memory(
            sum(map(memory_limits.held, ours)), sum(memory_limits.held(pid) for pid in keepers if pid), budget.held, budget.limit
        )


LOST: Final = (
    "another robot ran {0} too, or instead, and the copy of this robot, of epoch {1}, lost: failover lost inspect {0} shows its "
    "state and ends this note"
)

NOTICES_SHOWN: Final = 10
"""Of the store's latest findings."""


def _held(store: SnapshotStore) -> tuple[Held, ...]:
    return tuple(Held(name, store.positions(name)[-HISTORY_MAX:], _keeps_state(store, name)) for name in store.components())


def _keeps_state(store: SnapshotStore, name: str) -> bool:
    """Whether the newest snapshot is of a program that keeps its state; False also where it cannot be read now."""
    newest = newest_of(store, name)
    return newest is not None and newest.engine == COOPERATIVE


def main() -> int:
    """Be the worker of the main loop that started us."""
    return live(Worker)
