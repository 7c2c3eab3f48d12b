"""A driver as a class: its path, and which of its methods are commands, queries and streams.

@failover.driver("University/Lab/Robotino/Engines/3/PWM", alias="engine", rate_hz=20)
class Pwm:
    duty = 0.0

    @failover.command(coalesce="latest")
    def set(self, duty: float) -> None: ...

    @failover.query
    def read(self) -> dict[str, float]: ...

    @failover.stream(rate_hz=10)
    def current(self) -> float: ...

failover.run(Pwm)
"""

from __future__ import annotations

import inspect
import os
import typing
from collections.abc import Callable, Mapping
from typing import Any, Final, Literal, TypeVar, overload

import msgspec
from msgspec import Struct

from failover.core.messaging.envelope import SPEAKS, VERSION_SIZE_MAX, is_version
from failover.core.messaging.pacing import Coalesce
from failover.core.naming import names, worlds
from failover.errors import DriverError, NameFormatError
from failover.kept_state.component import DECLARED, RUNNER, kept_of

C = TypeVar("C")
F = TypeVar("F", bound=Callable[..., Any])

VERB: Final = "__failover_verb__"
DRIVER: Final = "__failover_driver__"

RATE_HZ_MAX: Final = 10_000.0
"""Above it the loop of a driver is the limit."""

VERB_SIZE_MAX: Final = 64
VERBS_MAX: Final = 64

Role = Literal["command", "query", "stream"]


class Marked(Struct, frozen=True):
    """What a decorator says about a method.

    Attributes:
        role: command: goes to the device, paced; query: answers at once; stream: is called ``rate_hz`` times a second for those
            that have subscribed.
    """

    role: Role
    coalesce: Coalesce = "queue"
    rate_hz: float = 0


class Verb(Struct, frozen=True):
    """One verb of a driver, as messages name it: ``set``, or ``set@1`` of a caller that speaks version 1.

    Attributes:
        arguments: a Struct of the method's arguments; what does not fit it is refused.
        earlier: the version whose class has the method; "": the driver has it.
    """

    name: str
    marked: Marked
    arguments: type[Struct]
    earlier: str = ""

    @property
    def method(self) -> str:
        """The name of the method."""
        return self.name.partition(SPEAKS)[0]


class Declaration(Struct, frozen=True):
    """What `driver` was told about a class.

    Attributes:
        version, migrations: of the kept state, as of `failover.component`.
        earlier: version of callers → the class whose verbs they call.
    """

    path: str
    aliases: tuple[str, ...]
    rate_hz: float | None
    verbs: Mapping[str, Verb]
    labels: Mapping[str, str]
    version: int = 1
    migrations: Mapping[int, Callable[[Any], Any]] | None = None
    earlier: Mapping[str, type] = {}

    @property
    def shown(self) -> list[Verb]:
        """The verbs without those that say in other words that a caller speaks the newest version."""
        return [one for one in self.verbs.values() if one.earlier or SPEAKS not in one.name]

    def schemas(self) -> dict[str, Any]:
        """Verb → role, and the JSON schema of its arguments, for the record."""
        return {one.name: {"role": one.marked.role} | _schema(one) for one in self.shown}


@overload
def command(function: F, /) -> F: ...
@overload
def command(*, coalesce: Coalesce = ...) -> Callable[[F], F]: ...
def command(function: Any = None, /, *, coalesce: Coalesce = "queue") -> Any:
    """A method that makes the device do something; at most ``rate_hz`` of the driver are carried out in a second.

    Args:
        coalesce: ``queue``: each waits its turn; ``latest``: those in a row that wait become one, later fields win.
    """
    if coalesce not in typing.get_args(Coalesce):
        raise DriverError(f"coalesce={coalesce!r} is none of {', '.join(typing.get_args(Coalesce))}")
    return _marker(function, Marked("command", coalesce), "command")


def query(function: F, /) -> F:
    """A method that tells something and changes nothing; it is never paced, but waits for commands that came before."""
    return _marker(function, Marked("query"), "query")  # type: ignore[no-any-return]


