"""The operators' page in a real browser, beside real robots: two users, a takeover, the keyboard alone, nothing from elsewhere.

FAILOVER_PICTURES=docs/page: the pictures of docs/page.md are taken.
"""

from __future__ import annotations

import os
import random
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from failover.boards.board import Board
from failover.cli.demo.robots import Pace
from failover.config.page import hashed
from tests.e2e import bridged, pages, robots
from tests.e2e import test_board as boards
from tests.e2e.pages import COUNT, Served, mistakes, served
from tests.e2e.robots import RobotMachine, until
from tests.e2e.test_board import two_with_boards

if TYPE_CHECKING:
    from playwright.sync_api import Browser, BrowserContext, Page

WHY_NOT = pages.why_not() or (
    "" if pages.browser() else "needs a browser (apt-get install chromium) and requirements-browser.txt"
)
pytestmark = [pytest.mark.skipif(bool(WHY_NOT), reason=WHY_NOT or "-"), pytest.mark.slow, pytest.mark.timeout(900)]

PICTURES = os.environ.get("FAILOVER_PICTURES", "")
COLOURS = 64
TEAM = "lab" if PICTURES else boards.TEAM
NAME = f"/{TEAM}/robot1/count"
LEDGER = "Lab/robot1/Ledger"
ORDERS = 200
T_TUP_MS = 50

DRIVER = f"""
import sys
import failover

@failover.driver("{LEDGER}", alias="ledger")
class Ledger:
    @failover.command
    def note(self, who: str, number: int) -> None:
        with open(sys.argv[1], "a") as book:
            print(who, number, file=book)

failover.run(Ledger)
"""

Pair = tuple[RobotMachine, RobotMachine]


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """One for all tests: on a busy machine it takes half a minute to start."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=pages.browser(), args=["--no-sandbox"], timeout=0)
        yield started
        started.close()


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Pair]:
    with pytest.MonkeyPatch.context() as patched, two_with_boards(tmp_path_factory.mktemp("pair"), patched, name=TEAM) as both:
        patched.undo()  # other teams have no such board
        robots.run(both[0], "count", "/usr/bin/env", "python3", "-c", COUNT)
        robots.until_protected(both[0])
        yield both


@pytest.fixture(scope="module")
def ledger(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """What a driver has noted; the driver's directory is beside it."""
    place = tmp_path_factory.mktemp("ledger")
    (place / "drivers").mkdir(mode=0o700)
    environment = {**os.environ, "FAILOVER_DRIVERS": str(place / "drivers"), "FAILOVER_ROBOT": "robot1"}
    process = subprocess.Popen([sys.executable, "-c", DRIVER, str(place / "book")], env=environment)
    yield place / "book"
    process.terminate()
    process.wait(pages.PATIENCE_S)


