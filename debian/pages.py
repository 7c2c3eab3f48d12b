"""Man pages and completions of the package, from the parsers: ``python -m debian.pages DIRECTORY`` (of usr/share)."""

from __future__ import annotations

import gzip
import sys
from pathlib import Path

import shtab
from argparse_manpage.manpage import Manpage

from agent.main import command_line
from failover import __version__
from failover.cli import parser

COMPLETIONS = {
    "bash": "bash-completion/completions/failover",
    "zsh": "zsh/vendor-completions/_failover",
    "fish": "fish/vendor_completions.d/failover.fish",
}


def main(share: Path) -> None:
    """Write them all."""
    for shell, place in COMPLETIONS.items():
        write(share / place, shtab.complete(parser.build(), shell=shell).encode())
    for section, command in ((1, parser.build()), (8, command_line())):
        command.man_short_description = command.description.partition(".")[0].lower()
        page = str(Manpage(command, {"project_name": "failover", "version": __version__, "manual_section": section}))
        write(share / f"man/man{section}/{command.prog}.{section}.gz", gzip.compress(page.encode(), mtime=0))


def write(path: Path, content: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