def stream(*, rate_hz: float) -> Callable[[F], F]:
    """A method without arguments whose value is sent to all that have subscribed, so many times a second."""
    check_rate(rate_hz)
    return _marker(None, Marked("stream", rate_hz=rate_hz), "stream")  # type: ignore[no-any-return]


def _marker(function: Any, marked: Marked, word: str) -> Any:
    def mark(chosen: F) -> F:
        setattr(chosen, VERB, marked)
        return chosen

    if function is None:
        return mark
    if not inspect.isfunction(function):
        raise DriverError(f"@failover.{word} is above no method: {function!r}")
    return mark(function)


def driver(
    path: str,
    /,
    *,
    alias: str | tuple[str, ...] = (),
    rate_hz: float | None = None,
    labels: Mapping[str, str] | None = None,
    version: int = 1,
    migrations: Mapping[int, Callable[[Any], Any]] | None = None,
    speaks: str = "",
    earlier: Mapping[str, type] | None = None,
) -> Callable[[type[C]], type[C]]:
    """Declare a class that speaks for one device; `failover.run` runs it. Attributes that are `failover.kept` survive.

    Args:
        path: where the device is in the team's tree of names: ``University/Lab/Robotino/Engines/3/PWM``; in a simulated world
            (``$FAILOVER_WORLD``) below that.
        alias: one free text or several by which it may be called, too.
        rate_hz: the most commands a second that the device takes; None: as many as come.
        labels: whatever others may want to know.
        version, migrations: of the kept attributes, as of `failover.component`.
        speaks: the version of the verbs of this class, for callers that name the one that they speak.
        earlier: version → a class with the verbs of that version, for callers that still speak it. It is made with the driver as
            its only argument, when the first of them calls, and calls the driver's methods.

    Raises:
        DriverError: the class or an argument cannot work.
    """
    aliases = (alias,) if isinstance(alias, str) else tuple(alias)
    try:
        world = worlds.checked(os.environ.get(worlds.VARIABLE, ""))
        normal, aliases = worlds.within(world, names.path(path)), tuple(names.alias(one) for one in aliases)
    except NameFormatError as error:
        raise DriverError(f"cannot declare a driver: {error}") from error
    if rate_hz is not None:
        check_rate(rate_hz)

    def declared(chosen: type[C]) -> type[C]:
        if not isinstance(chosen, type):
            raise DriverError(f"@failover.driver is above {chosen!r}, which is no class")
        if hasattr(chosen, DECLARED):
            raise DriverError(
                f"{chosen.__name__} is a component (failover.component) already: declare a class for each of the two"
            )
        verbs = _verbs(chosen)
        if speaks or earlier:
            verbs |= _spoken(_verbs(chosen), _checked_versions(chosen, speaks, earlier or {}), is_earlier=False)
        for spoken, cls in (earlier or {}).items():
            verbs |= _spoken(_verbs(cls), spoken, is_earlier=True)
        shown = sum(1 for one in verbs.values() if one.earlier or SPEAKS not in one.name)
        if shown > VERBS_MAX:
            raise DriverError(
                f"{chosen.__name__} has {shown} verbs with those of its earlier versions, {VERBS_MAX} are the most; "
                "leave a version out"
            )
        told = dict(labels or {}), version, migrations, dict(earlier or {})
        setattr(chosen, DRIVER, Declaration(normal, aliases, rate_hz, verbs, *told))
        setattr(chosen, RUNNER, "failover.drivers.server:run")
        return chosen

    return declared


def declaration_of(cls: type) -> Declaration:
    """What was declared.

    Raises:
        DriverError: nothing was.
    """
    found = getattr(cls, DRIVER, None)
    if not isinstance(found, Declaration):
        raise DriverError(f"{cls.__name__} is no driver: write @failover.driver(path) above it")
    return found


def _verbs(cls: type) -> dict[str, Verb]:
    found: dict[str, Verb] = {}
    for origin in reversed(cls.__mro__):
        for name, function in vars(origin).items():
            marked = getattr(function, VERB, None)
            if isinstance(marked, Marked):
                if name.startswith("_") or len(name.encode()) > VERB_SIZE_MAX:
                    raise DriverError(f"{cls.__name__}.{name} cannot be a verb: it begins with _, or is too long")
                found[name] = Verb(name, marked, _arguments(cls, name, function, marked))
    if len(found) > VERBS_MAX:
        raise DriverError(f"{cls.__name__} has {len(found)} verbs, {VERBS_MAX} are the most")
    if not found:
        raise DriverError(f"{cls.__name__} has no verb: write @failover.command or @failover.query above a method")
    return found


