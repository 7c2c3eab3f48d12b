"""The rule of rights: a table of users, verbs and paths, and what holds for any rules."""

from __future__ import annotations

import re

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from failover.core.rights import hours, paths
from failover.core.rights.rules import NEVER_BY_DEFAULT, VERBS, Rule, Subject, decide, make_rule, without_rules
from failover.errors import RightsError
from tests.failover.core.rights.table import CASES, GROUPS, MONDAY_NOON, PATHS, RULES, SUNDAY_NOON, expected


def subject(user: str) -> Subject:
    """As the directory tells a user of the table."""
    return Subject(f"ldap:{user}", GROUPS[user])


def test_the_table_holds() -> None:
    assert len(CASES) == 4 * 8 * 6
    wrong = [
        (user, verb, path, answer.because)
        for user, verb, path in CASES
        if bool(answer := decide(RULES, subject(user), verb, path, MONDAY_NOON)) != expected(user, verb, path)
    ]
    assert wrong == []


def test_a_decision_names_the_rule_its_line_the_group_and_the_pattern() -> None:
    path = PATHS[2]
    allowed = decide(RULES, subject("driver"), "call", path, MONDAY_NOON)
    denied = decide(RULES, subject("student"), "program", path, MONDAY_NOON)
    nothing = decide(RULES, subject("stranger"), "see", path, MONDAY_NOON)
    assert allowed.because == (
        f"ldap:driver may call {path}: rights.toml:4 allows it to drivers on University/Lab/** during Mon-Fri 08:00-20:00"
    )
    assert denied.because == f"ldap:student may not program {path}: rights.toml:17 denies it to students on **/Engines/**"
    assert nothing.because == f"ldap:stranger may not see {path}: no rule allows it to guests"
    assert (allowed.rule, denied.rule, nothing.rule) == (RULES[0], RULES[3], None)


def test_outside_its_hours_a_rule_is_not_there_and_the_sentence_says_so() -> None:
    answer = decide(RULES, subject("driver"), "call", PATHS[2], SUNDAY_NOON)
    assert not answer
    assert answer.because.endswith("rights.toml:4 allows it during Mon-Fri 08:00-20:00 only, and it is Sun 12:00")


def test_root_and_the_agents_user_stand_above_the_rules_but_for_program_and_grant() -> None:
    root = Subject("uid:0", stands_above=True)
    rules = [make_rule(["uid:0"], ["*"], ["**"], deny=True)]
    assert {verb for verb in VERBS if decide(rules, root, verb, "a", 0)} == set(VERBS) - set(NEVER_BY_DEFAULT)
    assert decide([make_rule(["uid:0"], ["grant"], ["**"])], root, "grant", "a", 0)


def test_a_group_of_a_directory_is_never_taken_for_a_name_or_a_relation() -> None:
    liar = Subject("ldap:eve", frozenset({"@owner", "uid:0", "@all", "ldap:adam"}))
    rules = [make_rule(["@owner", "uid:0", "ldap:adam", "@robots"], ["*"], ["**"])]
    assert not any(decide(rules, liar, verb, "a/b", 0) for verb in VERBS)
    assert decide([make_rule(["ldap:eve"], ["see"], ["**"])], liar, "see", "a/b", 0)


def test_relations() -> None:
    rules = [
        make_rule(["@owner"], ["operate"], ["**"]),
        make_rule(["@robots"], ["see"], ["**"]),
        make_rule(["@all"], ["read"], ["**"]),
    ]
    owner, other, robot = Subject("uid:7", is_owner=True), Subject("uid:8"), Subject("robot:robot2")
    seen = {one.name: [verb for verb in VERBS if decide(rules, one, verb, "x", 0)] for one in (owner, other, robot)}
    assert seen == {"uid:7": ["read", "operate"], "uid:8": ["read"], "robot:robot2": ["see"]}


