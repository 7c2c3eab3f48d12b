"""The delay of frames on a radio with and without RA-TDMA, in virtual time: Fig. 6 of the paper that it is due to, drawn anew.

python -m benchmarks.fig6                        9 minutes, 3 seeds, 3 kinds of traffic, 4 ways to send; writes record and plot
python -m benchmarks.fig6 --for 60 --seeds 1     one seed of a minute; prints only

Four robots send 379 bytes once in 50 ms over the medium of ``tests/simulation/radio.py``; alien echoes of 1,000 bytes through the
access point come never, each 10 ms, each 5 ms. The delay of a frame counts from its hand-off to the card to the end of its
broadcast. No figure depends on the machine: a seed gives the same ones everywhere. Exits with 1 if the shape is not as `NARROW`
and `WIDE` say, or if alien traffic widens the delays of RA-TDMA more than those of timers.

Source of the figure: F. Santos, L. Almeida, L. S. Lopes, ETFA 2008; it prints no numbers. `REFERENCE`: an earlier simulation.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from random import Random
from typing import TYPE_CHECKING, Final

import msgspec
from msgspec import Struct

from benchmarks.figures import percentile
from failover.core.frames.terms import Terms
from failover.core.types import MS
from tests.simulation.slotted import FRAME_SIZE, Pacer, Team, Unsynchronised

if TYPE_CHECKING:
    from matplotlib.axes import Axes

RECORD: Final = Path(__file__).parent / "fig6.json"
PICTURE: Final = Path(__file__).parent.parent / "docs" / "plots" / "radio.svg"
ROBOTS: Final = 4
SPAN_S: Final = 540
SEEDS: Final = 3
NOISES_MS: Final = (0, 10, 5)
BIN_MS: Final = 0.25
SHOWN_MS: Final = 30

RA_TDMA: Final = "RA-TDMA"
TOGETHER: Final = "RA-TDMA, all start together"
JITTER: Final = "timers with ±5 % of jitter"
NONE: Final = "timers"

REFERENCE: Final = {
    RA_TDMA: ((5.03, 5.39, 5.57, 6.05, 0.00), (5.13, 6.27, 7.43, 10.5, 0.43), (5.47, 6.75, 7.81, 36.8, 0.95)),
    TOGETHER: ((5.03, 5.39, 5.59, 19.2, 0.00), (5.13, 6.27, 7.42, 23.9, 0.44), (5.47, 6.76, 7.82, 36.8, 1.00)),
    NONE: ((5.35, 9.87, 15.97, 22.8, 0.58), (6.86, 13.43, 19.08, 27.9, 2.18), (6.10, 10.66, 19.70, 31.8, 1.89)),
    JITTER: ((5.19, 8.89, 13.1, 20.0, 0.38), (5.62, 9.89, 14.6, 25.4, 1.11), (6.31, 11.41, 16.8, 34.4, 2.10)),
}
"""p50, p90, p99, longest in ms, lost in %; without alien traffic, each 10 ms, each 5 ms."""

NARROW: Final = 1.6
"""With RA-TDMA one frame in a hundred takes longer than so many times the median, at most."""

WIDE: Final = 2.5
"""Without, at least."""


def _timers(jitter: float) -> Callable[[Terms, Random, int], Pacer]:
    return lambda terms, random, now_ns: Unsynchronised(terms, jitter, random, now_ns)


WAYS: Final[dict[str, tuple[Terms, Callable[[Terms, Random, int], Pacer] | None]]] = {
    RA_TDMA: (Terms(), None),
    TOGETHER: (Terms(spread=False), None),
    JITTER: (Terms(), _timers(0.05)),
    NONE: (Terms(), _timers(0)),
}


class Run(Struct):
    """What one team saw.

    Attributes:
        noise_ms: between two alien echoes, 0 for none.
        sent, lost: frames handed to a card; those of them that no robot got.
        p50_ms, p90_ms, p99_ms, longest_ms: of the delays.
        delays: how many frames had each delay, in steps of `BIN_MS`.
        took_s: of this machine's processor.
    """

    way: str
    noise_ms: int
    seed: int
    span_s: int
    sent: int
    lost: int
    p50_ms: float
    p90_ms: float
    p99_ms: float
    longest_ms: float
    delays: dict[int, int]
    took_s: float

    @property
    def lost_share(self) -> float:
        """Of the frames that were sent."""
        return self.lost / self.sent

    @property
    def round_ms(self) -> float:
        """The mean round."""
        return ROBOTS * self.span_s * 1_000 / self.sent


def play(way: str, noise_ms: int, seed: int, span_s: int) -> Run:
    """One team for so long, all robots starting at one instant."""
    began_s = time.process_time()
    terms, pacer = WAYS[way]
    team = Team(seed, ROBOTS, terms, pacer=pacer)
    team.on(*range(ROBOTS))
    team.noise(noise_ms * MS)
    team.run(span_s * 1_000 * MS)
    delays_ms = sorted(delay / MS for delay in team.delays_ns)
    p50_ms, p90_ms, p99_ms = (round(percentile(delays_ms, share), 2) for share in (0.5, 0.9, 0.99))
    return Run(
        way,
        noise_ms,
        seed,
        span_s,
        sum(len(robot.sends) for robot in team.robots),
        team.lost,
        p50_ms,
        p90_ms,
        p99_ms,
        round(delays_ms[-1], 1),
        dict(Counter(int(delay / BIN_MS) for delay in delays_ms)),
        round(time.process_time() - began_s, 1),
    )


# --- The shape -------------------------------------------------------------------------------------------------------


def flaws(runs: Sequence[Run]) -> list[str]:
    """What is not as it should be; each seed for itself."""
    found = []
    tails: dict[tuple[str, int, int], float] = {}
    for run in runs:
        tail = run.p99_ms / run.p50_ms
        tails[run.way, run.noise_ms, run.seed] = run.p99_ms - run.p50_ms
        where = f"{run.way}, {_noise(run.noise_ms)}, seed {run.seed}: p99 is {tail:.2f} × p50"
        if run.way in (RA_TDMA, TOGETHER) and tail > NARROW:
            found.append(f"{where}, more than {NARROW}")
        if run.way == NONE and tail < WIDE:
            found.append(f"{where}, less than {WIDE}")
    for (way, noise_ms, seed), tail_ms in tails.items():
        quiet_ms, other_ms, other_quiet_ms = (tails.get(key) for key in ((way, 0, seed), (NONE, noise_ms, seed), (NONE, 0, seed)))
        if way == RA_TDMA and noise_ms and None not in (quiet_ms, other_ms, other_quiet_ms):
            more_ms, others_more_ms = tail_ms - quiet_ms, other_ms - other_quiet_ms  # type: ignore[operator]
            if more_ms >= others_more_ms:
                found.append(
                    f"{_noise(noise_ms)}, seed {seed}: widens RA-TDMA by {more_ms:.2f} ms, timers by {others_more_ms:.2f}"
                )
    return found


def _noise(noise_ms: int) -> str:
    return f"echo each {noise_ms} ms" if noise_ms else "quiet"


def table(runs: Sequence[Run]) -> str:
    """p50 / p90 / p99 / longest ms, lost %: medians over the seeds (of the longest the most), and those of `REFERENCE`."""
    lines = [
        "| p50 / p90 / p99 / longest ms, lost % | " + " | ".join(_noise(noise_ms) for noise_ms in NOISES_MS) + " |",
        "|---|---|---|---|",
    ]
    for way, reference in REFERENCE.items():
        if any(run.way == way for run in runs):
            cells = [_cell([run for run in runs if (run.way, run.noise_ms) == (way, noise_ms)]) for noise_ms in NOISES_MS]
            lines.append(f"| {way} | " + " | ".join(cells) + " |")
            lines.append("| (reference) | " + " | ".join("{} / {} / {} / {}, {}".format(*one) for one in reference) + " |")
    return "\n".join(lines)


def _cell(runs: Sequence[Run]) -> str:
    if not runs:
        return ""
    middle = [statistics.median(getattr(run, name) for run in runs) for name in ("p50_ms", "p90_ms", "p99_ms")]
    longest, lost = max(run.longest_ms for run in runs), statistics.median(run.lost_share for run in runs)
    rounds = statistics.median(run.round_ms for run in runs)
    return " / ".join(f"{value:.2f}" for value in middle) + f" / {longest:.1f}, {lost:.2%} (round {rounds:.1f} ms)"


# --- The picture -----------------------------------------------------------------------------------------------------

COLOURS: Final = {RA_TDMA: "#1b6ca8", JITTER: "#c8553d", NONE: "#8d8d8d"}


def draw(runs: Sequence[Run], path: Path) -> None:
    """The histograms of all seeds together, one panel for each kind of alien traffic.

    Raises:
        ImportError: matplotlib is missing.
    """
    from matplotlib import figure as pictures
    from matplotlib import rc_context

    picture = pictures.Figure(figsize=(7.0, 6.0), layout="constrained")
    panels = picture.subplots(len(NOISES_MS), 1, sharex=True, sharey=True)
    for axes, noise_ms in zip(panels, NOISES_MS, strict=True):
        _paint(axes, [run for run in runs if run.noise_ms == noise_ms])
        axes.set_title(_noise(noise_ms), fontsize="small", loc="left")
        axes.spines[["top", "right"]].set_visible(False)
    panels[0].legend(frameon=False, fontsize="small")
    panels[1].set_ylabel(f"% of the frames, in steps of {BIN_MS} ms (logarithmic)")
    panels[-1].set_xlabel("ms from the hand-off to the end of the broadcast")
    picture.suptitle(f"Delays of frames of {ROBOTS} robots on one radio, simulated", fontsize="medium", x=0.01, ha="left")
    path.parent.mkdir(parents=True, exist_ok=True)
    with rc_context({"svg.hashsalt": path.stem, "svg.fonttype": "none"}):  # equal figures are equal files
        picture.savefig(path, metadata={"Date": None})


def _paint(axes: Axes, runs: Sequence[Run]) -> None:
    for way, colour in COLOURS.items():
        counts: Counter[int] = Counter()
        for run in runs:
            counts.update(run.delays if run.way == way else {})
        whole = sum(counts.values())
        if whole:
            steps = range(int(SHOWN_MS / BIN_MS))
            shares = [counts[step] / whole * 100 or float("nan") for step in steps]
            axes.plot([step * BIN_MS for step in steps], shares, drawstyle="steps-post", color=colour, label=way, linewidth=1.2)
    axes.set_yscale("log")
    axes.set_xlim(0, SHOWN_MS)
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")


def main() -> int:
    """Play, print, check; a whole run is written."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.fig6", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--for", dest="span_s", type=int, default=SPAN_S, metavar="S", help="virtual seconds (default: %(default)s)"
    )
    parser.add_argument("--seeds", type=int, default=SEEDS, help="how many (default: %(default)s)")
    parser.add_argument("--record", type=Path, default=RECORD, metavar="FILE", help="read and go on with (default: %(default)s)")
    parser.add_argument("--anew", action="store_true", help="play also what is in the record")
    arguments = parser.parse_args()
    is_whole = (arguments.span_s, arguments.seeds) == (SPAN_S, SEEDS)
    runs = [] if arguments.anew or not is_whole else read(arguments.record)
    for seed in range(1, arguments.seeds + 1):
        for noise_ms in NOISES_MS:
            for way in WAYS:
                if any((run.way, run.noise_ms, run.seed) == (way, noise_ms, seed) for run in runs):
                    continue
                print(f"{way}, {_noise(noise_ms)}, seed {seed} …", file=sys.stderr, flush=True)
                runs.append(play(way, noise_ms, seed, arguments.span_s))
                if is_whole:
                    write(arguments.record, runs)
    print(table(runs))
    print(f"\n{FRAME_SIZE} bytes each {Terms().t_tup_ms} ms, {arguments.span_s} s, {arguments.seeds} seeds, ", end="")
    print(f"in {sum(run.took_s for run in runs):.0f} s of the processor")
    wrong = flaws(runs)
    print("\n".join(wrong) if wrong else "The shape is right.")
    if is_whole:
        try:
            draw(runs, PICTURE)
        except ImportError as error:
            print(f"cannot draw without matplotlib ({error}): pip install -r requirements-dev.txt brings it", file=sys.stderr)
    return 1 if wrong else 0


def read(record: Path) -> list[Run]:
    """The runs of a record; none if there is no record."""
    return msgspec.json.decode(record.read_bytes(), type=list[Run]) if record.exists() else []


def write(record: Path, runs: Sequence[Run]) -> None:
    """One run a line."""
    record.write_text("[\n" + ",\n".join(json.dumps(msgspec.to_builtins(run), sort_keys=True) for run in runs) + "\n]\n")


if __name__ == "__main__":
    sys.exit(main())
