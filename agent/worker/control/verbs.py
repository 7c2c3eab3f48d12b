"""Carries out the verbs of the control socket. What the core must decide goes to it as a command."""

from __future__ import annotations

import asyncio
import functools
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, Final, Protocol

import msgspec
from msgspec.structs import replace

from agent.core_config import declared, level_of, rules_for
from agent.errors import RefusedError
from agent.hook_kinds import check_told
from agent.system import clock
from agent.system.adopted_process import Guest
from agent.system.permissions import Caller, asking, check_right, guest_of, inheritance_for, may
from agent.worker.components import prerequisites
from agent.worker.components.paths import Places
from agent.worker.components.supervisor import Supervisor
from agent.worker.control.arguments import (
    DrainArguments,
    HandoverArguments,
    LogsArguments,
    NameArguments,
    PreferArguments,
    PromoteArguments,
    ProtectArguments,
    ReserveArguments,
    RunArguments,
    StopArguments,
    UnreserveArguments,
    arguments_of,
)
from agent.worker.control.output_relay import OutputRelay, Passage
from agent.worker.control.queries import Lines, Questions, named_after
from agent.worker.control.quotas import check_components
from agent.worker.control.reservations import Reservations, checked_reason
from agent.worker.control.rights_gate import RIGHT_OF, RightsGate
from agent.worker.control.server import Conversation, Verb
from agent.worker.network.remote_orders import Order
from checkpoint.device_rules import RULES_MAX, rule_from, travelling
from checkpoint.engine import contradiction
from checkpoint.program import cpu_baseline
from checkpoint.snapshot.carried_files import is_carriable
from failover.core import acts, events
from failover.core.reservations import SPAN_MS_MAX, at_or_below
from failover.core.rights.paths import steps_of
from failover.core.types import COMMITTED, ComponentSpec, Launch, State
from failover.core.wire.names import check_component, weight
from failover.errors import NameFormatError, RightsError

STANDING_POLL_S: Final = 0.01
"""Between two questions to the robot that a component moves to: what an operator reads as the move's time."""

ROBOT_DEPTH: Final = 2
"""Steps of a robot's path, ``/TEAM/ROBOT``."""

START_PATIENCE_S: Final = 30.0
"""How long ``run`` waits for the program to begin; it goes on beginning if the client gives up."""


class Worker(Lines, Protocol):
    """What of `agent.worker.process.Worker` is needed here."""

    places: Places
    supervisors: dict[str, Supervisor]

    def supervisor(self, name: str) -> Supervisor: ...
    async def lacking(self, name: str) -> tuple[str, ...]: ...


