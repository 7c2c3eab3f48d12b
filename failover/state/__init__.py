"""A program's state as data: which values are kept, and in which form they come back.

    schema = Schema.of(Mission, default=Mission(), name="mission")
    encoded = schema.encode(mission)                # bytes, and regions for large arrays
    decoded = schema.decode(encoded)                # .value is a Mission, .notes say what changed meanwhile

The stored form names fields and built-in kinds, never classes: reading builds what the program declares and nothing else, and
runs nothing (but ``__post_init__`` of a msgspec.Struct). No pickle, except where a declaration says ``pickled`` itself.

| declared | comes back | remarks |
|---|---|---|
| None, bool, int, float, complex, str, bytes | the same, to the bit | int of up to a million bits, NaN payloads, odd text |
| a number's place | whichever number it held | an int in a float's place, numpy's scalars |
| bytearray, array.array | one object | numbers only |
| datetime, date, time, timedelta, timezone, ZoneInfo | the same, fold too | zones of datetime and zoneinfo |
| Decimal, Fraction, UUID, range, slice, Path, PurePath | the same | |
| ipaddress, msgspec.UNSET | the same | |
| random.Random, numpy.random.Generator | draws next what it would have drawn | Random is 2.5 KB |
| Enum, Flag, Literal | the member of that name | values may be numbered anew |
| list, deque, tuple, set, frozenset | the same, bounds too | of what is declared, or of Any |
| dict, OrderedDict, Counter, defaultdict | the same, order too | immutable keys; the factory is the declaration's |
| dataclass, attrs, msgspec.Struct, pydantic | fields as they were | pydantic's private attributes start anew |
| NamedTuple, TypedDict | the same | |
| generic classes, NewType, Annotated, Optional, Union | as declared | the first type that fits |
| numpy.ndarray, numpy scalars | dtype, C or F order | structured too; no objects, no long doubles; views whole |
| Any, object, bare list, dict … | any kind above | not a program's own classes: declare these |
| ``Annotated[X, Pickled()]``, ``Field(pickled=True)`` | as pickle makes it | *a writer of stored state can run code here* |

The schema refuses these by name and says what to keep instead (`failover.state.advice`), at declaration or at the commit: locks,
files, sockets, functions, instances of subclasses of what was declared, attributes that are no fields, views that share memory,
nesting deeper than 100, more than 64 MiB besides arrays.

An object that is reached by two paths is one object again, and cycles are cycles: a second way to a mutable object is stored as
the path of the first. That costs one look into a dictionary for each mutable object; refusing it would forbid
``current = plan[3]``.

Evolution: an added field takes its default, a removed one is dropped (both noted), ``Annotated[float, Formerly("theta")]`` finds
a former name; ``version`` and ``migrations`` change the rest, on plain values (``PlainRecord``, ``Labelled``, ``Unread``).
"""

from failover.state.declare import MISSING, Field, Formerly, Pickled
from failover.state.kinds import Region
from failover.state.pickled import Unread
from failover.state.schema import Decoded, Encoded, Schema
from failover.state.untyped import Labelled, PlainRecord

__all__ = [
    "MISSING",
    "Decoded",
    "Encoded",
    "Field",
    "Formerly",
    "Labelled",
    "Pickled",
    "PlainRecord",
    "Region",
    "Schema",
    "Unread",
]
