"""The command ``failover``: parses, loads the verb's function, and turns every error into a sentence and an exit status."""

from __future__ import annotations

import gc
import io
import os
import sys
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Final

from checkpoint.errors import CheckpointError
from checkpoint.runtime import early_interrupt
from checkpoint.sentences import in_words, visible
from failover.cli import keeper_prestart
from failover.errors import AgentRefusedError, FailoverError, NoAgentError

if TYPE_CHECKING:
    import argparse

FAILED: Final = 1
NO_AGENT: Final = 3

REASONS_SHOWN: Final = 8


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command line; returns its exit status. Errors are told on standard error, never as a traceback."""
    try:
        return _main(argv)
    except KeyboardInterrupt:
        return early_interrupt.INTERRUPTED


def _main(argv: Sequence[str] | None) -> int:
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # a name in other letters than the terminal's must not end in an error
    words = sys.argv[1:] if argv is None else list(argv)
    try:
        from failover.cli import parser

        return _obeyed(parser.build(words[0] if words else "").parse_args(words))
    finally:
        keeper_prestart.forsake()


def _obeyed(arguments: argparse.Namespace) -> int:
    from failover.cli.parser import load

    try:
        verb: Callable[[argparse.Namespace], int] = load(arguments.function)
        gc.freeze()
        gc.enable()
        early_interrupt.loaded()
        status = verb(arguments)
        sys.stdout.flush()
        return status
    except NoAgentError as error:
        return tell(error, arguments, NO_AGENT)
    except (FailoverError, CheckpointError) as error:
        return tell(error, arguments, FAILED)
    except BrokenPipeError:
        # The reader has seen enough (`failover logs … | head`); keep Python from complaining about it at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILED
    except OSError as error:
        return tell(error, arguments, FAILED)


def tell(error: Exception, arguments: argparse.Namespace, status: int) -> int:
    """Print the error: a sentence, then one line per reason; as JSON when that was asked for."""
    reasons: tuple[str, ...] = getattr(error, "reasons", ())
    kind = error.kind if isinstance(error, AgentRefusedError) and error.kind else type(error).__name__
    if getattr(arguments, "json", False):
        import json

        print(json.dumps({"error": kind, "message": in_words(error), "reasons": list(reasons)}))
    else:
        sentence = in_words(error)
        if len(reasons) > 1:  # they follow, one a line
            sentence = sentence.removesuffix("; ".join(reasons)).rstrip(": ")
        print(visible(f"failover: {sentence}"), file=sys.stderr)
        listed = [reason for reason in reasons if reason not in sentence]
        for reason in listed[:REASONS_SHOWN]:
            print(visible(f"  - {reason}"), file=sys.stderr)
        if len(listed) > REASONS_SHOWN:
            print(f"  - and {len(listed) - REASONS_SHOWN} more; --json has them all", file=sys.stderr)
    return status


if __name__ == "__main__":
    sys.exit(main())
