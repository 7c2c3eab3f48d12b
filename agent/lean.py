"""Optional parts of an interpreter that the agent's processes do without: three megabytes each, in the heart locked ones.

Python may be built without each of them, and what imports them says so by falling back. OpenSSL, which asyncio and hashlib load,
is of no use here: beats are sealed by BLAKE2, which is Python's own, and the lanes' encryption is ZeroMQ's.

`python -m agent.lean MODULE ARGUMENT…` is how the heart starts its lanes.
"""

from __future__ import annotations

import sys
from importlib import import_module
from importlib.util import find_spec
from typing import Final

OPTIONAL: Final = ("_ssl", "_bz2", "_lzma", "typing_extensions")

OPENSSL_DIGESTS: Final = "_hashlib"
OWN_DIGESTS: Final = ("_md5", "_sha1", "_sha3", "_blake2")
"""Without one of them (some distributions leave them out) hashlib would miss OpenSSL's."""


def begin() -> None:
    """Leave them out of this process, where nothing has loaded them yet."""
    own = all(find_spec(name) is not None for name in OWN_DIGESTS)
    for name in (*OPTIONAL, *((OPENSSL_DIGESTS,) if own else ())):
        sys.modules.setdefault(name, None)  # type: ignore[arg-type]  # the import system's sign for: not to be had


def main() -> int:
    """Be one of the agent's other processes."""
    begin()
    module = import_module(sys.argv.pop(1))
    return int(module.main())


if __name__ == "__main__":
    sys.exit(main())
