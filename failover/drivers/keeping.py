"""What a driver keeps: its attributes (`failover.kept`) and its mailbox, in one commit after each message.

So a driver that resumes, on this robot or on another one, knows which messages its state holds, and what it answered to them. An
answer leaves once the commit with it is safe.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Final

from failover.core.messaging.mailbox import Mailbox, unpacked
from failover.drivers.declare import Declaration
from failover.kept_state import component
from failover.kept_state.api import PROCESS, Resumed, Task, open_task
from failover.kept_state.component import kept_of, schema_of
from failover.kept_state.state import KeptState
from failover.state import Field, Schema

MAILBOX: Final = "_failover_mailbox"
"""The mailbox among the kept attributes."""

AGAIN_NS: Final = 1_000_000
"""Until a commit is made again for which there was no room."""


class Keeping:
    """The kept state of one driver; a process has one at most."""

    def __init__(self, cls: type, declaration: Declaration) -> None:
        """Begin the state, or resume it. Under an agent that waits until this robot is to run the driver.

        Raises:
            StateTakenError: another process keeps it.
            FitError: it does not fit the declaration any more.
        """
        PROCESS.refuse_second(declaration.path)
        attributes = kept_of(cls)
        declared = component.Declaration(declaration.path, 0, declaration.version, declaration.migrations)

        def schema(name: str) -> Schema:
            return schema_of(cls, declared, name, {MAILBOX: Field(annotation=bytes, default=b"")})

        def begin(state: KeptState) -> dict[str, Any]:
            return {key: one.first(state) for key, one in attributes.items()} | {MAILBOX: b""}

        self._task: Task = open_task(declaration.path, schema, begin)
        PROCESS.keep(self._task)
        if self._task.resumed is None:
            self._task.commit()  # a standby gets it before the first message: a driver that waits for one is protected, too
        self.mailbox = Mailbox(unpacked(self._task.value[MAILBOX]))
        self._waiting: deque[tuple[int, int]] = deque()
        """(commit, messages handled by then): their answers leave when the commit is safe."""
        self.instance: Any = component.instance_of(cls, self._task)

    @property
    def came_from(self) -> Resumed | None:
        """Where the state came from; None where it begins here."""
        return self._task.resumed

    def fileno(self) -> int:
        """Can be read when `safe` may have something new."""
        return self._task.fileno()

    def resumed(self) -> None:
        """Call the driver's ``on_resume``, if it has one and its state was resumed."""
        if (called := component.on_resume_of(self.instance, self._task.resumed)) is not None:
            called()

    @contextmanager
    def message(self) -> Iterator[None]:
        """Handle messages in the body: what they did and that they are done becomes one commit."""
        with self._task.transaction():
            yield
            vars(self.instance)[MAILBOX] = self.mailbox.packed()
        self._note()

    def _note(self) -> None:
        number = self._task.state.number + self._task.is_missing
        self._waiting.append((number, self.mailbox.handled))

    def wait_ns(self) -> int | None:
        """How long until `safe` is to be called although nothing comes."""
        return AGAIN_NS if self._task.is_missing else None

    def heard(self) -> None:
        """Take in what made the descriptor readable, also while no answer waits for it.

        Raises:
            NotCommittedError: nothing becomes safe any more.
        """
        self._task.safe()

    def safe(self) -> int | None:
        """How many messages are handled for good, if that may have changed.

        Raises:
            NotCommittedError: nothing becomes safe any more.
        """
        if not self._waiting:
            return None
        if self._task.is_missing:
            self._task.commit()
        safe, handled = self._task.safe(), None
        while self._waiting and self._waiting[0][0] <= safe:
            _, handled = self._waiting.popleft()
        return handled

    def close(self) -> None:
        """Write the newest commit, and let the state go."""
        PROCESS.release()
