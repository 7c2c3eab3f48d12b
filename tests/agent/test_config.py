"""The configuration file: every default documented, every mistake named with its line."""

from __future__ import annotations

import dataclasses
import os
import pwd
import re
import subprocess
import sys
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import msgspec
import pytest

from agent import config as configuration
from agent.alerts_config import AlertsConfig
from agent.config import ComponentConfig, Config, MediumConfig
from agent.coordinator_config import CoordinatorConfig
from agent.core_config import fetches, level_of, node_config, started_here
from agent.errors import ConfigError
from agent.main import main as agent_main
from agent.task_config import TaskConfig, declaration
from agent.worker.network.replication_link import new_keys
from checkpoint.linux.spawn.inherited_limits import Inheritance
from failover.config import team
from failover.config.store import StoreConfig
from failover.config.team import Robot, Role, Team
from failover.core.types import Launch, Rule
from failover.errors import FailoverError

DOCUMENTED = Path(__file__).parents[2] / "systemd" / "agent.toml"
ROBOT = Robot(("127.0.0.1:7420",), "127.0.0.1:7421")


@pytest.fixture
def directory(tmp_path: Path) -> Path:
    team.write(tmp_path / "team", Team("lab", {"robot1": ROBOT, "robot2": ROBOT}))
    return tmp_path


def written(directory: Path, *lines: str) -> Path:
    path = directory / "agent.toml"
    head = ['robot = "robot1"', f'team_directory = "{directory / "team"}"', "insecure = true"]
    path.write_text("\n".join([*head, *lines]) + "\n")
    return path


def test_every_key_and_its_default_stand_in_the_documented_file() -> None:
    text = DOCUMENTED.read_text()
    documented = tomllib.loads(re.sub(r"^#(\w+ = |\[)", r"\1", text, flags=re.MULTILINE))
    (component,) = documented.pop("components").values()
    (task,) = documented.pop("tasks").values()
    (medium,) = documented.pop("media").values()
    assert documented.pop("alerts") == dataclasses.asdict(AlertsConfig())
    assert documented.pop("coordinator") == dataclasses.asdict(CoordinatorConfig())
    assert documented.pop("store") == dataclasses.asdict(StoreConfig())
    defaults = dataclasses.asdict(Config())
    del defaults["components"], defaults["tasks"], defaults["media"], defaults["alerts"], defaults["store"]
    del defaults["coordinator"]
    assert documented == defaults
    assert set(component) == {one.name for one in dataclasses.fields(ComponentConfig)}
    assert msgspec.convert(component, ComponentConfig) == ComponentConfig()
    assert medium == dataclasses.asdict(MediumConfig())
    assert set(task) == {one.name for one in dataclasses.fields(TaskConfig)}
    assert msgspec.convert(task, TaskConfig) == TaskConfig()


TASK = ('[tasks."/lab/robot1/controller"]', 'command = ["/opt/controller", "--fast"]')


def test_a_declared_task_is_a_component_that_the_core_starts_by_itself(directory: Path) -> None:
    user = pwd.getpwuid(os.geteuid())
    lines = (
        'runtime_directory = "/run/other"',
        *TASK,
        f'user = "{user.pw_name}"',
        'environment = { SPEED = "2" }',
        "period_ms = 10",
    )
    rules = ('[components."/lab/robot1/controller"]', 'on_crash = "leave"')
    (spec,) = node_config(configuration.load(written(directory, *lines, *rules))).components
    assert (spec.name, spec.home, spec.owner, spec.launch.argv) == (
        "/lab/robot1/controller",
        "robot1",
        os.geteuid(),
        ("/opt/controller", "--fast"),
    )
    assert spec.rules.on_crash == "leave"
    assert (spec.rules.restart, spec.rules.restart_limit, spec.rules.restart_window_ms) == ("on-failure", 5, 60_000)
    told = dict(spec.launch.environment)
    assert (told["SPEED"], told["HOME"], told["FAILOVER_SOCKET"]) == ("2", user.pw_dir, "/run/other/control.sock")
    rights = msgspec.msgpack.decode(spec.launch.inheritance, type=Inheritance)
    assert (rights.uid, rights.gid) == (user.pw_uid, user.pw_gid)


