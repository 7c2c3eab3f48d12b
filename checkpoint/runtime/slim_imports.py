"""Keep unneeded modules out of our processes: saves four megabytes in each agent process, and a fifth of a command's start.

Python may be built without each of the optional parts, and the modules that import them then fall back. OpenSSL, which asyncio
and hashlib load, is of no use here: heartbeats are sealed by BLAKE2, which is Python's own, and the worker process's encryption
is ZeroMQ's.

Other modules are imported by modules that we import, for functions that we never call: they are loaded when they are used.
"""

from __future__ import annotations

import os
import sys
from importlib import import_module
from importlib.util import find_spec
from threading import Lock
from types import ModuleType
from typing import Any, Final

OPTIONAL: Final = ("ssl", "bz2", "lzma", "typing_extensions")

SELDOM_USED: Final = ("inspect", "ipaddress", "locale", "msgspec.inspect", "textwrap")
"""Wanted by dataclasses of classes without a docstring, by URLs, by children that are read as text, by schemas, by groups of
exceptions. None of them by the loop that beats, which would wait for the disk: `tests/agent/test_what_is_loaded.py`."""

OPENSSL_DIGESTS: Final = "_hashlib"
OWN_DIGESTS: Final = ("_md5", "_sha1", "_sha3", "_blake2")
"""Without one of them (some distributions leave them out) hashlib would miss OpenSSL's."""


def begin() -> None:
    """Leave them out of this process, where nothing has loaded them yet."""
    own = all(find_spec(name) is not None for name in OWN_DIGESTS)
    for name in (*OPTIONAL, *((OPENSSL_DIGESTS,) if own else ())):
        sys.modules.setdefault(name, None)  # type: ignore[arg-type]  # the import system's sign for: not to be had
    for name in SELDOM_USED:
        sys.modules.setdefault(name, _Seldom(name))


NUMPYS_TYPES: Final = "numpy._typing"
"""The types of its annotations; in the few that are evaluated a list does for an array."""
NUMPYS_TEXTS: Final = ("numpy._core._add_newdocs", "numpy._core._add_newdocs_scalars")
"""They write docstrings, and do nothing else."""
NUMPYS_THREADS: Final = "OPENBLAS_NUM_THREADS"
"""Each that its linear algebra starts while it is loaded is busy for 50 ms, waiting for work that never comes."""


def load_numpy() -> None:
    """Import numpy without the parts that take half of the time: threads, types and texts. Its types can be imported later.

    Only for processes of ours that start no program meanwhile: it would inherit a variable.
    """
    if "numpy" in sys.modules:
        return
    threads = os.environ.get(NUMPYS_THREADS)
    os.environ[NUMPYS_THREADS] = "1"
    stand_ins = {NUMPYS_TYPES: _Seldom(NUMPYS_TYPES, NDArray=list)} | {name: ModuleType(name) for name in NUMPYS_TEXTS}
    if isinstance(seldom := sys.modules.get("inspect"), _Seldom):
        vars(seldom)["cleandoc"] = str.strip  # of docstrings, again
    sys.modules.update(stand_ins)
    try:
        import_module("numpy")
    finally:
        for name, stand_in in stand_ins.items():
            if sys.modules.get(name) is stand_in:
                del sys.modules[name]
        if isinstance(seldom, _Seldom) and vars(seldom).get("cleandoc") is str.strip:
            del vars(seldom)["cleandoc"]
        if threads is None:
            del os.environ[NUMPYS_THREADS]
        else:
            os.environ[NUMPYS_THREADS] = threads


def load_seldom_used() -> None:
    """Import now what was left for its first use: soon this process may have no right to read it."""
    for name in SELDOM_USED:
        if isinstance(stand_in := sys.modules.get(name), _Seldom):
            vars(stand_in).update(vars(stand_in.loaded()))


class _Seldom(ModuleType):
    """A module until something in it is wanted, besides what is given here: then it is loaded, and this one shows what is in it.

    importlib's LazyLoader does not do: before Python 3.12.3 a second thread finds the module half loaded.
    """

    def __init__(self, name: str, **given: object) -> None:
        super().__init__(name)
        vars(self).update(given)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)  # the import system's questions want nothing of the module
        real = self.loaded()
        vars(self).update(vars(real))
        return getattr(real, name)

    def loaded(self) -> ModuleType:
        """The module itself."""
        with _standing_in:
            if sys.modules.get(self.__name__) is self:
                del sys.modules[self.__name__]
        return import_module(self.__name__)  # other threads that come meanwhile wait for it here


_standing_in: Final = Lock()
"""Held for a moment, not while a module is loaded: the import system has its own locks for that."""
