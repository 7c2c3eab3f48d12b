"""board header, board import: the board's declarations for the C compiler, and from CAMBADA's and RTDB2's files.

``import`` learns how large a C type is without running anything: it compiles ``char failover_size_ITEM[sizeof(TYPE)];`` to an
object file and reads the sizes of the symbols. So it works with a compiler for another processor, and no header's code runs here.
"""

from __future__ import annotations

import argparse
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Final

from failover.cli.output import render
from failover.config import team
from failover.config.board import as_toml
from failover.core.board import rtdb_conf, rtdb_xml
from failover.core.board.c_header import header as c_header
from failover.core.board.items import Board
from failover.core.board.rtdb_conf import Configuration
from failover.errors import FileMistakeError, ImportFailedError, ItemError

COMPILERS: Final = ("g++", "c++", "clang++")
"""Tried in this order; CAMBADA's headers are C++."""

PACKAGES: Final = "install one with: apt-get install g++ (a compiler), binutils (nm)"
SYMBOL: Final = "failover_size_"
COMPILE_S_MAX: Final = 120
"""Seconds for one compilation of all headers of a file."""

REASONS_MAX: Final = 16
"""Lines of a compiler's errors that are kept."""


def header(arguments: argparse.Namespace) -> int:
    """Print a C header with the structs, numbers, sizes and digests of a team's items."""
    members = team.read(Path(arguments.directory))
    board = members.items()
    text = c_header(board, members.team)
    if arguments.rtdb:
        text += _rtdb_names(board, sorted_robots(members))
    if arguments.json:
        items = [
            {"number": number, "name": item.name, "size": item.size, "type": item.as_words()["type"]}
            | {"digest": f"{item.type_digest:016x}"}
            for number, item in enumerate(board.items)
        ]
        render.as_json({"team": members.team, "digest": f"{board.digest:016x}", "items": items, "header": text})
    else:
        print(text, end="")
    return 0


def sorted_robots(members: team.Team) -> list[str]:
    """The members by rank."""
    from failover.core.wire.names import weight

    return sorted(members.robots, key=weight)


def _rtdb_names(board: Board, robots: list[str]) -> str:
    """Numbers of items and agents under their own names, as programs written for CAMBADA use them."""
    from failover.core.board.c_header import macro_of

    numbered = [(item.name, number) for number, item in enumerate(board.items)] + list(
        zip(robots, range(len(robots)), strict=True)
    )
    words = {name if name.isidentifier() and name.isascii() else macro_of(name): number for name, number in numbered}
    lines = [
        "",
        "/* Numbers of items and agents, for failover_rtdb.h */",
        "#ifndef FAILOVER_ITEMS_RTDB",
        "#define FAILOVER_ITEMS_RTDB",
        f"#define N_ITEMS {len(board.items)}",
        f"#define N_AGENTS {len(robots)}",
        "enum {",
        *(f"    {word} = {number}," for word, number in words.items()),
        "};",
        "#endif",
        "",
    ]
    return "\n".join(lines)


def import_file(arguments: argparse.Namespace) -> int:
    """Write an rtdb.conf or an rtdb2_configuration.xml as the table [board] of team.toml."""
    path = Path(arguments.file)
    try:
        content = path.read_bytes()
    except OSError as error:
        raise FileMistakeError(f"cannot read {path}: {error.strerror}") from error
    try:
        board, notes, comments = _imported(content, path, arguments)
    except ItemError as error:
        raise FileMistakeError(f"{path}: {error}") from error
    text = _commented(as_toml(board), comments)
    if arguments.json:
        render.as_json({"items": [item.as_words() for item in board.items], "notes": list(notes), "toml": text})
        return 0
    for note in notes:
        print(f"failover: note: {note}", file=sys.stderr)
    print(text, end="")
    return 0


def _imported(content: bytes, path: Path, arguments: argparse.Namespace) -> tuple[Board, tuple[str, ...], dict[str, str]]:
    """The board of a file, remarks on it, and a comment for each item."""
    if content.lstrip()[:1] == b"<":
        return Board(rtdb_xml.parse(content, str(path), arguments.size)), (), {}
    found = rtdb_conf.parse(content, str(path))
    sizes = _sizes(found, path, arguments)
    unknown = [item.name for item in found.items if item.name not in sizes]
    notes = [f"{path}: the type of {name} is not found; no agent has it, so it keeps its number, with 1 byte" for name in unknown]
    items = rtdb_conf.as_items(found, sizes | dict.fromkeys(unknown, 1), dict(arguments.robot))
    return Board(items), (*found.notes, *notes), {item.name: f"{item.datatype} of {item.headerfile}" for item in found.items}


