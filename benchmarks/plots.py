"""Pictures of the written record: what the tables of RESULTS.md say, as SVG.

python -m benchmarks.plots               draws benchmarks/results.json into docs/plots
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

from benchmarks import increments, soak
from benchmarks.figures import OURS, Figure, percentile

if TYPE_CHECKING:
    from matplotlib.axes import Axes

HERE: Final = Path(__file__).parent
PLACE: Final = HERE.parent / "docs" / "plots"
SIZE_IN: Final = (7.0, 4.0)
"""Of a picture, inches."""
COLOURS: Final = {
    OURS: "#1b6ca8",
    "CRIU": "#c8553d",
    "gcore": "#8d8d8d",
    f"{OURS}, first base": "#7fb2d6",
    "full copy": "#8d8d8d",
    "nobody": "#bdbdbd",
    "unprotected": "#bdbdbd",
}
"""Makers that have a colour of their own everywhere."""


def figures_of(record: Path) -> list[Figure]:
    """Every figure of a record.

    Raises:
        OSError, ValueError: there is none, or it is not one of ours.
    """
    try:
        findings = json.loads(record.read_text())["findings"]
        return [Figure(**{**one, "values": tuple(one["values"])}) for found in findings for one in found["figures"]]
    except (KeyError, TypeError) as error:
        raise ValueError(f"{record} is not a record of python -m benchmarks: {error!r}") from error


def draw(figures: Sequence[Figure], place: Path) -> list[Path]:
    """Draw what there are figures of; the files, each named after what it shows.

    Raises:
        ImportError: matplotlib is missing.
    """
    from matplotlib import figure as pictures
    from matplotlib import rc_context

    place.mkdir(parents=True, exist_ok=True)
    drawn = []
    for name, (title, paint) in PICTURES.items():
        picture = pictures.Figure(figsize=SIZE_IN, layout="constrained")
        axes = picture.add_subplot()
        if not paint(axes, figures):
            continue
        picture.suptitle(title, fontsize="medium", x=0.01, ha="left")
        axes.spines[["top", "right"]].set_visible(False)
        path = place / f"{name}.svg"
        with rc_context({"svg.hashsalt": name, "svg.fonttype": "none"}):  # equal figures are equal files
            picture.savefig(path, metadata={"Date": None})
        drawn.append(path)
    return drawn


# --- The pictures: each says whether there was something to draw -----------------------------------------------------------


def _over_size(axes: Axes, figures: Sequence[Figure], benchmarks: dict[str, str]) -> bool:
    """Medians with a whisker up to the longest, over resident memory; ``benchmarks`` are legends' beginnings by name."""
    lines: dict[str, list[Figure]] = {}
    for figure in figures:
        if figure.benchmark in benchmarks:
            lines.setdefault(_legend(benchmarks[figure.benchmark], figure.who), []).append(figure)
    for legend, line in lines.items():
        line.sort(key=_megabytes)
        medians = [one.median for one in line]
        whiskers = [[0.0] * len(line), [max(one.values) - one.median for one in line]]
        axes.errorbar(
            [_megabytes(one) for one in line],
            medians,
            whiskers,
            marker="o",
            capsize=3,
            label=legend,
            color=COLOURS.get(legend),
            linestyle="--" if "," in legend else "-",
        )
    if lines:
        _both_logarithmic(axes)
        axes.set_xticks(sorted({_megabytes(one) for line in lines.values() for one in line}))
        axes.minorticks_off()
        axes.set_xlabel("resident memory, MB")
        axes.set_ylabel("ms: median, and the longest")
        axes.legend(frameon=False)
    return bool(lines)


def _legend(beginning: str, who: str) -> str:
    return who if not beginning else f"{who}, {beginning}"


def _megabytes(figure: Figure) -> float:
    return float(figure.case.split()[0].replace(",", ""))


def _both_logarithmic(axes: Axes) -> None:
    for scale, axis in ((axes.set_xscale, axes.xaxis), (axes.set_yscale, axes.yaxis)):
        scale("log")
        axis.set_major_formatter(lambda value, _: f"{value:g}")


def _stands_still(axes: Axes, figures: Sequence[Figure]) -> bool:
    return _over_size(axes, figures, {"the program stands still (its own clock)": ""})


def _increments(axes: Axes, figures: Sequence[Figure]) -> bool:
    return _over_size(axes, figures, {increments.STILL: ""})


def _sent(axes: Axes, figures: Sequence[Figure]) -> bool:
    """The bytes that a snapshot sends by the bytes written, beside a full copy of as much memory."""
    found = sorted((figure for figure in figures if figure.benchmark == increments.SENT_OF_ONE), key=_megabytes)
    if found:
        ours = [figure for figure in found if figure.who == OURS]
        axes.plot([_megabytes(one) for one in ours], [one.median for one in ours], marker="o", label=OURS, color=COLOURS[OURS])
        for figure in found:
            if figure.who != OURS:
                axes.axhline(figure.median, linestyle="--", label=figure.who, color=COLOURS.get(figure.who))
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
        axes.set_xlabel("written since the last snapshot, MB")
        axes.set_ylabel("sent, KB: median")
        axes.legend(frameon=False)
    return bool(found)


def _resumes(axes: Axes, figures: Sequence[Figure]) -> bool:
    return _over_size(axes, figures, {"restore": "", "takeover from a ready copy": "from a ready copy"})


