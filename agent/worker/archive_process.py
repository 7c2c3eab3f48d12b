"""The archive's process as the worker sees it: started when it is needed, asked one thing after another, ended when it hangs."""

from __future__ import annotations

import asyncio
import os
import subprocess
import sys
import threading
from pathlib import Path
from typing import Final

import msgspec

from agent.archive.messages import Carried, Carry, Done, Look, Request
from agent.errors import TROUBLE, AgentError
from agent.worker.components.connection import Dialogue
from agent.worker.replication.send_sealed import Courier
from checkpoint.keeper.messages import close_all, pair
from failover.core.wire.messages import Content

PATIENCE_S: Final = 600.0
LEAST_RATE: Final = 100_000
DIGEST_S: Final = 10.0
"""How long the process may take for an answer: some time, what it reads and sends at so many bytes each second, each digest."""

END_S: Final = 10.0
"""How long it may take to end once it is killed."""


class NotArchivedError(AgentError):
    """A copy could not be made, or fetched; says why."""


class ArchiveProcess:
    """One process after another, for one task of the worker's loop."""

    def __init__(self, path: Path, courier: Courier | None = None) -> None:
        """
        Args:
            path: of agent.toml.
            courier: brings what is for the witness that keeps the copies; None: they go elsewhere.
        """
        self._path, self._courier = path, courier
        self._child: subprocess.Popen[bytes] | None = None
        self._dialogue: Dialogue | None = None

    def close(self) -> None:
        """End the process; nobody waits for it: the kernel may hold it."""
        self.hang_up()
        if self._child is not None:
            threading.Thread(target=self._child.wait, daemon=True).start()

    async def ask(self, request: Request, descriptors: tuple[int, ...] = (), limit_s: float = 0.0) -> Done:
        """Have the process do something.

        Args:
            limit_s: how long it may take; 0: by what it is given to read.

        Raises:
            AgentError: it cannot be done, or the process ended, or it took too long and was ended.
        """
        size = sum(os.fstat(one).st_size for one in descriptors)
        limit_s = limit_s or PATIENCE_S + size / LEAST_RATE + (
            DIGEST_S * len(request.digests) if isinstance(request, Look) else 0.0
        )
        dialogue = await self._opened()
        try:
            async with asyncio.timeout(limit_s):
                answer, more = await dialogue.ask(request, descriptors)
                while isinstance(answer, Carry):
                    answer, more = await dialogue.ask(await self._carry(answer, more))
        except TimeoutError as error:
            self.hang_up()
            raise NotArchivedError(
                f"the archive's process did not answer for {limit_s:.0f} s and was ended; see that its place answers"
            ) from error
        close_all(more)
        if not isinstance(answer, Done) or answer.refusal:
            raise NotArchivedError(answer.refusal)
        return answer

    async def _carry(self, carry: Carry, descriptors: tuple[int, ...]) -> Carried:
        """Have the witness do something for the process."""
        assert self._courier is not None, "the process knows the same settings"
        try:
            if carry.arguments:
                return Carried(answer=msgspec.msgpack.encode(await self._courier.ask(msgspec.msgpack.decode(carry.arguments))))
            await self._courier.ship(Content(0, carry.size, carry.digest), descriptors[0])
        except TROUBLE as error:
            return Carried(str(error))
        finally:
            close_all(descriptors)
        return Carried()

    async def _opened(self) -> Dialogue:
        """The conversation with the process, which is started if there is none.

        Raises:
            AgentError: the last one does not end.
        """
        if self._dialogue is not None and self._dialogue.open:
            return self._dialogue
        self.hang_up()
        if self._child is not None:
            try:
                await asyncio.to_thread(self._child.wait, END_S)
            except subprocess.TimeoutExpired as error:
                raise NotArchivedError(
                    f"the archive's process {self._child.pid} was killed and does not end: the kernel waits for its place; "
                    "see that the disk or the server of the folder answers"
                ) from error
        ours, theirs = pair()
        with theirs:
            command = [sys.executable, "-P", "-m", "agent.archive.process", str(self._path), str(theirs.fileno())]
            self._child = subprocess.Popen(command, pass_fds=(theirs.fileno(),), stdin=subprocess.DEVNULL, process_group=0)
        self._dialogue = Dialogue(ours, Done | Carry, NotArchivedError, "the archive's process")
        return self._dialogue

    def hang_up(self) -> None:
        """End the process; the next request starts another one."""
        if self._dialogue is not None:
            self._dialogue.close()
            self._dialogue = None
        if self._child is not None:
            self._child.kill()
