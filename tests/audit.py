"""Looks for known vulnerabilities of the pinned packages: ``./run audit``. It is no test: the answer changes from day to day.

pip-audit (an environment of its own, `requirements-audit.txt`) asks the database OSV about each version in each list of packages.
``FAILOVER_OSV_URL`` names a mirror of it.

Exit status: 0 none is known; 1 some are; 2 the database cannot be asked, so nothing is known.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any, Final

ROOT: Final = Path(__file__).resolve().parents[1]
TOOL: Final = ROOT / ".venv/audit/bin/pip-audit"
OSV: Final = "https://api.osv.dev/v1/query"
TIMEOUT_S: Final = 15
LISTS: Final = ("requirements*.txt", "debian/requirements.txt")


def main() -> int:
    """Ask, and tell."""
    url = os.environ.get("FAILOVER_OSV_URL", OSV)
    if not TOOL.exists():
        print("audit: pip-audit is not installed; ./run audit installs it, from the package registry", file=sys.stderr)
        return 2
    answers: dict[tuple[str, str], dict[str, Any]] = {}
    for lists in without_contradiction(sorted(path for pattern in LISTS for path in ROOT.glob(pattern))):
        answer, why = asked(lists, url)
        if answer is None:
            print(
                f"audit: the database of vulnerabilities at {url} cannot be asked, so nothing is known about the pinned "
                f"packages: {why}; try again from a machine that reaches it, or name a mirror in FAILOVER_OSV_URL",
                file=sys.stderr,
            )
            return 2
        answers.update({(one["name"], one.get("version", "")): one for one in answer})
    return told([answers[key] for key in sorted(answers)])


def without_contradiction(lists: list[Path]) -> list[list[Path]]:
    """The lists in groups: pip-audit takes one version of a package at a time."""
    groups: list[tuple[list[Path], dict[str, str]]] = []
    for path in lists:
        pinned = dict(re.findall(r"(?m)^([a-z0-9.-]+)==(\S+)", path.read_text()))
        for group, versions in groups:
            if all(versions.get(name, version) == version for name, version in pinned.items()):
                group.append(path)
                versions.update(pinned)
                break
        else:
            groups.append(([path], pinned))
    return [group for group, _ in groups]


def asked(lists: list[Path], url: str) -> tuple[list[dict[str, Any]] | None, str]:
    """What pip-audit says of each package; None, and why, where it got no answer."""
    with tempfile.TemporaryDirectory() as directory:
        file = Path(directory, "answer.json")
        command = [TOOL, "--vulnerability-service", "osv", "--osv-url", url, "--timeout", str(TIMEOUT_S), "--disable-pip"]
        command += ["--require-hashes", "--progress-spinner", "off", "--format", "json", "--output", file]
        command += [word for path in lists for word in ("--requirement", path)]
        ran = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
        if not file.exists():
            lines = [line for line in ran.stderr.splitlines() if line.strip()]
            return None, lines[-1][:300] if lines else f"pip-audit ended with {ran.returncode}"
        found: list[dict[str, Any]] = json.loads(file.read_text())["dependencies"]
    return found, ""


def told(answer: list[dict[str, Any]]) -> int:
    """Print what was found; the exit status."""
    skipped = [one for one in answer if "skip_reason" in one]
    for one in skipped:
        print(f"audit: {one['name']} was not looked at: {one['skip_reason']}", file=sys.stderr)
    known = [(one, bug) for one in answer for bug in one.get("vulns", ())]
    for one, bug in known:
        cure = f"mended in {', '.join(bug['fix_versions'])}" if bug["fix_versions"] else "no version is mended yet"
        print(f"{one['name']} {one['version']}: {', '.join([bug['id'], *bug['aliases']])}: {cure}")
    if known:
        names = {one["name"] for one, _ in known}
        print(f"audit: {len(known)} known vulnerabilities in {len(names)} packages: raise their versions")
        return 1
    print(f"audit: no vulnerability is known in {len(answer) - len(skipped)} packages")
    return 2 if skipped else 0


if __name__ == "__main__":
    sys.exit(main())
