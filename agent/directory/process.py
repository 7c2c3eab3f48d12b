"""The directory process: takes a question, asks the server, answers; nothing else. Ends when the worker does.

Started as `python -m agent.directory.process TEAM_DIRECTORY STATE_DIRECTORY DESCRIPTOR`, with all modules of Python: python-ldap
needs some that `agent.system.child_main` leaves out. Where the agent is root, it reads the service account's password and then
gives up all rights but those of its own user.
"""

from __future__ import annotations

import os
import pwd
import socket
import sys
import time
from pathlib import Path
from typing import Final

from agent.directory.answers import Answers
from agent.directory.bounded import REQUESTS, BoundedServer
from agent.directory.messages import Question
from agent.directory.server import LdapServer
from agent.errors import DirectoryError
from checkpoint.keeper.messages import Channel, ChannelError
from failover.config import rights
from failover.config.rights import LdapConfig
from failover.errors import FailoverError

FOLDER: Final = "rights"
COPIES: Final = "copies"


def main() -> int:
    """Answer until the worker has gone."""
    team, state, descriptor = sys.argv[1:4]
    channel: Channel[Question] = Channel(socket.socket(fileno=int(descriptor)), Question)
    try:
        found = rights.read(Path(team))
        if found is None or found.config.source != "ldap":
            raise DirectoryError(f"{team}/{rights.RIGHTS_FILE} names no directory server")
        config = found.config.ldap
        server = LdapServer(config, _secret(config))
        server.load()
        bounded = BoundedServer(server, REQUESTS * config.timeout_s)
        _settle(Path(state) / FOLDER, config)
    except (DirectoryError, FailoverError, OSError) as error:
        print(f"failover directory: {error}", file=sys.stderr)
        return 1
    answers = Answers(config, bounded, Path(COPIES), time.monotonic, time.time)
    while True:
        try:
            question, _ = channel.receive()
            channel.send(answers.answer(question))
        except (ChannelError, KeyboardInterrupt):
            return 0


def _secret(config: LdapConfig) -> str:
    """The service account's password; a file that others may read is refused."""
    if not config.password_file:
        return ""
    path = Path(config.password_file)
    if path.stat().st_mode & 0o077:
        raise DirectoryError(f"{path} may be read by others; chmod 600 {path}")
    return path.read_text().strip()


def _settle(folder: Path, config: LdapConfig) -> None:
    """Be in the folder of the copies, which lies in one of root's, with the rights of this process's own user alone."""
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    os.chdir(folder)
    if os.geteuid() == 0 and config.user:
        try:
            user = pwd.getpwnam(config.user)
        except KeyError:
            raise DirectoryError(f"user = {config.user!r} of [rights.ldap]: this robot has no such user") from None
        for file in (".", *os.listdir()):
            os.chown(file, user.pw_uid, user.pw_gid, follow_symlinks=False)
        os.setgroups([])
        os.setresgid(user.pw_gid, user.pw_gid, user.pw_gid)
        os.setresuid(user.pw_uid, user.pw_uid, user.pw_uid)


if __name__ == "__main__":
    sys.exit(main())
