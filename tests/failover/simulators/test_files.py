"""World files: the ones that come with failover, and each mistake in a sentence with file, line and key."""

from __future__ import annotations

from pathlib import Path

import pytest

from failover.errors import FileMistakeError
from failover.simulators.files import SHIPPED, read

LAB = "[labs.a]\nsize = [4, 3]\n"
ROBOT = f'{LAB}[robots.r]\nlab = "a"\nat = [1, 1]\n'

MISTAKES = {
    "labs = 3": "1: labs: Expected",
    LAB: "1: Object missing required field `robots`",
    f"{LAB}[robots]": "3: robots: a world has one at least",
    f"colour = 1\n{ROBOT}": "1: unknown key 'colour'",
    f"{ROBOT}engins = 4": "6: unknown key 'engins'; did you mean 'engines'?",
    f'{ROBOT}kind = "tank"': "6: robots.r.kind: 'tank' is none of omni, differential",
    f"{ROBOT}engines = 2": "3: robots.r: engines is 2: omni robots have 3 or 4",
    f"{ROBOT}us = 17": "3: robots.r: us is 17",
    f"{ROBOT}battery = 1.5": "3: robots.r: battery is 1.5",
    f"{ROBOT}radius = 0": "3: robots.r: radius is 0",
    f"{ROBOT}heading = nan": "3: robots.r: at and heading must be finite",
    f'{ROBOT}names = {{ us = "US" }}': "3: robots.r: names.us is 'US'",
    f'{ROBOT}names = {{ camera = "US/1" }}': "6: robots.r.names: two of its devices have the same name",
    f'{ROBOT}names = {{ camera = "a b" }}': "3: robots.r: 'Simulated/University/a/r/a b'",
    f'{ROBOT}aliases = {{ motor = "Motor" }}': "6: robots.r.aliases: 'Motor' is none of its devices: US/1",
    f'{LAB}[robots.r]\nlab = "b"\nat = [1, 1]': "4: robots.r.lab: there is no [labs.b]; this world has a",
    f'{LAB}[robots.r]\nlab = "a"\nat = [9, 1]': "5: robots.r.at: [9.0, 1.0] is not inside of a, which has 4 by 3 m",
    f'{LAB}[robots."x/y"]\nlab = "a"\nat = [1, 1]': "3: robots.\"x/y\": 'x/y' cannot name a robot",
    f'{LAB}[robots.{"r" * 60}]\nlab = "a"\nat = [1, 1]': "on the board it is called Simulated.rr",
    f'name = "a/../b"\n{ROBOT}': "1: name: FAILOVER_WORLD='Simulated/a/../b' names no world",
    f"seed = -1\n{ROBOT}": "1: seed is -1",
    ROBOT.replace("[4, 3]", "[0, 3]"): "1: labs.a: size is [0.0, 3.0]",
    ROBOT.replace("3]\n", "3]\nwalls = [[1, 1, 1, 1]]\n", 1): "1: labs.a: walls must have a length",
    ROBOT.replace("3]\n", "3]\nobstacles = [[1, 1, 0]]\n", 1): "1: labs.a: obstacles need finite numbers",
}


@pytest.mark.parametrize("text", MISTAKES, ids=lambda text: MISTAKES[text][:50])
def test_a_mistake_is_told_with_file_line_and_key(text: str, tmp_path: Path) -> None:
    file = tmp_path / "world.toml"
    file.write_text(text)
    with pytest.raises(FileMistakeError) as refused:
        read(str(file))
    said = str(refused.value)
    assert said.startswith(f"{file}:") and MISTAKES[text] in said and "\n" not in said


@pytest.mark.parametrize("name", ["nowhere", "nowhere/at/all.toml", "/", "/dev/null"])
def test_a_file_that_is_none_is_told(name: str) -> None:
    with pytest.raises(FileMistakeError, match=name):
        read(name)


@pytest.mark.parametrize("path", sorted(SHIPPED.glob("*.toml")), ids=lambda path: path.stem)
def test_each_world_that_comes_with_failover_is_found_by_its_name(path: Path) -> None:
    assert read(path.stem) == read(str(path))
    assert read(path.stem, 7).seed == 7


def test_a_world_says_how_its_robots_devices_are_called(tmp_path: Path) -> None:
    file = tmp_path / "world.toml"
    file.write_text(f'name = "North"\npath = ""\n{ROBOT}us = 1\nengines = 3\nbattery = false\ncamera = false\n')
    (robot,) = (world := read(str(file))).robots
    assert world.place_of(robot) == "Simulated/North/a/r"
    assert [name for _, name, _ in robot.devices()] == ["US/1", "Engines/1/PWM", "Engines/2/PWM", "Engines/3/PWM"]