@pytest.fixture(scope="module")
def page_of_two(pair: Pair, ledger: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """The page of robot1, where anna and ben log in."""
    config = "".join(f'[users.{name}]\npassword = "{hashed(name)}"\n' for name in ("anna", "ben"))
    environment = {"FAILOVER_DRIVERS": str(ledger.parent / "drivers"), "FAILOVER_ROBOT": "robot1"}
    with served(pair[0], tmp_path_factory.mktemp("page"), config, **environment) as found:
        yield found


def context_of(browser: Browser, **options: Any) -> BrowserContext:
    found = browser.new_context(viewport={"width": 1180, "height": 760}, reduced_motion="reduce", **options)
    found.set_default_timeout(pages.PATIENCE_S * 1000)
    return found


def logged_in(context: BrowserContext, page: Served, name: str) -> Page:
    """A window in which that user has logged in, as a person does."""
    window = context.new_page()
    window.goto(page.url)
    log_in(window, name)
    return window


def log_in(window: Page, name: str) -> None:
    window.get_by_label("Name").fill(name)
    window.get_by_label("Password").fill(name)
    window.keyboard.press("Enter")
    item(window, r"count, protected").wait_for()


def item(window: Page, told: str) -> Any:
    """A row of the tree, by what a screen reader says of it."""
    return window.get_by_role("treeitem", name=re.compile(told.replace("/", r"\/")))


def picture(window: Page, name: str) -> None:
    """Take it, in few colours: a document's picture is small."""
    if PICTURES:
        from PIL import Image

        path = Path(PICTURES) / f"{name}.png"
        window.screenshot(path=path)
        with Image.open(path) as taken:
            taken.convert("RGB").quantize(COLOURS).save(path, optimize=True)


# --- Two users -----------------------------------------------------------------------------------------------------------


def test_orders_of_two_users_are_carried_out_once_each_and_in_the_order_of_their_user(
    browser: Browser, page_of_two: Served, ledger: Path
) -> None:
    """Each types into the form of a driver's verb; the driver writes down what it has carried out."""
    names = ("anna", "ben")
    with context_of(browser) as first, context_of(browser) as second:
        windows = dict(
            zip(
                names,
                (logged_in(context, page_of_two, name) for context, name in zip((first, second), names, strict=True)),
                strict=True,
            )
        )
        for name, window in windows.items():
            item(window, f"^{LEDGER}, driver").click()
            window.get_by_label("who").fill(name)
        dice, left = random.Random(32), {name: iter(range(ORDERS // 2)) for name in names}
        waiting = list(names)
        while waiting:
            name = dice.choice(waiting)
            number = next(left[name], None)
            if number is None:
                waiting.remove(name)
                continue
            windows[name].get_by_label("number").fill(str(number))
            windows[name].keyboard.press("Enter")
        until(lambda: len(lines(ledger)) >= ORDERS, "the driver to carry all orders out")
        noted = lines(ledger)
        assert len(noted) == ORDERS, "none twice"
        for name in names:
            assert [int(number) for who, number in noted if who == name] == list(range(ORDERS // 2)), f"all of {name}, in order"
        assert noted != sorted(noted), "they were interleaved"
        windows["anna"].get_by_role("link", name="Orders").click()
        log = windows["anna"].get_by_role("row")
        log.nth(ORDERS).wait_for()
        told = windows["anna"].locator("main").inner_text()
        assert told.count("anna") >= ORDERS // 2 and told.count("ben") >= ORDERS // 2 and "refused" not in told
        item(windows["ben"], r"^count, protected").click()
        windows["anna"].get_by_text("ben looks at count").wait_for()


def lines(book: Path) -> list[tuple[str, ...]]:
    return [tuple(line.split()) for line in book.read_text().splitlines()] if book.exists() else []


def test_an_order_on_what_another_user_has_moved_meanwhile_is_refused_with_what_changed(
    browser: Browser, page_of_two: Served, pair: Pair
) -> None:
    with context_of(browser) as first, context_of(browser) as second:
        anna, ben = logged_in(first, page_of_two, "anna"), logged_in(second, page_of_two, "ben")
        for window in (anna, ben):
            item(window, r"^count, protected").click()
            window.get_by_role("button", name="Hand over…").click()
            window.get_by_role("dialog").get_by_text("no work is lost").wait_for()
        picture(anna, "order")
        anna.get_by_role("dialog").get_by_role("button", name="Hand over").click()
        anna.get_by_role("log").get_by_text("handover count:").wait_for()
        ben.get_by_role("dialog").get_by_text("It has changed meanwhile").wait_for()
        ben.get_by_role("dialog").get_by_role("button", name="Hand over").click()
        ben.get_by_role("log").get_by_text("has changed since this order was decided").wait_for()
        assert robots.component(pair[1], "count")["role"] == "primary"
        anna.get_by_role("definition").filter(has_text=re.compile("^robot2$")).first.wait_for()


def test_a_user_reserves_a_component_and_ends_that(browser: Browser, page_of_two: Served) -> None:
    """What it refuses to others is for `test_reservations`: here both users are one for the agent."""
    with context_of(browser) as context:
        window = logged_in(context, page_of_two, "anna")
        item(window, r"^count, protected").click()
        window.get_by_role("button", name="Reserve…").click()
        window.get_by_label("Minutes").fill("20")
        window.get_by_label("Why").fill("new wheels")
        assert mistakes(window) == []
        window.keyboard.press("Enter")
        window.get_by_role("log").get_by_text("is reserved by").wait_for()
        window.get_by_role("definition").filter(has_text=re.compile("^by .* until .*: new wheels$")).wait_for()
        window.get_by_role("button", name="End reservation…").click()
        window.get_by_role("dialog").get_by_role("button", name="End reservation").click()
        window.get_by_role("log").get_by_text("is free again").wait_for()


# --- One user, by the keyboard, with nothing from elsewhere ------------------------------------------------------------------


def test_the_keyboard_alone_moves_a_component_and_nothing_is_asked_of_another_host(
    browser: Browser, pair: Pair, tmp_path: Path
) -> None:
    """The kernel tells who connects here, so there is nothing to log in."""
    robots.until_protected(pair[1])
    with served(pair[0], tmp_path / "page") as page, context_of(browser) as context:
        asked: list[str] = []
        context.on("request", lambda request: asked.append(request.url))
        window = context.new_page()
        window.on("websocket", lambda link: asked.append(link.url))
        said: list[str] = []
        window.on("console", lambda message: said.append(message.text))
        window.goto(page.url)
        item(window, r"count, protected").wait_for()
        window.evaluate("document.activeElement.blur()")
        stops = []
        for _ in range(30):
            window.keyboard.press("Tab")
            if focused(window, "role") == "treeitem":
                break
            stops.append(window.evaluate("document.activeElement.textContent"))
        assert stops == ["Skip to the content", "Team", "Board", "Radio", "Orders"]
        assert window.locator("[role=tree] [tabindex='0']").count() == 1, "the tree is one stop of the tab key"
        window.keyboard.press("End")
        window.keyboard.press("Home")
        for _ in range(30):
            window.keyboard.press("ArrowDown")
            if (focused(window, "aria-label") or "").startswith("count"):
                break
        window.keyboard.press("ArrowLeft")
        assert (focused(window, "aria-label") or "").startswith("robot2")
        window.keyboard.press("ArrowLeft")
        assert focused(window, "aria-expanded") == "false"
        window.keyboard.press("ArrowRight")
        window.keyboard.press("ArrowRight")
        assert (focused(window, "aria-label") or "").startswith("count")
        window.keyboard.press("Enter")
        window.get_by_role("heading", name=NAME).wait_for()
        for _ in range(60):
            window.keyboard.press("Tab")
            if window.evaluate("document.activeElement.textContent") == "Hand over…":
                break
        window.keyboard.press("Enter")
        window.get_by_role("dialog").wait_for()
        window.keyboard.press("Escape")
        assert window.evaluate("document.activeElement.textContent") == "Hand over…", "the focus is back where it was"
        window.keyboard.press("Enter")
        window.keyboard.press("Tab")
        window.keyboard.press("Enter")
        window.get_by_role("log").get_by_text("handover count:").wait_for()
        until(lambda: robots.component(pair[0], "count")["role"] == "primary", "it to move to robot1")
        assert asked and all(url.startswith((page.url, page.url.replace("http", "ws"))) for url in asked), asked
        assert said == [], "no error, and nothing that the policy has refused"


def focused(window: Page, name: str) -> str | None:
    found: str | None = window.evaluate(f"document.activeElement.getAttribute('{name}')")
    return found


# --- For everybody's eyes and ears ---------------------------------------------------------------------------------------------

VIEWS = {
    "#/": "The team",
    f"#/component/{NAME.replace('/', '%2F')}": NAME,
    "#/robot/robot2": "robot2",
    "#/board": "The board",
    "#/item/robot1%2Falarm": "robot1/alarm",
    "#/radio": "Links and radio",
    "#/orders": "Orders on this page",
    f"#/driver/{LEDGER.replace('/', '%2F')}": LEDGER,
}
"""Address → heading."""


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_axe_finds_nothing_wrong_with_any_view(browser: Browser, page_of_two: Served, pair: Pair, scheme: Any) -> None:
    """The schemes differ in colours only."""
    rules = () if scheme == "light" else ("color-contrast",)
    robots.until_protected(pair[0])
    boards_of = [Board(robot.socket.parent / "board", "test") for robot in pair]
    with boards_of[0], boards_of[1], context_of(browser, color_scheme=scheme) as context:
        for number, board in enumerate(boards_of):
            board.item("alarm").put(3 + number)
            board.item("ball").put({"x": 1.5, "y": -0.25 * number})
        window = context.new_page()
        window.goto(page_of_two.url)
        window.get_by_label("Password").wait_for()
        assert mistakes(window, *rules) == [], "the login"
        log_in(window, "anna")
        for number, (view, heading) in enumerate(VIEWS.items()):
            window.evaluate("(view) => { location.hash = view; }", view)
            window.get_by_role("heading", name=heading, exact=True, level=2).wait_for()
            if view == "#/board":
                window.get_by_role("row", name=re.compile("alarm")).wait_for()
            if "component" in view:
                window.get_by_role("button", name="Start…").press("Enter")
                window.get_by_role("log").get_by_text("it has not ended").wait_for()
                window.get_by_role("button", name="Hand over…").click()
                window.get_by_role("dialog").wait_for()
                assert mistakes(window, *rules) == [], f"{view}, with the dialog"
                window.keyboard.press("Escape")
                window.get_by_label("Standard output").wait_for()
            assert mistakes(window, *rules) == [], view
            if scheme == "light" and number in (0, 1, 3):
                picture(window, {0: "team", 1: "component", 3: "board"}[number])


def test_axe_sees_a_text_of_too_little_contrast_and_a_button_without_a_name(browser: Browser, page_of_two: Served) -> None:
    with context_of(browser) as context:
        window = logged_in(context, page_of_two, "anna")
        window.evaluate(
            """() => {
                const told = document.createElement("p");
                told.textContent = "pale";
                told.style.color = "#aaa";
                document.querySelector("main").append(told);
                document.querySelector("header").append(document.createElement("button"));
            }"""
        )
        found = mistakes(window)
        assert [one.partition(":")[0] for one in found] == ["button-name", "color-contrast"] and "pale" in found[1]


# --- Simulated robots ------------------------------------------------------------------------------------------------------


def test_simulated_robots_stand_in_a_branch_of_their_own_which_a_person_opens(
    browser: Browser, page_of_two: Served, ledger: Path, tmp_path: Path
) -> None:
    environment = {**os.environ, "FAILOVER_DRIVERS": str(ledger.parent / "drivers"), "FAILOVER_ROBOT": "robot1"}
    words = [sys.executable, "-m", "failover", "simulate", "--world", "amur-7", "--board", str(tmp_path / "board")]
    with subprocess.Popen(words, env=environment, stdout=subprocess.DEVNULL) as simulation, context_of(browser) as context:
        try:
            window = logged_in(context, page_of_two, "anna")
            for step in ("Simulated", "RSUH", "lab1", "AMUR-7", "Engine", "US"):
                row = item(window, f"^{step}(,|$)").last
                row.wait_for(timeout=pages.PATIENCE_S * 1000)
                assert row.get_attribute("aria-expanded") == "false"
                row.locator(".name").first.click()
            item(window, "^8, simulated, live").wait_for()
            item(window, "^Camera, simulated, live").wait_for()
            item(window, "^Battery, simulated, live").click()
            window.get_by_role("button", name="read").click()
            window.get_by_text(re.compile('"?volts"?')).first.wait_for()
            item(window, "^8, simulated").scroll_into_view_if_needed()
            picture(window, "simulated")
        finally:
            simulation.terminate()
            simulation.wait(pages.PATIENCE_S)


# --- A radio ------------------------------------------------------------------------------------------------------------------


@pytest.mark.skipif(not robots.has_cable(), reason="needs network namespaces: run as root")
def test_the_ring_of_slots_shows_who_speaks_when_and_closes_over_a_robot_that_is_gone(browser: Browser, tmp_path: Path) -> None:
    count = 4 if PICTURES else 3
    settings = f"[media.{bridged.CABLE}]\nslots = true\n"
    with (
        bridged.on_one_switch(tmp_path, count, settings, pace=Pace(20, 400)) as stage,
        served(stage.robots[1], tmp_path / "page") as page,
        context_of(browser) as context,
    ):
        window = context.new_page()
        window.goto(f"{page.url}#/radio")
        names = [robot.name for robot in stage.robots]
        ring(window, names).wait_for()
        row(window, "robot1", "reference").wait_for()
        row(window, "robot2", "this robot").wait_for()
        row(window, "robot3", "in its slot", "all", r"\d+ %").wait_for()
        window.get_by_role("img", name=re.compile(f"^Robots in the round: now {count}")).wait_for()
        assert mistakes(window) == []
        window.set_viewport_size({"width": 1180, "height": 960})
        picture(window, "radio")
        stage.robots[-1].cut_power()
        ring(window, names[:-1]).wait_for()
        window.get_by_role("img", name=re.compile(f"^Robots in the round: now {count - 1}, at most {count}")).wait_for()
        assert not row(window, names[-1], "in its slot").count()


def ring(window: Page, names: list[str]) -> Any:
    """The drawing of a round that just these share, each with its instant, as a screen reader tells it."""
    begins = [f"{name} at {place * T_TUP_MS / len(names):.1f} ms" for place, name in enumerate(names)]
    told = "; ".join(f"{re.escape(one)}, (missed|came [^;]*)" for one in begins)
    return window.get_by_role("img", name=re.compile(f"^The round of {bridged.CABLE}, .* begins at robot1: {told}$"))


def row(window: Page, *told: str) -> Any:
    """A row of a table that says all this, in this order."""
    return window.get_by_role("row", name=re.compile(".*".join(told)))


# --- A takeover ---------------------------------------------------------------------------------------------------------------


def test_a_takeover_is_seen_in_the_tree_and_told_in_the_timeline(browser: Browser, pair: Pair, tmp_path: Path) -> None:
    """The last test: robot1 is gone after it."""
    robots.until_protected(pair[0])
    with served(pair[1], tmp_path / "page") as page, context_of(browser) as context:
        window = context.new_page()
        window.goto(page.url)
        item(window, r"^count, protected").click()
        below = lambda robot: item(window, f"^{robot},").get_by_role("treeitem", name=re.compile("^count"))  # noqa: E731
        below("robot1").wait_for()
        window.get_by_label("Standard output").get_by_text(re.compile(r"\d+")).wait_for()
        pair[0].cut_power()
        below("robot2").wait_for()
        item(window, r"^robot1, dead").wait_for()
        item(window, r"^count, alone").wait_for()
        story = window.locator("ol.story")
        story.get_by_text(re.compile("resumes from checkpoint|took it over|takes it over")).first.wait_for()
        before = len(window.get_by_label("Standard output").inner_text())
        until(lambda: len(window.get_by_label("Standard output").inner_text()) > before, "the program to go on")
        window.get_by_role("heading", name="What was decided").scroll_into_view_if_needed()
        story.evaluate("(node) => node.parentElement.scrollIntoView()")
        picture(window, "story")
