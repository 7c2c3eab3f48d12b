"""A component as a class: the fields that are kept, and a step that ends where its state may be committed.

@failover.component(name="mapper", every=0.1)
class Mapper:
    pose: Pose = failover.kept(default=Pose(0, 0, 0))
    grid: NDArray[np.uint8] = failover.kept(shape=(512, 512), dtype=np.uint8)

    def step(self) -> None: ...

failover.run(Mapper)
"""

from __future__ import annotations

import copy
import importlib
import typing
from collections.abc import Callable, Mapping
from typing import Any, Final, Protocol, TypeVar, overload

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from failover.errors import SchemaError, TaskError
from failover.kept_state.api import PROCESS, Resumed, Task, open_task
from failover.kept_state.loop import LONGEST_PERIOD_S, run_steps
from failover.kept_state.state import KeptState
from failover.state import MISSING, Field, Schema

T = TypeVar("T")
C = TypeVar("C")
D = TypeVar("D", bound=np.generic)

DECLARED: Final = "__failover_component__"

RUNNER: Final = "__failover_runner__"
"""Of a class that is no component and may be run nevertheless: ``module:function``, called with it."""


class Kept:
    """The attribute that `kept` leaves in a class: the declaration, and the first value for an instance that is made by hand."""

    def __init__(self, declared: Field) -> None:
        self.declared = declared
        self._name = ""

    def __set_name__(self, owner: type, name: str) -> None:
        """The attribute that it is."""
        self._name = name

    def __get__(self, instance: object | None, owner: type) -> Any:
        """The first value, made when it is first asked for; from then on it is a plain attribute."""
        if instance is None:
            return self
        value = self.first(None)
        instance.__dict__[self._name] = value
        return value

    def first(self, state: KeptState | None) -> Any:
        """The value of a component that begins here; its array in live memory of ``state``, if that is given."""
        declared = self.declared
        if declared.factory is not None:
            return declared.factory()
        if declared.shape is not None:
            dtype = np.dtype(declared.dtype)
            return np.zeros(declared.shape, dtype) if state is None else state.array(self._name, declared.shape, dtype)
        return copy.deepcopy(declared.default)


@overload
def kept(*, default: T, formerly: str | tuple[str, ...] = ..., pickled: bool = ...) -> T: ...
@overload
def kept(*, factory: Callable[[], T], formerly: str | tuple[str, ...] = ..., pickled: bool = ...) -> T: ...
@overload
def kept(*, shape: int | tuple[int, ...], dtype: type[D], formerly: str | tuple[str, ...] = ...) -> NDArray[D]: ...
@overload
def kept(*, shape: int | tuple[int, ...], dtype: str | np.dtype[Any], formerly: str | tuple[str, ...] = ...) -> Any: ...
def kept(
    *,
    default: Any = MISSING,
    factory: Callable[[], Any] | None = None,
    shape: int | tuple[int, ...] | None = None,
    dtype: Any = None,
    formerly: str | tuple[str, ...] = (),
    pickled: bool = False,
) -> Any:
    """An attribute that survives; to the program it is a plain attribute.

    Args:
        default: its first value, copied for each use; or ``factory`` makes it.
        shape, dtype: of an array that keeps its form, zeros at first. The kernel tells which pages of a large one
            were written, so that a commit costs the changed pages and not the whole array.
        formerly: names under which it was stored before it was renamed.
        pickled: store it by pickle. A person who can write the stored state can then run code in this program.
    """
    given = [default is not MISSING, factory is not None, shape is not None]
    if sum(given) != 1 or (shape is None) != (dtype is None):
        raise SchemaError("cannot keep this attribute: say default=, or factory=, or shape= and dtype=")
    sizes = (shape,) if isinstance(shape, int) else shape
    names = (formerly,) if isinstance(formerly, str) else formerly
    return Kept(Field(default=default, factory=factory, dtype=dtype, shape=sizes, formerly=names, pickled=pickled))


class Declaration(Struct, frozen=True):
    """The declarations that `component` got for a class.

    Attributes:
        period_ns: 0 for steps that follow one another at once.
    """

    name: str
    period_ns: int
    version: int
    migrations: Mapping[int, Callable[[Any], Any]] | None