def _commented(text: str, comments: dict[str, str]) -> str:
    lines = []
    for line in text.splitlines():
        name = line.removeprefix("[board.items.").removesuffix("]") if line.startswith("[board.items.") else ""
        lines.append(f"{line}  # {comments[name]}" if name in comments else line)
    return "\n".join(lines) + "\n"


# --- Sizes of C types ------------------------------------------------------------------------------------------------


def _sizes(found: Configuration, path: Path, arguments: argparse.Namespace) -> dict[str, int]:
    """Item → size of its type, by the compiler; one that no agent has may be missing.

    Raises:
        ImportFailedError: there is no compiler, or it does not know a type; has its sentences.
    """
    if not found.items:
        return {}
    compiler, nm = _tools(arguments.cc)
    with tempfile.TemporaryDirectory(prefix="failover-import-") as place:
        source, made = Path(place) / "sizes.cc", Path(place) / "sizes.o"
        source.write_text(_source(found, path))
        folders = [f"-I{folder}" for folder in (*arguments.include, path.resolve().parent)]
        _run([*compiler, "-x", "c++", "-w", "-fno-common", "-c", *folders, "-o", str(made), str(source)], "the compiler", path)
        listed = _run([*nm, "-S", str(made)], "nm", path)
    sizes = {}
    for line in listed.splitlines():
        words = line.split()
        if len(words) == 4 and words[3].startswith(SYMBOL):
            sizes[words[3].removeprefix(SYMBOL)] = int(words[1], 16)
    having = rtdb_conf.shares(found)
    missing = [item.name for item in found.items if item.name not in sizes and having[item.name][0]]
    if missing:
        raise ImportFailedError(f"{path}: the object file of {compiler[0]} names no size of {', '.join(missing[:5])}")
    return sizes


def _source(found: Configuration, path: Path) -> str:
    """A C++ file with one array as long as each type; its lines are named as those of the configuration."""
    name = str(path).replace("\\", "\\\\").replace('"', '\\"')
    having = rtdb_conf.shares(found)
    includes, arrays = [], []
    for item, line in zip(found.items, found.lines, strict=True):
        at = f'#line {line} "{name}"'
        array = f"char {SYMBOL}{item.name}[sizeof({item.datatype})] = {{1}};"
        if having[item.name][0]:
            includes += [at, f'#include "{item.headerfile}"']
            arrays += [at, array]
        else:  # teams leave such items behind, and not always their headers
            guard = f'#if __has_include("{item.headerfile}")'
            includes += [at, guard, at, f'#include "{item.headerfile}"', "#endif"]
            arrays += [at, guard, at, array, "#endif"]
    return "\n".join([*includes, *arrays, ""])


def _tools(said: str | None) -> tuple[list[str], list[str]]:
    """The command lines of the compiler and of nm, which begins with the same words as a cross compiler does."""
    wanted = said or os.environ.get("CXX") or next(filter(shutil.which, COMPILERS), "")
    compiler = shlex.split(wanted)
    if not compiler or shutil.which(compiler[0]) is None:
        named = f"there is no command {compiler[0]}" if compiler else f"there is none of {', '.join(COMPILERS)}"
        raise ImportFailedError(
            f"cannot learn the sizes of C types: {named}; {PACKAGES}, or give --cc COMMAND; the agent needs none"
        )
    folder, _, name = compiler[0].rpartition("/")
    beside = [f"{folder}/{name[:at]}nm" if folder else f"{name[:at]}nm" for at in [name.rfind("-") + 1]]
    nm = next(filter(shutil.which, (*beside, "nm", "llvm-nm")), "")
    if not nm:
        raise ImportFailedError(f"cannot learn the sizes of C types: there is no command nm; {PACKAGES}")
    return compiler, [nm]


def _run(words: list[str], what: str, path: Path) -> str:
    environment = os.environ | {"LC_ALL": "C"}
    try:
        ran = subprocess.run(words, capture_output=True, text=True, errors="replace", timeout=COMPILE_S_MAX, env=environment)
    except OSError as error:
        raise ImportFailedError(f"{path}: cannot run {words[0]}: {error.strerror}; {PACKAGES}") from error
    except subprocess.TimeoutExpired as error:
        raise ImportFailedError(f"{path}: {words[0]} has not ended within {COMPILE_S_MAX} s; try it by hand") from error
    if ran.returncode:
        said = [line.strip() for line in ran.stderr.splitlines() if ": error: " in line or "fatal error" in line]
        reasons = tuple(dict.fromkeys(said or ran.stderr.splitlines()))[:REASONS_MAX]
        raise ImportFailedError(
            f"{path}: {what} ({words[0]}) does not know every type; give the folders of the headers with -I DIR, "
            f"and the C++ of old headers with --cc '{words[0]} -std=gnu++98'",
            reasons,
        )
    return ran.stdout