def test_a_task_that_is_woken_by_a_signal_is_started_by_the_command_that_sends_it(directory: Path) -> None:
    (spec,) = node_config(configuration.load(written(directory, *TASK, "period_ms = 10", 'wake = "signal"'))).components
    sends = ("-P", "-m", "failover", "task", "run", "--signal", "CONT", "/lab/robot1/controller", "--")
    assert spec.launch.argv == (sys.executable, *sends, "/opt/controller", "--fast")


def test_such_a_task_takes_no_module_from_the_directory_of_its_program(directory: Path, tmp_path: Path) -> None:
    (tmp_path / "failover.py").write_text("print('theirs')")
    settings = configuration.load(written(directory, *TASK, "period_ms = 10", 'wake = "signal"'))
    (spec,) = node_config(settings).components
    words = [*spec.launch.argv[: spec.launch.argv.index("task")], "--help"]
    said = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=True).stdout
    assert "theirs" not in said and "usage: failover" in said


def test_a_task_without_a_period_runs_and_is_on_no_schedule(directory: Path) -> None:
    settings = configuration.load(written(directory, *TASK))
    assert len(node_config(settings).components) == 1
    assert declaration("/lab/robot1/controller", settings.config.tasks["/lab/robot1/controller"]) is None


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("period_ms = 0.01", "a period of 1e-05 s; 0.0001 to 1,000,000 s are possible"),
        ("period_ms = -1", "period_ms is -0.001 s"),
        ("period_ms = nan", "period_ms is nan"),
        ("period_ms = 10\ndeadline_ms = 20", "is longer than its period"),
        ("period_ms = 10\nafter = ['/lab/robot1/controller']", "it is to run after itself"),
        ("period_ms = 10\ncpus = [99]", "cpus = [99]: processors have the numbers 0 to 63"),
        ("period_ms = 10\npriority = 100", "priority 100"),
        ("wake = 'signal'", 'wake = "signal" without period_ms'),
        ("period_ms = 10\nwake = 'signal'\nwake_signal = 'BELL'", "wake_signal is 'BELL'; give the name of a signal"),
        ("period_ms = 10\nwake = 'signal'\nwake_signal = '_DFL'", "wake_signal is '_DFL'; give the name of a signal"),
        ("period_ms = 10\nwake = 'signal'\nwake_signal = 'KILL'", "wake_signal is 'KILL'; give the name of a signal"),
        ("period_ms = 10\nwake = 'signal'\nwake_signal = 'STOP'", "wake_signal is 'STOP'; give the name of a signal"),
        ("restart_limit = 101", "restart_limit is 101; at most 100, and 0 sets no limit"),
        ("restart_window_s = 0.5", "restart_window_s is 0.5; at least 1 and at most 3600"),
        ("user = 'no-such-user'", "user = 'no-such-user': this robot has no such user"),
        ("directory = 'here'", "directory = 'here' is not absolute"),
        ("command = ['']", "command is missing"),
        ("environment = { 'A=B' = '' }", "environment has a variable 'A=B'"),
    ],
)
def test_a_task_that_cannot_be_is_refused(directory: Path, line: str, said: str) -> None:
    head = TASK[:1] if line.startswith("command") else TASK
    with pytest.raises(ConfigError) as refusal:
        configuration.load(written(directory, *head, line))
    assert said in str(refusal.value) and "agent.toml:4" in str(refusal.value)


def test_a_whole_configuration_is_read(directory: Path) -> None:
    path = written(directory, "beat_ms = 10", '[components."/lab/robot1/mapper"]', 'on_loss = "hold"')
    settings = configuration.load(path)
    assert settings.config.beat_ms == 10
    assert settings.component("/lab/robot1/mapper").on_loss == "hold"
    assert settings.component("/lab/robot1/other") == ComponentConfig()
    assert list(settings.peers) == ["robot2"]


