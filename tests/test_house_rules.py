"""Rules of this repository: direction of imports, pure modules, one file per dependency, the names that are not used."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterable
from pathlib import Path

import pytest

from tests.imports import Graph, called, circles, folders, graph, imported, imports, imports_of

ROOT = Path(__file__).parent.parent
FLOORS = ("checkpoint", "failover", "agent", "page")

PURE_CHECKPOINT = (
    *(
        "errors",
        "model",
        "sentences",
        "pages/page_set",
        "pages/merge",
        "pages/xor_delta",
        "runtime/lazy_numpy",
        "segment/task_messages",
    ),
    *("snapshot/layout", "snapshot/canonical_state", "snapshot/validity", "snapshot/process_tree"),
    *("store/chain", "store/page_origins", "store/xor_cache"),
)

PURE_FILES = (
    *(f"checkpoint/{name}.py" for name in PURE_CHECKPOINT),
    "failover/core/",
    "failover/state/",
    "failover/simulators/world/",
)
"""Here nothing opens, asks the time, rolls dice or waits: values in, values out."""

PURE_IMPORTS = frozenset(
    """
    __future__ abc bisect binascii blake3 collections contextlib dataclasses difflib enum fastavro fractions functools hashlib
    heapq hmac ipaddress itertools json math msgspec numpy operator re string struct types typing unicodedata xml xxhash zlib
    """.split()  # noqa: SIM905
)

VALUE_IMPORTS = frozenset(
    "array copy datetime decimal fractions ipaddress pathlib pickle random sys uuid zoneinfo".split()  # noqa: SIM905
)
"""Where a program's values are stored, also the modules whose values are kept; pickle has a door of its own."""

IMPURE_CALLS = frozenset({"open", "print", "input", "exec", "eval"})

DOORS = {
    "ptrace": ("checkpoint/linux/trace/tracee.py",),
    "zstandard": ("checkpoint/snapshot/compression.py", "failover/recording/mcap_file.py"),
    "zmq": ("agent/worker/network/replication_link.py", "failover/drivers/sockets.py"),
    "obstore": ("failover/archive/s3.py",),
    "cryptography": (
        "failover/programs/keys.py",
        "failover/archive/keys.py",
        "failover/archive/sealed.py",
        "failover/archive/signature.py",
    ),
    "mcap": ("failover/recording/mcap_file.py",),
    "fastavro": ("failover/core/messaging/avro.py",),
    "foxglove": ("failover/recording/foxglove_server.py",),
    "ldap": ("agent/directory/server.py",),
    "pickle": ("failover/state/pickled.py",),
    "starlette": ("page/app.py",),
    "uvicorn": ("page/serve.py",),
    "psutil": ("failover/client/process_use.py",),
    "rich": ("failover/cli/output/render.py", "failover/cli/output/top_screen.py"),
    "textual": ("failover/cli/output/top_screen.py",),
    "shtab": ("failover/cli/completion.py",),
    "zenoh": ("failover/bridges/zenoh_bridge.py",),
}
"""Each outside dependency that is not plain arithmetic enters through one file."""

FORBIDDEN_WORDS = frozenset({"manager", "helper", "helpers", "util", "utils", "handler", "data", "info", "misc", "common"})

REGISTRY_HOSTS = tuple(
    f"{name}.{top}" for name, top in (("pypi", "org"), ("pythonhosted", "org"), ("deb", "debian"), ("npmjs", "org"))
)


def tracked_files() -> list[Path]:
    """Every file of the project: what git tracks, or, outside a clone, what lies there."""
    listed = subprocess.run(["git", "-C", ROOT, "ls-files", "-z"], capture_output=True, check=False)
    if listed.returncode == 0:
        return [ROOT / name for name in listed.stdout.decode().split("\0") if name and (ROOT / name).is_file()]
    return [path for path in ROOT.rglob("*") if path.is_file() and ".venv" not in path.parts]


def sources(*floors: str) -> list[Path]:
    """The Python files of the given floors, whether tracked yet or not."""
    return sorted(path for floor in floors for path in (ROOT / floor).rglob("*.py"))


