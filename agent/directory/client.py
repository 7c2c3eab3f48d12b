"""The directory process as the worker sees it: started when first asked, ended and replaced when it does not answer."""

from __future__ import annotations

import asyncio
import itertools
import os
import subprocess
import sys
from pathlib import Path
from typing import Final

from agent.directory.messages import Answer, Question
from agent.system.systemd_units import in_a_unit
from checkpoint.keeper.messages import Channel, ChannelError, pair

PATIENCE_S: Final = 300.0
"""Above what a question may take (`agent.directory.bounded`); a process that needs longer hangs."""


class DirectoryProcess:
    """One child after another; questions one at a time."""

    def __init__(self, team_directory: Path, state_directory: Path, starter: str = "") -> None:
        """
        Args:
            starter: of services of their own, see `agent.system.systemd_units`; "": it is our child.
        """
        self._starter = starter
        self._numbers = itertools.count(1)
        self._places = (str(team_directory), str(state_directory))
        self._child: subprocess.Popen[bytes] | None = None
        self._channel: Channel[Answer] | None = None
        self._turn = asyncio.Lock()

    async def ask(self, question: Question) -> Answer:
        """The answer; a refusal where the process cannot give one."""
        async with self._turn:
            return await asyncio.to_thread(self._ask, question)

    def close(self) -> None:
        """End the process."""
        if self._channel is not None:
            self._channel.close()
        if self._child is not None:
            self._child.kill()
            self._child.wait()
        self._child = self._channel = None

    def _ask(self, question: Question) -> Answer:
        try:
            channel = self._opened()
            channel.send(question)
            return channel.receive()[0]
        except (ChannelError, TimeoutError, OSError) as error:
            self.close()
            reason = f"the directory process gave no answer ({error}); see the agent's log"
            return Answer(refusal=reason, away=reason)

    def _opened(self) -> Channel[Answer]:
        if self._channel is not None and self._child is not None and self._child.poll() is None:
            return self._channel
        self.close()
        ours, theirs = pair()
        ours.settimeout(PATIENCE_S)
        way: list[str] = []
        if self._starter:
            name = f"{os.getpid()}-{next(self._numbers)}"
            way = [
                self._starter,
                "--pipe",
                *in_a_unit(self._starter, "directory", name)[1:],
            ]  # our stdin is the service's
        with theirs:
            command = [*way, sys.executable, "-P", "-m", "agent.directory.process", *self._places, "0"]
            self._child = subprocess.Popen(command, stdin=theirs.fileno(), process_group=0)
        self._channel = Channel(ours, Answer)
        return self._channel