def test_a_program_is_started_again_by_this_robots_own_command(directory: Path) -> None:
    lines = ('[components."/lab/robot1/mapper"]', 'command = ["/opt/mapper", "--small"]', 'environment = { MAPS = "/srv/maps" }')
    settings = configuration.load(written(directory, *lines))
    launch = Launch(("/home/ann/mapper",), (("LANG", "C"), ("MAPS", "/home/ann/maps")), "/home/ann", umask=0o077)
    told = started_here(launch, settings.component("/lab/robot1/mapper"))
    environment = (("LANG", "C"), ("MAPS", "/srv/maps"))
    assert told == Launch(("/opt/mapper", "--small"), environment, "/home/ann", umask=0o077)
    assert started_here(launch, settings.component("/lab/robot1/other")) == launch


def test_the_level_of_processors_is_the_callers_then_the_components_then_the_robots(directory: Path) -> None:
    lines = ("portable = true", '[components."/lab/robot1/mapper"]', 'portable = "x86-64-v3"')
    settings = configuration.load(written(directory, *lines))
    other, mapper = settings.component("/lab/robot1/other"), settings.component("/lab/robot1/mapper")
    assert level_of("", settings.config, other) == "x86-64-v2"
    assert level_of("", settings.config, mapper) == "x86-64-v3"
    assert level_of("x86-64-v1", settings.config, mapper) == "x86-64-v1"
    assert level_of("no", settings.config, mapper) == ""
    assert level_of("", Config("robot1"), ComponentConfig()) == ""
    assert level_of("", settings.config, ComponentConfig(portable=False)) == ""
    assert level_of("", settings.config, ComponentConfig(portable="armv8-a")) == "x86-64-v2"


@pytest.mark.parametrize("lines", [('portable = "x86-64-v9"',), ('[components."/lab/robot1/mapper"]', 'portable = "x86-64-v9"')])
def test_a_level_that_no_processor_has_is_refused_with_those_there_are(lines: tuple[str, ...], directory: Path) -> None:
    with pytest.raises(ConfigError, match=r"portable is 'x86-64-v9'; choose true, false or one of x86-64-v1, .*armv8-a"):
        configuration.load(written(directory, *lines))