class Verbs(Questions):
    """Every verb of the control socket."""

    def __init__(self, worker: Worker, gate: RightsGate | None = None) -> None:
        super().__init__(worker, gate)
        self._worker = worker
        self._output_relay = OutputRelay(worker, gate)
        state = Path(worker.settings.config.state_directory)
        self.reservations: Reservations = Reservations(state, lambda: worker.errands, self._reachable_robots)

    def table(self) -> dict[str, Verb]:
        """By name, as the client says them."""
        return {
            **super().table(),
            "run": self.run,
            "protect": self.protect,
            "logs": self.logs,
            "promote": self.promote,
            "drain": self.drain,
            "reserve": self.reserve,
            "unreserve": self.unreserve,
            **{name: functools.partial(self._order, name) for name in self.orders()},
        }

    def errands(self) -> dict[str, Order]:
        """What another robot may ask of this one: the orders, and how things stand here."""
        promoted = functools.partial(self._permitted, self._promoted)
        return {
            **super().errands(),
            **self.orders(),
            "piece": self._output_relay.piece,
            "promoted": promoted,
            "drained": self._drained,
            "lacks": self.lacks,
            "reservations": self.reservations.hear,
        }

    def orders(self) -> dict[str, Order]:
        """Those that are carried out where the component runs, wherever they are given."""
        found: dict[str, Order] = {
            "handover": self.handover,
            "failback": self.failback,
            "prefer": self.prefer,
            "release": self.release,
            "start": self.start,
            "stop": self.stop,
        }
        return {name: functools.partial(self._permitted, act) for name, act in found.items()}

    async def _permitted(self, order: Order, arguments: dict[str, Any], by: int) -> dict[str, Any]:
        """Carry an order out here, if its user may give it."""
        name = await self._known(str(arguments.get("name", "")))
        await self._check_right(by, name, "operate")
        return await order({**arguments, "name": name}, by)

    async def _order(self, verb: str, say: Conversation, arguments: dict[str, Any]) -> dict[str, Any]:
        """Carry an order out here, or have the robot do it where the component runs."""
        name = await self._known(str(arguments.get("name", "")))
        arguments = {**arguments, "name": name}
        primary = (await self._view(name)).get("primary", "")
        told = await self._worker.ask("status")
        living = {peer.robot for peer in told.status.peers if peer.state in ("alive", "suspect")} if told.status else set()
        is_declared = verb == "start" and name in self._worker.settings.config.tasks
        if primary in living and not is_declared:
            return await self._worker.errands.send(primary, verb, arguments, say.caller.uid)
        return await self.orders()[verb](arguments, say.caller.uid)

    async def run(self, say: Conversation, arguments: dict[str, Any]) -> dict[str, Any]:
        """Start a program under protection; with ``wait`` pass its output on until it has ended."""
        wanted = arguments_of(RunArguments, "run", arguments)
        if not wanted.argv:
            raise RefusedError("run needs a command: failover run -- COMMAND …")
        try:
            check_told(dict(wanted.hooks))
        except ValueError as error:
            raise RefusedError(f"run: {error}") from error
        inheritance = inheritance_for(say.caller, wanted.user)
        name = await self._fresh_name(wanted.name, wanted.argv[0], say.caller.uid)
        if not wanted.name and (gate := self._rules()) is not None:  # it has got a number, perhaps
            await gate.check(say.caller.uid, RIGHT_OF["run"], name)
        launch = Launch(
            tuple(wanted.argv),
            tuple(self._environment(name, wanted).items()),
            wanted.cwd,
            wanted.umask,
            isolate=wanted.isolate,
            inheritance=msgspec.msgpack.encode(inheritance),
            engine=wanted.engine,
            output=wanted.output,
            hooks=tuple((occasion, tuple(command)) for occasion, command in wanted.hooks.items() if command),
            carry=self._carried(name, wanted.carry),
            shared=self._shared(name, wanted.shared, wanted.carry),
            devices=self._device_rules(name, wanted.devices),
            connections=self._connections(name, wanted.connections),
            shared_memory=wanted.shared_memory or self._worker.settings.component(name).shared_memory,
        )
        supervisor = await self._begin(name, launch, inheritance.uid, say.caller.uid)
        figures = supervisor.figures
        started: dict[str, Any] = {"name": name, "notes": list(figures.notes), "reasons": list(figures.reasons)}
        if supervisor.component is not None:
            component = supervisor.component
            started |= {"pid": component.pid, "inner_pid": component.inner_pid, "isolated": component.isolated}
            started["notes"] = [*component.notes, *figures.notes]
        if not wanted.wait:
            return started
        await say.update({"started": started})
        await self._output_relay.pass_on(say, name, Passage(committed=wanted.output == COMMITTED, follow=True))
        if supervisor.ended is not None and supervisor.ended.done():
            report = supervisor.ended.result()
            return {"name": name, "exit_status": report.status, "failed": report.failed, "reason": report.reason}
        view = await self._view(name)  # it ended on another robot
        return {"name": name, "exit_status": view.get("exit_status"), "failed": view["state"] == "failed", "reason": ""}

    def _environment(self, name: str, wanted: RunArguments) -> dict[str, str]:
        """The program's variables, also those that have libraries choose code for a mixed fleet."""
        settings = self._worker.settings
        level = level_of(wanted.portable, settings.config, settings.component(name))
        return cpu_baseline.environment(wanted.env, level) if level else wanted.env

    async def protect(self, say: Conversation, arguments: dict[str, Any]) -> dict[str, Any]:
        """Take a running process under protection."""
        wanted = arguments_of(ProtectArguments, "protect", arguments)
        guest = guest_of(wanted.pid, say.caller)
        try:
            return await self._taken_in(wanted, guest, say.caller)
        finally:
            guest.close()

    async def _taken_in(self, wanted: ProtectArguments, guest: Guest, caller: Caller) -> dict[str, Any]:
        """Protect a process that is the caller's."""
        assert guest.rights is not None, "it was asked whose it is"
        for known in self._worker.supervisors.values():
            if known.component is not None and known.component.pid == wanted.pid:
                raise RefusedError(f"pid {wanted.pid} is protected already, as {known.name}; failover release ends that")
        name = await self._fresh_name(wanted.name, "", caller.uid)
        carried, devices = self._carried(name, wanted.carry), self._device_rules(name, wanted.devices)
        connections = self._connections(name, wanted.connections)
        shared = self._shared(name, wanted.shared, wanted.carry)
        launch = Launch(
            pid=wanted.pid,
            inheritance=msgspec.msgpack.encode(guest.rights),
            carry=carried,
            devices=devices,
            connections=connections,
            shared=shared,
            shared_memory=wanted.shared_memory or self._worker.settings.component(name).shared_memory,
        )
        supervisor = await self._begin(name, launch, guest.rights.uid, caller.uid, guest)
        return {"name": name, "pid": wanted.pid, "notes": list(supervisor.figures.notes)}

    async def release(self, arguments: dict[str, Any], by: int) -> dict[str, Any]:
        """Let a component run on unprotected; answers once its guard has been told, so that no later agent finds it again."""
        wanted = arguments_of(NameArguments, "release", arguments)
        name = await self._known(wanted.name)
        supervisor = self._worker.supervisor(name)
        pid = supervisor.component.pid if supervisor.component is not None else None
        await self._command(by, lambda number: events.Release(number, name, decided=wanted.epoch))
        await supervisor.let_go()  # the order came before the answer
        return {"name": name, "pid": pid}

    async def start(self, arguments: dict[str, Any], by: int) -> dict[str, Any]:
        """Start a component that this robot's agent.toml declares, from its beginning, after its end."""
        name, settings = arguments_of(NameArguments, "start", arguments).name, self._worker.settings
        task = settings.config.tasks.get(name)
        if task is None:
            raise RefusedError(
                f'cannot start {name}: {settings.path} of {settings.config.robot} does not declare it ([tasks."{name}"]); '
                f"ask at a robot that does, or start one that is not declared with failover run --name {name} -- COMMAND"
            )
        spec = declared(settings, name, task)
        if self._rules() is None:
            check_right(by, name, spec.owner)  # as whom it would run now: the record may be of an earlier declaration
        supervisor = await self._spec_begun(spec, by)
        return {"name": name, "robot": settings.config.robot, "notes": list(supervisor.figures.notes)}

    async def stop(self, arguments: dict[str, Any], by: int) -> dict[str, Any]:
        """End a component."""
        wanted = arguments_of(StopArguments, "stop", arguments)
        name = await self._known(wanted.name)
        end = self._worker.supervisor(name).end()
        await self._command(by, lambda number: events.Stop(number, name, wanted.signal, decided=wanted.epoch))
        report = await asyncio.shield(end)
        return {"name": name, "exit_status": report.status}

    async def handover(self, arguments: dict[str, Any], by: int) -> dict[str, Any]:
        """Move a component."""
        wanted = arguments_of(HandoverArguments, "handover", arguments)
        name = await self._known(wanted.name)
        await self._check_fit(name, "hand {} over to {}", wanted.to or (await self._view(name))["standby"])
        return await self._moved(by, name, lambda number: events.Handover(number, name, wanted.to, decided=wanted.epoch))

    async def failback(self, arguments: dict[str, Any], by: int) -> dict[str, Any]:
        """Move a component back to the robot that is preferred, or where it was started."""
        wanted = arguments_of(HandoverArguments, "failback", arguments)
        name = await self._known(wanted.name)
        view = await self._view(name)
        await self._check_fit(name, "fail {} back to {}", view["prefer"] or view["home"])
        return await self._moved(by, name, lambda number: events.Failback(number, name, to=wanted.to, decided=wanted.epoch))

    async def lacks(self, arguments: dict[str, Any], _by: int) -> dict[str, Any]:
        """What this robot lacks of what a component needs to go on here."""
        name = arguments_of(NameArguments, "lacks", arguments).name
        return {"lacks": list(await self._worker.lacking(name) if name in await self._names() else ())}

    async def _check_fit(self, name: str, order: str, robot: str) -> None:
        """Ask the robot that a component is to move to whether it could go on there.

        Where it cannot tell the core decides alone.

        Raises:
            RefusedError: it lacks something, all of it by name.
        """
        if robot not in await self._reachable():
            return
        if reasons := await prerequisites.asked_of(self._worker.errands, robot, name):
            sentence = f"cannot {order.format(name, robot)}, which could not resume it: {'; '.join(reasons)}"
            raise RefusedError(sentence, "MismatchError", reasons)

    async def _moved(self, by: int, name: str, make: Callable[[int], events.Command]) -> dict[str, Any]:
        began_ns, before = clock.now_ns(), await self._view(name)
        answer = await self._command(by, make)
        view = await self._view(name)
        if view["primary"] != self._worker.settings.config.robot:
            view = await self._running_at(view["primary"], name)
        took_ms = (clock.now_ns() - began_ns) / 1e6
        told = {"name": name, "to": view["primary"], "epoch": view["epoch"], "took_ms": took_ms, "sentence": answer.sentence}
        return {**told, "moved": view["primary"] != before["primary"]}

    async def _running_at(self, robot: str, name: str) -> dict[str, Any]:
        """Wait until the robot that took a component runs it; its view of it.

        Raises:
            RefusedError: it does not, or has not said so in time; the component stays the team's.
        """
        deadline_ns = clock.now_ns() + int(START_PATIENCE_S * 1e9)
        while True:
            view = await self._worker.errands.send(robot, "standing", {"name": name})
            if view.get("role") == "primary" and view["state"] in ("running", "degraded"):
                return view
            if view.get("state") in ("ended", "failed") or view.get("primary") not in (robot, None):
                sentence = "; ".join((*view.get("reasons", ()), *view.get("notes", ()))) or "see failover why"
                raise RefusedError(f"{robot} took {name} and does not run it: {sentence}")
            if clock.now_ns() > deadline_ns:
                raise RefusedError(
                    f"{robot} took {name} and has not begun to run it in {START_PATIENCE_S:.0f} s; see failover status"
                )
            await asyncio.sleep(STANDING_POLL_S)

    async def prefer(self, arguments: dict[str, Any], by: int) -> dict[str, Any]:
        """Say where a component should run."""
        wanted = arguments_of(PreferArguments, "prefer", arguments)
        name = await self._known(wanted.name)
        await self._check_fit(name, "let {} prefer {}", wanted.robot)
        await self._command(by, lambda number: events.Prefer(number, name, wanted.robot, decided=wanted.epoch))
        return {"name": name, "robot": wanted.robot}

    async def promote(self, say: Conversation, arguments: dict[str, Any]) -> dict[str, Any]:
        """Have a robot run what no robot is heard to run; or, unless it is ``sure``, tell what that would risk."""
        wanted = arguments_of(PromoteArguments, "promote", arguments)
        name, me = await self._known(wanted.name), self._worker.settings.config.robot
        robot = wanted.robot or await self._newest_at(name)
        if robot not in self._worker.settings.near:
            known = ", ".join(sorted(self._worker.settings.near))
            raise RefusedError(f"cannot promote {robot!r} for {name}: the team knows {known}")
        order = {"name": name, "robot": robot, "sure": wanted.sure, "epoch": wanted.epoch}
        if robot == me:
            return await self._permitted(self._promoted, order, say.caller.uid)
        return await self._worker.errands.send(robot, "promoted", order, say.caller.uid)

    async def _promoted(self, arguments: dict[str, Any], by: int) -> dict[str, Any]:
        """Promote this robot, or tell what that would risk."""
        wanted = arguments_of(PromoteArguments, "promote", arguments)
        answer = await self._command(
            by, lambda number: events.Promote(number, wanted.name, not wanted.sure, decided=wanted.epoch)
        )
        view = await self._view(wanted.name)
        told = {"name": wanted.name, "to": wanted.robot, "epoch": view["epoch"], "sentence": answer.sentence}
        return {**told, "promoted": wanted.sure, "risks": list(answer.risks)}

    async def drain(self, say: Conversation, arguments: dict[str, Any]) -> dict[str, Any]:
        """Have a robot give away all that it runs, and take nothing new; or let it run components again."""
        wanted, members = arguments_of(DrainArguments, "drain", arguments), self._worker.settings.near
        if wanted.robot not in members:
            raise RefusedError(f"cannot drain {wanted.robot!r}: the team knows {', '.join(sorted(members))}")
        order, uid = {"robot": wanted.robot, "on": wanted.on}, say.caller.uid
        if wanted.robot == self._worker.settings.config.robot:
            return await self._drained(order, uid)
        return await self._worker.errands.send(wanted.robot, "drained", order, uid)

    async def _drained(self, arguments: dict[str, Any], by: int) -> dict[str, Any]:
        """Drain this robot, or no longer: for root, or for whom the rules let operate at its path."""
        wanted, settings = arguments_of(DrainArguments, "drain", arguments), self._worker.settings
        if (gate := self._rules()) is not None:
            await gate.check(by, RIGHT_OF["drain"], f"/{settings.team.team}/{settings.config.robot}")
        elif not may(by, None):
            raise RefusedError(
                f"cannot drain {settings.config.robot}: only root may, or whom rights.toml lets", "PermissionError"
            )
        if wanted.on:
            running = [one["name"] for one in (await self._picture())["components"] if one["role"] == "primary"]
            self.reservations.check(by, (f"/{settings.team.team}/{settings.config.robot}", *running))
        answer = await self._worker.command(lambda number: events.Drain(number, wanted.on))
        if not answer.ok:
            raise RefusedError(answer.sentence)
        return {"robot": settings.config.robot, "drained": wanted.on, "sentence": answer.sentence}

    async def reserve(self, say: Conversation, arguments: dict[str, Any]) -> dict[str, Any]:
        """Let no other user give orders about a component, or about all below a path, for a time."""
        wanted, uid = arguments_of(ReserveArguments, "reserve", arguments), say.caller.uid
        if wanted.span_ms > SPAN_MS_MAX:
            raise RefusedError(f"a reservation lasts at most {SPAN_MS_MAX // 60_000} min; reserve again before it ends")
        why, path = checked_reason(wanted.why), await self._reserved_path(wanted.name)
        await self._check_all_below(uid, path)
        return await self.reservations.begin(path, uid, wanted.span_ms, why)

    async def _check_all_below(self, uid: int, path: str) -> None:
        """Let a user reserve a path, who may give orders about each component that is there.

        Raises:
            RefusedError: it is no path, or there is a component about which the user may give none.
        """
        told = await self._worker.ask("status")
        owners = {one.name: one.owner for one in told.status.components} if told.status else {}
        try:
            below = at_or_below(path, owners)
            is_one = path in owners and len(steps_of(path)) > ROBOT_DEPTH
        except RightsError as error:
            raise RefusedError(str(error), "RightsError") from error
        if (gate := self._rules()) is None:
            if not may(uid, None) and not (is_one and all(may(uid, owners[name]) for name in below)):
                sentence = "without rights.toml only its owner and root may, and all below a path only root"
                raise RefusedError(f"cannot reserve {path}: {sentence}", "PermissionError")
            return
        asker = await gate.subject(uid, RIGHT_OF["reserve"])
        if not all(gate.decision(asker, RIGHT_OF["reserve"], name, owners[name]) for name in below):
            sentence = "the rules do not let you operate each component below it; reserve those one by one that they do"
            raise RefusedError(f"cannot reserve {path}: {sentence}", "PermissionError")

    async def unreserve(self, say: Conversation, arguments: dict[str, Any]) -> dict[str, Any]:
        """End a reservation: one's own, or as whoever may also another user's."""
        wanted, uid = arguments_of(UnreserveArguments, "unreserve", arguments), say.caller.uid

        async def may_break(path: str) -> str:
            if may(uid, None):
                return ""
            if (gate := self._rules()) is None:
                return "only its user and root may end it before"
            answer = gate.decision(await gate.subject(uid, "grant"), "grant", path, None)
            return "" if answer else answer.because

        return await self.reservations.end(await self._reserved_path(wanted.name), uid, wanted.breaks, may_break)

    async def _reachable_robots(self) -> list[str]:
        """Those that take orders: a witness takes none."""
        team = self._worker.settings.near
        return [peer for peer in await self._reachable() if peer in team and team[peer].role != "witness"]

    async def _reserved_path(self, name: str) -> str:
        """The component that a person means; of a whole path the path itself, whatever is there."""
        return name if name.startswith("/") else await self._known(name)

    async def _newest_at(self, name: str) -> str:
        """The living robot with the newest checkpoint; this one, or the lesser name, of several."""
        me, team = self._worker.settings.config.robot, self._worker.settings.near
        seen = [(me, await self._view(name))]
        others = await self._reachable()
        asked = (self._asked(peer, "standing", {"name": name}) for peer in others)
        seen += zip(others, await asyncio.gather(*asked), strict=True)
        able = [(robot, view) for robot, view in seen if team[robot].role == "robot" and view]
        if not able:
            raise RefusedError(f"no robot that is heard knows {name}; start one, or name it with --robot")
        return min(able, key=lambda one: (_age_of(one[1]), one[0] != me, weight(one[0])))[0]

    async def logs(self, say: Conversation, arguments: dict[str, Any]) -> dict[str, Any]:
        """The component's output as far as no takeover can take it back; all of it once it has ended."""
        wanted = arguments_of(LogsArguments, "logs", arguments)
        name = await self._known(wanted.name)
        await self._check_right(say.caller.uid, name, "read")

        async def permitted() -> bool:
            if self._rules() is None:
                return False
            await self._check_right(say.caller.uid, name, "read")
            return True

        passage = Passage(wanted.offsets, follow=wanted.follow, since_ms=wanted.since_ms, times=wanted.times)
        totals = await self._output_relay.pass_on(say, name, passage, permitted)
        view = await self._view(name)
        return {"name": name, "totals": list(totals), "exit_status": view.get("exit_status")}

    # --- what verbs share ---

    def _carried(self, name: str, wanted: list[str]) -> tuple[str, ...]:
        """What travels with a component: what was asked for, and what this robot's operator wants besides.

        Raises:
            RefusedError: it is no path that means the same on every robot.
        """
        return _named_whole("carry", (*wanted, *self._worker.settings.component(name).carry))

    def _shared(self, name: str, wanted: list[str], carried: list[str]) -> tuple[str, ...]:
        """What others write to as well: what was asked for, and what this robot's operator rules besides.

        Raises:
            RefusedError: it is no path that means the same on every robot, or travels with the component.
        """
        paths = _named_whole("share", (*wanted, *self._worker.settings.component(name).shared))
        if both := contradiction(self._carried(name, carried), paths):
            raise RefusedError(both)
        return paths

    def _connections(self, name: str, wanted: str) -> str:
        """What becomes of a component's connections with others: what was asked for, else what this robot's operator wants."""
        return wanted or self._worker.settings.component(name).connections

    def _device_rules(self, name: str, wanted: dict[str, str]) -> tuple[tuple[str, str], ...]:
        """What becomes of a component's devices on every robot: what was asked for, and what this robot's operator wants here.

        Raises:
            RefusedError: a rule is none.
        """
        if len(wanted) > RULES_MAX:
            raise RefusedError(f"{len(wanted)} rules for devices; at most {RULES_MAX}")
        try:
            for path, said in wanted.items():
                rule_from(path, said)
        except ValueError as error:
            raise RefusedError(str(error)) from error
        own = travelling(self._worker.settings.component(name).device_rules())
        return tuple({**wanted, **dict(own)}.items())

    async def _begin(self, name: str, launch: Launch, owner: int, by: int, guest: Guest | None = None) -> Supervisor:
        """Have a component started or taken in, and wait until it is.

        Args:
            by: uid of the user who asks, also for another owner.
            guest: the process that is to be taken in; stays the caller's.

        Raises:
            RefusedError: the core says no, or it could not be started; with the reasons.
        """
        config = self._worker.settings.config
        rules = rules_for(config, self._worker.settings.component(name))
        return await self._spec_begun(ComponentSpec(name, config.robot, launch, rules, owner), by, guest)

    async def _spec_begun(self, spec: ComponentSpec, by: int, guest: Guest | None = None) -> Supervisor:
        name, launch = spec.name, spec.launch
        supervisor = self._worker.supervisor(name)
        supervisor.guest = guest
        had_started, before = supervisor.started.is_set(), supervisor.ended
        supervisor.started.clear()
        if before is not None and before.done():
            supervisor.ended = None
        end = supervisor.end()
        try:
            await self._command(by, lambda number: events.Run(number, spec))
        except RefusedError as refusal:
            if had_started:
                supervisor.started.set()
            if not end.done():
                supervisor.ended = before
            raise RefusedError(str(refusal), refusal.kind, supervisor.figures.reasons) from refusal
        begun = asyncio.ensure_future(supervisor.started.wait())
        try:
            both: set[asyncio.Future[Any]] = {begun, end}
            await asyncio.wait(both, timeout=START_PATIENCE_S, return_when=asyncio.FIRST_COMPLETED)
        finally:
            begun.cancel()
            supervisor.guest = None
        if end.done() and end.result().failed:
            verb = "protect" if launch.pid else "start"
            raise RefusedError(f"cannot {verb} {name}: {end.result().reason}", "RefusedError", supervisor.figures.reasons)
        if not supervisor.started.is_set():
            raise RefusedError(f"{name} has not begun in {START_PATIENCE_S:.0f} s; see failover why {name}")
        return supervisor

    async def _command(self, by: int, make: Callable[[int], events.Command]) -> acts.Answer:
        """Have the core decide, by the right of this user. Raises RefusedError: it says no."""
        asks = None if self._rules() is not None else asking(by)  # the rules have been asked
        answer = await self._worker.command(lambda number: replace(make(number), by=asks))
        if not answer.ok:
            raise RefusedError(answer.sentence)
        return answer

    async def _check_right(self, uid: int, name: str, right: str) -> None:
        """Raises RefusedError: the rules say no, or another user has reserved it; without rules, it is another user's."""
        owner = (await self._view(name)).get("owner")
        if (gate := self._rules()) is None:
            check_right(uid, name, owner)
        else:
            await gate.check(uid, right, name, owner)
        if right == "operate":
            self.reservations.check(uid, [name])

    async def _fresh_name(self, wanted: str, command: str, uid: int) -> str:
        """A name for something new: as given, under this robot's own path, or made from the command.

        Raises:
            RefusedError: it is no name, or one that another user has used and not released; or this user has too many.
        """
        own = f"/{self._worker.settings.team.team}/{self._worker.settings.config.robot}/"
        told = await self._worker.ask("status")
        known = {one.name: one for one in told.status.components} if told.status else {}
        if not wanted:
            stem = own + named_after(command)
            numbered = (stem, *(f"{stem}-{number}" for number in range(2, len(known) + 3)))
            free = (State.RELEASED, uid)  # by the same user: what it wrote is another user's to read
            wanted = next(name for name in numbered if name not in known or (known[name].state, known[name].owner) == free)
        name = wanted if wanted.startswith("/") else own + wanted
        try:
            steps_of(check_component(name))
        except (NameFormatError, RightsError) as error:
            raise RefusedError(str(error), type(error).__name__) from error
        self.reservations.check(uid, [name])
        check_components(uid, name, known.values(), self._worker.settings.config.components_per_user)
        if name in known and known[name].state not in (State.RELEASED, State.ABSENT):
            check_right(uid, name, known[name].owner)
        return name


def _age_of(view: dict[str, Any]) -> tuple[int, int]:
    """Of what a robot could go on from: the newest sorts first, nothing at all last."""
    return -(view.get("generation") or 0), -(view.get("sequence") or 0)


def _named_whole(verb: str, wanted: Iterable[str]) -> tuple[str, ...]:
    """Each path once. Raises RefusedError: one of them does not mean the same on every robot."""
    paths = tuple(dict.fromkeys(wanted))
    for path in paths:
        if not is_carriable(path):
            raise RefusedError(f"cannot {verb} {path!r}: name the file or folder by its whole path, without . and ..")
    return paths