def test_without_rules_todays_rights_hold() -> None:
    root, owner, other = Subject("uid:0", stands_above=True), Subject("uid:7", is_owner=True), Subject("uid:8")
    seen = {one.name: [verb for verb in VERBS if without_rules(one, verb, "/lab/r1/m")] for one in (root, owner, other)}
    all_but = ["see", "read", "call", "put", "operate", "start"]
    assert seen == {"uid:0": all_but, "uid:7": all_but, "uid:8": ["see", "start"]}


def test_a_copy_is_told_with_every_answer() -> None:
    told = Subject("ldap:driver", frozenset({"drivers"}), copy="rights by a copy 3 h old")
    assert decide(RULES, told, "call", PATHS[2], MONDAY_NOON).because.endswith("; rights by a copy 3 h old")
    assert decide(RULES, told, "grant", PATHS[2], MONDAY_NOON).because.endswith("; rights by a copy 3 h old")


@pytest.mark.parametrize(
    ("groups", "verbs", "where", "key", "said"),
    [
        ([], ["see"], ["**"], "groups", "no user"),
        (["@owners"], ["see"], ["**"], "groups", "did you mean '@owner'?"),
        ([""], ["see"], ["**"], "groups", "no group"),
        (["a"], ["sea"], ["**"], "verbs", "did you mean 'see'?"),
        (["a"], ["!sea"], ["**"], "verbs", "did you mean 'see'?"),
        (["a"], ["see", "!see"], ["**"], "verbs", "leaves none"),
        (["a"], [], ["**"], "verbs", "leaves none"),
        (["a"], ["see"], [], "paths", "about nothing"),
        (["a"], ["see"], ["lab/robot*"], "paths", "one whole step"),
        (["a"], ["see"], ["a//b"], "paths", "not empty"),
        (["a"], ["see"], ["a/../b"], "paths", "neither"),
        (["a"], ["see"], ["a\0b"], "paths", "visible"),
        (["a"], ["see"], ["x" * 201], "paths", "200 bytes"),
        (["a"], ["see"], ["/".join("x" * 17)], "paths", "16 steps"),
    ],
)
def test_a_rule_that_cannot_be_meant_is_refused(
    groups: list[str], verbs: list[str], where: list[str], key: str, said: str
) -> None:
    with pytest.raises(RightsError, match=re.escape(said)) as refused:
        make_rule(groups, verbs, where)
    assert refused.value.key == key


@pytest.mark.parametrize("path", ["", "/", "a//b", "a/", "..", "a/./b", "a\nb", "\ud800", "x" * 201, "／".join("x" * 17)])
def test_what_is_no_path_is_refused(path: str) -> None:
    with pytest.raises(RightsError):
        decide(RULES, subject("operator"), "see", path, 0)


def test_paths_are_compared_in_one_form() -> None:
    assert paths.steps_of("/lab/robot1") == paths.steps_of("lab→robot1") == paths.steps_of("lab／robot１")


# --- For any rules ---------------------------------------------------------------------------------------------------

STEPS = st.sampled_from(["a", "b", "Engines"])
PATTERNS = st.lists(st.one_of(STEPS, st.sampled_from(["*", "**"])), min_size=1, max_size=6).map("/".join)
SOME_PATHS = st.lists(STEPS, min_size=1, max_size=6).map("/".join)
GROUP_NAMES = st.sampled_from(["g", "h", "@all", "@owner", "uid:7"])
SUBJECTS = st.builds(
    Subject, st.sampled_from(["uid:7", "ldap:x", "robot:r"]), st.frozensets(st.sampled_from(["g", "h", "@owner"])), st.booleans()
)
HOURS = st.one_of(st.none(), st.sampled_from(["Mon-Fri 08:00-20:00", "Sat 22:00-06:00", "Sun"]).map(hours.parse))
VERB_WORDS = st.lists(st.sampled_from(sorted(VERBS)), min_size=1, max_size=3)
A_RULE = st.builds(
    lambda groups, verbs, patterns, deny, span: make_rule(groups, verbs, patterns, deny=deny, hours=span),
    st.lists(GROUP_NAMES, min_size=1, max_size=2),
    VERB_WORDS,
    st.lists(PATTERNS, min_size=1, max_size=2),
    st.booleans(),
    HOURS,
)
SOME_RULES = st.lists(A_RULE, max_size=5)
MINUTES = st.integers(0, hours.WEEK_MINUTES - 1)