def name_of(path: Path) -> str:
    """A file's path inside the project, as the rules name it."""
    return path.relative_to(ROOT).as_posix()


def package_of(path: Path) -> tuple[str, ...]:
    """The package that a relative import in this file starts from."""
    return path.relative_to(ROOT).parent.parts


def parsed(path: Path) -> ast.Module:
    """A source file as a tree."""
    return ast.parse(path.read_text(), str(path))


# --- Arrows ----------------------------------------------------------------------------------------------------------


def levels() -> dict[str, int]:
    """Part of the product → its line in ARCHITECTURE.md; a part imports those of the lines above its own."""
    text = (ROOT / "ARCHITECTURE.md").read_text().partition("```layers\n")[2].partition("```")[0]
    return {name: number for number, line in enumerate(text.splitlines()) for name in line.partition("  #")[0].split()}


def part_of(module: str, parts: Iterable[str]) -> str:
    """The part to which a module belongs: the longest that its name begins with."""
    return max((part for part in parts if f"{module}.".startswith(f"{part}.")), key=len)


def upward(edges: Graph) -> list[str]:
    """The imports against the drawing."""
    level = levels()
    return [
        f"{name} imports {other}: in ARCHITECTURE.md {there} does not stand above {here}"
        for name, others in edges.items()
        for other in sorted(others)
        if (here := part_of(name, level)) != (there := part_of(other, level)) and level[there] >= level[here]
    ]


def test_every_import_points_up_in_the_drawing() -> None:
    assert upward(graph()) == []


@pytest.mark.parametrize(
    ("module", "other"),
    [
        ("failover.core.node", "agent.main_loop.loop"),
        ("checkpoint.linux.abi", "checkpoint.engine"),
        ("checkpoint.engines.ptrace.capture.session", "checkpoint.engines.ptrace.restore.process"),
        ("agent.guard.server", "agent.worker.process"),
        ("agent.main_loop.loop", "agent.worker.process"),
    ],
)
def test_an_import_against_the_drawing_is_seen(module: str, other: str) -> None:
    assert upward({module: {other}}) != []


@pytest.mark.parametrize(
    "text",
    [
        "import agent.main",
        "from agent import main",
        "def f():\n    import agent.main",
        "if True:\n    from agent.main import command_line",
    ],
)
def test_an_import_is_seen_wherever_it_hides(text: str) -> None:
    assert imported(imports(ast.parse(text), []), {"agent", "agent.main"}) == {"agent.main"}


def test_no_module_imports_itself_by_way_of_others() -> None:
    assert circles(graph()) == []


def test_a_circle_is_seen() -> None:
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}}) == [["a", "b", "c"]]


def beside(edges: Graph) -> list[str]:
    """The imports between the page and what it stands beside: it imports failover, and nothing imports it."""
    return [
        f"{name} imports {other}"
        for name, others in edges.items()
        for other in sorted(others)
        if (name.split(".")[0] == "page") != (other.split(".")[0] == "page")
        and (name.split(".")[0] != "page" or other.split(".")[0] == "agent")
    ]


def test_the_page_imports_failover_and_nothing_imports_the_page() -> None:
    assert beside(graph()) == []


@pytest.mark.parametrize(
    ("module", "other"), [("page.app", "agent.config"), ("failover.cli.main", "page.app"), ("agent", "page")]
)
def test_an_import_between_the_page_and_the_rest_is_seen(module: str, other: str) -> None:
    assert beside({module: {other}}) != []
    assert beside({"page.app": {"failover.errors", "checkpoint.errors", "page.errors"}, "page": {"page.app"}}) == []


CROWDED = 30
"""Modules in one folder: an example of what a reader can still look over, and no law; say here why one holds more."""


def test_no_folder_is_crowded() -> None:
    sizes, _ = folders()
    assert [f"{folder} holds {size} modules" for folder, size in sizes.items() if size > CROWDED] == []


# --- Whole robots ----------------------------------------------------------------------------------------------------


