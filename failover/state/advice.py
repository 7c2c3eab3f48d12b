"""Advice on an object that is no data: what to keep instead, by the name of its class, so that nothing is imported for it."""

from __future__ import annotations

import collections.abc
import types
from typing import Any, Final

NOT_DATA: Final = "a state cannot hold it; keep the values that it was made from, and make it anew in on_resume"

NO_FIELDS: Final = (
    "its fields are not declared; make it a dataclass, or keep the values it was made from and make it anew in on_resume"
)

_LOCK: Final = "a lock belongs to the threads of one process; make it anew at each start, outside the state"
_RUNNING: Final = "a running one cannot move to another process; keep the values that it works on, and start it anew in on_resume"
_FILE: Final = "an open file belongs to one process; keep its path and position, and open it anew in on_resume"
_SOCKET: Final = "a connection belongs to one process; keep the address, and connect anew in on_resume"
_SUSPENDED: Final = "its position cannot be read; keep the numbers that say it in a dataclass, and make it anew in on_resume"
_FUNCTION: Final = "code is no data; keep a name or a member of an Enum, and look the function up by it"
_QUEUE: Final = "it has locks inside; keep a collections.deque, and fill the queue from it in on_resume"
_DICE: Final = "keep the numpy.random.Generator over it: numpy.random.default_rng(seed)"

_ADVICE: Final[dict[str, str]] = {
    "_thread.lock": _LOCK,
    "_thread.RLock": _LOCK,
    "threading.Condition": _LOCK,
    "threading.Semaphore": _LOCK,
    "threading.Event": _LOCK,
    "threading.Barrier": _LOCK,
    "asyncio.mixins._LoopBoundMixin": _LOCK,
    "threading.Thread": _RUNNING,
    "multiprocessing.process.BaseProcess": _RUNNING,
    "concurrent.futures._base.Executor": _RUNNING,
    "concurrent.futures._base.Future": _RUNNING,
    "_asyncio.Future": _RUNNING,
    "asyncio.events.AbstractEventLoop": _RUNNING,
    "subprocess.Popen": _RUNNING,
    "_io._IOBase": _FILE,
    "_io.BytesIO": "keep its bytes, getvalue()",
    "_io.StringIO": "keep its text, getvalue()",
    "mmap.mmap": _FILE,
    "_socket.socket": _SOCKET,
    "socket.socket": _SOCKET,
    "select.epoll": _SOCKET,
    "queue.Queue": _QUEUE,
    "_queue.SimpleQueue": _QUEUE,
    "asyncio.queues.Queue": _QUEUE,
    "functools.partial": _FUNCTION,
    "logging.Logger": "get it anew by its name: logging.getLogger(name)",
    "re.Pattern": "keep its text, pattern.pattern, and compile it anew",
    "builtins.memoryview": "keep the array or bytearray that it looks into, or bytes(it)",
    "builtins.type": "code is no data; keep a name or a member of an Enum, and look the class up by it",
    "builtins.module": "code is no data; keep the module's name",
    "builtins.BaseException": "keep its text, str(error)",
    "weakref.ReferenceType": "keep the object itself: one that is reached by two ways stays one",
    "numpy.random.bit_generator.BitGenerator": _DICE,
    "numpy.random.mtrand.RandomState": _DICE,
}
"""By class; its subclasses likewise."""

_FUNCTIONS: Final = (types.FunctionType, types.BuiltinFunctionType, types.MethodType)


def advice_for(cls: type) -> str:
    """The advice on a value of a class that cannot be kept; "" where nothing more is known than that."""
    for base in cls.__mro__:
        known = _ADVICE.get(f"{base.__module__}.{base.__qualname__}")
        if known is not None:
            return known
    if issubclass(cls, _FUNCTIONS):
        return _FUNCTION
    if issubclass(cls, collections.abc.Iterator | collections.abc.AsyncIterator | collections.abc.Coroutine):
        return _SUSPENDED
    return ""


def advice_for_annotation(annotation: Any, origin: Any) -> str:
    """The same for an object in the place of a type."""
    if origin is collections.abc.Callable or annotation is collections.abc.Callable:
        return _FUNCTION
    if isinstance(annotation, types.BuiltinFunctionType) and annotation.__module__ in ("_thread", "threading"):
        return _LOCK  # threading.Lock is a function before Python 3.13
    return NOT_DATA