@given(PATTERNS, SOME_PATHS)
def test_a_pattern_fits_as_its_regular_expression_does(pattern: str, path: str) -> None:
    parts = {"*": "[^/]+/", "**": "(?:[^/]+/)*"}
    expression = "".join(parts.get(step, re.escape(step) + "/") for step in pattern.split("/"))
    assert paths.fits(paths.pattern_of(pattern), paths.steps_of(path)) == bool(re.fullmatch(expression, path + "/"))


@settings(max_examples=60)
@given(SOME_RULES, A_RULE, st.integers(0, 5), SUBJECTS, st.sampled_from(sorted(VERBS)), SOME_PATHS, MINUTES)
def test_one_more_rule_changes_an_answer_only_in_its_own_direction(
    rules: list[Rule], more: Rule, place: int, asker: Subject, verb: str, path: str, minute: int
) -> None:
    before = decide(rules, asker, verb, path, minute).allow
    after = decide([*rules[:place], more, *rules[place:]], asker, verb, path, minute).allow
    assert not (more.deny and after and not before)
    assert not (not more.deny and before and not after)
    assert after == decide([more, *rules], asker, verb, path, minute).allow  # wherever it stands


@settings(max_examples=60)
@given(SOME_RULES, SUBJECTS, st.sampled_from(sorted(VERBS)), SOME_PATHS, MINUTES)
def test_an_answer_follows_from_the_rules_that_fit(rules: list[Rule], asker: Subject, verb: str, path: str, minute: int) -> None:
    answer = decide(rules, asker, verb, path, minute)
    steps = paths.steps_of(path)
    fit = [
        rule
        for rule in rules
        if verb in rule.verbs
        and rule.group_of(asker)
        and rule.pattern_for(steps)
        and (rule.hours is None or rule.hours.hold(minute))
    ]
    assert answer.allow == (bool(fit) and not any(rule.deny for rule in fit))
    assert answer.because.startswith(f"{asker.name} may {'' if answer else 'not '}{verb} {path}: ")


# --- Hours -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "within", "without"),
    [
        ("Mon-Fri 08:00-20:00", ["Mon 08:00", "Fri 19:59"], ["Mon 07:59", "Fri 20:00", "Sat 12:00"]),
        ("Sun 22:00-06:00", ["Sun 22:00", "Mon 00:00", "Mon 05:59"], ["Mon 06:00", "Sun 05:00", "Sun 21:59"]),
        ("Sat-Mon", ["Sat 00:00", "Sun 12:00", "Mon 23:59"], ["Fri 23:59", "Tue 00:00"]),
        ("09:00-24:00", ["Wed 09:00", "Wed 23:59"], ["Wed 08:59", "Wed 00:00"]),
        ("mon,wed 10:00-11:00", ["Mon 10:30", "Wed 10:30"], ["Tue 10:30"]),
    ],
)
def test_hours_hold(text: str, within: list[str], without: list[str]) -> None:
    def minute(told: str) -> int:
        return hours.minute_of(hours.DAYS.index(told[:3]), int(told[4:6]), int(told[7:]))

    found = hours.parse(text)
    assert [told for told in within if not found.hold(minute(told))] == []
    assert [told for told in without if found.hold(minute(told))] == []
    assert [told for told in within if hours.spelled(minute(told)) != told] == []


@pytest.mark.parametrize(
    "text", ["", " ", "Mo", "Mon-", "8:00-9:00", "Mon 25:00-26:00", "Mon 10:00-10:00", "Mon 10:60-11:00", "x" * 999]
)
def test_hours_that_are_none_are_refused(text: str) -> None:
    with pytest.raises(RightsError, match="is not understood"):
        hours.parse(text)