def _spoken(verbs: Mapping[str, Verb], version: str, *, is_earlier: bool) -> dict[str, Verb]:
    """The verbs as callers name them that speak this version."""
    named = ((f"{name}{SPEAKS}{version}", one) for name, one in verbs.items())
    return {name: Verb(name, one.marked, one.arguments, version if is_earlier else "") for name, one in named}


def _checked_versions(cls: type, speaks: str, earlier: Mapping[str, type]) -> str:
    """The version that a class speaks.

    Raises:
        DriverError: it says none, or the versions cannot be told apart in messages.
    """
    is_text = isinstance(speaks, str) and isinstance(earlier, Mapping) and all(isinstance(one, str) for one in earlier)
    if not is_text or not all(isinstance(old, type) for old in earlier.values()):
        raise DriverError(
            f"{cls.__name__}: speaks={speaks!r}, earlier={earlier!r} do not name versions as text, and a class for each earlier "
            'one: write speaks="2", earlier={"1": Version1}'
        )
    if not speaks:
        raise DriverError(f'{cls.__name__} has earlier verbs and says no version of its own: write speaks="2", for example')
    if speaks in earlier:
        raise DriverError(f"{cls.__name__} speaks {speaks!r}, and earlier={{{speaks!r}: …}} names that, too")
    for one in (speaks, *earlier):
        if not is_version(one):
            raise DriverError(
                f"{cls.__name__}: {one!r} is no version; write letters, digits and points, {VERSION_SIZE_MAX} at most"
            )
    for old in earlier.values():
        if kept_of(old):
            raise DriverError(
                f"{old.__name__} keeps attributes: only {cls.__name__} may; the object of an earlier version can be lost"
            )
    return speaks


def _arguments(cls: type, name: str, function: Callable[..., Any], marked: Marked) -> type[Struct]:
    """The arguments of a method as a Struct.

    Raises:
        DriverError: an argument has no name or no type that a message can say.
    """
    try:
        hints = typing.get_type_hints(function, include_extras=True)
    except NameError as error:
        raise DriverError(
            f"{cls.__name__}.{name}: its annotations name {error.name}, which is not there; import it outright"
        ) from error
    fields: list[Any] = []
    for one in list(inspect.signature(function).parameters.values())[1:]:
        if one.kind in (one.POSITIONAL_ONLY, one.VAR_POSITIONAL, one.VAR_KEYWORD):
            raise DriverError(f"{cls.__name__}.{name}: {one} cannot be in a message; give each argument a name of its own")
        kind = hints.get(one.name, Any)
        fields.append((one.name, kind) if one.default is one.empty else (one.name, kind, one.default))
    if fields and marked.role == "stream":
        raise DriverError(f"{cls.__name__}.{name} is a stream, and takes no argument")
    try:
        made = msgspec.defstruct(name, fields, forbid_unknown_fields=True, kw_only=True)
        msgspec.json.Decoder(made)
    except TypeError as error:
        raise DriverError(f"{cls.__name__}.{name} has an argument that no message can say: {error}") from error
    return made


def _schema(verb: Verb) -> dict[str, Any]:
    """Name → JSON schema of each argument; {} where there is none for a type."""
    arguments = verb.arguments
    try:
        _, components = msgspec.json.schema_components([arguments])
    except TypeError:
        return {}
    properties = components[arguments.__name__].get("properties", {}) if arguments.__name__ in components else {}
    return {
        "arguments": {name: {key: value for key, value in one.items() if key != "default"} for name, one in properties.items()}
    }


def check_rate(rate_hz: float) -> None:
    """Raises DriverError: nothing can be done so often a second."""
    if not 0 < rate_hz <= RATE_HZ_MAX:
        raise DriverError(f"rate_hz={rate_hz} is no rate in Hz: write a number above 0, at most {RATE_HZ_MAX:.0f}")
