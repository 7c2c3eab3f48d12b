"""A program's state as data: what is kept, and in which form it comes back.

schema = Schema.of(Mission, default=Mission(), name="mission")
encoded = schema.encode(mission)                # bytes, and regions for large arrays
decoded = schema.decode(encoded)                # .value is a Mission, .notes say what changed meanwhile
"""

from failover.state.declare import MISSING, Field, Formerly, Pickled
from failover.state.kinds import Region
from failover.state.opened import Labelled, PlainRecord
from failover.state.pickled import Unread
from failover.state.schema import Decoded, Encoded, Schema

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