@pytest.mark.parametrize(
    ("lines", "line", "said"),
    [
        (("baet_ms = 10",), 4, "did you mean 'beat_ms'"),
        (
            ('[components."/lab/a".devices]', '"/dev/x" = "open"'),
            5,
            "'open' is none of reopen, hook, optional; did you mean 'reopen'?",
        ),
        (
            ('[components."/lab/a"]', 'devices."/dev/x" = "hok"'),
            5,
            "'hok' is none of reopen, hook, optional; did you mean 'hook'?",
        ),
        (('[components."/lab/a"]', 'devices = { "/dev/x" = "hok" }'), 5, '"/lab/a".devices."/dev/x": \'hok\' is none of'),
        (('[components."/lab/a"]', 'hooks.after_resume = "x"'), 5, '"/lab/a".hooks.after_resume: Expected `array`'),
        (('[components."/lab/a".devices]', '"ttyUSB0" = "reopen"'), 4, "'ttyUSB0' is not the absolute path of a device"),
        (('[components."/lab/a"]', 'devices."/dev/x" = { reopen = "/dev/y", optoinal = true }'), 5, "did you mean 'optional'"),
        (('[components."/lab/a".hooks]', "limit_s = 0"), 4, "limit_s of its hooks is 0"),
        (('[components."/lab/a".hooks]', 'after_resmue = ["x"]'), 5, "did you mean 'after_resume'"),
        (("# fine", 'beat_ms = "often"'), 5, "Expected `int`"),
        (('when_alone = "panic"',), 4, "when_alone: 'panic' is none of run, freeze"),
        (('rule = "majorty"',), 4, "rule: 'majorty' is none of auto, pair, majority, etcd; did you mean 'majority'?"),
        (("# fine", "snapshots_over = 3"), 5, "snapshots_over: 3 is none of wired, any"),
        (('log_level = "warn"',), 4, "'warn' is none of debug, info, warning, error; did you mean 'warning'?"),
        (('portable = "x86-64-v9"',), 4, "; did you mean 'x86-64-v"),
        (('rule = "dice"',), 4, "rule: 'dice' is none of auto, pair, majority"),
        (("keep_chains = 2",), 4, "unknown key 'keep_chains'"),
        (("# fine", "beat_ms = 0"), 5, "must be at least 1"),
        (("beat_ms = 100_000",), 4, "at most 10000"),
        (("beat_ms = 100", "lease_ms = 200"), 5, "one lost beat would count as a death"),
        (("# fine", "snapshot_period_ms = 0"), 5, "must be at least 1"),
        (("# fine", "cpu_share = 5"), 5, "between 0.001 and 1, which is a whole core; 0: no limit"),
        (('[components."/lab/a"]', "cpu_share = nan"), 4, "cpu_share is nan"),
        (('[components."/lab/a"]', "freeze_budget_ms = -1"), 4, "0: as short as can be"),
        (('[components."/lab/a"]', "freeze_budget_ms = nan"), 4, "freeze_budget_ms is nan"),
        (('[components."/lab/a"]', "freeze_overrun_s = -1"), 4, "0: none takes longer"),
        (("link_mbit_s = -1",), 4, "0 means no cap"),
        (("keep_checkpoints = -1",), 4, "0 keeps none"),
        (("# fine", 'keep_for = "a week"'), 5, "'a week' is no span of time; write 90s, 10min, 2h or 3d"),
        (('keep_size = "20"',), 4, "'20' is no size; write 500MB, 20GB or 1TB"),
        (('[components."mapper"]', 'on_loss = "hold"'), 4, "mapper"),
        (('[components."/lab/a"]', 'prefer = "robot7"'), 4, "the team knows robot1, robot2"),
        (("patience_s = 0",), 4, "must be at least 1"),
        (('[components."/lab/a"]', 'on_lost = "hold"'), 5, "did you mean 'on_loss'"),
        (
            ('[components."/lab/a"]', 'on_loss = "give up"'),
            5,
            "components.\"/lab/a\".on_loss: 'give up' is none of takeover, hold",
        ),
        (('[components."/lab/a"]', 'command = "/opt/a"'), 5, "Expected `array`"),
        (('[components."/lab/a"]', 'command = [""]'), 4, "the first one names the program"),
        (('[components."/lab/a"]', 'command = ["/opt/a", "b\\u0000c"]'), 4, "a zero byte"),
        (('[components."/lab/a"]', 'directory = "opt"'), 4, "is not absolute"),
        (('[components."/lab/a"]', 'environment = { "A=B" = "c" }'), 4, "has a variable 'A=B'"),
        (('[components."/lab/a"]', "environment = { A = 1 }"), 5, "Expected `str`"),
        (("[alerts]", 'user = "nobody"', 'on_split = ["tell"]', "per_hour = 0"), 4, "per_hour is 0; it must be at least 1"),
        (("[alerts]", 'on_takeover = [""]'), 4, "the first word names the program"),
        (("[alerts]", 'on_takover = ["tell"]'), 5, "did you mean 'on_takeover'"),
        (("[alerts]", 'on_split = "tell"'), 5, "Expected `array`"),
        (("[store]", 's3 = "bucket/prefix"'), 4, "s3 is 'bucket/prefix', which is no place"),
        (("[store]", 's3 = "s3:///prefix"'), 4, "which is no place"),
        (("[store]", 's3_endpoint = "host:9000"'), 4, 'write "https://HOST:PORT"'),
        (("[store]", "s3_keep = 0"), 4, "s3_keep is 0; it must be at least 1"),
        (("[store]", "s3_evry_s = 5"), 5, "did you mean 's3_every_s'"),
        (("[alerts]", 'user = "no-such-user"', 'on_split = ["tell"]'), 4, "this robot has no such user"),
    ],
)
def test_a_mistake_is_named_with_file_line_and_cure(directory: Path, lines: tuple[str, ...], line: int, said: str) -> None:
    path = written(directory, *lines)
    with pytest.raises(ConfigError) as caught:
        configuration.load(path)
    assert str(caught.value).startswith(f"{path}:{line}: ")
    assert said in str(caught.value)


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        (("beat_ms = 100", "lease_ms = 200"), "one lost beat would count as a death"),
        (("beat_ms = 0",), "must be at least 1"),
        (("= 3",), "this is not TOML"),
    ],
)
def test_values_that_contradict_each_other_are_refused(directory: Path, lines: tuple[str, ...], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        configuration.load(written(directory, *lines))


def test_a_role_that_there_is_not_is_refused_with_those_there_are(directory: Path) -> None:
    path = directory / "team" / "team.toml"
    path.write_text(path.read_text().replace('role = "robot"', 'role = "sever"', 1))
    with pytest.raises(ConfigError) as caught:
        configuration.load(written(directory))
    said = f"{path}:5: robots.robot1.role: 'sever' is none of robot, server, witness; did you mean 'server'?"
    assert str(caught.value) == said


def test_a_robot_outside_the_team_is_told_who_is_in_it(directory: Path) -> None:
    path = directory / "agent.toml"
    path.write_text(f'robot = "robot9"\nteam_directory = "{directory / "team"}"\n')
    with pytest.raises(ConfigError, match="robot1, robot2"):
        configuration.load(path)


def test_a_robot_without_a_name_has_its_host_name(directory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = directory / "agent.toml"
    path.write_text(f'insecure = true\nteam_directory = "{directory / "team"}"\n')
    monkeypatch.setattr(configuration.os, "uname", lambda: Named("robot2.lab.example"))
    assert configuration.load(path).config.robot == "robot2"
    monkeypatch.setattr(configuration.os, "uname", lambda: Named("laptop"))
    with pytest.raises(ConfigError, match=r"robot 'laptop' is not in .* robot1, robot2"):
        configuration.load(path)


class Named(NamedTuple):
    nodename: str


def test_keys_are_asked_for_unless_the_operator_says_insecure(directory: Path) -> None:
    path = directory / "agent.toml"
    path.write_text(f'robot = "robot1"\nteam_directory = "{directory / "team"}"\n')
    with pytest.raises(ConfigError, match=r"cannot read this robot's key .* insecure = true"):
        configuration.load(path)
    team.write_secret_key(directory / "team", "robot1", "x" * 40)
    with pytest.raises(ConfigError, match=r"robot1, robot2 .* have no public key"):
        configuration.load(path)


@pytest.mark.parametrize(
    ("secret", "said"),
    [
        (new_keys()[1], "does not belong to the public key of robot1 in "),
        ("#" * 40, "is no key: it is not Z85"),
    ],
    ids=["another robot's", "no key"],
)
def test_a_secret_key_that_does_not_fit_the_team_fails_the_check(
    directory: Path, secret: str, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (public, right), (other, _) = new_keys(), new_keys()
    members = {"robot1": replace(ROBOT, public_key=public), "robot2": replace(ROBOT, public_key=other)}
    team.write(directory / "team", Team("lab", members))
    path = directory / "agent.toml"
    path.write_text(f'robot = "robot1"\nteam_directory = "{directory / "team"}"\n')
    key = team.write_secret_key(directory / "team", "robot1", secret)
    assert agent_main(["check", "--config", str(path)]) == 1
    refusal = capsys.readouterr().err
    assert refusal.startswith(f"failover-agent: {key}") and said in refusal
    key.write_text(right + "\n")
    assert agent_main(["check", "--config", str(path)]) == 0
    members["robot1"] = replace(members["robot1"], public_key=new_keys()[0], next_key=public)
    team.write(directory / "team", Team("lab", members))
    assert agent_main(["check", "--config", str(path)]) == 0, "of two that count while one replaces the other"


def test_a_secret_key_that_others_can_read_is_refused(directory: Path) -> None:
    key = team.write_secret_key(directory / "team", "robot1", "x" * 40)
    assert key.stat().st_mode & 0o777 == 0o600
    key.chmod(0o644)
    path = directory / "agent.toml"
    path.write_text(f'robot = "robot1"\nteam_directory = "{directory / "team"}"\n')
    with pytest.raises(ConfigError, match="chmod 600"):
        configuration.load(path)


@pytest.mark.parametrize(
    ("name", "key", "said"),
    [
        ("robot2", "x" * 39, "has 39 characters, not 40"),
        ("robot2", "☃" * 40, "is not Z85"),
        ("robot2", "#" * 40, "is not Z85"),
        ("r" * 64, "", "cannot name a robot"),
        ("ř" * 32, "", "cannot name a robot"),
        ("two words", "", "cannot name a robot"),
        ("a.b", "", "it holds one of"),
    ],
)
def test_a_robot_that_no_other_could_hear_or_let_in_is_refused(directory: Path, name: str, key: str, said: str) -> None:
    odd = Robot(ROBOT.beats, ROBOT.bulk, "robot", key)
    team.write(directory / "team", Team("lab", {"robot1": ROBOT, name: odd}))
    with pytest.raises(ConfigError, match=said):
        configuration.load(written(directory))


def test_every_key_that_is_made_is_a_key(directory: Path) -> None:
    for _ in range(20):
        team.enrol(Team("lab"), "robot1", Robot(ROBOT.beats, ROBOT.bulk, "robot", new_keys()[0]))


@pytest.mark.parametrize(
    ("roles", "line", "rule"),
    [
        (("robot", "robot"), "", Rule.PAIR),
        (("robot", "robot", "witness"), "", Rule.MAJORITY),
        (("robot", "robot", "server"), "", Rule.MAJORITY),
        (("robot", "robot", "robot"), 'rule = "pair"', Rule.PAIR),
        (("robot", "robot"), 'rule = "majority"', Rule.MAJORITY),
    ],
)
def test_more_than_two_members_decide_by_majority_unless_told_otherwise(
    directory: Path, roles: tuple[Role, ...], line: str, rule: Rule
) -> None:
    members = {f"robot{number + 1}": Robot(ROBOT.beats, ROBOT.bulk, role) for number, role in enumerate(roles)}
    team.write(directory / "team", Team("lab", members))
    config = node_config(configuration.load(written(directory, line)))
    assert config.rule is rule
    assert [config.runs(name) for name in members] == [role == "robot" for role in roles]
    assert [config.keeps(name) for name in members] == [role != "witness" for role in roles]


@pytest.mark.parametrize(
    ("choice", "said"),
    [
        ('prefer = "hall"', "it is a server and runs nothing; choose among robot1, robot2"),
        ('prefer = "gate"', "it is a witness and runs nothing; choose among robot1, robot2"),
        ('standby = "gate"', "it is a witness and keeps no checkpoints; choose among hall, robot1, robot2"),
        ('standby = "hall"', ""),
    ],
)
def test_nobody_is_chosen_for_what_his_role_never_does(directory: Path, choice: str, said: str) -> None:
    roles: dict[str, Role] = {"robot1": "robot", "robot2": "robot", "hall": "server", "gate": "witness"}
    members = {name: Robot(ROBOT.beats, ROBOT.bulk, role) for name, role in roles.items()}
    team.write(directory / "team", Team("lab", members))
    path = written(directory, '[components."/lab/a"]', choice)
    if not said:
        assert configuration.load(path).component("/lab/a").standby == "hall"
        return
    with pytest.raises(ConfigError, match=said) as caught:
        configuration.load(path)
    assert str(caught.value).startswith(f"{path}:4: ")
    assert agent_main(["check", "--config", str(path)]) == 1


def test_a_witness_under_the_pair_rule_is_refused(directory: Path) -> None:
    members = {"robot1": ROBOT, "robot2": Robot(ROBOT.beats, ROBOT.bulk, "witness")}
    team.write(directory / "team", Team("lab", members))
    with pytest.raises(ConfigError, match=r'robot2 would have no vote; set rule = "majority"'):
        configuration.load(written(directory))


@pytest.mark.parametrize(
    ("lines", "says"),
    [
        (("[media.wlan0]", "t_tup_ms = 2"), "media.wlan0.t_tup_ms is 2; it must be at least 5 and at most 1000"),
        (("lease_ms = 199", "[media.wlan0]", "slots = true"), "with slots on wlan0 in rounds of 50 ms give at least 200"),
        (("[media.wlan0]", 'cast = "multicats"'), "multicast"),
        (("[media.wlan0]", 'slots = "no"'), "slots"),
        (("[media.wlan0]", "slot = true"), "unknown key 'slot'"),
    ],
)
def test_a_medium_that_cannot_work_is_refused_by_name(directory: Path, lines: tuple[str, ...], says: str) -> None:
    with pytest.raises((ConfigError, FailoverError), match=re.escape(says)):
        configuration.load(written(directory, *lines))


def test_slots_by_name_work_with_a_lease_of_four_rounds(directory: Path) -> None:
    loaded = configuration.load(written(directory, "lease_ms = 200", "[media.wlan0]", "slots = true"))
    assert loaded.config.medium("wlan0").slots is True
    assert loaded.config.medium("eth0") == MediumConfig()


@pytest.mark.root
def test_an_agent_of_root_tells_an_operator_by_a_named_users_rights_alone(directory: Path) -> None:
    with pytest.raises(ConfigError, match=r"user is missing, and this agent runs as root.*nobody"):
        configuration.load(written(directory, "[alerts]", 'on_split = ["tell"]'))
    assert configuration.load(written(directory, "[alerts]", "limit_s = 5")).config.alerts.limit_s == 5, "nothing would be run"
    for user in ("root", "0"):
        with pytest.raises(ConfigError, match=r"is root: commands have an ordinary user's rights"):
            configuration.load(written(directory, "[alerts]", f'user = "{user}"', 'on_split = ["tell"]'))


def test_a_witness_has_nothing_to_tell_of_and_nothing_to_archive(directory: Path) -> None:
    members = {"robot1": replace(ROBOT, role="witness"), "robot2": ROBOT, "robot3": ROBOT}
    team.write(directory / "team", Team("lab", members))
    with pytest.raises(ConfigError, match="is a witness, and holds nothing to tell of"):
        configuration.load(written(directory, "[alerts]", 'user = "nobody"', 'on_split = ["tell"]'))
    for place in ('s3 = "s3://robots"', 'witness = "robot1"'):
        with pytest.raises(ConfigError, match="is a witness, and has no checkpoints of its own"):
            configuration.load(written(directory, "[store]", place))
    assert configuration.load(written(directory, "[store]", 'sealed_size = "20GB"')).config.store.place == ""


ETCD = ('rule = "etcd"', "lease_ms = 1800", "[coordinator]", 'endpoints = ["http://10.0.0.5:2379"]')


def test_etcd_is_one_more_member_that_only_votes(directory: Path) -> None:
    config = node_config(configuration.load(written(directory, *ETCD)))
    assert (config.rule, config.coordinator, config.quorum) == (Rule.ETCD, "etcd", 2)
    assert set(config.peers) == {"robot2", "etcd"} and config.witnesses == ("etcd",)
    assert config.loyalty_ns <= 2 * 10**9, "the usual lease of etcd lasts for two seconds"


@pytest.mark.parametrize("site", ["", "hall"])
def test_no_member_of_any_site_is_called_as_etcd_is(site: str, directory: Path) -> None:
    """What comes from a robot of that name would be told of etcd."""
    team.write(directory / "team", Team("lab", {"robot1": ROBOT, "robot2": ROBOT, "etcd": ROBOT.at(site)}))
    with pytest.raises(ConfigError, match="a member has the name etcd"):
        configuration.load(written(directory, *ETCD))


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        (('witness = "robot3"',), "witness = 'robot3', which is no witness of the team; choose among robot2"),
        (('witness = "gate"',), "witness = 'gate', which is no witness of the team"),
        (('witness = "robot2"', 's3 = "/mnt"'), "copies go to one place; remove one of the two"),
        (('sealed_size = "20GB"',), "robot1 is a robot: sealed_size is for a witness"),
        (('sealed_size = "much"',), "sealed_size: 'much' is no size"),
        (("resume = true",), "resume is true, and there is no archive; set s3 or witness, or remove resume"),
    ],
)
def test_who_keeps_sealed_copies_is_a_witness(lines: tuple[str, ...], said: str, directory: Path) -> None:
    team.write(directory / "team", Team("lab", {"robot1": ROBOT, "robot2": replace(ROBOT, role="witness"), "robot3": ROBOT}))
    with pytest.raises(ConfigError, match=said):
        configuration.load(written(directory, "[store]", *lines))
    assert configuration.load(written(directory, "[store]", 'witness = "robot2"')).config.store.place == "of witness robot2"


@pytest.mark.parametrize(
    ("lines", "third", "is_taken"),
    [
        (("resume = true",), "witness", True),
        ((), "witness", False),
        (("resume = true",), "", False),
        (("resume = true",), "robot", True),
    ],
    ids=["voters that resume", "voters that do not", "two robots alone do not vote", "three robots"],
)
def test_voters_take_copies_from_an_archive_where_they_are_told_so(
    lines: tuple[str, ...], third: str, is_taken: bool, directory: Path
) -> None:
    others = {"gate": replace(ROBOT, role=third)} if third else {}  # type: ignore[arg-type]
    team.write(directory / "team", Team("lab", {"robot1": ROBOT, "robot2": ROBOT, **others}))
    settings = configuration.load(written(directory, "[store]", 's3 = "/mnt"', "s3_every_s = 7", *lines))
    assert fetches(settings) == is_taken
    assert node_config(settings).copies_ms == (7_000 if is_taken else 0)


def test_a_team_without_the_witness_that_keeps_its_copies_is_refused_before_it_is_one(directory: Path) -> None:
    with_witness = Team("lab", {"robot1": ROBOT, "robot2": replace(ROBOT, role="witness"), "robot3": ROBOT})
    team.write(directory / "team", with_witness)
    settings = configuration.load(written(directory, "[store]", 'witness = "robot2"'))
    configuration.check_team(settings, with_witness)
    with pytest.raises(ConfigError, match="witness = 'robot2', which is no witness of the team"):
        configuration.check_team(settings, Team("lab", {"robot1": ROBOT, "robot3": ROBOT}))


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        (ETCD[:2], "needs to know where etcd is; add [coordinator] endpoints"),
        (("lease_ms = 999", ETCD[0], *ETCD[2:]), "give at least 1000, such as lease_ms = 1800"),
        (ETCD[1:], '[coordinator] has no effect without rule = "etcd"'),
        ((*ETCD[:3], 'endpoints = ["10.0.0.5:2379"]'), "'10.0.0.5:2379' is no address of etcd; write endpoints"),
    ],
)
def test_a_robot_that_could_not_ask_etcd_does_not_start(directory: Path, lines: tuple[str, ...], said: str) -> None:
    with pytest.raises(ConfigError) as caught:
        configuration.load(written(directory, *lines))
    assert said in str(caught.value)
