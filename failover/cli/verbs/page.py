"""page: checks what is asked for, and becomes the process of the operators' page (`page.__main__`)."""

from __future__ import annotations

import argparse
import getpass
import importlib.util
import os
import sys
from typing import Final, NoReturn

from failover.cli.arguments.page import config_of
from failover.config.page import hashed
from failover.errors import PageError

LIBRARIES: Final = ("starlette", "uvicorn", "websockets")


def page(arguments: argparse.Namespace) -> int:
    """Serve the page until Ctrl-C, or make the line of a password.

    Raises:
        PageError: it may not listen there, or a library is missing.
        FileMistakeError: its configuration is mistaken.
    """
    return _password() if arguments.password else _serve(arguments)


def _serve(arguments: argparse.Namespace) -> NoReturn:
    """This process becomes the page's: no part of failover imports that floor."""
    config = config_of(arguments)
    config.check()
    missing = [name for name in LIBRARIES if importlib.util.find_spec(name) is None]
    if missing:
        raise PageError(f"to serve the page needs {', '.join(missing)}, not installed here: pip install 'failover[page]'")
    options = [("--config", arguments.config), ("--listen", arguments.listen), ("--socket", arguments.socket)]
    words = [word for name, value in options if value for word in (name, value)]
    sys.stdout.flush()
    os.execv(sys.executable, [sys.executable, "-P", "-m", "page.__main__", *words, *(["--json"] if arguments.json else [])])


def _password() -> int:
    """The line of page.toml for a password that is typed, or comes in a pipe."""
    if sys.stdin.isatty():
        password = getpass.getpass("password: ")
        if getpass.getpass("again: ") != password:
            raise PageError("the two are not equal; nothing was printed")
    else:
        password = sys.stdin.readline().rstrip("\n")
    if not password:
        raise PageError("an empty password lets everybody in; type one")
    print(f'password = "{hashed(password)}"')
    return 0