@overload
def component(
    *,
    name: str = ...,
    every: float | None = ...,
    version: int = ...,
    migrations: Mapping[int, Callable[[Any], Any]] | None = ...,
) -> Callable[[type[C]], type[C]]: ...
@overload
def component(cls: type[C], /) -> type[C]: ...
def component(
    cls: type[C] | None = None,
    /,
    *,
    name: str = "",
    every: float | None = None,
    version: int = 1,
    migrations: Mapping[int, Callable[[Any], Any]] | None = None,
) -> Any:
    """Declare a class whose kept attributes survive.

    Args:
        name: of the component; the class's name in small letters unless given. The person who starts the program may set another.
        every: seconds from the beginning of a step to that of the next one; none: at once.
        version: of the kept state; raise it when a migration is needed.
        migrations: by the version that they start from, see ``failover.state``.
    """
    if cls is not None and not isinstance(cls, type):
        raise TaskError(f"@failover.component({cls!r}) is above no class: write @failover.component(name={cls!r})")
    if every is not None and not 0 < every < LONGEST_PERIOD_S:
        raise TaskError(f"every={every} is no period: say how many seconds lie between the beginnings of two steps")

    def declared(chosen: type[C]) -> type[C]:
        if not callable(getattr(chosen, "step", None)):
            raise TaskError(f"{chosen.__name__} has no step(self): a component needs one; its end is where a commit is made")
        if not kept_of(chosen):
            raise TaskError(f"{chosen.__name__} keeps nothing: give an attribute failover.kept(default=…)")
        period_ns = round((every or 0) * 1e9)
        setattr(chosen, DECLARED, Declaration(name or chosen.__name__.lower(), period_ns, version, migrations))
        return chosen

    return declared if cls is None else declared(cls)


def kept_of(cls: type) -> dict[str, Kept]:
    """The kept attributes of a class and of those that it comes from."""
    found: dict[str, Kept] = {}
    for origin in reversed(cls.__mro__):
        for name, value in vars(origin).items():
            if isinstance(value, Kept):
                found[name] = value
            else:
                found.pop(name, None)
    return found


class Versioned(Protocol):
    """A declaration with a version of the kept state."""

    @property
    def version(self) -> int:
        """Of the state's form."""
        ...

    @property
    def migrations(self) -> Mapping[int, Callable[[Any], Any]] | None:
        """By the version that they start from."""
        ...


def schema_of(cls: type, declaration: Versioned, name: str, more: Mapping[str, Field] | None = None) -> Schema:
    """The schema of everything that a class keeps: one, so that an object in two attributes stays one.

    Args:
        more: what is kept besides its attributes.
    """
    try:
        hints = typing.get_type_hints(cls, include_extras=True)
    except NameError as error:
        raise SchemaError(
            f"cannot keep {name}: its annotations name {error.name}, which is not there when the program runs; import it outright"
        ) from error
    fields = {
        key: Field(
            annotation=hints.get(key, MISSING),
            default=one.declared.default,
            factory=one.declared.factory,
            dtype=one.declared.dtype,
            shape=one.declared.shape,
            formerly=one.declared.formerly,
            pickled=one.declared.pickled,
        )
        for key, one in kept_of(cls).items()
    }
    return Schema.of_fields(fields | dict(more or {}), name=name, version=declaration.version, migrations=declaration.migrations)


class Component(Protocol):
    """The object that `run` runs."""

    def step(self) -> object:
        """One activation; it ends at a point where the state may be committed. May be a coroutine."""
        ...


R = TypeVar("R", bound=Component)


@overload
def run(cls: type[R]) -> R: ...
@overload
def run(cls: type[C]) -> C: ...
def run(cls: type[Any]) -> Any:
    """Make the component, give it its state, and run its steps; each that returns is committed. Drivers: `failover.driver`.

    Kept attributes are there when ``__init__`` runs. After a resume they are set again afterwards, so that the beginnings which
    it sets do not take the place of the kept values; then ``on_resume`` is called, if there is one, and then the steps begin.
    A step that returns `FINISHED` is the last one; one that raises is not committed. SIGTERM ends the program after the step
    under way.

    Returns:
        The component after its last step.
    """
    if runner := getattr(cls, RUNNER, ""):
        module, _, function = runner.partition(":")
        return getattr(importlib.import_module(module), function)(cls)
    declaration = getattr(cls, DECLARED, None)
    if not isinstance(declaration, Declaration):
        raise TaskError(f"cannot run {cls.__name__}: it is not declared; write @failover.component(name=…) above it")
    PROCESS.refuse_second(declaration.name)
    attributes = kept_of(cls)

    def begin(state: KeptState) -> dict[str, Any]:
        return {key: one.first(state) for key, one in attributes.items()}

    task = open_task(declaration.name, lambda name: schema_of(cls, declaration, name), begin)
    PROCESS.keep(task)
    try:
        instance = instance_of(cls, task)
        run_steps(task, instance.step, on_resume_of(instance, task.resumed), declaration.period_ns)
    finally:
        PROCESS.release()
    return instance


def instance_of(cls: type[C], task: Task) -> C:
    """The object with its kept attributes, which are the task's value from now on."""
    instance = cls.__new__(cls)
    values = task.value
    vars(instance).update(values)
    instance.__init__()  # type: ignore[misc]
    if task.resumed is not None:
        vars(instance).update(values)
    task.value = vars(instance)
    return instance


def on_resume_of(instance: object, resumed: Resumed | None) -> Callable[[], object] | None:
    """Its ``on_resume`` with where the state came from, if there are both."""
    called = getattr(instance, "on_resume", None)
    return None if called is None or resumed is None else lambda: called(resumed)
