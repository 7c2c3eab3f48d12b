"""task import, trace: files of other programs, read and written."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from failover.cli.output import render
from failover.cli.verbs.tasks import given, opened
from failover.config.quantities import span_ms
from failover.core.schedule import orders, pman_conf
from failover.core.schedule.terms import nanoseconds
from failover.errors import ScheduleError
from failover.schedule import trace


def import_file(arguments: argparse.Namespace) -> int:
    """Declare the tasks of CAMBADA's pman.conf, all of them or none."""
    tick_ns = nanoseconds(arguments.tick_ms / 1000, "--tick-ms")
    try:
        text = Path(arguments.file).read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise ScheduleError(f"cannot read {arguments.file}: byte {error.start} is not UTF-8") from None
    except OSError as error:
        raise ScheduleError(f"cannot read {arguments.file}: {error.strerror}") from error
    found = pman_conf.declarations(text, tick_ns, arguments.file)
    return given(arguments, lambda rows, held: orders.added(rows, found, held), f"declared {len(found)} tasks")


def write_trace(arguments: argparse.Namespace) -> int:
    """Look at the tasks for some time, and write what they did."""
    try:
        duration_s = span_ms(arguments.span) / 1000
    except ValueError as error:
        raise ScheduleError(f"--for {arguments.span}: {error}") from None
    with opened(arguments) as file, Path(arguments.output).open("w", encoding="utf-8") as written:
        traced = trace.watch(file, duration_s)
        json.dump(trace.as_events(traced), written, separators=(",", ":"))
    count, tasks = len(traced.activations), len({one.row for one in traced.activations})
    unseen = sum(traced.unseen.values())
    if arguments.json:
        render.as_json({"file": arguments.output, "activations": count, "tasks": tasks, "unseen": unseen})
        return 0
    more = f"; {unseen} more began and ended between two looks" if unseen else ""
    print(f"{arguments.output}: {count} activations of {tasks} tasks{more}")
    return 0
