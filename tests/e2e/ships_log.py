"""Log of a voyage (`tests.e2e.voyage`), and the check whether the state from which it resumed is the one it was promised."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from tests.e2e import voyage

WORDS: Final = {"r": 7, "b": 4, "c": 4, "a": 4}
"""Of each kind of line, without the full stop at its end."""


@dataclass(frozen=True, slots=True)
class Resumption:
    """A process of the program that has come so far as to have its state.

    Attributes:
        epoch: under which it runs; 0 where it began.
    """

    life: str
    number: int
    seal: int
    epoch: int
    why: str
    portrait: str


class ShipsLog:
    """The log so far. `read` goes on where it stopped."""

    def __init__(self, path: Path) -> None:
        path.touch(0o666)
        path.chmod(0o666)
        self.path = path
        self._offset = 0
        self._before = {0: 0}
        """Of every step that was begun, by its seal: the seal of the one before."""
        self._numbers = {0: 0}
        self._last_of: dict[str, int] = {}
        """Of every life: the seal of its last step."""
        self.resumptions: list[Resumption] = []
        self.safe = 0
        """Seal of the last step that was said to be safe."""
        self.acknowledged: dict[str, int] = {}
        """How often something was said to be safe, by life."""
        self.last_kind: dict[str, str] = {}
        """Of every life: what it said of its last step, "b" where it was killed before `commit` returned."""

    def read(self) -> None:
        """What is new. A line that was torn by a kill is passed over."""
        with self.path.open("rb") as file:
            file.seek(self._offset)
            content = file.read()
        whole = content[: content.rfind(b"\n") + 1]
        self._offset += len(whole)
        for line in whole.decode().splitlines():
            words = line.split()
            if words and words[-1] == "." and len(words) == WORDS.get(words[0], 0) + 1:
                self._take(words[0], words[1], int(words[2]), int(words[3]), words[4:-1])

    def _take(self, kind: str, life: str, number: int, seal: int, rest: list[str]) -> None:
        if kind == "r":
            resumption = Resumption(life, number, seal, int(rest[0]), rest[1], rest[2])
            self.check(resumption)
            self.resumptions.append(resumption)
            self._last_of[life] = seal
        elif kind == "b":
            self._before[seal], self._numbers[seal] = self._last_of[life], number
            self._last_of[life] = seal
        elif kind == "a":
            self.acknowledged[life] = self.acknowledged.get(life, 0) + 1
            if self.resumptions[-1].life == life and self._numbers[seal] >= self._numbers[self.safe]:
                self.safe = seal
        if kind in "bc":
            self.last_kind[life] = kind

    def check(self, resumption: Resumption) -> None:
        """It stands exactly where one commit stood, which the last one that was said to be safe led to, or is."""
        assert resumption.portrait != "torn", f"{resumption} is no state of any commit"
        assert resumption.seal in self._before, f"{resumption} is of a step that was never begun"
        seals = self.seals(resumption.seal)
        assert len(seals) == resumption.number + 1, f"{resumption}: step {len(seals) - 1} is of another number"
        assert resumption.portrait == voyage.expected(seals), f"{resumption}: its arrays are of other steps"
        number = self._numbers[self.safe]
        assert number <= resumption.number, f"{resumption} has lost step {number}, which was said to be safe"
        assert seals[number] == self.safe, f"{resumption} is of a voyage on which the safe step {number} was another one"

    def seals(self, seal: int) -> list[int]:
        """The seals of all steps that led to this one, by number."""
        found = []
        while seal:
            found.append(seal)
            seal = self._before[seal]
        return [0, *reversed(found)]

    def check_output(self, output: bytes) -> int:
        """It has every step that led to the newest one once, in order; how many there are."""
        lines = output[: output.rfind(b"\n") + 1].split(b"\n")[:-1]
        self.read()
        seals = self.seals(self._last_of[self.resumptions[-1].life])
        wanted = [b"%d %d" % (number, seal) for number, seal in enumerate(seals)][1:]
        ahead = lines[len(wanted) :]  # printed, and not told to the log yet when it was read
        assert len(ahead) <= 1, f"{len(ahead)} lines of steps that nobody began: {ahead[:3]}"
        for number, (line, want) in enumerate(zip(lines, wanted, strict=False), start=1):
            assert line == want, f"line {number} is {line!r} and not {want!r}"
        return len(lines)

    def newest(self) -> int:
        """Number of the last step that the newest life has begun."""
        return self._numbers[self._last_of[self.resumptions[-1].life]]
