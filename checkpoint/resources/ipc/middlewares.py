"""Recognise the middleware that made a piece of shared memory, so that a refusal names the switch that turns it off.

A name of a segment decides first; where it says nothing, the libraries that the program has mapped decide.

Sources: `zenoh <https://github.com/eclipse-zenoh/zenoh>`_ 1.10: ``/dev/shm/NUMBER.zenoh``, DEFAULT_CONFIG.json5; the README of
rmw_zenoh (ZENOH_CONFIG_OVERRIDE). Fast DDS: SHM_MANAGER_DOMAIN of SharedMemTransport.cpp is "fastrtps" up to 2.x and "fastdds"
from 3.0; data sharing writes ``fast_datasharing_GUID``; FASTDDS_BUILTIN_TRANSPORTS is known from 2.11 on. iceoryx2 0.10:
``iox2_…`` (its own default prefix). Cyclone DDS with iceoryx: RouDi makes ``/iceoryx_mgmt``, and segments that have the name of a
group of users. Python: ``multiprocessing.shared_memory`` makes ``/psm_…``.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Final

from msgspec import Struct


class Middleware(Struct, frozen=True):
    """One that shares memory between processes.

    Attributes:
        segments: matches the names of its files in /dev/shm.
        libraries: matches the file names of its libraries; None where the name of a segment alone tells.
        cure: what a user does so that it shares none, an imperative.
    """

    name: str
    segments: re.Pattern[str]
    libraries: re.Pattern[str] | None
    cure: str


KNOWN: Final = (
    Middleware(
        "zenoh",
        re.compile(r"\d+\.zenoh"),
        re.compile(r"(libzenoh|zenoh\.).*"),
        "set transport/shared_memory/enabled to false in its zenoh configuration (a ROS 2 node: "
        "ZENOH_CONFIG_OVERRIDE='transport/shared_memory/enabled=false')",
    ),
    Middleware(
        "Fast DDS",
        re.compile(r"(sem\.)?(fastrtps|fastdds)_.*|fast_datasharing_.*"),
        re.compile(r"lib(fastrtps|fastdds)\b.*"),
        "start it with FASTDDS_BUILTIN_TRANSPORTS=UDPv4 (before Fast DDS 2.11: a profile with useBuiltinTransports false and a "
        "UDPv4 transport), and set data_sharing to OFF in its profile",
    ),
    Middleware(
        "iceoryx2",
        re.compile(r"iox2_.*"),
        re.compile(r"(lib)?_?iceoryx2.*"),
        "it has no other transport: choose another middleware for the program (a ROS 2 node: "
        "RMW_IMPLEMENTATION=rmw_cyclonedds_cpp)",
    ),
    Middleware(
        "Cyclone DDS with iceoryx",
        re.compile(r"iceoryx_mgmt"),
        re.compile(r"libiceoryx_(posh|binding).*"),
        "start it with CYCLONEDDS_URI='<SharedMemory><Enable>false</Enable></SharedMemory>' (from Cyclone DDS 11 on: without the "
        "PubSubMessageExchange of its configuration)",
    ),
    Middleware(
        "Python's multiprocessing",
        re.compile(r"psm_.*"),
        None,
        "protect the process that started the others, with which they are one component",
    ),
)

SHM: Final = "/dev/shm/"


def made_by(path: str, mapped: Iterable[str]) -> Middleware | None:
    """Which middleware made a segment; None where none is known that did.

    Args:
        path: of the segment, as /proc/PID/maps names it.
        mapped: the names of all that the program has mapped.
    """
    name = path.removesuffix(" (deleted)").removeprefix(SHM)
    for one in KNOWN:
        if one.segments.fullmatch(name):
            return one
    libraries = {file.rpartition("/")[2] for file in mapped if ".so" in file}
    for one in KNOWN:
        if one.libraries is not None and any(map(one.libraries.fullmatch, libraries)):
            return one
    return None
