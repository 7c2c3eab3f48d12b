"""Shell completion (the only shtab import)."""

from __future__ import annotations

import argparse

from failover.cli import parser


def completion(arguments: argparse.Namespace) -> int:
    """Print the completion script of one shell."""
    import shtab

    print(shtab.complete(parser.build(), shell=arguments.shell))
    return 0
