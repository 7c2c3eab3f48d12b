"""Classes made by libraries that a program may have: imported only where they are installed."""

from __future__ import annotations

from typing import Annotated

import attrs
import pydantic


@attrs.define
class Wheel:
    radius: float
    turns: list[int] = attrs.Factory(list)


@attrs.frozen(cache_hash=True)
class Bolt:
    size: int
    label: str = "M"


@attrs.define(slots=False)
class Loose:
    mass: float = 1.0
    link: Loose | None = None


class Motor(pydantic.BaseModel):
    name: str
    current: Annotated[float, pydantic.Field(ge=0)] = 0.0
    log: list[str] = pydantic.Field(default_factory=list)
    _open: bool = pydantic.PrivateAttr(default=False)


class Fixed(pydantic.BaseModel, frozen=True):
    id: int
    parent: Fixed | None = None


class Extra(pydantic.BaseModel, extra="allow"):
    id: int = 0
