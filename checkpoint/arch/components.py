"""How a snapshot describes the components of a thread's extended state; each processor's own file defines the components."""

from __future__ import annotations

import struct
from typing import Final

from msgspec import Struct


class Component(Struct, frozen=True):
    """One component of a thread's extended state.

    Attributes:
        number: as the processor or the kernel numbers it.
        offset, size: in bytes.
    """

    number: int
    offset: int
    size: int


Layout = tuple[Component, ...]
"""The components in order, as their processor's file says; () where the processor could not be asked."""

_ENTRY: Final = struct.Struct("<III")


def encode_layout(layout: Layout) -> bytes:
    """As a snapshot holds it: number, offset and size of each component, 32 bits each."""
    return b"".join(_ENTRY.pack(one.number, one.offset, one.size) for one in layout)


def decode_layout(content: bytes) -> Layout:
    """The reverse of `encode_layout`; () for bytes that are no layout."""
    if len(content) % _ENTRY.size:
        return ()
    return tuple(Component(*entry) for entry in _ENTRY.iter_unpack(content))
