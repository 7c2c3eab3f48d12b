"""Parse an image of the vdso(7), the code that the kernel maps into every program: its functions and their places.

Source: elf(5), vdso(7).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import Final

from msgspec import Struct

_HEADER: Final = struct.Struct("<16sHHIQQQIHHHHHH")
_SEGMENT: Final = struct.Struct("<IIQQQQQQ")
_ENTRY: Final = struct.Struct("<QQ")
_SYMBOL: Final = struct.Struct("<IBBHQQ")
_MAGIC: Final = b"\x7fELF\x02\x01"
PT_LOAD: Final = 1
PT_DYNAMIC: Final = 2
DT_STRTAB: Final = 5
DT_SYMTAB: Final = 6
STT_FUNC: Final = 2
AT_SYSINFO_EHDR: Final = 33
"""Entry of the auxiliary vector that says where the image lies. Source: getauxval(3)."""


class Function(Struct, frozen=True):
    """A function of an image.

    Attributes:
        offset: of its first instruction, in bytes from the beginning of the image.
        size: of its code, in bytes.
    """

    name: str
    offset: int
    size: int


def functions(image: bytes) -> tuple[Function, ...]:
    """The functions that an image offers; none where it is not an image.

    Its table of symbols ends where the table of their names begins: every linker lays them out so, and of the hash tables, which
    would tell, a kernel may have either kind.
    """
    try:
        return tuple(_functions(image))
    except (struct.error, KeyError, ValueError, OverflowError):
        return ()


def _functions(image: bytes) -> Iterator[Function]:
    if not image.startswith(_MAGIC):
        return
    dynamic = _dynamic(image)
    names = dynamic[DT_STRTAB]
    for place in range(dynamic[DT_SYMTAB], names, _SYMBOL.size):
        name, kind, _, section, offset, size = _SYMBOL.unpack_from(image, place)
        if kind & 0xF == STT_FUNC and section and offset + size <= len(image):
            begin = names + name
            yield Function(image[begin : image.index(b"\0", begin)].decode(), offset, size)


def _dynamic(image: bytes) -> dict[int, int]:
    """Its dynamic section: tag → value; addresses are offsets, for an image is linked at 0."""
    for address, size in _segments(image, PT_DYNAMIC):
        return dict(_ENTRY.iter_unpack(image[address : address + size]))
    raise ValueError("no dynamic section")


def _segments(image: bytes, wanted: int) -> Iterator[tuple[int, int]]:
    """Address and size in memory of those of one kind."""
    header = _HEADER.unpack_from(image)
    table, entry_size, count = header[5], header[9], header[10]
    for index in range(count):
        kind, _, _, address, _, _, size, _ = _SEGMENT.unpack_from(image, table + index * entry_size)
        if kind == wanted:
            yield address, size


def ends(image: bytes) -> tuple[int, int]:
    """Where that of an image ends which programs use, and where all of it does; offsets from its beginning.

    In between lie names of its sections and their headers, which only debuggers read; the headers are the last thing in an image.

    Raises:
        struct.error: it is not an image.
    """
    header = _HEADER.unpack_from(image)
    used = max((address + size for address, size in _segments(image, PT_LOAD)), default=0)
    whole = header[6] + header[11] * header[12]
    return used, max(used, whole)


def address_in(auxv: bytes) -> int:
    """Where a program looks for the image, by its auxiliary vector; 0 where it is told of none."""
    whole = len(auxv) // _ENTRY.size * _ENTRY.size
    return next((value for kind, value in _ENTRY.iter_unpack(auxv[:whole]) if kind == AT_SYSINFO_EHDR), 0)