def test_whole_robots_are_started_where_no_two_tests_of_them_run_at_once() -> None:
    wrong = [
        f"{name_of(path)}:{line} imports {module}: a test that starts whole robots lies in tests/e2e (see tests/runner.py)"
        for path in sources("tests")
        if not name_of(path).startswith("tests/e2e/")
        for line, module in imports_of(path, package_of(path))
        if module.startswith("tests.e2e")
    ]
    assert wrong == []


# --- Purity ----------------------------------------------------------------------------------------------------------


def is_pure(path: Path) -> bool:
    """Whether the house rules call a file pure."""
    return name_of(path).startswith(PURE_FILES)


def impurities(path: Path, tree: ast.AST) -> list[str]:
    """What a pure file imports or calls that it should not."""
    allowed = PURE_IMPORTS | VALUE_IMPORTS if name_of(path).startswith("failover/state/") else PURE_IMPORTS
    found = [
        f"{name_of(path)}:{line} imports {module}"
        for line, module in imports(tree, list(package_of(path)))
        if module.split(".")[0] not in allowed and not is_pure_name(module)
    ]
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)]
    return found + [f"{name_of(path)}:{node.lineno} calls {called(node)}" for node in calls if called(node) in IMPURE_CALLS]


def is_pure_name(module: str) -> bool:
    """Whether a dotted name lies in a pure file or room, or in the error families."""
    path = module.replace(".", "/")
    return path.startswith(("failover/errors", *(pure.removesuffix(".py").rstrip("/") for pure in PURE_FILES)))


def test_the_pure_rooms_are_pure() -> None:
    pure = [path for path in sources("checkpoint", "failover") if is_pure(path)]
    assert [wrong for path in pure for wrong in impurities(path, parsed(path))] == []


@pytest.mark.parametrize(
    "text",
    ["import time", "def f():\n    import socket", "from random import choice", "open('x')", "import checkpoint.store.store"],
)
def test_an_impurity_is_seen(text: str) -> None:
    assert impurities(ROOT / "failover" / "core" / "node.py", ast.parse(text)) != []


# --- Doors -----------------------------------------------------------------------------------------------------------


def test_each_dependency_enters_through_its_door() -> None:
    wrong = [
        f"{name_of(path)}:{line} imports {module}: its only door is {', '.join(doors)}"
        for path in sources(*FLOORS)
        for line, module in imports_of(path, package_of(path))
        if (doors := DOORS.get(module.split(".")[0])) and name_of(path) not in doors
    ]
    assert wrong == []


DATACLASSES = {
    "failover/recording/mcap_file.py": "the mcap library's records are some",
    "failover/kept_state/period.py": "a field that is not shown",
    "failover/config/board.py": "read from TOML by its fields",
    "failover/config/members.py": "changes what is read from TOML",
    "failover/config/page.py": "read from TOML by its fields",
    "failover/config/programs.py": "read from TOML by its fields",
    "failover/config/store.py": "read from TOML by its fields",
    "failover/config/rights.py": "read from TOML by its fields",
    "failover/config/team.py": "read from TOML by its fields",
    "failover/simulators/files.py": "read from TOML by its fields",
    "failover/state/record_libraries.py": "programs have some",
    "failover/config/strict_toml.py": "reads TOML into them",
    "failover/config/choices.py": "what is read from TOML is made of them",
    "agent/alerts_config.py": "read from TOML by its fields",
    "agent/coordinator_config.py": "read from TOML by its fields",
    "agent/config.py": "read from TOML by its fields",
    "agent/task_config.py": "read from TOML by its fields",
    "agent/worker/components/supervisor.py": "fields that its beginning fills in",
}


def test_values_are_structs() -> None:
    """A dataclass takes 0.4 ms to be made, a Struct 0.01: a keeper, which a command waits for, has 150."""
    wrong = [
        f"{name_of(path)}:{line} imports dataclasses: take msgspec.Struct, or say here what that cannot do"
        for path in sources(*FLOORS)
        for line, module in imports_of(path, package_of(path))
        if module.split(".")[0] == "dataclasses" and name_of(path) not in DATACLASSES
    ]
    assert wrong == []


