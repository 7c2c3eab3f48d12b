"""A strict reader of Prometheus' text format: what a scrape would take, and nothing else.

Source: Prometheus, "Exposition formats", text format 0.0.4.
"""

from __future__ import annotations

import math
import re

NAME = re.compile(r"[a-zA-Z_:][a-zA-Z0-9_:]*")
LABEL = re.compile(r'([a-zA-Z_][a-zA-Z0-9_]*)="((?:[^"\\\n]|\\\\|\\"|\\n)*)"(,|$)')
SAMPLE = re.compile(r"([a-zA-Z_:][a-zA-Z0-9_:]*)(?:\{(.*)\})? (\S+)")
KINDS = ("counter", "gauge")

Samples = dict[tuple[tuple[str, str], ...], float]


class FormatError(Exception):
    """A line that is none of the format; names it."""


def read(text: str) -> dict[str, Samples]:
    """Family → labels → value.

    Raises:
        FormatError: anything at all is wrong.
    """
    if not text.endswith("\n"):
        raise FormatError("the last line has no end")
    families: dict[str, Samples] = {}
    kinds: dict[str, str] = {}
    helped = ""
    for number, line in enumerate(text[:-1].split("\n"), 1):
        if line.startswith("# HELP "):
            helped, _, says = line.removeprefix("# HELP ").partition(" ")
            if not NAME.fullmatch(helped) or not says or helped in kinds:
                raise FormatError(f"{number}: {line}")
        elif line.startswith("# TYPE "):
            name, _, kind = line.removeprefix("# TYPE ").partition(" ")
            if name != helped or kind not in KINDS or (kind == "counter") != name.endswith("_total"):
                raise FormatError(f"{number}: {line}")
            kinds[name], families[name] = kind, {}
        else:
            _take(number, line, helped, kinds, families)
    if empty := [name for name, samples in families.items() if not samples]:
        raise FormatError(f"families without a sample: {empty}")
    return families


def _take(number: int, line: str, family: str, kinds: dict[str, str], families: dict[str, Samples]) -> None:
    found = SAMPLE.fullmatch(line)
    if found is None or found[1] != family or family not in kinds:
        raise FormatError(f"{number}: {line}")
    labels = _labels(number, found[2] or "")
    value = float(found[3])
    if labels in families[family] or math.isnan(value) or (kinds[family] == "counter" and value < 0):
        raise FormatError(f"{number}: said twice, or no value of its kind: {line}")
    families[family][labels] = value


def _labels(number: int, text: str) -> tuple[tuple[str, str], ...]:
    found, at = [], 0
    while at < len(text):
        one = LABEL.match(text, at)
        if one is None or one[1].startswith("__"):
            raise FormatError(f"{number}: labels {text!r} at {at}")
        found.append((one[1], re.sub(r"\\(.)", lambda part: {"n": "\n"}.get(part[1], part[1]), one[2])))
        at = one.end()
    if len({name for name, _ in found}) < len(found):
        raise FormatError(f"{number}: a label twice: {text}")
    return tuple(sorted(found))
