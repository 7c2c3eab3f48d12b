"""board record, replay, serve: the board's items into MCAP files, back onto a board, and live to programs that look on."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Any, Final

from failover import __version__
from failover.boards import directory
from failover.cli.connection import connect
from failover.cli.ending import ended_by_signals
from failover.cli.output import render
from failover.cli.output.team_tree import size
from failover.cli.verbs.board import board_there
from failover.core.board import layout
from failover.recording.follower import Choice, Follower
from failover.recording.stream import Decisions, Stream

LIBRARY: Final = f"failover {__version__}"


def chosen(arguments: argparse.Namespace) -> Choice:
    """What --robots and --items say."""
    return Choice(tuple(arguments.robots), tuple(arguments.items))


def note(text: str) -> None:
    """A remark, beside the answer."""
    print(f"failover: note: {text}", file=sys.stderr, flush=True)


# --- Record ----------------------------------------------------------------------------------------------------------


def record(arguments: argparse.Namespace) -> int:
    """Record until the span is over, Ctrl-C or SIGTERM."""
    if arguments.recover:
        return _recover(arguments)
    from failover.recording.record import SIZE_MAX, Plan, Recorder

    span_s = None if arguments.span is None else arguments.span / 1000
    plan = Plan(Path(arguments.file), arguments.rate, span_s, arguments.max_size or SIZE_MAX, arguments.keep, LIBRARY)
    with board_there(arguments) as board:
        is_agents = not board.ensured().own.header.flags & layout.ALONE
        decisions = _decisions(arguments)
        recorder = Recorder(board, Follower(board, chosen(arguments), note), plan, decisions)
        if not arguments.json:
            print(f"recording the board of {board.robot} to {plan.path}; Ctrl-C ends it", flush=True)
        with ended_by_signals(recorder.stream.end):
            recorder.run()
    told, files = recorder.stream.counts, recorder.files
    if decisions is not None and decisions.complaint and (is_agents or told.decisions):
        note(f"decisions of the agents are not recorded to the end: {decisions.complaint}")
    for pause in told.pauses:
        note(f"nothing was recorded for a while: {pause}")
    written = sum(path.stat().st_size for path in files)
    answer = {
        "files": [str(path) for path in files],
        "bytes": written,
        "puts": told.puts,
        "missed": told.missed,
        "items": len(told.items),
        "robots": sorted(told.robots),
        "decisions": told.decisions,
        "span_s": round(recorder.took_s, 3),
    }
    if arguments.json:
        render.as_json(answer)
        return 0
    places = str(files[0]) if len(files) == 1 else f"{files[0]} to {files[-1].name}, {len(files)} files"
    print(
        f"{places}: {told.puts} puts of {len(told.items)} items of {len(told.robots)} robots, {told.decisions} decisions, in "
        f"{recorder.took_s:.1f} s, {size(written)}"
    )
    if told.missed:
        print(f"{told.missed} puts were replaced between two looks and are not in it; more looks (--rate) see more")
    return 0


def _decisions(arguments: argparse.Namespace) -> Decisions | None:
    """Those of the agent's robots; None: they are not wanted."""
    if not arguments.decisions:
        return None

    def ask(age_ms: int) -> Mapping[str, Any]:
        with connect(arguments) as agent:
            return agent.ask("why", name="", robot="", age_ms_max=age_ms)

    return Decisions(ask)


def _recover(arguments: argparse.Namespace) -> int:
    from failover.recording.mcap_file import recover

    path = Path(arguments.file)
    done = recover(path, LIBRARY)
    lost = done.loss.sentence(path)
    if arguments.json:
        answer = {"file": str(path), "messages": done.messages, "before": None if done.kept is None else str(done.kept)}
        render.as_json(answer | {"tail": done.loss.tail if done.kept else 0, "damaged_chunks": done.loss.chunks})
        return 0
    if done.kept is None:
        print(f"{path} is whole, with {done.messages} messages; nothing was changed")
    else:
        print(f"{path} is whole now, with {done.messages} messages; as it was it is {done.kept.name}\n{lost}")
    return 0


# --- Replay ----------------------------------------------------------------------------------------------------------


def replay(arguments: argparse.Namespace) -> int:
    """Play the files once, or again and again."""
    from failover.recording.replay import TURN_S, Player, Source, Stage

    source = Source([Path(file) for file in arguments.files], chosen(arguments))
    contents = source.examined()
    for lost in contents.lost:
        note(lost)
    place = Path(arguments.board) if arguments.board else directory.find()
    with Stage(place, contents, arguments.prefix or "") as stage:
        robots = sorted({channel.robot for channel in contents.channels.values()})
        span_s = (contents.last_ns - contents.first_ns) / 1e9
        if not arguments.json:
            there = stage.board.directory
            since = datetime.fromtimestamp(contents.first_ns / 1e9).strftime("%Y-%m-%d %H:%M:%S")
            print(
                f"replaying {contents.puts} puts of {len(contents.channels)} items of {', '.join(robots)}, {span_s:.1f} s from "
                f"{since} on, to the board of {stage.board.robot}; programs find it by FAILOVER_BOARD={there}",
                flush=True,
            )
        for said in stage.notes:
            note(said)
        least_s = TURN_S if arguments.loop else 0.0
        player = Player(source, contents, stage, arguments.pace)
        with ended_by_signals(player.end):
            player.run(least_s)
            while arguments.loop and not player.is_ended:
                player.run(least_s)
    answer = {"puts": player.puts, "items": len(contents.channels), "robots": robots, "span_s": round(span_s, 3)}
    if arguments.json:
        render.as_json(answer | {"lost": contents.lost})
    else:
        print(f"replayed {player.puts} puts")
    return 0


# --- Serve -----------------------------------------------------------------------------------------------------------


def serve(arguments: argparse.Namespace) -> int:
    """Show the board live until Ctrl-C or SIGTERM."""
    from failover.recording.foxglove_server import LiveServer, check_address

    check_address(arguments.listen, arguments.unsafe_listen)
    with board_there(arguments) as board:
        follower = Follower(board, chosen(arguments), note)
        with LiveServer(f"failover {board.robot}", arguments.listen, arguments.foxglove, follower) as server:
            told = {"address": arguments.listen, "port": server.port, "robot": board.robot}
            if arguments.json:
                render.as_json(told)
            else:
                place = f"[{arguments.listen}]" if ":" in arguments.listen else arguments.listen
                print(f"the board of {board.robot} is live at ws://{place}:{server.port}, until Ctrl-C", flush=True)
            stream = Stream(board, follower, server, _decisions(arguments))
            with ended_by_signals(stream.end):
                stream.run(arguments.rate, None, each_look=server.fulfil)
    return 0