def _freezes(axes: Axes, figures: Sequence[Figure]) -> bool:
    """The share of deltas that took no longer, by case."""
    found = [figure for figure in figures if figure.benchmark == "freeze of a delta"]
    for figure in found:
        ordered = sorted(figure.values)
        axes.step(ordered, [(place + 1) / len(ordered) * 100 for place in range(len(ordered))], label=figure.case, where="post")
    if found:
        axes.set_xscale("log")
        axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
        axes.xaxis.set_minor_formatter(lambda value, _: f"{value:g}")
        axes.set_xlabel("freeze, ms")
        axes.set_ylabel("% of the snapshots took no longer")
        axes.legend(frameon=False, fontsize="x-small")
    return bool(found)


def _outages(axes: Axes, figures: Sequence[Figure]) -> bool:
    """Each cut a dot, the median a stroke."""
    found = [figure for figure in figures if figure.benchmark == "power cut to next output"]
    for row, figure in enumerate(reversed(found)):
        colour = COLOURS.get(figure.who, "#444444")
        axes.plot(figure.values, [row] * len(figure.values), "o", color=colour, alpha=0.5, markersize=4)
        axes.plot([figure.median] * 2, [row - 0.3, row + 0.3], color=colour)
    if found:
        names = [figure.case if figure.who == OURS else f"{figure.who}: {figure.case}" for figure in reversed(found)]
        axes.set_yticks(range(len(found)), names, fontsize="small")
        axes.set_xlim(left=0)
        axes.set_xlabel("ms from the power cut to the next output")
    return bool(found)


def _per_thing(axes: Axes, figures: Sequence[Figure]) -> bool:
    """Microseconds of freeze for one more of each kind, of the most that were measured."""
    found = {figure.benchmark: figure for figure in figures if figure.benchmark.startswith("one more ")}
    for row, figure in enumerate(reversed(found.values())):
        late = percentile(figure.values, 0.95) - figure.median
        axes.barh(row, figure.median, color=COLOURS[OURS], xerr=[[0.0], [max(late, 0.0)]], capsize=2)
    if found:
        names = [f"{figure.benchmark.removeprefix('one more ')} {figure.case}" for figure in reversed(found.values())]
        axes.set_yticks(range(len(found)), names, fontsize="small")
        axes.set_xlabel("µs longer for each: median, and the 95th percentile")
    return bool(found)


def _soaked(axes: Axes, figures: Sequence[Figure], measured: str) -> bool:
    """The figure of each process, over the time."""
    found = [figure for figure in figures if figure.benchmark == measured]
    when = next((figure.values for figure in figures if figure.benchmark == soak.WHEN), ())
    for figure in found:
        is_first = figure.case.startswith("robot1")
        axes.plot(when[-len(figure.values) :], figure.values, linewidth=1, linestyle="-" if is_first else "--", label=figure.case)
    if found:
        axes.set_ylim(bottom=0)
        axes.set_xlabel(soak.WHEN)
        axes.set_ylabel(found[0].unit or measured)
        axes.legend(frameon=False, fontsize="xx-small", loc="upper left", bbox_to_anchor=(1, 1))
    return bool(found)


def _soaked_memory(axes: Axes, figures: Sequence[Figure]) -> bool:
    return _soaked(axes, figures, soak.MEMORY)


def _soaked_descriptors(axes: Axes, figures: Sequence[Figure]) -> bool:
    return _soaked(axes, figures, soak.DESCRIPTORS)


def _work(axes: Axes, figures: Sequence[Figure]) -> bool:
    """The share of the program's work that is left, by snapshots a second."""
    work = {(figure.case, figure.who): figure for figure in figures if figure.benchmark == "work done a second"}
    cases = [case for case, who in work if who == OURS and (case, "unprotected") in work]
    shares = [work[case, OURS].median / work[case, "unprotected"].median * 100 for case in cases]
    axes.barh(range(len(cases)), shares[::-1], color=COLOURS[OURS])
    axes.axvline(100, color=COLOURS["unprotected"])
    axes.set_yticks(range(len(cases)), cases[::-1], fontsize="small")
    axes.set_xlabel("% of the work that it does unprotected (medians)")
    return bool(cases)


PICTURES: Final[dict[str, tuple[str, Callable[[Axes, Sequence[Figure]], bool]]]] = {
    "stands-still": ("How long one more snapshot stops a program", _stands_still),
    "increments": ("How long one more snapshot stops a program, beside a full copy", _increments),
    "sent": ("What one more snapshot sends, of 100 MB", _sent),
    "freezes": ("Freezes of the deltas, all of them", _freezes),
    "per-thing": ("What one more thread, descriptor or carried name adds to the freeze", _per_thing),
    "resumes": ("From the snapshot to the running program", _resumes),
    "outages": ("A robot loses its power: until the program's next output elsewhere", _outages),
    "soak-memory": ("Memory of our processes over the time", _soaked_memory),
    "soak-descriptors": ("Descriptors of our processes over the time", _soaked_descriptors),
    "work": ("What protection leaves of a program's work", _work),
}


def main() -> int:
    """Draw the record."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.plots", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--record", type=Path, default=HERE / "results.json", help="default: %(default)s")
    parser.add_argument("--output", type=Path, default=PLACE, metavar="DIR", help="default: %(default)s")
    arguments = parser.parse_args()
    try:
        for path in draw(figures_of(arguments.record), arguments.output):
            print(path)
    except (OSError, ValueError) as error:
        print(f"cannot draw {arguments.record}: {error}", file=sys.stderr)
        return 1
    except ImportError as error:
        print(f"cannot draw without matplotlib ({error}): pip install -r requirements-dev.txt brings it", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