def test_the_keeper_alone_loads_the_gpl_library() -> None:
    """python-ptrace must never be in a process of ours other than the keeper: no face may pull it in."""
    modules = ", ".join(name_of(path).removesuffix(".py").replace("/", ".") for path in sources("failover", "agent"))
    script = f"import sys\nimport {modules}\nprint([name for name in sys.modules if name.split('.')[0] == 'ptrace'])"
    ran = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, cwd=ROOT, check=True)
    assert ran.stdout.strip() == "[]"


# --- Names -----------------------------------------------------------------------------------------------------------


def words(name: str) -> list[str]:
    """A name's words: ``PageStore`` and ``page_store`` are both page, store."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name).lower().strip("_").split("_")


def unwelcome(name: str) -> bool:
    """Whether a name says nothing: manager, helper, do_…"""
    return bool(FORBIDDEN_WORDS.intersection(words(name))) or (words(name)[0] == "do" and len(words(name)) > 1)


def test_no_name_that_says_nothing() -> None:
    wrong = [name_of(path) for path in sources(*FLOORS) if unwelcome(path.stem)]
    for path in sources(*FLOORS):
        wrong += [
            f"{name_of(path)}:{node.lineno} {node.name}"
            for node in ast.walk(parsed(path))
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef) and unwelcome(node.name)
        ]
    assert wrong == []


@pytest.mark.parametrize("name", ["PeerManager", "do_capture", "file_utils", "SignalHandler", "read_data"])
def test_a_name_that_says_nothing_is_seen(name: str) -> None:
    assert unwelcome(name)
    assert not unwelcome("database_path")


# --- Files and documents ---------------------------------------------------------------------------------------------


def test_no_file_names_a_package_registry() -> None:
    wrong = []
    for path in tracked_files():
        content = path.read_bytes()
        wrong += [f"{name_of(path)} names {host}" for host in REGISTRY_HOSTS if host.encode() in content]
    assert wrong == []


def pinned(name: str) -> list[str]:
    """The entries of a list of packages: a version and its hashes each."""
    return re.split(r"\n(?=\S)", re.sub(r"(?m)^#.*\n", "", (ROOT / name).read_text()).strip())


def test_the_development_set_is_pinned_by_version_and_hash() -> None:
    entries = pinned("requirements-dev.txt")
    assert len(entries) > 20
    for entry in entries:
        assert re.match(r"[a-z0-9.\-]+==\S+ \\\n", entry), entry.splitlines()[0]
        assert "--hash=sha256:" in entry


def test_what_runs_and_installs_failover_is_what_its_tests_run_with() -> None:
    tested = set(pinned("requirements-dev.txt"))
    running = pinned("requirements.txt")
    assert {*running, *pinned("requirements-build.txt")} <= tested
    wanted = {
        re.split(r"[<>=]", line)[0] for line in tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    }
    assert wanted <= {entry.split("==")[0] for entry in running}


def test_the_package_has_the_version_of_the_program() -> None:
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert (ROOT / "debian/changelog").read_text().startswith(f"failover ({version}) ")


def mentioned_verbs(text: str) -> set[str]:
    """The verbs that a document tells the reader to type: ``failover VERB`` in code spans and code blocks."""
    code = re.findall(r"```.*?```|`[^`\n]+`", text, flags=re.DOTALL)
    return {verb for piece in code for verb in re.findall(r"(?:^|[\s`$(|])failover ([a-z][a-z-]*)\b", piece)}


def test_documents_mention_only_verbs_that_exist() -> None:
    from failover.cli.parser import VERBS

    known = {verb.name for verb in VERBS}
    documents = [path for path in tracked_files() if path.suffix == ".md"]
    unknown = {name_of(path): sorted(mentioned_verbs(path.read_text()) - known) for path in documents}
    assert {name: verbs for name, verbs in unknown.items() if verbs} == {}


def test_a_verb_that_does_not_exist_is_seen() -> None:
    assert mentioned_verbs("type `failover fly 3` now") == {"fly"}
