"""Refuse devices that have no rule, with their common names. Terminals that are streams are handled before."""

from __future__ import annotations

import stat
from typing import Final

from checkpoint.capability import Area, refused
from checkpoint.model import Resource
from checkpoint.resources.open_file import OpenFile, Surroundings

KIND: Final = "devices"

CALLED: Final = (
    ("/dev/input/", "an input device"),
    ("/dev/video", "a camera"),
    ("/dev/media", "a camera"),
    ("/dev/i2c-", "an I2C bus"),
    ("/dev/spidev", "an SPI device"),
    ("/dev/gpio", "GPIO lines"),
    ("/dev/iio", "a sensor of the IIO"),
    ("/dev/snd/", "a sound device"),
    ("/dev/hidraw", "a HID device"),
    ("/dev/bus/usb/", "a USB device"),
    ("/dev/dri/", "a GPU"),
    ("/dev/nvidia", "a GPU"),
    ("/dev/kfd", "a GPU"),
    ("/dev/mali", "a GPU"),
    ("/dev/net/tun", "a network device (tun)"),
    ("/dev/kvm", "virtual machines (KVM)"),
    ("/dev/fuse", "a file system of its own (FUSE)"),
    ("/dev/pt", "a terminal"),
    ("/dev/ttyS", "a serial line"),
    ("/dev/ttyA", "a serial line"),
    ("/dev/ttyU", "a serial line"),
    ("/dev/tty", "a terminal"),
)
"""How the path of a device begins → what people call it."""

CAPABILITIES: Final = (
    refused(
        Area.DEVICES,
        "devices without a rule: serial lines, input, cameras, I2C, SPI, GPIO, sound, GPUs …",
        "give them a rule (docs/devices.md), or let a driver process of its own hold them",
        "for which there is no rule",
        "the device {}",
        *dict.fromkeys(called for _, called in CALLED),
    ),
)


def describe(held: OpenFile, surroundings: Surroundings) -> Resource | None:
    """Nothing is described here."""
    return None


def refuse(held: OpenFile, surroundings: Surroundings) -> str | None:
    """Name a device."""
    if not (stat.S_ISCHR(held.first.mode) or stat.S_ISBLK(held.first.mode)):
        return None
    return (
        f'{held.name} is {_called(held.first.target)}, for which there is no rule: give it one ("reopen", "hook" …, see '
        "docs/devices.md), or let a driver process of its own hold it"
    )


def _called(target: str) -> str:
    for place, called in CALLED:
        if target.startswith(place):
            return f"{called} ({target})"
    return f"the device {target}"
